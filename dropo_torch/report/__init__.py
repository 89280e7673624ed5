"""Reports: one self-contained HTML file from results, for people who have not read the paper.

A page is a module here (what it says), a template beside it (how it is laid out) and a module of
:mod:`~dropo_torch.report.figures` (what it draws). Each is imported when it is first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
