"""The one error that a person's input can cause."""


class InputError(ValueError):
    """Input that cannot be used: its message is one line that says what, where, expected, found and what to do.

    The command line prints the message and exits with status 2; in Python it is a ``ValueError``.
    """
