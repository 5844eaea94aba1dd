"""Opening the files of a shot: which layers are which buffers, and whether all frames have them."""

from __future__ import annotations

import functools
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
from torch import Tensor

from mcdenoise.data.camera_matrices import find_camera_matrices
from mcdenoise.data.images import (
    Image,
    ImageHeader,
    Metadata,
    Part,
    Window,
    check_channels,
    read_channels,
    read_image_header,
)
from mcdenoise.data.radiance import light_of
from mcdenoise.data.readers.choice import Choice, choose
from mcdenoise.data.readers.diffuse_specular import (
    DIFFUSE,
    EMISSION,
    SPECULAR,
    SPECULAR_ALBEDO,
    Split,
    find_splits,
)
from mcdenoise.data.readers.examining import examine, examine_parts
from mcdenoise.data.readers.files import RenderedFiles, as_tensor
from mcdenoise.data.readers.layers import Layer, layers_of, read_files, recognise
from mcdenoise.data.readers.lights import ALL, WHOLE, find_lights, is_light
from mcdenoise.data.readers.names import FileGroup, files_beside, pattern_of, patterns_of
from mcdenoise.data.readers.samples import SampleLayers, split_samples
from mcdenoise.data.readers.values import Row
from mcdenoise.errors import InputError

# Color spaces of images that the user may state.
ColorSpace: TypeAlias = Literal["auto", "linear", "srgb"]
# Strips of rows, and the columns in them, in which layers are compared with the color.
_STRIPS, _STRIP, _COLUMNS = 8, 8, 128
# Features that make most methods better, of which a frame has at least one where there are any.
_FEATURES = {"albedo", "normal", "depth"}


def open_files(
    groups: Sequence[FileGroup],
    choose_numbers: Callable[[list[int]], list[int]],
    where: str,
    mapping: Mapping[str, str],
    color_has_albedo: bool | None = None,
    lights: Sequence[str] = (),
    color_space: ColorSpace = "auto",
    make: Callable[..., RenderedFiles] = RenderedFiles,
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
        make: makes the shot, for a layout with conventions of its own.

    Raises:
        InputError: the files cannot be recognised, do not match one another, or cannot be read.
    """
    first_files = [group.first for group in groups]
    headers = [*map(read_image_header, first_files)]
    layers = [
        replace(layer, files=pattern)
        for i, (group, pattern, header) in enumerate(zip(groups, patterns_of(groups), headers, strict=True))
        for layer in layers_of(i, group.label, header.parts)
    ]
    samples, layers = split_samples(layers)
    choice = choose(where, layers, mapping, functools.partial(read_files, lambda layer: first_files[layer.group]))
    color = choice.layers["color"]
    splits = _splits(layers, choice, mapping)
    numbers = choose_numbers(sorted(groups[color.group].files))
    parts = [_parts(header, color_space) for header in headers]
    shot = make(groups, parts, choice, numbers=numbers, warnings=choice.warnings)
    shot.examined = _examined(shot)
    everywhere = _check_files(shot, splits, samples)
    for own in shot.more:
        everywhere &= _check_files(replace(shot, groups=own), splits, samples)
    shot.lights, left = find_lights(where, layers, color, lights, functools.partial(_some_pixels, shot, shot.examined))
    shot.cameras = find_camera_matrices(shot.file(color, numbers[0]).parent, numbers[-1])
    images = examine(shot, color_has_albedo)
    if left is not None:
        _compare_lights(shot, left, chosen=ALL not in lights)
    examine_parts(shot, images["color"][..., :3], splits, samples, everywhere)
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
        part: the part of the file that has it.
        metadata: attributes of the file.
    """

    path: Path
    layer: Layer
    part: Part
    metadata: Metadata

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.part.window.size

    def read(self, window: Window | None = None) -> Tensor:
        """Read ``(1, 3, H, W)`` radiance, thrice the same from one channel.

        Args:
            window: what to read instead of the data window; 0 where that has no pixels.

        Raises:
            InputError: the file is damaged.
        """
        pixels = read_channels(self.path, {self.layer.part: self.layer.channels[:4]})[self.layer.part]
        pixels = np.repeat(pixels, 3, -1) if pixels.shape[2] == 1 else pixels
        pixels = light_of(pixels, self.part)[..., :3]
        pixels = pixels if window is None else window.of(pixels, self.part.window)
        return as_tensor(pixels)


def open_result(path: Path, layer: str | None = None, color_space: ColorSpace = "auto") -> Result:
    """Find the radiance in a denoiser's output file, which may have other layers.

    Args:
        path: the file.
        layer: name of the layer of the radiance, if names do not tell.
        color_space: see :func:`open_files`.

    Raises:
        InputError: the file cannot be read, or its radiance cannot be determined.
    """
    header, mapping = read_image_header(path), {} if layer is None else {"color": layer}
    parts = _parts(header, color_space)
    chosen = choose(str(path), layers_of(0, "", parts), mapping, functools.partial(read_files, lambda _: path))
    found = chosen.written[0]
    return Result(path, found, parts[found.part], header.metadata)


def _check_files(shot: RenderedFiles, splits: Sequence[Split], samples: SampleLayers) -> set[Layer]:
    """Check that every frame has every buffer, in the same display window; join data windows that differ.

    Returns:
        The layers of parts of the light and of samples that every frame has, with the data window of the color.
    """
    color = shot.choice.layers["color"]
    for name, layer in sorted(shot.choice.layers.items()):
        missing = [number for number in shot.numbers if not shot.has(layer, number)]
        if missing and name != "reference":
            group = shot.groups[layer.group]
            place = group.first.parent / pattern_of(group)
            raise InputError(
                f"{place}: expected buffer '{name}' for every frame, found none for frame {missing[0]}; render it, or "
                f"leave the buffer out with --map {name}="
            )
    written = [color, *shot.choice.written]
    used = dict.fromkeys([*written, *shot.choice.layers.values()])
    everywhere = samples.layers.union(*(split.layers for split in splits))
    files = {layer.group: shot.groups[layer.group].files for layer in (*used, *everywhere)}
    windows: set[Window] = set()
    colors: set[Window] = set()
    for number in shot.numbers:
        headers = {group: read_image_header(own[number]) for group, own in files.items() if number in own}
        parts = {each: headers[each.group].part(each.part) for each in (*used, *everywhere) if each.group in headers}
        window = parts[color].window
        for layer in (each for each in used if each in parts):
            _check_part(shot, number, layer, parts[layer])
            if layer == shot.choice.layers.get("reference") and parts[layer].window != window:
                raise InputError(
                    f"{shot.file(layer, number)}: expected a reference in the data window of the color, found another; "
                    "render it so, or leave it out with --map reference="
                )
        own = {layer: part for layer, part in parts.items() if {*layer.channels} <= {*part.channels}}
        everywhere = {layer for layer in everywhere if layer in own and own[layer].window == window}
        windows |= {parts[layer].window for layer in used if layer in parts}
        colors |= {parts[layer].window for layer in written if layer in parts}
    if len(windows) > 1:
        tops, lefts, bottoms, rights = zip(*colors, strict=True)
        shot.window = Window(min(tops), min(lefts), max(bottoms), max(rights))
    return everywhere


def _check_part(shot: RenderedFiles, number: int, layer: Layer, part: Part) -> None:
    path, first, main = shot.file(layer, number), shot.part_of(layer), shot.part_of(shot.choice.layers["color"])
    check_channels(path, part.channels, layer.channels)
    if part.name != first.name and len(shot.parts[layer.group]) > 1:
        raise InputError(
            f"{path}: expected '{first.name}' as part {layer.part + 1}, as the first file has it, found '{part.name}'; "
            "render all frames with the same layers"
        )
    if part.window != main.window and (shot.one_window or part.display != main.display):
        raise InputError(
            f"{path}: expected {_window(main)} like the first color file, found {_window(part)}; render all "
            "buffers and frames at one size, or crop them in one display window, or leave a buffer out with --map"
        )


def _window(part: Part) -> str:
    (height, width), (top, left) = part.window.size, part.window[:2]
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


def _examined(shot: RenderedFiles) -> int:
    """The first frame, or one that shows something where that is empty: a shot may fade in, or begin with the sky."""
    layers = [layer for name, layer in shot.choice.layers.items() if name in ("color", "normal", "position")]
    # There is no choice in a still, and none after the others: nothing is read of the last one.
    *others, last = dict.fromkeys([shot.numbers[0], shot.numbers[len(shot.numbers) // 2], shot.numbers[-1]])
    for number in others:
        # A single value everywhere tells nothing.
        if all(np.ptp(np.nan_to_num(pixels)) > 0 for pixels in _some_pixels(shot, number, layers).values()):
            return number
    return last


def _some_pixels(shot: RenderedFiles, number: int, layers: Sequence[Layer]) -> dict[Layer, Image]:
    """``(N, C)`` the same pixels of layers of a frame, of those with the data window of the color."""
    main = shot.part_of(shot.choice.layers["color"])
    height, width = main.window.size
    same = [layer for layer in dict.fromkeys(layers) if shot.part_of(layer).window == main.window]
    same = [layer for layer in same if shot.has(layer, number)]
    found: defaultdict[Layer, list[Image]] = defaultdict(list)
    for top in np.linspace(0, max(0, height - _STRIP), _STRIPS).astype(int).tolist():
        strips = read_files(lambda layer: shot.file(layer, number), same, slice(top, top + _STRIP))
        for layer, pixels in strips.items():
            image = light_of(pixels[:, :: max(1, width // _COLUMNS)], shot.part_of(layer))[..., :3]
            found[layer].append(image.reshape(-1, image.shape[-1]))
    return {layer: np.concatenate(strips) for layer, strips in found.items()}


def _compare_lights(shot: RenderedFiles, left: float, *, chosen: bool) -> None:
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
    mapped = {name: choice.layers[name] for name in mapping if name in choice.layers}
    if {DIFFUSE, SPECULAR} <= mapped.keys():
        # These layers are read as parts only.
        for name in {DIFFUSE, SPECULAR, EMISSION, SPECULAR_ALBEDO} & mapped.keys():
            del choice.layers[name]
    return find_splits(layers, choice.layers["color"], mapped)
