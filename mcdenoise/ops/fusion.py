"""Laplacian-style fusion of two scales, and the 2x2 down- and upsampling it needs."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from mcdenoise.ops._check import check_half, check_shapes
from mcdenoise.ops._module import module_of
from mcdenoise.ops._window import accumulator_dtype, block_means, corner, of_blocks


def downsample(image: Tensor) -> Tensor:
    """Average blocks of 2x2 pixels.

    ``out[y, x] = mean of image[2y : 2y + 2, 2x : 2x + 2]``; where the height or width is odd, the last blocks hold
    only the pixels that exist.

    Args:
        image: ``(B, C, H, W)``, any unit, up to a quarter of the largest number.

    Returns:
        ``(B, C, ceil(H / 2), ceil(W / 2))``.

    Raises:
        TypeError: the image is no floating-point tensor.
        ValueError: the image is not four-dimensional.

    Differentiable in ``image``, to any order.

    Source: ``D`` of the paper's Eq. 2.

    Example:
        >>> import torch
        >>> downsample(torch.arange(9.0).reshape(1, 1, 3, 3)).flatten().tolist()
        [2.0, 3.5, 6.5, 8.0]
    """
    check_shapes(image=(image, "B C H W"))
    return block_means(image, 2)


def upsample(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Repeat every pixel 2x2 times and cut to ``size``, so that it undoes the size change of :func:`downsample`.

    ``out[y, x] = image[y // 2, x // 2]``.

    Args:
        image: ``(B, C, ceil(H / 2), ceil(W / 2))``, any unit and range.
        size: ``(H, W)`` of the result.

    Returns:
        ``(B, C, H, W)``.

    Raises:
        TypeError: the image is no floating-point tensor.
        ValueError: the image has not the size that :func:`downsample` gives for ``size``.

    Differentiable in ``image``, to any order.

    Source: ``U`` of the paper's Eq. 2 (nearest neighbour).

    Example:
        >>> import torch
        >>> upsample(torch.tensor([[[[1.0, 2.0]]]]), (2, 3)).tolist()
        [[[[1.0, 1.0, 2.0], [1.0, 1.0, 2.0]]]]
    """
    check_shapes(image=(image, "B C H W"))
    check_half("image", image, size)
    if 0 in image.shape:
        return of_blocks(image, 2, *size)
    return corner(F.interpolate(image, scale_factor=2, mode="nearest"), *size)


def laplacian_fusion(fine: Tensor, coarse: Tensor, alpha: Tensor) -> Tensor:
    """Replace, as far as ``alpha`` says, the low frequencies of a fine image by a coarse image.

    ``o = i_f - alpha * U(D(i_f)) + alpha * U(i_c)`` with :func:`downsample` ``D`` and :func:`upsample` ``U``.

    Args:
        fine: ``(B, C, H, W)`` image ``i_f``, any unit, up to a quarter of the largest number.
        coarse: ``(B, C, ceil(H / 2), ceil(W / 2))`` image ``i_c`` of the same unit.
        alpha: ``(B, 1, H, W)`` or ``(B, C, H, W)`` blending weight; 0 keeps ``fine``, 1 takes all low frequencies
            from ``coarse``.

    Returns:
        ``(B, C, H, W)`` in the dtype of ``fine``, which can be negative where the inputs are not: radiance needs a
        ``relu()`` behind it. Half precision is computed in float32.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: shapes disagree.

    Differentiable in ``fine``, ``coarse`` and ``alpha``, to any order.

    Source: the paper's Eq. 2; Vogels et al. 2018, "Denoising with kernel prediction and asymmetric loss functions",
    Eq. 4.

    Example:
        >>> import torch
        >>> fine, coarse = torch.rand(1, 3, 5, 7), torch.rand(1, 3, 3, 4)
        >>> torch.equal(laplacian_fusion(fine, coarse, torch.zeros(1, 1, 5, 7)), fine)
        True
    """
    sizes = check_shapes(fine=(fine, "B C H W"), coarse=(coarse, "B C h w"), alpha=(alpha, "B A H W"))
    size = (sizes["H"], sizes["W"])
    check_half("coarse", coarse, size)
    if sizes["A"] not in (1, sizes["C"]):
        raise ValueError(f"alpha: expected 1 or {sizes['C']} channels, found {sizes['A']}")
    dtype = accumulator_dtype(fine.dtype)
    source = fine.to(dtype)
    # Linear in what is upsampled, so one upsampling serves both terms.
    return (source + alpha.to(dtype) * upsample(coarse.to(dtype) - downsample(source), size)).to(fine.dtype)


LaplacianFusion = module_of(laplacian_fusion)
