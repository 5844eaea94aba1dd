"""The paper's training loss, and one of local means beside it."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from mcdenoise.metrics import smape_linear, temporal_smape_linear

# Side of the blocks whose means are compared, pixels.
_BLOCK = 16


def cascade_loss(
    initial: Tensor, final: Tensor, reference: Tensor, *, temporal_weight: float = 0.1, mean_weight: float = 0.0
) -> Tensor:
    """The total loss: spatial and temporal SMAPE of the initial and of the final image.

    ``L = L_s(R', Y) + L_s(R'', Y) + w_t (L_t(dR', dY) + L_t(dR'', dY)) + w_m (L_s(M R', M Y) + L_s(M R'', M Y))``

    ``M`` takes means of blocks of 16x16 pixels. Of a pixel about which the noisy image says little, the other terms ask
    for the median of what it may be, which is darker than the mean where light is sparse; of a block far more is known.

    Args:
        initial: ``(B, T, 3, H, W)`` R', scene-linear radiance with its albedo.
        final: R'' of the same shape.
        reference: Y of the same shape.
        temporal_weight: ``w_c = w_d`` of the paper, 0.1; 0 leaves the temporal loss out.
        mean_weight: ``w_m``; 0, as in the paper, leaves the loss of the means out.

    Returns:
        A scalar, the mean over the batch.

    Raises:
        ValueError: the shapes differ, or the temporal loss is asked for clips of one frame.

    Differentiable in ``initial`` and ``final``.

    Source: the paper's Eqs. 9-11, with ``w_a = w_b = 1``; the last term is ours.

    Example:
        >>> import torch
        >>> clip = torch.rand(2, 3, 3, 4, 4)
        >>> cascade_loss(clip, clip, clip).item()
        0.0
    """
    loss: Tensor = smape_linear(initial, reference).mean() + smape_linear(final, reference).mean()
    if temporal_weight:
        flicker = temporal_smape_linear(initial, reference).mean() + temporal_smape_linear(final, reference).mean()
        loss = loss + temporal_weight * flicker
    if mean_weight:
        first, second, truth = (_means(image) for image in (initial, final, reference))
        loss = loss + mean_weight * (smape_linear(first, truth).mean() + smape_linear(second, truth).mean())
    return loss


def _means(clip: Tensor) -> Tensor:
    """Of blocks of pixels, those at the edge of what there is of them."""
    blocks = F.avg_pool2d(clip.flatten(0, 1), _BLOCK, ceil_mode=True, count_include_pad=False)
    means: Tensor = blocks.unflatten(0, clip.shape[:2])
    return means
