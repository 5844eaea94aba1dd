"""Consistency of cameras and positions: fitting a camera to positions, and checking a given one."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mcdenoise.data.images import Image, Mask
from mcdenoise.motion import NEAR, Array, misses, sampled

# Number of times that outliers are rejected.
_ROUNDS = 10
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
    points, pixels, size = sampled(position, seen)
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
        errors = misses(homogeneous, matrix, screen, size)
        kept = errors <= 3 * np.median(errors) + 1e-6
    if not values[1] > _UNIQUE * max(values[0], 1e-12 * values[-1]):
        return None
    if np.median(homogeneous @ matrix[:, 2]) < 0:
        matrix = -matrix
    world = np.diag([1 / scale] * 3 + [1.0])
    world[3, :3] = -center / scale
    matrix = world @ matrix
    axis = np.linalg.norm(matrix[:3, 2])
    # For an orthographic camera w is constant, so it is not the depth.
    matrix /= axis if axis * scale > 1e-4 * abs(matrix[3, 2]) else abs(matrix[3, 2])
    error = float(np.median(errors))
    if not (np.isfinite(matrix).all() and error < NEAR):
        return None
    eye = -np.linalg.lstsq(matrix[:3].T, matrix[3], rcond=None)[0]
    return FittedCamera(matrix[:, [0, 1, 2, 2]], error, eye)


def fault(matrix: Array) -> str:
    """Why no camera has this matrix, in words: it is not finite, all zeros, or singular; empty if one may have it."""
    if not np.isfinite(matrix).all():
        return "the matrix has numbers that are not finite"
    if not matrix.any():
        return "the matrix is all zeros"
    # Depth between the planes of clipping is of no use here.
    return "the matrix is singular" if np.linalg.matrix_rank(matrix[:, [0, 1, 3]]) < 3 else ""
