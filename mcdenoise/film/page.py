"""The report page of a film: all shots, with the frames that a supervisor should check in each."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mcdenoise.data.files import write_text
from mcdenoise.film.driver import Film, FilmResult, ShotResult
from mcdenoise.film.work import Summary
from mcdenoise.report import render_page

FILE = "film.html"
# Size of a curve in the units of its SVG.
_WIDTH, _HEIGHT = 600, 40


def write_page(film: Film, result: FilmResult) -> Path:
    """Write ``OUT/film.html``: for each shot failures, the frames with the largest change, a strip, resets, warnings.

    Shots that are not complete come first, then the others by their largest change. The thumbnails are files beside the
    page, and are loaded as it is scrolled.

    Args:
        film: the film.
        result: how it ended.

    Returns:
        The path of the page.

    Raises:
        InputError: a package of ``mcdenoise[report]`` is not installed, or the page cannot be written.
    """
    shots = sorted(map(_shown, result.shots), key=lambda shot: (shot["complete"], -shot["score"]))
    path = film.out / FILE
    content = {"shots": shots, "result": result, "size": (_WIDTH, _HEIGHT)}
    write_text(path, render_page("film.html.jinja", content))
    return path


def _shown(result: ShotResult) -> dict[str, Any]:
    summary = result.summary or Summary()
    rows = summary.frames
    curves = {
        "change from both neighbours": _curve([row["score"] for row in rows]),
        "pixels with a history": _curve([row["history"] or 0.0 for row in rows], highest=1.0),
        "milliseconds": _curve([row["milliseconds"] for row in rows]),
    }
    return result.as_json() | {
        "score": summary.worst[0]["score"] if summary.worst else 0.0,
        "replaced": sum(row["replaced_pixels"] for row in rows),
        "worst": summary.worst,
        "strip": summary.strip,
        "curves": curves if len(rows) > 1 else {},
    }


def _curve(values: Sequence[float], highest: float = 0.0) -> dict[str, Any]:
    """The points of an SVG polyline, and the largest value."""
    highest = highest or max(values, default=0.0) or 1.0
    step = _WIDTH / max(len(values) - 1, 1)
    points = " ".join(f"{step * i:.1f},{_HEIGHT * (1 - min(v / highest, 1)):.1f}" for i, v in enumerate(values))
    return {"points": points, "highest": f"{highest:.3g}"}
