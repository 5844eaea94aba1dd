"""A test suite of rendered frames that no model was trained on: its list of rows, its rendering, and its tables."""

from mcdenoise.suite.close_ups import write_close_ups
from mcdenoise.suite.rendering import open_row, render_suite, rows_there
from mcdenoise.suite.rows import SHOTS, Row, Shot, choose_rows
from mcdenoise.suite.tables import (
    SHOWN,
    Line,
    MethodMean,
    error_against_time,
    lines_of,
    markdown,
    sample_curves,
    with_peers,
)

__all__ = [
    "SHOTS",
    "SHOWN",
    "Line",
    "MethodMean",
    "Row",
    "Shot",
    "choose_rows",
    "error_against_time",
    "lines_of",
    "markdown",
    "open_row",
    "render_suite",
    "rows_there",
    "sample_curves",
    "with_peers",
    "write_close_ups",
]
