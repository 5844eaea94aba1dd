"""Panoramas: the image continues at its left and right border with the other one."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from mcdenoise.frame import Frame
from mcdenoise.models._interface import Output

# Columns of the other border that a method sees. A network hardly looks further, and strides divide it.
_SEAM = 64


def seam(width: int) -> int:
    """Number of columns added on each side of an image."""
    return min(_SEAM, width)


def wrapped(frame: Frame) -> Frame:
    """The frame with columns of the other border on both sides, without a camera."""
    margin = seam(frame.size[1])

    def wrap(image: Tensor) -> Tensor:
        return torch.cat([image[..., -margin:], image, image[..., :margin]], -1)

    changes: dict[str, Any] = {name: wrap(image) for name, image in frame.items() if name != "view_projection"}
    extra = {name: changes.pop(name) for name in frame.extra}
    layers = {name: wrap(layer) for name, layer in frame.layers.items()}
    return frame.replace(**changes, view_projection=None, extra=extra, layers=layers)


def unwrapped(output: Output, width: int) -> Output:
    """The output without these columns."""
    start = seam(width)

    def crop(image: Tensor) -> Tensor:
        return image[..., start : start + width].contiguous() if image.shape[-1] == width + 2 * start else image

    stages = {name: crop(image) for name, image in output.stages.items()}
    layers = {name: crop(layer) for name, layer in output.layers.items()}
    alpha = None if output.alpha is None else crop(output.alpha)
    return output._replace(image=crop(output.image), stages=stages, layers=layers, alpha=alpha)
