"""Measured and simulated motion side by side: open-loop predictions of a log, and what is needed to draw them.

A run's folder is read by :mod:`~dropo_torch.view.run`, simulated by :mod:`~dropo_torch.view.replay`, reduced to simple
shapes by :mod:`~dropo_torch.view.scene`, and drawn: as a page by :mod:`dropo_torch.report.view`, as a video by
:mod:`~dropo_torch.view.video`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
