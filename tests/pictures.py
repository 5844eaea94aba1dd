"""Pictures that tests write and read."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import OpenImageIO as oiio


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


def stored(path: Path) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Header and channels of every part, as the library of the format reads them."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return [
            (dict(each.header), {name: c.pixels.copy() for name, c in each.channels.items()}) for each in file.parts
        ]


def channels_of(path: Path) -> dict[str, Any]:
    return {name: pixels for _, channels in stored(path) for name, pixels in channels.items()}
