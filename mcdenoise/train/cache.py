"""The training cache: decoded and accumulated sequences on disk, for fast reading in every epoch.

The cached frames are the output of a model's outer wrappers without weights, see :class:`mcdenoise.train.front.Front`.

A cached sequence is a folder ``NAME-ID/KEY`` of ``.npy`` files, one array each, which are memory-mapped. The id
identifies the sequence and the settings, the key everything that the arrays were computed from. If the key differs, the
arrays are computed again.
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
from torch import Tensor

from mcdenoise.data import Sequence
from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.light import replace_invalid
from mcdenoise.models._motion import motion_to_previous
from mcdenoise.train.front import ACCUMULATED, Front
from mcdenoise.train.shots import Array, Shot

_CAMERA = frozenset({"position", "view_projection"})
# Patterns of the files of a sequence, relative to its folder.
_SUFFIXES = {".exr", ".h", ".json"}
_PLACES = ("*", "noise_seed*/*", "inputs/*", "inputs/noise_seed*/*")
_FORMAT = 5

# Index of the first frame, and noise seed: each pair has its own colors.
_Start: TypeAlias = tuple[int, int]


@dataclass(frozen=True)
class CachedShot(Shot):
    """Consecutive frames as the network's input, for one or more noise seeds.

    Args:
        colors: for each noise seed ``(T, C, H, W)``: its channels, as ``parts`` describes them.
        features: ``(T, C, H, W)`` all other buffers by name; ``view_projection`` is ``(T, 4, 4)``.
        demodulated: whether the radiance in ``colors`` is demodulated.
        noisy: for each noise seed the features that depend on it, in the same form; empty if there are none.
        parts: names and channels of the buffers in ``colors``; these may hold only the first of them. By default
            accumulated radiance, radiance of the current frame, and history length.
    """

    colors: tuple[Array, ...]
    features: Mapping[str, Array]
    demodulated: bool = False
    noisy: tuple[Mapping[str, Array], ...] = ()
    parts: Mapping[str, int] = field(default_factory=lambda: ACCUMULATED)

    def __len__(self) -> int:
        return len(self.colors[0])

    @property
    def noise_seeds(self) -> int:
        """Number of noisy colors of a frame."""
        return len(self.colors)

    @property
    def references(self) -> int:
        """Number of the last frames that have a reference: all."""
        return len(self)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        height, width = self.colors[0].shape[-2:]
        return int(height), int(width)

    def cut(self, frames: slice) -> CachedShot:
        """Select consecutive frames; their history is kept."""
        features = {name: feature[frames] for name, feature in self.features.items()}
        noisy = tuple({name: feature[frames] for name, feature in own.items()} for own in self.noisy)
        return CachedShot(tuple(color[frames] for color in self.colors), features, self.demodulated, noisy, self.parts)

    def views(self, frames: slice, rows: slice, columns: slice, noise_seed: int) -> dict[str, Array]:
        """See :meth:`mcdenoise.train.shots.Shot.views`."""
        color, found, start = self.colors[noise_seed], dict[str, Array](), 0
        for name, count in self.parts.items():
            if start < color.shape[1]:
                found[name] = color[:, start : start + count]
            start += count
        found |= {**self.features, **(self.noisy[noise_seed] if self.noisy else {})}
        return {
            name: array[frames] if array.ndim == 3 else array[frames, :, rows, columns] for name, array in found.items()
        }


@dataclass(frozen=True)
class CachedSequence:
    """A decoded sequence.

    Args:
        shots: one for each first frame.
        sha256: checksum of all decoded noisy colors and references, as bytes of float32.
    """

    shots: list[CachedShot]
    sha256: str


@dataclass(frozen=True)
class _Plan:
    """The arrays to compute from a sequence."""

    sequence: Sequence
    front: Front
    features: tuple[str, ...]
    firsts: tuple[int, ...]
    noise_seeds: int
    keep_fireflies: int

    @property
    def own(self) -> tuple[str, ...]:
        """Features that depend on the noise seed."""
        noisy = self.sequence.noisy
        # Depth and motion may be computed from the positions.
        derived = {"motion"} if "position" in noisy and "motion" not in self.sequence.buffers else set()
        return tuple(name for name in self.features if name in noisy | derived)

    @property
    def shared(self) -> tuple[str, ...]:
        """Features that are the same for all noise seeds."""
        return tuple(name for name in self.features if name not in self.own)

    @property
    def starts(self) -> list[_Start]:
        return [(first, noise_seed) for first in self.firsts for noise_seed in range(self.noise_seeds)]

    def begin(self, noise_seed: int) -> Callable[[Frame], Frame]:
        kept = self.keep_fireflies > 0 and (noise_seed + 1) % self.keep_fireflies == 0
        return self.front.begin(keep_fireflies=kept)

    def color_shape(self, first: int) -> tuple[int, ...]:
        return (len(self.sequence) - first, sum(self.front.parts.values()), *self.sequence.size)


def features_of(sequence: Sequence) -> frozenset[str]:
    """Names of the buffers without noise that a sequence provides, including motion from positions and cameras."""
    derived = {"motion"} if sequence.buffers >= _CAMERA else set()
    return (sequence.buffers | derived) - {"color", "reference"}


def open_cached(
    sequence: Sequence,
    folder: Path,
    *,
    front: Front,
    features: Iterable[str],
    firsts: list[int],
    noise_seeds: int | None = None,
    keep_fireflies: int = 0,
) -> CachedSequence:
    """Open a sequence as the network's input from a cache, and fill the cache if necessary.

    Features are stored once (those with noise once for each noise seed). Radiance is stored once for each first frame
    and noise seed: a shot that begins later has shorter histories, so that a network also learns the beginning of a
    shot. Features are stored in half precision if that is exact, radiance in single precision. Invalid pixels of
    radiance and reference (NaN, infinite, negative, or too large) are replaced, as ``Frame.validate`` does it. Motion
    is the sequence's own, or computed from positions and cameras; then it is infinite (unknown) in the first frame.

    Arrays that were computed from other files (by name, size or modification time), with other settings or by another
    version of the code are computed again. If another run is filling the same place, this one waits.

    Args:
        sequence: frames with references.
        folder: folder of the cache; created if it does not exist.
        front: the wrappers that process the frames.
        features: names of further buffers to store, see :func:`features_of`.
        firsts: indices of the first frames, ascending.
        noise_seeds: number of noise seeds to use; all by default.
        keep_fireflies: every n-th noise seed keeps its fireflies as if they were caustics; 0 for none.

    Raises:
        InputError: a buffer or a reference is missing or damaged, or the cache cannot be written; then no incomplete
            files are left.
    """
    found = sequence.noise_seeds if noise_seeds is None else min(noise_seeds, sequence.noise_seeds)
    kept = tuple(sorted({*features, "reference"}))
    plan = _Plan(sequence, front, kept, tuple(firsts), found, keep_fireflies)
    # The id does not include the number of noise seeds found, so that arrays of fewer seeds are found stale and
    # removed.
    settings = [sequence.numbers, front.settings, kept, firsts, noise_seeds, keep_fireflies]
    identity = json.dumps([str(sequence.root.resolve()), *settings])
    place = folder / f"{sequence.name[:100]}-{hashlib.sha256(identity.encode()).hexdigest()[:16]}"
    finished = place / _key(sequence.root, [_FORMAT, *settings, found])[:32]
    if (cached := _load(finished, plan)) is not None:
        return cached
    try:
        with locked(place):
            # Another process may have done the work while this one waited for the lock.
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
    """Checksum of everything that the arrays depend on."""
    digest = hashlib.sha256(json.dumps(settings).encode() + _code())
    for path in sorted(path for place in _PLACES for path in root.glob(place)):
        # Hidden files are temporary files of a renderer.
        if path.suffix not in _SUFFIXES or path.name.startswith("."):
            continue
        # Broken and circular links are not files of the sequence.
        with suppress(OSError):
            status = path.stat()
            digest.update(os.fsencode(path.relative_to(root)))
            digest.update(f"\0{status.st_size}\0{status.st_mtime_ns}\0".encode())
    return digest.hexdigest()


@functools.cache
def _code() -> bytes:
    """Checksum of the whole package, so that a corrected reader or operator does not use arrays of its predecessor.

    It covers all files rather than those for decoding and accumulating, because such a list would become outdated.
    """
    package, digest = Path(__file__).parents[1], hashlib.sha256()
    for source in sorted(package.rglob("*.py")):
        content = source.read_bytes()
        digest.update(f"{source.relative_to(package).as_posix()}\0{len(content)}\0".encode() + content)
    return digest.digest()


@contextmanager
def locked(place: Path) -> Iterator[None]:
    """Lock a folder for this process; the lock is released when the process ends in any way."""
    place.mkdir(parents=True, exist_ok=True)
    with (place / "lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _fill(finished: Path, plan: _Plan) -> None:
    """Write the arrays to a temporary folder, rename it, and remove stale and incomplete folders."""
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
    """Decode the frames one after the other; only features without noise are collected in memory."""
    sequence = plan.sequence
    steps = {start: plan.begin(start[1]) for start in plan.starts}
    features: dict[str, list[Array]] = {_feature_name(name): [] for name in plan.shared}
    features |= {_feature_name(name, k): [] for name in plan.own for k in range(plan.noise_seeds)}
    camera: Tensor | None = None
    digest = hashlib.sha256()
    with ExitStack() as stack:
        files = {
            start: stack.enter_context(_array_file(folder / _color_name(start), plan.color_shape(start[0])))
            for start in plan.starts
        }
        wanted = {*plan.features, *plan.front.parts}
        for i, number in enumerate(sequence.numbers):
            for noise_seed in range(plan.noise_seeds):
                frame = _read(sequence, number, noise_seed, wanted, digest)
                for first in plan.firsts:
                    if first <= i:
                        seen = dict(steps[first, noise_seed](frame).items())
                        noisy = torch.cat([seen[name] for name in plan.front.parts], 1)
                        files[first, noise_seed].write(noisy.numpy().tobytes())
                if noise_seed == 0 or plan.own:
                    found = dict((_with_motion(frame, camera) if "motion" in plan.features else frame).items())
                    for name in plan.shared if noise_seed == 0 else ():
                        features[_feature_name(name)].append(_smallest(found[name].numpy()))
                    for name in plan.own:
                        features[_feature_name(name, noise_seed)].append(_smallest(found[name].numpy()))
            camera = frame.view_projection
    for file in list(features):
        # If half precision is not exact for one frame, all frames are stored in single precision.
        np.save(folder / file, np.concatenate(features.pop(file)), allow_pickle=False)
    checksums = {path.name: _checksum(path) for path in sorted(folder.iterdir())}
    (folder / "about.json").write_text(json.dumps({"sha256": digest.hexdigest(), "files": checksums}) + "\n")


def _read(sequence: Sequence, number: int, noise_seed: int, buffers: Collection[str], digest: Any) -> Frame:
    """Decode a frame, add noisy color and reference to the checksum, and validate it."""
    frame = sequence.frame(number, reference=noise_seed == 0, noise_seed=noise_seed, buffers=buffers)
    radiance = {"color": frame.color} | ({} if frame.reference is None else {"reference": frame.reference})
    for image in radiance.values():
        digest.update(image.numpy().tobytes())
    # ``validate`` replaces invalid pixels only in the color; a reference comes from the same renderer.
    try:
        mended = {name: replace_invalid(image)[0] for name, image in radiance.items()}
        return frame.replace(**mended).validate()[0].with_depth()
    except InputError as error:
        raise InputError(f"{sequence.root}, frame {number}: {error}") from error


def _with_motion(frame: Frame, camera: Tensor | None) -> Frame:
    """The frame with motion, computed from positions and the previous camera if necessary."""
    motion = motion_to_previous(frame, camera)
    return frame.replace(motion=torch.full_like(frame.color[:, :2], torch.inf) if motion is None else motion)


@contextmanager
def _array_file(path: Path, shape: tuple[int, ...]) -> Iterator[BinaryIO]:
    """Write the header of a ``.npy`` file of little-endian float32; the values are to be appended in order.

    A stream is used instead of a memory map because writing to a map kills the process when the disk is full.
    """
    with path.open("wb") as file:
        header = {"descr": "<f4", "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_1_0(file, header)
        yield file


def _smallest(values: Array) -> Array:
    """Convert to half precision if that is exact."""
    with np.errstate(over="ignore"):
        half = values.astype(np.float16)
    return half if np.array_equal(half.astype(values.dtype), values) else values


def _color_name(start: _Start) -> str:
    first, noise_seed = start
    return f"color-{first}-{noise_seed}.npy"


def _feature_name(name: str, noise_seed: int | None = None) -> str:
    return f"{name}.npy" if noise_seed is None else f"{name}-{noise_seed}.npy"


def _checksum(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _load(folder: Path, plan: _Plan) -> CachedSequence | None:
    """Map the arrays; return ``None`` if they are missing or damaged, as their checksums tell."""
    try:
        about = json.loads((folder / "about.json").read_text())
        if any(_checksum(folder / name) != checksum for name, checksum in about["files"].items()):
            return None
        features = {name: _map(folder / _feature_name(name)) for name in plan.shared}
        noisy = [
            {name: _map(folder / _feature_name(name, k)) for name in plan.own}
            for k in range(plan.noise_seeds if plan.own else 0)
        ]
        shots = []
        for first in plan.firsts:
            colors = [_map(folder / _color_name((first, k))) for k in range(plan.noise_seeds)]
            later = {name: feature[first:] for name, feature in features.items()}
            own = tuple({name: feature[first:] for name, feature in each.items()} for each in noisy)
            shots.append(CachedShot(tuple(colors), later, plan.front.demodulates, own, plan.front.parts))
        return CachedSequence(shots, str(about["sha256"]))
    except (OSError, EOFError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _map(path: Path) -> Array:
    # A plain view, because slicing a memmap takes longer than reading.
    array: Array = np.load(path, mmap_mode="r", allow_pickle=False).view(np.ndarray)
    return array
