"""The training loss: errors of the images of a clip, by stage."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from torch import Tensor

from mcdenoise.errors import InputError
from mcdenoise.metrics import smape_linear, temporal_smape_linear
from mcdenoise.models import Output

SpatialLoss = Literal["smape", "l1_display"]

RESULT = "image"
_DARK = 1e-3


def stage_loss(
    output: Output,
    reference: Tensor,
    weights: Mapping[str, float],
    *,
    temporal_weight: float = 0.1,
    display_weight: float = 0.0,
    spatial_loss: SpatialLoss = "smape",
) -> Tensor:
    """The total loss: spatial and temporal SMAPE of the image, its error on a display, and those of stages before it.

    ``L = sum_s w_s (L_s(R_s, Y) + w_t L_t(dR_s, dY) + w_d L_d(R_s, Y))``; with weights of 1 for the result and the
    stage ``initial``, and without ``w_d``, that is the paper's.

    Args:
        output: of a clip: images ``(B, T, 3, H, W)``, scene-linear radiance with its albedo.
        reference: Y of the same shape.
        weights: of the result, ``"image"``, and of stages by name; those without one do not count.
        temporal_weight: ``w_t``, the paper's ``w_c = w_d``, 0.1; 0 leaves the temporal loss out.
        display_weight: ``w_d`` of :func:`display_error`; 0, as in the paper, leaves it out.
        spatial_loss: ``L_s``: SMAPE, as in the paper, or :func:`display_difference`.

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
    loss = reference.new_zeros(())
    for stage, weight in weights.items():
        spatial = smape_linear if spatial_loss == "smape" else display_difference
        loss = loss + weight * spatial(images[stage], reference).mean()
        if temporal_weight:
            flicker = temporal_smape_linear(images[stage], reference).mean()
            loss = loss + weight * temporal_weight * flicker
        if display_weight:
            loss = loss + weight * display_weight * display_error(images[stage], reference).mean()
    return loss


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


def display_difference(image: Tensor, reference: Tensor) -> Tensor:
    """Mean absolute difference of each frame on the curve of a display, which a bright pixel moves less than a dark.

    ``mean(|g(x) - g(y)|)`` with ``g(x) = (max(x, 0) + c)^(1 / 2.2)``: what Meng et al. 2020 train with (its ``c`` is
    0). Unlike :func:`display_error` it does not end where a display does.

    Args:
        image: ``(..., 3, H, W)`` scene-linear radiance.
        reference: of the same shape.

    Returns:
        ``(...)``, one number a frame, differentiable where both are not equal, also in black: ``c = 0.001``.
    """
    shown, wanted = (each.clamp_min(0).add(_DARK).pow(1 / 2.2) for each in (image, reference))
    return (shown - wanted).abs().mean((-3, -2, -1))


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
