"""The channels of a history, and the result of blending a frame with it."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.ops._constants import RELIT, RELIT_BLOCK, RELIT_DOUBT
from mcdenoise.ops._window import block_means, corner

# The channels of a history in which lag is looked for: color, mean of the compressed radiance and of its square, and
# color and compressed radiance of a second, shorter history. A frame enters with the first five.
COLOR, MEAN, SQUARE, RECENT, RECENT_MEAN = slice(0, 3), slice(3, 4), slice(4, 5), slice(5, 9), slice(8, 9)


class Blended(NamedTuple):
    """A frame with its history.

    Args:
        color: ``(B, C, H, W)``, the channels of a history.
        length: ``(B, 1, H, W)`` of the history with this frame, in frames.
        kept: ``(B,)`` fraction of each image's pixels that found their surface in the previous frame, float32.
    """

    color: Tensor
    length: Tensor
    kept: Tensor


def root_variance(history: Tensor, length: Tensor) -> Tensor:
    """The variance of the noise of one frame's root ``(B, 1, H, W)``, from a history of that length."""
    counted = length.clamp_min(2)
    return (history[:, SQUARE] - history[:, MEAN].square()).clamp_min(0) * (counted / (counted - 1))


def light_changes(history: Tensor, length: Tensor, root: Tensor) -> Tensor:
    """How much brighter the light is than both histories say: the factors of their channels.

    Args:
        history: ``(B, 9, H, W)`` with this frame.
        length: ``(B, 1, H, W)`` of it.
        root: ``(B, 1, H, W)`` fourth root of this frame's radiance.

    Returns:
        ``(B, 9, H, W)``, between the blocks of :func:`root_changes` bilinearly interpolated, and 1 where there is no
        history; no derivative.
    """
    history, root = history.detach(), root.detach().to(history.dtype)
    each = torch.cat([history[:, MEAN], history[:, RECENT_MEAN], root, root_variance(history, length)], 1)
    blocks = block_means(each, RELIT_BLOCK)
    factors = root_changes(blocks, *history.shape[-2:])
    wide = F.interpolate(factors, scale_factor=RELIT_BLOCK, mode="bilinear", align_corners=False)
    one, short = torch.where(length > 1, corner(wide, *history.shape[-2:]), 1).split(1, 1)
    colors = [image.square().square().expand(-1, 3, -1, -1) for image in (one, short)]
    return torch.cat([colors[0], one, one.square(), colors[1], short], 1)


def root_changes(blocks: Tensor, height: int, width: int) -> Tensor:
    """By how much the fourth root of the light has changed, in windows of 3x3 blocks of 16x16 pixels.

    A change that is small beside the noise of a pixel is seen by no test of few pixels, and stays in a history for
    long. With the means over the ``n`` pixels of a window of the roots of the frame ``m_f`` and of a history ``m_h``,
    ``d = m_f - m_h``, and the mean variance ``m_v`` of the frame's root over the history, the factor is
    ``1 + w d / m_h`` with ``w = max(1 - 8 m_v / (n d^2), 0)``: a James-Stein estimate, which takes for noise what may
    be noise. Means of roots are those of the frame, whatever the noise of each, and one firefly does not hide all else.

    Args:
        blocks: ``(B, 4, h, w)`` means over blocks: roots of the whole and of the recent history, and of the frame; and
            the variance.
        height: of the image.
        width: of the image.

    Returns:
        ``(B, 2, h, w)`` factors of the roots of both histories, within (0.7, 1.4).
    """
    rows, columns = (
        (length - RELIT_BLOCK * torch.arange(count, dtype=blocks.dtype, device=blocks.device)).clamp_max(RELIT_BLOCK)
        for length, count in zip((height, width), blocks.shape[-2:], strict=True)
    )
    pixels = (rows[:, None] * columns).expand_as(blocks[:, :1])
    sums = 9 * F.avg_pool2d(torch.cat([blocks * pixels, pixels], 1), 3, 1, 1)
    before, now, noise, _ = (sums / sums[:, 4:]).split([2, 1, 1, 1], 1)
    change, noise = now - before, noise * RELIT_DOUBT / sums[:, 4:]
    tiny = torch.finfo(change.dtype).tiny
    kept = (1 - noise / change.square().clamp_min(tiny)).clamp_min(0)
    factors: Tensor = (1 + kept * change / before.clamp_min(tiny)).clamp(*RELIT)
    return factors
