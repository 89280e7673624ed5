"""The figures of the reports, one module a page, one function a figure: arrays in, a matplotlib ``Figure`` out.

To add a figure to a page, write its function in the page's module here (``figures/fit.py``, ``figures/gap.py``, ...)
with the helpers of :mod:`~dropo_torch.report.figures.drawing`, call it where the page's content is put together
(``report/fit.py``, ...), and place it in the page's template with ``{{ figure|svg }}``.
"""

from dropo_torch.report.figures.drawing import new_axes, new_figure
from dropo_torch.report.figures.svg import to_svg

__all__ = ["new_axes", "new_figure", "to_svg"]
