"""Determining the contents of a shot's files by names and headers, and by the values of the first frames."""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
import torch
from torch import Tensor

from mcdenoise.data.camera_matrices import MATRICES, Array, find_camera_matrices
from mcdenoise.data.exr import Image, Mask, Metadata
from mcdenoise.data.images import ImageHeader, Part, Window, read_channels, read_image_header
from mcdenoise.data.readers.cameras import FittedCamera, fault, fit_camera
from mcdenoise.data.readers.choice import Choice, choose
from mcdenoise.data.readers.diffuse_specular import (
    DIFFUSE,
    EMISSION,
    SPECULAR,
    SPECULAR_ALBEDO,
    Split,
    adds_up,
    find_splits,
)
from mcdenoise.data.readers.files import RenderedFiles, hit, seen_of, world_to_camera
from mcdenoise.data.readers.layers import Layer, layers_of, recognise
from mcdenoise.data.readers.lights import ALL, WHOLE, find_lights, is_light
from mcdenoise.data.readers.names import FileGroup, files_beside, pattern_of
from mcdenoise.data.readers.samples import SampleLayers, mean_is, split_samples
from mcdenoise.data.readers.transfer import decode
from mcdenoise.data.readers.values import Row, normal_is_encoded, nothing_hit, read_radiance
from mcdenoise.errors import InputError
from mcdenoise.motion import MOTION_PAIRS, USUAL_MOTION, Convention, motion_to, read_as, read_motion
from mcdenoise.noise import noise_is_spread

# Color spaces of images that the user may state.
ColorSpace: TypeAlias = Literal["auto", "linear", "srgb"]
# Motion conventions known by layer name: Blender's points to the previous frame, in pixels, y up.
_MOTION = {"vector": Convention(1, -1, "previous - current, y up, pixels")}
# Strips of rows, and the columns in them, in which layers are compared with the color.
_STRIPS, _STRIP, _COLUMNS = 8, 8, 128
# Features that make most methods better, of which a frame has at least one where there are any.
_FEATURES = {"albedo", "normal", "depth"}
# Smallest motion in pixels that shows a moving camera.
_MOVED = 0.3
# Largest distance of a camera from the origin, relative to the distance of visible points, in camera space.
_ORIGIN = 1e-2


def open_files(
    groups: Sequence[FileGroup],
    choose_numbers: Callable[[list[int]], list[int]],
    *,
    where: str,
    mapping: Mapping[str, str],
    color_has_albedo: bool | None = None,
    lights: Sequence[str] = (),
    color_space: ColorSpace = "auto",
) -> RenderedFiles:
    """Open the files of a shot: determine their contents by names, headers, and values of the first frames.

    Args:
        groups: kinds of files.
        choose_numbers: selects the frames to use.
        where: description of the files, for messages.
        mapping: see :func:`mcdenoise.data.readers.choice.choose`.
        color_has_albedo: whether the radiance includes the albedo; by default determined from the values.
        lights: names of additive layers of radiance that are denoised with the color.
        color_space: that of images other than EXR; by default what the files say.

    Raises:
        InputError: the files cannot be recognised, do not match one another, or cannot be read.
    """
    headers = [read_image_header(next(iter(group.files.values()))) for group in groups]
    layers = [
        replace(layer, files=pattern_of(group))
        for i, (group, header) in enumerate(zip(groups, headers, strict=True))
        for layer in layers_of(i, group.label, header.parts)
    ]

    def read_first(layer: Layer, rows: slice) -> Image:
        path = next(iter(groups[layer.group].files.values()))
        return read_channels(path, {layer.part: layer.channels}, rows)[layer.part]

    samples, layers = split_samples(layers)
    choice = choose(where, layers, mapping, read_first)
    color = choice.layers["color"]
    splits = _splits(layers, choice, mapping)
    numbers = choose_numbers(sorted(groups[color.group].files))
    shot = RenderedFiles(
        groups, [_parts(header, color_space) for header in headers], numbers, choice, {}, warnings=choice.warnings
    )
    _check(shot)
    found, left = find_lights(where, layers, color, lights, lambda wanted: _some_pixels(shot, wanted))
    folder = shot.file(color, numbers[0]).parent
    shot = replace(shot, lights=found, cameras=find_camera_matrices(folder, numbers[-1]))
    _look(shot, color_has_albedo)
    if left is not None:
        _look_at_lights(shot, left, chosen=ALL not in lights)
    if shot.color_has_albedo:
        _look_at_parts(shot, splits)
    if samples is not None:
        _look_at_samples(shot, samples)
    if not _FEATURES & {*choice.layers, *mapping}:
        _look_beside(shot)
    return shot


def _parts(header: ImageHeader, color_space: ColorSpace) -> tuple[Part, ...]:
    """The parts of a file, in another color space if that is stated."""
    if header.format == "openexr" or color_space == "auto":
        return header.parts
    return tuple(replace(part, display_referred=color_space == "srgb", gamma=0.0) for part in header.parts)


@dataclass(frozen=True)
class Result:
    """The radiance in one file: the denoised one, if there is also a noisy one.

    Args:
        path: the file.
        layer: layer of the radiance.
        window: its data window.
    """

    path: Path
    layer: Layer
    window: Window

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.window.size

    def read(self, window: Window | None = None) -> tuple[Tensor, Metadata]:
        """Read ``(1, 3, H, W)`` radiance, thrice the same from one channel, and the attributes of the file.

        Args:
            window: what to read instead of the data window; 0 where that has no pixels.

        Raises:
            InputError: the file is damaged.
        """
        pixels = read_channels(self.path, {self.layer.part: self.layer.channels[:3]})[self.layer.part]
        pixels = np.repeat(pixels, 3, -1) if pixels.shape[2] == 1 else pixels
        pixels = pixels if window is None else window.of(pixels, self.window)
        image = torch.from_numpy(pixels).permute(2, 0, 1)[None].contiguous()
        return image, read_image_header(self.path).metadata


def open_result(path: Path) -> Result:
    """Find the radiance in a denoiser's output file, which may have other layers.

    Raises:
        InputError: the file cannot be read, or its radiance cannot be determined.
    """
    parts = read_image_header(path).parts
    layers = layers_of(0, "", parts)

    def read(layer: Layer, rows: slice) -> Image:
        return read_channels(path, {layer.part: layer.channels}, rows)[layer.part]

    chosen = choose(str(path), layers, {}, read)
    (layer, *_) = chosen.written
    return Result(path, layer, parts[layer.part].window)


def _check(shot: RenderedFiles) -> None:
    """Check that every frame has every buffer, in the same display window; join data windows that differ."""
    color = shot.choice.layers["color"]
    main = shot.part(color)
    for name, layer in sorted(shot.choice.layers.items()):
        files = shot.groups[layer.group].files
        missing = [number for number in shot.numbers if number not in files]
        if missing and name != "reference":
            raise InputError(
                f"{pattern_of(shot.groups[layer.group])}: expected buffer '{name}' for every frame, found none for "
                f"frame {missing[0]}; render it, or leave the buffer out with --map {name}="
            )
        part = shot.part(layer)
        if part.window != main.window and part.display != main.display:
            raise InputError(
                f"{next(iter(files.values()))}: expected '{name}' in the pixels of the color "
                f"({_window(main)}), found {_window(part)}; render all layers in one window, or leave this one "
                f"out with --map {name}="
            )
    layers = {*shot.choice.layers.values(), *shot.choice.written}
    windows: list[Window] = []
    written: list[Window] = []
    kept = {color, *shot.choice.written}
    for group, own in enumerate(shot.groups):
        used = [layer for layer in layers if layer.group == group]
        for number in shot.numbers if used else []:
            if number in own.files:
                header = read_image_header(own.files[number])
                _check_header(own.files[number], header, used, main)
                windows += (header.parts[layer.part].window for layer in used)
                written += (header.parts[layer.part].window for layer in used if layer in kept)
    if len(set(windows)) > 1:
        shot.window = functools.reduce(Window.joined, written)
    reference = shot.choice.layers.get("reference", color)
    for number in shot.reference_numbers:
        if shot.window_of(reference, number) != shot.window_of(color, number):
            raise InputError(
                f"{shot.file(reference, number)}: expected a reference in the data window of the color, found another; "
                "render it so, or leave it out with --map reference="
            )


def _check_header(path: Path, header: ImageHeader, layers: Sequence[Layer], main: Part) -> None:
    for layer in layers:
        found = header.parts[layer.part].channels if layer.part < len(header.parts) else ()
        if absent := [channel for channel in layer.channels if channel not in found]:
            raise InputError(
                f"{path}: expected channel '{absent[0]}', as the first file has it, found {', '.join(found[:8])}; "
                "render all frames with the same layers"
            )
        part = header.parts[layer.part]
        if part.window != main.window and part.display != main.display:
            raise InputError(
                f"{path}: expected {_window(main)} like the first color file, found {_window(part)}; render all "
                "buffers and frames at one size, or crop them in one display window"
            )


def _window(part: Part) -> str:
    (height, width), (top, left) = part.size, part.origin
    return f"{width} x {height} pixels" + (f" at {left}, {top}" if (top, left) != (0, 0) else "")


def _look_beside(shot: RenderedFiles) -> None:
    """Warn if files beside the color, which were not given, have names of features of the same frame."""
    color = shot.file(shot.choice.layers["color"], shot.numbers[0])
    given = {path for group in shot.groups for path in group.files.values()}
    found = []
    for label, path in files_beside(color).items():
        denoted = recognise(Layer(0, 0, label, ("R", "G", "B"), ("r", "g", "b"), anonymous=True))
        if path not in given and denoted is not None and denoted[0] in _FEATURES:
            found.append(path.name)
    if found:
        shot.warnings.append(
            f"{color.name}: read without {', '.join(sorted(found))} beside it, which look like features of the same "
            "frame; give these files too, or a pattern or folder with all of them"
        )


def _look(shot: RenderedFiles, color_has_albedo: bool | None) -> None:
    """Read the first frame, and the next ones if there is motion, and determine the meaning of their values."""
    number, chosen = shot.numbers[0], dict(shot.choice.layers)
    images = shot.read(
        number,
        {n: each for n, each in shot.choice.layers.items() if n != "reference" or number in shot.reference_numbers},
    )
    readings = {name: [shot.choice.reasons[name]] if name in shot.choice.reasons else [] for name in images}
    _look_at_color(shot, images, readings["color"], color_has_albedo)
    if "albedo" in images:
        above = float((np.nan_to_num(images["albedo"]) > 1).any(-1).mean())
        readings["albedo"].append(f"{above:.1%} of the pixels above 1, clamped" if above else "0 to 1")
    if "normal" in images:
        shot.encoded_normals = normal_is_encoded(images["normal"])
        readings["normal"].append("stored as n/2 + 1/2, decoded" if shot.encoded_normals else "signed")
        length = np.linalg.norm(
            np.nan_to_num(images["normal"]) * (2 if shot.encoded_normals else 1) - shot.encoded_normals, axis=-1
        )
        if not 0.5 < np.median(length[length > 0.05] if (length > 0.05).any() else [1.0]) < 1.5:
            shot.warnings.append("'normal': most have no unit length; is it a normal? leave it out with --map normal=")
    if "depth" in images:
        far = nothing_hit(images["depth"])
        what = (
            "background: none"
            if not far.any()
            else f"background: {far.mean():.0%}, {_span(images['depth'][far])}, read as infinity"
        )
        readings["depth"].append(what)
    if "position" in images:
        _look_at_positions(shot, images, readings)
    elif shot.cameras is not None:
        readings["view_projection"] = ["no positions to check it with"]
    if "motion" in images:
        shot.motion, said = _motion(shot, images)
        readings["motion"].append(said)
    for name, words in readings.items():
        layer = chosen.get(name)
        source = layer.place if layer else MATRICES if shot.cameras else "the positions"
        shot.table.append(Row(name, source, "; ".join(words)))
    for light in shot.lights.values():
        layer, *colors = light.layers
        shot.table.append(Row("layer", layer.place, f"times {colors[0]}" if colors else "light"))


def _as_tensor(image: Image) -> Tensor:
    """``(1, C, H, W)``, which shares the memory."""
    return torch.from_numpy(image).permute(2, 0, 1)[None]


def _look_at_color(shot: RenderedFiles, images: Mapping[str, Image], words: list[str], stated: bool | None) -> None:
    if shot.part(shot.choice.layers["color"]).display_referred:
        words.append("display values, made linear")
        shot.warnings.append(
            "'color': 8 or 16 bits of display values: what was brighter than white is lost; render floats, or say "
            "--input-linear if its numbers are linear"
        )
    albedo = np.clip(np.nan_to_num(images["albedo"]), 0, 1) if "albedo" in images else None
    color = np.nan_to_num(images["color"][..., :3])
    features = {"albedo": albedo, "normal": np.nan_to_num(images["normal"]) if "normal" in images else None}
    given = {name: None if image is None else _as_tensor(image) for name, image in features.items()}
    if noise_is_spread(_as_tensor(color), **given):
        shot.warnings.append(
            "'color': neighbouring pixels share noise, since the film's filter counts each sample in several of them, "
            "as Mitsuba's default does; many denoisers leave such noise in, OIDN most: render with a box filter, or "
            "use the model oidn_temporal"
        )
    if albedo is None:
        words.append("radiance")
        return
    reference = images["reference"][..., :3] if "reference" in images else None
    shot.color_has_albedo, said, warning = read_radiance(images["color"][..., :3], albedo, reference, stated)
    words.append(said)
    shot.warnings += warning


def _look_at_positions(shot: RenderedFiles, images: dict[str, Image], readings: dict[str, list[str]]) -> None:
    position = images["position"]
    known = hit(images, seen_of(images))
    words = readings.setdefault("view_projection", [])
    if shot.cameras is not None:
        stated = shot.cameras.view_projection(shot.numbers[0], shot.size)
        shot.camera_convention, error = read_as(stated, position, known)
        if shot.camera_convention != "unknown":
            shot.has_camera = True
            how = shot.camera_convention or "row vectors, y down"
            words.append(f"{how}: positions are seen {error:.2g} pixels from their own")
            if shot.camera_convention:
                shot.warnings.append(f"{MATRICES}: read as {how}, since only so it sees the positions at their pixels")
            return
        seen = f"does not see the positions at their pixels (they miss by {error:.0f}) whichever way it is read"
        shot.warnings.append(
            f"{MATRICES}, frame {shot.numbers[0]}: {fault(stated) or seen}; cameras are found from the "
            "positions instead"
        )
        shot.cameras = None
    found = fit_camera(position, known)
    if found is None:
        words.append("the positions do not tell a camera")
        readings["position"].append("not used without a camera")
        readings.pop("view_projection")
        shot.drops_positions = True
        if len(shot.numbers) > 1:
            shot.warnings.append(
                f"'position': no pinhole camera sees them at their pixels, and there is no {MATRICES}: not used; write "
                "that file, or motion"
            )
    elif not shot.positions_of_camera and _is_origin(found, position, known) and _ends_at_origin(shot):
        if world_to_camera(shot.metadata(shot.numbers[0])) is not None:
            shot.positions_of_camera = True
            images["position"] = shot.in_world(shot.numbers[0], images["position"])
            readings["position"].append("in the space of the camera, brought to the world by 'worldToCamera'")
            _look_at_positions(shot, images, readings)
            return
        # The previous positions of points are unknown.
        shot.drops_positions, shot.has_camera = True, "depth" not in images
        readings["position"].append("in the space of the camera: only its depth is used")
        readings.pop("view_projection")
    else:
        shot.has_camera = True
        words.append(f"found from the positions, which it sees {found.error:.2g} pixels from their own")


def _is_origin(camera: FittedCamera, position: Image, known: Mask) -> bool:
    """Whether a camera fitted to positions is at their origin."""
    distance = np.linalg.norm(position[known], axis=-1)
    return bool(np.linalg.norm(camera.eye) < _ORIGIN * np.median(distance))


def _ends_at_origin(shot: RenderedFiles) -> bool:
    """Whether the last frame's camera is also at the origin: one that moves in the world may have begun there."""
    layers = {name: each for name, each in shot.choice.layers.items() if name in ("position", "depth")}
    images = shot.read(shot.numbers[-1], layers)
    known = hit(images, seen_of(images))
    found = fit_camera(images["position"], known)
    return found is not None and _is_origin(found, images["position"], known)


def _motion(shot: RenderedFiles, first: Mapping[str, Image]) -> tuple[Convention, str]:
    """Determine the convention of the motion by comparing consecutive frames; motion that is all zero is removed.

    Args:
        shot: the files.
        first: all images of its first frame.
    """
    layer = shot.choice.layers["motion"]
    given = _MOTION.get(layer.title.lower(), USUAL_MOTION)
    kept = {"albedo", "normal"} & set(shot.choice.layers) or {"color"}
    pairs, seen_elsewhere = [], []
    following = [(a, b) for a, b in pairwise(shot.numbers) if b == a + 1][:MOTION_PAIRS]
    names = kept | {"motion"} | ({"position", "depth"} & set(shot.choice.layers))
    wanted = {name: shot.choice.layers[name] for name in names}
    last, images = shot.numbers[0], first
    for before, now in following:
        previous = images if last == before else shot.read(before, wanted)
        last, images = now, shot.read(now, wanted)
        elsewhere = _seen_elsewhere(shot, (before, previous), (now, images))
        if elsewhere is not None:
            seen_elsewhere.append((images["motion"], elsewhere))
        features, earlier = (
            {name: np.clip(np.nan_to_num(each[name][..., :3]), -1, 1) for name in kept} for each in (images, previous)
        )
        pairs.append((features, earlier, images["motion"]))
    moved = any(np.nanmedian(np.linalg.norm(seen, axis=-1)) > _MOVED for _, seen in seen_elsewhere)
    if moved and not any(given.moves(motion, 0) for *_, motion in pairs):
        del shot.choice.layers["motion"]
        shot.warnings.append(
            "'motion': all zeros although the camera moves, as Blender writes it with motion blur; positions are used "
            "instead"
        )
        return given, "all zeros: not used"
    chosen, words, warnings = read_motion(pairs, given, seen_elsewhere)
    shot.warnings += warnings
    if chosen is None:
        del shot.choice.layers["motion"]
    return chosen or given, words


def _seen_elsewhere(
    shot: RenderedFiles, before: tuple[int, Mapping[str, Image]], now: tuple[int, Mapping[str, Image]]
) -> Array | None:
    """Pixels from each point of a frame to its projection by the previous frame's camera, if both are known."""
    if not shot.has_camera:
        return None
    matrix, known = shot.camera(*before, seen_of(before[1])), hit(now[1], seen_of(now[1]))
    if matrix is None or not known.any():
        return None
    return motion_to(matrix, now[1]["position"], known)


def _some_pixels(shot: RenderedFiles, layers: Sequence[Layer]) -> dict[Layer, Image]:
    """``(N, 3)`` the same pixels of layers of the first frame, of those with the data window of the color."""
    color, number = shot.choice.layers["color"], shot.numbers[0]
    main = shot.part(color)
    height, width = main.size
    same = [each for each in layers if shot.part(each).window == main.window]
    wanted = list(dict.fromkeys(layer for layer in same if number in shot.groups[layer.group].files))
    found: dict[Layer, list[Image]] = {layer: [] for layer in wanted}
    for top in np.linspace(0, max(0, height - _STRIP), _STRIPS).astype(int):
        for key in {(layer.group, layer.part) for layer in wanted}:
            own = [layer for layer in wanted if (layer.group, layer.part) == key]
            channels = [channel for layer in own for channel in layer.channels[:3]]
            rows = slice(int(top), int(top) + _STRIP)
            pixels = read_channels(shot.file(own[0], number), {key[1]: channels}, rows)[key[1]]
            for place, layer in enumerate(own):
                image = pixels[:, :: max(1, width // _COLUMNS), 3 * place : 3 * place + 3].reshape(-1, 3)
                found[layer].append(
                    decode(image, shot.part(layer).gamma) if shot.part(layer).display_referred else image
                )
    return {layer: np.concatenate(strips) for layer, strips in found.items() if strips}


def _look_at_lights(shot: RenderedFiles, left: float, *, chosen: bool) -> None:
    """Say how far the layers of light add up to the color; warn if they do not, unless the user has chosen them."""
    names = list(shot.lights)
    if left <= WHOLE:
        shot.table.append(Row("layers", f"all {len(names)}", "they add up to the color"))
        return
    shot.table.append(Row("layers", f"all {len(names)}", f"{left:.1%} of the light is in none: the remainder"))
    if not chosen:
        others = [layer.place for layer in shot.choice.unknown if layer.is_color and not is_light(layer)]
        shot.warnings.append(
            f"--layers all: {', '.join(names)} add up to the color but for {left:.1%} of its light, which stays in the "
            "image alone; write the missing layers, too"
            + (f", or name them, if they are among {', '.join(others[:8])}" if others else "")
        )


def _splits(layers: Sequence[Layer], choice: Choice, mapping: Mapping[str, str]) -> list[Split]:
    """Candidates for diffuse and specular light, unless the user has excluded them."""
    if "" in {mapping.get(DIFFUSE), mapping.get(SPECULAR)}:
        return []
    asked = {name: choice.layers[name] for name in mapping if name in choice.layers}
    if {DIFFUSE, SPECULAR} <= asked.keys():
        # These layers are read as parts only.
        for name in {DIFFUSE, SPECULAR, EMISSION, SPECULAR_ALBEDO} & asked.keys():
            del choice.layers[name]
    return find_splits(layers, choice.layers["color"], asked)


def _look_at_parts(shot: RenderedFiles, splits: Sequence[Split]) -> None:
    """Use the first candidate that adds up to the color of the first frame and exists in all frames."""
    number, color = shot.numbers[0], shot.choice.layers["color"]
    refused = []
    for split in (each for each in splits if _is_everywhere(shot, each.layers.values())):
        read = shot.read(number, {**split.layers, "color": color})
        sums = split.sums(read)
        off = split.off(sums, read["color"][..., :3])
        if not adds_up(off):
            refused.append((split, off))
            split = split.without_strangers(read, read["color"][..., :3])
            sums = split.sums(shot.read(number, split.layers))
            if not adds_up(split.off(sums, read["color"][..., :3])):
                continue
        shot.split = split
        total = sum(float(np.nansum(each)) for each in sums.values())
        for name, lights in split.parts.items():
            own = [layer.layers[0] for layer in lights]
            place = ", ".join(
                [own[0].place, *(each.title if each.files == own[0].files else each.place for each in own[1:])]
            )
            colors = list(dict.fromkeys(each.title for light in lights for each in light.layers[1:]))
            fraction = float(np.nansum(sums[name])) / (total or 1)
            said = f"{fraction:.0%} of the light; the parts add up to the color"
            shot.table.append(Row(name, place, f"times {', '.join(colors)}; {said}" if colors else said))
        if split.specular_albedo is not None:
            shot.table.append(Row(SPECULAR_ALBEDO, split.specular_albedo.place, "clamped to 0 to 1"))
        return
    if refused:
        split, (far, light) = refused[0]
        found = ", ".join(layer.title for own in split.parts.values() for each in own for layer in each.layers[:1])
        why = f"render {', '.join(split.absent)}, too, where the scene has such light" if split.absent else ""
        why = why or "they are of another image, or stored with loss (DWA), or the color has been denoised"
        shot.warnings.append(
            f"'diffuse', 'specular': {found} have {light:.1%} of the light of the color and differ from it in "
            f"{far:.0%} of the pixels: not used; {why}"
        )


def _look_at_samples(shot: RenderedFiles, samples: SampleLayers) -> None:
    """Use samples that exist in all frames and whose mean is the color in the first one."""
    number, color = shot.numbers[0], shot.choice.layers["color"]
    if not _is_everywhere(shot, samples.layers.values()):
        shot.warnings.append("'samples': some frames have others, or of other pixels, or none: not used")
        return
    read = shot.read(number, {**samples.layers, "color": color})
    if not mean_is(read["color"][..., :3], samples.samples(read)):
        shot.warnings.append(
            f"'samples': the mean of {len(samples.radiance)} is not the color: not used; write all samples of a pixel, "
            "with the weights of the pixel filter in them"
        )
        return
    shot.samples = samples
    first = samples.radiance[0]
    shot.table.append(Row("samples", f"{first.place} and on", str(samples)))


def _is_everywhere(shot: RenderedFiles, layers: Collection[Layer]) -> bool:
    """Whether all frames have these layers, with the data window of the color."""
    color = shot.choice.layers["color"]
    for layer in set(layers):
        files = shot.groups[layer.group].files
        for number in shot.numbers:
            parts = read_image_header(files[number]).parts if number in files else ()
            own = parts[layer.part] if layer.part < len(parts) else None
            if own is None or not {*layer.channels} <= {*own.channels}:
                return False
            if own.window != read_image_header(shot.file(color, number)).parts[color.part].window:
                return False
    return True


def _span(values: Image) -> str:
    known = values[np.isfinite(values)]
    if not known.size:
        return "not finite"
    low, high = float(known.min()), float(known.max())
    return f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"
