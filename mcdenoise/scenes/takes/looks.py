"""What renderers write as albedo and roughness of a material that is not diffuse, from its description."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from mcdenoise.scenes.random.materials import METALS


class Look(NamedTuple):
    """Of a material: roughness, and the albedo of a surface without diffuse reflection."""

    roughness: float
    color: tuple[float, float, float]


def look_of(bsdf: Mapping[str, Any]) -> Look:
    """The look of a Mitsuba material."""
    kind = bsdf["type"]
    if kind in ("twosided", "mask", "normalmap"):
        return look_of(bsdf["bsdf"])
    if kind in ("conductor", "roughconductor"):
        color = METALS.get(bsdf.get("material", ""), (0.8, 0.8, 0.8))
        return Look(_alpha(bsdf) if kind == "roughconductor" else 0.0, color)
    if kind in ("dielectric", "thindielectric"):
        return Look(0.0, (1.0, 1.0, 1.0))
    if kind == "plastic":
        return Look(0.0, (1.0, 1.0, 1.0))
    return Look(_alpha(bsdf) if kind == "roughplastic" else 1.0, (0.0, 0.0, 0.0))


def _alpha(bsdf: Mapping[str, Any]) -> float:
    """Perceptual roughness, the root of Beckmann's parameter."""
    alpha = bsdf.get("alpha", 0.1)
    mean = float(np.mean(alpha["bitmap"])) if isinstance(alpha, Mapping) else float(alpha)
    return math.sqrt(min(max(mean, 0.0), 1.0))
