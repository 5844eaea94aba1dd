"""Translation of a take's scene for Blender: triangles, inputs of Principled shaders, lights and a sky.

This is plain Python and numpy, without Mitsuba or Blender. The axes are not changed: y is up.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcdenoise.data.camera_path import Array
from mcdenoise.data.files import writing
from mcdenoise.errors import InputError
from mcdenoise.scenes import assets
from mcdenoise.scenes.random.materials import METALS

_PLASTIC_IOR, _GLASS_IOR = 1.49, 1.5046
# Lamps get few triangles, because Cycles chooses among all emitting triangles for every sample.
_AROUND, _AROUND_A_LAMP = 64, 20
# Inputs of Blender's Principled shader that make it diffuse.
_DIFFUSE = {
    "Roughness": 1.0,
    "Metallic": 0.0,
    "Specular IOR Level": 0.0,
    "IOR": 1.5,
    "Transmission Weight": 0.0,
    "Coat Weight": 0.0,
    "Coat Roughness": 0.0,
    "Coat IOR": 1.5,
}


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


class Description(NamedTuple):
    """A scene for the script in Blender, as numbers, strings and arrays.

    Args:
        content: ``objects`` (all static shapes are one; moving ones have ids and indices from 1, in the order of the
            scene), ``materials``, ``lights`` and ``sky``.
        arrays: vertices and triangles of the objects, and textures, by the names in ``content``.
    """

    content: dict[str, Any]
    arrays: dict[str, NDArray[Any]]

    def save(self, folder: Path) -> None:
        """Write ``scene.json`` and ``scene.npz``, which the script reads.

        Raises:
            InputError: the folder cannot be written.
        """
        with writing(folder):
            (folder / "scene.json").write_text(json.dumps(self.content), encoding="utf-8")
            # Arrays of numbers only, so nothing is pickled.
            np.savez(folder / "scene.npz", **self.arrays)  # type: ignore[arg-type]


def translate(scene: Mapping[str, Any], movers: Collection[str] = (), *, seed: int = 0) -> Description:
    """Translate a scene.

    Args:
        scene: of a :class:`mcdenoise.scenes.takes.draw.Take`.
        movers: ids of the moving shapes, which become separate objects.
        seed: decides at random whether a lacquer becomes a specular base or a coat on a diffuse one, as artists use
            both.

    Raises:
        InputError: the scene has a shape or a material that no take has.
    """
    return _Translator(scene, np.random.default_rng((seed, 0x6C6163))).run(movers)


class _Translator:
    def __init__(self, scene: Mapping[str, Any], rng: np.random.Generator) -> None:
        self._scene, self._rng = scene, rng
        self._arrays: dict[str, NDArray[Any]] = {}
        self._materials: dict[str, int] = {}
        self._translated: dict[str, dict[str, Any]] = {}
        self._textures: dict[bytes, str] = {}

    def run(self, movers: Collection[str]) -> Description:
        groups: dict[str, list[tuple[Mesh, int]]] = {"": []}
        lights: list[dict[str, Any]] = []
        sky: dict[str, Any] | None = None
        for name, entry in self._scene.items():
            if not isinstance(entry, Mapping):
                continue
            if entry["type"] in ("point", "spot"):
                light = {"type": entry["type"], "intensity": _rgb(entry["intensity"])}
                if entry["type"] == "point":
                    lights.append(light | {"position": list(entry["position"])})
                else:
                    pose = np.asarray(entry["to_world"]).tolist()
                    lights.append(light | {"to_world": pose, "cutoff": entry["cutoff_angle"]})
            elif entry["type"] == "envmap":
                self._arrays["sky"] = np.ascontiguousarray(entry["bitmap"], dtype=np.float32)
                sky = {"texture": "sky"}
            elif entry["type"] == "constant":
                sky = {"value": _rgb(entry["radiance"])}
            elif "bsdf" in entry and "to_world" in entry:
                groups.setdefault(name if name in movers else "", []).append(self._shape(entry))
        objects = [self._object(number, name, parts) for number, (name, parts) in enumerate(groups.items()) if parts]
        materials = [json.loads(text) for text in self._materials]
        return Description({"objects": objects, "materials": materials, "lights": lights, "sky": sky}, self._arrays)

    def _shape(self, entry: Mapping[str, Any]) -> tuple[Mesh, int]:
        radiance = _rgb(entry["emitter"]["radiance"]) if "emitter" in entry else [0.0]
        shines = any(radiance)
        mesh = _of_triangles(entry["mesh"]) if entry["type"] == "mesh" else tessellate(entry["type"], shines=shines)
        material = self._bsdf(entry["bsdf"])
        if shines:
            # Mitsuba's lamps emit on the side of their normal, Cycles' on both sides.
            material = {**material, "radiance": radiance, "one_sided": not mesh.closed}
        number = self._materials.setdefault(json.dumps(material, sort_keys=True), len(self._materials))
        return mesh.placed(np.asarray(entry["to_world"], dtype=np.float64)), number

    def _object(self, number: int, name: str, parts: list[tuple[Mesh, int]]) -> dict[str, Any]:
        """Merge shapes into one object: Blender is slow with many objects, but not with many triangles."""
        starts = np.cumsum([0, *(len(mesh.vertices) for mesh, _ in parts[:-1])])
        columns: dict[str, tuple[Any, list[NDArray[Any]]]] = {
            "vertices": (np.float32, [mesh.vertices for mesh, _ in parts]),
            "triangles": (np.int32, [mesh.triangles + start for (mesh, _), start in zip(parts, starts, strict=True)]),
            "uv": (np.float32, [mesh.uv for mesh, _ in parts]),
            "smooth": (np.bool_, [np.full(len(mesh.triangles), mesh.smooth) for mesh, _ in parts]),
            "material": (np.int32, [np.full(len(mesh.triangles), own) for mesh, own in parts]),
        }
        for key, (kind, arrays) in columns.items():
            self._arrays[f"object{number}_{key}"] = np.ascontiguousarray(np.concatenate(arrays), dtype=kind)
        return {"id": name, "array": f"object{number}", "moves": bool(name), "index": number}

    def _bsdf(self, bsdf: Mapping[str, Any]) -> dict[str, Any]:
        """A material: the ``inputs`` of a Principled shader, or the index of refraction of a ``pane``."""
        kind = bsdf["type"]
        if kind == "ref":
            if bsdf["id"] not in self._translated:
                self._translated[bsdf["id"]] = self._bsdf(self._scene[bsdf["id"]])
            return self._translated[bsdf["id"]]
        # All surfaces in Cycles are two-sided.
        if kind == "twosided":
            return self._bsdf(bsdf["bsdf"])
        for outer, key, name in (("mask", "opacity", "Alpha"), ("normalmap", "normalmap", "Normal")):
            if kind == outer:
                return {"inputs": {**self._bsdf(bsdf["bsdf"])["inputs"], name: self._value(bsdf[key])}}
        ior = float(bsdf.get("int_ior", _PLASTIC_IOR if "plastic" in kind else _GLASS_IOR))
        if kind == "thindielectric":
            return {"pane": ior}
        return {"inputs": {**_DIFFUSE, **self._inputs(bsdf, ior)}}

    def _inputs(self, bsdf: Mapping[str, Any], ior: float) -> dict[str, Any]:
        """Inputs of a Principled shader where they are not those of a diffuse one."""
        kind = bsdf["type"]
        if kind == "diffuse":
            return {"Base Color": self._value(bsdf["reflectance"])}
        if kind == "dielectric":
            inputs = {"Base Color": [1.0] * 3, "Transmission Weight": 1.0, "Roughness": 0.0}
            return inputs | {"Specular IOR Level": 0.5, "IOR": ior}
        if kind in ("plastic", "roughplastic"):
            base, roughness = {"Base Color": self._value(bsdf["diffuse_reflectance"])}, math.sqrt(bsdf.get("alpha", 0))
            if self._rng.random() < 0.5:
                return base | {"Roughness": roughness, "Specular IOR Level": 0.5, "IOR": ior}
            return base | {"Coat Weight": 1.0, "Coat Roughness": roughness, "Coat IOR": ior}
        if kind not in ("conductor", "roughconductor"):
            known = "diffuse, dielectric, plastic, roughplastic, conductor, roughconductor"
            raise InputError(f"expected a material that Cycles can be given ({known}), found '{kind}'")
        metal, tint = np.array(METALS[bsdf["material"]]), bsdf.get("specular_reflectance", 1.0)
        if isinstance(tint, Mapping) and tint["type"] == "bitmap":
            tint = {**tint, "bitmap": np.asarray(tint["bitmap"]) * metal}
        else:
            tint = {"type": "rgb", "value": (metal * _rgb(tint)).tolist()}
        alpha = bsdf.get("alpha", 0.0)
        # Artists' roughness is the square root of GGX's alpha.
        rough = {**alpha, "bitmap": np.sqrt(alpha["bitmap"])} if isinstance(alpha, Mapping) else math.sqrt(alpha)
        return {"Base Color": self._value(tint), "Metallic": 1.0, "Roughness": self._value(rough)}

    def _value(self, value: Any) -> Any:
        """A number or a color as three numbers, or a texture: ``{"texture": name, "scale": [u, v]}``."""
        if not isinstance(value, Mapping) or value["type"] == "rgb":
            return _rgb(value)
        image = np.asarray(value["bitmap"], dtype=np.float32)
        if (image == image[0, 0]).all():
            return np.broadcast_to(image[0, 0], 3).tolist()
        name = self._textures.setdefault(image.tobytes() + str(image.shape).encode(), f"texture{len(self._textures)}")
        self._arrays[name] = np.broadcast_to(image, (*image.shape[:2], 3)).copy()
        return {"texture": name, "scale": np.diagonal(value["to_uv"])[:2].tolist()}


def _rgb(value: Any) -> list[float]:
    """The three channels of a number, or of a color."""
    channels = np.broadcast_to(value["value"] if isinstance(value, Mapping) else value, 3)
    return [float(channel) for channel in channels]


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


def _of_triangles(mesh: assets.Mesh) -> Mesh:
    """The triangles of a model, with texture coordinates as Mitsuba has them, whose images begin at the top."""
    vertices, faces = mesh.vertices.astype(np.float64), mesh.faces.astype(np.int64)
    return Mesh(vertices, faces, mesh.texcoords[mesh.faces], smooth=mesh.normals is not None)
