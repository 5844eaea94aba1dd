"""The training cache: arrays that are computed once, written to disk, and mapped into memory in every run.

Those of a sequence are in a folder ``NAME-ID``, whose id identifies the sequence and the settings. Each folder in it
has ``.npy`` files, their checksums, and a key that identifies everything they were computed from. With another key, or
if they are damaged, the arrays are computed again.
"""

from __future__ import annotations

import functools
import hashlib
import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from mcdenoise.data import Sequence
from mcdenoise.data.files import held, new_folder, writing
from mcdenoise.errors import InputError
from mcdenoise.train.shots import Array

# Maps the arrays of a name; computes them by the function and writes them before, if necessary.
Keep: TypeAlias = Callable[[str, Callable[[], Mapping[str, Array]]], dict[str, Array]]


def open_cache(sequence: Sequence, settings: list[Any], folder: Path) -> Keep:
    """The cached arrays of a sequence: a function that takes their name and one that computes them.

    If another process is computing the arrays of a sequence, it waits. If they cannot be written, it raises an
    ``InputError``, and no incomplete files are left.

    Args:
        sequence: the sequence.
        settings: everything else that its arrays depend on, in JSON types.
        folder: folder of the whole cache; created if it does not exist.
    """
    settings = [sequence.numbers, *settings]
    identity = checksum_of([str(sequence.root.resolve()), *settings])[:16]
    key = checksum_of([*settings, checksum_of_code(), _state(sequence)])
    return functools.partial(_kept, folder / f"{sequence.name[:100]}-{identity}", key)


def _kept(folder: Path, key: str, name: str, make: Callable[[], Mapping[str, Array]]) -> dict[str, Array]:
    place = folder / name
    if (found := _mapped(place, key)) is None:
        with held(folder, "training", wait=True), writing(folder):
            # Another process may have done the work while this one waited.
            if (found := _mapped(place, key)) is None:
                shutil.rmtree(place, ignore_errors=True)
                arrays = make()
                with new_folder(place) as building:
                    for each, array in arrays.items():
                        np.save(building / f"{each}.npy", array, allow_pickle=False)
                    files = {path.name: _checksum(path) for path in sorted(building.iterdir())}
                    (building / "about.json").write_text(json.dumps({"key": key, "files": files}) + "\n")
                found = _mapped(place, key)
    if found is None:
        raise InputError(f"{place}: expected the arrays just written, found them damaged; check the disk")
    return found


def _mapped(place: Path, key: str) -> dict[str, Array] | None:
    """Map the arrays; return ``None`` if they are missing, stale or damaged, as their checksums tell."""
    try:
        about = json.loads((place / "about.json").read_text())
        if about != {"key": key, "files": {path.name: _checksum(path) for path in place.glob("*.npy")}}:
            return None
        # Plain views, because slicing a memmap takes longer than reading.
        maps = {name: np.load(place / name, mmap_mode="r", allow_pickle=False) for name in about["files"]}
        return {name.removesuffix(".npy"): array.view(np.ndarray) for name, array in maps.items()}
    except (OSError, EOFError, ValueError, RecursionError):
        return None


def _checksum(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def checksum_of(content: Any) -> str:
    """A checksum of JSON types."""
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def _state(sequence: Sequence) -> list[Any]:
    """Name, size and time of every file beside the frames; hidden ones are temporary files of a renderer."""
    inside = [folder.glob(name) for folder in sorted(sequence.folders) for name in ("[!.]*", "noise_seed*/[!.]*")]
    found = sorted(path for paths in inside for path in paths if path.is_file())
    return [(str(path), path.stat().st_size, path.stat().st_mtime_ns) for path in found]


@functools.cache
def checksum_of_code() -> str:
    """Checksum of the whole package, so that a corrected reader or operator does not use arrays of its predecessor.

    It covers all files rather than those for decoding and accumulating, because such a list would become outdated.
    """
    sources = sorted(Path(__file__).parents[1].rglob("*.py"))
    return hashlib.sha256(b"".join(map(Path.read_bytes, sources))).hexdigest()
