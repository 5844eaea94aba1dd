"""What methods with a pyramid of light have in common: a U-Net, a head at each scale, and light split into scales.

Each scale keeps a part of the light and hands on the rest; on the way up, each is filtered with its own kernels,
together with what comes from the coarser ones. As in Balint et al. 2023, "Neural Partitioning Pyramids for Denoising
Monte Carlo Renderings", Sec. 4.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, TypeAlias

import torch
from torch import Tensor, nn

from mcdenoise.frame import Frame
from mcdenoise.models._interface import Needs
from mcdenoise.nn.inputs import image_statistics
from mcdenoise.nn.unet import Head, UNet
from mcdenoise.ops import downsample, upsample
from mcdenoise.ops._backend import one_backend

# Filters what a scale has, with what was predicted there; the last is the number of the scale.
Filter: TypeAlias = Callable[[Tensor, Tensor, int], Tensor]

_LEAST = 1e-3  # of the light of a pixel that a scale keeps or hands on, and that a pixel is worth


class Pyramid(nn.Module):
    """Predicts for each scale a kernel, what it keeps, and what it takes of the coarser one; and more at the finest.

    Args:
        unet: which hands out features of every scale.
        taps: of a kernel.
        parts: what is predicted beside it at the finest scale: names, and of each channel what it is before anything
            was learnt.
        falloffs: channels that are predicted behind each kernel.
        spread: standard deviation of the heads' first weights.
    """

    uses: ClassVar[frozenset[str]]

    def __init__(
        self, unet: UNet, taps: int, parts: Mapping[str, Sequence[float]], *, falloffs: int = 0, spread: float = 0.0
    ) -> None:
        super().__init__()
        self.unet, self.taps = unet, taps
        self.parts = {name: len(values) for name, values in parts.items()}
        self.channels = [taps + falloffs + 2] * (unet.scales - 1) + [taps + falloffs]
        at_rest = torch.tensor([value for values in parts.values() for value in values])
        counts = [self.channels[0] + len(at_rest), *self.channels[1:]]
        heads = [Head(unet, scale, count) for scale, count in enumerate(counts)]
        for head in heads:
            nn.init.normal_(head.weight, std=spread)
            nn.init.zeros_(head.bias)  # type: ignore[arg-type]
        # A head of half the resolution predicts each channel for two by two pixels.
        pixels = heads[0].side ** 2
        with torch.no_grad():
            heads[0].bias[self.channels[0] * pixels :] = at_rest.repeat_interleave(pixels)  # type: ignore[index]
        self.heads = nn.ModuleList(heads)

    @property
    def needs(self) -> Needs:
        """What the U-Net sees, and the radius of each filter at its scale behind it."""
        radius, scales = math.isqrt(self.taps) // 2, range(self.unet.scales)
        behind = sum((radius + 1) << scale for scale in scales)
        ways = (self.unet.reach(scale) + max(1 << scale, self.unet.stride) for scale in scales)
        return Needs(uses=self.uses, reach=max(ways) + behind, stride=self.unet.multiple)

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """Exposure and depth scale of the whole image."""
        return image_statistics(frame)

    def bytes_per_pixel(self, *, bfloat16: bool) -> float:
        """Memory that a tile takes, see :class:`mcdenoise.models.Tiled`."""
        return self.unet.bytes_per_pixel(bfloat16=bfloat16)

    def predict(
        self, seen: Tensor, coarse: Sequence[Tensor], dtype: torch.dtype
    ) -> tuple[list[Tensor], dict[str, Tensor]]:
        """What is predicted at each scale, and the parts of the finest by their names, at least in float32.

        Args:
            seen: ``(B, C, H, W)`` that the U-Net is given.
            coarse: what it is given at coarser scales.
            dtype: of the image.
        """
        levels = self.unet(seen, coarse)
        height, width = seen.shape[-2:]
        predicted = [
            head(level, (-(-height // (1 << scale)), -(-width // (1 << scale)))).to(
                torch.promote_types(dtype, torch.float32)
            )
            for scale, (head, level) in enumerate(zip(self.heads, levels, strict=True))
        ]
        split = predicted[0][:, self.channels[0] :].split(list(self.parts.values()), 1)
        predicted[0] = predicted[0][:, : self.channels[0]]
        return predicted, dict(zip(self.parts, split, strict=True))


def filtered(light: Tensor, predicted: Sequence[Tensor], filter_scale: Filter) -> Tensor:
    """Down: each scale keeps a part. Up: it is filtered together with what comes from the coarser scales.

    Args:
        light: ``(B, C, H, W)``.
        predicted: of each scale, finest first; the last two channels of all but the coarsest are the logits of what it
            keeps, and of what it takes of the coarser one.
        filter_scale: see :data:`Filter`.
    """
    kept: list[Tensor] = []
    for prediction in predicted[:-1]:
        kept.append(inside(prediction[:, -2:-1]) * light)
        light = downsample(light - kept[-1])
    # One for all scales: a tile of an image must not be filtered otherwise than the whole.
    with one_backend(light):
        for scale in reversed(range(len(predicted))):
            prediction = predicted[scale]
            if scale < len(kept):
                size = (kept[scale].shape[-2], kept[scale].shape[-1])
                light = kept[scale] + torch.sigmoid(prediction[:, -1:]) * upsample(light, size)
            light = filter_scale(light, prediction, scale)
    return light


def inside(logit: Tensor) -> Tensor:
    """A fraction in [_LEAST, 1 - _LEAST]: nothing is ever lost altogether, and no mean is 0 / 0."""
    return _LEAST + (1 - 2 * _LEAST) * torch.sigmoid(logit)
