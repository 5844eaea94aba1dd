"""Writing a copy of a file with some channels replaced or added, and everything else unchanged.

OpenEXR's Python module fails on text in Latin-1, on a frame rate of 24/0 and on many types of attributes. So it gets a
copy of the file in which each attribute that pixels do not need is a placeholder of the same length, and the written
file gets the original bytes.
"""

from __future__ import annotations

import mmap
import shutil
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import OpenEXR

from mcdenoise.data.exr import LARGEST_HALF, within_half, write_image
from mcdenoise.data.files import atomic_path, cannot_write
from mcdenoise.data.images import FORMATS, Image, Part, read_image_header, read_last_rows, read_picture
from mcdenoise.data.radiance import encode
from mcdenoise.errors import first_line
from mcdenoise.interruption import unfinished

# Names of the channels that DWA compression rounds, and its usual level.
_DWA_ROUNDS, _DWA_LEVEL = {"r", "g", "b", "y", "ry", "by"}, 45

_MULTI_PART = 0x1000
# The attributes without which a flat image cannot be read and written as it was, and their types.
_NEEDED = {
    **{b"channels": b"chlist", b"compression": b"compression", b"lineOrder": b"lineOrder", b"tiles": b"tiledesc"},
    **{b"dataWindow": b"box2i", b"displayWindow": b"box2i", b"chunkCount": b"int", b"screenWindowCenter": b"v2f"},
    **dict.fromkeys((b"pixelAspectRatio", b"screenWindowWidth", b"dwaCompressionLevel"), b"float"),
    **dict.fromkeys((b"name", b"type"), b"string"),
}


def write_like(
    source: Path,
    target: Path,
    channels: Mapping[tuple[int, str], Image],
    *,
    like: str = "",
    full_float: bool = False,
    stored: Part | None = None,
) -> None:
    """Write a copy of ``source`` with the same container, parts, channels, types, attributes, windows, compression.

    Args:
        source: an existing image file.
        target: the file to write, atomically. Its folder must exist.
        channels: ``(H, W)`` pixels by part and channel; those that the file lacks are added to an EXR.
        like: the channel whose type new channels get.
        full_float: store all these channels as 32-bit floats, whatever the types were.
        stored: the curve of a picture that is no EXR; by default what the file says.

    Raises:
        InputError: the file cannot be written.
    """
    if FORMATS.get(source.suffix.lower()) != "openexr":
        _write_picture(source, target, {name: image for (_, name), image in channels.items()}, stored)
        return
    with atomic_path(target) as temporary:
        if reason := _write_exr(source, temporary, channels, like, full_float):
            raise cannot_write(target, reason)


def _write_exr(
    source: Path, target: Path, channels: Mapping[tuple[int, str], Image], like: str, full_float: bool
) -> str:
    copy = target.with_suffix(".copy.exr")
    # Reading and writing may raise any exception of the underlying library.
    try:
        expected = read_image_header(source).parts
        # The library skips unreadable parts with a printed warning. Suppressing that would also suppress the output of
        # all other threads.
        with unfinished(copy):
            shutil.copyfile(source, copy)
            originals = _make_readable(copy)
            file = OpenEXR.File(str(copy), separate_channels=True)
        whole = len(file.parts) == len(expected) and all(map(_is_whole, file.parts, expected))
    except Exception as error:
        return f"{source} cannot be read again: {first_line(error)}"
    finally:
        copy.unlink(missing_ok=True)
    if not whole:
        return f"{source} has changed meanwhile, or has parts that cannot be written again"
    for (index, name), image in channels.items():
        part = file.parts[index]
        old = part.channels.get(name, part.channels.get(like))
        kind = np.float32 if full_float or old is None else old.pixels.dtype
        pixels = np.ascontiguousarray(within_half(image) if kind == np.float16 else image, dtype=kind)
        if name in part.channels:
            old.pixels = pixels
        else:
            part.channels = {**part.channels, name: OpenEXR.Channel(name, pixels)}
    if clamped := {limit for each in file.parts if (limit := _leave_room(each))}:
        # The text is the same for all frames, so that it is told once.
        warnings.warn(
            f"DWA compression stores half floats and rounds them: brighter pixels are clamped to {min(clamped):.0f}; "
            "store the shot with ZIP compression to keep them",
            stacklevel=2,
        )
    try:
        file.write(str(target))
        _put_back(target, originals)
        written = read_last_rows(target).parts
    except Exception as error:
        return first_line(error)
    return "" if len(written) == len(expected) else "incomplete"


def _leave_room(part: Any) -> float:
    """Clamp pixels that DWA compression, which holds halves of any type and rounds them, would turn into infinity.

    Returns:
        The largest value of clamped pixels; 0 if there are none.
    """
    if part.header["compression"] not in (OpenEXR.DWAA_COMPRESSION, OpenEXR.DWAB_COMPRESSION):
        return 0.0
    # Random stars and noise came back up to 1.03 times as bright at a level of 45, 1.1 times at 200, 1.6 times at 1000.
    largest = LARGEST_HALF / (1 + float(part.header.get("dwaCompressionLevel", _DWA_LEVEL)) / 1000)
    clamped = False
    for name, channel in part.channels.items():
        pixels = channel.pixels
        if name.rpartition(".")[2].lower() not in _DWA_ROUNDS or pixels.dtype == np.uint32:
            continue
        above = np.isfinite(pixels) & (np.abs(pixels) > largest)
        if above.any():
            channel.pixels = np.where(above, np.sign(pixels) * largest, pixels).astype(pixels.dtype)
            clamped = True
    return largest if clamped else 0.0


def _is_whole(found: Any, part: Part) -> bool:
    """Whether the other library has read a part with all of its channels."""
    channels = found.channels
    return set(channels) == set(part.channels) and all(
        each.pixels.shape == part.window.size for each in channels.values()
    )


def _write_picture(source: Path, target: Path, replaced: Mapping[str, Image], stored: Part | None) -> None:
    """Write a file with one picture, with its other channels and its pixel type unchanged."""
    spec, header, pixels = read_picture(source)
    stored = stored or header.parts[0]
    names = header.parts[0].channels
    # Of what is not there, the color stays.
    there = np.ones_like(pixels[..., 0])
    if stored.straight:
        there = replaced.get(names[spec.alpha_channel], pixels[..., spec.alpha_channel])
    for place, name in enumerate(names):
        if name in replaced:
            image = replaced[name]
            if place != spec.alpha_channel:
                image = np.divide(image, there, out=np.zeros_like(image), where=there > 0)
                image = encode(image[..., None], stored.gamma)[..., 0] if stored.display_referred else image
                image = np.where(there > 0, image, pixels[..., place])
            pixels[..., place] = image
    write_image(target, spec, pixels)


class Record(NamedTuple):
    """An attribute in the header of a file: name, type, byte count, value.

    Args:
        part: index of the part.
        name: name of the attribute.
        kind: type of the attribute.
        start: file offset of the record.
        value: file offset of the value.
        end: file offset of the record's end.
    """

    part: int
    name: bytes
    kind: bytes
    start: int
    value: int
    end: int


def records(content: bytes | mmap.mmap) -> Iterator[Record]:
    """The attributes of all parts of a file (OpenEXR File Layout, "Header"); ``ValueError`` if it is damaged."""
    several = int.from_bytes(content[4:8], "little") & _MULTI_PART
    place, part = 8, 0
    while content[place]:
        while content[place]:
            name = content.find(b"\0", place)
            kind = content.find(b"\0", name + 1)
            value = kind + 5
            end = value + int.from_bytes(content[kind + 1 : value], "little")
            if not place < name < kind < end < len(content):
                raise ValueError("damaged header")
            yield Record(part, content[place:name], content[name + 1 : kind], place, value, end)
            place = end
        place, part = place + 1, part + 1
        if not several:
            return


def _make_readable(copy: Path) -> dict[tuple[int, bytes], bytes]:
    """Change a copy so that OpenEXR's Python module can read it.

    Returns:
        The original records by part and name of the placeholder, for :func:`_put_back`.
    """
    originals: dict[tuple[int, bytes], bytes] = {}
    with copy.open("r+b") as file, mmap.mmap(file.fileno(), 0) as content:
        for each in list(records(content)):
            # As long as the name was: a file says that it has long ones.
            name = (b"~%d" % len(originals)).ljust(len(each.name), b"~")
            text = name + b"\0string\0"
            rest = each.end - each.start - len(text) - 4
            if rest >= 0 and not _is_needed(each, content):
                originals[each.part, name] = content[each.start : each.end]
                content[each.start : each.end] = text + rest.to_bytes(4, "little") + b"." * rest
    return originals


def _put_back(target: Path, originals: dict[tuple[int, bytes], bytes]) -> None:
    """Replace placeholder records by the original ones."""
    with target.open("r+b") as file, mmap.mmap(file.fileno(), 0) as content:
        for each in list(records(content)):
            content[each.start : each.end] = originals.get((each.part, each.name), content[each.start : each.end])


def _is_needed(record: Record, content: mmap.mmap) -> bool:
    value = content[record.value : record.end]
    is_text = record.kind != b"string" or value.decode(errors="replace").encode() == value
    return _NEEDED.get(record.name) == record.kind and is_text
