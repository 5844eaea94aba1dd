"""The cross-bilateral filter: weights and convolution in one."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from mcdenoise.ops._module import module_of
from mcdenoise.ops._op import op, plain
from mcdenoise.ops._window import Border, accumulator_dtype
from mcdenoise.ops.bilateral import Normalize, check_settings, check_weights, cross_bilateral_weights
from mcdenoise.ops.kernel_conv import kernel_conv


@op("numba", check=check_weights, image="B C H W", kernel="B T H W")
def cross_bilateral_filter(
    image: Tensor,
    kernel: Tensor,
    guides: Sequence[Tensor] = (),
    falloffs: Sequence[Tensor] = (),
    distance_falloff: Tensor | None = None,
    *,
    normalize: Normalize = "softmax",
    border: Border = "replicate",
) -> Tensor:
    """Filter an image with per-pixel kernels that fall off where guides differ.

    ``out[p] = sum_t w'[t, p] * image[p + o_t]`` with the weights ``w'`` of :func:`cross_bilateral_weights`: it is
    ``kernel_conv(image, cross_bilateral_weights(kernel, guides, ...))``, except that the weights are never rounded to
    half precision. The fast backend never stores them either.

    Args:
        image: ``(B, C, H, W)``, any unit and range.
        kernel: see :func:`cross_bilateral_weights`; any layout in memory, such as channels-last.
        guides: see :func:`cross_bilateral_weights`.
        falloffs: see :func:`cross_bilateral_weights`.
        distance_falloff: see :func:`cross_bilateral_weights`.
        normalize: see :func:`cross_bilateral_weights`.
        border: image and guides at a tap outside the image: ``"replicate"`` those of the nearest edge pixel,
            ``"zeros"`` zeros; ``"renormalize"`` rejects such taps and divides by the sum of the weights that are
            left (0 where that sum is 0), so that the result is a weighted mean everywhere.

    Returns:
        ``(B, C, H, W)`` in the dtype of ``image``. Half precision is computed in float32.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: shapes disagree, ``K`` is even, the numbers of guides and falloffs differ, or a mode is unknown.

    Differentiable in ``image``, ``kernel``, ``guides``, ``falloffs`` and ``distance_falloff``, to any order.

    Source: the paper's Eqs. 4-8; Eisemann and Durand 2004, Petschnigg et al. 2004 (cross/joint bilateral filter).

    Example:
        >>> import torch
        >>> image = torch.tensor([2.0, 4.0, 100.0]).reshape(1, 1, 1, 3)
        >>> guide = torch.tensor([0.0, 0.0, 1.0]).reshape(1, 1, 1, 3)
        >>> filtered = cross_bilateral_filter(image, torch.zeros(1, 9, 1, 3), [guide], [torch.full((1, 1, 1, 3), 1e8)],
        ...                                   border="renormalize")
        >>> filtered.flatten().tolist()  # the third pixel is another surface
        [3.0, 3.0, 100.0]
    """
    weights = cross_bilateral_weights(
        kernel.to(accumulator_dtype(kernel.dtype)),
        guides,
        falloffs,
        distance_falloff,
        normalize=normalize,
        border=border,
    )
    # A tap that the softmax rejects has weight 0, and the weights of the others sum to 1 already.
    left_out = border == "renormalize" and normalize == "softmax"
    return plain(kernel_conv)(image, weights, border="zeros" if left_out else border)


CrossBilateralFilter = module_of(cross_bilateral_filter, check_settings)
