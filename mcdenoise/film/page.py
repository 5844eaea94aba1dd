"""The page that a supervisor scrolls through: all shots of a film, and what to look at in each."""

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
# Of a curve, in units of its own.
_WIDTH, _HEIGHT = 600, 40


def write_page(film: Film, result: FilmResult) -> Path:
    """Write ``OUT/film.html``: of each shot what failed, the frames that stick out, a strip, resets and warnings.

    Shots that are not complete come first, then those with the frames that stick out most. Pictures lie beside the page
    and are loaded as it is scrolled.

    Args:
        film: what was to be made.
        result: what became of it.

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
        "joint": film.joint,
        "size": (_WIDTH, _HEIGHT),
    }
    write_text(path, render_page("film.html.jinja", content))
    return path


def _shown(result: ShotResult) -> dict[str, Any]:
    rows: Sequence[Mapping[str, Any]] = () if result.closed is None else result.closed.frames
    pictures: Mapping[int, str] = {} if result.closed is None else result.closed.pictures
    worst = sorted(rows, key=lambda row: -row["score"])[:_WORST]
    shown = {row["number"] for row in worst}
    return {
        "name": result.shot.name,
        "id": quote(result.shot.name),
        "complete": result.complete,
        "score": worst[0]["score"] if worst else 0.0,
        "frames": len(result.found.numbers) if result.found is not None else 0,
        "made": result.made,
        "rate": result.rate,
        "failures": result.failures(),
        "warnings": () if result.closed is None else result.closed.warnings,
        "joints": {} if result.closed is None else result.closed.joints,
        "resets": [(row["number"], row["reset"]) for row in rows if row["reset"]],
        "replaced": sum(row["replaced_pixels"] for row in rows),
        "worst": [{**row, "picture": quote(pictures[row["number"]])} for row in worst if row["number"] in pictures],
        "strip": [(number, quote(path)) for number, path in sorted(pictures.items()) if number not in shown],
        "curves": [
            ("sticks out of its neighbours by", _curve([row["score"] for row in rows])),
            ("pixels with a history", _curve([row["history"] or 0.0 for row in rows], top=1.0)),
            ("milliseconds", _curve([row["milliseconds"] for row in rows])),
        ]
        if len(rows) > 1
        else [],
    }


def _curve(values: Sequence[float], top: float = 0.0) -> dict[str, Any]:
    """Points of a line, as SVG has them, and the largest value."""
    top = top or max(values) or 1.0
    step = _WIDTH / (len(values) - 1)
    points = " ".join(f"{step * i:.1f},{_HEIGHT * (1 - min(v / top, 1)):.1f}" for i, v in enumerate(values))
    return {"points": html.escape(points), "top": f"{top:.3g}"}
