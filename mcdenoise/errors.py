"""The one error that a person's input can cause."""

from __future__ import annotations

# Names of channels may have 255 bytes each, and a path 4096.
_LONGEST = 1500


class InputError(ValueError):
    """Input that cannot be used: its message is one line that says what, where, expected, found and what to do.

    The command line prints the message and exits with status 2; in Python it is a ``ValueError``. Names in files and of
    files become :func:`printable`.
    """

    def __init__(self, message: str = "") -> None:
        text = printable(message)
        if len(text) > _LONGEST:
            text = f"{text[: _LONGEST // 3 * 2]} ... {text[-(_LONGEST // 3) :]}"
        super().__init__(text)


class MissingBufferError(InputError):
    """A frame lacks a buffer that a method cannot do without."""


def is_unicode(text: str) -> bool:
    """Whether the text has an encoding in UTF-8; the name of a file that is none has not."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def printable(text: str) -> str:
    r"""The text without what a terminal would obey and without line breaks: such characters are spelled out.

    Example:
        >>> printable("sky\x1b[2J")
        'sky\\x1b[2J'
    """
    if text.isprintable():
        return text
    return "".join(each if each.isprintable() else ascii(each)[1:-1] for each in text)
