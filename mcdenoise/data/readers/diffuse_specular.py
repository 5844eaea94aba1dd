"""Diffuse and specular light in the files of renderers, used if they add up to the color.

KPCN (Bako et al. 2017) and its successors filter both with separate networks. ``specular`` is all light that is not
diffuse, so that the sum is complete: glossy reflection, transmission through glass and volumes, coats and sheen, and
directly visible lamps and background. The latter are not ``emission``, because they have noise under a pixel filter or
behind a lens. Light by subsurface scattering is diffuse.

For a renderer that is not listed here, name two layers (or files) ``diffuse`` and ``specular``, including the colors of
the surfaces, and optionally ``emission``, which must be free of noise, and ``specular_albedo``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mcdenoise.data.exr import Image
from mcdenoise.data.readers.layers import Layer
from mcdenoise.data.readers.lights import Light, color_of, find_parts
from mcdenoise.light import LARGEST_RADIANCE

DIFFUSE, SPECULAR, EMISSION, SPECULAR_ALBEDO = "diffuse", "specular", "emission", "specular_albedo"
# Optional buffers that few methods use and that are slow to read.
LIGHT_PARTS = frozenset({DIFFUSE, SPECULAR, EMISSION, SPECULAR_ALBEDO, "samples"})
# Layers of known renderers: diffuse light, all other light, the color of glossy reflection.
_RENDERERS: tuple[tuple[tuple[str, ...], tuple[str, ...], str], ...] = (
    (
        ("DiffDir", "DiffInd"),
        ("GlossDir", "GlossInd", "TransDir", "TransInd", "VolumeDir", "VolumeInd", "Emit", "Env"),
        "GlossCol",
    ),
    (
        ("Diffuse Direct", "Diffuse Indirect"),
        (
            *("Glossy Direct", "Glossy Indirect", "Transmission Direct", "Transmission Indirect"),
            *("Volume Direct", "Volume Indirect", "Emission", "Environment"),
        ),
        "Glossy Color",
    ),
    (
        ("diffuse_direct", "diffuse_indirect", "sss_direct", "sss_indirect"),
        (
            *("specular_direct", "specular_indirect", "coat_direct", "coat_indirect", "sheen_direct", "sheen_indirect"),
            *("transmission_direct", "transmission_indirect", "volume_direct", "volume_indirect"),
            *("emission", "background"),
        ),
        "specular_albedo",
    ),
    (
        ("directDiffuse", "indirectDiffuse", "subsurface"),
        ("directSpecular", "indirectSpecular", "transmissive", "emissive"),
        "",
    ),
    (
        ("DIRECT_DIFFUSE", "INDIRECT_DIFFUSE"),
        ("DIRECT_GLOSSY", "INDIRECT_GLOSSY", "INDIRECT_SPECULAR", "EMISSION"),
        "",
    ),
)
_KNOWN = {title for diffuse, others, _ in _RENDERERS for title in (*diffuse, *others)}
# Half floats round light, the color that it was divided by, and the sum, by 2^-11 each: allow for four roundings. Near
# 0 the spacing is 2^-24.
_ROUNDING, _SMALLEST_HALF = 4 * 2.0**-11, 2.0**-24
# Largest fraction of pixels that do not add up, such as those brighter than the largest half float.
_MOST_OFF = 1e-3
# Every so manyth column is looked at to find out which layers are parts.
_STEP = 8
_WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])")


@dataclass(frozen=True)
class Split:
    """The layers that are parts of the color.

    Args:
        parts: layers of light by buffer: diffuse, specular, and optionally emission.
        specular_albedo: layer of the specular albedo, if there is one.
        absent: names of layers that the renderer can also write.
    """

    parts: Mapping[str, tuple[Light, ...]]
    specular_albedo: Layer | None = None
    absent: tuple[str, ...] = field(default=(), compare=False)

    @property
    def names(self) -> frozenset[str]:
        """Names of the buffers that a frame gets."""
        return frozenset(self.parts) | ({SPECULAR_ALBEDO} if self.specular_albedo is not None else frozenset())

    @property
    def layers(self) -> dict[str, Layer]:
        """Every layer to read, by a key for :meth:`buffers`."""
        lights = [light for own in self.parts.values() for light in own]
        keyed = {f"light {i} {j}": each for i, light in enumerate(lights) for j, each in enumerate(light.layers)}
        return keyed | ({} if self.specular_albedo is None else {SPECULAR_ALBEDO: self.specular_albedo})

    def sums(self, images: Mapping[str, Image]) -> dict[str, Image]:
        """The parts, ``(H, W, 3)`` by buffer, from the images of :attr:`layers`."""
        lights, number = {}, 0
        for name, own in self.parts.items():
            total: Image = np.zeros((), np.float32)
            for light in own:
                found = [images[f"light {number} {j}"] for j in range(len(light.layers))]
                total = total + light.radiance(found)
                number += 1
            lights[name] = total
        return lights

    def without_strangers(self, images: Mapping[str, Image], color: Image) -> Split:
        """The same without lights that are not in the color, such as the sky of a transparent film, by their values."""
        lights = {f"{name} {i}": each for name, own in self.parts.items() for i, each in enumerate(own)}
        pixels = {}
        for number, (name, light) in enumerate(lights.items()):
            found = [images[f"light {number} {j}"] for j in range(len(light.layers))]
            pixels[name] = light.radiance(found)[:, ::_STEP].reshape(-1, 3)
        kept = find_parts(color[:, ::_STEP].reshape(-1, 3), pixels, {})
        parts = {name: tuple(lights[n] for n in kept if n.startswith(f"{name} ")) for name in self.parts}
        return replace(self, parts=parts) if all(parts.values()) else self

    def off(self, sums: Mapping[str, Image], color: Image) -> tuple[float, float]:
        """Apply :func:`off` to the parts."""
        return off(sums, color, count=1 + sum(len(own) for own in self.parts.values()))

    def buffers(self, images: Mapping[str, Image], color: Image) -> dict[str, Image] | None:
        """The buffers of a frame, in their legal ranges; ``None`` if the parts do not add up to its color."""
        sums = self.sums(images)
        if not adds_up(self.off(sums, color)):
            return None
        # Invalid pixels of the color are repaired later; the parts only need to be finite there.
        found = {name: np.clip(np.nan_to_num(each), 0, LARGEST_RADIANCE) for name, each in sums.items()}
        if self.specular_albedo is not None:
            found[SPECULAR_ALBEDO] = np.clip(np.nan_to_num(images[SPECULAR_ALBEDO], posinf=1, neginf=0), 0, 1)
        return found


def off(sums: Mapping[str, Image], color: Image, *, count: int) -> tuple[float, float]:
    """How far parts are from adding up to a color, beyond the rounding of half floats.

    Args:
        sums: ``(H, W, 3)`` each part.
        color: ``(H, W, 3)``.
        count: number of images that were rounded.

    Returns:
        The fraction of the pixels that do not add up, and the light of all parts over that of the color.
    """
    total: Image = np.asarray(sum(sums.values()))
    known = (np.isfinite(total) & np.isfinite(color)).all(-1)
    total, color = total[known], color[known]
    far = np.abs(total - color) > _ROUNDING * np.maximum(np.abs(total), np.abs(color)) + count * _SMALLEST_HALF
    light = float(np.sum(color, dtype=np.float64))
    return float(far.any(-1).mean()) if known.any() else 1.0, float(np.sum(total, dtype=np.float64)) / (light or 1)


def adds_up(off: tuple[float, float]) -> bool:
    """Whether the result of :meth:`Split.off` is within rounding."""
    return off[0] <= _MOST_OFF


def find_splits(layers: Sequence[Layer], color: Layer, asked: Mapping[str, Layer]) -> list[Split]:
    """Find candidates for the parts of a color by names of layers; only their values tell whether they are.

    Args:
        layers: all layers of a frame.
        color: layer of the color.
        asked: layers that the user has mapped to buffers; diffuse and specular among them replace the search.
    """
    if {DIFFUSE, SPECULAR} <= asked.keys():
        chosen = {name: (Light((asked[name],)),) for name in (DIFFUSE, SPECULAR, EMISSION) if name in asked}
        return [Split(chosen, asked.get(SPECULAR_ALBEDO))]
    own = [each for each in layers if each != color and each.is_color]
    own = [each for each in own if each.anonymous or each.family == color.family]
    titles: dict[str, Layer] = {}
    for layer in own:
        titles.setdefault(layer.title, layer)
    found: list[Split] = []
    for diffuse, others, gloss in _RENDERERS:
        parts = {
            name: tuple(Light((titles[t], *color_of(titles[t], own))) for t in names if t in titles)
            for name, names in ((DIFFUSE, diffuse), (SPECULAR, others))
        }
        if all(parts.values()):
            absent = tuple(each for each in (*diffuse, *others) if each not in titles)
            found.append(Split(parts, titles.get(gloss), absent))
    plain = {name: next((each for each in own if _says(each, name)), None) for name in (DIFFUSE, SPECULAR, EMISSION)}
    if plain[DIFFUSE] is not None and plain[SPECULAR] is not None:
        albedo = next((each for each in own if _says(each, SPECULAR_ALBEDO)), None)
        named = {name: (Light((layer,)),) for name, layer in plain.items() if layer is not None}
        without = {name: each for name, each in named.items() if name != EMISSION}
        # Lamps may be included in the specular light, and also have their own layer.
        found += [Split(each, albedo) for each in ([named, without] if EMISSION in named else [named])]
    return found


def _says(layer: Layer, name: str) -> bool:
    """Whether a layer's name ends with a buffer's name: ``diffuse``, ``shot_diffuse``, ``shotDiffuse``."""
    wanted = name.split("_")
    words = [word.lower() for word in _WORD.findall(layer.title)]
    return layer.title not in _KNOWN - {EMISSION} and words[-len(wanted) :] == wanted
