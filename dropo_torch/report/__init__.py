"""Reports: one self-contained HTML file from results, for people who have not read the paper."""

from dropo_torch.report.html import write_fit_report, write_sweep_report

__all__ = ["write_fit_report", "write_sweep_report"]
