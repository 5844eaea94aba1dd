"""Decoded sequences on disk: what training reads again and again, decoded and accumulated once, opened in an instant.

A cached sequence is a folder of plain ``.npy`` files, one array each, mapped into memory and read where a clip needs
them. It lies in ``NAME-ID/KEY``: the id says which sequence and settings, the key what it was made from. Whoever finds
another key makes the arrays anew.
"""

from __future__ import annotations

import fcntl
import functools
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mcdenoise.frame import Frame
from mcdenoise.data.sequences import Sequence
from mcdenoise.errors import InputError
from mcdenoise.history import CAUSTICS, History
from mcdenoise.ops import Accumulate, ClampFireflies

# name, channels: what a training clip holds, in the order in which :meth:`Shot.read` stacks it
PARTS = {"color": 3, "current": 3, "length": 1, "albedo": 3, "normal": 3, "depth": 1, "reference": 3}
# Each realisation of the noise and each first frame has its own of these, in one array; all have the others in common.
_NOISY = ("color", "current", "length")
_FEATURES = {name: channels for name, channels in PARTS.items() if name not in _NOISY}
# The files that a reader of sequences looks at, and where they are in a sequence's folder.
_SUFFIXES = {".exr", ".h", ".json"}
_PLACES = ("*", "realisation*/*", "inputs/*", "inputs/realisation*/*")
_FORMAT = 2

Array: TypeAlias = NDArray[Any]
# First frame (an index) and realisation of the noise: each has a color of its own.
_Start: TypeAlias = tuple[int, int]


@dataclass(frozen=True)
class Shot:
    """Successive frames as a network sees them, with one or more realisations of their noise.

    Args:
        colors: for each realisation ``(T, 7, H, W)``: accumulated demodulated radiance, that of each frame alone, and
            the history length.
        features: ``(T, C, H, W)`` of ``albedo``, ``normal``, ``depth`` and ``reference``.
    """

    colors: tuple[Array, ...]
    features: Mapping[str, Array]

    def __len__(self) -> int:
        return len(self.colors[0])

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        height, width = self.colors[0].shape[-2:]
        return int(height), int(width)

    def until(self, length: int) -> Shot:
        """The first frames of the shot."""
        return self._cut(slice(0, length))

    def last(self, length: int) -> Shot:
        """The last frames of the shot, with the past that they have."""
        return self._cut(slice(len(self) - length, None))

    def read(
        self,
        frames: slice = slice(None),
        rows: slice = slice(None),
        columns: slice = slice(None),
        *,
        realisation: int = 0,
        channels: Iterable[int] = range(sum(PARTS.values())),
        turn: Callable[[Array], Array] = lambda channel: channel,
    ) -> Tensor:
        """Copy a part of the shot from disk: ``(T, 17, H, W)`` float32, stacked in the order of ``PARTS``.

        Args:
            frames: which frames.
            rows: which rows.
            columns: which columns.
            realisation: of the noise.
            channels: which of the 17, in which order.
            turn: gives another view of ``(T, H, W)``, flipped or turned.
        """
        sources = (self.colors[realisation], *(self.features[name] for name in _FEATURES))
        # Views only: everything is moved at once, when it is copied.
        every = [source[frames, i, rows, columns] for source in sources for i in range(source.shape[1])]
        chosen = [turn(every[i]) for i in channels]
        stack = np.empty((chosen[0].shape[0], len(chosen), *chosen[0].shape[1:]), np.float32)
        return torch.from_numpy(np.stack(chosen, 1, out=stack))

    def _cut(self, frames: slice) -> Shot:
        features = {name: feature[frames] for name, feature in self.features.items()}
        return Shot(tuple(color[frames] for color in self.colors), features)


@dataclass(frozen=True)
class CachedSequence:
    """A decoded sequence.

    Args:
        shots: one for each first frame.
        sha256: of every noisy color and reference that was decoded, as bytes of float32.
    """

    shots: list[Shot]
    sha256: str


@dataclass(frozen=True)
class _Plan:
    """What is to be computed from a sequence."""

    sequence: Sequence
    alpha_min: float
    firsts: tuple[int, ...]
    realisations: int
    keep_fireflies: int

    @property
    def settings(self) -> list[Any]:
        return [_FORMAT, self.sequence.numbers, self.alpha_min, self.firsts, self.realisations, self.keep_fireflies]

    @property
    def starts(self) -> list[_Start]:
        return [(first, realisation) for first in self.firsts for realisation in range(self.realisations)]

    def history(self, realisation: int) -> History:
        """A new one."""
        kept = self.keep_fireflies > 0 and (realisation + 1) % self.keep_fireflies == 0
        return History(Accumulate(self.alpha_min), ClampFireflies(CAUSTICS) if kept else None)

    def color_shape(self, first: int) -> tuple[int, ...]:
        return (len(self.sequence) - first, sum(PARTS[name] for name in _NOISY), *self.sequence.size)


def check_trainable(sequence: Sequence) -> None:
    """See that a sequence has what training needs, from what is known without reading pixels.

    Raises:
        InputError: a buffer or a reference is missing.
    """
    missing = sorted({"albedo", "normal", "depth"} - sequence.buffers)
    if missing:
        raise InputError(f"{sequence.root}: expected albedo, normal and depth to train on, found no {missing[0]}")
    without = sorted(set(sequence.numbers) - set(sequence.reference_numbers))
    if without:
        raise InputError(
            f"{sequence.root}: expected a reference for every frame to train on, found none for frame {without[0]}; "
            "render it or choose other frames"
        )


def open_cached(
    sequence: Sequence,
    folder: Path,
    *,
    alpha_min: float,
    firsts: list[int],
    realisations: int | None = None,
    keep_fireflies: int = 0,
) -> CachedSequence:
    """A sequence as a network sees it, from a cache that is filled where it has to be.

    The features are kept once, the accumulated color once for each first frame and realisation of the noise: a shot
    that starts later has shorter histories, so that a network also learns how a shot begins. Features are kept in half
    precision where nothing is lost by it, accumulated color in single.

    What was made of other files (by name, size or time of change), of other settings or by another version of the
    code is made again. A run that finds somebody else filling the same place waits.

    Args:
        sequence: frames with references, albedo, normal and depth, see :func:`check_trainable`.
        folder: of the cache; made if it does not exist.
        alpha_min: see :func:`mcdenoise.ops.accumulate`.
        firsts: indices of the first frames, ascending.
        realisations: use so many; all by default.
        keep_fireflies: every n-th realisation keeps its fireflies as if they were caustics; 0 for none.

    Raises:
        InputError: a buffer or a reference is missing or damaged, or the cache cannot be written; nothing half made is
            left.
    """
    check_trainable(sequence)
    found = sequence.realisations if realisations is None else min(realisations, sequence.realisations)
    plan = _Plan(sequence, alpha_min, tuple(firsts), found, keep_fireflies)
    # Not how many realisations were found: what was made of fewer is stale, and goes.
    identity = json.dumps(
        [str(sequence.root.resolve()), sequence.numbers, alpha_min, firsts, realisations, keep_fireflies]
    )
    place = folder / f"{sequence.name[:100]}-{hashlib.sha256(identity.encode()).hexdigest()[:16]}"
    finished = place / _key(plan)[:32]
    cached = _load(finished, plan)
    if cached is not None:
        return cached
    try:
        with _locked(place):
            # While this waited for the lock, somebody else may have done the work.
            if (cached := _load(finished, plan)) is None:
                _fill(finished, plan)
    except OSError as error:
        reason = error.strerror or str(error) or type(error).__name__
        raise InputError(
            f"{place}: the cache of decoded frames cannot be written ({reason}); check the folder, its permissions "
            "and free space"
        ) from error
    cached = cached or _load(finished, plan)
    if cached is None:
        raise InputError(f"{finished}: expected the decoded frames just written, found them damaged; check the disk")
    return cached


def _key(plan: _Plan) -> str:
    """Checksum of everything the arrays depend on."""
    digest = hashlib.sha256(json.dumps(plan.settings).encode() + _code())
    root = plan.sequence.root
    for path in sorted(path for place in _PLACES for path in root.glob(place)):
        # What begins with a dot is being written by a renderer, and gone in a moment.
        if path.suffix not in _SUFFIXES or path.name.startswith("."):
            continue
        status = path.stat()
        digest.update(f"{path.relative_to(root)}\0{status.st_size}\0{status.st_mtime_ns}\0".encode())
    return digest.hexdigest()


@functools.cache
def _code() -> bytes:
    """Checksum of the whole package: a mended reader or operator must not find what its predecessor made.

    Not of those files only that decode and accumulate: nobody would keep a list of them true.
    """
    package, digest = Path(__file__).parents[1], hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        content = source.read_bytes()
        digest.update(f"{source.relative_to(package).as_posix()}\0{len(content)}\0".encode() + content)
    return digest.digest()


@contextmanager
def _locked(place: Path) -> Iterator[None]:
    """Have a folder for oneself; the lock ends with the process, however that ends."""
    place.mkdir(parents=True, exist_ok=True)
    with (place / "lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _fill(finished: Path, plan: _Plan) -> None:
    """Write a folder of arrays beside its final name and rename it; remove what is stale or was left half made."""
    for entry in finished.parent.iterdir():
        if entry.is_dir():
            shutil.rmtree(entry)
    building = finished.parent / "building"
    building.mkdir()
    try:
        _build(building, plan)
        os.rename(building, finished)
    finally:
        shutil.rmtree(building, ignore_errors=True)


def _build(folder: Path, plan: _Plan) -> None:
    """Decode the frames one after the other; only features in the making are held in memory."""
    sequence = plan.sequence
    histories = {start: plan.history(start[1]) for start in plan.starts}
    features: dict[str, list[Array]] = {name: [] for name in _FEATURES}
    digest = hashlib.sha256()
    with ExitStack() as stack:
        files = {
            start: stack.enter_context(_array_file(folder / _color_name(start), plan.color_shape(start[0])))
            for start in plan.starts
        }
        for i, number in enumerate(sequence.numbers):
            for realisation in range(plan.realisations):
                frame = _read(sequence, number, realisation, digest)
                for first in plan.firsts:
                    if first <= i:
                        past = histories[first, realisation].update(frame)
                        noisy = torch.cat([getattr(past, name) for name in _NOISY], 1)
                        files[first, realisation].write(noisy.numpy().tobytes())
                if realisation == 0:
                    for name, values in features.items():
                        values.append(_smallest(getattr(frame, name).numpy()))
    for name in list(features):
        # One frame that half precision cannot hold makes all of them single.
        np.save(folder / f"{name}.npy", np.concatenate(features.pop(name)), allow_pickle=False)
    (folder / "about.json").write_text(json.dumps({"sha256": digest.hexdigest()}) + "\n")


def _read(sequence: Sequence, number: int, realisation: int, digest: Any) -> Frame:
    """Decode a frame, add what is noisy and what is learnt from to the checksum, and validate."""
    frame = sequence.frame(number, reference=realisation == 0, realisation=realisation)
    for image in (frame.color, frame.reference):
        if image is not None:
            digest.update(image.numpy().tobytes())
    try:
        return frame.validate()[0]
    except InputError as error:
        raise InputError(f"{sequence.root}, frame {number}: {error}") from error


@contextmanager
def _array_file(path: Path, shape: tuple[int, ...]) -> Iterator[BinaryIO]:
    """A ``.npy`` file of little-endian float32 whose values are yet to be written, in order.

    Written as a stream and not through a map: on a full disk the one fails, the other kills the process.
    """
    with path.open("wb") as file:
        header = {"descr": "<f4", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(file, header)
        yield file


def _smallest(values: Array) -> Array:
    """The values in half precision if it holds them exactly, else as they are."""
    with np.errstate(over="ignore"):
        half = values.astype(np.float16)
    return half if np.array_equal(half.astype(values.dtype), values) else values


def _color_name(start: _Start) -> str:
    first, realisation = start
    return f"color-{first}-{realisation}.npy"


def _load(folder: Path, plan: _Plan) -> CachedSequence | None:
    """Map the arrays; ``None`` where there are none, or not those of this sequence."""
    sequence = plan.sequence
    try:
        about = json.loads((folder / "about.json").read_text())
        features = {
            name: _map(folder / f"{name}.npy", (len(sequence), channels, *sequence.size))
            for name, channels in _FEATURES.items()
        }
        shots = [
            Shot(
                tuple(
                    _map(folder / _color_name((first, k)), plan.color_shape(first)) for k in range(plan.realisations)
                ),
                {name: feature[first:] for name, feature in features.items()},
            )
            for first in plan.firsts
        ]
        return CachedSequence(shots, str(about["sha256"]))
    except (OSError, EOFError, ValueError, KeyError, TypeError):
        return None


def _map(path: Path, shape: tuple[int, ...]) -> Array:
    # A plain view of the map: memmap's own slices cost more than what they read.
    array: Array = np.load(path, mmap_mode="r", allow_pickle=False).view(np.ndarray)
    if array.shape != shape or array.dtype not in (np.float16, np.float32):
        raise ValueError(f"{path}: expected {shape}, found {array.shape} {array.dtype}")
    return array
