"""The steps before and behind the networks of ``wild``, on Open Image Denoise's scale of radiance."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.ops._constants import BLOCK, MAX_RADIANCE, RECENT_ALPHA
from mcdenoise.ops._numbers import numbers_like
from mcdenoise.ops._op import op
from mcdenoise.ops._steps.transfer import compress, expand, seen_by_oidn
from mcdenoise.ops._window import corner, up_to_multiple
from mcdenoise.ops.demodulation import demodulate, remodulate


@op("numba")
def wild_figures(
    alone: Tensor,
    recent: Tensor,
    history: Tensor,
    albedo: Tensor | None,
    normal: Tensor | None,
    length: Tensor,
    exposure: Tensor,
) -> Tensor:
    """What blocks of 4x4 pixels of a frame and its history show; at the border its last pixels are repeated.

    Args:
        alone: ``(B, 3, H, W)`` radiance of the frame without its albedo.
        recent: ``(B, 3, H, W)`` likewise, of the recent history.
        history: ``(B, 3, H, W)`` likewise, of the whole history.
        albedo: ``(B, 3, H, W)``; ``None`` counts as one.
        normal: ``(B, 3, H, W)``; ``None`` counts as zero.
        length: ``(B, 1, H, W)`` number of frames in the whole history. Up to 1, both histories count as the frame.
        exposure: ``(B, 1, 1, 1)`` factor of radiance.

    Returns:
        ``(B, 19, ceil(H / 4), ceil(W / 4))``, in this order. Means of the frame, the recent and the whole history, each
        a mean of channels on the scale; of the albedo, likewise; and of the three channels of the normal. Means of the
        absolute differences of frame and whole history, recent and whole history, frame and recent history. Mean of
        ``1 - 1 / length``, the part that older frames have in the whole history. Mean radiance of the three images. The
        variances of the first four means, and the sum of those of the normal.
    """
    images = _exposed(alone, recent, history, albedo, length, exposure)
    images = [image.clamp_max(MAX_RADIANCE) for image in images]
    # In ONNX, bounds that are integers become tensors, which onnxscript loses if two steps clamp the same image.
    albedo = torch.ones_like(alone) if albedo is None else albedo.to(alone.dtype).clamp(0.0, 1.0)
    normal = torch.zeros_like(alone) if normal is None else normal.to(alone.dtype).clamp(-1.0, 1.0)
    light = torch.cat([image.mean(1, keepdim=True) for image in images], 1)
    shown = torch.cat([image.mean(1, keepdim=True) for image in (*map(compress, images), albedo)], 1)
    each = torch.cat([shown, normal, differences(shown), _part(length), light], 1)
    each = up_to_multiple(each, BLOCK, "replicate")
    means = F.avg_pool2d(each, BLOCK)
    # Not mean squares less squared means: in half precision nothing is left of them where a block is even.
    pixels = each[:, :7].unflatten(3, (-1, BLOCK)).unflatten(2, (-1, BLOCK))
    squares = (pixels - means[:, :7, :, None, :, None]).square().flatten(4).flatten(2, 3)
    variances, of_normal = F.avg_pool2d(squares, BLOCK).split([4, 3], 1)
    return torch.cat([means, variances, of_normal.sum(1, keepdim=True)], 1)


@op("numba")
def wild_input(
    alone: Tensor,
    recent: Tensor,
    history: Tensor,
    albedo: Tensor | None,
    normal: Tensor | None,
    length: Tensor,
    logits: Tensor,
    exposure: Tensor,
    multiple: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """The input of the network.

    Args:
        alone: ``(B, 3, H, W)`` radiance of the frame without its albedo.
        recent: ``(B, 3, H, W)`` likewise, of the recent history.
        history: ``(B, 3, H, W)`` likewise, of the whole history.
        albedo: ``(B, 3, H, W)``, is clamped to [0, 1]; ``None`` counts as one.
        normal: ``(B, 3, H, W)``, is clamped to [-1, 1]; ``None`` counts as zero.
        length: ``(B, 1, H, W)`` number of frames in the whole history. Up to 1, both histories count as the frame.
        logits: ``(B, 2, ceil(H / 4), ceil(W / 4))`` of the weight of the accumulated radiance beside the frame, and of
            the whole history in it, which is a mean of both histories.
        exposure: ``(B, 1, 1, 1)`` factor of radiance.
        multiple: height and width of the input are padded with zeros to multiples of this.

    Returns:
        ``(B, 16, H', W')`` the mean of frame and accumulated radiance on the scale, albedo, normal in [0, 1], the frame
        and the accumulated radiance on the scale, part; ``(B, 9, H, W)`` the three images of radiance on the scale; and
        ``(B, 1, H, W)`` part of the history in the accumulated radiance. The fast backend writes the input as a
        convolution takes it: channels-last, in the precision of autocast.
    """
    alone, recent, history = _exposed(alone, recent, history, albedo, length, exposure)
    weights = F.interpolate(logits, scale_factor=BLOCK, mode="bilinear", align_corners=False).sigmoid()
    trust, whole = corner(weights, *alone.shape[-2:]).split(1, 1)
    history = torch.lerp(recent, history, whole)
    part = torch.lerp(_part(length.clamp_max(1 / RECENT_ALPHA)), _part(length), whole)
    images = compress(torch.cat([torch.lerp(alone, history, trust), alone, history], 1))
    albedo = torch.ones_like(alone) if albedo is None else albedo
    normal = torch.zeros_like(alone) if normal is None else normal
    mean, others = images.split([3, 6], 1)
    seen = torch.cat([seen_by_oidn(mean, albedo, normal), others, part], 1)
    return up_to_multiple(seen, multiple), images, part


@op("numba")
def wild_choice(
    predicted: Tensor,
    images: Tensor,
    part: Tensor,
    albedo: Tensor | None,
    exposure: Tensor,
    offsets: Sequence[float],
    pace: float,
) -> Tensor:
    """The weighted mean of four images, see :class:`mcdenoise.models.wild.WildNetwork` for its equation.

    Args:
        predicted: ``(B, 7, H, W)`` the network's own image on the scale, and four numbers for the logits.
        images: ``(B, 9, H, W)`` mean, frame and accumulated radiance on the scale, see :func:`wild_input`.
        part: ``(B, 1, H, W)`` part of the history in the accumulated radiance.
        albedo: ``(B, 3, H, W)`` that the radiance is divided by; ``None`` counts as one.
        exposure: ``(B, 1, 1, 1)`` factor of radiance.
        offsets: of the logits, which are ``offsets + pace * numbers``.
        pace: factor of the numbers.

    Returns:
        ``(B, 3, H, W)`` radiance without its albedo.
    """
    own, logits = predicted.split([3, 4], 1)
    mean, alone, history = images.split(3, 1)
    logits = pace * logits + numbers_like(logits, offsets).reshape(1, -1, 1, 1)
    share = torch.cat([torch.ones_like(part), part, part, torch.ones_like(part)], 1)
    # The largest logit of a choice that counts: beside a larger one all weights might be 0.
    most = torch.where(share > 0, logits, -torch.inf).amax(1, keepdim=True).detach()
    weights = share * torch.where(share > 0, logits - most, 0).exp()
    choices = torch.stack([own.clamp_min(0), alone, history, mean], 1)
    mixed = (weights[:, :, None] * choices).sum(1) / weights.sum(1, keepdim=True)
    image = expand(mixed) / exposure
    return image if albedo is None else demodulate(image, albedo)


def differences(images: Tensor) -> Tensor:
    """How far frame, recent and whole history, which come first of ``(B, 3 or more, H, W)``, differ: three images."""
    alone, recent, history, *_ = images.split(1, 1)
    return torch.cat([alone - history, recent - history, alone - recent], 1).abs()


def _exposed(
    alone: Tensor, recent: Tensor, history: Tensor, albedo: Tensor | None, length: Tensor, exposure: Tensor
) -> list[Tensor]:
    """The radiance of the three images with the albedo, times the exposure."""
    images = [alone, *(torch.where(length > 1, image, alone) for image in (recent, history))]
    return [exposure * (image if albedo is None else remodulate(image, albedo)) for image in images]


def _part(length: Tensor) -> Tensor:
    """The part of all frames but the last one."""
    return 1 - 1 / length.clamp_min(1)
