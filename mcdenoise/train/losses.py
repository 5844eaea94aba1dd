"""The training loss: errors of the images of a clip, by stage."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal

import torch
from torch import Tensor

from mcdenoise.errors import InputError
from mcdenoise.metrics import smape_linear, temporal_smape_linear
from mcdenoise.models import Output

Loss = Literal["smape", "l1_display", "rae"]

RESULT = "image"
_DARK = 1e-3


def stage_loss(
    output: Output,
    reference: Tensor,
    weights: Mapping[str, float],
    *,
    loss: Loss = "smape",
    temporal_weight: float = 0.1,
    display_weight: float = 0.0,
) -> Tensor:
    """The total loss: errors in space and time of the image, its error on a display, and those of stages before it.

    ``L = sum_s w_s (L_c(R_s, Y) + w_d L_d(R_s, Y))`` with the loss ``L_c`` of a clip; with ``L_c`` of
    :func:`smape_loss`, weights of 1 for the result and the stage ``initial``, and without ``w_d``, that is the paper's.

    Args:
        output: of a clip: images ``(B, T, 3, H, W)``, scene-linear radiance with its albedo.
        reference: Y of the same shape.
        weights: of the result, ``"image"``, and of stages by name; those without one do not count.
        loss: a name in :data:`LOSSES`: ``"smape"``, :func:`smape_loss`; ``"l1_display"``, :func:`l1_display_loss`; or
            ``"rae"``, :func:`rae_loss`.
        temporal_weight: ``w_t`` of these, the paper's ``w_c = w_d``, 0.1; 0 leaves the temporal loss out.
        display_weight: ``w_d`` of :func:`display_error`; 0, as in the paper, leaves it out.

    Returns:
        A scalar, the mean over the batch.

    Raises:
        ValueError: the shapes differ, or the temporal loss is asked for clips of one frame.

    Differentiable in all images.

    Source: the paper's Eqs. 9-11, with ``w_a = w_b = 1``.

    Example:
        >>> import torch
        >>> clip = torch.rand(2, 3, 3, 4, 4)
        >>> stage_loss(Output(clip, {"initial": clip}), clip, {"image": 1, "initial": 1}).item()
        0.0
    """
    images = {RESULT: output.image, **output.stages}
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
        reference: Y of the same shape.
        temporal_weight: ``w_t``; 0 leaves the temporal loss out.

    Returns:
        A scalar, the mean over the batch.

    Raises:
        ValueError: the shapes differ, or the temporal loss is asked for clips of one frame.
    """
    spatial = smape_linear(image, reference).mean()
    return spatial + temporal_weight * temporal_smape_linear(image, reference).mean() if temporal_weight else spatial


def l1_display_loss(image: Tensor, reference: Tensor, *, temporal_weight: float = 0.1) -> Tensor:
    """Mean absolute difference on the curve of a display, which a bright pixel moves less than a dark one.

    ``L = mean |g(R) - g(Y)| + w_t L_t(dR, dY)`` with ``g(x) = (max(x, 0) + c)^(1 / 2.2)`` and ``c = 0.001``. What Meng
    et al. 2020 train with has no ``c`` and no ``L_t``. Unlike :func:`display_error` it does not end where displays do.

    Args:
        image: R, ``(B, T, 3, H, W)`` scene-linear radiance.
        reference: Y of the same shape.
        temporal_weight: ``w_t`` of the temporal SMAPE; 0 leaves it out.

    Returns:
        A scalar, the mean over the batch, differentiable where both are not equal, also in black.

    Raises:
        ValueError: the shapes differ, or the temporal loss is asked for clips of one frame.
    """
    if image.shape != reference.shape:
        raise ValueError(f"image: expected shape {tuple(reference.shape)} as reference, found {tuple(image.shape)}")
    shown, wanted = (each.clamp_min(0).add(_DARK).pow(1 / 2.2) for each in (image, reference))
    spatial = (shown - wanted).abs().mean()
    return spatial + temporal_weight * temporal_smape_linear(image, reference).mean() if temporal_weight else spatial


def rae_loss(image: Tensor, reference: Tensor, *, temporal_weight: float = 0.1) -> Tensor:
    """L1 in space, of gradients and in time, which counts the more the later in a clip a frame is.

    ``L = sum_t g_t (0.8 L_s + 0.1 L_g + w_t L_t) / sum_t g_t``, with ``P = log(1 + R)`` and ``T = log(1 + Y)``:

    - ``L_s = mean |P - T|``,
    - ``L_g = mean |dP - dT|`` over the differences between neighbours along x, and along y, the mean of both,
    - ``L_t = mean |(P_t - P_{t-1}) - (T_t - T_{t-1})|``, 0 of the first frame,
    - ``g_t = exp(-(n - t)^2 / 8)`` of frame t of n: of 7 frames 0.011, 0.044, 0.135, 0.325, 0.607, 0.882, 1, so that a
      hidden state has time to fill.

    Its terms and their weights are those of the paper. The logarithms, the differences of neighbours as the gradient,
    and the division by the sum of the weights, which makes clips of any length alike, are what is taken here.

    Args:
        image: R, ``(B, T, 3, H, W)`` scene-linear radiance, not negative.
        reference: Y of the same shape.
        temporal_weight: ``w_t``.

    Returns:
        A scalar, the mean over the batch.

    Raises:
        ValueError: the shapes differ.

    Differentiable in both images where nothing is equal.

    Source: Chaitanya et al. 2017, the equations of the spatial, gradient and temporal loss. The weights of the frames
    are a Gaussian with a deviation of 2 frames, which gives the seven numbers of the paper.

    Example:
        >>> clip = torch.full((1, 7, 3, 4, 4), 0.5)
        >>> round(rae_loss(torch.zeros_like(clip), clip).item(), 4)  # 0.8 log(1.5)
        0.3244
    """
    if image.shape != reference.shape:
        raise ValueError(f"image: expected shape {tuple(reference.shape)} as reference, found {tuple(image.shape)}")
    error = torch.log1p(image) - torch.log1p(reference)
    frames = error.shape[1]
    counts = torch.exp(-torch.arange(frames - 1, -1, -1, device=error.device).to(error.dtype).square() / 8)
    each = 0.8 * _by_frame(error)
    # A row or a column of one pixel has no neighbours.
    for dim in (-1, -2):
        if error.shape[dim] > 1:
            each = each + 0.05 * _by_frame(error.diff(dim=dim))
    # The difference of differences is that of the errors.
    change = torch.cat([torch.zeros_like(error[:, :1]), error.diff(dim=1)], 1)
    each = each + temporal_weight * _by_frame(change)
    return (each * counts).sum(1).mean() / counts.sum()


def _by_frame(error: Tensor) -> Tensor:
    """``(B, T)``: mean absolute error of each frame."""
    return error.abs().mean((-3, -2, -1))


# Of a clip, by name.
LOSSES: dict[str, Callable[..., Tensor]] = {"smape": smape_loss, "l1_display": l1_display_loss, "rae": rae_loss}


def display_error(image: Tensor, reference: Tensor) -> Tensor:
    """Root mean square error of each frame as a display shows it, which is what PSNR is the logarithm of.

    ``sqrt(mean((g(x) - g(y))^2))`` with ``g(x) = (clamp(x, 0, 1) + c)^(1 / 2.2)``. SMAPE alone is content with a
    median: a highlight of which most samples know nothing is left out.

    Args:
        image: ``(..., 3, H, W)`` scene-linear radiance, 1 is the brightest that a display shows.
        reference: of the same shape.

    Returns:
        ``(...)``, one number a frame, differentiable also where both are equal, or black: ``c = 0.001``.
    """
    shown, wanted = (each.clamp(0, 1).add(_DARK).pow(1 / 2.2) for each in (image, reference))
    return ((shown - wanted).square().mean((-3, -2, -1)) + _DARK**2).sqrt()


def stage_weights(asked: Mapping[str, float], output: Output) -> dict[str, float]:
    """The weight of each stage in the loss.

    Args:
        asked: weights by stage; without any, those of the paper: 1 for the result and for the stage ``initial``, where
            the model has one.
        output: of the model.

    Raises:
        InputError: the model has no such stage, or a weight is negative or all are zero.
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
