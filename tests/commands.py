"""Commands, run in the process of their test."""

import io
from contextlib import redirect_stderr, redirect_stdout

import pytest

from mcdenoise.cli import main


def run(*arguments: object) -> tuple[int, str, str]:
    """Run `mcdenoise` with arguments, or with those of a line: exit status, standard output and standard error."""
    line = str(arguments[0]).split() if len(arguments) == 1 else [*map(str, arguments)]
    out, err = (io.TextIOWrapper(io.BytesIO(), "utf-8", write_through=True) for _ in range(2))
    with redirect_stdout(out), redirect_stderr(err), pytest.raises(SystemExit) as stop:
        main(line)
    printed, said = (stream.buffer.getvalue().decode() for stream in (out, err))
    return int(stop.value.code or 0), printed, said


def succeeds(*arguments: object) -> str:
    status, printed, said = run(*arguments)
    assert status == 0, said
    return printed


def silently(*arguments: object) -> str:
    """What a command prints that has nothing to warn of."""
    status, printed, said = run(*arguments)
    assert (status, said) == (0, "")
    return printed


def refuses(*arguments: object, status: int = 2) -> str:
    """The one line of a command that refuses its arguments."""
    found, _, said = run(*arguments)
    assert found == status
    assert said.startswith("mcdenoise")
    assert (said.count("\n"), said[-1]) == (1, "\n")
    return said
