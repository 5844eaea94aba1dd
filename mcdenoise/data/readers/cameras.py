"""Consistency of cameras and positions: fitting a camera to positions, and checking a given one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mcdenoise.data.camera_matrices import Array
from mcdenoise.data.exr import Image, Mask

# Approximate number of sampled pixels.
_POINTS = 4096
# Number of times that outliers are rejected.
_ROUNDS = 10
# Largest median reprojection error in pixels: filters and lenses move points, and pixel offsets differ by one at most.
_NEAR = 2.0
# Ratio of the second smallest to the smallest singular value: coplanar points have many solutions.
_UNIQUE = 10.0


class FittedCamera(NamedTuple):
    """The camera that projects given points to their pixels.

    Args:
        matrix: float64 ``(4, 4)`` row-vector world-to-clip matrix, clip y down, clip w the depth along the view axis.
        error: median reprojection error in pixels.
        eye: position of the camera.
    """

    matrix: Array
    error: float
    eye: Array


def fit_camera(position: Image | Array, seen: Mask) -> FittedCamera | None:
    r"""Fit a camera to the positions in an image by the direct linear transform.

    Each pixel gives :math:`P a = u\,P c` and :math:`P b = v\,P c` for the columns a, b, c of the matrix (Hartley and
    Zisserman, Multiple View Geometry, 7.1); the singular vector of the smallest singular value solves all of them. The
    fit is repeated without the points of the largest error: at edges, pixel filters average positions of different
    surfaces.

    Args:
        position: ``(H, W, 3)``.
        seen: ``(H, W)`` bool, true where something was hit.

    Returns:
        ``None`` if the points do not determine a camera: too few, coplanar, or not seen by a pinhole camera.
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
    # For an orthographic camera w is constant, so it is not the depth.
    matrix /= axis if axis * scale > 1e-4 * abs(matrix[3, 2]) else abs(matrix[3, 2])
    error = float(np.median(errors))
    if not (np.isfinite(matrix).all() and error < _NEAR):
        return None
    eye = -np.linalg.lstsq(matrix[:3].T, matrix[3], rcond=None)[0]
    return FittedCamera(matrix[:, [0, 1, 2, 2]], error, eye)


def miss(matrix: Array, position: Image | Array, seen: Mask) -> float:
    """Median reprojection error in pixels of a row-vector matrix with clip y down."""
    points, pixels, size = _sampled(position, seen)
    if not len(points):
        return 0.0
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], 1)
    errors = _misses(homogeneous, matrix[:, [0, 1, 3]], pixels / size * 2 - 1, size)
    return float(np.median(errors))


def motion_to(matrix: Array, position: Image | Array, seen: Mask) -> Array:
    """``(H, W, 2)`` pixels from each pixel to the projection of its point by a matrix as in :func:`miss`, or NaN."""
    height, width = seen.shape
    rows, columns = np.mgrid[:height, :width]
    clip = np.where(seen[..., None], position, np.nan) @ matrix[:3] + matrix[3]
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
    if errors[""] <= _NEAR:
        return "", errors[""]
    best = min(errors, key=lambda name: errors[name])
    return (best, errors[best]) if errors[best] <= _NEAR else ("unknown", errors[""])


_CONVENTIONS = ("", "y up", "transposed", "transposed, y up")


def convert(matrix: Array, convention: str) -> Array:
    """Convert a matrix to this package's convention: row vectors, clip y down."""
    result = matrix.T.copy() if "transposed" in convention else matrix.copy()
    if "y up" in convention:
        result[:, 1] *= -1
    return result


def _sampled(position: Image | Array, seen: Mask) -> tuple[Array, Array, Array]:
    """Points ``(N, 3)`` on a grid of pixels, their pixel coordinates, and the image's width and height."""
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
