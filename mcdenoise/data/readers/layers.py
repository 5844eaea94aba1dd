"""Layers: the channels of a file that belong together, and which buffer their name says they are."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from mcdenoise.data.images import Part
from mcdenoise.frame import BUFFERS

# Names that renderers give a buffer, in small letters and digits only, the preferred ones first; field by field from
# Blender, Mitsuba, pbrt, Arnold, RenderMan, V-Ray, Redshift, Octane, Corona, LuxCore, Falcor, Tungsten, OIDN and BMFR.
NAMES: dict[str, tuple[str, ...]] = {
    "color": (
        # What is not denoised yet comes before what may be.
        "noisyimage beautynoisy noisybeauty rgbanoisy",
        "color colour beauty combined rgba rgb ci radiance hdr noisy rgbimagepipeline accumulatepass path2sppillum",
    ),
    "albedo": (
        "denoisingalbedo denoisealbedo",
        "albedo alb diffusealbedo visiblediffuse diffcol diffusefilter diffuseopacity diffusecolor basecolor "
        "albedomulti",
        "denoisealbedonoisy albedonoisy",
    ),
    "normal": (
        "denoisingnormal denoisenormal avgshadingnormal",
        "shadingnormal shnormal ns visiblenormals optixnormals bumpnormals guidenormalw normw",
        "normal normals n nrm worldnormal normalmulti",
        "geometrynormal geonormal facenormal",
    ),
    "depth": ("depth z zdepth zfiltered linearz viewz dd", "denoisingdepth"),
    "position": ("position worldposition p pos posw worldpos pworld positionmulti",),
    "previous_position": ("previousposition prevpos prevposw",),
    "motion": ("vector motion motionvector motionvectors mvec mv flow backward", "velocity"),
    "variance": ("variance rgbavariance rgbvariance colorvariance beautyvariance",),
    "alpha": ("alpha a",),
    "roughness": ("roughness",),
    "reference": ("reference ref groundtruth gt converged",),
}
_RANKS = {
    name: (buffer, rank) for buffer, ranks in NAMES.items() for rank, row in enumerate(ranks) for name in row.split()
}
# Also of a layer that nobody has named: alone, in the file that has a frame's name.
_ROOT_RANK = 1
_ORDER = {
    spelling: place
    for place, row in enumerate(("r red x u", "g green y v", "b blue z", "a alpha w"))
    for spelling in row.split()
}
_EYES = {"left", "right"}
_COLORS = ({"r", "g", "b"}, {"red", "green", "blue"})
# These words speak of something about a buffer, and not of itself.
_ABOUT = {"variance", "var", "mse", "noice", "error", "count"}
# And what stands behind these is a buffer of another kind of light.
_OTHERS = {"specular", "glossy", "transmission", "light", "shadow", "forward", "relative"}
# Tungsten's `colorA` and `colorB` are means of half the samples each: what they are halves of comes first.
_HALF = re.compile(r"(?<=[a-z])[AB]")
_HALF_RANK = 10
_WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|[0-9]+")


@dataclass(frozen=True)
class Layer:
    """Channels of one part of a kind of file that belong together.

    Args:
        group: which kind of file, by its place among those of a frame.
        part: index of the part of the file.
        name: such as ``ViewLayer.Denoising Albedo``; of a file of one picture, what its own name says; or empty.
        channels: their names in the file: R, G, B, A or X, Y, Z, W.
        components: the last words of these, in small letters.
        anonymous: whether only the name of the file says what it is.
        files: how the files are called, for people.
    """

    group: int
    part: int
    name: str
    channels: tuple[str, ...]
    components: tuple[str, ...]
    anonymous: bool = False
    files: str = field(default="", compare=False)

    def __str__(self) -> str:
        letters = "".join(each[0].upper() if each in _ORDER else each.upper() for each in self.components if each)
        return ".".join(filter(None, (self.name, letters))) or self.channels[0]

    @property
    def place(self) -> str:
        """Its files and, unless these alone say what it is, itself; for people."""
        return self.files if self.anonymous and self.files else f"{self.files} {self}".strip()

    @property
    def title(self) -> str:
        """The word of its name that says what it is: without view layer, and without the eye of a stereo image."""
        if self.anonymous:
            return self.name
        words = self.name.split(".")
        return words[-2] if len(words) > 1 and words[-1] in _EYES else words[-1]

    @property
    def family(self) -> tuple[str, ...]:
        """What it has in common with the other layers of one image: all the rest of its name."""
        words = self.name.split(".")
        return tuple(words[:-2] + words[-1:]) if len(words) > 1 and words[-1] in _EYES else tuple(words[:-1])

    @property
    def is_color(self) -> bool:
        """Whether its first three channels are red, green and blue."""
        return set(self.components[:3]) in _COLORS


def layers_of(group: int, label: str, parts: Sequence[Part]) -> list[Layer]:
    """The layers of a file.

    Args:
        group: which kind of file.
        label: what its name says, without the number: names the layer of a file that has no names of its own.
        parts: of the file.
    """
    found: list[Layer] = []
    for index, part in enumerate(parts):
        channels: dict[str, list[str]] = {}
        usable = [channel for channel in part.channels if channel not in part.integers]
        roots = {channel.lower() for channel in usable if "." not in channel}
        together = roots & set(_ORDER)
        if any(colors <= roots for colors in _COLORS):
            # Z beside R, G, B is a depth, and not a third coordinate.
            together &= {"r", "g", "b", "a", "red", "green", "blue", "alpha"}
        elif not {"x", "y"} <= roots and not {"u", "v"} <= roots and roots != {"r", "g"}:
            together = set()
        for channel in usable:
            prefix, dot, _ = channel.rpartition(".")
            if not dot and channel.lower() not in together:
                # `Nsx, Nsy, Nsz` of pbrt are one layer, and `dzdx, dzdy` none.
                stem, three = channel[:-1], [channel[:-1] + letter for letter in "xyz"]
                prefix = stem if stem and channel in three and set(three) <= set(usable) else channel
            channels.setdefault(prefix, []).append(channel)
        for prefix, own in channels.items():
            single = own == [prefix]
            components = ["" if single else channel.removeprefix(prefix).removeprefix(".").lower() for channel in own]
            order = sorted(range(len(own)), key=lambda place: (_ORDER.get(components[place], 9), place))
            name = prefix
            if len(parts) > 1 and prefix and part.name.startswith(prefix):
                # Blender's eyes have parts of their own, with the same channels: `ViewLayer.Combined-left`.
                eye = part.name.removeprefix(prefix).strip("-._ ")
                name = f"{prefix}.{eye}" if eye in _EYES else prefix
            elif part.name and len(parts) > 1 and not prefix.startswith(part.name):
                name = ".".join(filter(None, (part.name, prefix)))
            found.append(Layer(group, index, name, tuple(own[i] for i in order), tuple(components[i] for i in order)))
    # A file of one picture is what its own name says: `albedo_0001.exr`.
    if len(parts) == 1 and len(found) == 1:
        (only,) = found
        picture = Layer(group, 0, label or only.name, only.channels, only.components, anonymous=True)
        says = recognise(picture)
        # `reference_0001.exr` is one, whatever its only layer is called.
        if not only.name or len(only.channels) == 1 or (says is not None and says[1] <= _ROOT_RANK):
            return [picture]
    return found


def recognise(layer: Layer) -> tuple[str, int] | None:
    """Which buffer a layer's name says that it is, and how much its name is preferred: 0 is best; or ``None``.

    The last words of the name count: ``Main Layer.Denoising Albedo``, ``kitchen_albedo``, ``kitchenAlbedo``. A name
    that speaks of something about a buffer, such as ``albedo_variance``, is none of that buffer.
    """
    if not layer.name:
        return ("color", _ROOT_RANK) if layer.is_color else None
    last = layer.title
    if layer.anonymous and _HALF.fullmatch(last, len(last) - 1):
        whole = recognise(replace(layer, name=last[:-1]))
        if whole is not None and whole[0] != "alpha":
            return whole[0], whole[1] + _HALF_RANK
    words = [word.lower() for word in _WORD.findall(last)]
    starts = [(words[start:], words[:start]) for start in range(len(words))]
    # What a file is may also stand before its shot.
    ends: list[tuple[list[str], list[str]]] = (
        [(words[:end], []) for end in range(len(words) - 1, 0, -1)] if layer.anonymous else []
    )
    for said, before in starts + ends:
        found = _RANKS.get("".join(said))
        # `albedoA` is no alpha: a short name stands alone.
        if found is None or (len(said) < len(words) and len("".join(said)) < 3 and said[0] not in _split(last)):
            continue
        buffer, rank = found
        if _OTHERS & set(before) or (
            buffer == "variance" and any("".join(before[i:]) in _RANKS for i in range(len(before)))
        ):
            return None
        # The compositor's layer is what has been made of the renderer's.
        return buffer, rank + (buffer == "color" and layer.name.lower().startswith("composite"))
    if layer.anonymous and layer.is_color and not (_ABOUT | _OTHERS) & set(words):
        return "color", _ROOT_RANK + 1
    return None


def is_about_a_buffer(layer: Layer) -> bool:
    """Whether a layer's name speaks of something about a buffer that is not the color, such as ``albedoVariance``."""
    words = [word.lower() for word in _WORD.findall(layer.title)]
    return bool(_ABOUT & set(words[-1:])) and any("".join(words[i:-1]) in _RANKS for i in range(len(words) - 1))


def _split(name: str) -> list[str]:
    return re.split(r"[^a-z0-9]+", name.lower())


def fits(buffer: str, layer: Layer) -> bool:
    """Whether a layer has the channels that a buffer needs; one channel may be stored as grey."""
    count = len(layer.channels)
    if BUFFERS[buffer].channels == 1:
        # Or, as Falcor's depth, with its derivative.
        return count <= 2 or layer.is_color
    if buffer == "motion":
        return count in (2, 3, 4)
    if buffer == "variance":
        return count in (1, 3, 4)
    return count in (3, 4)


def named(layers: Sequence[Layer], text: str) -> list[Layer]:
    """Layers that somebody means by a text.

    It is a name with or without its view layer and with or without its channels; or some channels, with commas.

    Example:
        >>> channels = ("View.DiffCol.R", "View.DiffCol.G", "View.DiffCol.B")
        >>> layer = Layer(0, 0, "View.DiffCol", channels, ("r", "g", "b"))
        >>> named([layer], "DiffCol") == named([layer], "View.DiffCol.RGB") == [layer]
        True
        >>> named([layer], "View.DiffCol.G, View.DiffCol.R")[0].channels
        ('View.DiffCol.G', 'View.DiffCol.R')
    """
    channels = tuple(part.strip() for part in text.split(","))
    owners = [next((layer for layer in layers if channel in layer.channels), None) for channel in channels]
    if owners[0] is not None and (len(channels) > 1 or len(owners[0].channels) == 1):
        if any(owner is None or (owner.group, owner.part) != (owners[0].group, owners[0].part) for owner in owners):
            return []
        letters = ("r", "g", "b", "a")[: len(channels)] if len(channels) > 2 else ("",) * len(channels)
        return [replace(owners[0], name=text, channels=channels, components=letters)]
    wanted = {text.strip(), text.strip().rpartition(".")[0]} - {""}
    exact = [layer for layer in layers if text.strip() in (layer.name, str(layer))]
    return exact or [
        layer for layer in layers if any(layer.name == each or layer.name.endswith(f".{each}") for each in wanted)
    ]
