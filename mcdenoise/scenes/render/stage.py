"""A scene in Mitsuba 3, which is optional and imported on first use, with objects that move from frame to frame."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np

from mcdenoise.data.camera_path import Array, Camera
from mcdenoise.errors import InputError, first_line
from mcdenoise.scenes.render.loading import LLVM, Scene, import_mitsuba, load_scene

_MOST_NAMES = 20


class Stage:
    """A scene that a variant of Mitsuba has loaded.

    Args:
        scene: see :func:`mcdenoise.scenes.render.render_sequence`.
        variant: one of ``VARIANTS``.
        moves: see :class:`mcdenoise.data.camera_path.CameraPath`.
        merge: whether meshes that do not move may become one.

    ``mitsuba`` and ``drjit`` are its modules, ``scene`` is its scene, ``moves`` are those given, and ``movers`` the ids
    of the moving shapes.

    Raises:
        InputError: Mitsuba is missing, the variant does not work here, the scene cannot be loaded, or a moving object
            does not exist.
    """

    def __init__(
        self, scene: Scene, variant: str, moves: Mapping[str, Array] | None = None, *, merge: bool = True
    ) -> None:
        self.mitsuba = mi = import_mitsuba()
        try:
            mi.set_variant(variant)
        except ImportError as error:
            advice = f"; {LLVM}" if variant.startswith("llvm") else ""
            raise InputError(f"Mitsuba variant '{variant}' does not run here: {first_line(error)}{advice}") from error
        self.drjit = importlib.import_module("drjit")
        # On a single core, parallel loading of a scene whose parts refer to each other deadlocks.
        self.drjit.set_thread_count(max(2, self.drjit.thread_count()))
        self.scalar = variant.startswith("scalar")
        self.name = f"mitsuba {mi.__version__} ({variant}, drjit {self.drjit.__version__}), path integrator"
        # Merged meshes could not move separately.
        self.scene = load_scene(mi, scene, merge=merge and not moves)
        self.moves = dict(moves or {})
        self._parameters: Any = mi.traverse(self.scene) if moves else {}
        shapes = {shape.id(): shape for shape in self.scene.shapes()}
        self._placed: int | None = None
        self._at_rest = {identity: self._placement(identity, shapes) for identity in self.moves}
        self.movers = [identity for identity in self.moves if identity in shapes]
        # Corners of the bounding boxes.
        boxes = {identity: shapes[identity].bbox() for identity in self.movers}
        self._boxes = {name: np.array([*product(*zip(box.min, box.max, strict=True))]) for name, box in boxes.items()}

    def place(self, frame: int) -> None:
        """Put every moving object to its place in a frame, unless it is there.

        Raises:
            InputError: Mitsuba cannot apply the transform to an object.
        """
        if not self._at_rest or frame == self._placed:
            return
        for identity, placement in self._at_rest.items():
            matrix = self.moves[identity][frame]
            for key, (kind, value) in placement.items():
                self._parameters[f"{identity}.{key}"] = kind(*_transformed(key, value, matrix))
        try:
            self._parameters.update()
        except RuntimeError as error:
            raise InputError(f"frame {frame}: Mitsuba cannot move the objects: {first_line(error)}") from error
        self._placed = frame

    def reach(self, cameras: Sequence[Camera]) -> float:
        """A distance from each camera that is behind everything in the scene: the distance of the background."""
        box = self.scene.bbox()
        if not box.valid():
            return 1.0
        corners = [np.array(box.min, dtype=np.float64), np.array(box.max, dtype=np.float64)]
        for identity, moved in self._boxes.items():
            for matrix in self.moves[identity]:
                corners.extend(moved @ matrix[:3, :3].T + matrix[:3, 3])
        low, high = np.min(corners, axis=0), np.max(corners, axis=0)
        diagonal = float(np.linalg.norm(high - low))
        away = [float(np.linalg.norm((low + high) / 2 - camera.to_world[:3, 3])) for camera in cameras]
        # Rounded up, so that it does not depend on the number of frames unless the camera travels far.
        return max(diagonal + away[0], diagonal / 2 + max(away))

    def _placement(self, identity: str, shapes: Mapping[str, Any]) -> dict[str, tuple[Any, Array]]:
        """The parameters to change when an object moves, with their types and initial values."""
        things = {emitter.id() for emitter in self.scene.emitters()}.union(shapes)
        kinds = ("to_world", "vertex_positions", "position")
        movable = {
            name: [kind for kind in kinds if f"{name}.{kind}" in self._parameters][:1] for name in sorted(things)
        }
        if not movable.get(identity):
            names = [name for name, keys in movable.items() if keys]
            more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
            raise InputError(
                f"object '{identity}': expected the id of a shape or a light that can move "
                f"({', '.join(names[:_MOST_NAMES])}{more}), found no such thing in the scene"
            )
        keys = movable[identity]
        if keys == ["vertex_positions"] and f"{identity}.vertex_normals" in self._parameters:
            keys.append("vertex_normals")
        placement = {}
        for key in keys:
            value = self._parameters[f"{identity}.{key}"]
            numbers = np.array(value.matrix if key == "to_world" else value, dtype=np.float64)
            placement[key] = (type(value), numbers.reshape(4, 4) if key == "to_world" else numbers.reshape(-1, 3))
        return placement


def to_previous(path: Array, frame: int) -> Array:
    """``(4, 4)``, from where an object is in a frame to where it was in the previous one; the identity at first."""
    return np.asarray(path[max(frame - 1, 0)] @ np.linalg.inv(path[frame]))


def _transformed(key: str, value: Array, matrix: Array) -> tuple[Any, ...]:
    """Constructor arguments of a parameter: its initial value with a transform applied."""
    linear, offset = matrix[:3, :3], matrix[:3, 3]
    if key == "to_world":
        return (matrix @ value,)
    if key == "position":
        return tuple((linear @ value[0] + offset).tolist())
    if key == "vertex_normals":
        normals = value @ np.linalg.inv(linear)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return ((normals / np.where(length > 0, length, 1)).astype(np.float32).ravel(),)
    return ((value @ linear.T + offset).astype(np.float32).ravel(),)
