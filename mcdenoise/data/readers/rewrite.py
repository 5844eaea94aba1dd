"""Writing a file as it was read, with some channels replaced or added, and all else passed through untouched."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import OpenImageIO as oiio

from mcdenoise.data.exr import LARGEST_HALF, Image, pending_error
from mcdenoise.data.files import atomic_path
from mcdenoise.data.images import FORMATS, as_stored, read_channels, read_image_header
from mcdenoise.data.readers.transfer import encode
from mcdenoise.errors import InputError


def write_like(
    source: Path,
    target: Path,
    replaced: Mapping[tuple[int, str], Image],
    *,
    added: Mapping[str, Image],
    part: int = 0,
    full_float: bool = False,
) -> None:
    """Write ``target`` as ``source`` is: the same container, parts, channels, types, attributes, windows, compression.

    Args:
        source: a file that has been read.
        target: the file to be written, whole or not at all. Its folder must exist.
        replaced: ``(H, W)`` pixels by part and channel.
        added: the same of new channels, by name.
        part: the part that they are added to.
        full_float: store all of these as 32-bit floats, whatever was there.

    Raises:
        InputError: the file cannot be written, or a layer is to be added to a file that has none.
    """
    with atomic_path(target) as temporary:
        if FORMATS.get(source.suffix.lower()) == "openexr":
            reason = _write_exr(source, temporary, replaced, added, part, full_float)
        elif added:
            raise InputError(
                f"{source}: expected an EXR to add a layer to, found '{source.suffix}'; replace its picture"
            )
        else:
            reason = _write_picture(source, temporary, {name: image for (_, name), image in replaced.items()})
        if reason:
            raise InputError(
                f"{target}: cannot be written ({reason}); check the folder, its permissions and free space"
            )


def _write_exr(
    source: Path,
    target: Path,
    replaced: Mapping[tuple[int, str], Image],
    added: Mapping[str, Image],
    part: int,
    full_float: bool,
) -> str:
    # Both raise whatever the library below has to say, and nothing else can go wrong with a file that was read whole.
    try:
        file = OpenEXR.File(str(source), separate_channels=True)
        for (index, name), image in replaced.items():
            channel = file.parts[index].channels[name]
            channel.pixels = _stored(image, np.float32 if full_float else channel.pixels.dtype)
        if added:
            main = file.parts[part]
            kinds = {channel.pixels.dtype for channel in main.channels.values()} - {np.dtype(np.uint32)}
            kind = np.float32 if full_float or kinds != {np.dtype(np.float16)} else np.float16
            channels = dict(main.channels)
            for name, image in added.items():
                if name in channels:
                    return f"it has a channel '{name}' already"
                channels[name] = OpenEXR.Channel(name, _stored(image, kind))
            main.channels = channels
        file.write(str(target))
        written = read_image_header(target)
    except (RuntimeError, ValueError, TypeError, OSError, InputError) as error:
        return str(error).splitlines()[0] if str(error) else type(error).__name__
    return "" if len(written.parts) == len(file.parts) else "incomplete"


def _stored(image: Image, kind: Any) -> Any:
    if kind == np.float16:
        # Rounding would turn a firefly into infinity, which spreads through every filter downstream.
        image = np.clip(image, -LARGEST_HALF, LARGEST_HALF)
    return np.ascontiguousarray(image, dtype=kind)


def _write_picture(source: Path, target: Path, replaced: Mapping[str, Image]) -> str:
    """A file of one picture: its other channels, and what kind of numbers it has, stay."""
    header = read_image_header(source).parts[0]
    pixels = read_channels(source, {0: header.channels})[0]
    light = np.stack([replaced[name] for name in header.channels[:3]], -1)
    pixels[..., :3] = encode(light) if header.display_referred else light
    if len(header.channels) > 3 and header.channels[3] in replaced:
        pixels[..., 3] = replaced[header.channels[3]]
    file, output = oiio.ImageInput.open(str(source), as_stored()), oiio.ImageOutput.create(str(target))
    if file is None or output is None:
        return pending_error(oiio)
    if not output.open(str(target), file.spec()) or not output.write_image(pixels) or not output.close():
        return pending_error(output)
    try:
        # A full disk is not noticed otherwise.
        read_channels(target, {0: header.channels})
    except InputError as error:
        return f"incomplete: {error}"
    return ""
