"""Building blocks of the scenes: shapes and materials as Mitsuba dictionaries; units are metres, y is up."""

from __future__ import annotations

from typing import Any

import numpy as np

from mcdenoise.data.camera_path import Array
from mcdenoise.scenes.random.builder import place, rotate
from mcdenoise.scenes.random.textures import Color


def tint(brightness: Array, color: Color) -> Array:
    """A texture of one color with varying brightness, ``(H, W, 3)`` in 0 to 0.9."""
    return np.asarray(np.clip(brightness[..., None] * np.array(color), 0, 0.9))


def textured(texture: Array) -> dict[str, Any]:
    """A diffuse surface with a texture."""
    return _two_sided({"type": "diffuse", "reflectance": bitmap(texture)})


def varnish(texture: Array, alpha: float = 0.15) -> dict[str, Any]:
    """A diffuse surface under a slightly rough coat."""
    return _two_sided({"type": "roughplastic", "diffuse_reflectance": bitmap(texture), "alpha": alpha})


def bitmap(texture: Array) -> dict[str, Any]:
    """A texture of reflectances."""
    # raw: the values are reflectances, not sRGB values to be decoded.
    return {"type": "bitmap", "bitmap": texture, "raw": True}


def diffuse(color: Color) -> dict[str, Any]:
    """A diffuse surface."""
    return _two_sided({"type": "diffuse", "reflectance": {"type": "rgb", "value": list(color)}})


def plastic(color: Color, alpha: float) -> dict[str, Any]:
    """A diffuse surface under a rough coat."""
    reflectance = {"type": "rgb", "value": list(color)}
    return _two_sided({"type": "roughplastic", "diffuse_reflectance": reflectance, "alpha": alpha})


def metal(material: str, alpha: float) -> dict[str, Any]:
    """A rough metal."""
    return _two_sided({"type": "roughconductor", "material": material, "alpha": alpha})


def rectangle(center: Color, half_size: tuple[float, float], rotation: Array, bsdf: dict[str, Any]) -> dict[str, Any]:
    """A rectangle that faces +z before the rotation."""
    return {"type": "rectangle", "to_world": place(center, 0, (*half_size, 1), rotation), "bsdf": bsdf}


def box(center: Color, size: Color, bsdf: dict[str, Any], turn: float = 0) -> dict[str, Any]:
    """A box, rotated about its vertical axis by ``turn`` degrees."""
    half = (size[0] / 2, size[1] / 2, size[2] / 2)
    return {"type": "cube", "to_world": place(center, turn, half), "bsdf": bsdf}


def disk(center: Color, radius: float, bsdf: dict[str, Any], up: bool = True) -> dict[str, Any]:
    """A horizontal disk that faces up, or down."""
    to_world = place(center, 0, (radius, radius, 1), rotate("x", -90 if up else 90))
    return {"type": "disk", "to_world": to_world, "bsdf": bsdf}


def lamp(shape: dict[str, Any], radiance: Color) -> dict[str, Any]:
    """A shape that sends out light."""
    return {**shape, "emitter": {"type": "area", "radiance": {"type": "rgb", "value": list(radiance)}}}


def sphere(center: Color, radius: float, bsdf: dict[str, Any]) -> dict[str, Any]:
    """A sphere."""
    return {"type": "sphere", "center": list(center), "radius": radius, "bsdf": bsdf}


def cylinder(foot: Color, height: float, radius: float, bsdf: dict[str, Any]) -> dict[str, Any]:
    """The side of an upright cylinder, without caps."""
    top = [foot[0], foot[1] + height, foot[2]]
    return {"type": "cylinder", "p0": list(foot), "p1": top, "radius": radius, "bsdf": bsdf}


def _two_sided(bsdf: dict[str, Any]) -> dict[str, Any]:
    return {"type": "twosided", "bsdf": bsdf}
