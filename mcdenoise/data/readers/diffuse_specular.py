"""Diffuse and specular light in the files of renderers, used if they add up to the color.

KPCN (Bako et al. 2017) and its successors filter both with separate networks. ``specular`` is all light that is not
diffuse, so that the sum is complete: glossy reflection, transmission through glass and volumes, coats and sheen, and
directly visible lamps and background. The latter are not ``emission``, because they have noise under a pixel filter or
behind a lens. Light by subsurface scattering is diffuse.

For a renderer that is not listed here, name two layers (or files) ``diffuse`` and ``specular``, including the colors of
the surfaces, and optionally ``emission``, which must be free of noise, and ``specular_albedo``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from mcdenoise.data.images import Image
from mcdenoise.data.readers.layers import Layer, words_of
from mcdenoise.data.readers.lights import KNOWN, PASSES, Light, difference, find_parts, is_same, light_of
from mcdenoise.light import LARGEST_RADIANCE

DIFFUSE, SPECULAR, EMISSION, SPECULAR_ALBEDO = "diffuse", "specular", "emission", "specular_albedo"
# Optional buffers that few methods use and that are slow to read.
LIGHT_PARTS = frozenset({DIFFUSE, SPECULAR, EMISSION, SPECULAR_ALBEDO, "samples"})
# Every so manyth column is looked at to find out which layers are parts.
_STEP = 8


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
    def layers(self) -> set[Layer]:
        """Every layer to read."""
        own = {layer for lights in self.parts.values() for light in lights for layer in light.layers}
        return own | (set() if self.specular_albedo is None else {self.specular_albedo})

    def sums(self, images: Mapping[Layer, Image]) -> dict[str, Image]:
        """The parts, ``(H, W, 3)`` by buffer, from the images of :attr:`layers`."""
        return {
            name: sum((each.radiance(images) for each in own[1:]), own[0].radiance(images))
            for name, own in self.parts.items()
        }

    def without_absent_light(self, images: Mapping[Layer, Image], color: Image) -> Split:
        """The same without lights that are not in the color, such as the sky of a transparent film, by their values."""
        lights = {f"{name} {i}": each for name, own in self.parts.items() for i, each in enumerate(own)}
        pixels = {name: light.radiance(images)[:, ::_STEP].reshape(-1, 3) for name, light in lights.items()}
        kept = find_parts(color[:, ::_STEP].reshape(-1, 3), pixels, {})
        parts = {name: tuple(lights[n] for n in kept if n.startswith(f"{name} ")) for name in self.parts}
        return replace(self, parts=parts) if all(parts.values()) else self

    def difference(self, sums: Mapping[str, Image], color: Image) -> float:
        """The fraction of the pixels in which the parts do not add up to a color."""
        total: Image = np.asarray(sum(sums.values()))
        return difference(total, color, 1 + sum(len(own) for own in self.parts.values()))

    def buffers(self, images: Mapping[Layer, Image], color: Image) -> dict[str, Image] | None:
        """The buffers of a frame, in their legal ranges; ``None`` if the parts do not add up to its color."""
        sums = self.sums(images)
        if not is_same(self.difference(sums, color)):
            return None
        # Invalid pixels of the color are repaired later; the parts only need to be finite there.
        found = {name: np.clip(np.nan_to_num(each), 0, LARGEST_RADIANCE) for name, each in sums.items()}
        if self.specular_albedo is not None:
            found[SPECULAR_ALBEDO] = np.clip(np.nan_to_num(images[self.specular_albedo][..., :3]), 0, 1)
        return found


NO_SPLIT = Split({})


def find_splits(layers: Sequence[Layer], color: Layer, mapped: Mapping[str, Layer]) -> list[Split]:
    """Find candidates for the parts of a color by names of layers; only their values tell whether they are.

    Args:
        layers: all layers of a frame.
        color: layer of the color.
        mapped: layers that the user has mapped to buffers; diffuse and specular among them replace the search.
    """
    if {DIFFUSE, SPECULAR} <= mapped.keys():
        chosen = {name: (Light((mapped[name],)),) for name in (DIFFUSE, SPECULAR, EMISSION) if name in mapped}
        return [Split(chosen, mapped.get(SPECULAR_ALBEDO))]
    own = [each for each in layers if each != color and each.is_color]
    own = [each for each in own if each.anonymous or each.family == color.family]
    titles: dict[str, Layer] = {}
    for layer in own:
        titles.setdefault(layer.title, layer)
    found: list[Split] = []
    for diffuse, others, gloss in PASSES:
        parts = {
            name: tuple(light_of(titles[t], own) for t in names if t in titles)
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
    words = [word for word in words_of(layer.title) if not word.isdigit()]
    return layer.title not in KNOWN - {EMISSION} and words[-len(wanted) :] == wanted
