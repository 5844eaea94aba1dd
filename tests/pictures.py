"""Pictures that tests write and read."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest

from mcdenoise.data import read_exr, write_exr


def save(path: Path, channels: Mapping[str, Any], kind: str | Sequence[str] = "float", **attributes: Any) -> Path:
    """Write channels ``(H, W)`` by name to a file of the format that its name says, and make its folder.

    The kind is that of all pixels, or of each channel. Attributes are fields of OpenImageIO's spec, or others, with two
    underscores for a colon.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.stack([np.asarray(image, np.float32) for image in channels.values()], -1)
    height, width, count = pixels.shape
    spec = oiio.ImageSpec(width, height, count, kind if isinstance(kind, str) else "float")
    spec.channelnames = tuple(channels)
    spec.channelformats = () if isinstance(kind, str) else tuple(oiio.TypeDesc(each) for each in kind)
    for name, value in attributes.items():
        if hasattr(spec, name):
            setattr(spec, name, value)
        elif isinstance(value, bytes | tuple):
            spec.attribute(name, f"uint8[{len(value)}]" if isinstance(value, bytes) else "matrix", value)
        else:
            spec.attribute(name.replace("__", ":"), value)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec), output.geterror()
    assert output.write_image(pixels), output.geterror()
    assert output.close(), output.geterror()
    return path


def as_channels(layers: Mapping[str, Any], letters: str = "RGB") -> dict[str, Any]:
    """Channels ``(H, W)`` by the names that they have in a file with these images ``(H, W, C)`` as its layers."""
    return {f"{name}.{c}".lstrip("."): image[..., i] for name, image in layers.items() for i, c in enumerate(letters)}


def part_of(
    channels: Mapping[str, Any],
    name: str = "",
    place: tuple[int, int] = (0, 0),
    display: tuple[int, int] | None = None,
    **header: Any,
) -> Any:
    """A part of an EXR with these channels ``(H, W)``, whose first row and column are at a place of what is shown."""

    def window(top: int, left: int, height: int, width: int) -> tuple[Any, Any]:
        return np.int32([left, top]), np.int32([left + width - 1, top + height - 1])

    size = next(iter(channels.values())).shape
    windows = {"dataWindow": window(*place, *size), "displayWindow": window(0, 0, *(display or size))}
    kind = {"compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.scanlineimage}
    images = {each: np.ascontiguousarray(image) for each, image in channels.items()}
    return OpenEXR.Part(windows | kind | header, images, *([name] if name else []))


def stored(path: Path) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Header and channels of every part, as the library of the format reads them."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return [
            (dict(each.header), {name: c.pixels.copy() for name, c in each.channels.items()}) for each in file.parts
        ]


def channels_of(path: Path) -> dict[str, Any]:
    return {name: pixels for _, channels in stored(path) for name, pixels in channels.items()}


def edit(path: Path, change: Callable[[Any], object]) -> None:
    """Change the pixels of a file where they are."""
    pixels, channels, _ = read_exr(path)
    change(pixels)
    write_exr(path, pixels, channels, full_float=True)


def frames_of(video: Path) -> list[Any]:
    """The frames of a video, by what its file says of their colours."""
    with pytest.importorskip("av").open(video) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
