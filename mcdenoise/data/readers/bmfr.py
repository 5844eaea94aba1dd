"""The layout of the BMFR data set: one EXR per buffer and frame, cameras in a C header (Koskela et al. 2019)."""

from __future__ import annotations

import functools
import json
import os
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mcdenoise.data.camera_matrices import MATRICES, find_camera_matrices
from mcdenoise.data.exr import LARGEST_HALF, Image, Mask, MetadataValue, read_exr, write_exr
from mcdenoise.data.files import make_folder, write_text
from mcdenoise.data.images import Part, read_image_header, read_picture
from mcdenoise.data.readers.choice import Choice
from mcdenoise.data.readers.diffuse_specular import DIFFUSE, SPECULAR, find_splits
from mcdenoise.data.readers.examining import examine, examine_parts
from mcdenoise.data.readers.files import RenderedFiles, as_tensor
from mcdenoise.data.readers.layers import Layer, layers_of
from mcdenoise.data.readers.names import FileGroup, find_files, pattern_of
from mcdenoise.data.readers.opening import check_files
from mcdenoise.data.readers.samples import SampleLayers, split_samples, write_samples
from mcdenoise.data.readers.sequence import Sequence as FrameSequence
from mcdenoise.data.readers.values import nothing_hit
from mcdenoise.errors import InputError
from mcdenoise.frame import BUFFERS, Frame
from mcdenoise.motion import USUAL_MOTION
from mcdenoise.reading import read_text

# File names of the buffers in writing order: color is last, so that a frame that has its color is complete.
_STEMS = {
    "albedo": "albedo",
    "normal": "shading_normal",
    "position": "world_position",
    "depth": "depth",
    "motion": "motion",
    "previous_position": "previous_position",
    "diffuse": "diffuse",
    "specular": "specular",
    "samples": "samples",
    "reference": "reference",
    "color": "color",
}
_BUFFER_OF = {stem: name for name, stem in _STEMS.items()}
_NAME = re.compile(rf"({'|'.join(_BUFFER_OF)})([0-9]{{1,9}})\.exr")
# Names that are not used for buffers outside this layout.
_OWN_STEMS = {"shading_normal", "world_position"}
_CHANNELS = {1: ["Y"], 2: ["X", "Y"], 3: ["R", "G", "B"]}
_DESCRIPTION = "camera.json"
_FULL_FLOAT = {"position", "previous_position"}

# The file of each frame by buffer.
Files = Mapping[str, Mapping[int, Path]]


@dataclass(kw_only=True)
class _BmfrFolder(RenderedFiles):
    """A folder in this layout: ``{color,albedo,shading_normal,world_position,...}N.exr`` and ``camera_matrices.h``.

    Further noisy colors of the same frames, with other noise seeds, are ``noise_seed{1,2,...}/colorN.exr``. If other
    buffers lie beside them, these have noise of the same seed; references do not depend on the seed.

    Unlike files of a renderer, they hold what a frame holds: a sky, for example, is left as it is.

    Args:
        path: the folder that holds the files.
        more: the kinds of files for each noise seed from 1 on.
    """

    path: Path
    more: Sequence[Sequence[FileGroup]] = ()
    fits_cameras = False

    @property
    def folders(self) -> set[Path]:
        return {self.path}

    @property
    def noise_seeds(self) -> int:
        return 1 + len(self.more)

    @property
    def noisy(self) -> frozenset[str]:
        """Names of the buffers that differ between noise seeds, as :meth:`frame` returns them."""
        layers = {"samples": self.samples.radiance[0]} if self.samples else {}
        layers |= {name: lights[0].layers[0] for name, lights in (self.split.parts if self.split else {}).items()}
        layers |= self.choice.layers
        own = {
            name for name, each in layers.items() for more in self.more if more[each.group] != self.groups[each.group]
        }
        derived = {"depth"} if "position" in own and self.cameras is not None and "depth" not in layers else set()
        return frozenset(own | derived | {"color"})

    @property
    def unused(self) -> list[str]:
        return _others(self.path)

    def _files(self, number: int) -> list[Path]:
        description = self.path / _DESCRIPTION
        return super()._files(number) + ([description] if description.is_file() else [])

    def _frame(self, number: int, reference: bool, noise_seed: int, buffers: Collection[str] | None) -> Frame:
        if noise_seed:
            return replace(self, groups=self.more[noise_seed - 1])._frame(number, reference, 0, buffers)
        return super()._frame(number, reference, 0, buffers)

    def as_frame(self, number: int, images: dict[str, Image], lights: Mapping[str, Image]) -> Frame:
        if not self.color_has_albedo:
            images["color"] = images["color"] * images["albedo"]
        normal = images.get("normal")
        matrix = self.camera(number, images)
        if matrix is not None and "position" in images:
            # Row by row, because a large image takes much memory in float64.
            w = np.stack([row.astype(np.float64) @ matrix[:3, 3] + matrix[3, 3] for row in images["position"]])
            # A matrix and its negative give the same projection; visible points lie in front.
            if np.median(w[np.isfinite(w)]) < 0:
                matrix, w = -matrix, -w
            images.setdefault("depth", w[..., None].astype(np.float32))
        if "position" in images:
            # Where nothing was hit it may be infinite; the depth tells.
            images["position"] = np.where(np.isfinite(images["position"]), images["position"], 0)
        if "motion" in images and self.motion != USUAL_MOTION:
            images["motion"] = self.motion.apply(images["motion"])
        if normal is not None and self.encoded_normals:
            images["normal"] = np.where((normal != 0).any(-1, keepdims=True), 2 * normal - 1, 0)
        if "depth" in images:
            nothing = nothing_hit(images["depth"])
            if normal is not None and "albedo" in images:
                # Both must be zero: mirrors and glass have no albedo, but they have a normal.
                nothing |= ((images["albedo"] == 0) & (images["normal"] == 0)).all(-1, keepdims=True)
            images["depth"] = np.where(nothing, np.float32(np.inf), images["depth"])
        buffers: dict[str, Any] = {name: as_tensor(image) for name, image in images.items()}
        if matrix is not None:
            buffers["view_projection"] = torch.from_numpy(matrix).float()[None]
        return Frame(**buffers)

    def known(self, images: Mapping[str, Image]) -> Mask:
        """``(H, W)`` true where something was hit: where positions, and normals if there are any, are not zero."""
        found = [images[name] for name in ("position", "normal") if name in images]
        known: Mask = np.all([(image != 0).any(-1) for image in found], axis=0)
        return known

    def check_output_layer(self, name: str) -> None:
        # There are no layers.
        FrameSequence.check_output_layer(self, name)

    def target(self, source: Path) -> str:
        """The name of a result: ``denoisedN.exr``."""
        return f"denoised{source.name.removeprefix(_STEMS['color'])}"


def find_bmfr(given: Sequence[Path]) -> tuple[Path, Files] | None:
    """The given folder, or its subfolder ``inputs``, if it has this layout and no other, and its files.

    Raises:
        InputError: a folder cannot be listed, or two files are the same frame of a buffer.
    """
    for folder in (given[0], given[0] / "inputs") if len(given) == 1 else ():
        if os.path.isdir(folder) and (files := _list_files(folder))["color"] and _is_bmfr(folder, files):
            return folder, files
    return None


def _is_bmfr(path: Path, files: Files) -> bool:
    with suppress(InputError):
        if len(read_image_header(next(iter(files["color"].values()))).parts[0].channels) != BUFFERS["color"].channels:
            return False
    if {_DESCRIPTION, MATRICES} & set(os.listdir(path)):
        return True
    stems = {_STEMS[name] for name, found in files.items() if found}
    return not _others(path) and bool(stems & _OWN_STEMS or stems == {"color"})


def noise_seed_folder(folder: Path, noise_seed: int) -> Path:
    """The folder of a noise seed's colors: the folder itself for 0, ``noise_seed{k}`` for k."""
    return folder / f"noise_seed{noise_seed}" if noise_seed else folder


def _list_files(path: Path) -> dict[str, dict[int, Path]]:
    found: dict[str, dict[int, Path]] = {name: {} for name in _STEMS}
    try:
        entries = sorted(os.listdir(path))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check its permissions") from error
    for match in filter(None, map(_NAME.fullmatch, entries)):
        other = found[_BUFFER_OF[match[1]]].setdefault(int(match[2]), path / match[0])
        if other.name != match[0]:
            raise InputError(f"{path}: expected one file a frame, found {other.name} and {match[0]}; remove one")
    return found


def _others(path: Path) -> list[str]:
    """Images whose names the layout does not use, such as `normal#.exr`."""
    names = [each.name for each in find_files([path]) if not _NAME.fullmatch(each.name)]
    return list(dict.fromkeys(re.sub("[0-9]+", "#", name) for name in names))


def open_bmfr(
    path: Path,
    files: Files,
    choose_numbers: Callable[[list[int]], list[int]],
    color_has_albedo: bool | None = None,
) -> RenderedFiles:
    """Check the selected frames of a folder by file names and headers, and the values of the first frame.

    Args:
        path: the folder.
        files: result of :func:`find_bmfr`.
        choose_numbers: selects the frames to use.
        color_has_albedo: whether color is radiance including albedo; by default as stated in ``camera.json``, or else
            determined from the values.

    Raises:
        InputError: a file is missing or unreadable, or has other sizes or channels than expected.
    """
    numbers = choose_numbers(sorted(files["color"]))
    files = {name: own for name, own in files.items() if any(number in own for number in numbers)}
    _check_complete(path, files, numbers)
    groups = [FileGroup(_STEMS[name], own) for name, own in files.items()]
    parts = [read_image_header(next(own[n] for n in numbers if n in own)).parts[:1] for own in files.values()]
    layers: dict[str, Layer] = {}
    samples: SampleLayers | None = None
    for index, (name, (part,)) in enumerate(zip(files, parts, strict=True)):
        if name == "samples":
            samples, _ = split_samples(layers_of(index, "", [part]))
            if samples is None:
                found = ", ".join(part.channels[:8])
                raise InputError(f"{files[name][numbers[0]]}: expected layers sample0.RGB, sample1.RGB, found {found}")
        else:
            layers[name] = _layer_of(index, name, files[name], part)
    split = find_splits([], layers["color"], {name: layers[name] for name in (DIFFUSE, SPECULAR) if name in layers})
    buffers = {name: layers[name] for name in sorted(layers, key=lambda name: name != "color")}
    choice = Choice({name: layer for name, layer in buffers.items() if name not in (DIFFUSE, SPECULAR)})
    choice.written = [layers["color"]]
    more = _find_noise_seeds(path, numbers, groups, files)
    shot = _BmfrFolder(groups, parts, choice, path=path, numbers=numbers, more=more)
    everywhere = {*(layer for each in split for layer in each.layers), *(samples.layers if samples else ())}
    for own in (groups, *more):
        everywhere &= check_files(replace(shot, groups=own), split, samples, one_window=True)
    if len({DIFFUSE, SPECULAR} & files.keys()) == 1:
        shot.warnings.append("'diffuse', 'specular': expected both, which add up to the color, found one: not used")
    shot.cameras = find_camera_matrices(path, numbers[-1])
    stated = _color_has_albedo(path, "albedo" in files) if color_has_albedo is None else color_has_albedo
    images = examine(shot, stated)
    examine_parts(shot, images["color"], split, samples, everywhere)
    return shot


def _check_complete(folder: Path, files: Files, numbers: Sequence[int]) -> None:
    """Check that every frame has every buffer but the reference."""
    for name, own in files.items():
        missing = [number for number in numbers if number not in own]
        if missing and name != "reference":
            raise InputError(
                f"{folder / f'{_STEMS[name]}{missing[0]}.exr'}: expected buffer '{name}' for every frame, found it for "
                f"some; render it, or remove all {_STEMS[name]} files"
            )


def _layer_of(group: int, name: str, files: Mapping[int, Path], part: Part) -> Layer:
    """All channels of a buffer's file."""
    if len(part.channels) != BUFFERS[name].channels or part.integers:
        found = "whole numbers" if part.integers else str(len(part.channels))
        raise InputError(
            f"{next(iter(files.values()))}: expected {BUFFERS[name].channels} channels for buffer '{name}', found "
            f"{found} ({', '.join(part.channels[:8])}); write only those that belong to it"
        )
    letters = ("",) if len(part.channels) == 1 else tuple("rgb"[: len(part.channels)])
    pattern = pattern_of(FileGroup(_STEMS[name], files))
    return Layer(group, 0, _STEMS[name], part.channels, letters, anonymous=True, files=pattern)


def _find_noise_seeds(
    path: Path, numbers: list[int], groups: Sequence[FileGroup], files: Files
) -> list[list[FileGroup]]:
    """Files of the noise seeds 1, 2, ..., up to the first seed that lacks a color and so is still being rendered."""
    found: list[list[FileGroup]] = []
    while os.path.isdir(folder := noise_seed_folder(path, 1 + len(found))):
        listed = _list_files(folder)
        if not all(number in listed["color"] for number in numbers):
            break
        own = {name: listed[name] for name in files if name != "reference" and any(n in listed[name] for n in numbers)}
        _check_complete(folder, own, numbers)
        kinds = zip(files, groups, strict=True)
        found.append([replace(group, files=own[name]) if name in own else group for name, group in kinds])
    return found


def write_bmfr_frame(
    folder: Path, number: int, frame: Frame, *, metadata: Mapping[str, MetadataValue] | None = None
) -> None:
    """Write the buffers of one frame: 32-bit floats for positions (and depths beyond half's range), half for the rest.

    The color file is written last. A folder without ``camera.json`` gets one, which states that color is radiance.
    ``view_projection`` is not written: see :func:`mcdenoise.data.camera_matrices.write_camera_matrices`.

    Args:
        folder: folder to write to; created if it does not exist.
        number: frame number.
        frame: batch of 1. Infinite depths are stored as 0.
        metadata: attributes for every file.

    Raises:
        InputError: a file cannot be written.
        ValueError: the frame holds more than one image.
    """
    if frame.color.shape[0] != 1:
        raise ValueError(f"frame: expected a batch of 1, found {frame.color.shape[0]}")
    make_folder(folder)
    # Without it, a reader must assume published BMFR data, whose color is divided by albedo.
    if not (folder / _DESCRIPTION).exists():
        write_text(folder / _DESCRIPTION, json.dumps({"color_includes_albedo": True}) + "\n")
    buffers = dict(frame.items())
    for name in _STEMS:
        if name in buffers:
            write_buffer(folder, number, name, buffers[name], metadata=metadata)


def write_buffer(
    folder: Path, number: int, name: str, buffer: Tensor, *, metadata: Mapping[str, MetadataValue] | None = None
) -> None:
    """Write one buffer of a frame atomically, like :func:`write_bmfr_frame`.

    Args:
        folder: folder to write to. It must exist.
        number: frame number.
        name: name of the buffer, such as ``"reference"``.
        buffer: ``(1, C, H, W)``; samples are ``(1, S, C, H, W)``.
        metadata: attributes for the file.

    Raises:
        InputError: the file cannot be written.
    """
    if name == "samples":
        write_samples(folder / f"{_STEMS[name]}{number}.exr", buffer[0].detach().float().cpu().numpy())
        return
    image = buffer[0].detach().float().permute(1, 2, 0).cpu().numpy()
    if name == "depth":
        image = np.where(np.isinf(image), 0, image)
    full_float = name in _FULL_FLOAT or (name == "depth" and bool(image.max() > LARGEST_HALF))
    path = folder / f"{_STEMS[name]}{number}.exr"
    write_exr(path, image, _CHANNELS[image.shape[2]], full_float=full_float, metadata=metadata)


def has_buffer(folder: Path, number: int, name: str, size: tuple[int, int]) -> bool:
    """Whether a complete file of a buffer exists: its pixels are read, once per process.

    A file that is damaged, empty or of another size, for example after a power failure, does not count.

    Args:
        folder: folder of the file.
        number: frame number.
        name: name of the buffer.
        size: expected width and height in pixels.
    """
    path = folder / f"{_STEMS[name]}{number}.exr"
    try:
        status = os.stat(path)
    except OSError:
        return False
    return _is_whole(path, size, len(_CHANNELS[BUFFERS[name].channels]), status.st_mtime_ns, status.st_size)


@functools.cache
def _is_whole(path: Path, size: tuple[int, int], channels: int, *_: int) -> bool:
    try:
        part = read_picture(path)[1].parts[0]
    except InputError:
        return False
    return part.size == size[::-1] and part.origin == (0, 0) and len(part.channels) == channels


CLEAN = "clean"


def write_clean_features(folder: Path, number: int, albedo: Tensor, normal: Tensor) -> None:
    """Write the converged features of a reference: ``clean/albedoN.exr`` and so on.

    Args:
        folder: ``inputs`` of a sequence.
        number: frame number.
        albedo: ``(1, 3, H, W)`` in [0, 1].
        normal: ``(1, 3, H, W)`` in [-1, 1].

    Raises:
        InputError: a file cannot be written.
    """
    make_folder(folder / CLEAN)
    write_buffer(folder / CLEAN, number, "albedo", albedo)
    write_buffer(folder / CLEAN, number, "normal", normal)


def read_clean_features(folder: Path, number: int) -> tuple[Tensor, Tensor] | None:
    """Read albedo and normal of :func:`write_clean_features`, ``(1, 3, H, W)`` each, or ``None``.

    Raises:
        InputError: a file is damaged.
    """
    paths = [folder / CLEAN / f"{_STEMS[name]}{number}.exr" for name in ("albedo", "normal")]
    if not all(path.is_file() for path in paths):
        return None
    albedo, normal = (torch.from_numpy(read_exr(path)[0]).permute(2, 0, 1)[None] for path in paths)
    return albedo, normal


def _color_has_albedo(path: Path, albedo_present: bool) -> bool | None:
    """Read it from ``camera.json``; ``None`` without that file: then the values have to tell."""
    description = path / _DESCRIPTION
    if not os.path.lexists(description):
        # Without albedo there is nothing to multiply by: this is ordinary radiance, not the published data.
        return None if albedo_present else True
    try:
        content = json.loads(read_text(description))
        has_albedo = content.get("color_includes_albedo", True)
    except (OSError, ValueError, AttributeError, RecursionError) as error:
        raise InputError(f"{description}: expected a JSON object, found something else; repair or remove it") from error
    if not isinstance(has_albedo, bool):
        raise InputError(f"{description}: expected 'color_includes_albedo' to be true or false, found {has_albedo!r}")
    if not has_albedo and not albedo_present:
        raise InputError(
            f"{path}: expected albedo files, because camera.json says that color has no albedo in it, found none; "
            "add them, or set 'color_includes_albedo' to true"
        )
    return has_albedo
