"""Assignment of layers to buffers: by name, by the user's mapping, or else by values."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from mcdenoise.data.camera_path import Array
from mcdenoise.data.images import Image
from mcdenoise.data.readers.cameras import fit_camera
from mcdenoise.data.readers.layers import NAMES, Layer, fits, is_about_a_buffer, is_luminance, named, recognise, usual
from mcdenoise.data.readers.values import is_direction
from mcdenoise.errors import InputError
from mcdenoise.frame import BUFFERS

# Buffers to which the user may map a layer.
MAPPABLE = sorted(set(BUFFERS) - {"current", "recent", "length"})
_ALL, _LOWEST = slice(None), slice(-16, None)
# Rec. 709 to XYZ (ITU-R BT.709), and the largest difference of a converted color relative to the light of a pixel.
_TO_XYZ = np.array([[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]])
_SAME_COLOR = 2e-3
# Largest median difference of a depth from that of the positions, relative to it.
_SAME_DEPTH = 0.01
# Names that are longer than a single letter.
_WORDS = re.compile(r"[^\W_]{2}")


@dataclass
class Choice:
    """The selected layers of a frame.

    Args:
        layers: selected layer by buffer.
        reasons: reason by buffer, if the layer was not selected by its name.
        written: the layers that the result replaces: usually that of the color, and layers equal to it.
        converted: those of them that hold the color in another color space, and the matrix ``(C, 3)`` to that.
        unused: layers that look like buffers but are not used.
        unknown: layers with unknown names.
        warnings: doubtful choices, one line each.
    """

    layers: dict[str, Layer] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)
    written: list[Layer] = field(default_factory=list)
    converted: dict[Layer, Array] = field(default_factory=dict)
    unused: list[Layer] = field(default_factory=list)
    unknown: list[Layer] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)


# Reads some rows of layers in the first frame.
Read: TypeAlias = Callable[[Sequence[Layer], slice], Mapping[Layer, Image]]


def choose(where: str, layers: Sequence[Layer], mapping: Mapping[str, str], read: Read) -> Choice:
    """Select a layer for each buffer.

    Args:
        where: description of the files, for messages.
        layers: all layers of a frame.
        mapping: the user's names of layers by buffer; an empty name stands for no layer.
        read: reads pixels if names do not tell.

    Raises:
        InputError: there is no color or more than one candidate, or a requested layer does not exist.
    """
    choice = Choice()
    candidates: dict[str, list[tuple[int, Layer]]] = {buffer: [] for buffer in NAMES}
    unnamed: list[Layer] = []
    for layer in layers:
        found = recognise(layer)
        # A single channel is a color only if there is no other.
        if found is not None and fits(found[0], layer) and not (found[0] == "color" and len(layer.channels) == 1):
            candidates[found[0]].append((found[1], layer))
        else:
            unnamed.append(layer)
    if not candidates["color"]:
        # The name of a shot may be a letter, as in a_0001.exr or [n].hdr, which is a buffer's name elsewhere.
        for ranked in candidates.values():
            unnamed += [layer for _, layer in ranked if _is_letter(layer)]
            ranked[:] = [(rank, layer) for rank, layer in ranked if not _is_letter(layer)]
    for buffer, text in mapping.items():
        if text:
            choice.layers[buffer] = _mapped(where, layers, buffer, text)
            choice.reasons[buffer] = "as asked for"
    if not candidates["color"] and "color" not in mapping and len(references := candidates["reference"]) == 1:
        # A single layer is an ordinary picture.
        candidates["color"], candidates["reference"] = references, []
    color = choice.layers.get("color") or _color(where, candidates["color"], unnamed, layers)
    choice.layers["color"] = color
    # Positions may tell which depth is right.
    for buffer in sorted(NAMES, key=lambda name: name == "depth"):
        if buffer not in choice.layers and buffer not in mapping:
            _choose_best(choice, buffer, candidates[buffer], read)
    own = [layer for layer in unnamed if not color.family or layer.family == color.family]
    _by_values(choice, own, mapping, read)
    # Both a denoised and a noisy layer exist: read the noisy one, and write the result to the denoised one.
    finished = [layer for rank, layer in candidates["color"] if layer.family == color.family and rank == 1]
    choice.written = [color]
    if (0, color) in candidates["color"] and len(finished) == 1:
        choice.written = finished
        choice.reasons["color"] = f"not denoised yet; '{finished[0]}' has been, and gets the result"
    elif twins := _twins(color, own, read):
        choice.written += twins
        choice.reasons["color"] = f"the same as {', '.join(map(str, twins))}, which gets the result too"
    choice.converted = _conversions(color, own, read)
    choice.written += choice.converted
    used = {*choice.layers.values(), *choice.written}
    known = [layer for own in candidates.values() for _, layer in own]
    choice.unused = [layer for layer in [*known, *filter(is_about_a_buffer, unnamed)] if layer not in used]
    choice.unknown = [layer for layer in unnamed if layer not in used and layer not in choice.unused]
    return choice


def parse_mapping(texts: Sequence[str]) -> dict[str, str]:
    """Parse ``--map`` options, such as ``albedo=RGBA.diff``; ``motion=`` stands for no layer.

    Raises:
        InputError: an option has another form.
    """
    mapping: dict[str, str] = {}
    for text in texts:
        buffer, equals, layer = (part.strip() for part in text.partition("="))
        if not equals or buffer not in MAPPABLE or buffer in mapping:
            raise InputError(f"--map: expected BUFFER=LAYER with a buffer of {', '.join(MAPPABLE)}, found {text!r}")
        if buffer == "color" and not layer:
            raise InputError("--map: expected a layer for 'color', found none; no frame can do without")
        mapping[buffer] = layer
    return mapping


def _is_letter(layer: Layer) -> bool:
    return layer.anonymous and (layer.is_color or len(layer.channels) == 1) and _WORDS.search(layer.name) is None


def _mapped(where: str, layers: Sequence[Layer], buffer: str, text: str) -> Layer:
    found = named(layers, text)
    if len(found) != 1:
        names = ", ".join(str(layer) for layer in (found or layers)[:24])
        raise InputError(
            f"{where}: expected one layer for --map {buffer}={text}, found {'several' if found else 'none'}; "
            f"{'they are' if found else 'there are'} {names}"
        )
    if not fits(buffer, found[0]):
        raise InputError(
            f"{where}: expected {BUFFERS[buffer].channels} channels for --map {buffer}={text}, "
            f"found {len(found[0].channels)}; choose another layer"
        )
    return found[0]


def _color(
    where: str, candidates: Sequence[tuple[int, Layer]], unnamed: Sequence[Layer], layers: Sequence[Layer]
) -> Layer:
    if not candidates:
        # A single picture of unknown name is the noisy color.
        pictures = [layer for layer in unnamed if layer.is_color]
        single = [layer for layer in unnamed if layer.components in (("",), ("v",)) or is_luminance(layer)]
        for own in (pictures, [layer for layer in single if is_luminance(layer)], single):
            if len(own) == 1 and (own is pictures or not pictures):
                return own[0]
        found = ", ".join(str(layer) for layer in dict.fromkeys([*pictures, *layers][:12])) or "no layers of floats"
        raise InputError(
            f"{where}: expected noisy radiance, found {found}; give its file too, or name it with --map color=LAYER"
        )
    least = min(rank for rank, _ in candidates)
    best = [layer for rank, layer in candidates if rank == least]
    if len(best) > 1:
        alike = len({str(layer) for layer in best}) < len(best)
        ways = [] if alike else [f"choose with --map color={best[0].name or best[0]}"]
        ways += ["give only the files of one shot"] if len({layer.group for layer in best}) > 1 else []
        found = ", ".join(layer.place for layer in best[:8])
        raise InputError(f"{where}: expected one layer of noisy radiance, found {found}; {', or '.join(ways)}")
    return best[0]


def _choose_best(choice: Choice, buffer: str, candidates: Sequence[tuple[int, Layer]], read: Read) -> None:
    """Choose the preferred layer of the same image as the color; one in a separate file may belong to any image.

    Of layers with equally good names, the positions tell the right one, or all of them hold the same; otherwise it is
    the usual one, with a warning.
    """
    color = choice.layers["color"]
    own = [(rank, layer) for rank, layer in candidates if layer.family == color.family or layer.anonymous] or (
        list(candidates) if color.anonymous or not color.family else []
    )
    best = [layer for rank, layer in own if rank == min(rank for rank, _ in own)]
    best.sort(key=usual)
    if not best:
        return
    if len(best) > 1:
        images = [*read(best, _ALL).values()]
        ranks = [_rank_by_points(choice, buffer, image, read) for image in images]
        right = [layer for layer, rank in zip(best, ranks, strict=True) if rank == min(ranks)]
        alike = all(np.array_equal(image, images[0], equal_nan=True) for image in images)
        names = ", ".join(layer.place for layer in best[:8])
        if len(right) == 1:
            best = right
            choice.reasons[buffer] = f"of {names} the one that fits a camera at the positions"
        elif alike:
            choice.reasons[buffer] = f"the same in {names}"
        else:
            choice.reasons[buffer] = f"the usual one of {names}"
            choice.warnings.append(
                f"'{buffer}': read from {best[0]}, though {', '.join(map(str, best[1:8]))} may be meant as well; "
                f"choose with --map {buffer}={best[1].name or best[1]}"
            )
    choice.layers[buffer] = best[0]


def _rank_by_points(choice: Choice, buffer: str, image: Image, read: Read) -> int:
    """0 for positions that a camera sees at their pixels and a depth along its axis, 1 for a distance, 2 for others."""
    if buffer != "position" and (buffer != "depth" or "position" not in choice.layers):
        return 2
    position = image[..., :3]
    if buffer == "depth":
        layer = choice.layers["position"]
        position = read([layer], _ALL)[layer][..., :3]
    if position.shape[:2] != image.shape[:2]:
        return 2
    hit = np.isfinite(position).all(-1) & (position != 0).any(-1)
    camera = fit_camera(position, hit)
    if buffer == "position" or camera is None:
        return 0 if camera is not None else 2
    points = np.where(hit[..., None], position, 0)
    along = points @ camera.matrix[:3, 3] + camera.matrix[3, 3]
    away = np.linalg.norm(points - camera.eye, axis=-1)
    off = [float(np.median(np.abs(image[hit, 0] - each[hit]) / np.abs(each[hit]))) for each in (along, away)]
    return next((rank for rank, each in enumerate(off) if each < _SAME_DEPTH), 2)


def _twins(color: Layer, unnamed: Sequence[Layer], read: Read) -> list[Layer]:
    """Layers equal to the color: Mitsuba writes the color of a nested integrator twice."""
    place = (color.group, color.part)
    others = [each for each in unnamed if each.is_color and each != color and (each.group, each.part) == place]
    # Compare a few rows first, since every read decompresses all layers of these rows.
    for rows in (_LOWEST, _ALL):
        pixels = {layer: image[..., :3] for layer, image in (read([color, *others], rows) if others else {}).items()}
        others = [each for each in others if np.array_equal(pixels[each], pixels[color], equal_nan=True)]
    return others


def _conversions(color: Layer, unnamed: Sequence[Layer], read: Read) -> dict[Layer, Array]:
    """Layers with the color as XYZ or luminance, as Mitsuba's films write it beside the RGB of a nested integrator."""
    own = [layer for layer in unnamed if (layer.group, layer.part) == (color.group, color.part)]
    matrices = {
        layer: _TO_XYZ if len(layer.channels) > 1 else _TO_XYZ[1:2]
        for layer in own
        if layer.components[:3] == ("x", "y", "z") or is_luminance(layer)
    }
    if not matrices or not color.is_color:
        return {}
    pixels = read([color, *matrices], _ALL)
    light = pixels[color][..., :3]
    with np.errstate(invalid="ignore", over="ignore"):
        expected = {layer: light @ matrix.T for layer, matrix in matrices.items()}
        off = {layer: np.abs(pixels[layer][..., :3] - each) for layer, each in expected.items()}
        near = {layer: each <= _SAME_COLOR * np.abs(light).sum(-1, keepdims=True) for layer, each in off.items()}
    return {layer: matrices[layer] for layer, each in near.items() if light.any() and each.mean() > 1 - _SAME_COLOR}


def _by_values(choice: Choice, unnamed: Sequence[Layer], mapping: Mapping[str, str], read: Read) -> None:
    """Recognise layers with unknown names, such as Mitsuba's: depths end in T, normals have unit length."""
    depths = [layer for layer in unnamed if layer.components == ("t",)]
    directions: list[Layer] = []
    points: list[Layer] = []
    named_already = {"normal", "position"} <= {*choice.layers, *mapping}
    triples = [] if named_already else [each for each in unnamed if each.components == ("x", "y", "z")]
    for layer, vectors in read(triples, _ALL).items():
        if is_direction(vectors):
            directions.append(layer)
        elif fit_camera(vectors, (vectors != 0).any(-1)) is not None:
            points.append(layer)
    for buffer, found, why in (
        ("depth", depths, "by its component T"),
        ("normal", directions, "by its values: vectors of unit length"),
        ("position", points, "by its values: coordinates that a camera sees at their pixels"),
    ):
        if buffer not in choice.layers and buffer not in mapping and len(found) == 1:
            choice.layers[buffer] = found[0]
            choice.reasons[buffer] = why
