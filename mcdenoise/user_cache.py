"""Files in the user's cache folder, for values that are measured once on a machine."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from mcdenoise.errors import InputError
from mcdenoise.reading import read_text


def cache_file(name: str) -> Path:
    """Path of a file in the user's cache folder; the file need not exist."""
    folder = os.environ.get("XDG_CACHE_HOME")
    return (Path(folder) if folder else Path("~/.cache").expanduser()) / "mcdenoise" / name


def measured_once(name: str, key: str, measure: Callable[[], float]) -> float:
    """A number above 0 that is measured once, and kept for later runs; if that fails, it is measured again then.

    Args:
        name: of the file in the user's cache folder.
        key: what was measured, and everything that the number depends on, the machine among it.
        measure: measures the number.
    """
    path = cache_file(name)
    known = numbers_in(path)
    if not 0 < known.get(key, 0.0) < math.inf:
        # Imported here because it loads the readers of files, which takes time.
        from mcdenoise.data.files import write_text

        known[key] = measure()
        with suppress(OSError, InputError):
            path.parent.mkdir(parents=True, exist_ok=True)
            write_text(path, json.dumps(known, indent=1) + "\n")
    return known[key]


def numbers_in(path: Path) -> dict[str, float]:
    """The numbers in a file by their keys; none if it is missing or damaged."""
    try:
        return {key: float(value) for key, value in json.loads(read_text(path)).items()}
    except (OSError, ValueError, TypeError, AttributeError, RecursionError, OverflowError):
        return {}
