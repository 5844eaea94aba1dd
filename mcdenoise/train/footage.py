"""Frames to train on, of sequences and of packed takes, as shots of what the network behind the front is handed."""

from __future__ import annotations

import functools
import hashlib
import warnings
from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch

from mcdenoise.data import Sequence
from mcdenoise.data.shards import ERROR, Shard
from mcdenoise.errors import InputError, level_of_caller, naming
from mcdenoise.frame import Frame
from mcdenoise.light import replace_invalid
from mcdenoise.models._history import motion_to_previous
from mcdenoise.models._void import without_void
from mcdenoise.train.cache import Keep, open_cache
from mcdenoise.train.front import Front
from mcdenoise.train.shots import Array, Shot

Source: TypeAlias = Sequence | Shard

# Networks that use these buffers would learn to work without them if they were missing, which is rarely intended.
FEATURES = ("albedo", "normal", "depth")
# Name of the reference while void pixels are filled: one of this name would be left as it is.
_TRUTH = "(reference)"
# Radiance without its albedo may exceed half floats.
_LARGEST = 65504.0


def features_of(source: Source) -> frozenset[str]:
    """Names of the buffers besides color and reference, including motion from positions and cameras."""
    names = source.shapes.keys() if isinstance(source, Shard) else source.buffers | _computed(source)
    return frozenset(names) - {"color", "reference", ERROR}


def place_of(source: Source) -> Path:
    """The file of a take, or the folder of a sequence."""
    return source.path if isinstance(source, Shard) else source.root


def references_of(source: Source) -> int:
    """Number of the last frames that have a reference: all of a sequence, see :func:`check_trainable`."""
    return source.references if isinstance(source, Shard) else len(source)


def check_trainable(source: Source, wanted: frozenset[str]) -> None:
    """Check that headers show everything that training needs.

    Args:
        source: a sequence or a packed take.
        wanted: names of the features that the model needs.

    Raises:
        InputError: a feature is missing, or a frame or a reference of a sequence.
    """
    where = place_of(source)
    if missing := sorted(wanted - features_of(source)):
        names = ", ".join([*(name for name in FEATURES if name in wanted), *sorted(wanted - set(FEATURES))])
        raise InputError(f"{where}: expected {names} to train this model on, found no {missing[0]}")
    if isinstance(source, Shard):
        return
    for one, following in pairwise(source.numbers):
        if following != one + 1:
            raise InputError(
                f"{where}: expected frame {one + 1} after frame {one}, found {following}; a clip to train on has no "
                "gaps: render it, or keep the frames of each run in a folder of their own"
            )
    if without := sorted(set(source.numbers) - set(source.reference_numbers)):
        raise InputError(
            f"{where}: expected a reference for every frame to train on, found none for frame {without[0]}; render it, "
            "or train on other sequences"
        )


def shots_of(
    source: Source,
    front: Front,
    features: frozenset[str],
    frames: int,
    cache: Path,
    *,
    start_every: int = 0,
    held: int = 0,
    noise_seeds: int | None = None,
) -> tuple[list[Shot], str]:
    """Shots to cut clips from: the first one has all frames in its history.

    For a front with a history, others begin later, so that a network also learns the beginning of a shot: at every n-th
    frame. Where only the last frames have references, clips end with them: then only the frames of such a clip are
    kept, and there is one other shot.

    A sequence is decoded and processed at once if it is not in the cache. A take is read and processed when the first
    clip is drawn from it, and is then kept in memory as half floats. Void pixels (of alpha 0) are filled, in references
    too. A warning tells of frames that repeat the noise of the frame before, which a history would count again.

    Args:
        source: a sequence or a packed take, see :func:`check_trainable`.
        front: the wrappers that process the frames.
        features: names of the features to return.
        frames: number of frames of a clip.
        cache: folder of the cache; created if it does not exist.
        start_every: n; by default there is only the first shot.
        held: number of the last frames that no clip has: a later shot has room for a clip before them.
        noise_seeds: number of noise seeds to use; all by default.

    Returns:
        The shots, and a checksum of the frames; that of a sequence is of its noisy colors and references, decoded.

    Raises:
        InputError: a file is damaged, or the cache cannot be written.
    """
    length, references, first = len(source), references_of(source), 0
    wanted = frozenset({*front.parts, *features, "reference"})
    every = start_every if front.accumulates and start_every else length
    later = [start for start in range(every, length, every) if length - held - start >= frames]
    read: Callable[[int], Mapping[str, Array]]
    keep: Keep = _as_halves
    if isinstance(source, Shard):
        seeds, digest = 1, source.digest
        if front.accumulates and references < length:
            first = max(length - frames, 0)
            later = later and [later[int(digest, 16) % len(later)]]
        read = functools.partial(_packed, source)
    else:
        seeds = min(noise_seeds or source.noise_seeds, source.noise_seeds)
        keep = open_cache(source, [front.settings, sorted(wanted), noise_seeds], cache)
        arrays = keep("frames", functools.partial(_decoded, source, wanted, seeds, keep_all=bool(front.wrappers)))
        read, digest = functools.partial(_of_seed, arrays), arrays["sha256"].tobytes().hex()

    def handed(start: int, noise_seed: int) -> dict[str, Array]:
        buffers = _filled(read(noise_seed))
        if repeated := 0 if start else _repeated(buffers["color"]):
            warnings.warn(
                f"{place_of(source)}: {repeated} of {length} frames have the noise of the frame before, pixel by "
                "pixel, which a history counts again; render each frame with its own seed",
                stacklevel=level_of_caller(),
            )
        kept = {name: array[max(start, first) - length :] for name, array in buffers.items() if name in wanted}
        if not front.wrappers:
            return kept
        seen = {name: array for name, array in buffers.items() if name not in _computed(source)}
        process = functools.partial(_processed, seen, front, start, max(start, first))
        return kept | keep(f"from{start}-{noise_seed}", process)

    shots = []
    for start in (0, *later):
        buffers = tuple(functools.cache(functools.partial(handed, start, noise_seed)) for noise_seed in range(seeds))
        kept = length - max(start, first)
        shots.append(Shot(buffers, range(kept), source.size, max(kept - references, 0), front.demodulates))
        if isinstance(source, Sequence):
            for each in buffers:
                each()
    return shots, digest


def frame_of(arrays: Mapping[str, Array], t: int) -> Frame:
    """Frame ``t`` of the arrays of a take, without its reference."""
    images: dict[str, Any] = {
        name: _image(array, t) for name, array in arrays.items() if name not in ("reference", ERROR)
    }
    return Frame(**images).validate()[0]


def _image(array: Array, t: int) -> torch.Tensor:
    return torch.from_numpy(array[t : t + 1].astype(np.float32))


def _processed(arrays: Mapping[str, Array], front: Front, start: int, first: int) -> dict[str, Array]:
    """The frames from ``first`` on, as the front processes them with a history that begins at ``start``."""
    step, made = front.begin(), {name: list[Array]() for name in front.parts}
    for t in range(start, len(arrays["color"])):
        seen = step(frame_of(arrays, t))
        for name, images in made.items() if t >= first else ():
            # There is no recent history where no lag is looked for.
            if (image := seen.buffer(name)) is not None:
                images.append(image.numpy())
    return {name: np.concatenate(images) for name, images in made.items() if images}


def _repeated(color: Array) -> int:
    """How many frames are lit, and equal to the frame before in every eighth row."""
    return sum(bool(now.any() and np.array_equal(now, before)) for before, now in pairwise(color[:, :, ::8]))


def _packed(shard: Shard, noise_seed: int) -> dict[str, Array]:
    arrays = shard.read()
    # A reference comes from the same renderer as the color.
    with naming(str(shard.path)):
        mended = {name: replace_invalid(torch.from_numpy(arrays[name]))[0].numpy() for name in ("color", "reference")}
    return arrays | mended


def _filled(buffers: Mapping[str, Array]) -> dict[str, Array]:
    """The buffers with void pixels filled, as a denoiser fills them, the references alike.

    So a network learns from the mirror images, too, and not that black ends at a rim.
    """
    arrays, lacking = dict(buffers), len(buffers["color"]) - len(buffers["reference"])
    for t in range(len(buffers["color"])) if buffers.keys() & {"alpha", "mask"} else ():
        images = {} if t < lacking else {_TRUTH: _image(buffers["reference"], t - lacking)}
        frame, void = without_void(frame_of(buffers, t).replace(extra=images))
        for name, image in frame.items() if void.mask is not None else ():
            own, place = ("reference", t - lacking) if name == _TRUTH else (name, t)
            if own in buffers:
                # Those of a cache are only to be read.
                arrays[own] = arrays[own] if arrays[own] is not buffers[own] else np.array(buffers[own])
                arrays[own][place] = image[0]
    return arrays


def _as_halves(name: str, make: Callable[[], Mapping[str, Array]]) -> dict[str, Array]:
    return {each: np.minimum(array, _LARGEST).astype(np.float16) for each, array in make().items()}


def _computed(source: Source) -> set[str]:
    """Names of the features that are not in the files: the front is not handed them."""
    if isinstance(source, Shard) or not source.buffers >= {"position", "view_projection"}:
        return set()
    return {"motion"} - source.buffers


def _decoded(sequence: Sequence, wanted: frozenset[str], noise_seeds: int, *, keep_all: bool) -> dict[str, Array]:
    """The wanted buffers of the sequence, or all of them: those without noise once, in half precision if that is exact.

    Invalid pixels of radiance and reference (NaN, infinite, negative, or too large) are replaced, as ``Frame.validate``
    does it. Motion is the sequence's own, or computed from positions and cameras; then it is infinite (unknown) in the
    first frame.
    """
    digest, camera, found = hashlib.sha256(), None, dict[str, list[Array]]()
    computed = wanted & _computed(sequence)
    noisy = sequence.noisy | (computed if "position" in sequence.noisy else set())
    for number in sequence.numbers:
        for noise_seed in range(noise_seeds):
            frame = sequence.frame(number, reference=noise_seed == 0, noise_seed=noise_seed, buffers=wanted)
            radiance = {name: image for name, image in frame.items() if name in ("color", "reference")}
            for image in radiance.values():
                digest.update(image.numpy().tobytes())
            # ``validate`` replaces invalid pixels only in the color; a reference comes from the same renderer.
            with naming(f"{sequence.root}, frame {number}"):
                mended = {name: replace_invalid(image)[0] for name, image in radiance.items()}
                frame = frame.replace(**mended).validate()[0].with_depth()
            if computed:
                motion = motion_to_previous(frame, camera)
                unknown = torch.full_like(frame.color[:, :2], torch.inf)
                frame = frame.replace(motion=unknown if motion is None else motion)
            for name, image in frame.items():
                if (keep_all or name in wanted) and (noise_seed == 0 or name in noisy):
                    found.setdefault(f"{name}-{noise_seed}", []).append(_smallest(image.numpy()))
        camera = frame.view_projection
    # A buffer that some frames lack is of no use.
    arrays = {name: np.concatenate(own) for name, own in found.items() if len(own) == len(sequence)}
    return arrays | {"sha256": np.frombuffer(digest.digest(), np.uint8)}


def _of_seed(arrays: Mapping[str, Array], noise_seed: int) -> dict[str, Array]:
    """The buffers of a noise seed; those without noise are of the first one."""
    keys = [key.rpartition("-") for key in arrays if key.endswith(("-0", f"-{noise_seed}"))]
    return {name: arrays[f"{name}-{k}"] for name, _, k in sorted(keys, key=lambda key: int(key[2]))}


def _smallest(values: Array) -> Array:
    """Convert to half precision if that is exact."""
    with np.errstate(over="ignore"):
        half = values.astype(np.float16)
    return half if np.array_equal(half.astype(values.dtype), values) else values
