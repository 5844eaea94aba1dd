"""A suite of rendered frames that are never used for training: its contents, rendering, and tables."""

from mcdenoise.suite.close_ups import write_close_ups
from mcdenoise.suite.rendering import RenderingStep, open_row, render_suite, rows_there
from mcdenoise.suite.rows import SHOTS, Row, Shot, choose_rows
from mcdenoise.suite.tables import PEERS, SHOWN, Line, error_lines, markdown, sample_curves, suite_lines

__all__ = [
    "PEERS",
    "SHOTS",
    "SHOWN",
    "Line",
    "RenderingStep",
    "Row",
    "Shot",
    "choose_rows",
    "error_lines",
    "markdown",
    "open_row",
    "render_suite",
    "rows_there",
    "sample_curves",
    "suite_lines",
    "write_close_ups",
]
