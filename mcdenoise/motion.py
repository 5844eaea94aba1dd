"""Whether motion and cameras lead to what was there in the frame before, and by which convention.

All arrays are ``(H, W, C)``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from mcdenoise.frame import Frame

Image: TypeAlias = NDArray[np.float32]
Mask: TypeAlias = NDArray[np.bool_]
Array: TypeAlias = NDArray[np.float64]

_LARGEST_MOTION = 1e5
# Pixels that move less do not determine the sign; a smaller number of pixels is not sufficient.
_MOVES, _LEAST_MOVING = 0.5, 64
# Another sign is chosen only if it matches this much better than the usual one of the format.
_BETTER = 0.85
# Largest error relative to the motion of points, if cameras determine the convention.
_EXACT = 0.5
# Motion is meaningful if it matches this much better than no motion.
_TELLING = 0.98
# Motion contradicts the frames if it matches this much worse than no motion, and moves this many pixels by this
# distance; smaller motion only blurs the compared image, which proves nothing.
_CONTRADICTS, _FAR = 1.1, 2.0
# Mean difference of frames below which they are the same up to rounding, and tell nothing of motion.
_UNLIKE = 1e-3
# Number of compared pairs of frames.
MOTION_PAIRS = 3
# Approximate number of sampled pixels.
_POINTS = 4096
# Largest median reprojection error in pixels: filters and lenses move points, and pixel offsets differ by one at most.
NEAR = 2.0
# About so many pixels of an image are compared at most, on a grid.
_COMPARED = 2**14


class Convention(NamedTuple):
    """How a motion buffer is stored: ``previous = current + (x * scale_x, y * scale_y)`` in pixels, y down.

    Args:
        scale_x: factor of the first channel.
        scale_y: factor of the second channel.
        words: description.
        swapped: whether the second channel is x, and the first one y.
    """

    scale_x: float
    scale_y: float
    words: str
    swapped: bool = False

    def apply(self, motion: Image) -> Image:
        """Convert to ``(H, W, 2)`` pixels, y down; infinite where the stored value is huge or NaN."""
        with np.errstate(invalid="ignore", over="ignore"):
            xy = motion[..., 1::-1] if self.swapped else motion[..., :2]
            scaled: Image = xy * np.array([self.scale_x, self.scale_y], np.float32)
        return np.where((_is_known(motion) & _is_known(scaled))[..., None], scaled, np.float32(np.inf))

    def moves(self, motion: Image, least: float) -> int:
        """The number of pixels that move more than this in x or y, of those with a motion."""
        with np.errstate(invalid="ignore", over="ignore"):
            moved = _longer(self.apply(motion))
            return int(((moved > least) & (moved < np.inf)).sum())


def _is_known(motion: Image) -> Mask:
    """``(H, W)`` where a motion is neither infinite, as in a background, nor NaN, nor huge."""
    with np.errstate(invalid="ignore"):
        known: Mask = _longer(motion) < _LARGEST_MOTION
    return known


def _longer(motion: Image) -> Image:
    """``(H, W)`` the longer of both sides of a motion; NaN if one is."""
    # The maximum over the last axis takes five times as long.
    found: Image = np.maximum(np.abs(motion[..., 0]), np.abs(motion[..., 1]))
    return found


def _is_around_half(motion: Image) -> bool:
    """Whether both channels lie in [0, 1] and around 0.5, as renderers write motion to pictures."""
    known = motion[..., :2][_is_known(motion)]
    inside = bool(known.size) and known.min() >= 0 and known.max() <= 1
    return inside and bool((np.abs(np.median(known, 0) - 0.5) < 0.25).all())


USUAL_MOTION = Convention(1, 1, "previous - current, y down, pixels")
_AT_REST = Convention(0, 0, "no motion")


def conventions(size: tuple[int, int], motion: Image) -> list[Convention]:
    """Possible conventions of a motion buffer: two signs per axis, in pixels or, if plausible, image fractions."""
    height, width = size
    finite = motion[..., :2][np.isfinite(motion[..., :2])]
    scales = [(1.0, 1.0, "pixels")]
    if not finite.size or np.abs(finite[np.abs(finite) < _LARGEST_MOTION]).max(initial=0) <= 2:
        scales += [(width, height, "parts of the image"), (width / 2, height / 2, "parts of half the image")]
    return [
        Convention(
            sx * x,
            sy * y,
            f"{'previous - current' if sx > 0 else 'current - previous'}, {'y down' if sx == sy else 'y up'}, {unit}",
        )
        for (x, y, unit), sx, sy in product(scales, (1, -1), (1, -1))
    ]


# Features of a frame by name, those of the previous frame, and the stored motion.
Pair: TypeAlias = tuple[Mapping[str, Image], Mapping[str, Image], Image]


def read_motion(
    pairs: Sequence[Pair], given: Convention, seen_elsewhere: Sequence[tuple[Image, Array]] = ()
) -> tuple[Convention | None, str, list[str]]:
    """The convention of the motion, its description, and warnings.

    Cameras determine it best, see :func:`match_cameras`; otherwise the frames, see :func:`match_motion`.
    """
    by_cameras = match_cameras(seen_elsewhere, given)
    chosen, conclusive = (by_cameras, True) if by_cameras else match_motion(pairs, given)
    if chosen is None:
        warning = (
            "'motion': does not lead to what looks alike in the frame before, whichever way it is read; it is not used"
        )
        return None, "fits no neighbouring frame: not used", [warning]
    warnings = []
    if chosen[:2] != given[:2]:
        warnings = [f"'motion': read as {chosen.words}, since only so frames match the ones before them"]
    elif not by_cameras and pairs and all(_is_around_half(motion) for *_, motion in pairs):
        warnings = [
            f"'motion': read as {chosen.words}, though all of it lies around 0.5 and between 0 and 1, as "
            "where 0.5 stands for no motion; write raw vectors, or leave it out with --map motion="
        ]
    return chosen, f"{chosen.words}{', as neighbouring frames match' if conclusive else ''}", warnings


def match_motion(pairs: Sequence[Pair], given: Convention) -> tuple[Convention | None, bool]:
    """Find the motion convention that leads to matching pixels in the previous frame.

    Args:
        pairs: pairs of consecutive frames.
        given: the usual convention of the format.

    Returns:
        The usual convention, unless another matches clearly better; ``None`` if none matches better than no motion
        although much moves; and whether the frames are conclusive.
    """
    if not pairs:
        return given, False
    given, candidates = _candidates([motion for *_, motion in pairs], given)
    moving = sum(given.moves(motion, _MOVES) for *_, motion in pairs)
    units = {each.words.rpartition(", ")[2] for each in candidates}
    if moving < _LEAST_MOVING and len(units) == 1:
        return given, False
    best, errors, at_rest = _compare([(now, before, on_grid(motion)) for now, before, motion in pairs], candidates)
    better = errors[best] < _BETTER * errors[given]
    # Hardly better than no motion: this is conclusive only if the usual convention is far worse.
    if errors[best] > at_rest or (errors[best] > _TELLING * at_rest and not better):
        far = sum(given.moves(motion, _FAR) for *_, motion in pairs)
        contradicts = errors[best] > _CONTRADICTS * at_rest and far > _LEAST_MOVING
        return (None, True) if contradicts else (given, False)
    # If the usual unit gives hardly any motion and another unit matches, the motion is in that unit.
    rescaled = moving < _LEAST_MOVING and abs(best.scale_x) != abs(given.scale_x)
    return (best, True) if rescaled or better else (given, True)


def _compare(
    pairs: Sequence[Pair], candidates: Sequence[Convention]
) -> tuple[Convention, dict[Convention, float], float]:
    """The best convention, the mean :func:`_mismatch` of each, and that of no motion; of motion :func:`on_grid`."""
    *errors, at_rest = (float(np.mean([_mismatch(*pair, each) for pair in pairs])) for each in (*candidates, _AT_REST))
    found = dict(zip(candidates, errors, strict=True))
    # Interpolation blurs by half a pixel: between two units that match about equally well, prefer the usual one.
    return min(found, key=lambda each: found[each] / (_BETTER if "half" in each.words else 1)), found, at_rest


def match_cameras(pairs: Sequence[tuple[Image, Array]], given: Convention) -> Convention | None:
    """Find the motion convention that agrees with the projection of this frame's points by the previous camera.

    Args:
        pairs: stored motion, and pixels to the previous projection of the points, or NaN, see :func:`motion_to`.
        given: the usual convention of the format.

    Returns:
        The usual convention, unless another fits clearly better; ``None`` if points hardly move or none fits.
    """
    if not pairs:
        return None
    given, candidates = _candidates([motion for motion, _ in pairs], given)
    compared = [(on_grid(motion), seen) for motion, seen in pairs]

    def missed(convention: Convention) -> float:
        away = [np.linalg.norm(convention.apply(motion) - seen, axis=-1) for motion, seen in compared]
        return float(np.mean([np.median(each[np.isfinite(each)]) if np.isfinite(each).any() else 0 for each in away]))

    errors = {each: missed(each) for each in candidates}
    best = min(errors, key=lambda each: errors[each])
    at_rest = missed(_AT_REST)
    if at_rest < _MOVES or errors[best] > _EXACT * at_rest:
        return None
    return best if errors[best] < _BETTER * errors[given] else given


def _candidates(motions: Sequence[Image], given: Convention) -> tuple[Convention, list[Convention]]:
    """The usual convention, and all conventions to compare, including it."""
    found = conventions(motions[0].shape[:2], np.concatenate(motions))
    known = next((each for each in found if each[:2] == given[:2]), None)
    return known or given, found if known else [given, *found]


def _mismatch(now: Mapping[str, Image], before: Mapping[str, Image], motion: Image, convention: Convention) -> float:
    """Mean difference of features and of the previous features to which a motion leads.

    Only pixels with a motion are compared, so that a background without one is no argument for rest. A pixel led
    outside the image counts twice its difference without motion. So a fast pan is judged fairly, but a motion that
    leads every pixel outside is rejected. The motion is that :func:`on_grid`.
    """
    height, width, _ = next(iter(now.values())).shape
    step, moved = _grid_step((height, width)), convention.apply(motion)
    rows, columns = np.mgrid[:height:step, :width:step]
    x = (columns + moved[..., 0] + 0.5) / width * 2 - 1
    y = (rows + moved[..., 1] + 0.5) / height * 2 - 1
    known = np.isfinite(x) & np.isfinite(y)
    grid = torch.from_numpy(np.stack([np.where(known, x, 0), np.where(known, y, 0)], -1)).float()[None]
    inside = known & (np.abs(x) <= 1) & (np.abs(y) <= 1)
    total = 0.0
    for name, image in now.items():
        source = torch.from_numpy(before[name]).permute(2, 0, 1)[None]
        found = F.grid_sample(source, grid, align_corners=False, padding_mode="border")[0].permute(1, 2, 0).numpy()
        unmoved, wanted = on_grid(before[name]), on_grid(image)
        error, at_rest = (np.minimum(np.abs(each - wanted).mean(-1), 1) for each in (found, unmoved))
        total += float(np.where(inside, error, 2 * at_rest[known].mean())[known].mean()) if known.any() else 1.0
    return total


def on_grid(image: Any) -> Any:
    """The pixels of ``(H, W, ...)`` that are compared, a view: about 16 thousand, in every so manyth row and column."""
    step = _grid_step(image.shape)
    return image[::step, ::step]


def _grid_step(size: Sequence[int], pixels: int = _COMPARED) -> int:
    return max(1, int(np.sqrt(size[0] * size[1] / pixels)))


def miss(matrix: Array, position: Image | Array, seen: Mask) -> float:
    """Median reprojection error in pixels of a row-vector matrix with clip y down."""
    points, pixels, size = sampled(position, seen)
    if not len(points):
        return 0.0
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], 1)
    errors = misses(homogeneous, matrix[:, [0, 1, 3]], pixels / size * 2 - 1, size)
    return float(np.median(errors))


def motion_to(matrix: Array, position: Image | Array, seen: Mask) -> Array:
    """Pixels from each pixel to the projection of its point by a matrix as in :func:`miss`, or NaN.

    Returns:
        ``(H', W', 2)`` :func:`on_grid`.
    """
    (height, width), step = seen.shape, _grid_step(seen.shape)
    rows, columns = np.mgrid[:height:step, :width:step]
    clip = np.where(on_grid(seen)[..., None], on_grid(position), np.nan) @ matrix[:3] + matrix[3]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = (clip[..., :2] / clip[..., 3:] + 1) / 2 * (width, height) - 0.5
    result: Array = pixels - np.stack([columns, rows], -1)
    return result


def read_as(matrix: Array, position: Image | Array, seen: Mask) -> tuple[str, float]:
    """Find the convention by which a matrix projects a frame's positions to their pixels.

    Returns:
        The conversion that is needed: empty for none, ``transposed``, ``y up``, both, or ``unknown``; and the remaining
        median reprojection error in pixels.
    """
    errors = {name: miss(convert(matrix, name), position, seen) for name in _CONVENTIONS}
    if errors[""] <= NEAR:
        return "", errors[""]
    best = min(errors, key=lambda name: errors[name])
    return (best, errors[best]) if errors[best] <= NEAR else ("unknown", errors[""])


_CONVENTIONS = ("", "y up", "transposed", "transposed, y up")


def convert(matrix: Array, convention: str) -> Array:
    """Convert a matrix to this package's convention: row vectors, clip y down."""
    result = matrix.T.copy() if "transposed" in convention else matrix.copy()
    if "y up" in convention:
        result[:, 1] *= -1
    return result


class Seen(NamedTuple):
    """What a check of the next frame's motion needs of a frame.

    Args:
        features: albedo and normal, or the color without them, as means of 3x3 pixels.
        camera: row-vector world-to-clip matrix.
    """

    features: Mapping[str, Image]
    camera: Array | None


def seen_in(frame: Frame) -> Seen:
    """Copies of what :func:`doubt_motion` needs of the first frame of a batch, on a CPU."""
    names = [name for name in ("albedo", "normal") if frame.buffer(name) is not None] or ["color"]
    features = {name: _smoothed(_buffer(frame, name)) for name in names}
    matrix = frame.view_projection
    return Seen(features, None if matrix is None else matrix[0].detach().double().numpy().copy())


def _smoothed(image: Tensor) -> Image:
    """Means of 3x3 pixels: noise that a motion interpolates is a fifth less unlike any noise than noise itself."""
    valid = image.nan_to_num().clamp(-1, 1)
    means: Image = F.avg_pool2d(valid, 3, stride=1, padding=1, count_include_pad=False).movedim(0, -1).numpy()
    return means


def doubt_motion(frame: Frame, seen: Seen, before: Seen | None) -> str:
    """What is wrong with the motion of a frame, in a line for a warning; empty if nothing is known to be wrong.

    The matrix must project positions to their own pixels. Motion, or positions under the previous matrix, is wrong if
    another convention leads to pixels that are clearly more alike than its own, and than those at the same place.
    Noise, sky and things that come into view make all of them unlike.

    Args:
        frame: on a CPU; the first frame of its batch is examined.
        seen: the same by :func:`seen_in`.
        before: likewise, the frame before it, of the same size; ``None`` for the first one.
    """
    if frame.position is not None and seen.camera is not None:
        convention, _ = read_as(seen.camera, _pixels(frame, "position"), _hit(frame))
        if convention not in ("", "unknown"):
            return (
                "'view_projection': wrong, which is worse than no motion: positions are projected to their own pixels "
                f"only if it is read as {convention}; expected clip = [x y z 1] @ matrix, clip y down"
            )
    if before is None:
        return ""
    now = seen.features
    if {name: each.shape for name, each in now.items()} != {name: each.shape for name, each in before.features.items()}:
        return ""
    motions: dict[str, Image] = {}
    if frame.motion is not None:
        motions["'motion'"] = on_grid(_pixels(frame, "motion"))
    points = "position" if frame.previous_position is None else "previous_position"
    if before.camera is not None and frame.buffer(points) is not None:
        motion = motion_to(before.camera, _pixels(frame, points), _hit(frame)).astype(np.float32)
        motions[f"'{points}' with the previous 'view_projection'"] = motion
    for source, motion in motions.items():
        if reason := _contradiction((now, before.features, motion)):
            meaning = "previous = current + motion in pixels, x right, y down"
            return f"{source}: wrong, which is worse than no motion: {reason}; expected {meaning}"
    return ""


def _contradiction(pair: Pair) -> str:
    """Why a motion cannot be right: another reading of it must be better than it and than no motion."""
    now, *_, motion = pair
    # The first one is the usual convention.
    usual, *others = conventions(next(iter(now.values())).shape[:2], motion)
    turned = [each._replace(words=f"x and y swapped, {each.words}", swapped=True) for each in (usual, *others[:3])]
    candidates = [usual, *others, *turned]
    if max(each.moves(motion, _MOVES) for each in candidates) < _LEAST_MOVING:
        return ""
    best, errors, at_rest = _compare([pair], candidates)
    if at_rest > _UNLIKE and errors[best] < _BETTER * errors[usual] and errors[best] < _BETTER * at_rest:
        return f"the frame before looks alike only if it is read as {best.words}"
    return ""


def _buffer(frame: Frame, name: str) -> Tensor:
    """``(C, H, W)`` of the first frame of a batch."""
    image = frame.buffer(name)
    assert image is not None
    return image[0].detach().float()


def _pixels(frame: Frame, name: str) -> Image:
    pixels: Image = _buffer(frame, name).movedim(0, -1).numpy()
    return pixels


def _hit(frame: Frame) -> Mask:
    """Where a surface was hit, as far as the buffers tell."""
    hit = (_buffer(frame, "position") != 0).any(0)
    found: Mask = (hit if frame.depth is None else hit & _buffer(frame, "depth")[0].isfinite()).numpy()
    return found


def sampled(position: Image | Array, seen: Mask) -> tuple[Array, Array, Array]:
    """Points ``(N, 3)`` on a grid of pixels, their pixel coordinates, and the image's width and height."""
    height, width = position.shape[:2]
    step = _grid_step((height, width), _POINTS)
    rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    points = position[rows, columns].astype(np.float64)
    known = seen[rows, columns] & np.isfinite(points).all(-1) & (np.abs(points) < 1e9).all(-1)
    pixels = np.stack([columns + 0.5, rows + 0.5], -1)
    return points[known], pixels[known], np.array([width, height], np.float64)


def misses(homogeneous: Array, matrix: Array, screen: Array, size: Array) -> Array:
    """Distances in pixels between projections by a ``(4, 3)`` matrix and places on the screen, from -1 to 1."""
    clip = homogeneous @ matrix
    with np.errstate(divide="ignore", invalid="ignore"):
        missed = np.linalg.norm((clip[:, :2] / clip[:, 2:] - screen) * size / 2, axis=1)
    result: Array = np.nan_to_num(missed, nan=np.inf, posinf=np.inf)
    return result
