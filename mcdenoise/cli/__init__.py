"""The command line: parsing, running commands, and printing results."""

from __future__ import annotations

import contextlib
import functools
import importlib
import io
import itertools
import sys
from collections.abc import Callable
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any

from mcdenoise.cli._stdout import forgiving_stdout
from mcdenoise.errors import InputError
from mcdenoise.interruption import Interruption
from mcdenoise.threads import wait_passively

Command = Callable[..., int | None]

# One line about each command; its function has the same name as its module in this package.
COMMANDS = {
    "demo": "Render a short animation at one sample per pixel, denoise it, and show the result.",
    "denoise": "Denoise the frames of a shot, as a renderer wrote them.",
    "film": "Denoise the shots of a film with many processes or machines; an interrupted film resumes.",
    "inspect": "Show which layers of a shot are read as which buffers, and why; denoises nothing.",
    "render": "Render a Mitsuba 3 scene along a camera path to a noisy sequence with references.",
    "generate": "Render random scenes for training.",
    "train": "Train a model on sequences with references.",
    "calibrate": "Calibrate weights for --precision int8.",
    "evaluate": "Compare a folder of denoised images with references.",
    "benchmark": "Measure error against run time of models and other denoisers.",
    "report": "Write the page and the plots of a finished benchmark.",
    "gradcheck": "Check first and second derivatives of the operators, or of a function of your own.",
    "stability": "Check operators, models and the denoiser on stiff and extreme inputs, in every precision.",
    "export": "Write a model as an ONNX or torch.export graph.",
    "models": "List the models with their size and cost.",
    "ops": "List the operators with their error against their equations.",
}

_SUMMARY = """usage: mcdenoise COMMAND [OPTIONS]

Interactive Monte Carlo denoising you can open up.

commands:
{commands}

`mcdenoise COMMAND --help` says everything about a command."""


def main(arguments: list[str] | None = None) -> None:
    """Run a command and exit.

    The exit status is 0; 1 if a check failed; 2 for wrong usage or invalid input; and, after a signal, 128 plus the
    number of the signal: 130 after Ctrl+C.

    Args:
        arguments: arguments of a command that runs inside another program; by default those of the process. Then
            signals are handled until the process ends.
    """
    of_process = arguments is None
    arguments = sys.argv[1:] if arguments is None else arguments
    name = arguments[0] if arguments and arguments[0] in COMMANDS else ""
    interruption = Interruption(name)
    interruption.start()
    try:
        interruption.listening = True
        status = _status(name, arguments)
    except BaseException:
        # Any exception that followed a signal.
        if not interruption.number:
            raise
        status = 0
    finally:
        interruption.listening = False
        if not of_process and not interruption.number:
            interruption.stop()
    sys.exit(interruption.status(status))


def _status(name: str, arguments: list[str]) -> int:
    """Run a command, and print input errors in one line; return the exit status."""
    try:
        with forgiving_stdout():
            return _run(name, arguments)
    except InputError as error:
        print(f"mcdenoise{f' {name}' if name else ''}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        # A KeyboardInterrupt that was raised without a signal.
        print(f"mcdenoise {name}: interrupted; finished files are kept", file=sys.stderr)
        return 130


def _run(name: str, arguments: list[str]) -> int:
    """Run a command, or print the summary; return the exit status."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_summary())
        return 0 if arguments else 2
    if arguments[0] == "--version":
        from importlib.metadata import version

        print(version("mcdenoise"))
        return 0
    if not name:
        raise InputError(f"unknown command '{arguments[0]}'; expected one of {', '.join(COMMANDS)}")
    wait_passively()
    try:
        command = parse(name, arguments[1:])
        _check_json(command)
        return command() or 0
    except SystemExit as stop:
        # tyro has printed the requested help.
        return int(stop.code or 0)


def _check_json(command: Callable[[], int | None]) -> None:
    """Check that the file of ``--json`` can be written, if the command has one, before its work begins."""
    given: dict[str, Any] = getattr(command, "keywords", {})
    if given.get("json") is None:
        return
    from mcdenoise.cli._output import check_json

    inputs: list[Path] = []
    # Groups of options also hold paths.
    grouped = [each for group in given.values() if is_dataclass(group) for each in vars(group).values()]
    for name, value in (*given.items(), *(("", each) for each in grouped)):
        if name not in ("json", "out"):
            inputs += (
                each for each in (value if isinstance(value, list | tuple) else [value]) if isinstance(each, Path)
            )
    check_json(given["json"], inputs, given.get("out"))


def load_command(name: str) -> Command:
    """Import the function of a command; its imports are only loaded now.

    Args:
        name: one of :data:`COMMANDS`.
    """
    command: Command = getattr(importlib.import_module(f"{__name__}.{name}"), name)
    return command


def parse(name: str, arguments: list[str]) -> Callable[[], int | None]:
    """Bind a command to its arguments.

    Args:
        name: one of :data:`COMMANDS`.
        arguments: arguments as on the command line.

    Raises:
        InputError: the arguments are invalid.
    """
    # Imported here, after signal handlers are installed, because it is slow to load.
    import tyro

    command, prog = load_command(name), f"mcdenoise {name}"

    @functools.wraps(command)
    def bind(*args: Any, **kwargs: Any) -> Callable[[], int | None]:
        return functools.partial(command, *args, **kwargs)

    messages = io.StringIO()
    try:
        with contextlib.redirect_stderr(messages):
            return tyro.cli(bind, args=arguments, prog=prog)
    except SystemExit as stop:
        if not stop.code:
            raise
        # tyro frames its messages: a title, the errors, a rule, and further help. Keep the errors.
        lines = [line.strip("│╭╮╰╯ ") for line in messages.getvalue().splitlines()]
        wrong = itertools.takewhile(lambda line: line.strip("─"), lines[1:])
        raise InputError(f"{' '.join(wrong).rstrip('.')}; see `{prog} --help`") from stop


def _summary() -> str:
    return _SUMMARY.format(commands="\n".join(f"  {name:<10} {what}" for name, what in COMMANDS.items()))
