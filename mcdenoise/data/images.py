"""Reading images in all formats of renderers through OpenImageIO: headers, and selected channels.

Supported are EXR files with several parts, each with its own channels, and `.hdr`, `.pfm`, `.tif` or `.png` files with
one image. Pixels are returned as 32-bit floats; every failure is an error of one line.
"""

from __future__ import annotations

import os
import struct
import warnings
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import OpenImageIO as oiio
from numpy.typing import NDArray

from mcdenoise.errors import InputError, is_unicode
from mcdenoise.reading import check_file, expecting

Image: TypeAlias = NDArray[np.float32]
Mask: TypeAlias = NDArray[np.bool_]
MetadataValue: TypeAlias = str | int | float | tuple[float, ...]
Metadata: TypeAlias = dict[str, MetadataValue]

LARGEST_PIXEL_COUNT = 2**28
# Largest number of black pixels per byte of a file: zlib's limit is 1032, and PXR24 first drops a quarter; DWA stores
# one number for 64, or two bytes for a run of 128.
_LARGEST_RATIO, _LARGEST_DWA_RATIO = 2_000, 70_000
# These attributes describe how one file stores its pixels, not the picture; the written file has its own.
STORAGE_PREFIXES = ("oiio:", "openexr:", "compression", "textureformat")
# Supported formats by OpenImageIO's names.
FORMATS = {
    **dict.fromkeys((".exr", ".sxr", ".mxr", ".cxr"), "openexr"),
    **{".hdr": "hdr", ".pfm": "pnm", ".tif": "tiff", ".tiff": "tiff", ".png": "png"},
}
_LARGEST_PARTS, _LARGEST_CHANNELS = 1024, 4096
# Rows to decode at a time, with all channels, although few are requested: one chunk or several. More rows would double
# the time for a frame of 60 channels and take hundreds of megabytes; fewer would decode a chunk repeatedly.
_ROWS = {"none": 16, "rle": 16, "zips": 16, "zip": 16, "pxr24": 16, "piz": 32, "b44": 32, "b44a": 32, "dwaa": 32}
_MOST_ROWS = 256
# Largest difference of a curve from a straight line.
_STEP = 1 / 512
EXR_SUFFIXES = {suffix for suffix, name in FORMATS.items() if name == "openexr"}
_PNG = b"\x89PNG\r\n\x1a\n"
_INTEGERS = {"uint", "int"}
# Chroma channels of a luminance-chroma image: useless without the luminance, and usually subsampled.
_CHROMA = {"ry", "by"}
# More than OpenImageIO's default limit: a shot with all passes of 300 lights exceeds that.
oiio.attribute("limits:channels", _LARGEST_CHANNELS)


class Window(NamedTuple):
    """Pixels from a first row and column to those before an end, in the display window's coordinates."""

    top: int
    left: int
    bottom: int
    right: int

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self.bottom - self.top, self.right - self.left

    def holds(self, other: Window) -> bool:
        """Whether this window has all pixels of another."""
        begins = self.top <= other.top and self.left <= other.left
        return begins and other.bottom <= self.bottom and other.right <= self.right

    def of(self, image: Image, own: Window, fill: float = 0.0) -> Image:
        """The pixels of this window, from an ``(H, W, C)`` image of another; filled where that has none."""
        if self == own:
            return image
        found = np.full((*self.size, *image.shape[2:]), fill, image.dtype)
        top, left = max(self.top, own.top), max(self.left, own.left)
        bottom, right = max(top, min(self.bottom, own.bottom)), max(left, min(self.right, own.right))
        found[top - self.top : bottom - self.top, left - self.left : right - self.left] = image[
            top - own.top : bottom - own.top, left - own.left : right - own.left
        ]
        return found


_NOWHERE = Window(0, 0, 0, 0)


@dataclass(frozen=True)
class Part:
    """One image (part) of a file.

    Args:
        name: name of the part, empty if the file has none.
        window: the data window.
        display: the display window.
        channels: names of the channels, R, G, B first.
        integers: channels that are stored as integers, such as object ids.
        display_referred: whether the pixels are display values, as in an 8-bit PNG.
        gamma: exponent of the display curve, if it is a power; 0 for the curve of sRGB.
        straight: whether the colors are not multiplied by their alpha, as in a PNG.
    """

    name: str
    window: Window
    display: Window
    channels: tuple[str, ...]
    integers: frozenset[str] = frozenset()
    display_referred: bool = False
    gamma: float = 0.0
    straight: bool = False


@dataclass(frozen=True)
class ImageHeader:
    """Header of an image file.

    Args:
        format: the format, by OpenImageIO's name, such as ``openexr``.
        parts: at least one.
        metadata: attributes of the first part that describe the picture.
    """

    format: str
    parts: tuple[Part, ...]
    metadata: Metadata

    def part(self, index: int) -> Part:
        """A part; one without channels if the file does not have it."""
        return self.parts[index] if index < len(self.parts) else Part("", _NOWHERE, _NOWHERE, ())


def read_image_header(path: Path) -> ImageHeader:
    """Read the headers of all parts of a file.

    Raises:
        InputError: the file is missing, has another format, or is deep, damaged or unreasonably large.
    """
    with _opened(path) as (_, header):
        return header


def read_channels(path: Path, wanted: Mapping[int, Sequence[str]], rows: slice = slice(None)) -> dict[int, Image]:
    """Read selected channels of a file.

    Args:
        path: the file.
        wanted: names of channels, by part index.
        rows: contiguous rows of the data window to read.

    Returns:
        For each part float32 ``(H, W, C)`` pixels of its data window, top row first, with channels in the order of
        ``wanted``.

    Raises:
        InputError: see :func:`read_image_header`; or a part or channel does not exist, or pixels are damaged or
            missing.
    """
    with _opened(path) as (file, header):
        for part, names in wanted.items():
            check_channels(path, header.part(part).channels, names)
        return {part: _read(path, file, part, header.parts[part], names, rows) for part, names in wanted.items()}


def read_last_rows(path: Path) -> ImageHeader:
    """Read the last row of each part of a file that has been written: the last kilobytes may lack on a full disk.

    The libraries do not report that. Of a PNG, the header is enough, for which its checksums are compared.

    Raises:
        InputError: see :func:`read_channels`.
    """
    header = read_image_header(path)
    for index, part in enumerate(header.parts if header.format != "png" else ()):
        read_channels(path, {index: part.channels}, slice(-1, None))
    return header


def check_channels(path: Path, found: Sequence[str], wanted: Sequence[str]) -> None:
    """Check that a part has all channels that are wanted of it.

    Raises:
        InputError: one is missing.
    """
    if absent := [name for name in wanted if name not in found]:
        raise InputError(
            f"{path}: expected channel '{absent[0]}', as the first file has it, found "
            f"{', '.join(found[:8]) or 'no such part'}; render all frames with the same layers"
        )


def read_picture(path: Path) -> tuple[oiio.ImageSpec, ImageHeader, Image]:
    """Read all channels of the first image of a file; also return OpenImageIO's and our own description of the file.

    This does not use ``oiio.ImageBuf``, which reads a PFM upside down.

    Raises:
        InputError: see :func:`read_channels`.
    """
    with _opened(path) as (file, header):
        file.seek_subimage(0, 0)
        return file.spec(), header, _read(path, file, 0, header.parts[0], header.parts[0].channels)


def _read(
    path: Path, file: oiio.ImageInput, index: int, part: Part, names: Sequence[str], rows: slice = slice(None)
) -> Image:
    places = [part.channels.index(name) for name in names]
    first, end = min(places), max(places) + 1
    picked = [place - first for place in places]
    height, width = part.window.size
    try:
        spec = file.spec(index)
        # All rows at once are decoded by several threads.
        whole = rows == slice(None) and len(picked) == len(part.channels)
        if whole or spec.tile_width or path.suffix.lower() not in EXR_SUFFIXES:
            pixels = file.read_image(index, 0, first, end, oiio.FLOAT)
            found = None if pixels is None else np.asarray(pixels).reshape(height, width, -1)[rows]
            found = found if found is None or picked == [*range(found.shape[2])] else found[..., picked]
        else:
            first_row, end_row, _ = rows.indices(height)
            found = np.empty((end_row - first_row, width, len(names)), np.float32)
            step = _ROWS.get(str(spec.getattribute("compression")).partition(":")[0], _MOST_ROWS)
            for top in range(first_row, end_row, step):
                bottom = min(top + step, end_row)
                pixels = file.read_scanlines(index, 0, spec.y + top, spec.y + bottom, 0, first, end, oiio.FLOAT)
                if pixels is None:
                    found = None
                    break
                strip = np.asarray(pixels).reshape(bottom - top, width, -1)
                found[top - first_row : bottom - first_row] = strip[..., picked]
        reason = pending_error(file)
    except MemoryError:
        found, reason = None, "not enough memory"
    # A truncated file has an intact header; without this check its missing rows would be black.
    if found is None or reason:
        raise InputError(
            f"{path}: expected whole images, found damaged or missing pixels ({reason}); render or copy the file again"
        )
    return np.ascontiguousarray(found, dtype=np.float32)


@contextmanager
def _opened(path: Path) -> Iterator[tuple[oiio.ImageInput, ImageHeader]]:
    with expecting(path, "an image"):
        check_file(path)
    check_name(path)
    if path.suffix.lower() not in FORMATS:
        raise InputError(f"{path}: expected one of {', '.join(FORMATS)}, found '{path.suffix}'; convert the file")
    name = FORMATS[path.suffix.lower()]
    if name == "png" and not _png_is_whole(path):
        raise InputError(f"{path}: expected an image, found a PNG with damaged or missing data; copy the file again")
    file, reason = None, "damaged header"
    with suppress(UnicodeDecodeError, MemoryError):
        file = oiio.ImageInput.open(str(path), as_stored())
        reason = pending_error(oiio).replace(f"EXR Error ({path}): ", "")
    if file is None:
        raise InputError(
            f"{path}: expected an image, found what cannot be opened ({reason}); check that the file is complete"
        )
    try:
        if (found := file.format_name()) != name:
            raise _refused(
                path, f"a file of the format {found}, which its name does not say", "name it after its format"
            )
        yield file, _header(path, file, name)
    finally:
        file.close()


def as_stored() -> oiio.ImageSpec:
    """OpenImageIO settings for reading pixels as stored: without multiplying a PNG's color by its alpha."""
    config = oiio.ImageSpec()
    config.attribute("oiio:RawColor", 1)
    config.attribute("oiio:UnassociatedAlpha", 1)
    # A PFM begins with the lowest row; without this hint, OpenImageIO may not flip it.
    config.attribute("pnm:pfmflip", 1)
    return config


def _png_is_whole(path: Path) -> bool:
    """Whether all chunks of a PNG are present with valid checksums; true for other files.

    The library prints its errors about damaged chunks to the terminal, and does not notice missing chunks at the end.
    """
    with expecting(path, "an image"):
        content = path.read_bytes()
    place = len(_PNG)
    while content.startswith(_PNG) and place + 12 <= len(content):
        length, kind = struct.unpack_from(">I4s", content, place)
        end = place + 8 + length
        if content[end : end + 4] != struct.pack(">I", zlib.crc32(content[place + 4 : end])):
            return False
        if kind == b"IEND":
            return True
        place = end + 4
    return not content.startswith(_PNG)


def check_name(path: Path) -> None:
    """Reject a name that cannot be passed to OpenImageIO.

    Raises:
        InputError: the name is not valid UTF-8.
    """
    if not is_unicode(str(path)):
        raise InputError(f"{path}: expected a name in UTF-8, found other bytes; rename the file")


def _picture_metadata(spec: oiio.ImageSpec) -> Metadata:
    """The attributes that describe the picture rather than its storage."""
    kept: Metadata = {}
    for attribute in spec.extra_attribs:
        value = _as_text(attribute.value) if isinstance(attribute.value, str) else attribute.value
        if isinstance(value, tuple) and not all(isinstance(item, int | float) for item in value):
            continue
        if isinstance(value, str | int | float | tuple) and not attribute.name.startswith(STORAGE_PREFIXES):
            kept[_as_text(attribute.name)] = value
    return kept


def _as_text(text: str) -> str:
    """Decode bytes that are not UTF-8, and arrive as surrogates, as Latin-1, which old systems write."""
    return text if is_unicode(text) else text.encode(errors="surrogateescape").decode("latin-1")


def pending_error(source: Any) -> str:
    """OpenImageIO's pending error in one line; a damaged header can make it contain invalid text."""
    try:
        lines = source.geterror().split("\n")
    except UnicodeDecodeError:
        return "damaged header"
    return str(lines[-1]).strip()


def _header(path: Path, file: oiio.ImageInput, name: str) -> ImageHeader:
    parts: list[Part] = []
    metadata: Metadata = {}
    bytes_promised = 0
    while len(parts) <= _LARGEST_PARTS:
        try:
            if not file.seek_subimage(len(parts), 0):
                break
            spec = file.spec()
            kinds = [str(kind) for kind in spec.channelformats] or [str(spec.format)] * spec.nchannels
            channels = tuple(spec.channelnames)
            metadata = metadata or _picture_metadata(spec)
            part_name = spec.get_string_attribute("oiio:subimagename") or spec.get_string_attribute("name")
            gamma = _gamma_of(spec) if name in ("png", "tiff") else None
        except UnicodeDecodeError as error:
            raise _refused(path, "names that are no text") from error
        pixels = spec.width * spec.height
        if {channel.rpartition(".")[2].lower() for channel in channels} >= _CHROMA:
            raise _refused(path, "luminance and chroma (Y, RY, BY)", "write it as R, G, B")
        if spec.deep:
            raise _refused(path, "a deep image")
        if not 1 <= spec.nchannels <= _LARGEST_CHANNELS:
            raise _refused(path, f"{spec.nchannels} channels")
        if min(spec.width, spec.height) < 1 or pixels > LARGEST_PIXEL_COUNT or spec.depth > 1:
            raise _refused(path, f"{spec.width} x {spec.height} pixels")
        bytes_promised += pixels * int(spec.pixel_bytes(True))
        # More than the file can hold, whatever the compression; checked before memory is allocated.
        dwa = str(spec.getattribute("compression")).startswith("dwa")
        if bytes_promised > (_LARGEST_DWA_RATIO if dwa else _LARGEST_RATIO) * os.path.getsize(path):
            raise _refused(
                path, f"{spec.width} x {spec.height} pixels of {spec.nchannels} channels, but not their data"
            )
        # OpenEXR's module cannot write such files, and the coarser levels would still show the noisy image.
        if name == "openexr" and file.seek_subimage(len(parts), 1):
            raise _refused(path, "a texture of several resolutions", "write the largest one alone")
        integers = frozenset(c for c, kind in zip(channels, kinds, strict=True) if kind in _INTEGERS)
        # Floats, and files that say nothing, have the usual curve of their kind.
        usual = kinds[0] in ("uint8", "uint16") if gamma is None else gamma != 1
        display = name in ("png", "tiff") and usual
        window = Window(spec.y, spec.x, spec.y + spec.height, spec.x + spec.width)
        whole = Window(spec.full_y, spec.full_x, spec.full_y + spec.full_height, spec.full_x + spec.full_width)
        gamma = gamma or 0.0 if display else 0.0
        straight = len(channels) > 3 and bool(spec.get_int_attribute("oiio:UnassociatedAlpha"))
        parts.append(Part(part_name, window, whole, channels, integers, display, gamma, straight))
        if name != "openexr":
            if file.seek_subimage(1, 0):
                # The text is the same for all frames, so that it is told once.
                warnings.warn("a file has several images: only the first is read and written", stacklevel=2)
            break
    pending_error(file)
    if not parts:
        raise _refused(path, "no image")
    return ImageHeader(name, tuple(parts), metadata)


def _gamma_of(spec: oiio.ImageSpec) -> float | None:
    """Exponent of the curve that a file states: 1 for linear light, 0 for the curve of sRGB; ``None`` if none."""
    profile = spec.getattribute("ICCProfile")
    if isinstance(profile, np.ndarray) and (found := _gamma_of_profile(profile.tobytes())) is not None:
        return found if 0.1 < found < 10 else 0.0
    space = spec.get_string_attribute("oiio:ColorSpace").lower()
    if "lin" in space:
        return 1.0
    stated = spec.get_float_attribute("oiio:Gamma")
    gamma = stated if 0.1 < stated < 10 else 0.0
    # Without any statement, OpenImageIO says that a PNG is sRGB.
    return gamma if gamma or "srgb" in space else None


def _gamma_of_profile(profile: bytes) -> float | None:
    """The same from an ICC profile's curve of red or grey (ICC.1:2022, 7.3, 10.6, 10.18)."""
    try:
        (count,) = struct.unpack_from(">I", profile, 128)
        tags = (struct.unpack_from(">4sII", profile, 132 + 12 * i) for i in range(min(count, 100)))
        start = next((start for name, start, _ in tags if name in (b"rTRC", b"kTRC")), None)
        if start is None:
            return None
        kind, _, values = struct.unpack_from(">4sII", profile, start)
        if kind == b"para":
            power = float(struct.unpack_from(">i", profile, start + 12)[0]) / 2**16
            # Only the first of the five functions is a power; the others are like that of sRGB.
            return power if values >> 16 == 0 or power == 1 else 0.0
        if kind != b"curv":
            return None
        table = np.frombuffer(profile, ">u2", values, start + 12)
        if values == 1:
            return float(table[0]) / 256
        straight = np.linspace(0, 1, values)
        return 1.0 if np.abs(table / 65535 - straight).max(initial=0) < _STEP else 0.0
    except (struct.error, ValueError):
        return None


def _refused(path: Path, found: str, advice: str = "render a flat image of at most 2^28 pixels") -> InputError:
    return InputError(f"{path}: expected an image, found {found}; {advice}")
