"""Errors of displayed values: clamped to [0, 1] with the sRGB curve, or (HDR-FLIP) over all exposures."""

from __future__ import annotations

from typing import Literal

import torch
from kornia.color import linear_rgb_to_rgb
from kornia.metrics import ssim
from torch import Tensor

from mcdenoise.metrics.linear import mse
from mcdenoise.metrics.metric import UncomputableError, check_images, check_window, package_of

_SSIM_WINDOW = 11
_LARGEST = 65504.0
# For references darker than this, flip-evaluator finds no exposures and ends the process.
_BLACK = 1e-5


def displayed(image: Tensor) -> Tensor:
    """Scene-linear radiance as a display shows it: clamped to [0, 1], sRGB curve (IEC 61966-2-1).

    Args:
        image: ``(..., 3, H, W)`` scene-linear radiance, Rec. 709 primaries.

    Returns:
        The same shape, in [0, 1].
    """
    return linear_rgb_to_rgb(image.clamp(0, 1))


def display_codes(image: Tensor) -> Tensor:
    """The values of :func:`displayed` as 8-bit codes: ``round(255 displayed)``.

    Args:
        image: ``(..., 3, H, W)`` scene-linear radiance, Rec. 709 primaries; no NaN.

    Returns:
        The same shape, uint8.

    Example:
        >>> display_codes(torch.tensor([0.0, 0.18, 1.0, 9.0]).expand(3, 1, 4))[0].tolist()
        [[0, 118, 255, 255]]
    """
    return (displayed(image) * 255).round().to(torch.uint8)


def psnr_srgb(image: Tensor, reference: Tensor) -> Tensor:
    """Peak signal-to-noise ratio as displayed: clamped to [0, 1], sRGB curve, peak 1.

    For one image ``kornia.metrics.psnr`` of the displayed values is equal; it averages a batch before the logarithm.

    Args:
        image: ``(..., 3, H, W)`` scene-linear radiance.
        reference: of the same shape.

    Returns:
        ``(...)`` decibels, higher is better; infinite for equal images.

    Raises:
        ValueError: the shapes differ.
    """
    check_images(image, reference)
    return psnr_of(displayed(image), displayed(reference))


def psnr_gamma(image: Tensor, reference: Tensor, *, gamma: float = 2.2) -> Tensor:
    """Peak signal-to-noise ratio of values clamped to [0, 1] with a power curve, peak 1.

    Args:
        image: ``(..., 3, H, W)`` scene-linear radiance.
        reference: of the same shape.
        gamma: the values are raised to ``1 / gamma``.

    Returns:
        ``(...)`` decibels, higher is better; infinite for equal images.

    Raises:
        ValueError: the shapes differ.

    Example:
        >>> white = torch.ones(3, 2, 2)
        >>> round(psnr_gamma(white * 0.25, white, gamma=2).item(), 4)  # 0.5 against 1
        6.0206
    """
    check_images(image, reference)
    return psnr_of(*(x.clamp(0, 1).pow(1 / gamma) for x in (image, reference)))


def psnr_of(image: Tensor, reference: Tensor) -> Tensor:
    """As :func:`psnr_srgb`, of images in [0, 1] that are shown as they are."""
    return -10 * torch.log10(mse(image, reference))


def ssim_srgb(image: Tensor, reference: Tensor) -> Tensor:
    """Structural similarity as displayed: clamped to [0, 1], sRGB curve, data range 1.

    It uses a Gaussian window of 11x11 pixels with sigma 1.5, K1 = 0.01, K2 = 0.03 and weighted (not sample) covariance,
    and is the mean over the channels and over the pixels whose window lies within the image. It is computed by
    ``kornia.metrics.ssim`` with ``padding="valid"``, and agrees with scikit-image's ``structural_similarity`` with
    ``gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1``. Published values with the defaults
    of that function (7x7 uniform window, in old versions a data range of 2) are higher.

    Args:
        image: ``(..., 3, H, W)`` scene-linear radiance, H and W at least 11.
        reference: of the same shape.

    Returns:
        ``(...)`` in [-1, 1], higher is better, 1 for equal images.

    Raises:
        ValueError: the shapes differ.
        UncomputableError: the images are smaller than the window.

    Source: Wang et al. 2004.

    Example:
        >>> image = torch.rand(1, 3, 16, 16)
        >>> ssim_srgb(image, image).tolist()
        [1.0]
    """
    check_images(image, reference)
    return ssim_of(displayed(image), displayed(reference))


def ssim_of(image: Tensor, reference: Tensor) -> Tensor:
    """As :func:`ssim_srgb`, of images in [0, 1] that are shown as they are, with any number of channels."""
    check_window("SSIM's window", image, _SSIM_WINDOW)
    shown, expected = (x.reshape(-1, *x.shape[-3:]) for x in (image, reference))
    # Drop kornia's epsilon, so that equal images give 1: the denominator is at least K1^2 K2^2 without it.
    similarity = ssim(shown, expected, _SSIM_WINDOW, max_val=1.0, eps=0.0, padding="valid")
    return similarity.mean((-3, -2, -1)).reshape(image.shape[:-3])


def flip_srgb(image: Tensor, reference: Tensor) -> Tensor:
    """Mean LDR-FLIP as displayed: clamped to [0, 1], sRGB curve, 67 pixels per degree.

    LDR-FLIP estimates the difference that a viewer sees when flipping between the two images. It is computed by the
    authors' package ``flip-evaluator`` on the CPU, at about 1 microsecond per pixel, and has no gradient.

    Args:
        image: ``(..., 3, H, W)`` scene-linear radiance.
        reference: of the same shape.

    Returns:
        ``(...)`` in [0, 1], lower is better.

    Raises:
        ValueError: the shapes differ.
        UncomputableError: the package ``flip-evaluator`` is not installed.

    Source: Andersson et al. 2020.
    """
    check_images(image, reference)
    return flip(displayed(image), displayed(reference), "LDR")


def flip_hdr(image: Tensor, reference: Tensor) -> Tensor:
    """Mean HDR-FLIP: the maximum LDR-FLIP of each pixel over a range of exposures chosen from the reference.

    It takes scene-linear radiance, applies each exposure and the ACES curve of the metric's authors, and assumes 67
    pixels per degree. It is computed by the authors' package ``flip-evaluator`` with its defaults, on the CPU, at the
    cost of one LDR-FLIP per exposure (2 to about 15), and has no gradient.

    Args:
        image: ``(..., 3, H, W)`` scene-linear radiance; clamped to [0, 65504].
        reference: of the same shape.

    Returns:
        ``(...)`` in [0, 1], lower is better.

    Raises:
        ValueError: the shapes differ.
        UncomputableError: a reference is black, or the package ``flip-evaluator`` is not installed.

    Source: Andersson et al. 2021, Visualizing Errors in Rendered High Dynamic Range Images.
    """
    check_images(image, reference)
    if bool((reference.amax((-3, -2, -1)) < _BLACK).any()):
        raise UncomputableError("HDR-FLIP's exposures: expected a reference with light in it, found a black one")
    return flip(image.clamp(0, _LARGEST), reference.clamp(0, _LARGEST), "HDR")


def flip(image: Tensor, reference: Tensor, dynamic_range: Literal["LDR", "HDR"]) -> Tensor:
    """Mean FLIP of images that are already in the domain of the metric.

    Args:
        image: ``(..., 3, H, W)`` in [0, 1] on the sRGB curve for ``"LDR"``, else scene-linear and at least 0.
        reference: of the same shape.
        dynamic_range: ``"LDR"`` for LDR-FLIP, ``"HDR"`` for HDR-FLIP.

    Returns:
        ``(...)`` in [0, 1], lower is better.

    Raises:
        UncomputableError: the package ``flip-evaluator`` is not installed.
    """
    evaluator = package_of("FLIP", "flip-evaluator", "flip_evaluator")
    tests, truths = (
        x.detach().reshape(-1, *x.shape[-3:]).permute(0, 2, 3, 1).float().cpu().contiguous().numpy()
        for x in (image, reference)
    )
    means = [
        evaluator.evaluate(truth, test, dynamic_range, applyMagma=False)[1]
        for test, truth in zip(tests, truths, strict=True)
    ]
    return torch.tensor(means, dtype=image.dtype, device=image.device).reshape(image.shape[:-3])
