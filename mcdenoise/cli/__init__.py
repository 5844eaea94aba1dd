"""The command line: parsing of arguments, and exit statuses."""

from __future__ import annotations

import atexit
import contextlib
import functools
import gc
import importlib
import io
import itertools
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator
from inspect import cleandoc, signature
from typing import Any, get_type_hints

from mcdenoise.cli._stdout import forgiving_stdout
from mcdenoise.errors import InputError, printable
from mcdenoise.interruption import heed_signals
from mcdenoise.threads import wait_passively

Command = Callable[..., int | None]

# Commands with their summaries. Command NAME is the function NAME of the module NAME in this package.
COMMANDS = {
    "demo": "Render a short animation at one sample per pixel, denoise it, and show the result.",
    "denoise": "Denoise the frames of a shot, as a renderer wrote them.",
    "film": "Denoise the shots of a film in several processes or on several machines, and resume interrupted shots.",
    "inspect": "Show how the frames of a shot would be read, and why, without denoising them.",
    "render": "Render a Mitsuba 3 scene along a camera path to a noisy sequence with references.",
    "generate": "Render random scenes for training.",
    "train": "Train a model on sequences with references.",
    "evaluate": "Compare a folder of denoised images with references.",
    "benchmark": "Measure error and run time of models and other denoisers.",
    "gradcheck": "Check first and second derivatives of the operators, or of a function of your own.",
    "stability": "Check operators, models and the denoiser on stiff and extreme inputs, in every precision.",
    "export": "Write a model as an ONNX or torch.export graph.",
    "models": "List the models, or the operators, with what they need and cost.",
}

_SUMMARY = """usage: mcdenoise COMMAND [OPTIONS]

Interactive Monte Carlo denoising you can open up.

commands:
{commands}

`mcdenoise COMMAND --help` shows the options of a command."""


def main(arguments: list[str] | None = None) -> None:
    """Run a command, and exit.

    The exit status is 0 on success, 1 if a check failed, 2 for bad usage or bad input, and 128 plus the number of the
    signal if a signal ended the command: 130 after Ctrl+C.

    Args:
        arguments: arguments of the command, for a process that continues afterwards; by default those of the process,
            whose signals are then handled until it ends.
    """
    of_process = arguments is None
    arguments = sys.argv[1:] if arguments is None else arguments
    name = arguments[0] if arguments and arguments[0] in COMMANDS else ""
    statuses: list[int] = []
    if of_process:
        # Registered first, and so called last.
        atexit.register(_leave, statuses)
        warnings.showwarning = _warn
        heed_signals(name)
    statuses.append(_status(name, arguments))
    sys.exit(*statuses)


def _warn(message: Warning | str, *_: object, **__: object) -> None:
    """Print a warning of Python's as the command's own, in one line without a place in the code."""
    print(f"warning: {printable(' '.join(str(message).split()))}", file=sys.stderr)


def _leave(statuses: list[int]) -> None:
    """End the process at once, after its last exit function: to take torch's modules apart takes half a second.

    Args:
        statuses: the exit status; none after an exception, of which Python tells.
    """
    for status in statuses:
        for stream in (sys.stdout, sys.stderr):
            # It may be closed, or its reader may be gone.
            with contextlib.suppress(OSError, ValueError, AttributeError):
                stream.flush()
        os._exit(status)


def _status(name: str, arguments: list[str]) -> int:
    """Run a command, and print the reason for a failure in one line; returns the exit status."""
    try:
        with forgiving_stdout():
            return _run(name, arguments)
    except InputError as error:
        print(f"mcdenoise{f' {name}' if name else ''}: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        # Signals of a process that is not the command's own are left as they were.
        print(f"mcdenoise {name}: interrupted; finished files are kept", file=sys.stderr)
        return 130


def _run(name: str, arguments: list[str]) -> int:
    """Run a command, or print the summary or the version; returns the exit status."""
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_SUMMARY.format(commands="\n".join(f"  {name:<10} {summary}" for name, summary in COMMANDS.items())))
        return 0 if arguments else 2
    if arguments[0] == "--version":
        from importlib.metadata import version

        print(version("mcdenoise"))
        return 0
    if not name:
        raise InputError(f"unknown command '{arguments[0]}'; expected one of {', '.join(COMMANDS)}")
    wait_passively()
    try:
        with _no_collection():
            command = parse(name, arguments[1:])
    except SystemExit as stop:
        # The help of the command was printed.
        return int(stop.code or 0)
    if command.keywords.get("json") is not None:
        from mcdenoise.cli._output import check_json

        check_json(command.keywords)
    try:
        return command() or 0
    except SystemExit as stop:
        # No command ends in this way, so a model or a function of the user has asked for it.
        raise InputError(
            f"expected code of yours that goes on, found that it ends the program (SystemExit: {stop})"
        ) from stop


@contextlib.contextmanager
def _no_collection() -> Iterator[None]:
    """Collect no garbage inside this block, which loads modules: there is none, and looking for it takes time."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def load_command(name: str) -> Command:
    """Import the function that runs a command.

    Args:
        name: one of :data:`COMMANDS`.
    """
    command: Command = getattr(importlib.import_module(f"{__name__}.{name}"), name)
    return command


def parse(name: str, arguments: list[str]) -> functools.partial[int | None]:
    """Parse the arguments of a command, and return a function that runs it.

    Args:
        name: one of :data:`COMMANDS`.
        arguments: as on the command line.

    Raises:
        InputError: the command does not accept the arguments.
    """
    # These imports are slow, so they come after the handling of signals has begun.
    import tyro

    from mcdenoise.cli._options import optional_values

    command, prog = load_command(name), f"mcdenoise {name}"

    def bind(*args: Any, **kwargs: Any) -> functools.partial[int | None]:
        return functools.partial(command, *args, **kwargs)

    bind.__signature__ = signature(command)  # type: ignore[attr-defined]
    bind.__annotations__ = get_type_hints(command, include_extras=True)
    # Without the line breaks that are due to the width of the source.
    bind.__doc__ = re.sub(r"\n {8,}(?=\S)", " ", cleandoc(command.__doc__ or ""))
    messages = io.StringIO()
    try:
        with contextlib.redirect_stderr(messages):
            return tyro.cli(bind, args=[_expanded(each) for each in arguments], prog=prog, registry=optional_values())
    except SystemExit as stop:
        if not stop.code:
            raise
        raise InputError(f"{_in_one_line(messages.getvalue())}; see `{prog} --help`") from stop


def _in_one_line(box: str) -> str:
    """The errors that tyro prints in a box, without the help that it adds to them."""
    # The box has a title, and then blocks with rules between them; a terminal without Unicode gets rules of hyphens.
    lines = [line.rstrip("│ ")[2:] for line in box.splitlines()[1:-1]]
    blocks = [list(block) for inside, block in itertools.groupby(lines, lambda line: bool(line.strip("─-"))) if inside]
    errors = []
    for i, block in enumerate(blocks):
        if block[0].startswith("Missing from"):
            # A line with the names of an option is indented by four spaces, and its help by more.
            missing = [line.rpartition(", ")[2].strip() for line in block if re.match(r" {4}\S", line)]
            errors.append(f"expected {', '.join(missing)}, found none")
        elif i == 0 or block[0].startswith("Unrecognized"):
            text = " ".join(line.strip() for line in block).rstrip(".")
            errors.append(text[0].lower() + text[1:])
    return "; ".join(errors)


def _expanded(argument: str) -> str:
    """The argument with the user's folder for ``~``, which a shell does not expand in quotes or after ``--option=``."""
    option, equals, value = argument.partition("=") if argument.startswith("--") else ("", "", argument)
    return f"{option}{equals}{os.path.expanduser(value)}"
