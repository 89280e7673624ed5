"""Reports: one self-contained HTML file from results, for people who have not read the paper."""

from dropo_torch.report.compare import write_compare_report
from dropo_torch.report.gap import write_gap_report
from dropo_torch.report.html import write_fit_report, write_sweep_report
from dropo_torch.report.study import write_study_report

__all__ = [
    "write_compare_report",
    "write_fit_report",
    "write_gap_report",
    "write_study_report",
    "write_sweep_report",
]
