"""Translation of a Mitsuba dictionary for Blender: triangles, Principled materials, lights and a sky.

This is plain Python and numpy, without Mitsuba or Blender. The axes are not changed: y is up.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcdenoise.errors import InputError
from mcdenoise.scenes.cycles.shapes import Mesh, as_matrix, of_triangles, tessellate
from mcdenoise.scenes.random.materials import METALS

# "none" is a perfect mirror.
_METALS = METALS | {"none": (1.0, 1.0, 1.0)}
_SHAPE_KEYS = {"type", "to_world", "bsdf", "emitter", "mesh"}
_PLASTIC_IOR, _GLASS_IOR = 1.49, 1.5046
# Fraction of a spot light's cone with constant intensity, Mitsuba's default.
_BEAM = 0.75


@dataclass(frozen=True, eq=False)
class Description:
    """A scene for the script in Blender, as numbers, strings and arrays.

    Args:
        content: ``objects`` (all static shapes are one; moving ones have ids and indices from 1, in the order of the
            scene), ``materials``, ``lights`` and ``sky``.
        arrays: vertices and triangles of the objects, and textures, by the names in ``content``.
    """

    content: dict[str, Any]
    arrays: dict[str, NDArray[Any]] = field(default_factory=dict)

    def save(self, folder: Path) -> None:
        """Write ``scene.json`` and ``scene.npz``, which the script reads.

        Raises:
            InputError: the folder cannot be written.
        """
        try:
            (folder / "scene.json").write_text(json.dumps(self.content), encoding="utf-8")
            # Arrays of numbers only, so nothing is pickled.
            np.savez(folder / "scene.npz", **self.arrays)  # type: ignore[arg-type]
        except OSError as error:
            raise InputError(f"{folder}: cannot be written ({error.strerror}); free space or check it") from error


def translate(scene: Mapping[str, Any], movers: Collection[str] = (), *, seed: int = 0) -> Description:
    """Translate a scene.

    Args:
        scene: a Mitsuba dictionary as in :class:`mcdenoise.scenes.takes.draw.Take`, with arrays for
            transforms and bitmaps.
        movers: ids of the moving shapes, which become separate objects.
        seed: decides at random whether a lacquer becomes a specular base or a coat on a diffuse one, as artists use
            both.

    Raises:
        InputError: the scene has an unsupported part, or ``movers`` names a shape that does not exist.
    """
    translator = _Translator(scene, np.random.default_rng((seed, 0x6C6163)))
    return translator.run(movers)


class _Translator:
    def __init__(self, scene: Mapping[str, Any], rng: np.random.Generator) -> None:
        self._scene, self._rng = scene, rng
        self._arrays: dict[str, NDArray[Any]] = {}
        self._materials: list[dict[str, Any]] = []
        self._numbers: dict[str, int] = {}
        self._translated: dict[str, dict[str, Any]] = {}
        self._textures: dict[bytes, str] = {}
        self._lights: list[dict[str, Any]] = []
        self._sky: dict[str, Any] | None = None

    def run(self, movers: Collection[str]) -> Description:
        groups: dict[str, list[tuple[Mesh, int]]] = {"": []}
        lights = {"point": self._point, "spot": self._spot, "envmap": self._envmap, "constant": self._constant}
        for name, entry in self._scene.items():
            if not isinstance(entry, Mapping):
                continue
            kind = entry["type"]
            if kind in lights:
                lights[kind](name, entry)
            elif kind in _BSDFS:
                continue
            else:
                groups.setdefault(name if name in movers else "", []).append(self._shape(name, entry))
        absent = sorted(set(movers) - groups.keys())
        if absent:
            raise InputError(f"object '{absent[0]}': expected the id of a shape that can move, found no such shape")
        objects = [self._object(number, name, parts) for number, (name, parts) in enumerate(groups.items()) if parts]
        content = {"objects": objects, "materials": self._materials, "lights": self._lights, "sky": self._sky}
        return Description(content, self._arrays)

    def _shape(self, name: str, entry: Mapping[str, Any]) -> tuple[Mesh, int]:
        where = f"scene, '{name}'"
        if entry["type"] == "mesh":
            mesh = of_triangles(entry["mesh"])
        else:
            mesh = tessellate(entry["type"], where, shines=any(_radiance(entry, where)))
        if unknown := sorted(entry.keys() - _SHAPE_KEYS):
            raise InputError(f"{where}: expected {', '.join(sorted(_SHAPE_KEYS))}, found '{unknown[0]}'")
        material = self._bsdf(where, entry["bsdf"]) if "bsdf" in entry else _principled(_color((0.5, 0.5, 0.5)))
        radiance = _radiance(entry, where)
        if any(radiance):
            # Mitsuba's lamps emit on the side of their normal, Cycles' on both sides.
            material = {**material, "radiance": radiance, "one_sided": not mesh.closed}
        return mesh.placed(as_matrix(entry.get("to_world", np.eye(4)), where)), self._number(material)

    def _number(self, material: dict[str, Any]) -> int:
        key = json.dumps(material, sort_keys=True)
        if key not in self._numbers:
            self._numbers[key] = len(self._materials)
            self._materials.append(material)
        return self._numbers[key]

    def _object(self, number: int, name: str, parts: list[tuple[Mesh, int]]) -> dict[str, Any]:
        """Merge shapes into one object: Blender is slow with many objects, but not with many triangles."""
        starts = np.cumsum([0, *(len(mesh.vertices) for mesh, _ in parts)])
        arrays = {
            "vertices": np.concatenate([mesh.vertices for mesh, _ in parts]).astype(np.float32),
            "triangles": np.concatenate(
                [mesh.triangles + start for (mesh, _), start in zip(parts, starts, strict=False)]
            ).astype(np.int32),
            "uv": np.concatenate([mesh.uv for mesh, _ in parts]).astype(np.float32),
            "smooth": np.concatenate([np.full(len(mesh.triangles), mesh.smooth) for mesh, _ in parts]),
            "material": np.concatenate([np.full(len(mesh.triangles), own, np.int32) for mesh, own in parts]),
        }
        self._arrays |= {f"object{number}_{key}": np.ascontiguousarray(array) for key, array in arrays.items()}
        return {"id": name, "array": f"object{number}", "moves": bool(name), "index": number}

    def _bsdf(self, where: str, bsdf: Mapping[str, Any]) -> dict[str, Any]:
        if bsdf["type"] == "ref":
            identity = bsdf["id"]
            if identity not in self._translated:
                if not isinstance(self._scene.get(identity), Mapping):
                    raise InputError(f"{where}: expected a material '{identity}' in the scene, found none")
                self._translated[identity] = self._bsdf(f"scene, '{identity}'", self._scene[identity])
            return self._translated[identity]
        if bsdf["type"] not in _BSDFS:
            raise InputError(
                f"{where}: expected a material that Cycles can be given ({', '.join(_BSDFS)}), found '{bsdf['type']}'"
            )
        return getattr(self, f"_{bsdf['type']}")(where, bsdf)  # type: ignore[no-any-return]

    def _twosided(self, where: str, bsdf: Mapping[str, Any]) -> dict[str, Any]:
        # All surfaces in Cycles are two-sided.
        return self._bsdf(where, bsdf["bsdf"])

    def _mask(self, where: str, bsdf: Mapping[str, Any]) -> dict[str, Any]:
        return {**self._bsdf(where, bsdf["bsdf"]), "alpha": self._value(where, bsdf["opacity"])}

    def _normalmap(self, where: str, bsdf: Mapping[str, Any]) -> dict[str, Any]:
        return {**self._bsdf(where, bsdf["bsdf"]), "normal": self._value(where, bsdf["normalmap"])}

    def _diffuse(self, where: str, bsdf: Mapping[str, Any]) -> dict[str, Any]:
        return _principled(self._value(where, bsdf.get("reflectance", 0.5)))

    def _plastic(self, where: str, bsdf: Mapping[str, Any]) -> dict[str, Any]:
        return self._lacquer(where, bsdf, 0.0)

    def _roughplastic(self, where: str, bsdf: Mapping[str, Any]) -> dict[str, Any]:
        return self._lacquer(where, bsdf, float(bsdf.get("alpha", 0.1)))

    def _lacquer(self, where: str, bsdf: Mapping[str, Any], alpha: float) -> dict[str, Any]:
        base = self._value(where, bsdf.get("diffuse_reflectance", 0.5))
        roughness, ior = math.sqrt(alpha), float(bsdf.get("int_ior", _PLASTIC_IOR))
        if self._rng.random() < 0.5:
            return _principled(base, roughness=roughness, specular=0.5, ior=ior)
        return _principled(base, coat=1.0, coat_roughness=roughness, coat_ior=ior)

    def _conductor(self, where: str, bsdf: Mapping[str, Any]) -> dict[str, Any]:
        return self._metal(where, bsdf, _number(0.0))

    def _roughconductor(self, where: str, bsdf: Mapping[str, Any]) -> dict[str, Any]:
        alpha = bsdf.get("alpha", 0.1)
        # Artists' roughness is the square root of GGX's alpha.
        rough = {**alpha, "bitmap": np.sqrt(alpha["bitmap"])} if isinstance(alpha, Mapping) else math.sqrt(alpha)
        return self._metal(where, bsdf, self._value(where, rough))

    def _metal(self, where: str, bsdf: Mapping[str, Any], roughness: dict[str, Any]) -> dict[str, Any]:
        name = bsdf.get("material", "none")
        if name not in _METALS:
            raise InputError(f"{where}: expected a metal of {', '.join(_METALS)}, found '{name}'")
        tint: Any = bsdf.get("specular_reflectance", 1.0)
        if isinstance(tint, Mapping) and tint["type"] == "bitmap":
            tint = {**tint, "bitmap": np.asarray(tint["bitmap"]) * _METALS[name]}
        else:
            value = self._value(where, tint)["value"]
            tint = {"type": "rgb", "value": [a * b for a, b in zip(value, _METALS[name], strict=True)]}
        return _principled(self._value(where, tint), metallic=1.0, roughness=roughness)

    def _dielectric(self, where: str, bsdf: Mapping[str, Any]) -> dict[str, Any]:
        return self._glass(bsdf, 0.0)

    def _roughdielectric(self, where: str, bsdf: Mapping[str, Any]) -> dict[str, Any]:
        return self._glass(bsdf, math.sqrt(float(bsdf.get("alpha", 0.1))))

    def _glass(self, bsdf: Mapping[str, Any], roughness: float) -> dict[str, Any]:
        ior = float(bsdf.get("int_ior", _GLASS_IOR))
        return _principled(_color((1.0, 1.0, 1.0)), transmission=1.0, roughness=roughness, specular=0.5, ior=ior)

    def _thindielectric(self, where: str, bsdf: Mapping[str, Any]) -> dict[str, Any]:
        return {"type": "pane", "ior": float(bsdf.get("int_ior", _GLASS_IOR))}

    def _value(self, where: str, value: Any) -> dict[str, Any]:
        """Translate a number, a color or a texture: ``{"value": [...]}`` or ``{"texture": name, "scale": [u, v]}``."""
        if isinstance(value, int | float):
            return _color((float(value),) * 3)
        if not isinstance(value, Mapping) or value["type"] not in ("rgb", "bitmap"):
            found = value["type"] if isinstance(value, Mapping) else type(value).__name__
            raise InputError(f"{where}: expected a number, 'rgb' or 'bitmap', found '{found}'")
        if value["type"] == "rgb":
            return _color(_rgb(value, where))
        image = np.asarray(value["bitmap"], dtype=np.float32)
        if image.ndim != 3 or image.shape[2] not in (1, 3) or not value.get("raw", False):
            raise InputError(f"{where}: expected a raw bitmap of 1 or 3 channels, found shape {image.shape}")
        first = image[0, 0]
        if (image == first).all():
            return _color(np.broadcast_to(first, 3).tolist())
        scale = np.asarray(value.get("to_uv", np.eye(4)), dtype=np.float64)
        if not np.array_equal(scale, np.diag(scale.diagonal())):
            raise InputError(f"{where}: expected a texture that is scaled and neither turned nor moved")
        key = image.tobytes() + bytes(str(image.shape), "ascii")
        if key not in self._textures:
            self._textures[key] = f"texture{len(self._textures)}"
            self._arrays[self._textures[key]] = np.broadcast_to(image, (*image.shape[:2], 3)).copy()
        return {"texture": self._textures[key], "scale": scale.diagonal()[:2].tolist()}

    def _point(self, name: str, light: Mapping[str, Any]) -> None:
        intensity = _rgb(light["intensity"], f"scene, '{name}'")
        if any(intensity):
            self._lights.append({"type": "point", "position": list(light["position"]), "intensity": intensity})

    def _spot(self, name: str, light: Mapping[str, Any]) -> None:
        where = f"scene, '{name}'"
        intensity, cutoff = _rgb(light["intensity"], where), float(light.get("cutoff_angle", 20.0))
        beam = float(light.get("beam_width", _BEAM * cutoff))
        if any(intensity):
            self._lights.append(
                {
                    "type": "spot",
                    "to_world": as_matrix(light["to_world"], where).tolist(),
                    "intensity": intensity,
                    "cutoff": cutoff,
                    "beam": beam,
                }
            )

    def _envmap(self, name: str, light: Mapping[str, Any]) -> None:
        image = np.asarray(light["bitmap"], dtype=np.float32)
        if "to_world" in light and not np.allclose(light["to_world"], np.eye(4)):
            raise InputError(f"scene, '{name}': expected a sky that is not turned, found a 'to_world'")
        if image.any():
            self._arrays["sky"] = np.ascontiguousarray(image * float(light.get("scale", 1.0)))
            self._sky = {"texture": "sky"}

    def _constant(self, name: str, light: Mapping[str, Any]) -> None:
        self._sky = {"value": _rgb(light["radiance"], f"scene, '{name}'")}


_BSDFS = (
    "diffuse",
    "plastic",
    "roughplastic",
    "conductor",
    "roughconductor",
    "dielectric",
    "roughdielectric",
    "thindielectric",
    "mask",
    "normalmap",
    "twosided",
)


def _radiance(shape: Mapping[str, Any], where: str) -> list[float]:
    if "emitter" not in shape:
        return [0.0] * 3
    if shape["emitter"]["type"] != "area":
        raise InputError(f"{where}: expected an emitter of type 'area', found '{shape['emitter']['type']}'")
    return _rgb(shape["emitter"]["radiance"], where)


def _principled(base: dict[str, Any], **settings: Any) -> dict[str, Any]:
    """A Principled material, diffuse by default."""
    numbers = {
        "roughness": 1.0,
        "metallic": 0.0,
        "specular": 0.0,
        "ior": 1.5,
        "transmission": 0.0,
        "coat": 0.0,
        "coat_roughness": 0.0,
        "coat_ior": 1.5,
    }
    every = {key: value if isinstance(value, dict) else _number(value) for key, value in (numbers | settings).items()}
    return {"type": "principled", "base": base, **every}


def _number(value: float) -> dict[str, Any]:
    return {"value": float(value)}


def _color(value: Any) -> dict[str, Any]:
    return {"value": [float(channel) for channel in value]}


def _rgb(value: Any, where: str) -> list[float]:
    if isinstance(value, int | float):
        return [float(value)] * 3
    if not isinstance(value, Mapping) or value["type"] != "rgb":
        raise InputError(f"{where}: expected a number or a color of type 'rgb', found something else")
    channels = value["value"]
    return [float(channels)] * 3 if isinstance(channels, int | float) else [float(channel) for channel in channels]
