"""Materials of random scenes; a plain color is a small bitmap, too, so that fewer programs are compiled."""

from __future__ import annotations

from typing import Any

import numpy as np

from mcdenoise.data.camera_path import Array
from mcdenoise.scenes.random.textures import Color, Rng, leaf_mask, log_uniform, random_color, texture

Bsdf = dict[str, Any]
# Reflectance of each metal at normal incidence, linear sRGB.
METALS = {
    "Ag": (0.97, 0.96, 0.91),
    "Al": (0.91, 0.92, 0.92),
    "Au": (0.94, 0.78, 0.37),
    "Cu": (0.93, 0.62, 0.49),
    "Cr": (0.55, 0.55, 0.55),
    "W": (0.50, 0.49, 0.45),
}


def diffuse(reflectance: Color | Array, repeat: tuple[float, float] = (1, 1)) -> Bsdf:
    """A diffuse surface."""
    return _two_sided({"type": "diffuse", "reflectance": bitmap(reflectance, repeat)})


def lacquer(reflectance: Color | Array, repeat: tuple[float, float] = (1, 1), nonlinear: bool | None = None) -> Bsdf:
    """A diffuse surface under a smooth clear coat; ``nonlinear`` saturates the color by internal reflections."""
    inner = {"type": "plastic", "diffuse_reflectance": bitmap(reflectance, repeat)}
    # By default Mitsuba's plastic is linear; a key would change the checksums of scenes.
    return _two_sided(inner if nonlinear is None else {**inner, "nonlinear": nonlinear})


def rough_plastic(reflectance: Color | Array, alpha: float, repeat: tuple[float, float] = (1, 1)) -> Bsdf:
    """A diffuse surface under a rough coat."""
    return _two_sided({"type": "roughplastic", "diffuse_reflectance": bitmap(reflectance, repeat), "alpha": alpha})


def rough_metal(material: str, alpha: float | Array, tint: Color | Array = (1, 1, 1)) -> Bsdf:
    """A rough metal; ``alpha`` may be a ``(H, W, 1)`` texture."""
    roughness = np.full((2, 2, 1), alpha) if isinstance(alpha, float) else alpha
    rough = {"type": "roughconductor", "material": material, "alpha": bitmap(roughness)}
    return _two_sided({**rough, "specular_reflectance": bitmap(tint)})


def mirror(material: str = "Ag") -> Bsdf:
    """A perfect mirror."""
    return _two_sided({"type": "conductor", "material": material})


def glass(index: float = 1.5) -> Bsdf:
    """Solid glass, for closed shapes."""
    return {"type": "dielectric", "int_ior": index}


def pane() -> Bsdf:
    """Thin glass without refraction."""
    return {"type": "thindielectric", "int_ior": 1.5}


def foliage(rng: Rng, color: Color) -> Bsdf:
    """A twig of leaves, cut out of a rectangle by a mask."""
    shade = np.clip(np.array(color) * rng.uniform(0.6, 1.4, (16, 16, 1)), 0.02, 0.9)
    return {"type": "mask", "opacity": bitmap(leaf_mask(rng)), "bsdf": diffuse(shade)}


def random_metal(rng: Rng) -> Bsdf:
    """A rough metal: untinted, tinted or brushed."""
    material, alpha = str(rng.choice(list(METALS))), log_uniform(rng, 0.02, 0.4)
    if rng.random() < 0.25:
        pattern = texture(rng).mean(axis=-1, keepdims=True)
        return rough_metal(material, np.clip(alpha * (0.5 + 2 * pattern), 0.02, 0.5))
    if rng.random() < 0.2:
        return rough_metal(material, alpha, tint=texture(rng))
    return rough_metal(material, alpha)


def random_opaque(rng: Rng, repeat: tuple[float, float] = (1, 1), textured: float = 0.4) -> Bsdf:
    """Paint, wood, cloth or lacquer: diffuse or coated, textured with the given probability."""
    look = texture(rng) if rng.random() < textured else random_color(rng)
    kind = rng.random()
    if kind < 0.55:
        return diffuse(look, repeat)
    if kind < 0.7:
        return lacquer(look, repeat)
    return rough_plastic(look, log_uniform(rng, 0.03, 0.4), repeat)


def random_material(rng: Rng) -> Bsdf:
    """Any material for a small closed object."""
    kind = rng.random()
    if kind < 0.66:
        return random_opaque(rng)
    if kind < 0.82:
        return random_metal(rng)
    if kind < 0.88:
        return mirror(str(rng.choice(list(METALS))))
    return glass(rng.uniform(1.3, 1.75))


def _two_sided(bsdf: Bsdf) -> Bsdf:
    return {"type": "twosided", "bsdf": bsdf}


def bitmap(look: Color | Array, repeat: tuple[float, float] = (1, 1)) -> dict[str, Any]:
    """A color, or an image, that is repeated so many times along u and v."""
    image = np.tile(np.array(look, dtype=np.float64), (2, 2, 1)) if isinstance(look, tuple) else look
    # raw: the values are reflectances, not sRGB values to be decoded.
    return {"type": "bitmap", "bitmap": image, "raw": True, "to_uv": np.diag((*repeat, 1.0, 1.0))}
