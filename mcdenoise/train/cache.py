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
import itertools
import json
import os
import shutil
from collections.abc import Collection, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from mcdenoise.data import Sequence
from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.light import replace_invalid
from mcdenoise.models._motion import motion_to_previous
from mcdenoise.train.front import Front
from mcdenoise.train.shots import Array, Shot

_CAMERA = frozenset({"position", "view_projection"})
# Patterns of the files of a sequence, relative to its folder.
_SUFFIXES = {".exr", ".h", ".json"}
_PLACES = ("*", "noise_seed*/*", "inputs/*", "inputs/noise_seed*/*")

# Index of the first frame, and noise seed: each pair has its own colors.
_Start: TypeAlias = tuple[int, int]


@dataclass(frozen=True)
class CachedSequence:
    """A decoded sequence.

    Args:
        shots: one for each first frame.
        sha256: checksum of all decoded noisy colors and references, as bytes of float32.
    """

    shots: list[Shot]
    sha256: str


@dataclass(frozen=True)
class _Plan:
    """The arrays to compute from a sequence."""

    sequence: Sequence
    front: Front
    features: tuple[str, ...]
    firsts: tuple[int, ...]
    noise_seeds: int

    @property
    def own(self) -> frozenset[str]:
        """Features that depend on the noise seed."""
        noisy = self.sequence.noisy
        # Depth and motion may be computed from the positions.
        derived = {"motion"} if "position" in noisy and "motion" not in self.sequence.buffers else set()
        return (noisy | derived) & set(self.features)

    @property
    def stored(self) -> list[tuple[str, int]]:
        """Each feature with the noise seeds that it is stored for; the first, if it is the same for all."""
        return [(name, k) for name in self.features for k in range(self.noise_seeds if name in self.own else 1)]

    @property
    def starts(self) -> list[_Start]:
        return [(first, noise_seed) for first in self.firsts for noise_seed in range(self.noise_seeds)]


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

    Raises:
        InputError: a buffer or a reference is missing or damaged, or the cache cannot be written; then no incomplete
            files are left.
    """
    found = sequence.noise_seeds if noise_seeds is None else min(noise_seeds, sequence.noise_seeds)
    kept = tuple(sorted({*features, "reference"}))
    plan = _Plan(sequence, front, kept, tuple(firsts), found)
    # The id does not include the number of noise seeds found, so that arrays of fewer seeds are found stale and
    # removed.
    settings = [sequence.numbers, front.settings, kept, firsts, noise_seeds]
    identity = json.dumps([str(sequence.root.resolve()), *settings])
    place = folder / f"{sequence.name[:100]}-{hashlib.sha256(identity.encode()).hexdigest()[:16]}"
    finished = place / _key(sequence.root, [*settings, found])[:32]
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
    sequence, digest = plan.sequence, hashlib.sha256()
    steps = {start: plan.front.begin() for start in plan.starts}
    features: dict[tuple[str, int], list[Array]] = {each: [] for each in plan.stored}
    channels = sum(plan.front.parts.values())
    camera: Tensor | None = None
    with ExitStack() as stack:
        files = {}
        for start in plan.starts:
            # A stream instead of a memory map, because writing to a map kills the process when the disk is full.
            files[start] = stack.enter_context((folder / _file("color", *start)).open("wb"))
            shape = len(sequence) - start[0], channels, *sequence.size
            header = {"descr": "<f4", "fortran_order": False, "shape": shape}
            np.lib.format.write_array_header_1_0(files[start], header)
        wanted = {*plan.features, *plan.front.parts}
        for i, number in enumerate(sequence.numbers):
            for noise_seed in range(plan.noise_seeds):
                frame = _read(sequence, number, noise_seed, wanted, digest)
                for start, step in steps.items():
                    if start[0] <= i and start[1] == noise_seed:
                        seen = dict(step(frame).items())
                        files[start].write(torch.cat([seen[name] for name in plan.front.parts], 1).numpy().tobytes())
                if noise_seed == 0 or plan.own:
                    found = dict((_with_motion(frame, camera) if "motion" in plan.features else frame).items())
                    for name, own in features:
                        if own == noise_seed:
                            features[name, own].append(_smallest(found[name].numpy()))
            camera = frame.view_projection
    for each in list(features):
        # If half precision is not exact for one frame, all frames are stored in single precision.
        np.save(folder / _file(*each), np.concatenate(features.pop(each)), allow_pickle=False)
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


def _smallest(values: Array) -> Array:
    """Convert to half precision if that is exact."""
    with np.errstate(over="ignore"):
        half = values.astype(np.float16)
    return half if np.array_equal(half.astype(values.dtype), values) else values


def _file(name: str, *numbers: int) -> str:
    return f"{'-'.join([name, *map(str, numbers)])}.npy"


def _checksum(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _load(folder: Path, plan: _Plan) -> CachedSequence | None:
    """Map the arrays; return ``None`` if they are missing or damaged, as their checksums tell."""
    try:
        about = json.loads((folder / "about.json").read_text())
        if any(_checksum(folder / name) != checksum for name, checksum in about["files"].items()):
            return None
        features = {each: _map(folder / _file(*each)) for each in plan.stored}
        ends = list(itertools.accumulate(plan.front.parts.values()))[:-1]
        shots = []
        for first in plan.firsts:
            arrays = []
            for k in range(plan.noise_seeds):
                noisy = np.split(_map(folder / _file("color", first, k)), ends, 1)
                own = {name: features[name, k if name in plan.own else 0][first:] for name in plan.features}
                arrays.append(dict(zip(plan.front.parts, noisy, strict=True)) | own)
            shots.append(Shot.of(*arrays, demodulated=plan.front.demodulates))
        return CachedSequence(shots, str(about["sha256"]))
    except (OSError, EOFError, ValueError, KeyError, TypeError, AttributeError):
        return None


def _map(path: Path) -> Array:
    # A plain view, because slicing a memmap takes longer than reading.
    array: Array = np.load(path, mmap_mode="r", allow_pickle=False).view(np.ndarray)
    return array
