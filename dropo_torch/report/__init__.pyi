# The pages, read by type checkers and, at import, by lazy_loader.
from .check import write_check_report as write_check_report
from .compare import write_compare_report as write_compare_report
from .fit import write_fit_report as write_fit_report
from .gap import write_gap_report as write_gap_report
from .gap_picture import write_gap_picture as write_gap_picture
from .init import write_init_report as write_init_report
from .plan import write_plan_report as write_plan_report
from .study import write_study_report as write_study_report
from .sweep import write_sweep_report as write_sweep_report
from .view import write_view_page as write_view_page
