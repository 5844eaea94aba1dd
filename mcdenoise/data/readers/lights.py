"""Layers of light that add up to the color, such as diffuse and glossy, direct and indirect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np

from mcdenoise.data.exr import Image, Mask
from mcdenoise.data.readers.layers import Layer, named, recognise
from mcdenoise.errors import InputError

ALL = "all"
# Blender divides light by the color of what it fell on: `DiffDir` times `DiffCol` is what adds up.
_DIVIDED = {
    f"{kind}{way}": f"{kind}{color}"
    for kinds, ways, color in (
        (("Diff", "Gloss", "Trans", "Subsurface"), ("Dir", "Ind"), "Col"),
        (("Diffuse ", "Glossy ", "Transmission ", "Subsurface "), ("Direct", "Indirect"), "Color"),
    )
    for kind in kinds
    for way in ways
}
# What adds up in Blender, Arnold, RenderMan, V-Ray and LuxCore, where all of it is asked for.
_ADDED = {
    *_DIVIDED,
    *("Emit", "Env", "VolumeDir", "VolumeInd", "Emission", "Environment", "Volume Direct", "Volume Indirect"),
    *("diffuse_direct", "diffuse_indirect", "specular_direct", "specular_indirect", "coat_direct", "coat_indirect"),
    *("sheen_direct", "sheen_indirect", "transmission_direct", "transmission_indirect", "sss_direct", "sss_indirect"),
    *("volume_direct", "volume_indirect", "emission", "background"),
    *(
        "directDiffuse",
        "indirectDiffuse",
        "directSpecular",
        "indirectSpecular",
        "subsurface",
        "transmissive",
        "emissive",
    ),
    *("DIRECT_DIFFUSE", "DIRECT_GLOSSY", "EMISSION", "INDIRECT_DIFFUSE", "INDIRECT_GLOSSY", "INDIRECT_SPECULAR"),
}


# Of a color that light is divided by.
_DARKEST = 1e-3


@dataclass(frozen=True)
class Light:
    """A layer of radiance.

    Args:
        layers: its own and, where it is stored divided by a color, that color.
    """

    layers: tuple[Layer, ...]

    def radiance(self, images: Sequence[Image]) -> Image:
        """What adds up to the color, of the pixels of its layers; invalid values are left to who checks the color."""
        result: Image = images[0] if len(images) == 1 else images[0] * images[1]
        return result


def keeps(color: Image | None) -> Mask | bool:
    """Where a layer that is divided by a color, or by none, can hold light: not where that is nearly 0."""
    return True if color is None else np.greater(color, _DARKEST)


def stored(radiance: Image, color: Image | None) -> Image:
    """Radiance as its layer keeps it, so that :meth:`Light.radiance` of it is the same again."""
    if color is None:
        return radiance
    result: Image = np.divide(radiance, color, out=np.zeros_like(radiance), where=color > _DARKEST)
    return result


def kept_together(radiances: Mapping[str, Image], kept: Mapping[str, Mask | bool]) -> dict[str, Image]:
    """Layers of the same sum, each with light only where it can hold some.

    Filters carry light over an edge to where a layer is divided by a color of 0; there the others share it.

    Args:
        radiances: ``(H, W, 3)`` by layer.
        kept: where each can hold light.
    """
    total = sum(radiances.values())
    held = {name: np.where(kept[name], radiance, 0) for name, radiance in radiances.items()}
    left = sum(held.values())
    scale = np.divide(total, left, out=np.ones_like(total), where=left > 0)
    return {name: (radiance * scale).astype(np.float32) for name, radiance in held.items()}


def is_light(layer: Layer) -> bool:
    """Whether a layer is known as light, or as a color that light is divided by, or as none: mattes of objects."""
    colors, mattes = set(_DIVIDED.values()), ("Crypto", "Debug", "Index", "Material Index", "Object Index")
    return layer.title in _ADDED | colors or layer.title.startswith(("Combined_", *mattes))


def color_of(layer: Layer, layers: Sequence[Layer]) -> list[Layer]:
    """The color that a layer of light is divided by, if there is one."""
    return [each for each in layers if each.title == _DIVIDED.get(layer.title) and each.family == layer.family][:1]


def find_lights(where: str, layers: Sequence[Layer], color: Layer, names: Sequence[str]) -> Mapping[str, Light]:
    """The layers of light that somebody asks for.

    Args:
        where: what the layers are of, for messages.
        layers: all of a frame.
        color: that of the radiance; of several view layers, its own is meant.
        names: of layers, also as patterns such as ``Combined_*``; ``all`` for those that are known to add up.

    Raises:
        InputError: there is no such layer, or it has no three channels.
    """
    own = [layer for layer in layers if (layer.family == color.family or layer.anonymous) and layer != color]
    expanded: list[str] = []
    for name in names:
        known = [layer for layer in own if layer.is_color and recognise(layer) is None]
        if name == ALL:
            expanded += [layer.name for layer in known if layer.title in _ADDED]
        elif any(mark in name for mark in "*?["):
            expanded += [layer.name for layer in known if fnmatchcase(layer.title, name)]
        else:
            expanded.append(name)
            continue
        if not expanded:
            raise InputError(f"{where}: expected layers of light for --layers {name}, found none; name them")
    lights: dict[str, Light] = {}
    for name in expanded:
        found = named(own, name) or named(layers, name)
        if len(found) != 1 or not found[0].is_color or found[0] == color:
            pictures = ", ".join(str(layer) for layer in own if layer.title in _ADDED) or "the others: none is known"
            raise InputError(
                f"{where}: expected one layer of light for --layers {name}, found "
                f"{', '.join(map(str, found)) or 'none'}; choose among {pictures}"
            )
        (layer,) = found
        lights[layer.name] = Light((layer, *color_of(layer, own)))
    return lights
