"""Printed output of commands: progress bars, tables, warnings, JSON files."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from mcdenoise.errors import InputError, printable


def progress_bar() -> Progress:
    """A progress bar on stderr, which is hidden if stderr is not a terminal."""
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeRemainingColumn(),
    )
    return Progress(*columns, console=console, disable=not console.is_terminal)


@contextmanager
def steps_of(task: str) -> Iterator[Callable[[int, int], None]]:
    """A progress bar of one task, as a function that takes the numbers of finished and of all steps."""
    with progress_bar() as progress:
        bar = progress.add_task(task, total=None)
        yield lambda done, total: progress.update(bar, completed=done, total=total)


@contextmanager
def frames_of(task: str, total: int) -> Iterator[Callable[..., None]]:
    """A progress bar of one task, as a function that is called after each of its frames."""
    with progress_bar() as progress:
        bar = progress.add_task(task, total=total)
        yield lambda *_: progress.advance(bar)


def say(line: object) -> None:
    """Print a line that contains paths or other names; terminal control sequences in it are escaped."""
    print(printable(str(line)), flush=True)


def console_of_tables() -> Console:
    """Stdout, with the width of the terminal."""
    # A pipe has no width; do not wrap lines that a script may read.
    console = Console()
    return console if console.is_terminal else Console(width=200)


def print_rows(rows: list[dict[str, str]]) -> None:
    """Print rows with the same columns as a table; prints nothing without rows."""
    if rows:
        table = Table(*rows[0])
        for row in rows:
            # Print names literally: brackets in the name of a layer would be markup to the table.
            table.add_row(*(Text(printable(each)) for each in row.values()))
        console_of_tables().print(table)


def print_times(milliseconds: dict[str, float]) -> None:
    """Print the run time of each stage, and their sum."""
    print(f"milliseconds a frame (median): {stages(milliseconds)}; together {sum(milliseconds.values()):.1f}")


def stages(milliseconds: dict[str, float]) -> str:
    """The run time of each stage as text."""
    return ", ".join(f"{stage} {value:.1f}" for stage, value in milliseconds.items())


def warn(*warnings: str) -> None:
    """Print warnings to stderr, one per line; an empty one is none."""
    for warning in filter(None, warnings):
        print(f"warning: {printable(warning)}", file=sys.stderr)


def check_json(given: Mapping[str, Any]) -> None:
    """Check before the work of a command that the file of ``--json`` can be written.

    Args:
        given: arguments of the command, ``json`` among them. It writes to ``out``, which it may create, and the file
            may be inside; all other paths are read.

    Raises:
        InputError: it cannot be written, or the command reads it.
    """
    path, out = given["json"], given.get("out")
    # Imported here because it loads the reader of images, which not every command needs.
    from mcdenoise.data.files import check_writable

    values = [value for name, value in given.items() if name not in ("json", "out")]
    # Groups of options contain paths too.
    values += [each for group in values if is_dataclass(group) for each in vars(group).values()]
    inputs = [each for value in values for each in (value if isinstance(value, list | tuple) else [value])]
    real = os.path.realpath(path)
    for source in (os.path.realpath(each) for each in inputs if isinstance(each, Path)):
        read = real.endswith("camera.json") or not real.endswith(".json")
        if real == source or (os.path.lexists(real) and read and real.startswith(f"{source}{os.sep}")):
            raise InputError(f"--json: expected a file to write, found {path}, which is an input; choose another path")
    made = out is not None and not os.path.lexists(out) and real.startswith(f"{os.path.realpath(out)}{os.sep}")
    if not made:
        check_writable(path)


def write_json(path: Path | None, content: Any) -> None:
    """Write the content of a printed table to the file of ``--json``, if it is given."""
    if path is not None:
        # Imported here because it loads the reader of images, which not every command needs.
        from mcdenoise.data import files

        files.write_json(path, content)
