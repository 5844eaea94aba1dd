"""The training loss: errors of the images of a clip, by stage."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

from mcdenoise.metrics import smape_linear, temporal_smape_linear
from mcdenoise.metrics.metric import check_images
from mcdenoise.models import Output

Loss = Literal["smape", "l1_display", "rae"]

RESULT = "image"
# The images that are in the loss, if a model has them.
_STAGES = (RESULT, "initial")
_DARK = 1e-3


def seen_stages(output: Output) -> dict[str, Tensor]:
    """The images of an output that are in the loss: the result, and the stage ``initial``, if the model has one."""
    images = {RESULT: output.image, **output.stages}
    return {stage: images[stage] for stage in _STAGES if stage in images}


def stage_loss(
    output: Output,
    reference: Tensor,
    *,
    loss: Loss = "smape",
    temporal_weight: float = 0.1,
    display_weight: float = 0.0,
) -> Tensor:
    """The total loss: for the image and for an intermediate one, errors in space and time, and errors on a display.

    ``L = sum_s (L_c(R_s, Y) + w_d L_d(R_s, Y))`` over the result and the stage ``initial``, if there is one. The loss
    ``L_c`` of a clip is one of these, with the temporal SMAPE ``L_t``:

    - ``"smape"``, with ``w_d = 0`` the paper's: ``SMAPE(R, Y) + w_t L_t``;
    - ``"l1_display"``: ``mean |g(R) - g(Y)| + w_t L_t`` with ``g(x) = (max(x, 0) + 0.001)^(1 / 2.2) + min(x, 0)``,
      which gives bright pixels less weight than dark ones, and unlike :func:`display_error` has no upper limit. Meng
      et al. 2020 train without the 0.001, negative light and ``L_t``;
    - ``"rae"``: :func:`rae_loss`.

    Args:
        output: output for a clip: images ``(B, T, 3, H, W)``, scene-linear radiance including albedo.
        reference: Y, the same shape, or that of its last frames only, which are then the clip.
        loss: the name of ``L_c``.
        temporal_weight: ``w_t``, the paper's ``w_c = w_d``, 0.1; 0 disables the temporal loss.
        display_weight: ``w_d`` of :func:`display_error`; 0, as in the paper, disables it.

    Returns:
        A scalar, the mean over the batch.

    Raises:
        ValueError: the shapes differ, or a temporal loss is requested for clips of one frame.

    Differentiable in all images; ``"l1_display"`` where they differ, also in black and below.

    Source: the paper's Eqs. 9-11, with ``w_a = w_b = 1``.

    Example:
        >>> import torch
        >>> clip = torch.rand(2, 3, 3, 4, 4)
        >>> stage_loss(Output(clip, {"initial": clip}), clip).item()
        0.0
    """
    total = reference.new_zeros(())
    for image in seen_stages(output).values():
        clip = image[:, -reference.shape[1] :]
        total = total + LOSSES[loss](clip, reference, temporal_weight)
        if display_weight:
            total = total + display_weight * display_error(clip, reference).mean()
    return total


def _smape(image: Tensor, reference: Tensor, temporal_weight: float) -> Tensor:
    return smape_linear(image, reference).mean() + _of_changes(image, reference, temporal_weight)


def _l1_display(image: Tensor, reference: Tensor, temporal_weight: float) -> Tensor:
    check_images(image, reference)
    return (_shown(image) - _shown(reference)).abs().mean() + _of_changes(image, reference, temporal_weight)


def _of_changes(image: Tensor, reference: Tensor, weight: float) -> Tensor | float:
    """``w_t L_t``, of clips of several frames, unless the weight is 0."""
    return weight * temporal_smape_linear(image, reference).mean() if weight else 0.0


def _shown(image: Tensor) -> Tensor:
    # A network without a last activation begins with negative light, which must have a derivative.
    return image.clamp_min(0).add(_DARK).pow(1 / 2.2) + torch.where(image < 0, image, 0)


def rae_loss(image: Tensor, reference: Tensor, temporal_weight: float = 0.1) -> Tensor:
    """L1 of values, of gradients and of temporal differences, with larger weights for later frames of a clip.

    ``L = sum_t g_t (0.8 L_s + 0.1 L_g + w_t L_t) / sum_t g_t``, with ``P = log(1 + R)`` (R where that is negative) and
    ``T = log(1 + Y)``:

    - ``L_s = mean |P - T|``,
    - ``L_g = mean |dP - dT|`` over the differences between neighbours along x, and along y, the mean of both,
    - ``L_t = mean |(P_t - P_{t-1}) - (T_t - T_{t-1})|``, 0 for the first frame,
    - ``g_t = exp(-(n - t)^2 / 8)`` for frame t of n: for 7 frames 0.011, 0.044, 0.135, 0.325, 0.607, 0.882, 1, which
      gives a hidden state time to adapt.

    The terms and their weights are those of the paper. Our choices are the logarithms, differences of neighbours as
    gradients, and the division by the sum of the weights, which makes the loss independent of the clip's length.

    Args:
        image: R, ``(B, T, 3, H, W)`` scene-linear radiance.
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
    error = _compressed(image) - _compressed(reference)
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


def _compressed(image: Tensor) -> Tensor:
    # A network without a last activation begins with negative light, whose logarithm may be none.
    return torch.where(image < 0, image, torch.log1p(image.clamp_min(0)))


def _by_frame(error: Tensor) -> Tensor:
    """``(B, T)``: mean absolute error of each frame."""
    return error.abs().mean((-3, -2, -1))


# Losses of a clip by name.
LOSSES: dict[str, Callable[[Tensor, Tensor, float], Tensor]] = {
    "smape": _smape,
    "l1_display": _l1_display,
    "rae": rae_loss,
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
