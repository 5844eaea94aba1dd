"""Layers of light that add up to the color, such as diffuse and glossy, direct and indirect."""

from __future__ import annotations

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np

from mcdenoise.data.exr import Image, Mask
from mcdenoise.data.readers.layers import Layer, named, recognise
from mcdenoise.errors import InputError

ALL = "all"
# Blender divides light by the surface color: `DiffDir` times `DiffCol` is the additive part.
_DIVIDED = {
    f"{kind}{way}": f"{kind}{color}"
    for kinds, ways, color in (
        (("Diff", "Gloss", "Trans", "Subsurface"), ("Dir", "Ind"), "Col"),
        (("Diffuse ", "Glossy ", "Transmission ", "Subsurface "), ("Direct", "Indirect"), "Color"),
    )
    for kind in kinds
    for way in ways
}
# Additive layers of Blender, Arnold, RenderMan, V-Ray and LuxCore, for ``all``.
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


# Smallest color by which light is divided.
_DARKEST = 1e-3


@dataclass(frozen=True)
class Light:
    """A layer of radiance.

    Args:
        layers: its own layer, and the color by which it is divided, if any.
    """

    layers: tuple[Layer, ...]

    def radiance(self, images: Sequence[Image]) -> Image:
        """Compute the additive radiance from the pixels of its layers; invalid values are handled later."""
        result: Image = images[0] if len(images) == 1 else images[0] * images[1]
        return result


def keeps(color: Image | None) -> Mask | bool:
    """The pixels in which a layer can store light: those where the color by which it is divided is not nearly 0."""
    return True if color is None else np.greater(color, _DARKEST)


def stored(radiance: Image, color: Image | None) -> Image:
    """Convert radiance to stored pixels, the inverse of :meth:`Light.radiance`."""
    if color is None:
        return radiance
    result: Image = np.divide(radiance, color, out=np.zeros_like(radiance), where=color > _DARKEST)
    return result


def kept_together(radiances: Mapping[str, Image], kept: Mapping[str, Mask | bool]) -> dict[str, Image]:
    """Move light of each layer from pixels where it cannot be stored to the other layers, preserving the sum.

    Filters carry light across an edge to pixels where a layer is divided by a color of 0.

    Args:
        radiances: ``(H, W, 3)`` by layer.
        kept: where each layer can store light.
    """
    total = sum(radiances.values())
    held = {name: np.where(kept[name], radiance, 0) for name, radiance in radiances.items()}
    left = sum(held.values())
    scale = np.divide(total, left, out=np.ones_like(total), where=left > 0)
    return {name: (radiance * scale).astype(np.float32) for name, radiance in held.items()}


def is_light(layer: Layer) -> bool:
    """Whether a layer is known as light, as a color that light is divided by, or as neither (object mattes)."""
    colors, mattes = set(_DIVIDED.values()), ("Crypto", "Debug", "Index", "Material Index", "Object Index")
    return layer.title in _ADDED | colors or layer.title.startswith(("Combined_", *mattes))


def color_of(layer: Layer, layers: Sequence[Layer]) -> list[Layer]:
    """The color by which a layer of light is divided, if there is one."""
    return [each for each in layers if each.title == _DIVIDED.get(layer.title) and each.family == layer.family][:1]


def find_lights(where: str, layers: Sequence[Layer], color: Layer, names: Sequence[str]) -> Mapping[str, Light]:
    """Find the requested layers of light.

    Args:
        where: description of the files, for messages.
        layers: all layers of a frame.
        color: layer of the color; it determines the view layer.
        names: names or patterns such as ``Combined_*``; ``all`` for all known additive layers.

    Raises:
        InputError: a layer does not exist, or has fewer than three channels.
    """
    own = [layer for layer in layers if (layer.family == color.family or layer.anonymous) and layer != color]
    known = [layer for layer in own if layer.is_color and recognise(layer) is None]
    expanded: list[str] = []
    for name in names:
        if name == ALL:
            expanded += [layer.name for layer in known if layer.title in _ADDED]
        elif any(mark in name for mark in "*?["):
            expanded += [layer.name for layer in known if fnmatchcase(layer.title, name)]
        else:
            expanded.append(name)
            continue
        if not expanded:
            advice = f"name them: --layers {shlex.join(map(str, known[:2]))}" if known else "omit the option"
            raise InputError(f"{where}: expected layers of light for --layers {name}, found none; {advice}")
    lights: dict[str, Light] = {}
    for name in expanded:
        found = named(own, name) or named(layers, name)
        if len(found) != 1 or not found[0].is_color or found[0] == color:
            lit = [layer for layer in known if layer.title in _ADDED] or known
            advice = f"choose among {', '.join(map(str, lit))}" if lit else "omit the option"
            # Commas separate the channels of one layer.
            if "," in name:
                separate = shlex.join(map(str.strip, name.split(",")))
                advice = f"separate names by spaces: --layers {separate}; or {advice}"
            raise InputError(
                f"{where}: expected one layer of light for --layers {name}, found "
                f"{', '.join(map(str, found)) or 'none'}; {advice}"
            )
        (layer,) = found
        lights[layer.name] = Light((layer, *color_of(layer, own)))
    return lights
