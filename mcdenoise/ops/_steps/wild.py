"""The steps before and behind the network of ``wild``, on Open Image Denoise's scale of radiance."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from mcdenoise.ops._numbers import numbers_like
from mcdenoise.ops._op import op
from mcdenoise.ops._steps.transfer import compress, expand, seen_by_oidn
from mcdenoise.ops._window import up_to_multiple


@op("numba")
def wild_input(
    color: Tensor,
    alone: Tensor,
    history: Tensor,
    albedo: Tensor | None,
    normal: Tensor | None,
    part: Tensor,
    exposure: Tensor,
    multiple: int,
) -> tuple[Tensor, Tensor]:
    """The input of the network.

    Args:
        color: ``(B, 3, H, W)`` radiance, a mean of the frame and its history.
        alone: ``(B, 3, H, W)`` radiance of the frame.
        history: ``(B, 3, H, W)`` accumulated radiance.
        albedo: ``(B, 3, H, W)``, is clamped to [0, 1]; ``None`` counts as one.
        normal: ``(B, 3, H, W)``, is clamped to [-1, 1]; ``None`` counts as zero.
        part: ``(B, 1, H, W)`` part of the history in the accumulated radiance.
        exposure: ``(B, 1, 1, 1)`` factor of radiance.
        multiple: height and width of the input are padded with zeros to multiples of this.

    Returns:
        ``(B, 16, H', W')`` the mean on the scale, albedo, normal in [0, 1], the frame and the accumulated radiance on
        the scale, part; and ``(B, 9, H, W)`` the three images of radiance on the scale. The fast backend writes the
        input as a convolution takes it: channels-last, in the precision of autocast.
    """
    images = compress(torch.cat([color, alone, history], 1) * exposure)
    albedo = torch.ones_like(color) if albedo is None else albedo
    normal = torch.zeros_like(color) if normal is None else normal
    mean, others = images.split([3, 6], 1)
    seen = torch.cat([seen_by_oidn(mean, albedo, normal), others, part], 1)
    return up_to_multiple(seen, multiple), images


@op("numba")
def wild_choice(predicted: Tensor, images: Tensor, part: Tensor, exposure: Tensor, offsets: Sequence[float]) -> Tensor:
    """The weighted mean of four images, see :class:`mcdenoise.models.wild.WildNetwork` for its equation.

    Args:
        predicted: ``(B, 7, H, W)`` the network's own image on the scale, and four logits.
        images: ``(B, 9, H, W)`` mean, frame and accumulated radiance on the scale, see :func:`wild_input`.
        part: ``(B, 1, H, W)`` part of the history in the accumulated radiance.
        exposure: ``(B, 1, 1, 1)`` factor of radiance.
        offsets: added to the logits.

    Returns:
        ``(B, 3, H, W)`` radiance.
    """
    own, logits = predicted.split([3, 4], 1)
    mean, alone, history = images.split(3, 1)
    logits = logits + numbers_like(logits, offsets).reshape(1, -1, 1, 1)
    share = torch.cat([torch.ones_like(part), part, part, torch.ones_like(part)], 1)
    # The largest logit of a choice that counts: beside a larger one all weights might be 0.
    most = torch.where(share > 0, logits, -torch.inf).amax(1, keepdim=True).detach()
    weights = share * torch.where(share > 0, logits - most, 0).exp()
    choices = torch.stack([own.clamp_min(0), alone, history, mean], 1)
    mixed = (weights[:, :, None] * choices).sum(1) / weights.sum(1, keepdim=True)
    return expand(mixed) / exposure
