"""Output of commands: progress bars, tables, warnings and JSON files."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from mcdenoise.errors import InputError, printable


def progress_bar() -> Progress:
    """A progress bar on stderr; none if stderr is not a terminal."""
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeRemainingColumn(),
    )
    return Progress(*columns, console=console, disable=not console.is_terminal)


def say(line: object) -> None:
    """Print a line with names from users; control characters are escaped."""
    print(printable(str(line)), flush=True)


def show(table: Table) -> None:
    """Print a table to stdout."""
    # A pipe has no width: do not wrap lines that a script may read.
    console = Console()
    Console(width=None if console.is_terminal else 200).print(table)


def print_rows(rows: list[dict[str, str]]) -> None:
    """Print rows with the same columns; print nothing if there are none."""
    if rows:
        table = Table(*rows[0])
        for row in rows:
            # Disable markup, because a layer's name may contain brackets.
            table.add_row(*(Text(printable(each)) for each in row.values()))
        show(table)


def print_times(milliseconds: dict[str, float]) -> None:
    """Print the run time of each stage, and the total."""
    print(f"milliseconds a frame (median): {stages(milliseconds)}; together {sum(milliseconds.values()):.1f}")


def stages(milliseconds: dict[str, float]) -> str:
    """Text with the run time of each stage."""
    return ", ".join(f"{stage} {value:.1f}" for stage, value in milliseconds.items())


def warn(warnings: Iterable[str]) -> None:
    """Print warnings to stderr, one line each."""
    for warning in warnings:
        print(f"warning: {printable(warning)}", file=sys.stderr)


def check_json(path: Path | None, inputs: Iterable[Path], out: Path | None) -> None:
    """Check that the file of ``--json`` can be written before other output is written.

    Args:
        path: argument of ``--json``.
        inputs: files and folders that the command reads; the file must not be among them.
        out: folder that the command creates; the file may be in it.

    Raises:
        InputError: the file cannot be written.
    """
    if path is None:
        return
    # Imported here because it loads the reader of images, which not every command needs.
    from mcdenoise.data.files import check_writable

    real = os.path.realpath(path)
    for given in map(os.path.realpath, inputs):
        read = real.endswith("camera.json") or not real.endswith(".json")
        if real == given or (os.path.lexists(real) and read and real.startswith(f"{given}{os.sep}")):
            raise InputError(f"--json: expected a file to write, found {path}, which is read; choose another path")
    made = out is not None and not os.path.lexists(out) and real.startswith(f"{os.path.realpath(out)}{os.sep}")
    if not made:
        check_writable(path)


def write_json(path: Path | None, content: Any) -> None:
    """Write the printed results to the file of ``--json``, if it is given."""
    if path is not None:
        # Imported here because it loads the reader of images, which not every command needs.
        from mcdenoise.data.files import write_text

        write_text(path, json.dumps(content, indent=2) + "\n")
