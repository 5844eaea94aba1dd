"""The steps before and behind the network of ``oidn_tuned``, on Open Image Denoise's scale of radiance."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from mcdenoise.ops._numbers import numbers_like
from mcdenoise.ops._op import op
from mcdenoise.ops._steps.transfer import compress, expand, seen_by_oidn
from mcdenoise.ops._window import up_to_multiple


@op("numba")
def tuned_input(
    color: Tensor,
    before: Tensor,
    light: Tensor,
    albedo: Tensor | None,
    normal: Tensor | None,
    valid: Tensor,
    exposure: Tensor,
    multiple: int,
) -> tuple[Tensor, Tensor]:
    """The input of the network.

    Args:
        color: ``(B, 3, H, W)`` noisy radiance.
        before: ``(B, 3, H, W)`` previous result.
        light: ``(B, 3, H, W)`` likewise, in the other form of :class:`mcdenoise.models.Recurrent`.
        albedo: ``(B, 3, H, W)``, is clamped to [0, 1]; ``None`` counts as one.
        normal: ``(B, 3, H, W)``, is clamped to [-1, 1]; ``None`` counts as zero.
        valid: ``(B, 1, H, W)`` weight of the previous result.
        exposure: ``(B, 1, 1, 1)`` factor of radiance.
        multiple: height and width of the input are padded with zeros to multiples of this.

    Returns:
        ``(B, 16, H', W')`` noisy radiance on the scale, albedo, normal in [0, 1], previous results on the scale, valid;
        and ``(B, 9, H, W)`` the three images of radiance on the scale. The fast backend writes the input as a
        convolution takes it: channels-last, in the precision of autocast.
    """
    images = compress(torch.cat([color, before, light], 1) * exposure)
    albedo = torch.ones_like(color) if albedo is None else albedo
    normal = torch.zeros_like(color) if normal is None else normal
    noisy, previous = images.split([3, 6], 1)
    seen = torch.cat([seen_by_oidn(noisy, albedo, normal), previous, valid], 1)
    return up_to_multiple(seen, multiple), images


@op("numba")
def tuned_choice(
    predicted: Tensor, images: Tensor, valid: Tensor, exposure: Tensor, offsets: Sequence[float]
) -> Tensor:
    """The weighted mean of four images, see :class:`mcdenoise.models.oidn_tuned.TunedNetwork` for its equation.

    Args:
        predicted: ``(B, 7, H, W)`` the network's own image on the scale, and four logits.
        images: ``(B, 9, H, W)`` noisy image and previous results on the scale, see :func:`tuned_input`.
        valid: ``(B, 1, H, W)`` weight of the previous results.
        exposure: ``(B, 1, 1, 1)`` factor of radiance.
        offsets: added to the logits.

    Returns:
        ``(B, 3, H, W)`` radiance.
    """
    own, logits = predicted.split([3, 4], 1)
    noisy, before, light = images.split(3, 1)
    logits = logits + numbers_like(logits, offsets).reshape(1, -1, 1, 1)
    share = torch.cat([torch.ones_like(valid), valid, valid, torch.ones_like(valid)], 1)
    # The largest logit of a choice that counts: beside a larger one all weights might be 0.
    most = torch.where(share > 0, logits, -torch.inf).amax(1, keepdim=True).detach()
    weights = share * (logits - most).clamp_max(0).exp()
    choices = torch.stack([own.clamp_min(0), before, light, noisy], 1)
    mixed = (weights[:, :, None] * choices).sum(1) / weights.sum(1, keepdim=True)
    return expand(mixed) / exposure
