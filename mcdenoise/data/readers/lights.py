"""Layers of light that add up to the color, such as diffuse and glossy, direct and indirect."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from itertools import islice

import numpy as np

from mcdenoise.data.camera_path import Array
from mcdenoise.data.images import Image
from mcdenoise.data.readers.layers import Layer, named, recognise
from mcdenoise.errors import InputError

ALL = "all"


# For each renderer, whose layers of light add up to its color: names of layers of diffuse light, of layers of all other
# light, and of the color of glossy reflection, if there is one. Blender to 4.5, Blender from 5.0 on, Arnold, RenderMan,
# LuxCore.
PASSES = tuple(
    (diffuse.split(", "), others.split(", "), specular_albedo)
    for diffuse, others, specular_albedo in (
        ("DiffDir, DiffInd", "GlossDir, GlossInd, TransDir, TransInd, VolumeDir, VolumeInd, Emit, Env", "GlossCol"),
        (
            "Diffuse Direct, Diffuse Indirect",
            "Glossy Direct, Glossy Indirect, Transmission Direct, Transmission Indirect, "
            "Volume Direct, Volume Indirect, Emission, Environment",
            "Glossy Color",
        ),
        (
            "diffuse_direct, diffuse_indirect, sss_direct, sss_indirect",
            "specular_direct, specular_indirect, coat_direct, coat_indirect, sheen_direct, sheen_indirect, "
            "transmission_direct, transmission_indirect, volume_direct, volume_indirect, emission, background",
            "specular_albedo",
        ),
        ("directDiffuse, indirectDiffuse, subsurface", "directSpecular, indirectSpecular, transmissive, emissive", ""),
        ("DIRECT_DIFFUSE, INDIRECT_DIFFUSE", "DIRECT_GLOSSY, INDIRECT_GLOSSY, INDIRECT_SPECULAR, EMISSION", ""),
    )
)
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
# All layers of light with known names, which ``all`` tries first.
KNOWN = {title for diffuse, others, _ in PASSES for title in (*diffuse, *others)}
_ADDED = KNOWN | _DIVIDED.keys()
_MATTES = ("Crypto", "crypto", "Debug", "Index", "Material Index", "Object Index")
# Smallest color by which light is divided.
_DARKEST = 1e-3
# Fraction of a layer's light that must be missing without it. The rest is rounding and loss of compression.
_MISSING = 0.9
# Largest difference of layers that add up, and of a copy of the color, relative to the light of the color.
WHOLE, _COPY = 0.01, 0.1
# Number of sets of layers to try.
_MOST_SETS = 4096
# Half floats round light, the color that it was divided by, and the sum, by 2^-11 each: allow for four roundings. Near
# 0 the spacing is 2^-24.
_ROUNDING, _SMALLEST_HALF = 4 * 2.0**-11, 2.0**-24
# Largest fraction of pixels that are not equal, such as those brighter than the largest half float.
_MOST_OFF = 1e-3


@dataclass(frozen=True)
class Light:
    """A layer of radiance.

    Args:
        layers: its own layer, and the color by which it is divided, if any.
    """

    layers: tuple[Layer, ...]

    def radiance(self, images: Mapping[Layer, Image]) -> Image:
        """Compute the additive radiance from the pixels of its layers; invalid values are handled later."""
        own, *colors = (images[layer][..., :3] for layer in self.layers)
        return own * colors[0] if colors else own

    @property
    def color(self) -> Layer | None:
        """The color by which the layer is divided."""
        return self.layers[1] if len(self.layers) > 1 else None


def stored(radiances: Mapping[str, Image], colors: Mapping[str, Image | None]) -> dict[str, Image]:
    """Convert radiances to stored pixels, the inverse of :meth:`Light.radiance`.

    Filters carry light across an edge to pixels where a layer is divided by a color of nearly 0, and cannot store it:
    there the other layers get it, so that the sum is preserved.

    Args:
        radiances: ``(H, W, 3)`` by layer.
        colors: the colors by which the layers are divided.
    """
    kept = {name: True if color is None else color > _DARKEST for name, color in colors.items()}
    held = {name: np.where(kept[name], radiance, 0) for name, radiance in radiances.items()}
    total, left = np.asarray(sum(radiances.values())), np.asarray(sum(held.values()))
    scale = np.divide(total, left, out=np.ones_like(total), where=left > 0)
    found: dict[str, Image] = {}
    for name, radiance in held.items():
        light, color = (radiance * scale).astype(np.float32), colors[name]
        zero = np.zeros_like(light)
        found[name] = light if color is None else np.divide(light, color, out=zero, where=color > _DARKEST)
    return found


def difference(one: Image | Array, other: Image | Array, count: int) -> float:
    """The fraction of the pixels ``(H, W, 3)`` that differ by more than the rounding of half floats.

    Args:
        one: sum or mean of images that were rounded.
        other: what it may be equal to.
        count: number of images that were rounded.
    """
    known = (np.isfinite(one) & np.isfinite(other)).all(-1)
    one, other = one[known], other[known]
    far = np.abs(one - other) > _ROUNDING * np.maximum(np.abs(one), np.abs(other)) + count * _SMALLEST_HALF
    return float(far.any(-1).mean()) if known.any() else 1.0


def is_same(difference: float) -> bool:
    """Whether two images are equal, from their :func:`difference`."""
    return difference <= _MOST_OFF


def left_of(color: Image, parts: Sequence[Image]) -> float:
    """The difference of a color and the sum of its parts, ``(N, 3)`` each, relative to the color."""
    with np.errstate(all="ignore"):
        left = np.abs(color - np.sum(parts, 0, dtype=np.float64))
        known = np.isfinite(left)
        return float(left[known].sum() / max(np.abs(color[known]).sum(dtype=np.float64), 1e-30))


def find_parts(color: Image, known: Mapping[str, Image], unknown: Mapping[str, Image]) -> list[str]:
    """Choose the layers that add up to the color, by their values.

    A layer can be a part if nearly all of its light is missing without it. Of the sets of such layers the first that is
    complete is taken: those with known names and with many layers are tried first. If none is complete, the parts are
    the layers with known names, since others may be anything.

    Args:
        color: ``(N, 3)`` some pixels of the color.
        known: the same pixels of layers with names of light.
        unknown: likewise, with other names.
    """
    with np.errstate(all="ignore"):
        images = {name: image.astype(np.float64) for name, image in {**known, **unknown}.items()}
        # What is no light may have NaN anywhere; light has it in few pixels.
        broken = {name: ~np.isfinite(image).all(-1) for name, image in images.items()}
        usable = np.isfinite(color).all(-1)
        usable &= ~np.any([each for each in broken.values() if each.mean() < _COPY] or [~usable], axis=0)
        # All pixels count, however bright a few of them are.
        total = np.abs(color[usable]).sum(-1, keepdims=True)
        weight = 1 / (total + np.median(total) + 1e-30)
        left = color[usable] * weight
        images = {name: image[usable] * weight for name, image in images.items()}
    light = max(float(np.abs(left).sum()), 1e-30)
    # Unknown layers are neither black, nor the color itself in another layer, perhaps without its noise.
    order = [n for n in images if n in known or (images[n].any() and np.abs(left - images[n]).sum() > _COPY * light)]
    lights = np.array([np.abs(images[name]).sum() for name in order])
    # The light of a layer and of all after it.
    coming = [float(np.nansum(lights[i:])) for i in range(len(order) + 1)]

    def without(rest: Array, place: int) -> Array | None:
        after: Array = rest - images[order[place]]
        gain = np.abs(rest).sum() - np.abs(after).sum()
        # A faint layer with a known name may be less than the rounding of the others.
        least = _MISSING * lights[place] - (WHOLE / 10 * light if order[place] in known else 0)
        return after if gain >= least else None

    stack: list[tuple[Array, int, list[str]]] = [(left, 0, [])]
    first: list[str] | None = None
    for _ in range(_MOST_SETS):
        if not stack:
            break
        rest, place, names = stack.pop()
        if first is None and place == len(known):
            first = names
        far = float(np.abs(rest).sum()) - WHOLE * light
        if place == len(order):
            if far <= 0:
                return names
        elif first is None or far <= coming[place]:
            after = without(rest, place)
            stack.append((rest, place + 1, names))
            if after is not None:
                stack.append((after, place + 1, [*names, order[place]]))
    return first or []


def is_light(layer: Layer) -> bool:
    """Whether a layer is known as light, as a color that light is divided by, or as neither (object mattes)."""
    return layer.title in _ADDED or layer.title.startswith("Combined_") or _is_other(layer)


def _is_other(layer: Layer) -> bool:
    """Whether a layer of colors is known to be no light: a color that light is divided by, or an object matte."""
    return layer.title in _DIVIDED.values() or layer.title.startswith(_MATTES)


def light_of(layer: Layer, layers: Sequence[Layer]) -> Light:
    """A layer of light, with the color by which it is divided, if there is one among other layers."""
    colors = (each for each in layers if each.title == _DIVIDED.get(layer.title) and each.family == layer.family)
    return Light((layer, *islice(colors, 1)))


def find_lights(
    where: str,
    layers: Sequence[Layer],
    color: Layer,
    names: Sequence[str],
    read: Callable[[Sequence[Layer]], Mapping[Layer, Image]],
) -> tuple[Mapping[str, Light], float | None]:
    """Find the requested layers of light.

    Args:
        where: description of the files, for messages.
        layers: all layers of a frame.
        color: layer of the color; it determines the view layer.
        names: names or patterns such as ``Combined_*``; ``all`` for those that add up to the color.
        read: reads the same pixels of several layers, ``(N, 3)`` each, of those that have the pixels of the color.

    Returns:
        The lights by name, and the fraction of the light of the color that is in none of them; ``None`` if there are
        none, or some have other pixels.

    Raises:
        InputError: a layer does not exist, or has fewer than three channels.
    """
    own = [layer for layer in layers if (layer.family == color.family or layer.anonymous) and layer != color]
    known = [layer for layer in own if layer.is_color and recognise(layer) is None]
    pixels = read([color, *(each for layer in known for each in light_of(layer, own).layers)]) if names else {}

    def radiance(chosen: Sequence[Layer]) -> dict[str, Image]:
        """The pixels of lights, as far as they have been read."""
        parts = [light_of(layer, own) for layer in chosen]
        return {each.layers[0].name: each.radiance(pixels) for each in parts if {*each.layers} <= {*pixels}}

    expanded: list[str] = []
    for name in names:
        if name == ALL:
            lit = [layer for layer in known if layer.title in _ADDED]
            others = [layer for layer in known if layer not in lit and not _is_other(layer)]
            expanded += find_parts(pixels[color], radiance(lit), radiance(others))
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
            raise InputError(
                f"{where}: expected one layer of light for --layers {name}, found "
                f"{', '.join(map(str, found)) or 'none'}; {_advice(name, known)}"
            )
        (layer,) = found
        lights[layer.name] = light_of(layer, own)
    images = radiance([light.layers[0] for light in lights.values()])
    whole = bool(lights) and images.keys() == lights.keys()
    return lights, left_of(pixels[color], [*images.values()]) if whole else None


def _advice(name: str, known: Sequence[Layer]) -> str:
    lit = [layer for layer in known if layer.title in _ADDED] or known
    advice = f"choose among {', '.join(map(str, lit))}" if lit else "omit the option"
    # Commas separate the channels of one layer.
    if "," not in name:
        return advice
    return f"separate names by spaces: --layers {shlex.join(map(str.strip, name.split(',')))}; or {advice}"
