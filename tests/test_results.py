"""Results as they are stored: what was written is read again, and what is damaged is refused in one line."""

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

from mcdenoise.errors import InputError
from mcdenoise.report.views import views
from mcdenoise.results import Cell, Cost, Fit, Machine, Method, Results, Scene, Spread

SPREAD = Spread(2.0, 1.0, 4.0, 3)


@pytest.fixture
def results() -> Results:
    return Results(
        command="mcdenoise benchmark plane",
        created="2026-01-01T00:00:00+00:00",
        machine=Machine("a processor", 2, 8.0, "cpu", 1, "an operating system", {"torch": "2"}),
        rounds=3,
        scenes=[Scene("plane", 1000, 500, [0, 1], [1], [1], 0.01)],
        methods=[
            Method("noisy", "baseline", "noisy", "noisy"),
            Method("ours", "trainable", "ours", "ours", {"width": 4}, "ours.safetensors", "bfloat16", True, 12),
            Method("theirs", "fixed", "theirs", "theirs", missing="not installed"),
        ],
        cells=[
            Cell("plane", "noisy", failure="it broke"),
            Cell("plane", "ours", {"SMAPE": 0.1}, {"SMAPE": SPREAD}, SPREAD, {"read": SPREAD}, 5.0, computing=SPREAD),
        ],
        costs=[Cost("ours", 10, 20, SPREAD), Cost("ours", 1000, 2000, failure="too little memory")],
        fits=[Fit("ours", 1.0, 2.0, 0.1)],
        notes=["FLIP is skipped"],
    )


HOSTILE: list[Any] = [None, True, -1, 1e300, "../..", "\x1b[2J", []]


def places(content: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    items = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, value in items:
        yield (*path, key)
        yield from places(value, (*path, key))


def changed(content: Any, path: tuple[Any, ...], change: Callable[[Any, Any], None]) -> Any:
    copied = json.loads(json.dumps(content))
    holder = copied
    for key in path[:-1]:
        holder = holder[key]
    change(holder, path[-1])
    return copied


def damaged(content: Any) -> Iterator[Any]:
    for path in places(content):
        for value in HOSTILE:
            yield changed(content, path, lambda holder, key, value=value: holder.__setitem__(key, value))
        yield changed(content, path, lambda holder, key: holder.pop(key))
        if isinstance(path[-1], int):
            yield changed(content, path, lambda holder, key: holder.append(holder[key]))


def read_or_refused(folder: Path) -> Results | None:
    """Results that are as they are meant to be; those that are not are refused in one line."""
    message, read = "", None
    try:
        read = Results.read(folder)
    except InputError as error:
        message = str(error)
    if read is None:
        assert message.startswith(f"{folder / 'results.json'}: expected")
        assert "\n" not in message
        assert len(message) < 1000
    else:
        json.dumps(asdict(read), allow_nan=False)
    return read


def test_whatever_is_changed_it_is_refused_in_one_line_or_still_makes_sense(results: Results, tmp_path: Path) -> None:
    cells = [
        results.cells[0],
        replace(results.cells[1], plan=[{"stage": "history", "skipped": 0.5, "reason": "still"}]),
    ]
    replace(results, cells=cells).write(tmp_path)
    path, counts = tmp_path / "results.json", [0, 0]
    for content in damaged(json.loads(path.read_text())):
        path.write_text(json.dumps(content))
        read = read_or_refused(tmp_path)
        counts[read is not None] += 1
        if read is not None:
            shown = views(read)
            assert len(shown[-1].rows) == len(read.methods)
            read.skipped()
            [read.megapixels_per_second(cell) for cell in read.cells]
    assert counts[0] > 400
    assert counts[1] > 100


@pytest.mark.usefixtures("no_finalizers")
def test_no_text_is_too_much(results: Results, tmp_path: Path) -> None:
    results.write(tmp_path)
    path = tmp_path / "results.json"
    text = path.read_text()
    numbers = ("NaN", "Infinity", "-Infinity", "1e999", "-1e999", "9" * 5000, "1" * 400)
    others = (
        *(text.replace("0.1", number) for number in numbers),
        "[" * 100_000,
        '{"a":' * 100_000,
        "null",
        "[]",
        "0",
        "",
    )
    deep = text.replace('"settings": {', '"settings": {"a": ' + "[" * 50_000 + "]" * 50_000 + ", ")
    for content in (*others, deep, text + text, text[1:], text.replace("plane", "\udcff")):
        path.write_bytes(content.encode(errors="surrogateescape"))
        assert read_or_refused(tmp_path) is None, content[:100]
    for scenes in ([], None, 1, "x"):
        path.write_text(json.dumps(json.loads(text) | {"scenes": scenes}))
        assert read_or_refused(tmp_path) is None
