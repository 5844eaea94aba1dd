"""What is measured once on a machine and kept in the user's cache folder."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from mcdenoise.errors import InputError


def cache_file(name: str) -> Path:
    """Where a file of the user's cache is, whether or not there is one."""
    folder = os.environ.get("XDG_CACHE_HOME")
    return (Path(folder) if folder else Path("~/.cache").expanduser()) / "mcdenoise" / name


def kept(path: Path) -> str:
    """The text of a file of a cache.

    Raises:
        ValueError: there is none.
    """
    from mcdenoise.data.files import read_file

    return read_file(path, "a file of a cache").decode()


def keep(path: Path, text: str) -> None:
    """Write a file of a cache, whole or not at all; where there is no place for it, it is measured again next time."""
    # Here because it brings the readers of files, which take their time to load.
    from mcdenoise.data.files import write_text

    with suppress(OSError, InputError):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, text)
