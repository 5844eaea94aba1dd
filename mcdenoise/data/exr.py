"""Reading and writing EXR files of one float image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from mcdenoise.data.files import atomic_path, cannot_write
from mcdenoise.data.images import (
    STORAGE_PREFIXES,
    Image,
    Metadata,
    MetadataValue,
    check_name,
    pending_error,
    read_last_rows,
    read_picture,
)
from mcdenoise.errors import InputError

LARGEST_HALF = 65504.0
# Rows to convert and compress at a time: enough for all cores, and little compared with a large image.
_ROWS = 256
_TUPLE_TYPES = {"FramesPerSecond": "rational", "smpte:TimeCode": "timecode"}


def read_exr(path: Path) -> tuple[Image, list[str], Metadata]:
    """Read an EXR file.

    Args:
        path: the file. If it has several parts, the first one is read.

    Returns:
        The pixels of the data window as float32 ``(H, W, C)``, top row first; the C channel names; and the attributes
        that describe the picture.

    Raises:
        InputError: the file is missing, not an EXR, deep, damaged or unreasonably large, or holds whole numbers.
    """
    _, header, pixels = read_picture(path)
    part = header.parts[0]
    if header.format != "openexr" or part.integers:
        # OpenImageIO scales integers by 2^-32.
        found = "whole numbers" if part.integers else f"a {header.format} file"
        raise InputError(f"{path}: expected an EXR image, found {found}; render a flat EXR of floats")
    return pixels, list(part.channels), header.metadata


def write_exr(
    path: Path,
    image: NDArray[Any],
    channels: Sequence[str],
    *,
    full_float: bool = False,
    metadata: Mapping[str, MetadataValue] | None = None,
) -> None:
    """Write an EXR file with ZIP compression, atomically.

    Args:
        path: the file. Its folder must exist.
        image: ``(H, W, C)`` pixels, top row first.
        channels: C channel names.
        full_float: whether to store 32-bit floats; otherwise half floats, clamped to 65504.
        metadata: attributes to keep, as :func:`read_exr` returns them.

    Raises:
        InputError: the file cannot be written.
        ValueError: ``image`` and ``channels`` do not match.
    """
    if image.ndim != 3 or 0 in image.shape or image.shape[2] != len(channels):
        raise ValueError(
            f"image: expected shape (H, W, {len(channels)}) for channels {list(channels)}, found {image.shape}"
        )
    check_name(path)
    height, width, count = image.shape
    spec = oiio.ImageSpec(width, height, count, "float" if full_float else "half")
    spec.channelnames = tuple(channels)
    for name, value in (metadata or {}).items():
        if name.startswith(STORAGE_PREFIXES):
            continue
        if isinstance(value, tuple):
            spec.attribute(name, oiio.TypeDesc(_TUPLE_TYPES.get(name, f"float[{len(value)}]")), value)
        else:
            spec.attribute(name, value)
    spec.attribute("compression", "zip")
    write_image(path, spec, image)


def write_image(path: Path, spec: oiio.ImageSpec, image: NDArray[Any]) -> None:
    """Write a file of one image atomically, in the format that its name says.

    Not by ImageBuf, which leaves an entry per file in OpenImageIO's cache and fragments the heap.

    Raises:
        InputError: the file cannot be written.
    """
    with atomic_path(path) as temporary:
        if reason := _write(temporary, spec, image).replace(str(temporary), path.name):
            raise cannot_write(path, reason)


def _write(path: Path, spec: oiio.ImageSpec, image: NDArray[Any]) -> str:
    """Write the file; return the reason of a failure, or an empty text."""
    file = oiio.ImageOutput.create(str(path))
    if file is None or not file.open(str(path), spec):
        return pending_error(file or oiio) or "writing failed"
    if file.format_name() == "openexr":
        tops = range(0, spec.height, _ROWS)
        strips = (np.asarray(image[top : top + _ROWS], np.float32) for top in tops)
        half = spec.format == oiio.HALF
        written = all(
            file.write_scanlines(top, top + len(strip), 0, np.ascontiguousarray(within_half(strip) if half else strip))
            for top, strip in zip(tops, strips, strict=True)
        )
    else:
        written = file.write_image(np.ascontiguousarray(image))
    reason = pending_error(file)
    if not file.close() or not written:
        return reason or "writing failed"
    try:
        read_last_rows(path)
    except InputError as error:
        return f"incomplete: {error}"
    return ""


def within_half(pixels: NDArray[Any]) -> NDArray[Any]:
    """Clamp pixels to the range of half floats; NaN is kept.

    Otherwise rounding would turn a firefly into infinity, which spreads through every later filter.
    """
    clipped: NDArray[Any] = np.clip(pixels, -LARGEST_HALF, LARGEST_HALF)
    return clipped
