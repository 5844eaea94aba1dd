"""Writing a file as it was read, with some channels replaced or added, and all else passed through untouched."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import OpenImageIO as oiio

from mcdenoise.data.exr import LARGEST_HALF, Image, pending_error
from mcdenoise.data.files import atomic_path
from mcdenoise.data.images import FORMATS, Part, read_channels, read_image_header
from mcdenoise.data.readers.transfer import encode
from mcdenoise.errors import InputError


class _NotReadError(Exception):
    """OpenEXR does not read all that OpenImageIO has read."""


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
    expected = read_image_header(source).parts
    # Reading and writing raise whatever the library below has to say.
    try:
        # A part that it cannot read it leaves out, and prints that.
        with redirect_stdout(io.StringIO()):
            file = OpenEXR.File(str(source), separate_channels=True)
        if len(file.parts) != len(expected) or not all(map(_is_whole, file.parts, expected)):
            raise _NotReadError
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
    except (_NotReadError, UnicodeDecodeError):
        return _write_through_oiio(source, target, expected, replaced, added, full_float)
    except (RuntimeError, ValueError, TypeError, OSError, InputError) as error:
        return str(error).splitlines()[0] if str(error) else type(error).__name__
    return "" if len(written.parts) == len(file.parts) else "incomplete"


def _is_whole(found: Any, part: Part) -> bool:
    """Whether a part has been read: all its channels, as the other library sees them."""
    channels = found.channels
    return set(channels) == set(part.channels) and all(each.pixels.shape == part.size for each in channels.values())


def _write_through_oiio(
    source: Path,
    target: Path,
    parts: Sequence[Part],
    replaced: Mapping[tuple[int, str], Image],
    added: Mapping[str, Image],
    full_float: bool,
) -> str:
    """What has texts that are no UTF-8: OpenImageIO keeps them, but scales whole numbers and loses rare attributes."""
    if added or any(part.integers for part in parts):
        raise InputError(
            f"{source}: expected channels and attributes that OpenEXR reads, found others, such as texts that are no "
            "UTF-8; render the file again without them"
        )
    file, clean = oiio.ImageInput.open(str(source)), oiio.ImageOutput.create("openexr")
    if file is None or clean is None:
        return pending_error(oiio)
    specs, images = [], []
    for index, part in enumerate(parts):
        spec = file.spec(index)
        pixels = np.array(file.read_image(index, 0, 0, spec.nchannels, oiio.FLOAT), np.float32)
        pixels = pixels.reshape(*part.size, spec.nchannels)
        kinds = [str(kind) for kind in spec.channelformats] or [str(spec.format)] * spec.nchannels
        for place, name in enumerate(part.channels):
            if (index, name) in replaced:
                half = kinds[place] == "half" and not full_float
                pixels[..., place] = _stored(replaced[index, name], np.float16 if half else np.float32)
        if full_float:
            spec.set_format("float")
        specs.append(spec)
        images.append(pixels)
    file.close()
    for index, (spec, pixels) in enumerate(zip(specs, images, strict=True)):
        opened = clean.open(str(target), spec, "AppendSubimage") if index else clean.open(str(target), tuple(specs))
        if not opened or not clean.write_image(pixels):
            return pending_error(clean) or "writing failed"
    return _missing(target) if clean.close() else pending_error(clean) or "writing failed"


def _stored(image: Image, kind: Any) -> Any:
    if kind == np.float16:
        # Rounding would turn a firefly into infinity, which spreads through every filter downstream.
        image = np.clip(image, -LARGEST_HALF, LARGEST_HALF)
    return np.ascontiguousarray(image, dtype=kind)


def _write_picture(source: Path, target: Path, replaced: Mapping[str, Image]) -> str:
    """A file of one picture: its other channels, and what kind of numbers it has, stay."""
    picture = oiio.ImageBuf(str(source))
    spec = picture.spec()
    pixels = np.asarray(picture.get_pixels(oiio.FLOAT), dtype=np.float32)
    names = list(spec.channelnames)
    light = np.stack([replaced[name] for name in names[:3]], -1)
    display = read_image_header(source).parts[0].display_referred
    pixels[..., :3] = encode(light) if display else light
    if len(names) > 3 and names[3] in replaced:
        pixels[..., 3] = replaced[names[3]]
    clean = oiio.ImageBuf(spec)
    clean.set_pixels(spec.roi, pixels)
    return _missing(target) if clean.write(str(target)) else pending_error(clean)


def _missing(written: Path) -> str:
    """OpenImageIO does not notice when the last kilobytes no longer fit on the disk: see whether they are there."""
    try:
        parts = read_image_header(written).parts
        read_channels(written, {index: part.channels for index, part in enumerate(parts)})
    except InputError:
        return "incomplete"
    return ""
