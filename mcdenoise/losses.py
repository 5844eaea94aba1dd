"""The paper's training loss."""

from __future__ import annotations

import torch
from torch import Tensor

from mcdenoise.ops._check import check_shapes

EPSILON = 1e-2


def smape(result: Tensor, reference: Tensor, *, epsilon: float = EPSILON) -> Tensor:
    """Symmetric mean absolute percentage error, ``mean(|R - Y| / (|R| + |Y| + epsilon))``.

    Args:
        result: ``(B, C, H, W)`` or ``(B, T, C, H, W)`` scene-linear radiance R.
        reference: the reference Y, of the same shape.
        epsilon: keeps the quotient finite and black pixels unimportant; in the unit of the radiance.

    Returns:
        The mean over everything, a scalar in [0, 1].

    Raises:
        ValueError: the shapes differ.

    Source: the paper's Eq. 9.

    Example:
        >>> smape(torch.tensor([1.0]), torch.tensor([3.0]), epsilon=0.0).item()
        0.5
    """
    if result.shape != reference.shape:
        raise ValueError(f"reference: expected shape {tuple(result.shape)} as in result, found {tuple(reference.shape)}")
    return (torch.abs(result - reference) / (result.abs() + reference.abs() + epsilon)).mean()


def temporal_smape(result: Tensor, reference: Tensor, *, epsilon: float = EPSILON) -> Tensor:
    """SMAPE of the absolute differences between successive frames, which punishes flicker.

    Args:
        result: ``(B, T, C, H, W)`` scene-linear radiance.
        reference: of the same shape.
        epsilon: see :func:`smape`.

    Returns:
        A scalar in [0, 1]; 0 for a clip of one frame.

    Raises:
        ValueError: the shapes differ or are no clips.

    Source: the paper's Eq. 10 (differences are not motion-compensated).

    Example:
        >>> clip = torch.rand(1, 4, 3, 2, 2)
        >>> temporal_smape(clip + 1, clip).item() < 1e-4  # a constant error does not flicker
        True
    """
    check_shapes(result=(result, "B T C H W"), reference=(reference, "B T C H W"))
    if result.shape[1] < 2:
        return result.new_zeros(())
    return smape(result.diff(dim=1).abs(), reference.diff(dim=1).abs(), epsilon=epsilon)


def cascade_loss(initial: Tensor, final: Tensor, reference: Tensor, *, temporal_weight: float = 0.1) -> Tensor:
    """The total loss: spatial and temporal SMAPE of the initial and of the final image.

    ``L = L_s(R', Y) + L_s(R'', Y) + w_t (L_t(dR', dY) + L_t(dR'', dY))``

    Args:
        initial: ``(B, T, 3, H, W)`` R', scene-linear radiance with its albedo.
        final: R'' of the same shape.
        reference: Y of the same shape.
        temporal_weight: ``w_c = w_d`` of the paper, 0.1; 0 leaves the temporal loss out.

    Returns:
        A scalar.

    Source: the paper's Eq. 11, with ``w_a = w_b = 1``.
    """
    loss = smape(initial, reference) + smape(final, reference)
    if temporal_weight:
        loss = loss + temporal_weight * (temporal_smape(initial, reference) + temporal_smape(final, reference))
    return loss
