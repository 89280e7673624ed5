"""Reports: one self-contained HTML file from results, for people who have not read the paper.

A page is a module here (what it says), a template beside it (how it is laid out) and a module of
:mod:`~dropo_torch.report.figures` (what it draws).
"""

from dropo_torch.report.compare import write_compare_report
from dropo_torch.report.fit import write_fit_report
from dropo_torch.report.gap import write_gap_report
from dropo_torch.report.study import write_study_report
from dropo_torch.report.sweep import write_sweep_report

__all__ = ["write_compare_report", "write_fit_report", "write_gap_report", "write_study_report", "write_sweep_report"]
