"""Mitsuba 3, which is optional and imported on first use: its variants, and how scenes are identified and loaded."""

from __future__ import annotations

import functools
import hashlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mcdenoise.data.camera_path import Array
from mcdenoise.errors import InputError, first_line, import_optional
from mcdenoise.interruption import unfinished
from mcdenoise.scenes.assets import Mesh

Scene: TypeAlias = str | Path | Mapping[str, Any]

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


def load_scene(mi: Any, scene: Scene, merge: bool) -> Any:
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
    # Mitsuba's images begin at the top.
    uv = np.zeros((len(mesh.vertices), 2)) if mesh.uv is None else mesh.uv * (1, -1) + (0, 1)
    positions = mesh.vertices @ to_world[:3, :3].T + to_world[:3, 3]
    columns: dict[str, NDArray[Any]] = {"vertex_positions": positions, "vertex_texcoords": uv}
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
