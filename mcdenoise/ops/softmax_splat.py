"""Splat pixels by predicted kernels, and divide by the sum of the weights that arrive."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.ops._check import check_shapes
from mcdenoise.ops._window import accumulator_dtype, kernel_size_of, offsets, shifted
from mcdenoise.ops.kernel_conv import kernel_splat


def softmax_splat(image: Tensor, logits: Tensor) -> tuple[Tensor, Tensor]:
    """Spread every pixel over its neighbours by the exponentials of its logits, and divide by the weights that arrive.

    With the offsets ``o_t`` of the ``K x K`` window, over the pixels ``q - o_t`` inside the image,

    - ``weight[q] = sum_t exp(logits[t, q - o_t])``,
    - ``out[q] = sum_t exp(logits[t, q - o_t]) image[q - o_t] / weight[q]``.

    The largest exponent that arrives at a pixel is subtracted from all that do, so that no exponential overflows and
    the sum is at least 1. Several splats, such as those of the samples of each pixel, are combined by the logarithms of
    their weights: with ``w = sigmoid(log_weight_2 - log_weight_1)`` the mean of two is ``lerp(out_1, out_2, w)``, and
    the logarithm of its weight ``logaddexp(log_weight_1, log_weight_2)``.

    Args:
        image: ``(B, C, H, W)``, any unit and range.
        logits: ``(B, K*K, H, W)`` finite, odd ``K``: tap ``t`` of pixel ``p`` says how much of ``p`` goes to
            ``p + o_t``, row by row from top left. Light that leaves the image is lost.

    Returns:
        ``(B, C, H, W)`` means, in the dtype of ``image``, and ``(B, 1, H, W)`` logarithms of the weights that arrived,
        in the dtype of ``logits``. Half precision is computed in float32. The mean holds while the sum of ``|image|``
        over a window is below the largest number.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: shapes disagree, or ``K`` is even.

    Differentiable in ``image`` and ``logits``, to any order.

    Source: Gharbi et al. 2019, "Sample-based Monte Carlo denoising using a kernel-splatting network"; the
    running maximum over samples is that of their published code.

    Example:
        >>> image = torch.tensor([1.0, 2.0, 6.0]).reshape(1, 1, 1, 3)
        >>> mean, log_weight = softmax_splat(image, torch.zeros(1, 9, 1, 3))
        >>> mean.flatten().tolist()
        [1.5, 3.0, 4.0]
        >>> log_weight.exp().flatten().round().tolist()
        [2.0, 3.0, 2.0]
    """
    check_shapes(image=(image, "B C H W"), logits=(logits, "B T H W"))
    size = kernel_size_of(logits.shape[1], "logits")
    if image.numel() == 0:
        return image, logits[:, :1]
    dtype = accumulator_dtype(image.dtype)
    exponents = logits.to(accumulator_dtype(logits.dtype))
    largest = _largest_arriving(exponents.detach(), size)
    # For each tap, the largest logit of the pixel that it goes to; infinite outside, where nothing arrives.
    arriving = F.unfold(F.pad(largest, (size // 2,) * 4, value=torch.inf), size)
    weights = torch.exp(exponents - arriving.reshape(exponents.shape))
    source = torch.cat([image.to(dtype), torch.ones_like(image[:, :1], dtype=dtype)], 1)
    total = kernel_splat(source, weights, border="zeros")
    mean = total[:, :-1] / total[:, -1:]
    log_weight = largest + torch.log(total[:, -1:].to(largest.dtype))
    return mean.to(image.dtype), log_weight.to(logits.dtype)


def _largest_arriving(logits: Tensor, size: int) -> Tensor:
    """``max_t logits[t, q - o_t]`` of each pixel ``q``, ``(B, 1, H, W)``."""
    radius, (height, width) = size // 2, logits.shape[-2:]
    largest = logits[:, size**2 // 2][:, None]
    for tap, dy, dx in offsets(size):
        padded = F.pad(logits[:, tap : tap + 1], (radius,) * 4, value=-torch.inf)
        largest = torch.maximum(largest, shifted(padded, radius, -dy, -dx, height, width))
    return largest
