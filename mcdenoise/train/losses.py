"""The training loss: errors of the images of a clip, by stage."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.errors import InputError
from mcdenoise.metrics import smape_linear, temporal_smape_linear
from mcdenoise.metrics.metric import check_images
from mcdenoise.models import Output
from mcdenoise.nn.oidn import oidn_exposure
from mcdenoise.ops._steps.transfer import compress

Loss = Literal["smape", "l1_display", "rae", "oidn"]

RESULT = "image"
_DARK = 1e-3
# Open Image Denoise's weights of both errors, and the window and constants of Wang et al. 2003.
_L1, _STRUCTURE, _SCALES = 0.16, 0.84, 5
_WINDOW, _SIGMA, _LUMINANCE, _CONTRAST = 11, 1.5, 0.01**2, 0.03**2


def stage_loss(
    output: Output,
    reference: Tensor,
    weights: Mapping[str, float],
    *,
    loss: Loss = "smape",
    temporal_weight: float = 0.1,
    display_weight: float = 0.0,
) -> Tensor:
    """The total loss: for the image and for intermediate stages, errors in space and time, and errors on a display.

    ``L = sum_s w_s (L_c(R_s, Y) + w_d L_d(R_s, Y))`` with the loss ``L_c`` of a clip; with ``L_c`` of
    :func:`smape_loss`, weights of 1 for the result and the stage ``initial``, and without ``w_d``, that is the paper's.

    Args:
        output: output for a clip: images ``(B, T, 3, H, W)``, scene-linear radiance including albedo.
        reference: Y, the same shape, or that of its last frames only, which are then the clip.
        weights: weight of the result, ``"image"``, and of stages by name; other stages have weight 0.
        loss: a name in :data:`LOSSES`: ``"smape"``, :func:`smape_loss`; ``"l1_display"``, :func:`l1_display_loss`;
            ``"rae"``, :func:`rae_loss`; or ``"oidn"``, :func:`oidn_loss`.
        temporal_weight: ``w_t`` of these, the paper's ``w_c = w_d``, 0.1; 0 disables the temporal loss.
        display_weight: ``w_d`` of :func:`display_error`; 0, as in the paper, disables it.

    Returns:
        A scalar, the mean over the batch.

    Raises:
        ValueError: the shapes differ, or a temporal loss is requested for clips of one frame.

    Differentiable in all images.

    Source: the paper's Eqs. 9-11, with ``w_a = w_b = 1``.

    Example:
        >>> import torch
        >>> clip = torch.rand(2, 3, 3, 4, 4)
        >>> stage_loss(Output(clip, {"initial": clip}), clip, {"image": 1, "initial": 1}).item()
        0.0
    """
    count = reference.shape[1]
    images = {stage: image[:, -count:] for stage, image in ((RESULT, output.image), *output.stages.items())}
    total = reference.new_zeros(())
    for stage, weight in weights.items():
        total = total + weight * LOSSES[loss](images[stage], reference, temporal_weight=temporal_weight)
        if display_weight:
            total = total + weight * display_weight * display_error(images[stage], reference).mean()
    return total


def smape_loss(image: Tensor, reference: Tensor, *, temporal_weight: float = 0.1) -> Tensor:
    """Spatial and temporal SMAPE of clips, the paper's Eqs. 9 and 10: ``L_s(R, Y) + w_t L_t(dR, dY)``.

    Args:
        image: R, ``(B, T, 3, H, W)`` scene-linear radiance.
        reference: Y, the same shape.
        temporal_weight: ``w_t``; 0 disables the temporal loss.

    Returns:
        A scalar, the mean over the batch.

    Raises:
        ValueError: the shapes differ, or a temporal loss is requested for clips of one frame.
    """
    spatial = smape_linear(image, reference).mean()
    return spatial + temporal_weight * temporal_smape_linear(image, reference).mean() if temporal_weight else spatial


def l1_display_loss(image: Tensor, reference: Tensor, *, temporal_weight: float = 0.1) -> Tensor:
    """Mean absolute difference of gamma-mapped radiance, which gives bright pixels less weight than dark ones.

    ``L = mean |g(R) - g(Y)| + w_t L_t(dR, dY)`` with ``g(x) = (max(x, 0) + c)^(1 / 2.2)`` and ``c = 0.001``. Meng et
    al. 2020 train without ``c`` and without ``L_t``. Unlike :func:`display_error` it has no upper limit.

    Args:
        image: R, ``(B, T, 3, H, W)`` scene-linear radiance.
        reference: Y, the same shape.
        temporal_weight: ``w_t`` of the temporal SMAPE; 0 disables it.

    Returns:
        A scalar, the mean over the batch, differentiable where both images differ, also in black.

    Raises:
        ValueError: the shapes differ, or a temporal loss is requested for clips of one frame.
    """
    check_images(image, reference)
    shown, wanted = (each.clamp_min(0).add(_DARK).pow(1 / 2.2) for each in (image, reference))
    spatial = (shown - wanted).abs().mean()
    return spatial + temporal_weight * temporal_smape_linear(image, reference).mean() if temporal_weight else spatial


def rae_loss(image: Tensor, reference: Tensor, *, temporal_weight: float = 0.1) -> Tensor:
    """L1 of values, of gradients and of temporal differences, with larger weights for later frames of a clip.

    ``L = sum_t g_t (0.8 L_s + 0.1 L_g + w_t L_t) / sum_t g_t``, with ``P = log(1 + R)`` and ``T = log(1 + Y)``:

    - ``L_s = mean |P - T|``,
    - ``L_g = mean |dP - dT|`` over the differences between neighbours along x, and along y, the mean of both,
    - ``L_t = mean |(P_t - P_{t-1}) - (T_t - T_{t-1})|``, 0 for the first frame,
    - ``g_t = exp(-(n - t)^2 / 8)`` for frame t of n: for 7 frames 0.011, 0.044, 0.135, 0.325, 0.607, 0.882, 1, which
      gives a hidden state time to adapt.

    The terms and their weights are those of the paper. Our choices are the logarithms, differences of neighbours as
    gradients, and the division by the sum of the weights, which makes the loss independent of the clip's length.

    Args:
        image: R, ``(B, T, 3, H, W)`` scene-linear radiance, not negative.
        reference: Y, the same shape.
        temporal_weight: ``w_t``.

    Returns:
        A scalar, the mean over the batch.

    Raises:
        ValueError: the shapes differ.

    Differentiable in both images where no two compared values are equal.

    Source: Chaitanya et al. 2017, the equations of the spatial, gradient and temporal loss. The weights of the frames
    are a Gaussian with a deviation of 2 frames, which gives the seven numbers of the paper.

    Example:
        >>> clip = torch.full((1, 7, 3, 4, 4), 0.5)
        >>> round(rae_loss(torch.zeros_like(clip), clip).item(), 4)  # 0.8 log(1.5)
        0.3244
    """
    check_images(image, reference)
    error = torch.log1p(image) - torch.log1p(reference)
    frames = error.shape[1]
    counts = torch.exp(-torch.arange(frames - 1, -1, -1, device=error.device).to(error.dtype).square() / 8)
    each = 0.8 * _by_frame(error)
    # An image of one row or column has no gradient along that axis.
    for dim in (-1, -2):
        if error.shape[dim] > 1:
            each = each + 0.05 * _by_frame(error.diff(dim=dim))
    # Differences are linear: compute them from the errors.
    change = torch.cat([torch.zeros_like(error[:, :1]), error.diff(dim=1)], 1)
    each = each + temporal_weight * _by_frame(change)
    return (each * counts).sum(1).mean() / counts.sum()


def _by_frame(error: Tensor) -> Tensor:
    """``(B, T)``: mean absolute error of each frame."""
    return error.abs().mean((-3, -2, -1))


def oidn_loss(image: Tensor, reference: Tensor, *, temporal_weight: float = 0.1) -> Tensor:
    """The loss that Open Image Denoise's networks are trained with, and a temporal term.

    ``L = 0.16 mean |P - T| + 0.84 (1 - MS-SSIM(P, T)) + w_t mean |(P_t - P_{t-1}) - (T_t - T_{t-1})|`` of values on the
    library's perceptually uniform scale, :func:`mcdenoise.ops.compress`, with the exposure of the clip's last
    reference. MS-SSIM has five scales of equal weight, fewer where the window would be larger than the image.

    Args:
        image: R, ``(B, T, 3, H, W)`` scene-linear radiance.
        reference: Y, the same shape.
        temporal_weight: ``w_t``; 0 disables the temporal term.

    Returns:
        A scalar, the mean over the batch.

    Raises:
        ValueError: the shapes differ.

    Differentiable in both images where no two compared values are equal.

    Source: the library's ``training/`` at version 2.4.1; Wang et al. 2003, "Multiscale structural similarity for image
    quality assessment".

    Example:
        >>> clip = torch.rand(1, 2, 3, 16, 16)
        >>> round(oidn_loss(clip, clip).item(), 6)
        0.0
    """
    check_images(image, reference)
    exposure = oidn_exposure(reference[:, -1])[:, None]
    shown, wanted = (compress(each * exposure) for each in (image, reference))
    error = shown - wanted
    loss = _L1 * error.abs().mean() + _STRUCTURE * (1 - _multiscale(shown.flatten(0, 1), wanted.flatten(0, 1)))
    return loss + temporal_weight * error.diff(dim=1).abs().mean() if temporal_weight else loss


def _multiscale(a: Tensor, b: Tensor) -> Tensor:
    """MS-SSIM of images ``(B, C, H, W)`` from 0 to 1."""
    x = torch.arange(_WINDOW, device=a.device).to(a.dtype) - _WINDOW // 2
    row = torch.exp(-x.square() / (2 * _SIGMA**2))
    row = row / row.sum()
    scales = max(1, min(_SCALES, int(math.log2(min(a.shape[-2:]) / _WINDOW)) + 1))
    found = a.new_ones(())
    for scale in range(scales):
        images = torch.stack([a, b, a * a, b * b, a * b]).reshape(-1, 1, *a.shape[-2:])
        around = F.conv2d(F.conv2d(images, row.reshape(1, 1, 1, -1)), row.reshape(1, 1, -1, 1))
        mean_a, mean_b, *squares = around.unflatten(0, (5, -1))
        var_a, var_b, both = (s - m for s, m in zip(squares, (mean_a**2, mean_b**2, mean_a * mean_b), strict=True))
        alike = (2 * both + _CONTRAST) / (var_a + var_b + _CONTRAST)
        if scale == scales - 1:
            alike = alike * (2 * mean_a * mean_b + _LUMINANCE) / (mean_a**2 + mean_b**2 + _LUMINANCE)
        found = found * alike.mean().clamp_min(_DARK) ** (1 / scales)
        a, b = F.avg_pool2d(a, 2), F.avg_pool2d(b, 2)
    return found


# Losses of a clip by name.
LOSSES: dict[str, Callable[..., Tensor]] = {
    "smape": smape_loss,
    "l1_display": l1_display_loss,
    "rae": rae_loss,
    "oidn": oidn_loss,
}


def display_error(image: Tensor, reference: Tensor) -> Tensor:
    """Root mean square error of each gamma-mapped and clamped frame, from which PSNR is computed.

    ``sqrt(mean((g(x) - g(y))^2))`` with ``g(x) = (clamp(x, 0, 1) + c)^(1 / 2.2)``. SMAPE alone is minimal for the
    median, which misses a highlight that only few samples hit.

    Args:
        image: ``(..., 3, H, W)`` scene-linear radiance; 1 is the brightest value of a display.
        reference: the same shape.

    Returns:
        ``(...)``, one number per frame, differentiable also where both are equal or black, because of ``c = 0.001``.
    """
    shown, wanted = (each.clamp(0, 1).add(_DARK).pow(1 / 2.2) for each in (image, reference))
    return ((shown - wanted).square().mean((-3, -2, -1)) + _DARK**2).sqrt()


def stage_weights(asked: Mapping[str, float], output: Output) -> dict[str, float]:
    """The weight of each stage in the loss.

    Args:
        asked: weights by stage; if empty, those of the paper: 1 for the result and for the stage ``initial``, if the
            model has one.
        output: output of the model.

    Raises:
        InputError: the model has no such stage, a weight is negative, or all are zero.
    """
    known = (RESULT, *output.stages)
    weights = dict(asked) or {stage: 1.0 for stage in (RESULT, "initial") if stage in known}
    for stage, weight in weights.items():
        if stage not in known:
            raise InputError(f"losses: expected stages of the model ({', '.join(known)}), found '{stage}'")
        if not 0 <= weight < float("inf"):
            raise InputError(f"losses: expected weights of at least 0, found {weight} for '{stage}'")
    if not any(weights.values()):
        raise InputError("losses: expected one weight above 0 at least, found none")
    return weights
