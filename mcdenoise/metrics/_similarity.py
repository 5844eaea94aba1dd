"""Structural similarity in the variants of published results."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, conv2d

from mcdenoise.metrics._check import UncomputableError

_K1, _K2 = 0.01, 0.03
# Weights of the five scales, from fine to coarse: Wang, Simoncelli and Bovik 2003, Sec. 3.2.
_SCALES = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)


def gaussian(size: int = 11, sigma: float = 1.5) -> Tensor:
    """``(size,)`` Gaussian window that sums to one."""
    x = torch.arange(size, dtype=torch.float64) - size // 2
    weights = torch.exp(-x.square() / (2 * sigma**2))
    return weights / weights.sum()


def uniform(size: int = 7) -> Tensor:
    """``(size,)`` box window that sums to one."""
    return torch.full((size,), 1 / size, dtype=torch.float64)


def similarity(
    image: Tensor, reference: Tensor, window: Tensor, data_range: float, *, sample_covariance: bool = False
) -> tuple[Tensor, Tensor]:
    """Structural similarity of every channel, over the pixels whose window lies inside the image.

    With local means, variances and covariance under the window: ``SSIM = mean(l cs)``,
    ``l = (2 ux uy + C1) / (ux^2 + uy^2 + C1)``, ``cs = (2 sxy + C2) / (sx^2 + sy^2 + C2)``, ``C = (K data_range)^2``.

    Args:
        image: ``(B, C, H, W)``.
        reference: the same shape.
        window: ``(size,)`` weights, applied in both directions.
        data_range: range of the values.
        sample_covariance: divide by the number of pixels minus one; for windows of equal weights.

    Returns:
        ``(B, C)`` mean SSIM, and ``(B, C)`` mean cs.

    Raises:
        UncomputableError: the images are smaller than the window.

    Source: Wang et al. 2004, Eqs. 6-13.
    """
    size = len(window)
    if min(image.shape[-2:]) < size:
        raise UncomputableError(
            f"SSIM's window: expected at least {size} x {size} pixels, found {image.shape[-2]} x {image.shape[-1]}"
        )
    weights = window.to(image)
    stack = torch.stack([image, reference, image * image, reference * reference, image * reference])
    flat = stack.reshape(-1, 1, *image.shape[-2:])
    local = conv2d(conv2d(flat, weights.reshape(1, 1, -1, 1)), weights.reshape(1, 1, 1, -1))
    ux, uy, uxx, uyy, uxy = local.reshape(5, *image.shape[:2], *local.shape[-2:])
    correction = size**2 / (size**2 - 1) if sample_covariance else 1.0
    c1, c2 = (_K1 * data_range) ** 2, (_K2 * data_range) ** 2
    cs = (2 * correction * (uxy - ux * uy) + c2) / (correction * (uxx - ux * ux + uyy - uy * uy) + c2)
    luminance = (2 * ux * uy + c1) / (ux * ux + uy * uy + c1)
    return (luminance * cs).mean((-2, -1)), cs.mean((-2, -1))


def multiscale_similarity(image: Tensor, reference: Tensor, data_range: float) -> Tensor:
    """Similarity over five scales, each half as large as the one before: ``l_5 cs_5^w5 prod_(j<5) cs_j^wj``.

    Gaussian window of 11 with sigma 1.5; scales are 2x2 means (an odd side is padded with zeros); negative factors
    count as 0: the conventions of ``pytorch_msssim.ms_ssim``.

    Args:
        image: ``(B, C, H, W)``.
        reference: the same shape.
        data_range: range of the values.

    Returns:
        ``(B, C)`` in [0, 1].

    Raises:
        UncomputableError: a side is at most 160 pixels, which is too small for five scales.

    Source: Wang, Simoncelli and Bovik 2003.
    """
    if min(image.shape[-2:]) <= 160:
        raise UncomputableError(
            f"MS-SSIM's five scales: expected more than 160 x 160 pixels, found {image.shape[-2]} x {image.shape[-1]}"
        )
    product = image.new_ones(())
    for scale, exponent in enumerate(_SCALES):
        whole, contrast = similarity(image, reference, gaussian(), data_range)
        last = scale == len(_SCALES) - 1
        product = product.to(whole) * (whole if last else contrast).clamp_min(0) ** exponent
        if not last:
            odd = (image.shape[-2] % 2, image.shape[-1] % 2)
            image, reference = (avg_pool2d(x, 2, padding=odd) for x in (image, reference))
    return product
