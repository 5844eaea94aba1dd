"""Mitsuba 3, which is optional and imported on first use: its variants, and scenes with objects that move."""

from __future__ import annotations

import functools
import hashlib
import importlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import is_dataclass
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mcdenoise.data.camera_path import Array, Camera
from mcdenoise.errors import InputError, first_line, import_optional
from mcdenoise.interruption import unfinished
from mcdenoise.scenes.assets import Mesh

Scene: TypeAlias = str | Path | Mapping[str, Any]

_MOST_NAMES = 20
VARIANTS = ("scalar_rgb", "llvm_ad_rgb", "cuda_ad_rgb")
# What a person without Mitsuba's derivatives, or its fast variant on a CPU, has to do.
LLVM = (
    "Mitsuba's llvm_ad_rgb needs LLVM 19 or newer (Debian: apt-get install libllvm19); set DRJIT_LIBLLVM_PATH to its "
    "library, such as /usr/lib/x86_64-linux-gnu/libLLVM.so.19.1"
)


def choose_variant(variant: str | None) -> str:
    """Choose the variant: the given one, the one that Mitsuba is set to, or the fastest that works here.

    Raises:
        InputError: Mitsuba is missing, or the variant is unknown.
    """
    if variant is None:
        current = import_mitsuba().variant()
        variant = current if current in VARIANTS else (first_working(("cuda_ad_rgb", "llvm_ad_rgb")) or "scalar_rgb")
    if variant not in VARIANTS:
        raise InputError(f"Mitsuba variant: expected one of {', '.join(VARIANTS)}, found '{variant}'")
    return variant


@functools.cache
def first_working(variants: tuple[str, ...]) -> str | None:
    """The first of these variants that can render here; ``None`` if none can.

    The variants are tried in a child process, because an LLVM that is too old for the processor aborts the process.
    """
    trial = f"""
import mitsuba as mi
for variant in {variants!r}:
    try:
        mi.set_variant(variant)
        mi.render(mi.load_dict(mi.cornell_box()), spp=1).numpy()
    except Exception:
        continue
    print("works:", variant)
    break
"""
    # Neither Python, with -P, nor Mitsuba then loads anything from the folder of somebody's scene.
    command, folder = [sys.executable, "-P", "-c", trial], Path(__file__).parent
    try:
        child = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, cwd=folder)
    except (OSError, subprocess.TimeoutExpired):
        return None
    # The output may also contain other text, such as warnings of a driver.
    found = [variant for variant in variants if f"works: {variant}" in child.stdout]
    return found[0] if found else None


def scene_name(scene: Scene) -> str:
    """Name of a scene: the folder of a ``scene.xml``, the name of any other file."""
    if isinstance(scene, Mapping):
        return "in memory"
    path = Path(scene).resolve()
    return path.parent.name if path.stem == "scene" else path.stem


def scene_digest(scene: Scene) -> str:
    """Checksum of a scene's description; of the files that an XML refers to, only the names are included."""
    digest = hashlib.sha256()

    def feed(value: Any) -> None:
        if isinstance(value, Mapping):
            for key, item in value.items():
                digest.update(f"{key}:".encode())
                feed(item)
        elif isinstance(value, np.ndarray):
            digest.update(str(value.shape).encode() + value.tobytes())
        elif isinstance(value, list | tuple):
            digest.update(f"{len(value)}:".encode())
            for item in value:
                feed(item)
        elif is_dataclass(value):
            feed(vars(value))
        elif isinstance(value, np.generic):
            # numpy's formatting of its scalars is a global setting, which colour-science changes.
            feed(value.item())
        else:
            digest.update(f"{value!r};".encode())

    feed(scene if isinstance(scene, Mapping) else Path(scene).read_bytes())
    return digest.hexdigest()


def import_mitsuba() -> Any:
    """Its module, which looks for nothing in the working folder."""
    mitsuba = import_optional("mitsuba", "rendering", "render")
    places = mitsuba.file_resolver()
    for number in reversed(range(len(places))):
        # Mitsuba would load native code, plugins/NAME.so, from the working folder before its own.
        if str(places[number]) == os.getcwd():
            del places[number]
    return mitsuba


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
        self.scene = _load_scene(mi, scene, merge=merge and not moves)
        self.moves = dict(moves or {})
        self._parameters: Any = mi.traverse(self.scene) if moves else {}
        shapes = {shape.id(): shape for shape in self.scene.shapes()}
        self._placed: int | None = None
        self._at_rest = {identity: self._placement(identity, shapes) for identity in self.moves}
        self.movers = [identity for identity in self.moves if identity in shapes]
        # Corners of the bounding boxes.
        boxes = {name: shapes[name].bbox() for name in self.movers}
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
        kinds = ("to_world", "vertex_positions", "position")
        things = sorted({emitter.id() for emitter in self.scene.emitters()}.union(shapes))
        movable = {name: [kind for kind in kinds if f"{name}.{kind}" in self._parameters][:1] for name in things}
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


def _load_scene(mi: Any, scene: Scene, merge: bool) -> Any:
    """The scene in Mitsuba; ``merge`` joins its meshes."""
    if not isinstance(scene, Mapping):
        scene = Path(scene)
        if not scene.is_file():
            raise InputError(f"{scene}: expected a Mitsuba scene, found no such file; check the path")
        scene = scene.absolute()
        native = [each.name for each in scene.parent.glob("plugins/*") if each.suffix in (".so", ".dylib", ".dll")]
        if native or b"<path" in scene.read_bytes():
            found = f"plugins/{native[0]}" if native else "an element <path>, which names a folder for them"
            raise InputError(
                f"{scene}: expected a scene without plug-ins, which are native code that Mitsuba would run, found "
                f"{found}; remove it"
            )
    try:
        if isinstance(scene, Mapping):
            with tempfile.TemporaryDirectory(prefix="mcdenoise-") as folder, unfinished(Path(folder)):
                loaded = mi.load_dict(_to_mitsuba(mi, scene, Path(folder)), optimize=merge)
        else:
            loaded = mi.load_file(str(scene), optimize=merge)
    except (RuntimeError, TypeError, ValueError) as error:
        where = "scene dictionary" if isinstance(scene, Mapping) else scene
        raise InputError(f"{where}: Mitsuba cannot load it: {first_line(error)}") from error
    if not isinstance(loaded, mi.Scene):
        raise InputError(
            f"expected a Mitsuba scene, found a {type(loaded).__name__}; its outermost type must be 'scene'"
        )
    return loaded


def _to_mitsuba(mi: Any, value: Any, folder: Path, name: str = "") -> Any:
    """A dictionary as Mitsuba has it; triangles go to files, which can refer to materials by name."""
    if isinstance(value, Mapping):
        if value.get("type") == "mesh":
            path = folder / f"{name}.ply"
            _write_ply(mi, path, value["mesh"], value["to_world"])
            rest = {key: item for key, item in value.items() if key not in ("type", "mesh", "to_world")}
            value = {"type": "ply", "filename": str(path), "face_normals": value["mesh"].normals is None, **rest}
        return {key: _to_mitsuba(mi, item, folder, key) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        if value.shape == (4, 4):
            return mi.ScalarTransform4f(value)
        return mi.Bitmap(np.ascontiguousarray(value, dtype=np.float32))
    return value


def _write_ply(mi: Any, path: Path, mesh: Mesh, to_world: Array) -> None:
    """Write a mesh in its place."""
    positions = mesh.vertices @ to_world[:3, :3].T + to_world[:3, 3]
    columns: dict[str, NDArray[Any]] = {"vertex_positions": positions, "vertex_texcoords": mesh.texcoords}
    if mesh.normals is not None:
        normals = mesh.normals @ np.linalg.inv(to_world[:3, :3])
        columns["vertex_normals"] = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    has = {"has_vertex_normals": mesh.normals is not None, "has_vertex_texcoords": True}
    written = mi.Mesh(path.stem, len(positions), len(mesh.faces), **has)
    parameters = mi.traverse(written)
    parameters["faces"] = mesh.faces.astype(np.uint32).ravel()
    for name, values in columns.items():
        parameters[name] = values.astype(np.float32).ravel()
    parameters.update()
    written.write_ply(str(path))
