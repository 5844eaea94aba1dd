"""Layers: groups of channels in a file, and recognising buffers by the names of layers."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from mcdenoise.data.images import Image, Part, read_channels
from mcdenoise.frame import BUFFERS

# Renderers' names of each buffer, in lower-case letters and digits, in order of preference; for Blender, Mitsuba, pbrt,
# Arnold, RenderMan, V-Ray, Redshift, Octane, Corona, LuxCore, Falcor, Tungsten, OIDN and BMFR.
NAMES: dict[str, tuple[str, ...]] = {
    "color": (
        # Noisy images are preferred to those that may have been denoised.
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
    "mask": ("mask validity coverage",),
    "roughness": ("roughness",),
    "reference": ("reference ref groundtruth gt converged",),
}
_RANKS = {
    name: (buffer, rank) for buffer, ranks in NAMES.items() for rank, row in enumerate(ranks) for name in row.split()
}
# The names of a rank, the first ones first.
_USUAL = {name: place for place, name in enumerate(_RANKS)}
# Preference of a layer without a name: the only layer of a file named after the frame.
_ROOT_RANK = 1
_ORDER = {
    spelling: place
    for place, row in enumerate(("r red x u", "g green y v", "b blue z", "a alpha w"))
    for spelling in row.split()
}
# Buffers of three channels that may have one, and names of it.
GREY = frozenset({"color", "reference", "albedo", "variance"})
_LUMINANCE = {"y", "l", "luminance", "grey", "gray"}
_EYES = {"left", "right"}
_COLORS = ({"r", "g", "b"}, {"red", "green", "blue"})
# A name with one of these words denotes a property of a buffer, not the buffer itself.
_ABOUT = {"variance", "var", "mse", "noice", "error", "count"}
# A buffer name after one of these words denotes a buffer of another kind of light.
_OTHERS = {"specular", "glossy", "transmission", "light", "shadow", "forward", "relative"}
# Tungsten's `colorA` and `colorB` are means of half the samples each; the full mean is preferred.
_HALF = re.compile(r"(?<=[a-z])[AB]")
_HALF_RANK = 10
_WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|[0-9]+")


@dataclass(frozen=True)
class Layer:
    """A group of channels in one part of a kind of file.

    Args:
        group: index of the kind of file.
        part: index of the part in the file.
        name: such as ``ViewLayer.Denoising Albedo``; for a file with one picture the file's own name; or empty.
        channels: names in the file: R, G, B, A or X, Y, Z, W.
        components: last words of the channel names, in lower case.
        anonymous: whether only the name of the file identifies the layer.
        files: name of the files, for messages.
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
        """Files and layer name, for messages; only the files if their name identifies it."""
        return self.files if self.anonymous and self.files else f"{self.files} {self}".strip()

    @property
    def title(self) -> str:
        """The significant word of the name: without view layer, and without the eye of a stereo image."""
        if self.anonymous:
            return self.name
        words = self.name.split(".")
        return words[-2] if len(words) > 1 and words[-1] in _EYES else words[-1]

    @property
    def family(self) -> tuple[str, ...]:
        """The rest of the name, which all layers of one image have in common."""
        words = self.name.split(".")
        return tuple(words[:-2] + words[-1:]) if len(words) > 1 and words[-1] in _EYES else tuple(words[:-1])

    @property
    def is_color(self) -> bool:
        """Whether its first three channels are red, green and blue."""
        return set(self.components[:3]) in _COLORS


def layers_of(group: int, label: str, parts: Sequence[Part]) -> list[Layer]:
    """Group the channels of a file into layers.

    Args:
        group: index of the kind of file.
        label: file name without the number; it names the layer of a file whose channels have no layer name.
        parts: parts of the file.
    """
    found: list[Layer] = []
    for index, part in enumerate(parts):
        channels: dict[str, list[str]] = {}
        usable = [channel for channel in part.channels if channel not in part.integers]
        roots = {channel.lower() for channel in usable if "." not in channel}
        together = roots & set(_ORDER)
        if any(colors <= roots for colors in _COLORS):
            # Z beside R, G, B is a depth, not a third coordinate.
            together &= {"r", "g", "b", "a", "red", "green", "blue", "alpha"}
        elif not {"x", "y"} <= roots and not {"u", "v"} <= roots and roots != {"r", "g"}:
            together = set()
        for channel in usable:
            prefix, dot, _ = channel.rpartition(".")
            if not dot and channel.lower() not in together:
                prefix = _stem(channel, usable) or channel
            channels.setdefault(prefix, []).append(channel)
        for prefix, own in channels.items():
            single = own == [prefix]
            components = ["" if single else channel.removeprefix(prefix).removeprefix(".").lower() for channel in own]
            order = sorted(range(len(own)), key=lambda place: (_ORDER.get(components[place], 9), place))
            name = prefix.rstrip("_")
            if len(parts) > 1 and prefix and part.name.startswith(prefix):
                # Blender writes each eye to its own part, with the same channels: `ViewLayer.Combined-left`.
                eye = part.name.removeprefix(prefix).strip("-._ ")
                name = f"{prefix}.{eye}" if eye in _EYES else prefix
            elif part.name and len(parts) > 1 and not prefix.startswith(part.name):
                name = ".".join(filter(None, (part.name, prefix)))
            found.append(Layer(group, index, name, tuple(own[i] for i in order), tuple(components[i] for i in order)))
    # A file with one picture is named after its buffer: `albedo_0001.exr`.
    if len(parts) == 1 and len(found) == 1:
        (only,) = found
        picture = Layer(group, 0, label or only.name, only.channels, only.components, anonymous=True)
        says = recognise(picture)
        # `reference_0001.exr` is a reference, whatever the name of its only layer is.
        if not only.name or len(only.channels) == 1 or (says is not None and says[1] <= _ROOT_RANK):
            return [picture]
    return found


def _stem(channel: str, channels: Collection[str]) -> str:
    """The name of a channel without its last letter, if that alone tells it from the others of its layer.

    pbrt's `Nsx, Nsy, Nsz` are one layer, as `albedo_R, albedo_G, albedo_B` and `motion_x, motion_y` are; `dzdx, dzdy`
    are not.
    """
    stem, last = channel[:-1], channel[-1:]
    for letters in ("xyzw", "XYZW", "rgba", "RGBA"):
        least = 2 if stem.endswith("_") and "y" in letters.lower() else 3
        if last in letters and {stem + letter for letter in letters[:least]} <= {*channels}:
            return stem
    return ""


def read_files(
    path_of: Callable[[Layer], Path], layers: Iterable[Layer], rows: slice = slice(None)
) -> dict[Layer, Image]:
    """Read some rows of layers, opening each file once.

    Args:
        path_of: the file of a layer.
        layers: the layers.
        rows: contiguous rows of the data window.

    Raises:
        InputError: see :func:`mcdenoise.data.images.read_channels`.
    """
    layers = list(layers)
    files: defaultdict[Path, list[Layer]] = defaultdict(list)
    for layer in layers:
        files[path_of(layer)].append(layer)
    found: dict[Layer, Image] = {}
    for path, own in files.items():
        channels: defaultdict[int, dict[str, None]] = defaultdict(dict)
        for layer in own:
            channels[layer.part] |= dict.fromkeys(layer.channels)
        names = {part: [*each] for part, each in channels.items()}
        pixels = read_channels(path, names, rows)
        found |= {
            layer: pixels[layer.part][..., [names[layer.part].index(each) for each in layer.channels]] for layer in own
        }
    return {layer: found[layer] for layer in layers}


def is_luminance(layer: Layer) -> bool:
    """Whether a layer is a single channel with the name of a luminance, or of a color."""
    says = recognise(layer)
    named_so = bool({layer.title.lower(), *layer.components} & _LUMINANCE)
    return len(layer.channels) == 1 and (named_so or (says is not None and says[0] == "color"))


def recognise(layer: Layer) -> tuple[str, int] | None:
    """The buffer that a layer's name denotes and the rank of the name (0 is the best), or ``None``.

    The last words of the name decide: ``Main Layer.Denoising Albedo``, ``kitchen_albedo``, ``kitchenAlbedo``. A name
    that denotes a property of a buffer, such as ``albedo_variance``, is not that buffer.
    """
    if not layer.name:
        return ("color", _ROOT_RANK) if layer.is_color else None
    last = layer.title
    if layer.anonymous and _HALF.fullmatch(last, len(last) - 1):
        whole = recognise(replace(layer, name=last[:-1]))
        if whole is not None and whole[0] != "alpha":
            return whole[0], whole[1] + _HALF_RANK
    words = words_of(last)
    starts = [(words[start:], words[:start]) for start in range(len(words))]
    # A file name may also begin with the buffer.
    ends: list[tuple[list[str], list[str]]] = (
        [(words[:end], []) for end in range(len(words) - 1, 0, -1)] if layer.anonymous else []
    )
    for said, before in starts + ends:
        found = _RANKS.get("".join(said))
        # `albedoA` is not an alpha: a short name must be the whole word.
        if found is None or (
            len(said) < len(words) and len("".join(said)) < 3 and said[0] not in re.split(r"[^a-z0-9]+", last.lower())
        ):
            continue
        buffer, rank = found
        if _OTHERS & set(before) or (
            buffer == "variance" and any("".join(before[i:]) in _RANKS for i in range(len(before)))
        ):
            return None
        # The compositor's layer is not a direct output of the renderer.
        return buffer, rank + (buffer == "color" and layer.name.lower().startswith("composite"))
    if layer.anonymous and layer.is_color and not (_ABOUT | _OTHERS) & set(words):
        return "color", _ROOT_RANK + 1
    return None


def words_of(name: str) -> list[str]:
    """The words and numbers of a name, in lower case: ``shotDiffuse2`` has three."""
    return [word.lower() for word in _WORD.findall(name)]


def usual(layer: Layer) -> int:
    """Place of a layer among those of one rank; smaller for names that stand further ahead in :data:`NAMES`."""
    return _USUAL.get("".join(words_of(layer.title)), len(_USUAL))


def is_about_a_buffer(layer: Layer) -> bool:
    """Whether a layer's name denotes a property of a buffer other than the color, such as ``albedoVariance``."""
    words = words_of(layer.title)
    return bool(_ABOUT & set(words[-1:])) and any("".join(words[i:-1]) in _RANKS for i in range(len(words) - 1))


def fits(buffer: str, layer: Layer) -> bool:
    """Whether a layer has the channels of a buffer; a single channel may be stored as grey, and light as luminance."""
    count = len(layer.channels)
    if BUFFERS[buffer].channels == 1:
        # Falcor's depth has its derivative as a second channel.
        return count <= 2 or layer.is_color
    if buffer == "motion":
        return count in (2, 3, 4)
    return count in (3, 4) or (count == 1 and buffer in GREY)


def named(layers: Sequence[Layer], text: str) -> list[Layer]:
    """Find layers by the user's text.

    The text is a name with or without its view layer and its channels; or a list of channels, separated by commas.

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
