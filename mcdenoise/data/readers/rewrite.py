"""Writing a copy of a file with some channels replaced or added, and everything else unchanged."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from mcdenoise.data.exr import LARGEST_HALF, Image, cannot_write, within_half, write_image
from mcdenoise.data.files import atomic_path
from mcdenoise.data.images import FORMATS, Part, read_channels, read_image_header, read_picture
from mcdenoise.data.readers.attributes import put_back, readable
from mcdenoise.data.readers.transfer import encode

# Names of the channels that DWA compression rounds, and its usual level.
_DWA_ROUNDS, _DWA_LEVEL = {"r", "g", "b", "y", "ry", "by"}, 45


def write_like(
    source: Path,
    target: Path,
    replaced: Mapping[tuple[int, str], Image],
    *,
    added: Mapping[str, Image],
    part: int = 0,
    like: str = "",
    full_float: bool = False,
    stored: Part | None = None,
) -> None:
    """Write a copy of ``source`` with the same container, parts, channels, types, attributes, windows, compression.

    Args:
        source: an existing image file.
        target: the file to write, atomically. Its folder must exist.
        replaced: ``(H, W)`` pixels by part and channel.
        added: ``(H, W)`` pixels of new channels of an EXR, by name.
        part: the part that gets the new channels.
        like: the channel of that part whose type the new channels get.
        full_float: store all these channels as 32-bit floats, whatever the types were.
        stored: the curve of a picture that is no EXR; by default what the file says.

    Raises:
        InputError: the file cannot be written.
    """
    if FORMATS.get(source.suffix.lower()) != "openexr":
        _write_picture(source, target, {name: image for (_, name), image in replaced.items()}, stored)
        return
    with atomic_path(target) as temporary:
        if reason := _write_exr(source, temporary, replaced, added, part, like, full_float):
            raise cannot_write(target, reason)


def _write_exr(
    source: Path,
    target: Path,
    replaced: Mapping[tuple[int, str], Image],
    added: Mapping[str, Image],
    part: int,
    like: str,
    full_float: bool,
) -> str:
    # Reading and writing may raise any exception of the underlying library.
    try:
        expected = read_image_header(source).parts
        # The library skips unreadable parts with a printed warning. Suppressing that would also suppress the output of
        # all other threads.
        copy = target.with_suffix(".copy.exr")
        with readable(source, copy) as originals:
            file = OpenEXR.File(str(copy), separate_channels=True)
        whole = len(file.parts) == len(expected) and all(map(_is_whole, file.parts, expected))
    except Exception as error:
        return f"{source} cannot be read again: {_first_line(error)}"
    if not whole:
        return f"{source} has changed meanwhile, or has parts that cannot be written again"
    for (index, name), image in replaced.items():
        channel = file.parts[index].channels[name]
        channel.pixels = _stored(image, np.float32 if full_float else channel.pixels.dtype)
    if added:
        main = file.parts[part]
        kind = np.float32 if full_float or like not in main.channels else main.channels[like].pixels.dtype
        channels = dict(main.channels)
        for name, image in added.items():
            if name in channels:
                return f"it has a channel '{name}' already"
            channels[name] = OpenEXR.Channel(name, _stored(image, kind))
        main.channels = channels
    if clamped := {limit for each in file.parts if (limit := _leave_room(each))}:
        # The text is the same for all frames, so that it is told once.
        warnings.warn(
            f"DWA compression stores half floats and rounds them: brighter pixels are clamped to {min(clamped):.0f}; "
            "store the shot with ZIP compression to keep them",
            stacklevel=2,
        )
    try:
        file.write(str(target))
        put_back(target, originals)
        written = read_image_header(target).parts
        # OpenEXR does not report a full disk for the last few kilobytes, so read them back.
        for index, each in enumerate(written):
            read_channels(target, {index: each.channels}, slice(each.size[0] - 1, each.size[0]))
    except Exception as error:
        return _first_line(error)
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


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _is_whole(found: Any, part: Part) -> bool:
    """Whether the other library has read a part with all of its channels."""
    channels = found.channels
    return set(channels) == set(part.channels) and all(each.pixels.shape == part.size for each in channels.values())


def _stored(image: Image, kind: Any) -> Any:
    return np.ascontiguousarray(within_half(image) if kind == np.float16 else image, dtype=kind)


def _write_picture(source: Path, target: Path, replaced: Mapping[str, Image], stored: Part | None) -> None:
    """Write a file with one picture, with its other channels and its pixel type unchanged."""
    spec, header, pixels = read_picture(source)
    stored = stored or header.parts[0]
    for place, name in enumerate(header.parts[0].channels):
        if name in replaced:
            image = replaced[name]
            display = stored.display_referred and name.lower() not in ("a", "alpha")
            pixels[..., place] = encode(image[..., None], stored.gamma)[..., 0] if display else image
    write_image(target, spec, pixels)
