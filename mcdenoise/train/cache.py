"""Decoded sequences on disk: what training reads again and again, decoded and accumulated once, opened in an instant.

What is kept is what a model sees behind its wrappers without weights, see :class:`mcdenoise.train.front.Front`.

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
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mcdenoise.data.sequences import Sequence
from mcdenoise.errors import InputError
from mcdenoise.frame import Frame, replace_invalid
from mcdenoise.models.accumulated import motion_to_previous
from mcdenoise.train.front import ACCUMULATED, Front

_CAMERA = frozenset({"position", "view_projection"})
# The files that a reader of sequences looks at, and where they are in a sequence's folder.
_SUFFIXES = {".exr", ".h", ".json"}
_PLACES = ("*", "realisation*/*", "inputs/*", "inputs/realisation*/*")
_FORMAT = 5

Array: TypeAlias = NDArray[Any]
# First frame (an index) and realisation of the noise: each has a color of its own.
_Start: TypeAlias = tuple[int, int]


@dataclass(frozen=True)
class Shot:
    """Successive frames as a network sees them, with one or more realisations of their noise.

    Args:
        colors: for each realisation ``(T, C, H, W)``: what it has of its own, as ``parts`` says.
        features: ``(T, C, H, W)`` of everything else, by the names of buffers; ``view_projection`` is ``(T, 4, 4)``.
        demodulated: whether the radiance in ``colors`` has no albedo in it.
        noisy: for each realisation the features that are of its own samples, in the same form; empty where there are
            none.
        parts: names of the buffers in ``colors`` with their channels, as many of the first as there are channels; by
            default accumulated radiance, that of each frame alone, and the history length.
    """

    colors: tuple[Array, ...]
    features: Mapping[str, Array]
    demodulated: bool = False
    noisy: tuple[Mapping[str, Array], ...] = ()
    parts: Mapping[str, int] = field(default_factory=lambda: ACCUMULATED)

    def __len__(self) -> int:
        return len(self.colors[0])

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        height, width = self.colors[0].shape[-2:]
        return int(height), int(width)

    def cut(self, frames: slice) -> Shot:
        """Some of the frames, with the history that they have."""
        features = {name: feature[frames] for name, feature in self.features.items()}
        noisy = tuple({name: feature[frames] for name, feature in own.items()} for own in self.noisy)
        return Shot(tuple(color[frames] for color in self.colors), features, self.demodulated, noisy, self.parts)

    def read(
        self,
        frames: slice = slice(None),
        rows: slice = slice(None),
        columns: slice = slice(None),
        *,
        realisation: int = 0,
        channels: Mapping[str, list[int]] = {},
        turn: Callable[[Array], Array] = lambda image: image,
    ) -> dict[str, Tensor]:
        """Copy a part of the shot from disk: ``(T, C, H, W)`` float32 by name.

        Args:
            frames: which frames.
            rows: which rows.
            columns: which columns.
            realisation: of the noise, and of the features that have noise.
            channels: of some buffers, which channels, in which order.
            turn: gives another view of ``(T, C, H, W)``, flipped or turned.
        """
        color = self.colors[realisation]
        sources: dict[str, Array] = {}
        start = 0
        for name, count in self.parts.items():
            if start < color.shape[1]:
                sources[name] = color[:, start : start + count]
            start += count
        parts = {}
        own = self.noisy[realisation] if self.noisy else {}
        for name, source in {**sources, **self.features, **own}.items():
            if source.ndim == 3:
                parts[name] = torch.from_numpy(source[frames].astype(np.float32))
                continue
            # Views only: everything is moved at once, when it is copied.
            image = turn(source[frames, :, rows, columns])
            order = channels.get(name, range(image.shape[1]))
            part = np.empty((image.shape[0], len(order), *image.shape[2:]), np.float32)
            parts[name] = torch.from_numpy(np.stack([image[:, i] for i in order], 1, out=part))
        return parts


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
    front: Front
    features: tuple[str, ...]
    firsts: tuple[int, ...]
    realisations: int
    keep_fireflies: int

    @property
    def own(self) -> tuple[str, ...]:
        """Features that each realisation has of its own."""
        noisy = self.sequence.noisy
        # Depth and motion may be those of the positions.
        derived = {"motion"} if "position" in noisy and "motion" not in self.sequence.buffers else set()
        return tuple(name for name in self.features if name in noisy | derived)

    @property
    def shared(self) -> tuple[str, ...]:
        """Features that all realisations have in common."""
        return tuple(name for name in self.features if name not in self.own)

    @property
    def starts(self) -> list[_Start]:
        return [(first, realisation) for first in self.firsts for realisation in range(self.realisations)]

    def begin(self, realisation: int) -> Callable[[Frame], Frame]:
        kept = self.keep_fireflies > 0 and (realisation + 1) % self.keep_fireflies == 0
        return self.front.begin(keep_fireflies=kept)

    def color_shape(self, first: int) -> tuple[int, ...]:
        return (len(self.sequence) - first, sum(self.front.parts.values()), *self.sequence.size)


def features_of(sequence: Sequence) -> frozenset[str]:
    """Names of the buffers without noise that can be had of a sequence: motion also of positions and cameras."""
    derived = {"motion"} if sequence.buffers >= _CAMERA else set()
    return (sequence.buffers | derived) - {"color", "reference"}


def open_cached(
    sequence: Sequence,
    folder: Path,
    *,
    front: Front,
    features: Iterable[str],
    firsts: list[int],
    realisations: int | None = None,
    keep_fireflies: int = 0,
) -> CachedSequence:
    """A sequence as a network sees it, from a cache that is filled where it has to be.

    The features are kept once (those with noise once for each realisation), the radiance once for each first frame and
    realisation of the noise: a shot that starts
    later has shorter histories, so that a network also learns how a shot begins. Features are kept in half precision
    where nothing is lost by it, radiance in single. Pixels of the radiance and of the reference that are none (NaN,
    infinite, negative, or absurdly large) get the mean of their neighbours. Motion is the sequence's own, or else
    computed of positions and cameras; infinite, that is unknown, in the first frame then.

    What was made of other files (by name, size or time of change), of other settings or by another version of the
    code is made again. A run that finds somebody else filling the same place waits.

    Args:
        sequence: frames with references.
        folder: of the cache; made if it does not exist.
        front: what is done to the frames.
        features: names of the buffers that are kept besides, of :func:`features_of`.
        firsts: indices of the first frames, ascending.
        realisations: use so many; all by default.
        keep_fireflies: every n-th realisation keeps its fireflies as if they were caustics; 0 for none.

    Raises:
        InputError: a buffer or a reference is missing or damaged, or the cache cannot be written; nothing half made is
            left.
    """
    found = sequence.realisations if realisations is None else min(realisations, sequence.realisations)
    kept = tuple(sorted({*features, "reference"}))
    plan = _Plan(sequence, front, kept, tuple(firsts), found, keep_fireflies)
    # Not how many realisations were found: what was made of fewer is stale, and goes.
    settings = [sequence.numbers, front.settings, kept, firsts, realisations, keep_fireflies]
    identity = json.dumps([str(sequence.root.resolve()), *settings])
    place = folder / f"{sequence.name[:100]}-{hashlib.sha256(identity.encode()).hexdigest()[:16]}"
    finished = place / _key(sequence.root, [_FORMAT, *settings, found])[:32]
    cached = _load(finished, plan)
    if cached is not None:
        return cached
    try:
        with locked(place):
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


def _key(root: Path, settings: list[Any]) -> str:
    """Checksum of everything the arrays depend on."""
    digest = hashlib.sha256(json.dumps(settings).encode() + _code())
    for path in sorted(path for place in _PLACES for path in root.glob(place)):
        # What begins with a dot is being written by a renderer, and gone in a moment.
        if path.suffix not in _SUFFIXES or path.name.startswith("."):
            continue
        # A link to nothing, or to itself, is no file of the sequence.
        with suppress(OSError):
            status = path.stat()
            digest.update(os.fsencode(path.relative_to(root)))
            digest.update(f"\0{status.st_size}\0{status.st_mtime_ns}\0".encode())
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
def locked(place: Path) -> Iterator[None]:
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
    steps = {start: plan.begin(start[1]) for start in plan.starts}
    features: dict[str, list[Array]] = {_feature_name(name): [] for name in plan.shared}
    features |= {_feature_name(name, k): [] for name in plan.own for k in range(plan.realisations)}
    camera: Tensor | None = None
    digest = hashlib.sha256()
    with ExitStack() as stack:
        files = {
            start: stack.enter_context(_array_file(folder / _color_name(start), plan.color_shape(start[0])))
            for start in plan.starts
        }
        wanted = {*plan.features, *plan.front.parts}
        for i, number in enumerate(sequence.numbers):
            for realisation in range(plan.realisations):
                frame = _read(sequence, number, realisation, wanted, digest)
                for first in plan.firsts:
                    if first <= i:
                        seen = dict(steps[first, realisation](frame).items())
                        noisy = torch.cat([seen[name] for name in plan.front.parts], 1)
                        files[first, realisation].write(noisy.numpy().tobytes())
                if realisation == 0 or plan.own:
                    found = dict((_with_motion(frame, camera) if "motion" in plan.features else frame).items())
                    for name in plan.shared if realisation == 0 else ():
                        features[_feature_name(name)].append(_smallest(found[name].numpy()))
                    for name in plan.own:
                        features[_feature_name(name, realisation)].append(_smallest(found[name].numpy()))
            camera = frame.view_projection
    for file in list(features):
        # One frame that half precision cannot hold makes all of them single.
        np.save(folder / file, np.concatenate(features.pop(file)), allow_pickle=False)
    checksums = {path.name: _checksum(path) for path in sorted(folder.iterdir())}
    (folder / "about.json").write_text(json.dumps({"sha256": digest.hexdigest(), "files": checksums}) + "\n")


def _read(sequence: Sequence, number: int, realisation: int, buffers: Collection[str], digest: Any) -> Frame:
    """Decode a frame, add what is noisy and what is learnt from to the checksum, and validate."""
    frame = sequence.frame(number, reference=realisation == 0, realisation=realisation, buffers=buffers)
    radiance = {"color": frame.color} | ({} if frame.reference is None else {"reference": frame.reference})
    for image in radiance.values():
        digest.update(image.numpy().tobytes())
    # What validation does to colour alone; a reference is rendered by the same program.
    mended = {name: replace_invalid(image)[0] for name, image in radiance.items()}
    try:
        return frame.replace(**mended).validate()[0].with_depth()
    except InputError as error:
        raise InputError(f"{sequence.root}, frame {number}: {error}") from error


def _with_motion(frame: Frame, camera: Tensor | None) -> Frame:
    """The frame with its motion, if need be that of its positions seen from the camera before."""
    motion = motion_to_previous(frame, camera)
    return frame.replace(motion=torch.full_like(frame.color[:, :2], torch.inf) if motion is None else motion)


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


def _feature_name(name: str, realisation: int | None = None) -> str:
    return f"{name}.npy" if realisation is None else f"{name}-{realisation}.npy"


def _checksum(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _load(folder: Path, plan: _Plan) -> CachedSequence | None:
    """Map the arrays; ``None`` where there are none, or not those of this sequence, or a bit of them has changed."""
    sequence = plan.sequence
    try:
        about = json.loads((folder / "about.json").read_text())
        if any(_checksum(folder / name) != checksum for name, checksum in about["files"].items()):
            return None
        features = _map_features(folder, plan.shared, None, sequence)
        noisy = [_map_features(folder, plan.own, k, sequence) for k in range(plan.realisations)] if plan.own else []
        shots = []
        for first in plan.firsts:
            colors = [_map(folder / _color_name((first, k))) for k in range(plan.realisations)]
            for color in colors:
                _check(f"color of {first}", color, plan.color_shape(first))
            later = {name: feature[first:] for name, feature in features.items()}
            own = tuple({name: feature[first:] for name, feature in each.items()} for each in noisy)
            shots.append(Shot(tuple(colors), later, plan.front.demodulates, own, plan.front.parts))
        return CachedSequence(shots, str(about["sha256"]))
    except (OSError, EOFError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _map_features(
    folder: Path, names: tuple[str, ...], realisation: int | None, sequence: Sequence
) -> dict[str, Array]:
    features = {name: _map(folder / _feature_name(name, realisation)) for name in names}
    for name, feature in features.items():
        _check(name, feature, (len(sequence), *feature.shape[1:-2], *_size(name, sequence)))
    return features


def _size(name: str, sequence: Sequence) -> tuple[int, int]:
    return (4, 4) if name == "view_projection" else sequence.size


def _map(path: Path) -> Array:
    # A plain view of the map: memmap's own slices cost more than what they read.
    array: Array = np.load(path, mmap_mode="r", allow_pickle=False).view(np.ndarray)
    return array


def _check(name: str, array: Array, shape: tuple[int, ...]) -> None:
    if array.shape != shape or array.dtype not in (np.float16, np.float32):
        raise ValueError(f"{name}: expected {shape}, found {array.shape} {array.dtype}")
