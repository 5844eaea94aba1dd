"""EXR files through OpenImageIO: float images in and out, every failure told in one line."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from mcdenoise.data.files import atomic_path
from mcdenoise.errors import InputError, is_unicode

Image: TypeAlias = NDArray[np.float32]
Mask: TypeAlias = NDArray[np.bool_]
MetadataValue: TypeAlias = str | int | float | tuple[float, ...]
Metadata: TypeAlias = dict[str, MetadataValue]

LARGEST_HALF = 65504.0
LARGEST_PIXEL_COUNT = 2**28
# Bytes to convert and compress at a time: enough for all cores, and little compared with a large image.
_ROWS = 256
# Largest number of black pixels per byte of a file: zlib's limit is 1032, and PXR24 first drops a quarter; DWA stores
# one number for 64, or two bytes for a run of 128.
_LARGEST_RATIO, _LARGEST_DWA_RATIO = 2_000, 70_000
# These attributes describe how one file stores its pixels, not the picture; the written file has its own.
_STORAGE_PREFIXES = ("oiio:", "openexr:", "compression", "textureformat")
_TUPLE_TYPES = {"FramesPerSecond": "rational", "smpte:TimeCode": "timecode"}


@dataclass(frozen=True)
class ExrHeader:
    """Header of an EXR file.

    Args:
        size: height and width of the data window in pixels.
        channels: channel names, in the order in which :func:`read_exr` returns them (R, G, B first).
        metadata: attributes that describe the picture: texts, numbers and tuples of numbers.
        origin: row and column of its first pixel in the display window.
    """

    size: tuple[int, int]
    channels: list[str]
    metadata: Metadata
    origin: tuple[int, int] = (0, 0)


def read_exr_header(path: Path) -> ExrHeader:
    """Read the header of an EXR file without its pixels.

    Args:
        path: the file. If it has several parts, the first one is read.

    Raises:
        InputError: see :func:`read_exr`; damaged pixels are not detected.
    """
    file, header = _open(path)
    file.close()
    return header


def read_exr(path: Path) -> tuple[Image, list[str], Metadata]:
    """Read an EXR file.

    Args:
        path: the file. If it has several parts, the first one is read.

    Returns:
        The pixels of the data window as float32 ``(H, W, C)``, top row first; the C channel names; and the attributes
        that describe the picture.

    Raises:
        InputError: the file is missing, not an EXR, deep, damaged or unreasonably large.
    """
    file, header = _open(path)
    try:
        pixels = file.read_image(0, 0, 0, len(header.channels), oiio.FLOAT)
        reason = pending_error(file)
    except MemoryError:
        pixels, reason = None, "not enough memory"
    finally:
        file.close()
    # A truncated file has an intact header; without this check its missing rows would be black.
    if pixels is None or reason:
        raise _unreadable(path, f"damaged or missing pixels ({reason})", "render or copy the file again")
    return np.asarray(pixels, dtype=np.float32).reshape(*header.size, -1), header.channels, header.metadata


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
        if not name.startswith(_STORAGE_PREFIXES):
            _set_attribute(spec, name, value)
    spec.attribute("compression", "zip")
    with atomic_path(path) as temporary:
        reason = _write(temporary, spec, image, full_float).replace(str(temporary), path.name)
        if reason:
            raise InputError(f"{path}: cannot be written ({reason}); check the folder, its permissions and free space")


def _open(path: Path) -> tuple[oiio.ImageInput, ExrHeader]:
    # Not Path.is_file, which raises an error for a name that is too long or a folder without access.
    if not os.path.isfile(path):
        raise _unreadable(path, what_is_at(path), "check the path")
    check_name(path)
    file = oiio.ImageInput.open(str(path))
    if file is None:
        reason = pending_error(oiio).replace(f"EXR Error ({path}): ", "")
        raise _unreadable(path, f"what cannot be opened ({reason})", "check that the file is an EXR and complete")
    spec = file.spec()
    found = ""
    if file.format_name() != "openexr":
        found = f"a {file.format_name()} file"
    elif spec.deep:
        found = "a deep image"
    elif spec.nchannels < 1:
        found = "no channels"
    elif any(str(kind) in ("uint", "int") for kind in (spec.format, *spec.channelformats)):
        # OpenImageIO would scale integers by 2^-32.
        found = "whole numbers"
    elif {"RY", "BY"} <= set(spec.channelnames):
        found = "luminance and chroma (Y, RY, BY), not R, G, B"
    elif file.seek_subimage(0, 1):
        found = "a texture of several resolutions"
    elif min(spec.width, spec.height) < 1 or spec.width * spec.height > LARGEST_PIXEL_COUNT:
        found = f"{spec.width} x {spec.height} pixels"
    elif is_hollow(path, spec, spec.width * spec.height * int(spec.pixel_bytes(True))):
        # Checked before memory is allocated.
        found = f"{spec.width} x {spec.height} pixels of {spec.nchannels} channels, but not the data for them"
    if found:
        file.close()
        raise _unreadable(path, found, "render a flat EXR of at most 2^28 pixels")
    # Errors of attributes, which the pixels do not need, would be taken for those of the pixels.
    pending_error(file)
    size, origin = (spec.height, spec.width), (spec.y, spec.x)
    return file, ExrHeader(size, list(spec.channelnames), picture_metadata(spec), origin)


def what_is_at(path: Path) -> str:
    """Describe what is at a path instead of a file, for messages."""
    if os.path.isdir(path):
        return "a folder"
    if os.path.exists(path):
        return "a device or a pipe"
    return "a link to nothing" if os.path.lexists(path) else "no such file"


def check_name(path: Path) -> None:
    """Reject a name that cannot be passed to OpenImageIO.

    Raises:
        InputError: the name is not valid UTF-8.
    """
    if not is_unicode(str(path)):
        raise InputError(f"{path}: expected a name in UTF-8, found other bytes; rename the file")


def is_hollow(path: Path, spec: oiio.ImageSpec, promised: int) -> bool:
    """Whether a header declares more pixels than its file can hold, whatever the compression."""
    dwa = str(spec.getattribute("compression")).startswith("dwa")
    ratio = _LARGEST_DWA_RATIO if dwa else _LARGEST_RATIO
    return promised > ratio * os.path.getsize(path)


def picture_metadata(spec: oiio.ImageSpec) -> Metadata:
    """The attributes that describe the picture rather than its storage."""
    kept: Metadata = {}
    for attribute in spec.extra_attribs:
        value = attribute.value
        if isinstance(value, str) and not value.isascii():
            value = _as_text(value)
        if isinstance(value, tuple) and not all(isinstance(item, int | float) for item in value):
            continue
        if isinstance(value, str | int | float | tuple) and not attribute.name.startswith(_STORAGE_PREFIXES):
            kept[_as_text(attribute.name)] = value
    return kept


def _as_text(text: str) -> str:
    """Decode bytes that are not UTF-8, and arrive as surrogates, as Latin-1, which old systems write."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return text.encode(errors="surrogateescape").decode("latin-1")
    return text


def _set_attribute(spec: oiio.ImageSpec, name: str, value: MetadataValue) -> None:
    if isinstance(value, tuple):
        spec.attribute(name, oiio.TypeDesc(_TUPLE_TYPES.get(name, f"float[{len(value)}]")), value)
    else:
        spec.attribute(name, value)


def _write(path: Path, spec: oiio.ImageSpec, image: NDArray[Any], full_float: bool) -> str:
    """Write the file; return the reason of a failure, or an empty text."""
    file = oiio.ImageOutput.create("openexr")
    if file is None:
        return pending_error(oiio)
    if not file.open(str(path), spec):
        return pending_error(file)
    written = True
    for top in range(0, spec.height, _ROWS):
        pixels = np.ascontiguousarray(image[top : top + _ROWS], dtype=np.float32)
        if not full_float:
            pixels = within_half(pixels)
        written = written and file.write_scanlines(top, top + len(pixels), 0, pixels)
    reason = pending_error(file)
    if not file.close() or not written:
        return reason or "writing failed"
    # OpenImageIO does not report a full disk for the last few kilobytes, so read them back.
    check = oiio.ImageInput.open(str(path))
    if check is None:
        return f"incomplete: {pending_error(oiio)}"
    last = check.read_scanlines(0, 0, spec.height - 1, spec.height, 0, 0, spec.nchannels, oiio.FLOAT)
    reason = pending_error(check)
    check.close()
    return "" if last is not None and not reason else f"incomplete: {reason}"


def within_half(pixels: NDArray[Any]) -> NDArray[Any]:
    """Clamp pixels to the range of half floats; NaN is kept.

    Otherwise rounding would turn a firefly into infinity, which spreads through every later filter.
    """
    clipped: NDArray[Any] = np.clip(pixels, -LARGEST_HALF, LARGEST_HALF)
    return clipped


def pending_error(source: Any) -> str:
    """OpenImageIO's pending error in one line; a damaged header can make it contain invalid text."""
    try:
        lines = source.geterror().split("\n")
    except UnicodeDecodeError:
        return "damaged header"
    return str(lines[-1]).strip()


def _unreadable(path: Path, found: str, advice: str) -> InputError:
    return InputError(f"{path}: expected an EXR image, found {found}; {advice}")
