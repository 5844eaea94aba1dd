"""How far an image is from its reference: one value for each image, with the domain in the name.

Images are ``(..., 3, H, W)`` scene-linear radiance; whatever stands before the last three axes is a batch.
"""

from __future__ import annotations

import importlib

import torch
from kornia.color import linear_rgb_to_rgb
from kornia.metrics import ssim
from torch import Tensor

from mcdenoise.errors import InputError

_SSIM_WINDOW = 11


def smape_linear(image: Tensor, reference: Tensor, *, epsilon: float = 1e-2) -> Tensor:
    """Symmetric mean absolute percentage error of scene-linear radiance: ``mean(|x - y| / (|x| + |y| + epsilon))``.

    Args:
        image: ``(..., C, H, W)`` scene-linear radiance.
        reference: of the same shape.
        epsilon: in the unit of the radiance.

    Returns:
        ``(...)`` in [0, 1], lower is better.

    Raises:
        ValueError: the shapes differ.

    Source: the paper's Eq. 9.

    Example:
        >>> smape_linear(torch.ones(1, 3, 2, 2), torch.full((1, 3, 2, 2), 3.0), epsilon=0.0).tolist()
        [0.5]
    """
    _check(image, reference)
    return ((image - reference).abs() / (image.abs() + reference.abs() + epsilon)).mean((-3, -2, -1))


def temporal_smape_linear(clip: Tensor, reference: Tensor, *, epsilon: float = 1e-2) -> Tensor:
    """SMAPE of the absolute differences between successive frames, which sees flicker and lag.

    With ``dx = |x_i - x_(i-1)|``, not motion-compensated: ``mean(|dx - dy| / (dx + dy + epsilon))``.

    Args:
        clip: ``(..., T, C, H, W)`` scene-linear radiance of successive frames, T at least 2.
        reference: of the same shape.
        epsilon: in the unit of the radiance.

    Returns:
        ``(...)`` in [0, 1], lower is better.

    Raises:
        ValueError: the shapes differ, or there are fewer than two frames.

    Source: the paper's Eq. 10.

    Example:
        >>> clip = torch.rand(4, 3, 2, 2)
        >>> temporal_smape_linear(clip + 1, clip).item() < 1e-4  # a constant error does not flicker
        True
    """
    _check_clip(clip, reference)
    return smape_linear(clip.diff(dim=-4).abs(), reference.diff(dim=-4).abs(), epsilon=epsilon).mean(-1)


def relmse_linear(image: Tensor, reference: Tensor, *, epsilon: float = 1e-2) -> Tensor:
    """Relative mean squared error of scene-linear radiance: ``mean((x - y)^2 / (mean_rgb(y)^2 + epsilon))``.

    Args:
        image: ``(..., C, H, W)`` scene-linear radiance.
        reference: of the same shape.
        epsilon: in the unit of the radiance squared.

    Returns:
        ``(...)``, lower is better.

    Raises:
        ValueError: the shapes differ.

    Source: Rousselle et al. 2011.
    """
    _check(image, reference)
    scale = reference.mean(-3, keepdim=True).square() + epsilon
    return ((image - reference).square() / scale).mean((-3, -2, -1))


def psnr_srgb(image: Tensor, reference: Tensor) -> Tensor:
    """Peak signal-to-noise ratio as displayed: clamped to [0, 1], sRGB curve, peak 1.

    ``kornia.metrics.psnr`` on these values gives the same for one image; it averages a batch before the logarithm.

    Args:
        image: ``(..., 3, H, W)`` scene-linear radiance.
        reference: of the same shape.

    Returns:
        ``(...)`` decibels, higher is better; infinite for equal images.

    Raises:
        ValueError: the shapes differ.
    """
    _check(image, reference)
    difference = displayed(image) - displayed(reference)
    return -10 * torch.log10(difference.square().mean((-3, -2, -1)))


def ssim_srgb(image: Tensor, reference: Tensor) -> Tensor:
    """Structural similarity as displayed: clamped to [0, 1], sRGB curve, data range 1.

    Gaussian window of 11x11 pixels with sigma 1.5, K1 = 0.01, K2 = 0.03, weighted (not sample) covariance, each channel
    by itself; the mean over channels and those pixels whose window lies within the image. It is
    ``kornia.metrics.ssim`` with ``padding="valid"``, and agrees with scikit-image's ``structural_similarity`` with
    ``gaussian_weights=True, sigma=1.5, use_sample_covariance=False, data_range=1``; published values with that
    function's defaults (7x7 uniform window, and once a data range of 2) are higher.

    Args:
        image: ``(..., 3, H, W)`` scene-linear radiance, H and W at least 11.
        reference: of the same shape.

    Returns:
        ``(...)`` in [-1, 1], higher is better, 1 for equal images.

    Raises:
        ValueError: the shapes differ, or the images are smaller than the window.

    Source: Wang et al. 2004.

    Example:
        >>> image = torch.rand(1, 3, 16, 16)
        >>> ssim_srgb(image, image).tolist()
        [1.0]
    """
    _check(image, reference)
    if min(image.shape[-2:]) < _SSIM_WINDOW:
        raise ValueError(f"image: expected at least 11 x 11 pixels, found {image.shape[-2]} x {image.shape[-1]}")
    shown, expected = (displayed(x).reshape(-1, *x.shape[-3:]) for x in (image, reference))
    # Without kornia's epsilon, which the denominator does not need (it is at least K1^2 K2^2), equal images give 1.
    similarity = ssim(shown, expected, _SSIM_WINDOW, max_val=1.0, eps=0.0, padding="valid")
    return similarity.mean((-3, -2, -1)).reshape(image.shape[:-3])


def flip_srgb(image: Tensor, reference: Tensor) -> Tensor:
    """Mean LDR-FLIP as displayed: clamped to [0, 1], sRGB curve, 67 pixels a degree; what a viewer sees on flipping.

    Computed by the authors' ``flip-evaluator``, on the CPU, about 1 microsecond a pixel; no gradient.

    Args:
        image: ``(..., 3, H, W)`` scene-linear radiance.
        reference: of the same shape.

    Returns:
        ``(...)`` in [0, 1], lower is better.

    Raises:
        ValueError: the shapes differ.
        InputError: the package ``flip-evaluator`` is not installed.

    Source: Andersson et al. 2020.
    """
    _check(image, reference)
    try:
        flip = importlib.import_module("flip_evaluator")
    except ImportError as error:
        raise InputError(
            "FLIP needs flip-evaluator, which is not installed; pip install 'mcdenoise[peers]', or leave FLIP out"
        ) from error
    shown, expected = (
        displayed(x.detach()).reshape(-1, *x.shape[-3:]).permute(0, 2, 3, 1).float().cpu().contiguous().numpy()
        for x in (image, reference)
    )
    means = [flip.evaluate(y, x, "LDR", applyMagma=False)[1] for x, y in zip(shown, expected, strict=True)]
    return torch.tensor(means, dtype=image.dtype, device=image.device).reshape(image.shape[:-3])


def temporal_rmse_srgb(clip: Tensor, reference: Tensor) -> Tensor:
    """Root mean squared error of the differences between successive frames as displayed, which sees flicker and lag.

    ``sqrt(mean(((x_i - x_(i-1)) - (y_i - y_(i-1)))^2))`` of values clamped to [0, 1] on the sRGB curve, not
    motion-compensated, of each pair of frames; then the mean over the pairs. A steady error, however large, is 0.

    Args:
        clip: ``(..., T, 3, H, W)`` scene-linear radiance of successive frames, T at least 2.
        reference: of the same shape.

    Returns:
        ``(...)`` in [0, 2], lower is better. The gradient is undefined where it is 0.

    Raises:
        ValueError: the shapes differ, or there are fewer than two frames.

    Example:
        >>> clip = torch.rand(4, 3, 2, 2)
        >>> temporal_rmse_srgb(clip, clip).item()
        0.0
    """
    _check_clip(clip, reference)
    error = displayed(clip) - displayed(reference)
    return error.diff(dim=-4).square().mean((-3, -2, -1)).sqrt().mean(-1)


def displayed(image: Tensor) -> Tensor:
    """Scene-linear radiance as a display shows it: clamped to [0, 1], sRGB curve."""
    return linear_rgb_to_rgb(image.clamp(0, 1))


def _check(image: Tensor, reference: Tensor) -> None:
    if image.shape != reference.shape or image.ndim < 3:
        raise ValueError(
            f"reference: expected the shape of image and (..., C, H, W), found {tuple(reference.shape)} "
            f"for {tuple(image.shape)}"
        )


def _check_clip(clip: Tensor, reference: Tensor) -> None:
    _check(clip, reference)
    if clip.ndim < 4 or clip.shape[-4] < 2:
        raise ValueError(f"clip: expected (..., T, C, H, W) with at least 2 frames, found {tuple(clip.shape)}")
