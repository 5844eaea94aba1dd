"""Panoramas: the image continues at its left and right border with the other one."""

from __future__ import annotations

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

    return frame.replace(view_projection=None).map(wrap)


def unwrapped(output: Output, width: int) -> Output:
    """The output without these columns."""
    start = seam(width)

    def crop(image: Tensor) -> Tensor:
        return image[..., start : start + width].contiguous() if image.shape[-1] == width + 2 * start else image

    return output.map(crop)
