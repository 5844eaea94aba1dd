"""What commands show, and where they show it."""

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
    """A progress bar on stderr; silent when that is no terminal."""
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeRemainingColumn(),
    )
    return Progress(*columns, console=console, disable=not console.is_terminal)


def say(line: object) -> None:
    """Print a line that has paths in it, or what else others have named: a terminal obeys nothing of it."""
    print(printable(str(line)), flush=True)


def show(table: Table) -> None:
    """Print a table to stdout."""
    # A pipe has no width: never fold what a script may read.
    console = Console()
    Console(width=None if console.is_terminal else 200).print(table)


def print_rows(rows: list[dict[str, str]]) -> None:
    """Print rows with the same columns; nothing where there are none."""
    if rows:
        table = Table(*rows[0])
        for row in rows:
            # As they stand: a layer's name may hold brackets, which are orders to a table.
            table.add_row(*(Text(printable(each)) for each in row.values()))
        show(table)


def print_times(milliseconds: dict[str, float]) -> None:
    """Print the run time of each stage, and of all."""
    print(f"milliseconds a frame (median): {stages(milliseconds)}; together {sum(milliseconds.values()):.1f}")


def stages(milliseconds: dict[str, float]) -> str:
    """The run time of each stage in words."""
    return ", ".join(f"{stage} {value:.1f}" for stage, value in milliseconds.items())


def warn(warnings: Iterable[str]) -> None:
    """Say on stderr what is probably wrong, a line each."""
    for warning in warnings:
        print(f"warning: {printable(warning)}", file=sys.stderr)


def check_json(path: Path | None, inputs: Iterable[Path], out: Path | None) -> None:
    """See that the file of ``--json`` can be written before there is anything to be written.

    Args:
        path: of ``--json``.
        inputs: files and folders that the command reads, which it must not be one of.
        out: folder that the command makes, in which it may be.

    Raises:
        InputError: it cannot.
    """
    if path is None:
        return
    # Here because it brings the reader of images, which not every command needs.
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
    """Write what was printed to the file of ``--json``, if there is one."""
    if path is not None:
        # Here because it brings the reader of images, which not every command needs.
        from mcdenoise.data.files import write_text

        write_text(path, json.dumps(content, indent=2) + "\n")
