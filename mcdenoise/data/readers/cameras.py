"""Cameras and the positions that they see: each tells whether the other is what it is said to be."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mcdenoise.data.camera_matrices import Array
from mcdenoise.data.exr import Image, Mask

# Pixels are compared on a grid of about so many.
_POINTS = 4096
# How often those that miss are left out anew.
_ROUNDS = 10
# Pixels by which a point may miss its own, in the median: filters and lenses move points, and offsets by one at most.
_NEAR = 2.0
# How much a second solution has to be worse for the first one to be told: points of one plane have many.
_UNIQUE = 10.0


class FittedCamera(NamedTuple):
    """The camera that sees given points at their pixels.

    Args:
        matrix: float64 ``(4, 4)`` row-vector world-to-clip matrix, clip y down, clip w the depth along the view axis.
        error: by how many pixels a point misses its own, in the median.
        eye: where the camera is.
    """

    matrix: Array
    error: float
    eye: Array


def fit_camera(position: Image | Array, seen: Mask) -> FittedCamera | None:
    r"""Find the camera from the positions that its pixels show, by the direct linear transform.

    Each pixel says :math:`P a = u\,P c` and :math:`P b = v\,P c` of the columns a, b, c of the matrix (Hartley and
    Zisserman, Multiple View Geometry, 7.1); the smallest singular vector of all of them solves these. Then again
    without the points that miss their pixel by most: at edges, filters make means of points that nobody sees.

    Args:
        position: ``(H, W, 3)``.
        seen: ``(H, W)`` bool, where something was hit.

    Returns:
        ``None`` where the points do not tell: too few, all in one plane, or not those of a camera.
    """
    points, pixels, size = _sampled(position, seen)
    if len(points) < 32:
        return None
    center, scale = points.mean(0), np.abs(points - points.mean(0)).max()
    if not scale > 0:
        return None
    homogeneous = np.concatenate([(points - center) / scale, np.ones((len(points), 1))], 1)
    screen = pixels / size * 2 - 1
    kept = np.ones(len(points), bool)
    matrix = np.zeros((4, 3))
    for _ in range(_ROUNDS):
        own, at = homogeneous[kept], screen[kept]
        zero = np.zeros_like(own)
        rows = np.concatenate(
            [np.concatenate([own, zero, -at[:, :1] * own], 1), np.concatenate([zero, own, -at[:, 1:] * own], 1)]
        )
        values, vectors = np.linalg.eigh(rows.T @ rows)
        matrix = vectors[:, 0].reshape(3, 4).T
        errors = _misses(homogeneous, matrix, screen, size)
        kept = errors <= 3 * np.median(errors) + 1e-6
    if not values[1] > _UNIQUE * max(values[0], 1e-12 * values[-1]):
        return None
    if np.median(homogeneous @ matrix[:, 2]) < 0:
        matrix = -matrix
    world = np.concatenate([np.diag([1 / scale] * 3), -center[None] / scale])
    world = np.concatenate([world, [[0.0], [0.0], [0.0], [1.0]]], 1)
    matrix = world @ matrix
    axis = np.linalg.norm(matrix[:3, 2])
    # Without a perspective w is the same everywhere, and no depth.
    matrix /= axis if axis * scale > 1e-4 * abs(matrix[3, 2]) else abs(matrix[3, 2])
    error = float(np.median(errors))
    if not (np.isfinite(matrix).all() and error < _NEAR):
        return None
    eye = -np.linalg.lstsq(matrix[:3].T, matrix[3], rcond=None)[0]
    return FittedCamera(matrix[:, [0, 1, 2, 2]], error, eye)


def miss(matrix: Array, position: Image | Array, seen: Mask) -> float:
    """By how many pixels points miss their own, in the median, seen by a row-vector matrix with clip y down."""
    points, pixels, size = _sampled(position, seen)
    if not len(points):
        return 0.0
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], 1)
    errors = _misses(homogeneous, matrix[:, [0, 1, 3]], pixels / size * 2 - 1, size)
    return float(np.median(errors))


def motion_to(matrix: Array, position: Image | Array, seen: Mask) -> Array:
    """``(H, W, 2)`` pixels from each pixel to where a matrix, as in :func:`miss`, sees its point; NaN where none is."""
    height, width = seen.shape
    rows, columns = np.mgrid[:height, :width]
    clip = np.where(seen[..., None], position, np.nan) @ matrix[:3] + matrix[3]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = (clip[..., :2] / clip[..., 3:] + 1) / 2 * (width, height) - 0.5
    result: Array = pixels - np.stack([columns, rows], -1)
    return result


def read_as(matrix: Array, position: Image | Array, seen: Mask) -> tuple[str, float]:
    """The convention by which a matrix sees a frame's positions at their pixels.

    Returns:
        What is to be done with it: empty where it is right as it stands, or ``transposed``, ``y up``, or both, or
        ``unknown``; and by how many pixels points miss their own then.
    """
    errors = {name: miss(convert(matrix, name), position, seen) for name in _CONVENTIONS}
    if errors[""] <= _NEAR:
        return "", errors[""]
    best = min(errors, key=lambda name: errors[name])
    return (best, errors[best]) if errors[best] <= _NEAR else ("unknown", errors[""])


_CONVENTIONS = ("", "y up", "transposed", "transposed, y up")


def convert(matrix: Array, convention: str) -> Array:
    """The matrix as this project keeps it: for row vectors, clip y down."""
    result = matrix.T.copy() if "transposed" in convention else matrix.copy()
    if "y up" in convention:
        result[:, 1] *= -1
    return result


def _sampled(position: Image | Array, seen: Mask) -> tuple[Array, Array, Array]:
    """Points ``(N, 3)`` of a grid of pixels, and where they are seen, in pixels from the corner; width and height."""
    height, width = position.shape[:2]
    step = max(1, int(np.sqrt(height * width / _POINTS)))
    rows, columns = np.mgrid[step // 2 : height : step, step // 2 : width : step]
    points = position[rows, columns].astype(np.float64)
    known = seen[rows, columns] & np.isfinite(points).all(-1) & (np.abs(points) < 1e9).all(-1)
    pixels = np.stack([columns + 0.5, rows + 0.5], -1)
    return points[known], pixels[known], np.array([width, height], np.float64)


def _misses(homogeneous: Array, matrix: Array, screen: Array, size: Array) -> Array:
    clip = homogeneous @ matrix
    with np.errstate(divide="ignore", invalid="ignore"):
        missed = np.linalg.norm((clip[:, :2] / clip[:, 2:] - screen) * size / 2, axis=1)
    result: Array = np.nan_to_num(missed, nan=np.inf)
    return result
