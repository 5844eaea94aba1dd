"""The training loss: errors of the images of a clip, by stage."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from mcdenoise.errors import InputError
from mcdenoise.metrics import smape_linear, temporal_smape_linear
from mcdenoise.models import Output

RESULT = "image"


def stage_loss(
    output: Output, reference: Tensor, weights: Mapping[str, float], *, temporal_weight: float = 0.1
) -> Tensor:
    """The total loss: spatial and temporal SMAPE of the image, and of stages on the way to it.

    ``L = sum_s w_s (L_s(R_s, Y) + w_t L_t(dR_s, dY))``; with weights of 1 for the result and the stage ``initial``,
    that is the paper's.

    Args:
        output: of a clip: images ``(B, T, 3, H, W)``, scene-linear radiance with its albedo.
        reference: Y of the same shape.
        weights: of the result, ``"image"``, and of stages by name; those without one do not count.
        temporal_weight: ``w_c = w_d`` of the paper, 0.1; 0 leaves the temporal loss out.

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
        loss = loss + weight * smape_linear(images[stage], reference).mean()
        if temporal_weight:
            flicker = temporal_smape_linear(images[stage], reference).mean()
            loss = loss + weight * temporal_weight * flicker
    return loss


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
