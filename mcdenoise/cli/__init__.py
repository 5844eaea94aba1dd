"""The command line: parses, calls, prints."""

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

# What each command does; it is the function of its name in the module of its name here.
COMMANDS = {
    "demo": "Render a short animation at one sample a pixel, denoise it, and show the result.",
    "denoise": "Denoise the frames of a shot, as a renderer wrote them.",
    "film": "Denoise the shots of a film, by many processes or machines, and resume where they were stopped.",
    "inspect": "Show what would be read of the frames of a shot, and why; denoises nothing.",
    "render": "Render a Mitsuba 3 scene along a camera path to a noisy sequence with references.",
    "generate": "Render random scenes to train on.",
    "train": "Train a model on sequences with references.",
    "sweep": "Train the runs of recipes with several seeds, by many processes or machines.",
    "calibrate": "Calibrate weights for --precision int8.",
    "evaluate": "Compare a folder of denoised images with references.",
    "benchmark": "Measure error against run time of models and other denoisers.",
    "report": "Write the page and the plots of a finished benchmark.",
    "gradcheck": "Check first and second derivatives of the operators, or of a function of your own.",
    "stability": "Check operators, models and the denoiser on stiff and extreme inputs, in every precision.",
    "export": "Write a model as an ONNX or torch.export graph.",
    "models": "List the models with their size and cost.",
    "ops": "List the operators with their error against the equations written out.",
}

_SUMMARY = """usage: mcdenoise COMMAND [OPTIONS]

Interactive Monte Carlo denoising you can open up.

commands:
{commands}

`mcdenoise COMMAND --help` says everything about a command."""


def main(arguments: list[str] | None = None) -> None:
    """Run a command, and exit.

    The status is 0; 1 where a check failed; 2 for bad usage or bad input; and, after a signal that ends it, 128 and the
    number of the signal: 130 after Ctrl+C.

    Args:
        arguments: of a command that this process runs among others; those of the process by default. Then signals are
            obeyed until its very end.
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
        # Whatever has become of what a signal has raised.
        if not interruption.number:
            raise
        status = 0
    finally:
        interruption.listening = False
        if not of_process and not interruption.number:
            interruption.stop()
    sys.exit(interruption.status(status))


def _status(name: str, arguments: list[str]) -> int:
    """Run a command, and say in one line why it could not be; the exit status."""
    try:
        with forgiving_stdout():
            return _run(name, arguments)
    except InputError as error:
        print(f"mcdenoise{f' {name}' if name else ''}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        # Of somebody who raises it without a signal.
        print(f"mcdenoise {name}: interrupted; finished files are kept", file=sys.stderr)
        return 130


def _run(name: str, arguments: list[str]) -> int:
    """Run a command, or say what there is; the exit status."""
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
        # Help was asked for.
        return int(stop.code or 0)


def _check_json(command: Callable[[], int | None]) -> None:
    """See that the file of ``--json`` can be written, where a command has one, before its work and not after it."""
    given: dict[str, Any] = getattr(command, "keywords", {})
    if given.get("json") is None:
        return
    from mcdenoise.cli._output import check_json

    inputs: list[Path] = []
    # Groups of options hold paths, too.
    grouped = [each for group in given.values() if is_dataclass(group) for each in vars(group).values()]
    for name, value in (*given.items(), *(("", each) for each in grouped)):
        if name not in ("json", "out"):
            inputs += (
                each for each in (value if isinstance(value, list | tuple) else [value]) if isinstance(each, Path)
            )
    check_json(given["json"], inputs, given.get("out"))


def load_command(name: str) -> Command:
    """The function that runs a command; only now are its imports paid for.

    Args:
        name: one of :data:`COMMANDS`.
    """
    command: Command = getattr(importlib.import_module(f"{__name__}.{name}"), name)
    return command


def parse(name: str, arguments: list[str]) -> Callable[[], int | None]:
    """A command with its arguments, ready to be called.

    Args:
        name: one of :data:`COMMANDS`.
        arguments: as on the command line.

    Raises:
        InputError: the command does not take them.
    """
    # Here, and not before signals are obeyed, because it takes its time to load.
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
        # tyro frames its messages: a title, what is wrong, a rule, and more help.
        lines = [line.strip("│╭╮╰╯ ") for line in messages.getvalue().splitlines()]
        wrong = itertools.takewhile(lambda line: line.strip("─"), lines[1:])
        raise InputError(f"{' '.join(wrong).rstrip('.')}; see `{prog} --help`") from stop


def _summary() -> str:
    return _SUMMARY.format(commands="\n".join(f"  {name:<10} {what}" for name, what in COMMANDS.items()))
