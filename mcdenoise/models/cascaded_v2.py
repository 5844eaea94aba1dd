"""The family ``cascaded_v2``: the cascaded pixel-kernel network with a history, logarithms and three resolutions.

It adds the following to the paper's network (:mod:`mcdenoise.models.cascaded`); measurements showed a benefit of each:

- the networks also see the current frame alone and one over the history length;
- the pixel network predicts the logarithm of the radiance as a residual, and takes means at coarser scales;
- scales are fused as logarithms, and no pixel becomes brighter than the brightest input pixel;
- the pixel network also denoises the image at half and at a quarter of its size (:class:`CoarseToFine`);
- detail of nearly clean frames, which the networks smooth, is given back (:class:`Restored`).

``cascaded_v2`` has the paper's width. ``cascaded_v2_small`` (widths 16 and 32, 0.41 of the multiply-adds) and
``cascaded_v2_tiny`` (width 16, 3x3 kernels, 0.18 of them) are the same network for slower processors, and the U-Nets of
``cascaded_v2_micro`` (0.08 of them) begin at half the resolution.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from mcdenoise.frame import Frame
from mcdenoise.models._entries import register_family
from mcdenoise.models._interface import Model, Needs, Output, State
from mcdenoise.models._layers import answered, carried
from mcdenoise.models.accumulated import Accumulated
from mcdenoise.models.chain import Chain
from mcdenoise.models.coarse_to_fine import CoarseToFine
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.models.restored import Restored
from mcdenoise.models.skipping import TOLERANCE, Skipping
from mcdenoise.models.tiled import Tiled
from mcdenoise.nn.fusion import LogFusion
from mcdenoise.nn.inputs import FEATURES, guides_of, image_statistics, input_of
from mcdenoise.nn.unet import Head, UNet
from mcdenoise.ops import cross_bilateral_filter, downsample
from mcdenoise.ops._backend import one_backend
from mcdenoise.ops._steps.network import softplus
from mcdenoise.ops.lag import THRESHOLD

SCALE_UNITS = (10.0, 1000.0, 1.0)  # of f1, f2, f3
_USES = frozenset({"albedo", "normal", "depth", "current", "length"})


class _Network(nn.Module):
    """Common base of both networks: a U-Net, heads at three scales, and their fusion."""

    def __init__(self, unet: UNet, channels: int, radius: int) -> None:
        super().__init__()
        self.unet = unet
        self.heads = nn.ModuleList(Head(unet, scale, channels) for scale in range(self.unet.scales))
        self.fusions: Sequence[LogFusion] = nn.ModuleList(  # type: ignore[assignment]
            LogFusion() for _ in range(self.unet.scales - 1)
        )
        # At each scale a pixel for head and fusion, and the filter's radius, beyond the U-Net.
        heads = (max(1 << scale, unet.stride) for scale in range(unet.scales))
        ways = (unet.reach(scale) + head + (radius << scale) for scale, head in enumerate(heads))
        reach = max(ways) + sum(1 << scale for scale in range(unet.scales - 1))
        self.needs = Needs(uses=_USES, reach=reach, stride=unet.multiple, live=unet.live)

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """Exposure, depth scale, and the logarithm of the brightest pixel of this network's own input."""
        found = image_statistics(frame)
        return found | {"maximum": torch.log1p(frame.color.amax((1, 2, 3), keepdim=True) * found["exposure"])}


class PixelNetwork(_Network):
    """P: predicts the image itself at three scales and fuses them, coarse to fine.

    In addition to the noisy pixels, the U-Net takes the logarithm of their means at each coarser scale. At one sample
    per pixel, most light of a dark surface is in few bright pixels. Their mean radiance is informative; the mean of
    their logarithms, or the maximum that pooling keeps, is not.

    Args:
        width: feature channels of the U-Net.
        half: whether the U-Net begins at half the resolution, with twice the width at all of its levels but the finest.
    """

    def __init__(self, width: int, half: bool = False) -> None:
        super().__init__(_unet(width, half, coarse_channels=3), 3, radius=0)
        for head in self.heads:
            nn.init.zeros_(head.weight)  # type: ignore[arg-type]
            nn.init.zeros_(head.bias)  # type: ignore[arg-type]

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        statistics = frame.statistics or self.statistics(frame)
        frame, exposure, maximum = frame.replace(statistics=statistics), statistics["exposure"], statistics["maximum"]
        image = frame.color * exposure
        logs = torch.log1p(image)
        means: list[Tensor] = []
        for _ in range(1, self.unet.stride):
            image = downsample(image)
        for _ in range(self.unet.levels - 1):
            image = downsample(image)
            means.append(torch.log1p(image))
        levels = self.unet(input_of(frame, logs, logarithms=False), means)
        # The heads predict a residual of the logarithm of the radiance: an untrained network is the identity, and
        # errors are relative, as in the loss.
        scales = [logs]
        for _ in levels[1:]:
            scales.append(downsample(scales[-1]))
        fused = _at_least_float32(self.heads[-1](levels[-1], scales[-1].shape[-2:])) + scales[-1]
        for scale in (1, 0):
            residual = self.heads[scale](levels[scale], scales[scale].shape[-2:])
            fused = self.fusions[1 - scale](scales[scale], fused, residual, None if scale else maximum)
        return Output(fused / exposure), None


class KernelNetwork(_Network):
    """K: predicts kernels at three scales, filters the image's pyramid with them, and fuses from coarse to fine.

    Each scale has ``K*K + 3`` channels: the kernel's logits and the falloffs f1 (normal), f2 (depth) and f3 (distance)
    of the paper's Eqs. 5-8. The falloffs are made non-negative by a softplus and scaled by ``SCALE_UNITS``, since
    normals and depths in [0, 1] differ by much less than pixel coordinates.

    Args:
        width: feature channels of the U-Net.
        kernel_size: K, 5 in the paper.
        half: see :class:`PixelNetwork`.
    """

    def __init__(self, width: int, kernel_size: int = 5, half: bool = False) -> None:
        taps = kernel_size * kernel_size
        super().__init__(_unet(width, half), taps + 3, radius=kernel_size // 2)
        self.taps = taps

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        statistics = frame.statistics or self.statistics(frame)
        frame, exposure, maximum = frame.replace(statistics=statistics), statistics["exposure"], statistics["maximum"]
        image = frame.color * exposure
        levels = self.unet(input_of(frame, image))
        guides, others = guides_of(frame), carried(frame)
        image = image if others is None else torch.cat([image, others], 1)
        scales: list[Tensor] = []
        # All scales share the statistics of the whole image, so that a tile is filtered as in the whole image.
        with one_backend(image):
            for head, level in zip(self.heads, levels, strict=True):
                prediction = head(level, image.shape[-2:])
                logits, rest = prediction[:, : self.taps], prediction[:, self.taps :]
                *falloffs, distance = softplus(rest, SCALE_UNITS).split(1, 1)
                # A mean of radiance preserves energy; a mean of logarithms would darken the image.
                scales.append(cross_bilateral_filter(image, logits, guides, falloffs, distance, border="renormalize"))
                if len(scales) < len(levels):
                    image, guides = downsample(image), [downsample(guide) for guide in guides]
        if others is not None:
            others = scales[-1][:, 3:]
        # Each scale is a weighted mean, but their fusion could leave the range of the input.
        fused = torch.log1p(scales[-1][:, :3])
        for scale, fusion in ((1, self.fusions[0]), (0, self.fusions[1])):
            fine = scales[scale][:, :3]
            if others is not None:
                others = fusion.mean(scales[scale][:, 3:], others, fusion.weight(torch.log1p(fine), fused))
            fused = fusion(fine, fused, None, None if scale else maximum, logarithms=True)
        return answered(frame, fused / exposure, others), None


def _unet(width: int, half: bool, coarse_channels: int = 0) -> UNet:
    if not half:
        return UNet(3 + FEATURES, [width] * 4, coarse_channels=coarse_channels)
    return UNet(3 + FEATURES, [width, 2 * width, 2 * width], coarse_channels=coarse_channels, half=True)


def _at_least_float32(tensor: Tensor) -> Tensor:
    """Convert half precision to float32; keep float64, in which tests run the shipped weights to measure rounding."""
    return tensor.to(torch.promote_types(tensor.dtype, torch.float32))


def both_networks(width: int, kernel_width: int | None, kernel_size: int, resolutions: int, half: bool) -> Chain:
    """Both networks, for demodulated radiance with or without a history; for the arguments see :func:`_cascade`."""
    return Chain(
        initial=CoarseToFine(Tiled(PixelNetwork(width, half)), resolutions),
        final=Tiled(KernelNetwork(kernel_width or width, kernel_size, half)),
    )


def with_history(networks: Model, alpha_min: float, anti_lag: bool, tolerance: float, restore: bool) -> Model:
    """The networks with all their wrappers; for the other arguments see :func:`_cascade`."""
    model = Demodulated(
        Accumulated(
            Skipping(networks, tolerance, alpha_min),
            alpha_min=alpha_min,
            lag_threshold=THRESHOLD if anti_lag else math.inf,
        )
    )
    return Restored(model) if restore else model


def _cascade(
    width: int = 40,
    kernel_width: int | None = None,
    kernel_size: int = 5,
    resolutions: int = 3,
    half: bool = False,
    *,
    alpha_min: float = 0.1,
    anti_lag: bool = True,
    tolerance: float = TOLERANCE,
    restore: bool = True,
) -> Model:
    """The cascade with all its wrappers.

    Args:
        width: feature channels of the pixel network.
        kernel_width: feature channels of the kernel network; ``width`` by default.
        kernel_size: K.
        resolutions: number of image sizes that the pixel network denoises; 1 in the paper.
        half: whether the U-Nets begin at half the resolution.
        alpha_min: see :class:`mcdenoise.models.Accumulated`.
        anti_lag: see :class:`mcdenoise.models.Accumulated`.
        tolerance: see :class:`mcdenoise.models.Skipping`.
        restore: whether :class:`mcdenoise.models.Restored` gives back detail.
    """
    networks = both_networks(width, kernel_width, kernel_size, resolutions, half)
    return with_history(networks, alpha_min, anti_lag, tolerance, restore)


register_family(
    _cascade,
    "P+K with history, logarithms, three resolutions",
    {
        "cascaded_v2": ("width 40, 5x5 kernels", {"width": 40}),
        "cascaded_v2_small": ("widths 16 and 32, 5x5 kernels", {"width": 16, "kernel_width": 32}),
        "cascaded_v2_tiny": ("width 16, 3x3 kernels", {"width": 16, "kernel_size": 3}),
        "cascaded_v2_micro": (
            "width 16, 3x3 kernels, half the resolution",
            {"width": 16, "kernel_size": 3, "half": True},
        ),
    },
    kind="kernel",
    paper="after DOI 10.1007/s00371-023-02951-6",
)
