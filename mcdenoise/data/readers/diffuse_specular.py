"""Diffuse and specular light of what renderers write, used where it adds up to the color.

KPCN (Bako et al. 2017) and its successors filter the two by networks of their own. ``specular`` is all light that is
not diffuse, so that the sum stays whole: glossy reflection, what comes through glass and volumes, coats and sheen, and
what is seen of lamps and of the background. The latter are no ``emission``: under a pixel filter or behind a lens they
have noise. Light by subsurface scattering is diffuse.

A renderer that is not known here, or somebody's own, names two layers (or files) ``diffuse`` and ``specular``, with the
colors of the surfaces in them, and perhaps ``emission``, which is without noise then, and ``specular_albedo``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mcdenoise.data.exr import Image
from mcdenoise.data.readers.layers import Layer
from mcdenoise.data.readers.lights import Light, color_of
from mcdenoise.frame import LARGEST_RADIANCE

DIFFUSE, SPECULAR, EMISSION, SPECULAR_ALBEDO = "diffuse", "specular", "emission", "specular_albedo"
# Buffers of which a frame may have some more, at the price of reading them, and which few methods use.
PARTS = frozenset({DIFFUSE, SPECULAR, EMISSION, SPECULAR_ALBEDO, "samples"})
# What a renderer writes: diffuse light, all other light, the color of glossy reflection.
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
# Half floats round light, the color that it was divided by, and the sum, by 2^-11 each: three of these, and one to
# spare. Near 0 they are 2^-24 apart.
_ROUNDING, _SMALLEST_HALF = 4 * 2.0**-11, 2.0**-24
# Of the pixels: those that are brighter than the largest half float do not add up.
_MOST_OFF = 1e-3
_WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])")


@dataclass(frozen=True)
class Split:
    """Which layers are the parts of the color.

    Args:
        parts: layers of light by buffer: diffuse, specular, perhaps emission.
        specular_albedo: of the specular light, if there is one.
        absent: titles of layers that the renderer might have written, too.
    """

    parts: Mapping[str, tuple[Light, ...]]
    specular_albedo: Layer | None = None
    absent: tuple[str, ...] = field(default=(), compare=False)

    @property
    def names(self) -> frozenset[str]:
        """Of the buffers that a frame has of it."""
        return frozenset(self.parts) | ({SPECULAR_ALBEDO} if self.specular_albedo is not None else frozenset())

    @property
    def layers(self) -> dict[str, Layer]:
        """Every layer that is to be read, by a key for :meth:`buffers`."""
        lights = [light for own in self.parts.values() for light in own]
        keyed = {f"light {i} {j}": each for i, light in enumerate(lights) for j, each in enumerate(light.layers)}
        return keyed | ({} if self.specular_albedo is None else {SPECULAR_ALBEDO: self.specular_albedo})

    def sums(self, images: Mapping[str, Image]) -> dict[str, Image]:
        """The parts, ``(H, W, 3)`` by buffer, of the images of :attr:`layers`."""
        lights, number = {}, 0
        for name, own in self.parts.items():
            total: Image = np.zeros((), np.float32)
            for light in own:
                found = [images[f"light {number} {j}"] for j in range(len(light.layers))]
                total = total + light.radiance(found)
                number += 1
            lights[name] = total
        return lights

    def off(self, sums: Mapping[str, Image], color: Image) -> tuple[float, float]:
        """:func:`off` of the parts."""
        return off(sums, color, count=1 + sum(len(own) for own in self.parts.values()))

    def buffers(self, images: Mapping[str, Image], color: Image) -> dict[str, Image] | None:
        """What a frame has of them, in the range of buffers; ``None`` where they do not add up to its color."""
        sums = self.sums(images)
        if not adds_up(self.off(sums, color)):
            return None
        # A pixel of the color that is not finite is mended later on, and these need only be numbers.
        found = {name: np.clip(np.nan_to_num(each), 0, LARGEST_RADIANCE) for name, each in sums.items()}
        if self.specular_albedo is not None:
            found[SPECULAR_ALBEDO] = np.clip(np.nan_to_num(images[SPECULAR_ALBEDO], posinf=1, neginf=0), 0, 1)
        return found


def off(sums: Mapping[str, Image], color: Image, *, count: int) -> tuple[float, float]:
    """How far parts are from adding up to a color, apart from the rounding of half floats.

    Args:
        sums: ``(H, W, 3)`` of each part.
        color: likewise.
        count: how many images were rounded.

    Returns:
        The fraction of the pixels in which they do not, and the light of all over that of the color.
    """
    total: Image = np.asarray(sum(sums.values()))
    known = (np.isfinite(total) & np.isfinite(color)).all(-1)
    total, color = total[known], color[known]
    far = np.abs(total - color) > _ROUNDING * np.maximum(np.abs(total), np.abs(color)) + count * _SMALLEST_HALF
    light = float(np.sum(color, dtype=np.float64))
    return float(far.any(-1).mean()) if known.any() else 1.0, float(np.sum(total, dtype=np.float64)) / (light or 1)


def adds_up(off: tuple[float, float]) -> bool:
    """Whether :meth:`Split.off` is no more than rounding."""
    return off[0] <= _MOST_OFF


def find_splits(layers: Sequence[Layer], color: Layer, asked: Mapping[str, Layer]) -> list[Split]:
    """What may be the parts of a color, by the names of layers; only their values tell whether they are.

    Args:
        layers: all of a frame.
        color: that of the radiance.
        asked: layers that somebody has chosen for a buffer. With diffuse and specular there is nothing else to find.
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
        # Lamps may be in the specular light, and once more in a layer of their own.
        found += [Split(each, albedo) for each in ([named, without] if EMISSION in named else [named])]
    return found


def _says(layer: Layer, name: str) -> bool:
    """Whether the last words of a layer's name are that of a buffer: ``diffuse``, ``shot_diffuse``, ``shotDiffuse``."""
    wanted = name.split("_")
    words = [word.lower() for word in _WORD.findall(layer.title)]
    return layer.title not in _KNOWN - {EMISSION} and words[-len(wanted) :] == wanted
