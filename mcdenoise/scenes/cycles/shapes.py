"""The shapes of a Mitsuba dictionary as triangle meshes, which Cycles requires."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

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
    smooth: bool = False
    closed: bool = False

    def placed(self, matrix: Array) -> Mesh:
        """Transform the mesh by an affine ``(4, 4)`` matrix for column vectors."""
        moved = replace(self, vertices=self.vertices @ matrix[:3, :3].T + matrix[:3, 3])
        if np.linalg.det(matrix[:3, :3]) > 0:
            return moved
        # A reflection would turn the mesh inside out.
        return replace(moved, triangles=self.triangles[:, ::-1], uv=self.uv[:, ::-1])


def tessellate(kind: str, *, shines: bool = False) -> Mesh:
    """Tessellate a shape plugin of Mitsuba: ``cube``, ``sphere``, ``cylinder``, ``disk`` or ``rectangle``.

    Args:
        kind: name of the plugin.
        shines: whether it is a lamp, which gets fewer triangles.

    Raises:
        InputError: the shape is not supported.

    Example:
        >>> tessellate("cube").triangles.shape
        (12, 3)
    """
    around = _AROUND_A_LAMP if shines else _AROUND
    if kind == "cube":
        return _cube()
    if kind == "sphere":
        return replace(_grid(around, around // 2, _on_sphere, down=True), smooth=True, closed=True)
    if kind == "cylinder":
        return replace(_grid(around, 1, lambda u, v: (*_circle(u), v)), smooth=True)
    if kind == "disk":
        # u is the radius and v the angle.
        return _grid(1, around, lambda u, v: (*(u * side for side in _circle(v)), 0 * u))
    if kind == "rectangle":
        return _grid(1, 1, lambda u, v: (2 * u - 1, 2 * v - 1, 0 * u))
    raise InputError(f"expected a shape that Cycles can be given, found '{kind}'")


def _circle(turn: Array) -> tuple[Array, Array]:
    return np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn)


def _on_sphere(u: Array, v: Array) -> tuple[Array, ...]:
    return (*(np.sin(np.pi * v) * side for side in _circle(u)), np.cos(np.pi * v))


def _grid(columns: int, rows: int, place: Callable[[Array, Array], tuple[Array, ...]], *, down: bool = False) -> Mesh:
    """Triangles of a grid over u and v from 0 to 1; points in the same place are one vertex.

    Args:
        columns: steps of u.
        rows: steps of v.
        place: the points of u and v.
        down: whether v falls from row to row, which turns the outside to the other side.
    """
    v, u = np.mgrid[0 : 1 : (rows + 1) * 1j, 0 : 1 : (columns + 1) * 1j].reshape(2, -1)
    v = 1 - v if down else v
    points = np.stack(place(u, v), -1)
    _, kept, names = np.unique(points.round(9) + 0.0, axis=0, return_index=True, return_inverse=True)
    first = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    across = first + columns + 2
    corners = np.stack([first, first + 1, across, first, across, across - 1], -1).reshape(-1, 3)
    triangles = names.reshape(-1)[corners]
    whole = (triangles != np.roll(triangles, 1, axis=1)).all(1)
    return Mesh(points[kept], triangles[whole], np.stack([u, v], -1)[corners][whole])


def _cube() -> Mesh:
    """From -1 to 1 in every axis; each face has the whole of a texture."""
    side = tessellate("rectangle")
    faces: list[Mesh] = []
    for axis in range(3):
        for sign in (1, -1):
            outside = slice(None, None, sign)
            vertices = np.roll(side.vertices + np.array((0, 0, sign)), axis + 1, axis=1)
            triangles = side.triangles[:, outside] + 4 * len(faces)
            faces.append(Mesh(vertices, triangles, side.uv[:, outside]))
    vertices, triangles, uv = (
        np.concatenate([getattr(face, name) for face in faces]) for name in ("vertices", "triangles", "uv")
    )
    return Mesh(vertices, triangles, uv, closed=True)


def of_triangles(mesh: assets.Mesh) -> Mesh:
    """The triangles of a model, with texture coordinates as Mitsuba has them, whose images begin at the top."""
    vertices, faces = mesh.vertices.astype(np.float64), mesh.faces.astype(np.int64)
    return Mesh(vertices, faces, mesh.texcoords[mesh.faces], smooth=mesh.normals is not None)
