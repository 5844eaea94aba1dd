"""The shapes of a Mitsuba dictionary as triangle meshes, which Cycles requires."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcdenoise.data.camera_path import Array
from mcdenoise.errors import InputError
from mcdenoise.scenes import assets

# Lamps get few triangles, because Cycles chooses among all emitting triangles for every sample.
_AROUND, _AROUND_A_LAMP = 64, 20


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh.

    Args:
        vertices: ``(N, 3)``.
        triangles: ``(F, 3)`` indices, counterclockwise seen from outside.
        uv: ``(F, 3, 2)`` texture coordinates of each corner, as in Mitsuba.
        smooth: whether normals are interpolated.
        closed: whether the mesh is closed, so that back faces are not visible from outside.
    """

    vertices: Array
    triangles: NDArray[np.int64]
    uv: Array
    smooth: bool
    closed: bool

    def placed(self, matrix: Array) -> Mesh:
        """Transform the mesh by an affine ``(4, 4)`` matrix for column vectors."""
        vertices = self.vertices @ matrix[:3, :3].T + matrix[:3, 3]
        if np.linalg.det(matrix[:3, :3]) > 0:
            return Mesh(vertices, self.triangles, self.uv, self.smooth, self.closed)
        # A reflection would turn the mesh inside out.
        return Mesh(vertices, self.triangles[:, ::-1], self.uv[:, ::-1], self.smooth, self.closed)


def tessellate(kind: str, where: str, *, shines: bool = False) -> Mesh:
    """Tessellate a shape plugin of Mitsuba: ``cube``, ``sphere``, ``cylinder``, ``disk`` or ``rectangle``.

    Args:
        kind: name of the plugin.
        where: description of the object, for the error.
        shines: whether it is a lamp, which gets fewer triangles.

    Raises:
        InputError: the shape is not supported.

    Example:
        >>> tessellate("cube", "a box").triangles.shape
        (12, 3)
    """
    try:
        return _SHAPES[kind](_AROUND_A_LAMP if shines else _AROUND)
    except KeyError as error:
        raise InputError(
            f"{where}: expected a shape that Cycles can be given ({', '.join(_SHAPES)}), found '{kind}'"
        ) from error


def _sphere(around: int) -> Mesh:
    """Radius 1; u around the z axis, v from the pole at +z down. The poles have one vertex each."""
    down = around // 2
    polar = np.arange(1, down) * math.pi / down
    angle = np.arange(around) * 2 * math.pi / around
    ring = np.stack(
        [
            np.sin(polar)[:, None] * np.cos(angle),
            np.sin(polar)[:, None] * np.sin(angle),
            np.cos(polar)[:, None] + 0 * angle,
        ],
        -1,
    )
    vertices = np.concatenate([ring.reshape(-1, 3), [(0, 0, 1), (0, 0, -1)]])
    top, bottom = len(vertices) - 2, len(vertices) - 1
    triangles: list[tuple[int, int, int]] = []
    uv: list[tuple[tuple[float, float], ...]] = []
    for column in range(around):
        after = (column + 1) % around
        left, middle, right = (x / around for x in (column, column + 0.5, column + 1))
        triangles.append((top, column, after))
        uv.append(((middle, 0.0), (left, 1 / down), (right, 1 / down)))
        for row in range(down - 2):
            a, b, c, d = (r * around + x for r, x in ((row, column), (row + 1, column), (row + 1, after), (row, after)))
            high, low = (row + 1) / down, (row + 2) / down
            triangles += [(a, b, c), (a, c, d)]
            uv += [((left, high), (left, low), (right, low)), ((left, high), (right, low), (right, high))]
        last = (down - 2) * around
        triangles.append((last + column, bottom, last + after))
        uv.append(((left, 1 - 1 / down), (middle, 1.0), (right, 1 - 1 / down)))
    return Mesh(vertices, np.array(triangles), np.array(uv), smooth=True, closed=True)


def _cylinder(around: int) -> Mesh:
    """An open tube of radius 1 from z = 0 to 1; u around the axis, v along it."""
    angle = np.arange(around) * 2 * math.pi / around
    circle = np.stack([np.cos(angle), np.sin(angle)], -1)
    vertices = np.concatenate([np.column_stack([circle, np.full(around, z)]) for z in (0.0, 1.0)])
    first = np.arange(around)
    after = (first + 1) % around
    triangles = np.concatenate(
        [
            np.stack([first, after, after + around], -1),
            np.stack([first, after + around, first + around], -1),
        ]
    )
    left, right = first / around, (first + 1) / around
    low, high = np.zeros(around), np.ones(around)

    def corner(u: Array, v: Array) -> Array:
        return np.stack([u, v], -1)

    uv = np.concatenate(
        [
            np.stack([corner(left, low), corner(right, low), corner(right, high)], 1),
            np.stack([corner(left, low), corner(right, high), corner(left, high)], 1),
        ]
    )
    return Mesh(vertices, triangles, uv, smooth=True, closed=False)


def _disk(around: int) -> Mesh:
    """Radius 1, facing +z; u is the radius and v the angle."""
    angle = np.arange(around) * 2 * math.pi / around
    vertices = np.concatenate([np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1), [(0, 0, 0)]])
    first = np.arange(around)
    triangles = np.stack([np.full(around, around), first, (first + 1) % around], -1)
    turned = np.stack([(first + 0.5) / around, first / around, (first + 1) / around], -1)
    radius = np.broadcast_to((0.0, 1.0, 1.0), turned.shape)
    return Mesh(vertices, triangles, np.stack([radius, turned], -1), smooth=False, closed=False)


def _rectangle(around: int) -> Mesh:
    """From -1 to 1 in x and y, facing +z."""
    vertices = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], dtype=np.float64)
    triangles = np.array([(0, 1, 2), (0, 2, 3)])
    return Mesh(vertices, triangles, (vertices[triangles][..., :2] + 1) / 2, smooth=False, closed=False)


def _cube(around: int) -> Mesh:
    """From -1 to 1 in every axis; each face has the whole of a texture."""
    corners = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)])
    vertices: list[Array] = []
    triangles: list[list[int]] = []
    uv: list[Array] = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            face = np.empty((4, 3))
            face[:, axis] = sign
            order = ((axis + 1) % 3, (axis + 2) % 3)
            face[:, order] = 2 * corners - 1
            inside_out = sign < 0
            for triangle in ((0, 1, 2), (0, 2, 3)):
                chosen = list(triangle[::-1] if inside_out else triangle)
                triangles.append([4 * len(vertices) + k for k in chosen])
                uv.append(corners[chosen])
            vertices.append(face)
    return Mesh(np.concatenate(vertices), np.array(triangles), np.array(uv), smooth=False, closed=True)


_SHAPES: dict[str, Callable[[int], Mesh]] = {
    "cube": _cube,
    "sphere": _sphere,
    "cylinder": _cylinder,
    "disk": _disk,
    "rectangle": _rectangle,
}


def of_triangles(mesh: assets.Mesh) -> Mesh:
    """The triangles of a model, with texture coordinates as Mitsuba has them, whose images begin at the top."""
    uv = np.zeros((len(mesh.vertices), 2))
    if mesh.uv is not None:
        uv = np.stack([mesh.uv[:, 0], 1 - mesh.uv[:, 1]], -1).astype(np.float64)
    return Mesh(
        mesh.vertices.astype(np.float64),
        mesh.faces.astype(np.int64),
        uv[mesh.faces],
        mesh.normals is not None,
        closed=False,
    )


def as_matrix(value: Any, where: str) -> Array:
    """Check a ``(4, 4)`` transform of a dictionary.

    Raises:
        InputError: it is not a finite matrix of that shape.
    """
    matrix = np.asarray(value, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError(f"{where}: expected a finite 4x4 matrix for 'to_world', found shape {matrix.shape}")
    return matrix
