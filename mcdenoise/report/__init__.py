"""The report of a benchmark: one page that opens anywhere, and its plots for papers."""

from mcdenoise.report.gallery import kept_pictures, read_picture
from mcdenoise.report.writing import check_packages, render_page, write_report, write_sample_plots

__all__ = [
    "check_packages",
    "kept_pictures",
    "read_picture",
    "render_page",
    "write_report",
    "write_sample_plots",
]
