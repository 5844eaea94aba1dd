"""The data sets of Noisebase: samples of each pixel in zipped Zarr arrays (Balint et al., NPPD, SIGGRAPH 2023).

One zip holds a frame (test sets) or a sequence whose arrays have a first axis of frames (training set). The arrays have
Zarr's format 2, channels first and samples last, in chunks compressed by Blosc. They are read chunk by chunk, and each
chunk is checked before it is decompressed, so that a sequence of terabytes needs only the memory for one frame's means.
"""

from __future__ import annotations

import json
import math
import os
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mcdenoise.data.camera_matrices import Array
from mcdenoise.data.exr import LARGEST_PIXEL_COUNT, Image, Mask, Metadata, write_exr
from mcdenoise.data.readers.names import group_files
from mcdenoise.data.readers.values import Row
from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.motion import miss

SUFFIX = ".zip"
# Channels and dtypes of the arrays. The arrays of a frame are [C, H, W, S], or [C, H, W] for the reference.
_IMAGES = {
    "color": (4, "|u1"),
    "diffuse": (3, "<f2"),
    "normal": (3, "<f2"),
    "position": (3, "<f4"),
    "motion": (3, "<f4"),
    "reference": (3, "<f4"),
}
_NUMBERS = {"exposure": ((2,), "<f4"), "view_proj_mat": ((4, 4), "<f4"), "crop_offset": ((2,), "<i4")}
# These arrays are redundant with `view_proj_mat`.
_SILENT = {"camera_position", "camera_target", "camera_up", "proj_mat"}
# Sizes of the full images from which training crops and test frames were cut.
_RENDERED = (1080, 1920)
# Largest compression ratio of a chunk: LZ4's limit is 255. Small chunks are harmless.
_LARGEST_RATIO, _SMALL = 300, 2**16
_LARGEST_DESCRIPTION, _LARGEST_SAMPLES, _BLOSC_HEADER = 2**16, 4096, 16
# Largest median reprojection error in pixels: samples are spread over a pixel.
_NEAR = 1.5


@dataclass(frozen=True)
class _ZarrArray:
    """The contents of a ``.zarray``."""

    name: str
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dtype: np.dtype[Any]
    compressed: bool
    separator: str

    @property
    def chunk_bytes(self) -> int:
        return math.prod(self.chunks) * self.dtype.itemsize


@dataclass
class NoisebaseFiles:
    """Frames of one sequence; made by :func:`open_noisebase`.

    Args:
        files: the zip of each frame.
        axis: whether the arrays have an axis of frames.
        numbers: frames in use, ascending.
        size: height and width in pixels.
        arrays: names of the arrays that every zip has.
        view: size of the full image of the matrices, and whether the files' crop offset applies; ``None`` if positions
            are not projected to their pixels either way.
        table: the source of each buffer.
        warnings: probable mistakes.
        unused: arrays that are not used.
    """

    files: Mapping[int, Path]
    axis: bool
    numbers: list[int]
    size: tuple[int, int]
    arrays: frozenset[str]
    view: tuple[tuple[int, int], bool] | None = None
    table: Sequence[Row] = ()
    warnings: Sequence[str] = ()
    unused: Sequence[str] = ()
    color_has_albedo: bool = True
    noise_seeds: int = 1
    samples: int = 1

    @property
    def folders(self) -> set[Path]:
        """The folders of the files."""
        return {path.parent for path in self.files.values()}

    @property
    def buffers(self) -> frozenset[str]:
        """Names of the buffers that every frame has."""
        present = {"color"} | ({"variance", "samples"} if self.samples > 1 else set())
        present |= {own for own, name in _SOURCES.items() if name in self.arrays}
        if {"position", "motion"} <= self.arrays:
            present.add("previous_position")
        if self.view is not None:
            present |= {"view_projection", "depth"}
        return frozenset(present)

    @property
    def reference_numbers(self) -> list[int]:
        """Frames in use that have a reference: all or none."""
        return self.numbers if "reference" in self.arrays else []

    def frame_files(self, number: int) -> list[Path]:
        """The zip of one frame, or of all frames."""
        return [self.files[number]]

    def metadata(self, number: int) -> Metadata:
        """Empty, because the arrays have no attributes."""
        return {}

    def reference(self, number: int) -> Tensor:
        """Read the reference of one frame."""
        with _opened(self.files[number]) as file:
            return _tensor(_mean(file, _described(file, "reference"), self._index(number)))

    def frame(
        self, number: int, *, reference: bool = True, noise_seed: int = 0, buffers: Collection[str] | None = None
    ) -> Frame:
        """Read one frame; see :meth:`mcdenoise.data.Sequence.frame`.

        ``color`` is the mean over the samples, and ``variance`` the variance of this mean; features are means, too.
        """
        index = self._index(number)
        sampled = self.samples > 1 and (buffers is None or "samples" in buffers)
        samples = np.empty((self.samples, 3, *self.size), np.float32) if sampled else None
        with _opened(self.files[number]) as file:
            exposure = self._numbers(file, "exposure", index)
            color, variance = _radiance(file, _described(file, "color"), exposure, index, samples)
            means = {
                name: _mean(file, _described(file, name), index)
                for name in _IMAGES
                if name in self.arrays and name != "color" and (reference or name != "reference")
            }
            matrix = self._matrix(file, index) if self.view is not None else None
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

    def write(self, out: Path, number: int, image: Image, *, full_float: bool = False) -> Path:
        """Write an EXR with R, G, B, named after the zip, because the arrays hold samples rather than images.

        If one zip holds all frames, the frame number is appended to the name. There is neither alpha nor a layer. See
        :meth:`mcdenoise.data.Sequence.write`.
        """
        source = self.files[number]
        target = out / (f"{source.stem}_{number:04d}.exr" if self.axis else f"{source.stem}.exr")
        write_exr(target, image, ["R", "G", "B"], full_float=full_float)
        return target

    def _index(self, number: int) -> int | None:
        return number if self.axis else None

    def _numbers(self, file: zipfile.ZipFile, name: str, index: int | None) -> Array:
        ((_, values),) = _pieces(file, _described(file, name), index)
        if not np.isfinite(values).all():
            raise _damaged(file, f"numbers in '{name}' that are not finite")
        return values.astype(np.float64)

    def _matrix(
        self, file: zipfile.ZipFile, index: int | None, view: tuple[tuple[int, int], bool] | None = None
    ) -> Array:
        """World-to-clip matrix for row vectors, y down, of the crop; the files have y up and the full image."""
        whole, cropped = view or self.view or (self.size, False)
        top, left = self._numbers(file, "crop_offset", index) if cropped else (0, 0)
        given = self._numbers(file, "view_proj_mat", index)
        matrix: Array = given.copy()
        for column, sign, begin, part, full in (
            (0, 1, left, self.size[1], whole[1]),
            (1, -1, top, self.size[0], whole[0]),
        ):
            matrix[:, column] = given[:, column] * sign * full / part + given[:, 3] * ((full - 2 * begin) / part - 1)
        return matrix


# Array of each buffer that is read from a single array.
_SOURCES = {"albedo": "diffuse", "normal": "normal", "position": "position", "reference": "reference"}


def find_zips(given: Sequence[Path]) -> list[Path]:
    """The zips among the given files, or in the given folder; empty if there are other files."""
    if len(given) == 1 and os.path.isdir(given[0]):
        try:
            names = sorted(name for name in os.listdir(given[0]) if not name.startswith("."))
        except OSError:
            return []
        return [given[0] / name for name in names] if all(Path(each).suffix == SUFFIX for each in names) else []
    return list(given) if all(path.suffix == SUFFIX for path in given) else []


def open_noisebase(
    paths: Sequence[Path], choose_numbers: Callable[[list[int]], list[int]], *, where: str
) -> NoisebaseFiles:
    """Check zips, and whether the first frame's positions are projected to their pixels.

    Args:
        paths: one zip for a sequence, or one for each frame.
        choose_numbers: selects the frames to use.
        where: description of the files, for messages.

    Raises:
        InputError: the package numcodecs is missing; or a zip is damaged, has other contents or differs from the first
            one.
    """
    first = _shapes(paths[0])
    axis = len(first["color"]) == 5
    if axis:
        if len(paths) > 1:
            raise InputError(f"{where}: expected one sequence, found {len(paths)}; give one of its files")
        files = dict.fromkeys(range(first["color"][0]), paths[0])
    else:
        groups, _ = group_files(paths)
        if len(groups) != 1:
            raise InputError(
                f"{where}: expected the frames of one sequence, found files of {len(groups)} names; give those of one"
            )
        files = dict(groups[0].files)
    numbers = choose_numbers(sorted(files))
    for path in dict.fromkeys(files[number] for number in numbers):
        if (found := _shapes(path)) != first:
            name = next(name for name in {**first, **found} if first.get(name) != found.get(name))
            raise InputError(
                f"{path}: expected array '{name}' of shape {first.get(name)} as in the first frame, found "
                f"{found.get(name)}; choose frames of one sequence"
            )
    height, width, samples = first["color"][-3:]
    known = frozenset(first) & {*_IMAGES, *_NUMBERS}
    shot = NoisebaseFiles(files, axis, numbers, (height, width), known, samples=samples)
    shot.unused = sorted(first.keys() - known - _SILENT)
    _look(shot)
    return shot


def _look(shot: NoisebaseFiles) -> None:
    """Determine the full image of the matrices from the positions of the first frame."""
    mean = f"mean of {shot.samples} samples"
    words = {"color": f"radiance, {mean}", "variance": f"variance of the {mean}", "reference": "radiance"}
    words["samples"] = f"{shot.samples} of a pixel: radiance"
    if {"position", "view_proj_mat"} <= shot.arrays:
        number = shot.numbers[0]
        index = shot._index(number)
        with _opened(shot.files[number]) as file:
            present = [name for name in ("position", "normal", "diffuse") if name in shot.arrays]
            means: dict[str, Array] = {name: _mean(file, _described(file, name), index) for name in present}
            position, seen = means["position"].transpose(1, 2, 0), _seen(means)
            views = [(shot.size, False)] + [
                (whole, cropped)
                for cropped in ([True] if "crop_offset" in shot.arrays else [])
                for whole in (_RENDERED, shot.size)
            ]
            misses = [miss(shot._matrix(file, index, view), position, seen) for view in views]
        best = int(np.argmin(misses))
        if misses[best] <= _NEAR:
            shot.view = views[best]
            (tall, wide), cropped = shot.view
            crop = f", cropped from {wide} x {tall}" if cropped else ""
            words["view_projection"] = f"positions are seen {misses[best]:.2g} pixels from their own{crop}"
            words["depth"] = "clip w of the positions"
        else:
            shot.warnings = [
                f"view_proj_mat: does not see the positions at their pixels (they miss by {min(misses):.0f}); cameras "
                "are not used"
            ]
    arrays = {**_SOURCES, "previous_position": "position + motion", "view_projection": "view_proj_mat"}
    shot.table = [
        Row(name, arrays.get(name, "position" if name == "depth" else "color"), words.get(name, mean))
        for name in sorted(shot.buffers)
    ]


def _seen(means: Mapping[str, Array]) -> Mask:
    """The pixels that hit something: those with a normal or a reflectance in any sample."""
    told = [means[name] for name in ("normal", "diffuse") if name in means]
    seen: Mask = np.all(np.isfinite(means["position"]), axis=0)
    if told:
        seen &= (np.concatenate(told) != 0).any(0)
    return seen


def _radiance(
    file: zipfile.ZipFile, array: _ZarrArray, exposure: Array, index: int | None, samples_out: Image | None = None
) -> tuple[Array, Array | None]:
    r"""Mean radiance ``(3, H, W)`` and the variance of the mean, ``None`` for one sample; fills ``(S, 3, H, W)``.

    A sample is :math:`c / 255 \exp(e (b - a) + a)` of its three bytes c, with :math:`e = (E + 1) / 256` of its fourth
    and the exposure (a, b), natural logarithms.
    """
    height, width, samples = array.shape[-3:]
    low, high = exposure
    scale = np.exp((np.arange(256) + 1) / 256 * (high - low) + low) / 255
    total, squares = np.zeros((3, height, width)), np.zeros((3, height, width))
    for (_, rows, columns, which), piece in _pieces(file, array, index):
        radiance = piece[:3] * scale[piece[3]]
        if samples_out is not None:
            samples_out[which, :, rows, columns] = np.moveaxis(radiance, -1, 0)
        total[:, rows, columns] += radiance.sum(-1)
        squares[:, rows, columns] += (radiance**2).sum(-1)
    mean = total / samples
    if samples == 1:
        return mean, None
    return mean, np.maximum(squares / samples - mean**2, 0) / (samples - 1)


def _mean(file: zipfile.ZipFile, array: _ZarrArray, index: int | None) -> Array:
    """``(C, H, W)`` mean over the samples, if there are several."""
    sampled = array.name != "reference"
    count = array.shape[-1] if sampled else 1
    places = array.shape[-4:-1] if sampled else array.shape[-3:]
    total = np.zeros(places)
    for where, piece in _pieces(file, array, index):
        total[where[:3]] += piece.sum(-1, dtype=np.float64) if sampled else piece
    return total / count


def _pieces(file: zipfile.ZipFile, array: _ZarrArray, index: int | None) -> Iterator[tuple[tuple[slice, ...], Array]]:
    """The chunks of a frame with their positions, one after the other."""
    first = 0 if index is None else 1
    lead = [] if index is None else [index // array.chunks[0]]
    counts = [math.ceil(n / m) for n, m in zip(array.shape, array.chunks, strict=True)][first:]
    for place in product(*map(range, counts)):
        chunk = _chunk(file, array, [*lead, *place])
        if index is not None:
            chunk = chunk[index % array.chunks[0]]
        where = tuple(
            slice(i * m, min((i + 1) * m, n))
            for i, m, n in zip(place, array.chunks[first:], array.shape[first:], strict=True)
        )
        yield where, chunk[tuple(slice(0, each.stop - each.start) for each in where)]


def _chunk(file: zipfile.ZipFile, array: _ZarrArray, place: Sequence[int]) -> Array:
    content = _read(file, f"{array.name}/{array.separator.join(map(str, place))}", array.chunk_bytes + _BLOSC_HEADER)
    if array.compressed:
        # Compare the chunk's stated size with the expected one before memory is allocated.
        promised = int.from_bytes(content[4:8], "little") if len(content) >= _BLOSC_HEADER else -1
        if promised != array.chunk_bytes or promised > _LARGEST_RATIO * len(content) + _SMALL:
            raise _damaged(file, f"a chunk of '{array.name}' of another size")
        values = np.empty(array.chunks, array.dtype)
        _blosc().Blosc().decode(content, out=values)
        return values
    if len(content) != array.chunk_bytes:
        raise _damaged(file, f"a chunk of '{array.name}' of another size")
    return np.frombuffer(content, array.dtype).reshape(array.chunks)


def _read(file: zipfile.ZipFile, name: str, limit: int) -> bytes:
    info = file.getinfo(name)
    if info.file_size > min(limit, _LARGEST_RATIO * info.compress_size + _SMALL):
        raise _damaged(file, f"'{name}' of {info.file_size} bytes")
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        # These are decompressed whole, whatever size is stated.
        raise _damaged(file, f"'{name}' compressed by another method than deflate")
    with file.open(info) as stream:
        # With a size, no more than that is decompressed.
        content = stream.read(info.file_size)
    if len(content) != info.file_size:
        raise _damaged(file, f"'{name}' of {len(content)} bytes instead of {info.file_size}")
    return content


def _shapes(path: Path) -> dict[str, tuple[int, ...]]:
    """Shapes of the arrays of a zip; known arrays are checked, and all their chunks must exist."""
    _blosc()
    with _opened(path) as file:
        entries = set(file.namelist())
        names = sorted(name.removesuffix("/.zarray") for name in entries if name.endswith("/.zarray"))
        if not {"color", "exposure"} <= set(names):
            raise _damaged(file, f"arrays {', '.join(names[:8]) or 'of no kind'} without 'color' and 'exposure'")
        found = {name: _described(file, name) for name in names if name in _IMAGES or name in _NUMBERS}
        color = found["color"].shape
        lead = color[:-4]
        height, width, samples = color[-3:] if len(color) >= 4 else (0, 0, 0)
        if len(lead) > 1 or not (0 < height * width <= LARGEST_PIXEL_COUNT and 0 < samples <= _LARGEST_SAMPLES):
            raise _damaged(file, f"'color' of shape {color}")
        for name, array in found.items():
            shape, kind = (
                ((_IMAGES[name][0], height, width, samples), _IMAGES[name][1]) if name in _IMAGES else _NUMBERS[name]
            )
            shape = (*lead, *(shape[:3] if name == "reference" else shape))
            if array.shape != shape or array.dtype != np.dtype(kind):
                raise _damaged(file, f"'{name}' of {array.dtype} {array.shape} beside 'color' {color}")
            # Small arrays, and the bytes of one sample, must be in one chunk.
            whole = array.shape[len(lead) :] if name in _NUMBERS else array.shape[len(lead) :][: name == "color"]
            if array.chunks[len(lead) :][: len(whole)] != whole:
                raise _damaged(file, f"chunks of '{name}' of shape {array.chunks}")
            counts = [math.ceil(n / m) for n, m in zip(array.shape, array.chunks, strict=True)]
            # Zarr would read a missing chunk as zeros, that is, as black.
            if math.prod(counts) > len(entries) or any(
                f"{name}/{array.separator.join(map(str, place))}" not in entries
                for place in product(*map(range, counts))
            ):
                raise _damaged(file, f"'{name}' without all of its chunks")
        return {name: found[name].shape if name in found else () for name in names}


def _described(file: zipfile.ZipFile, name: str) -> _ZarrArray:
    content = json.loads(_read(file, f"{name}/.zarray", _LARGEST_DESCRIPTION))
    compressor = content["compressor"]
    shape, chunks = (tuple(content[key]) for key in ("shape", "chunks"))
    separator = content.get("dimension_separator", ".")
    if content["zarr_format"] != 2 or content["order"] != "C" or content.get("filters") or separator not in ("./"):
        raise _damaged(file, f"'{name}' in another format than Zarr 2")
    if compressor is not None and compressor["id"] != "blosc":
        raise _damaged(file, f"'{name}' compressed by {compressor['id']}")
    if len(shape) != len(chunks) or not all(isinstance(n, int) and 0 < n < 2**31 for n in (*shape, *chunks)):
        raise _damaged(file, f"'{name}' of shape {shape} in chunks of {chunks}")
    return _ZarrArray(name, shape, chunks, np.dtype(str(content["dtype"])), compressor is not None, separator)


@contextmanager
def _opened(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open a zip, and convert every error to one line."""
    if not os.path.isfile(path):
        raise InputError(f"{path}: expected a zip of Noisebase, found none; check the path")
    try:
        with zipfile.ZipFile(path) as file:
            yield file
    except InputError:
        raise
    except MemoryError as error:
        raise InputError(f"{path}: expected a zip of Noisebase, found no memory for a frame of it") from error
    # zipfile, json and numcodecs raise a dozen different exceptions for damaged data.
    except Exception as error:
        reason = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise InputError(f"{path}: expected a zip of Noisebase, found it damaged ({reason}); copy it again") from error


def _damaged(file: zipfile.ZipFile, found: str) -> InputError:
    return InputError(f"{file.filename}: expected a zip of Noisebase, found {found[:300]}; copy it again")


def _blosc() -> Any:
    try:
        from numcodecs import blosc
    except ImportError as error:
        raise InputError(
            "noisebase: expected the package numcodecs, found none; install it with pip install 'mcdenoise[noisebase]'"
        ) from error
    return blosc


def _tensor(image: Array) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(image, dtype=np.float32))[None]
