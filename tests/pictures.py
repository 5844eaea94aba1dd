"""Writing pictures for tests to read."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio


def save(path: Path, channels: Mapping[str, Any], kind: str | Sequence[str] = "float", **attributes: Any) -> Path:
    """Write channels by name to a file of the format that its name says.

    Args:
        path: the file; its folder is made.
        channels: ``(H, W)`` each.
        kind: type of the pixels, or of each channel.
        attributes: fields of OpenImageIO's spec, or attributes, with two underscores for a colon.
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
