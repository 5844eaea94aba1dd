"""The report page of a film: all shots, with the frames that a supervisor should check in each."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from mcdenoise.data.files import write_text
from mcdenoise.film.driver import Film, FilmResult, ShotResult
from mcdenoise.report import render_page

FILE = "film.html"
_WORST = 3
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
    shots = [_shown(each) for each in result.shots]
    shots.sort(key=lambda shot: (shot["complete"], -shot["score"]))
    path = film.out / FILE
    content = {
        "shots": shots,
        "complete": result.complete,
        "made": result.made,
        "frames": sum(shot["frames"] for shot in shots),
        "failed": sum(len(each.failed) for each in result.shots),
        "seconds": result.seconds,
        "size": (_WIDTH, _HEIGHT),
    }
    write_text(path, render_page("film.html.jinja", content))
    return path


def _shown(result: ShotResult) -> dict[str, Any]:
    rows: Sequence[Mapping[str, Any]] = () if result.summary is None else result.summary.frames
    pictures: Mapping[int, str] = {} if result.summary is None else result.summary.pictures
    worst = sorted(rows, key=lambda row: -row["score"])[:_WORST]
    shown = {row["number"] for row in worst}
    return {
        "name": result.shot.name,
        "id": quote(result.shot.name),
        "complete": result.complete,
        "score": worst[0]["score"] if worst else 0.0,
        "frames": len(result.found.numbers) if result.found is not None else 0,
        "made": result.made,
        "picked": result.shot.picked,
        "failures": result.failures(),
        "warnings": () if result.summary is None else result.summary.warnings,
        "resets": [(row["number"], row["reset"]) for row in rows if row["reset"]],
        "replaced": sum(row["replaced_pixels"] for row in rows),
        "worst": [{**row, "picture": quote(pictures[row["number"]])} for row in worst if row["number"] in pictures],
        "strip": [(number, quote(path)) for number, path in sorted(pictures.items()) if number not in shown],
        "curves": [
            ("change from both neighbours", _curve([row["score"] for row in rows])),
            ("pixels with a history", _curve([row["history"] or 0.0 for row in rows], highest=1.0)),
            ("milliseconds", _curve([row["milliseconds"] for row in rows])),
        ]
        if len(rows) > 1
        else [],
    }


def _curve(values: Sequence[float], highest: float = 0.0) -> dict[str, Any]:
    """The points of an SVG polyline, and the largest value."""
    highest = highest or max(values) or 1.0
    step = _WIDTH / (len(values) - 1)
    points = " ".join(f"{step * i:.1f},{_HEIGHT * (1 - min(v / highest, 1)):.1f}" for i, v in enumerate(values))
    return {"points": html.escape(points), "highest": f"{highest:.3g}"}
