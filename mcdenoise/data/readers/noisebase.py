"""The data sets of Noisebase: samples of each pixel in zipped Zarr arrays (Balint et al., NPPD, SIGGRAPH 2023).

One zip holds a frame (test sets) or a sequence whose arrays have a first axis of frames (training set). The arrays have
Zarr's format 2, channels first and samples last, in chunks compressed by Blosc. The package zarr reads them, a strip of
chunks at a time, so that a sequence of terabytes needs only the memory for one frame's means. What a file declares is
checked before zarr allocates it, and no codec but Blosc is called.
"""

from __future__ import annotations

import math
import os
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from mcdenoise.data.exr import write_exr
from mcdenoise.data.files import listed
from mcdenoise.data.images import LARGEST_PIXEL_COUNT, Image, Mask
from mcdenoise.data.readers.names import group_files
from mcdenoise.data.readers.sequence import Denoised
from mcdenoise.data.readers.sequence import Sequence as FrameSequence
from mcdenoise.data.readers.values import Row
from mcdenoise.errors import InputError, import_optional
from mcdenoise.frame import Frame
from mcdenoise.motion import Array, miss
from mcdenoise.reading import expecting

if TYPE_CHECKING:
    from torch import Tensor
    from zarr import Array as ZarrArray

SUFFIX = ".zip"
# Shapes and dtypes of the arrays of a frame, with its height, width and number of samples.
_ARRAYS = {
    "color": ("4HWS", "|u1"),
    "diffuse": ("3HWS", "<f2"),
    "normal": ("3HWS", "<f2"),
    "position": ("3HWS", "<f4"),
    "motion": ("3HWS", "<f4"),
    "reference": ("3HW", "<f4"),
    "exposure": ("2", "<f4"),
    "view_proj_mat": ("44", "<f4"),
    "crop_offset": ("2", "<i4"),
}
_IMAGES = {name for name, (shape, _) in _ARRAYS.items() if "H" in shape}
# These arrays are redundant with `view_proj_mat`.
_REDUNDANT = {"camera_position", "camera_target", "camera_up", "proj_mat"}
# The array of each buffer that is read from a single array.
_SOURCES = {"albedo": "diffuse", "normal": "normal", "position": "position", "reference": "reference"}
# Sizes of the full images from which training crops and test frames were cut.
_RENDERED = (1080, 1920)
# Largest compression ratio of a chunk: LZ4's limit is 255. Small chunks are harmless.
_LARGEST_RATIO, _SMALL = 300, 2**16
_LARGEST_SAMPLES, _BLOSC_HEADER = 4096, 16
# Largest median reprojection error in pixels: samples are spread over a pixel.
_NEAR = 1.5


class _Arrays:
    """The arrays of one zip, or of one frame in it.

    Args:
        file: the zip.
        index: the frame, if the arrays have an axis of frames.
    """

    def __init__(self, file: zipfile.ZipFile, index: int | None = None) -> None:
        import zarr

        class Checked(zarr.storage.ZipStore):
            async def get(store, key: str, prototype: Any, byte_range: Any = None) -> Any:
                return prototype.buffer.from_bytes(self._read(key)) if key in file.NameToInfo else None

        self.file, self.lead = file, () if index is None else (index,)
        # The store's own handle only lists names.
        self._store = Checked(str(file.filename))
        # Bytes of a chunk of each array that is compressed.
        self._promised: dict[str, int] = {}

    def array(self, name: str) -> ZarrArray[Any]:
        """An array, of which nothing is read yet."""
        import zarr

        array = zarr.open_array(self._store, path=name, mode="r", zarr_format=2)
        if array.compressors:
            self._promised[name] = math.prod(array.chunks) * array.dtype.itemsize
        return array

    def _read(self, key: str) -> bytes:
        """Read a member of the zip: at most the bytes that it says, which must not be too many for its size."""
        info = self.file.getinfo(key)
        name, _, chunk = key.partition("/")
        described = chunk.startswith(".z")
        if info.file_size > (_SMALL if described else _LARGEST_RATIO * info.compress_size + _SMALL):
            raise ValueError(f"'{key}' of {info.file_size} bytes")
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            # These are decompressed whole, whatever size is stated.
            raise ValueError(f"'{key}' compressed by another method than deflate")
        with self.file.open(info) as stream:
            # With a size, no more than that is decompressed.
            content = stream.read(info.file_size)
        # Blosc allocates what a chunk says that it holds.
        promised = -1 if len(content) < _BLOSC_HEADER else int.from_bytes(content[4:8], "little")
        if len(content) != info.file_size or (not described and promised != self._promised.get(name, promised)):
            raise ValueError(f"'{key}' of another size than is stated")
        return content

    def whole(self, name: str) -> Array:
        """An array without samples."""
        return np.asarray(self.array(name)[(*self.lead, ...)], np.float64)

    def numbers(self, name: str) -> Array:
        """A small array; its numbers must be finite."""
        values = self.whole(name)
        if not np.isfinite(values).all():
            raise ValueError(f"numbers in '{name}' that are not finite")
        return values

    def pieces(self, name: str) -> Iterator[tuple[slice, slice, Any]]:
        """Rows and samples, and the values of all columns of these, for a strip of chunks at a time."""
        array = self.array(name)
        (height, _, samples), (tall, _, several) = array.shape[-3:], array.chunks[-3:]
        for top, first in product(range(0, height, tall), range(0, samples, several)):
            rows, which = slice(top, min(top + tall, height)), slice(first, min(first + several, samples))
            yield rows, which, array[(*self.lead, slice(None), rows, slice(None), which)]

    def mean(self, name: str) -> Array:
        """``(C, H, W)`` mean over the samples, if there are several."""
        if "S" not in _ARRAYS[name][0]:
            return self.whole(name)
        shape = self.array(name).shape
        total = np.zeros(shape[-4:-1])
        for rows, _, values in self.pieces(name):
            total[:, rows] += values.sum(-1, dtype=np.float64)
        return total / shape[-1]

    def radiance(self, samples_out: Image | None = None) -> tuple[Array, Array | None]:
        r"""Mean ``(3, H, W)`` and the variance of the mean, ``None`` for one sample; fills ``(S, 3, H, W)``.

        A sample is :math:`c / 255 \exp(e (b - a) + a)` of its three bytes c, with :math:`e = (E + 1) / 256` of its
        fourth and the exposure (a, b), natural logarithms.
        """
        height, width, samples = self.array("color").shape[-3:]
        low, high = self.numbers("exposure")
        scale = np.exp((np.arange(256) + 1) / 256 * (high - low) + low) / 255
        total, squares = np.zeros((3, height, width)), np.zeros((3, height, width))
        for rows, which, values in self.pieces("color"):
            radiance = values[:3] * scale[values[3]]
            if samples_out is not None:
                samples_out[which, :, rows] = np.moveaxis(radiance, -1, 0)
            total[:, rows] += radiance.sum(-1)
            squares[:, rows] += (radiance**2).sum(-1)
        mean = total / samples
        return mean, np.maximum(squares / samples - mean**2, 0) / (samples - 1) if samples > 1 else None

    def matrix(self, size: tuple[int, int], whole: tuple[int, int], cropped: bool) -> Array:
        """World-to-clip matrix for row vectors, y down, of a crop; the files have y up and the full image.

        Args:
            size: height and width of the crop.
            whole: height and width of the full image.
            cropped: whether the crop begins at the files' offset, or else at 0.
        """
        offset = self.numbers("crop_offset") if cropped else (0, 0)
        given = self.numbers("view_proj_mat")
        matrix: Array = given.copy()
        for axis, (column, sign) in enumerate(((1, -1), (0, 1))):
            part, full, begin = size[axis], whole[axis], offset[axis]
            matrix[:, column] = given[:, column] * sign * full / part + given[:, 3] * ((full - 2 * begin) / part - 1)
        return matrix


@dataclass
class _NoisebaseFiles(FrameSequence):
    """Frames of one sequence; made by :func:`open_noisebase`.

    Args:
        zips: the zip of each frame.
        shapes: shape of every array of a zip, of the same names and shapes in all; empty for those that are not read.
        view: size of the full image of the matrices, and whether the files' crop offset applies; ``None`` if positions
            are not projected to their pixels either way.
    """

    zips: Mapping[int, Path]
    shapes: Mapping[str, tuple[int, ...]]
    view: tuple[tuple[int, int], bool] | None = None

    @property
    def has_frames(self) -> bool:
        """Whether the arrays have an axis of frames."""
        return len(self.shapes["color"]) == 5

    @property
    def samples(self) -> int:
        """Number of samples of a pixel."""
        return self.shapes["color"][-1]

    @property
    def size(self) -> tuple[int, int]:
        height, width, _ = self.shapes["color"][-3:]
        return height, width

    @property
    def folders(self) -> set[Path]:
        return {path.parent for path in self.zips.values()}

    @property
    def buffers(self) -> frozenset[str]:
        present = {"color"} | ({"variance", "samples"} if self.samples > 1 else set())
        present |= {own for own, name in _SOURCES.items() if name in self.shapes}
        if {"position", "motion"} <= self.shapes.keys():
            present.add("previous_position")
        if self.view is not None:
            present |= {"view_projection", "depth"}
        return frozenset(present)

    @property
    def reference_numbers(self) -> list[int]:
        return self.numbers if "reference" in self.shapes else []

    @property
    def unused(self) -> list[str]:
        return sorted(self.shapes.keys() - _ARRAYS.keys() - _REDUNDANT)

    def _files(self, number: int) -> list[Path]:
        return [self.zips[number]]

    def opened(self, number: int) -> AbstractContextManager[_Arrays]:
        """The arrays of one frame."""
        return _opened(self.zips[number], number if self.has_frames else None)

    def _frame(self, number: int, reference: bool, noise_seed: int, buffers: Collection[str] | None) -> Frame:
        """Read means over samples: ``color``, features, and ``variance`` of the mean that the color is."""
        sampled = self.samples > 1 and (buffers is None or "samples" in buffers)
        samples = np.empty((self.samples, 3, *self.size), np.float32) if sampled else None
        wanted = self.shapes.keys() & _IMAGES - {"color", *(() if reference else ("reference",))}
        with self.opened(number) as arrays:
            color, variance = arrays.radiance(samples)
            means = {name: arrays.mean(name) for name in wanted}
            matrix = None if self.view is None else arrays.matrix(self.size, *self.view)
        found: dict[str, Any] = {own: _tensor(means[name]) for own, name in _SOURCES.items() if name in means}
        if {"position", "motion"} <= means.keys():
            found["previous_position"] = _tensor(means["position"] + means["motion"])
        if matrix is not None:
            w = np.einsum("chw,c->hw", means["position"], matrix[:3, 3]) + matrix[3, 3]
            depth = np.where(_seen(means) & (w > 0), w, np.inf)
            found |= {"depth": _tensor(depth[None]), "view_projection": torch.from_numpy(matrix).float()[None]}
        if variance is not None:
            found["variance"] = _tensor(variance)
        if samples is not None:
            found["samples"] = torch.from_numpy(samples)[None]
        return Frame(color=_tensor(color), **found)

    def _write(self, out: Path, number: int, result: Denoised) -> Path:
        """Write an EXR named after the zip, and the frame number if that holds all: its arrays hold no image."""
        source = self.zips[number]
        target = out / (f"{source.stem}_{number:04d}.exr" if self.has_frames else f"{source.stem}.exr")
        write_exr(target, result.image, ["R", "G", "B"], full_float=result.full_float)
        return target


def find_zips(given: Sequence[Path]) -> list[Path]:
    """The zips among the given files, or in the given folder; empty if there are other files."""
    if len(given) == 1 and os.path.isdir(given[0]):
        given = [each for each in listed(given[0]) if not each.name.startswith(".")]
    return list(given) if all(path.suffix == SUFFIX for path in given) else []


def open_noisebase(
    paths: Sequence[Path], choose_numbers: Callable[[list[int]], list[int]], *, where: str
) -> FrameSequence:
    """Check zips, and whether the first frame's positions are projected to their pixels.

    Args:
        paths: one zip for a sequence, or one for each frame.
        choose_numbers: selects the frames to use.
        where: description of the files, for messages.

    Raises:
        InputError: the package zarr is missing; or a zip is damaged, has other contents or differs from the first
            one.
    """
    first = _shapes(paths[0])
    shot = _NoisebaseFiles(numbers=[], zips={}, shapes=first)
    if shot.has_frames:
        if len(paths) > 1:
            raise InputError(f"{where}: expected one sequence, found {len(paths)}; give one of its files")
        shot.zips = dict.fromkeys(range(first["color"][0]), paths[0])
    else:
        groups, _ = group_files(paths)
        if len(groups) != 1:
            raise InputError(
                f"{where}: expected the frames of one sequence, found files of {len(groups)} names; give those of one"
            )
        shot.zips = groups[0].files
    shot.numbers = choose_numbers(sorted(shot.zips))
    for path in dict.fromkeys(shot.zips[number] for number in shot.numbers):
        # The first one has been looked at.
        if path != paths[0] and (found := _shapes(path)) != first:
            name = next(name for name in {**first, **found} if first.get(name) != found.get(name))
            raise InputError(
                f"{path}: expected array '{name}' of shape {first.get(name)} as in the first frame, found "
                f"{found.get(name)}; choose frames of one sequence"
            )
    _find_view(shot)
    return shot


def _find_view(shot: _NoisebaseFiles) -> None:
    """Determine the full image of the matrices from the positions of the first frame."""
    mean = f"mean of {shot.samples} samples"
    words = {"color": f"radiance, {mean}", "variance": f"variance of the {mean}", "reference": "radiance"}
    words["samples"] = f"{shot.samples} of a pixel: radiance"
    if {"position", "view_proj_mat"} <= shot.shapes.keys():
        views = [(shot.size, False)]
        if "crop_offset" in shot.shapes:
            views += [(whole, True) for whole in (_RENDERED, shot.size)]
        with shot.opened(shot.numbers[0]) as arrays:
            means = {name: arrays.mean(name) for name in ("position", "normal", "diffuse") if name in shot.shapes}
            position, seen = means["position"].transpose(1, 2, 0), _seen(means)
            misses = [miss(arrays.matrix(shot.size, *view), position, seen) for view in views]
        best = int(np.argmin(misses))
        if misses[best] <= _NEAR:
            shot.view = (tall, wide), cropped = views[best]
            crop = f", cropped from {wide} x {tall}" if cropped else ""
            words["view_projection"] = f"positions are seen {misses[best]:.2g} pixels from their own{crop}"
            words["depth"] = "clip w of the positions"
        else:
            shot.warnings = [
                f"view_proj_mat: does not see the positions at their pixels (they miss by {min(misses):.0f}); cameras "
                "are not used"
            ]
    arrays_of = {"previous_position": "position + motion", "view_projection": "view_proj_mat", "depth": "position"}
    shot.table = [
        Row(name, (_SOURCES | arrays_of).get(name, "color"), words.get(name, mean)) for name in sorted(shot.buffers)
    ]


def _seen(means: Mapping[str, Array]) -> Mask:
    """The pixels that hit something: those with a normal or a reflectance in any sample."""
    features = [means[name] for name in ("normal", "diffuse") if name in means]
    seen: Mask = np.all(np.isfinite(means["position"]), axis=0)
    if features:
        seen &= (np.concatenate(features) != 0).any(0)
    return seen


def _shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Shapes of the arrays of a zip; known arrays are checked, and all their chunks must exist."""
    with _opened(path) as arrays:
        file = arrays.file
        names = sorted(name.removesuffix("/.zarray") for name in file.namelist() if name.endswith("/.zarray"))
        if not {"color", "exposure"} <= set(names):
            raise ValueError(f"arrays {', '.join(names[:8]) or 'of no kind'} without 'color' and 'exposure'")
        found = {name: arrays.array(name) for name in names if name in _ARRAYS}
        color = found["color"].shape
        lead = color[:-4]
        height, width, samples = color[-3:] if len(color) >= 4 else (0, 0, 0)
        sides = {"H": height, "W": width, "S": samples}
        if len(lead) > 1 or not (0 < height * width <= LARGEST_PIXEL_COUNT and 0 < samples <= _LARGEST_SAMPLES):
            raise ValueError(f"'color' of shape {color}")
        for name, array in found.items():
            letters, kind = _ARRAYS[name]
            shape = (*lead, *(sides.get(letter) or int(letter) for letter in letters))
            if array.shape != shape or array.dtype != np.dtype(kind):
                raise ValueError(f"'{name}' of {array.dtype} {array.shape} beside 'color' {color}")
            _check_chunks(file, name, array)
        return {name: found[name].shape if name in found else () for name in names}


def _check_chunks(file: zipfile.ZipFile, name: str, array: ZarrArray[Any]) -> None:
    """Check that all chunks of an array exist, are of a size that the zip can hold, and need no codec but Blosc."""
    from numcodecs import Blosc

    if array.filters or not all(isinstance(codec, Blosc) for codec in array.compressors) or array.order != "C":
        raise ValueError(f"'{name}' with other codecs than Blosc, or in another order")
    sizes = [entry.file_size for entry in file.infolist() if entry.filename.startswith(f"{name}/")]
    # Zarr would read a missing chunk as zeros, that is, as black.
    if array.nchunks > len(sizes) or array.nchunks_initialized != array.nchunks:
        raise ValueError(f"'{name}' without all of its chunks")
    if math.prod(array.chunks) * array.dtype.itemsize > _LARGEST_RATIO * max(sizes) + _SMALL:
        raise ValueError(f"chunks of '{name}' of shape {array.chunks}")


@contextmanager
def _opened(path: Path, index: int | None = None) -> Iterator[_Arrays]:
    """Open a zip, and convert every error to one line."""
    if not os.path.isfile(path):
        raise InputError(f"{path}: expected a zip of Noisebase, found none; check the path")
    import_optional("zarr", "noisebase", "noisebase")
    # zipfile, zarr and numcodecs raise a dozen different exceptions for damaged data.
    with expecting(path, "a zip of Noisebase", (Exception,)), zipfile.ZipFile(path) as file:
        yield _Arrays(file, index)


def _tensor(image: Array) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(image, dtype=np.float32))[None]
