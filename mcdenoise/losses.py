"""The paper's training loss."""

from __future__ import annotations

from torch import Tensor

from mcdenoise.metrics import smape_linear, temporal_smape_linear


def cascade_loss(initial: Tensor, final: Tensor, reference: Tensor, *, temporal_weight: float = 0.1) -> Tensor:
    """The total loss: spatial and temporal SMAPE of the initial and of the final image.

    ``L = L_s(R', Y) + L_s(R'', Y) + w_t (L_t(dR', dY) + L_t(dR'', dY))``

    Args:
        initial: ``(B, T, 3, H, W)`` R', scene-linear radiance with its albedo.
        final: R'' of the same shape.
        reference: Y of the same shape.
        temporal_weight: ``w_c = w_d`` of the paper, 0.1; 0 leaves the temporal loss out.

    Returns:
        A scalar, the mean over the batch.

    Raises:
        ValueError: the shapes differ, or the temporal loss is asked for clips of one frame.

    Differentiable in ``initial`` and ``final``.

    Source: the paper's Eqs. 9-11, with ``w_a = w_b = 1``.

    Example:
        >>> import torch
        >>> clip = torch.rand(2, 3, 3, 4, 4)
        >>> cascade_loss(clip, clip, clip).item()
        0.0
    """
    loss = smape_linear(initial, reference).mean() + smape_linear(final, reference).mean()
    if temporal_weight:
        flicker = temporal_smape_linear(initial, reference).mean() + temporal_smape_linear(final, reference).mean()
        loss = loss + temporal_weight * flicker
    return loss
