"""The report of a benchmark: one page that opens anywhere, and its plots for papers."""

from mcdenoise.report.writing import write_report

__all__ = ["write_report"]
