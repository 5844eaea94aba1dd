"""The layout of the BMFR data set: one EXR per buffer and frame, cameras in a C header (Koskela et al. 2019)."""

from __future__ import annotations

import functools
import json
import os
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mcdenoise.data.camera_matrices import MATRICES, Array, CameraMatrices, find_camera_matrices
from mcdenoise.data.exr import (
    LARGEST_HALF,
    ExrHeader,
    Image,
    Metadata,
    MetadataValue,
    read_exr,
    read_exr_header,
    write_exr,
)
from mcdenoise.data.files import write_text
from mcdenoise.data.images import read_channels, read_image_header
from mcdenoise.data.readers.cameras import fault
from mcdenoise.data.readers.diffuse_specular import LIGHT_PARTS, adds_up, off
from mcdenoise.data.readers.layers import layers_of
from mcdenoise.data.readers.names import find_files
from mcdenoise.data.readers.rewrite import write_like
from mcdenoise.data.readers.samples import mean_is, split_samples, write_samples
from mcdenoise.data.readers.values import Row, normal_is_encoded, nothing_hit, read_radiance
from mcdenoise.errors import InputError
from mcdenoise.frame import BUFFERS, Frame, scale_samples
from mcdenoise.motion import MOTION_PAIRS, USUAL_MOTION, Convention, Pair, convert, read_as, read_motion

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
_KNOWN = re.compile(rf"({'|'.join(_STEMS.values())})[0-9]+\.exr")
# Names that are not used for buffers outside this layout.
_OWN_STEMS = {"shading_normal", "world_position"}
_CHANNELS = {1: ["Y"], 2: ["X", "Y"], 3: ["R", "G", "B"]}
_DESCRIPTION, _LARGEST_DESCRIPTION = "camera.json", 2**26
_FULL_FLOAT = {"position", "previous_position"}


@dataclass(frozen=True)
class BmfrFolder:
    """A folder in this layout: ``{color,albedo,shading_normal,world_position,...}N.exr`` and ``camera_matrices.h``.

    Further noisy colors of the same frames, with other noise seeds, are ``noise_seed{1,2,...}/colorN.exr``. If other
    buffers lie beside them, these have noise of the same seed; references do not depend on the seed.

    Args:
        path: the folder that holds the files.
        files: for each buffer, the file of each frame number.
        numbers: frames in use, ascending.
        size: height and width in pixels, the same for every buffer and frame.
        cameras: contents of ``camera_matrices.h``, or ``None`` without it.
        color_has_albedo: whether the color files hold radiance (``camera.json`` says so) or radiance divided by
            albedo (the published data, which has no ``camera.json``). Without albedo files it is always radiance.
        more: for each noise seed from 1 on, its own files, like ``files``.
        table: the source of each buffer.
        warnings: probable mistakes.
        unused: files that look like buffers of the layout but are not used.
    """

    path: Path
    files: Mapping[str, Mapping[int, Path]]
    numbers: list[int]
    size: tuple[int, int]
    cameras: CameraMatrices | None
    color_has_albedo: bool
    more: Sequence[Mapping[str, Mapping[int, Path]]] = ()
    encoded_normals: bool = False
    camera_convention: str = ""
    motion: Convention | None = USUAL_MOTION
    table: Sequence[Row] = ()
    warnings: Sequence[str] = ()
    unused: Sequence[str] = ()

    @property
    def folders(self) -> set[Path]:
        """The folders of the files."""
        return {self.path}

    @property
    def noise_seeds(self) -> int:
        """The number of noisy colors that every frame in use has."""
        return 1 + len(self.more)

    @property
    def noisy(self) -> frozenset[str]:
        """Names of the buffers that differ between noise seeds, as :meth:`frame` returns them."""
        own = {name for files in self.more for name in files} | {"color"}
        derived = {"depth"} if "position" in own and self.cameras is not None and not self.files.get("depth") else set()
        return frozenset(own | derived)

    @property
    def buffers(self) -> frozenset[str]:
        """Names of the buffers that every frame has, as :meth:`frame` returns them."""
        present = {name for name, files in self.files.items() if all(number in files for number in self.numbers)}
        present -= {"motion"} if self.motion is None else set()
        if self.cameras is not None:
            present |= {"view_projection", "depth"} if "position" in present else {"view_projection"}
        return frozenset(present)

    @property
    def reference_numbers(self) -> list[int]:
        """Frames in use that have a reference."""
        return [number for number in self.numbers if number in self.files["reference"]]

    def frame_files(self, number: int) -> list[Path]:
        """The files of one frame without its references, and the files that describe all frames."""
        own = [files[number] for name, files in self.files.items() if name != "reference" and number in files]
        return own + [path for path in (self.path / _DESCRIPTION, self.path / MATRICES) if path.is_file()]

    def metadata(self, number: int) -> Metadata:
        """Attributes of the color file of one frame."""
        return read_exr_header(self.files["color"][number]).metadata

    def frame(
        self, number: int, *, reference: bool = True, noise_seed: int = 0, buffers: Collection[str] | None = None
    ) -> Frame:
        """Read one frame; see :meth:`mcdenoise.data.Sequence.frame`."""
        unwanted = frozenset() if buffers is None else LIGHT_PARTS - set(buffers)
        sources: dict[str, Mapping[int, Path]] = dict(self.files)
        if noise_seed:
            sources |= self.more[noise_seed - 1]
        found: dict[str, Any] = {
            name: self._read(name, files[number])
            for name, files in sources.items()
            if number in files and (reference or name != "reference") and name not in unwanted
        }
        if not self.color_has_albedo:
            found["color"] = found["color"] * found["albedo"]
            if "samples" in found:
                found["samples"] = scale_samples(found["samples"], found["albedo"])
        if self.cameras is not None:
            matrix = convert(self.cameras.view_projection(number, self.size), self.camera_convention)
            if "position" in found:
                matrix, distance = _view_depth(matrix, found["position"])
                found.setdefault("depth", distance)
            found["view_projection"] = torch.from_numpy(matrix).float()[None]
        if "position" in found:
            # Where nothing was hit it may be infinite; the depth tells.
            found["position"] = found["position"].where(found["position"].isfinite(), 0)
        if self.motion is None:
            found.pop("motion", None)
        elif "motion" in found and self.motion != USUAL_MOTION:
            stored = found["motion"][0].permute(1, 2, 0).numpy()
            found["motion"] = torch.from_numpy(self.motion.apply(stored)).permute(2, 0, 1)[None].contiguous()
        if self.encoded_normals and "normal" in found:
            encoded = found["normal"]
            found["normal"] = torch.where((encoded != 0).any(1, keepdim=True), 2 * encoded - 1, 0)
        if "depth" in found:
            found["depth"] = _with_infinite_background(found["depth"], found.get("albedo"), found.get("normal"))
        return Frame(**found)

    def reference(self, number: int) -> Tensor:
        """Read the reference of one frame that has one."""
        return self._read("reference", self.files["reference"][number])

    def write(self, out: Path, number: int, image: Image, *, full_float: bool = False) -> Path:
        """Write ``denoisedN.exr``; see :meth:`mcdenoise.data.Sequence.write`. There is neither alpha nor a layer."""
        source = self.files["color"][number]
        target = out / f"denoised{source.name.removeprefix(_STEMS['color'])}"
        names = read_exr_header(source).channels
        replaced = {(0, name): image[..., i] for i, name in enumerate(names)}
        write_like(source, target, replaced, added={}, full_float=full_float)
        return target

    def _read(self, name: str, path: Path) -> Tensor:
        if name == "samples":
            return torch.from_numpy(_read_samples(path, self.size))[None]
        image, channels, _ = read_exr(path)
        _check_file(name, path, image.shape[:2], channels, self.size)
        return torch.from_numpy(image).permute(2, 0, 1)[None].contiguous()


def find_frames(path: Path) -> dict[str, dict[int, Path]] | None:
    """List the files of a folder in this layout by buffer and frame number; ``None`` if it has no color files.

    Raises:
        InputError: the folder cannot be listed, or two files are the same frame of a buffer.
    """
    found = _list_files(path, _STEMS)
    return found if found["color"] else None


def is_bmfr(path: Path) -> bool:
    """Whether the names of a folder's images have this layout, and no other.

    Raises:
        InputError: see :func:`find_frames`.
    """
    files = find_frames(path)
    if files is None:
        return False
    first = next(iter(files["color"].values()))
    with suppress(InputError):
        if len(read_exr_header(first).channels) != BUFFERS["color"].channels:
            return False
    if {_DESCRIPTION, MATRICES} & set(os.listdir(path)):
        return True
    stems = {_STEMS[name] for name, found in files.items() if found}
    return not _others(path) and bool(stems & _OWN_STEMS or stems == {"color"})


def noise_seed_folder(folder: Path, noise_seed: int) -> Path:
    """The folder of a noise seed's colors: the folder itself for 0, ``noise_seed{k}`` for k."""
    return folder / f"noise_seed{noise_seed}" if noise_seed else folder


def _list_files(path: Path, stems: Mapping[str, str]) -> dict[str, dict[int, Path]]:
    found: dict[str, dict[int, Path]] = {name: {} for name in stems}
    patterns = {name: re.compile(rf"{stem}([0-9]{{1,9}})\.exr") for name, stem in stems.items()}
    try:
        entries = sorted(os.listdir(path))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check its permissions") from error
    for entry in entries:
        for name, pattern in patterns.items():
            if match := pattern.fullmatch(entry):
                other = found[name].setdefault(int(match[1]), path / entry)
                if other.name != entry:
                    raise InputError(f"{path}: expected one file a frame, found {other.name} and {entry}; remove one")
    return found


def open_bmfr(
    path: Path, files: Mapping[str, Mapping[int, Path]], numbers: list[int], color_has_albedo: bool | None = None
) -> BmfrFolder:
    """Check the selected frames of a folder by file names and headers, and the values of the first frame.

    Args:
        path: the folder.
        files: result of :func:`find_frames`.
        numbers: the frames to use, ascending; each has a color file.
        color_has_albedo: whether color is radiance including albedo; by default as stated in ``camera.json``, or else
            determined from the values.

    Raises:
        InputError: a file is missing or unreadable, or has other sizes or channels than expected.
    """
    first = read_exr_header(files["color"][numbers[0]])
    size = first.size
    used = {name for name in files if any(number in files[name] for number in numbers)} | {"reference"}
    for name in sorted(used):
        for number in numbers:
            if number in files[name]:
                _check_header(name, files[name][number], first)
            elif name != "reference":
                missing = path / f"{_STEMS[name]}{number}.exr"
                raise InputError(
                    f"{missing}: expected buffer '{name}' for every frame, found it for some; "
                    f"render it, or remove all {_STEMS[name]} files"
                )
    cameras = find_camera_matrices(path, numbers[-1])
    more = _find_noise_seeds(path, numbers, first, used - {"reference"})
    own = {name: files[name] for name in used}
    stated = _color_has_albedo(path, "albedo" in used) if color_has_albedo is None else color_has_albedo
    folder = BmfrFolder(path, own, numbers, size, cameras, stated is not False, more)
    return _look(_with_parts(folder, stated), stated)


def _with_parts(folder: BmfrFolder, stated: bool | None) -> BmfrFolder:
    """Remove diffuse and specular light that do not add up to the color, and samples whose mean is not the color."""
    number, warnings, dropped = folder.numbers[0], [], set()
    given = {name for name in LIGHT_PARTS & folder.files.keys() if folder.files[name]}
    if not given:
        return folder

    def image(name: str) -> Image:
        pixels: Image = folder._read(name, folder.files[name][number])[0].numpy()
        return pixels if name == "samples" else pixels.transpose(1, 2, 0)

    color = image("color")
    if "samples" in given and not mean_is(color, image("samples")):
        dropped.add("samples")
        warnings.append("'samples': their mean is not the color: not used; write all samples of a pixel")
    if parts := given - {"samples"}:
        whole = len(parts) == 2 and stated is not False
        far, light = off({name: image(name) for name in parts}, color, count=3) if whole else (1.0, 0.0)
        if not whole or not adds_up((far, light)):
            dropped |= parts
            found = f"have {light:.1%} of its light" if whole else f"found {', '.join(sorted(parts))}"
            warnings.append(
                f"'diffuse', 'specular': expected both, which add up to a color with albedo, {found}: not used"
            )
    files = {name: {} if name in dropped else own for name, own in folder.files.items()}
    more = [{name: own for name, own in each.items() if name not in dropped} for each in folder.more]
    return replace(folder, files=files, more=more, warnings=warnings)


def _read_samples(path: Path, size: tuple[int, int]) -> Image:
    """Read ``(S, C, H, W)`` from ``samplesN.exr``."""
    parts = read_image_header(path).parts
    layers, _ = split_samples(layers_of(0, "", parts))
    if layers is None or parts[0].size != size:
        (height, width), (tall, wide) = size, parts[0].size
        raise InputError(
            f"{path}: expected layers sample0.RGB, sample1.RGB, ... of {width} x {height} pixels, found "
            f"{', '.join(parts[0].channels[:8])} of {wide} x {tall}"
        )
    images = {key: read_channels(path, {each.part: each.channels})[each.part] for key, each in layers.layers.items()}
    return layers.samples(images)


def _look(folder: BmfrFolder, stated: bool | None) -> BmfrFolder:
    """Determine properties that are not stated from the values of the first frame."""
    number = folder.numbers[0]
    # Skip stated properties, and do not read the pixels of a file twice.
    looked_at = {"position", "normal"} | ({"color", "albedo", "reference"} if stated is None else set())
    images = {
        name: folder._read(name, files[number])[0].permute(1, 2, 0).numpy()
        for name, files in folder.files.items()
        if name in looked_at and number in files
    }
    words = {name: "" for name in sorted(folder.files) if folder.files[name]}
    words |= {name: "the parts add up to the color" for name in ("diffuse", "specular") if name in words}
    words |= {"samples": "their mean is the color"} if "samples" in words else {}
    warnings = list(folder.warnings)
    motion: Convention | None = USUAL_MOTION
    if "motion" in words:
        motion, words["motion"], warnings = read_motion(_pairs(folder), USUAL_MOTION)
    has_albedo = stated is not False
    if "albedo" not in folder.files:
        words["color"] = "radiance"
    elif stated is not None:
        words["color"] = f"{'with' if stated else 'without'} albedo, as stated"
    else:
        has_albedo, words["color"], doubts = read_radiance(
            images["color"], np.clip(np.nan_to_num(images["albedo"]), 0, 1), images.get("reference"), None
        )
        warnings += doubts
    encoded = "normal" in images and normal_is_encoded(images["normal"])
    if encoded:
        words["normal"] = "stored as n/2 + 1/2, decoded"
    convention, cameras = "", folder.cameras
    if cameras is not None and "position" in images:
        position = images["position"]
        seen = (position != 0).any(-1)
        if "normal" in images:
            seen &= (images["normal"] != 0).any(-1)
        stated_matrix = cameras.view_projection(number, folder.size)
        convention, error = read_as(stated_matrix, position, seen)
        words["view_projection"] = (
            f"{convention or 'row vectors, y down'}: positions are seen {error:.2g} pixels from their own"
        )
        if convention == "unknown":
            seen = f"its cameras see the positions {error:.0f} pixels from their own, whichever way they are read"
            warnings.append(
                f"{MATRICES}, frame {number}: {fault(stated_matrix) or seen}, so no history is found; "
                "write the matrices of these frames"
            )
        elif convention:
            warnings.append(f"{MATRICES}: read as {convention}, since only so it sees the positions at their pixels")
    rows = [
        Row(name, MATRICES if name == "view_projection" else f"{_STEMS[name]}#.exr", said)
        for name, said in words.items()
    ]
    return replace(
        folder,
        color_has_albedo=has_albedo,
        encoded_normals=encoded,
        camera_convention=convention,
        motion=motion,
        table=rows,
        warnings=warnings,
        unused=_others(folder.path),
    )


def _pairs(folder: BmfrFolder) -> list[Pair]:
    """Pairs of consecutive frames, for determining the convention of their motion."""
    kept = [name for name in ("albedo", "normal") if folder.files.get(name)] or ["color"]

    def features(number: int) -> dict[str, Image]:
        found = {name: folder._read(name, folder.files[name][number])[0].permute(1, 2, 0).numpy() for name in kept}
        return {name: np.clip(np.nan_to_num(image), -1, 1) for name, image in found.items()}

    following = [(a, b) for a, b in pairwise(folder.numbers) if b == a + 1][:MOTION_PAIRS]
    motion = folder.files["motion"]
    return [
        (features(b), features(a), folder._read("motion", motion[b])[0].permute(1, 2, 0).numpy()) for a, b in following
    ]


def _others(path: Path) -> list[str]:
    """Images whose names the layout does not use, such as `normal#.exr`."""
    names = [each.name for each in find_files([path]) if not _KNOWN.fullmatch(each.name)]
    return list(dict.fromkeys(re.sub("[0-9]+", "#", name) for name in names))


def _find_noise_seeds(
    path: Path, numbers: list[int], first: ExrHeader, used: set[str]
) -> list[dict[str, dict[int, Path]]]:
    """Files of the noise seeds 1, 2, ..., up to the first seed that lacks a color and so is still being rendered."""
    found: list[dict[str, dict[int, Path]]] = []
    while os.path.isdir(folder := noise_seed_folder(path, 1 + len(found))):
        files = _list_files(folder, {name: _STEMS[name] for name in used})
        if not all(number in files["color"] for number in numbers):
            break
        own = {name: paths for name, paths in files.items() if any(number in paths for number in numbers)}
        for name, paths in own.items():
            for number in numbers:
                if number not in paths:
                    raise InputError(
                        f"{folder / f'{_STEMS[name]}{number}.exr'}: expected buffer '{name}' for every frame, found it "
                        "for some; render it, or remove them all"
                    )
                _check_header(name, paths[number], first)
        found.append(own)
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
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}); choose another folder") from error
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
        header = read_exr_header(path)
        whole = header.size == size[::-1] and header.origin == (0, 0) and len(header.channels) == channels
        return whole and bool(read_exr(path)[0].size)
    except InputError:
        return False


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
    place = folder / CLEAN
    try:
        place.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"{place}: cannot be created ({error.strerror}); choose another output folder") from error
    write_buffer(place, number, "albedo", albedo)
    write_buffer(place, number, "normal", normal)


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


def _check_header(name: str, path: Path, first: ExrHeader) -> None:
    """Check that a file has the channels of its buffer and the data window of the first color."""
    header = read_exr_header(path)
    _check_file(name, path, header.size, header.channels, first.size)
    if header.origin != first.origin:
        (top, left), (first_top, first_left) = header.origin, first.origin
        raise InputError(
            f"{path}: expected a data window that begins at {first_left}, {first_top} like that of the first color "
            f"file, found {left}, {top}; render all buffers and frames in one window"
        )


def _check_file(
    name: str, path: Path, size: Iterable[int], channels: list[str], expected_size: tuple[int, int]
) -> None:
    expected = BUFFERS[name].channels if name in BUFFERS else len(channels)
    if len(channels) != expected:
        raise InputError(
            f"{path}: expected {expected} channels for buffer '{name}', found {len(channels)} "
            f"({', '.join(channels[:8])}); write only those that belong to it"
        )
    height, width = size
    if (height, width) != expected_size:
        raise InputError(
            f"{path}: expected {expected_size[1]} x {expected_size[0]} pixels like the first color file, "
            f"found {width} x {height}; render all buffers and frames at one size"
        )


def _color_has_albedo(path: Path, albedo_present: bool) -> bool | None:
    """Read it from ``camera.json``; ``None`` without that file: then the values have to tell."""
    description = path / _DESCRIPTION
    if not os.path.lexists(description):
        # Without albedo there is nothing to multiply by: this is ordinary radiance, not the published data.
        return None if albedo_present else True
    try:
        # Opening a pipe would block, and a device has no end.
        if not os.path.isfile(description):
            raise OSError("no file")
        with description.open(encoding="utf-8") as file:
            content = json.loads(file.read(_LARGEST_DESCRIPTION))
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


def _view_depth(matrix: Array, position: Tensor) -> tuple[Array, Tensor]:
    """Clip w of every position, and the matrix with the sign that makes it positive in front of the camera."""
    factors = torch.from_numpy(matrix[:3, 3])
    # Row by row, because a large image takes much memory in float64.
    w = torch.stack([row.double().T @ factors + matrix[3, 3] for row in position[0].unbind(1)])
    # A matrix and its negative give the same projection; visible points lie in front.
    if w[w.isfinite()].median() < 0:
        matrix, w = -matrix, -w
    return matrix, w.float()[None, None]


def _with_infinite_background(depth: Tensor, albedo: Tensor | None, normal: Tensor | None) -> Tensor:
    """Set depth to infinity where nothing was hit: at depth 0, behind the camera, or without albedo and normal."""
    nothing = torch.from_numpy(nothing_hit(depth.numpy()))
    if albedo is not None and normal is not None:
        # Both must be zero: mirrors and glass have no albedo, but they have a normal.
        nothing |= ((albedo == 0) & (normal == 0)).all(dim=1, keepdim=True)
    return torch.where(nothing, torch.inf, depth)
