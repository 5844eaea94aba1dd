"""The light of an image divided among the levels of a pyramid, and learned upsampling that adds it up."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.ops._check import check_half, check_shapes
from mcdenoise.ops._window import Border, accumulator_dtype, block_means, corner, unpad


def pyramid_partition(image: Tensor, logits: Tensor) -> tuple[Tensor, ...]:
    """Split every pixel's light among the levels of a pyramid, each half the size of the one before.

    ``out_i[q] = mean of softmax(logits)[i] * image over the pixels of block q``, blocks of ``2^i x 2^i`` pixels for
    ``i = 0, ..., K - 1``. Blocks at the lower and right border hold only the pixels that exist. No light is lost: the
    sum of ``out_i[q]`` times the number of pixels in block ``q``, over all levels and blocks, is that of the image.

    Args:
        image: ``(B, C, H, W)``, any unit, up to ``4^(1 - K)`` of the largest number.
        logits: ``(B, K, H, W)``, finite, one for each level, the finest first.

    Returns:
        ``K`` images ``(B, C, ceil(H / 2^i), ceil(W / 2^i))`` in the dtype of ``image``, finest first. Half precision is
        computed in float32.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: shapes disagree, or there is no level.

    Differentiable in ``image`` and ``logits``, to any order.

    Source: Balint et al. 2023, "Neural Partitioning Pyramids for Denoising Monte Carlo Renderings".

    Example:
        >>> image = torch.tensor([[[[4.0, 8.0], [0.0, 0.0]]]])
        >>> fine, coarse = pyramid_partition(image, torch.zeros(1, 2, 2, 2))
        >>> fine.flatten().tolist(), coarse.item()  # half of the light stays, and half is 4 pixels times 1.5
        ([2.0, 4.0, 0.0, 0.0], 1.5)
    """
    levels = check_shapes(image=(image, "B C H W"), logits=(logits, "B K H W"))["K"]
    if levels < 1:
        raise ValueError("logits: expected a channel for each of at least 1 level, found 0")
    dtype = accumulator_dtype(image.dtype)
    source, weights = image.to(dtype), torch.softmax(logits.to(dtype), 1)
    parts = ((1 << level, source * weights[:, level : level + 1]) for level in range(levels))
    return tuple(block_means(part, side).to(image.dtype) for side, part in parts)


def learned_upsample(image: Tensor, kernel: Tensor, size: tuple[int, int], *, border: Border = "replicate") -> Tensor:
    """Double the size of an image by spreading each pixel over ``K x K`` finer ones with weights of its own.

    ``out[y, x] = sum kernel[r K + s, i, j] image[i, j]`` over all ``i, j, r, s`` with ``y = 2 i + r - K / 2 + 1`` and
    ``x = 2 j + s - K / 2 + 1``: taps around the 2x2 pixels that a coarse one covers, which are all for ``K = 2``. For
    ``K = 4``, 4 coarse pixels reach each fine one. With weights that sum to 4 light is kept, since a fine pixel is a
    quarter of a coarse one.

    Args:
        image: ``(B, C, ceil(H / 2), ceil(W / 2))``, any unit and range.
        kernel: ``(B, K*K, ceil(H / 2), ceil(W / 2))`` weights, even ``K``, taps row by row from top left; used as they
            are. The published ones are a softmax times 4.
        size: ``(H, W)`` of the result. Where one is odd, the last row or column of the doubled image is cut off, as
            :func:`mcdenoise.ops.upsample` does.
        border: where light goes that leaves the doubled image: ``"replicate"`` to the nearest edge pixel, so that none
            is lost and, for ``K`` up to 4, equal weights that sum to 4 leave a constant image constant; ``"zeros"``
            nowhere, as in the published code.

    Returns:
        ``(B, C, H, W)`` in the dtype of ``image``. Half precision is summed in float32. Holds while the sum of
        ``|kernel image|`` is below the largest number.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: shapes disagree, the image has not half of ``size``, ``K`` is odd, or ``border`` is another one.

    Differentiable in ``image`` and ``kernel``, to any order.

    Source: Balint et al. 2023, "Neural Partitioning Pyramids for Denoising Monte Carlo Renderings", and its
    published code, with ``K = 4``.

    Example:
        >>> image = torch.tensor([[[[3.0, 3.0]]]])
        >>> learned_upsample(image, torch.full((1, 16, 1, 2), 1 / 4), (2, 3)).tolist()
        [[[[3.0, 3.0, 3.0], [3.0, 3.0, 3.0]]]]
    """
    sizes = check_shapes(image=(image, "B C h w"), kernel=(kernel, "B T h w"))
    side = math.isqrt(sizes["T"])
    if side**2 != sizes["T"] or side % 2 or not side:
        raise ValueError(f"kernel: expected K*K channels with even K (4, 16, 36, ...), found {sizes['T']}")
    if border not in ("replicate", "zeros"):
        raise ValueError(f"border: expected 'replicate' or 'zeros', found {border!r}")
    check_half("image", image, size)
    dtype, margin = accumulator_dtype(image.dtype), side // 2 - 1
    if image.numel() == 0:
        return image.new_zeros(*image.shape[:2], *size)
    spread = (image.to(dtype)[:, :, None] * kernel.to(dtype)[:, None]).flatten(1, 2).flatten(2)
    whole = (2 * (sizes["h"] + margin), 2 * (sizes["w"] + margin))
    return corner(unpad(F.fold(spread, whole, side, stride=2), margin, border), *size).to(image.dtype)
