"""The errors caused by invalid input."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from difflib import get_close_matches
from typing import Any, get_args

# A channel name may have 255 bytes, and a path 4096.
_LONGEST = 1500


class InputError(ValueError):
    """Invalid input. The message is one line that says what and where, what was expected and found, and what to do.

    The command line prints the message and exits with status 2; in Python it is a ``ValueError``. The message is made
    :func:`printable`, since it may contain names of files and names stored in files.
    """

    def __init__(self, message: str = "") -> None:
        super().__init__(_shortened(printable(message)))


class MissingBufferError(InputError):
    """A frame lacks a buffer that a method needs."""


def import_optional(package: str, use: str, extra: str) -> Any:
    """Import an optional package.

    Args:
        package: its name in Python.
        use: what needs it, for the message.
        extra: the extra of this package that installs it.

    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise InputError(f"{use} needs {package}, which is not installed; pip install 'mcdenoise[{extra}]'") from error


@contextmanager
def naming(where: str) -> Iterator[None]:
    """Put the place in front of the errors of invalid input inside this block."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def check_choice(name: str, value: object, known: Any) -> None:
    """Check that a setting is one of a ``Literal``.

    Raises:
        InputError: it is none of them.
    """
    if value not in get_args(known):
        raise InputError(f"{name}: expected one of {', '.join(get_args(known))}, found {value!r}")


def run_script(main: Callable[[], object]) -> None:
    """Run a script: bad input is one line on standard error, and exit status 2."""
    try:
        main()
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)


def in_one_line(error: BaseException) -> str:
    r"""Type and message of an error, such as a user's code raises, in one line; of an :class:`InputError` the message.

    Example:
        >>> in_one_line(RuntimeError("out of\nmemory"))
        'RuntimeError: out of memory'
    """
    if isinstance(error, InputError):
        return str(error)
    name = type(error).__name__
    if isinstance(error, SystemExit):
        return f"it ends the program ({name}: {error})"
    # The text of an exception may be a user's code, too.
    with suppress(Exception):
        text = " ".join(str(error).split())
        return _shortened(f"{name}: {text}" if text else name)
    return name


def first_line(error: BaseException) -> str:
    r"""The first line of an error's message that says anything, or the name of its type.

    Example:
        >>> first_line(RuntimeError("\n out of memory\nat ..."))
        'out of memory'
    """
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """A question that offers the known names nearest to one that is unknown; empty if none is near.

    Example:
        >>> did_you_mean("wild-small", ["noisy", "wild_small"])
        'did you mean wild_small?'
    """
    near = get_close_matches(name.lower(), known)
    return f"did you mean {' or '.join(near)}?" if near else ""


def level_of_caller() -> int:
    """The ``stacklevel`` with which a warning shows the line that called this package, instead of a line in it."""
    level, frame = 1, sys._getframe(1)
    # Some functions of this package are decorated by a context.
    own = (__package__, "contextlib")
    while frame.f_globals.get("__name__", "").partition(".")[0] in own and frame.f_back is not None:
        level, frame = level + 1, frame.f_back
    return level


def is_unicode(text: str) -> bool:
    """Whether the text has an encoding in UTF-8; the name of a file that is none has not."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def printable(text: str) -> str:
    r"""Escape control characters, which a terminal would obey, and line breaks.

    Example:
        >>> printable("sky\x1b[2J")
        'sky\\x1b[2J'
    """
    if text.isprintable():
        return text
    return "".join(each if each.isprintable() else ascii(each)[1:-1] for each in text)


def _shortened(text: str) -> str:
    return text if len(text) <= _LONGEST else f"{text[: _LONGEST // 3 * 2]} ... {text[-(_LONGEST // 3) :]}"
