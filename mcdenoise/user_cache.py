"""Files in the user's cache folder, for values that are measured once on a machine."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from mcdenoise.errors import InputError


def cache_file(name: str) -> Path:
    """Path of a file in the user's cache folder; the file need not exist."""
    folder = os.environ.get("XDG_CACHE_HOME")
    return (Path(folder) if folder else Path("~/.cache").expanduser()) / "mcdenoise" / name


def keep(path: Path, text: str) -> None:
    """Write a cache file atomically; if that fails, the value is measured again next time."""
    # Imported here because it loads the readers of files, which takes time.
    from mcdenoise.data.files import write_text

    with suppress(OSError, InputError):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path, text)
