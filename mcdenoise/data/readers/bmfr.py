"""The layout of the BMFR data set: one EXR per buffer and frame, cameras in a C header (Koskela et al. 2019)."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from torch import Tensor

from mcdenoise.data.camera_matrices import MATRICES
from mcdenoise.data.exr import LARGEST_HALF, read_exr, write_exr
from mcdenoise.data.files import listed, make_folder, write_text
from mcdenoise.data.images import Image, Mask, read_image_header, read_picture
from mcdenoise.data.readers.diffuse_specular import DIFFUSE, LIGHT_PARTS, SPECULAR
from mcdenoise.data.readers.files import RenderedFiles, as_tensors
from mcdenoise.data.readers.names import FileGroup, find_files
from mcdenoise.data.readers.opening import open_files
from mcdenoise.data.readers.samples import write_samples
from mcdenoise.data.readers.sequence import Sequence as FrameSequence
from mcdenoise.data.readers.values import nothing_hit
from mcdenoise.errors import InputError
from mcdenoise.frame import BUFFERS, Frame
from mcdenoise.reading import expecting, read_text

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
# Subfolder of the features of references, ``clean/albedoN.exr`` and so on.
CLEAN = "clean"

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
    """

    path: Path
    fits_cameras = False
    one_window = True

    @property
    def noisy(self) -> frozenset[str]:
        """Names of the buffers that differ between noise seeds, as :meth:`frame` returns them."""
        parts = {name: lights[0].layers[0] for name, lights in self.split.parts.items()}
        layers = {**dict(zip(["samples"], self.samples.radiance, strict=False)), **parts, **self.choice.layers}
        own = {
            name for name, each in layers.items() for more in self.more if more[each.group] != self.groups[each.group]
        }
        derived = {"depth"} if "position" in own and self.cameras is not None and "depth" not in layers else set()
        return frozenset(own | derived | {"color"})

    @property
    def unused(self) -> list[str]:
        return [*super().unused, *_others(self.path)]

    def _files(self, number: int) -> list[Path]:
        description = self.path / _DESCRIPTION
        return super()._files(number) + ([description] if description.is_file() else [])

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
        if "motion" in images:
            images["motion"] = self.motion.apply(images["motion"])
        if normal is not None and self.encoded_normals:
            images["normal"] = np.where((normal != 0).any(-1, keepdims=True), 2 * normal - 1, 0)
        if "depth" in images:
            nothing = nothing_hit(images["depth"])
            if normal is not None and "albedo" in images:
                # Both must be zero: mirrors and glass have no albedo, but they have a normal.
                nothing |= ((images["albedo"] == 0) & (images["normal"] == 0)).all(-1, keepdims=True)
            images["depth"] = np.where(nothing, np.float32(np.inf), images["depth"])
        return Frame(**as_tensors(images, matrix))

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
    for match in filter(None, (_NAME.fullmatch(each.name) for each in listed(path))):
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
    """Open the selected frames of a folder as :func:`open_files` does: file names are the names of buffers.

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
    files = _of_frames(files, numbers)
    groups = [FileGroup(_STEMS[name], own) for name, own in files.items()]
    stated = _color_has_albedo(path, "albedo" in files) if color_has_albedo is None else color_has_albedo
    make = partial(_BmfrFolder, path=path, more=_find_noise_seeds(path, numbers, files))
    shot = open_files(groups, lambda present: present, str(path), {}, stated, make=make)
    # Motion may be there and of no use.
    for name in files.keys() - shot.choice.layers.keys() - LIGHT_PARTS - {"motion"}:
        first = next(iter(files[name].values()))
        raise InputError(
            f"{first}: expected {BUFFERS[name].channels} channels of floats for buffer '{name}', found "
            f"{', '.join(read_image_header(first).parts[0].channels[:8])}; write only those that belong to it"
        )
    if len({DIFFUSE, SPECULAR} & files.keys()) == 1:
        shot.warnings.append("'diffuse', 'specular': expected both, which add up to the color, found one: not used")
    return shot


def _of_frames(files: Files, numbers: Sequence[int]) -> dict[str, dict[int, Path]]:
    """The files of some frames, of those buffers that any of them has."""
    chosen = {name: {number: own[number] for number in numbers if number in own} for name, own in files.items()}
    return {name: own for name, own in chosen.items() if own}


def _find_noise_seeds(path: Path, numbers: Sequence[int], files: Files) -> list[list[FileGroup]]:
    """Files of the noise seeds 1, 2, ..., up to the first seed that lacks a color and so is still being rendered."""
    found: list[list[FileGroup]] = []
    while os.path.isdir(folder := noise_seed_folder(path, 1 + len(found))):
        own = _of_frames(_list_files(folder), numbers)
        if len(own.get("color", ())) < len(numbers):
            break
        own.pop("reference", None)
        found.append([FileGroup(_STEMS[name], own.get(name, all_seeds)) for name, all_seeds in files.items()])
    return found


def write_bmfr_frame(folder: Path, number: int, frame: Frame) -> None:
    """Write the buffers of one frame: 32-bit floats for positions (and depths beyond half's range), half for the rest.

    The color file is written last. A folder without ``camera.json`` gets one, which states that color is radiance.
    ``view_projection`` is not written: see :func:`mcdenoise.data.camera_matrices.write_camera_matrices`.

    Args:
        folder: folder to write to; created if it does not exist.
        number: frame number.
        frame: batch of 1. Infinite depths are stored as 0.

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
    write_buffers(folder, number, {name: buffers[name] for name in _STEMS if name in buffers})


def write_buffers(folder: Path, number: int, buffers: Mapping[str, Tensor]) -> None:
    """Write some buffers of a frame, one after the other, each atomically, like :func:`write_bmfr_frame`.

    Args:
        folder: folder to write to; created if it does not exist.
        number: frame number.
        buffers: ``(1, C, H, W)`` by the names of buffers; samples are ``(1, S, C, H, W)``.

    Raises:
        InputError: a file cannot be written.
    """
    make_folder(folder)
    for name, buffer in buffers.items():
        path, image = folder / f"{_STEMS[name]}{number}.exr", buffer[0].detach().float().cpu().numpy()
        if name == "samples":
            write_samples(path, image)
            continue
        image = image.transpose(1, 2, 0)
        if name == "depth":
            image = np.where(np.isinf(image), 0, image)
        full_float = name in _FULL_FLOAT or (name == "depth" and bool(image.max() > LARGEST_HALF))
        write_exr(path, image, _CHANNELS[image.shape[2]], full_float=full_float)


def has_buffers(folder: Path, number: int, names: Iterable[str], size: tuple[int, int]) -> bool:
    """Whether the files of some buffers exist and are complete, see :func:`is_whole`.

    Args:
        folder: folder of the files.
        number: frame number.
        names: names of the buffers.
        size: expected width and height in pixels.
    """
    return all(is_whole(folder / f"{_STEMS[name]}{number}.exr", size, BUFFERS[name].channels) for name in names)


def is_whole(path: Path, size: tuple[int, int], channels: int) -> bool:
    """Whether an image exists and is complete: its pixels are read, once per process.

    A file that is damaged, empty or of another size, for example after a power failure, does not count.

    Args:
        path: the file.
        size: expected width and height in pixels.
        channels: expected number of channels.
    """
    try:
        status = os.stat(path)
    except OSError:
        return False
    return _is_whole(path, size, channels, status.st_mtime_ns, status.st_size)


@cache
def _is_whole(path: Path, size: tuple[int, int], channels: int, *_: int) -> bool:
    try:
        part = read_picture(path)[1].parts[0]
    except InputError:
        return False
    return part.window == (0, 0, *size[::-1]) and len(part.channels) == channels


def read_clean_features(folder: Path, number: int) -> tuple[Tensor, Tensor] | None:
    """Read albedo and normal without noise from the subfolder ``CLEAN``, ``(1, 3, H, W)`` each, or ``None``.

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
    with expecting(description, "a JSON object, in which 'color_includes_albedo' is true or false"):
        content = msgspec.convert(json.loads(read_text(description)), dict[str, Any])
        has_albedo = content.get("color_includes_albedo", True)
        if not isinstance(has_albedo, bool):
            raise ValueError(repr(has_albedo))
    if not has_albedo and not albedo_present:
        raise InputError(
            f"{path}: expected albedo files, because camera.json says that color has no albedo in it, found none; "
            "add them, or set 'color_includes_albedo' to true"
        )
    return has_albedo
