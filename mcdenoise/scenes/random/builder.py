"""Assembly of a random scene from parts, with bounding boxes for finding free space."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import product
from typing import Any, TypeAlias

import numpy as np

from mcdenoise.data.camera_path import Array
from mcdenoise.scenes.assets import Mesh
from mcdenoise.scenes.random.materials import Bsdf
from mcdenoise.scenes.random.textures import Color

Vector: TypeAlias = Sequence[float] | Array
# A shape as in a Mitsuba dictionary, in the coordinates of its group.
Part: TypeAlias = dict[str, Any]

# Rotation about the vertical axis that turns +z into the room, for each wall: at -z, -x, +z and +x.
TURNS = (0.0, 90.0, 180.0, -90.0)
# Least and largest z of a shape in its own space, where they are not -1 and 1, as those of x and y are.
_BOUNDS = {"cylinder": (0, 1), "disk": (0, 0), "rectangle": (0, 0)}


class SceneBuilder:
    """Collects materials, shapes and lights as a Mitsuba dictionary.

    ``low`` and ``high`` are the bounds for people and cameras. ``points`` are points of interest for cameras.
    ``groups`` are the ids of the shapes of each movable object.
    """

    def __init__(self, low: Vector, high: Vector) -> None:
        self.low, self.high = np.array(low, dtype=np.float64), np.array(high, dtype=np.float64)
        self.points: list[Array] = []
        self.groups: list[list[str]] = []
        self._materials: dict[str, Any] = {}
        self._objects: dict[str, Any] = {}
        self._lights: dict[str, Any] = {}
        self._sky: dict[str, Any] = {}
        self._bounds: list[tuple[Array, Array]] = []

    def material(self, bsdf: Bsdf) -> dict[str, str]:
        """Register a material, which several shapes can use."""
        name = f"material_{len(self._materials)}"
        self._materials[name] = bsdf
        return {"type": "ref", "id": name}

    def areas(self) -> dict[str, float]:
        """For each material, the largest face area of the bounding box of a shape with it, square metres."""
        areas: dict[str, float] = {}
        for shape, (low, high) in zip(self._objects.values(), self._bounds, strict=True):
            name, size = shape["bsdf"]["id"], np.sort(high - low)
            areas[name] = max(areas.get(name, 0.0), float(size[1] * size[2]))
        return areas

    def change_materials(self, change: Callable[[str, Bsdf], Bsdf]) -> None:
        """Replace every material by the result of ``change`` for its id and description."""
        self._materials = {name: change(name, bsdf) for name, bsdf in self._materials.items()}

    def add(
        self, parts: Iterable[Part], to_world: Array | None = None, *, movable: bool = False, look: Vector | None = None
    ) -> None:
        """Add a group of parts to the scene.

        Args:
            parts: shapes in the coordinates of the group.
            to_world: ``(4, 4)`` place of the group.
            movable: whether it may move.
            look: a point of interest, in the coordinates of the group.
        """
        names = []
        for part in parts:
            matrix = part["to_world"] if to_world is None else to_world @ part["to_world"]
            name = f"{'lamp' if 'emitter' in part else part['type']}_{len(self._objects)}"
            self._objects[name] = {**part, "to_world": matrix}
            self._bounds.append(bounds(part["type"], matrix))
            names.append(name)
        if movable:
            self.groups.append(names)
        if look is not None:
            self.points.append(np.array(look) if to_world is None else (to_world @ (*look, 1.0))[:3])

    def add_light(self, light: dict[str, Any]) -> None:
        """Add a light without a surface: a point or spot light."""
        self._lights[f"light_{len(self._lights)}"] = {**light, "sampling_weight": 1.0}

    def set_sky(self, image: Array) -> None:
        """Set the environment light, a lat-long image whose top row is the zenith."""
        self._sky = {"sky": {"type": "envmap", "bitmap": image, "sampling_weight": 1.0}}

    def surface(self) -> float:
        """Area of the sides of the bounds, floor and ceiling included, square metres."""
        width, height, depth = self.high - self.low
        return float(2 * (width * height + height * depth + depth * width))

    def lamps(self) -> list[str]:
        """Ids of the shapes that shine."""
        return [name for name, shape in self._objects.items() if "emitter" in shape]

    def placed(self, name: str) -> Array:
        """Transform of a shape from its own space to world space."""
        return np.asarray(self._objects[name]["to_world"])

    def boxes(self) -> tuple[Array, Array]:
        """Lower and upper corners ``(N, 3)`` of the bounding boxes of all shapes, in order of insertion."""
        lows, highs = np.array(self._bounds).reshape(-1, 2, 3).swapaxes(0, 1)
        return lows, highs

    def scene(self) -> dict[str, Any]:
        """The Mitsuba dictionary of what is there; a shape of the type ``"mesh"`` holds its triangles."""
        return {"type": "scene", **self._materials, **self._objects, **self._lights, **self._sky}


def scene_of(parts: Mapping[str, Part]) -> dict[str, Any]:
    """The Mitsuba dictionary of named parts, each with a material of its own."""
    return {"type": "scene"} | {name: _plain(part) for name, part in parts.items()}


def _plain(value: Any) -> Any:
    """A description with colors and numbers in place of bitmaps of 2x2 pixels, which take longer to load."""
    if not isinstance(value, Mapping):
        return value
    if value.get("type") == "bitmap" and value["bitmap"].shape[:2] == (2, 2):
        pixel = value["bitmap"][0, 0]
        return rgb(pixel) if len(pixel) == 3 else float(pixel[0])
    return {key: _plain(item) for key, item in value.items()}


def rgb(color: Color) -> dict[str, Any]:
    """A colour as a Mitsuba dictionary."""
    return {"type": "rgb", "value": [float(channel) for channel in color]}


def shape(kind: str, to_group: Array, material: Bsdf, radiance: Color | None = None, mesh: Mesh | None = None) -> Part:
    """A shape plugin of Mitsuba, or triangles.

    Args:
        kind: name of the plugin, or ``"mesh"``.
        to_group: ``(4, 4)`` transform from the shape's own space.
        material: description of a material, or result of :meth:`SceneBuilder.material`.
        radiance: emitted radiance, if it is a light.
        mesh: triangles of the kind ``"mesh"``.
    """
    part: Part = {"type": kind, "to_world": to_group, "bsdf": material}
    if mesh is not None:
        part["mesh"] = mesh
    if radiance is not None:
        part["emitter"] = {"type": "area", "radiance": rgb(radiance), "sampling_weight": 1.0}
    return part


def bounds(kind: str, matrix: Array) -> tuple[Array, Array]:
    """Lower and upper corner of a transformed shape's axis-aligned bounding box."""
    corners = np.array([*product((-1, 1), (-1, 1), _BOUNDS.get(kind, (-1, 1)))], dtype=np.float64)
    world = corners @ matrix[:3, :3].T + matrix[:3, 3]
    return world.min(axis=0), world.max(axis=0)


def place(position: Vector, turn: float = 0, scale: Vector = (1, 1, 1), rotation: Array | None = None) -> Array:
    """A transform: scale, rotate, rotate about the vertical axis by ``turn`` degrees, translate."""
    matrix = rotate("y", turn) @ (np.eye(4) if rotation is None else rotation) @ np.diag((*scale, 1.0))
    matrix[:3, 3] = position
    return np.asarray(matrix)


def rotate(axis: str, degrees: float) -> Array:
    """A rotation around an axis."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    first, second = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(4)
    matrix[first, first] = matrix[second, second] = c
    matrix[first, second], matrix[second, first] = -s, s
    return matrix


def box(center: Vector, size: Vector, material: Bsdf, turn: float = 0, tilt: float = 0) -> Part:
    """A box of full ``size``, tilted about x, then rotated about y, in degrees."""
    return shape("cube", place(center, turn, [0.5 * length for length in size], rotate("x", tilt)), material)


def ball(center: Vector, radius: float, material: Bsdf, radiance: Color | None = None) -> Part:
    """A sphere."""
    return shape("sphere", place(center, scale=(radius, radius, radius)), material, radiance)


def rod(start: Vector, end: Vector, radius: float, material: Bsdf) -> Part:
    """An open tube between two points."""
    axis = np.subtract(end, start, dtype=np.float64)
    length = float(np.linalg.norm(axis))
    axis /= length
    aside = np.array((1.0, 0.0, 0.0)) if abs(axis[0]) < 0.9 else np.array((0.0, 1.0, 0.0))
    first = np.cross(axis, aside)
    first /= np.linalg.norm(first)
    matrix = np.eye(4)
    matrix[:3] = np.stack((first * radius, np.cross(axis, first) * radius, axis * length, np.asarray(start)), axis=1)
    return shape("cylinder", matrix, material)


def drum(foot: Vector, height: float, radius: float, material: Bsdf) -> list[Part]:
    """An upright cylinder with caps."""
    top = (foot[0], foot[1] + height, foot[2])
    return [rod(foot, top, radius, material), plate(top, radius, material), plate(foot, radius, material, up=False)]


def plate(center: Vector, radius: float, material: Bsdf, up: bool = True) -> Part:
    """A horizontal disc."""
    return shape("disk", place(center, 0, (radius, radius, 1), rotate("x", -90 if up else 90)), material)


def sheet(
    center: Vector, half_size: Vector, material: Bsdf, rotation: Array | None = None, radiance: Color | None = None
) -> Part:
    """A rectangle that faces +z before the rotation."""
    return shape("rectangle", place(center, 0, (*half_size, 1), rotation), material, radiance)
