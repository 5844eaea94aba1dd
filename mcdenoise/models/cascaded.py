"""The paper's cascaded pixel-kernel network: a pixel network, and a kernel network that filters its prediction.

The paper is doi:10.1007/s00371-023-02951-6; equation numbers refer to it. It leaves some details open; the choices are:

- the fusion module's layers: one 3x3 convolution of both scales and a sigmoid (:class:`mcdenoise.nn.FusionModule`);
- the normalization of kernels: ``softmax(logits - f1 |dn|^2 - f2 dd^2 - f3 r^2)``, which is Eq. 5 for unnormalised
  weights divided by their sum; ``normalize="none"`` is Eq. 5 exactly;
- f1, f2, f3 >= 0: a softplus;
- the unit of radiance: typical radiance is scaled to 0.5 (:class:`mcdenoise.models.Exposed`);
- depth in [0, 1]: ``d / (d + typical depth)``;
- accumulation (its Appendix 1): that of Koskela et al. 2019 with alpha 0.2, on demodulated radiance, with limits of the
  consistency test that are relative to the depth (:func:`mcdenoise.models._published.as_published`);
- negative radiance, which Eq. 2 allows: the result is clamped at 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mcdenoise.errors import check_choice
from mcdenoise.frame import Frame
from mcdenoise.models._interface import GUIDES, Model, Needs, Output, State
from mcdenoise.models._layers import answered, with_carried
from mcdenoise.models._published import Network, published
from mcdenoise.models._registry import register_model
from mcdenoise.models._wrapper import Wrapper
from mcdenoise.models.chain import Chain
from mcdenoise.models.tiled import Tiled
from mcdenoise.nn.fusion import FusionModule
from mcdenoise.nn.inputs import unit_features_of
from mcdenoise.nn.unet import UNet
from mcdenoise.ops import cross_bilateral_filter, downsample

Normalize = Literal["softmax", "none"]
Cascade = Literal["P", "K", "P+K", "K+P", "K+K"]

LEVELS = 4  # of the U-Net


class _Scales(Network):
    """The U-Net of Fig. 2, with a head and a fusion module at the scales of its last three decoder layers."""

    def __init__(self, width: int, channels: int, radius: int) -> None:
        super().__init__()
        self.unet = UNet(10, [width] * LEVELS)  # color 3, albedo 3, normal 3, depth 1
        self.heads = nn.ModuleList(nn.Conv2d(width, channels, 3, padding=1) for _ in range(self.unet.scales))
        self.fusions: Sequence[FusionModule] = nn.ModuleList(  # type: ignore[assignment]
            FusionModule() for _ in range(self.unet.scales - 1)
        )
        # At each scale a pixel for head and fusion, and the filter's radius, beyond the U-Net.
        ways = (self.unet.reach(scale) + ((1 + radius) << scale) for scale in range(self.unet.scales))
        reach = max(ways) + sum(1 << scale for scale in range(self.unet.scales - 1))
        self.needs = Needs(uses=GUIDES, reach=reach, stride=self.unet.multiple, live=self.unet.live)

    def fuse(self, images: list[Tensor]) -> Tensor:
        """Fuse the scales of an image, and of what follows its color, finest first."""
        fused = images[-1]
        for image, fusion in zip(images[-2::-1], self.fusions, strict=True):
            fused = fusion(image, fused)  #                                                                     Eq. 2
        return fused


class PixelNetwork(_Scales):
    """P: predicts the image at three scales and fuses them.

    Args:
        width: feature channels of every convolution, the paper's 40.
    """

    def __init__(self, width: int = 40) -> None:
        super().__init__(width, 3, radius=0)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        levels = self.unet(self.input_of(frame, frame.color))
        images = [head(level) for head, level in zip(self.heads, levels, strict=True)]
        return Output(self.fuse([image.to(frame.color.dtype) for image in images])), None  #                    Eq. 1


class KernelNetwork(_Scales):
    """K: predicts a kernel for each pixel at three scales, adjusts it by the features, filters, and fuses.

    Args:
        width: feature channels of every convolution, the paper's 40.
        kernel_size: k, the paper's 5; a head has k^2 channels, 28 with the three of the bilateral weights.
        bilateral: whether features adjust the kernels (Sec. 3.3).
        normalize: how the weights of a kernel are normalised.
    """

    def __init__(
        self, width: int = 40, kernel_size: int = 5, bilateral: bool = True, normalize: Normalize = "softmax"
    ) -> None:
        super().__init__(width, kernel_size**2 + (3 if bilateral else 0), radius=kernel_size // 2)
        self.taps, self.bilateral, self.normalize = kernel_size**2, bilateral, normalize

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        x, (albedo, normal, depth) = frame.color, unit_features_of(frame)
        levels = self.unet(torch.cat([x, albedo, normal, depth], 1))
        # Negative weights have no meaning as proportions.
        x = with_carried(frame) if self.normalize == "softmax" else x
        images = []
        for scale, (head, level) in enumerate(zip(self.heads, levels, strict=True)):
            if scale:
                x, normal, depth = downsample(x), downsample(normal), downsample(depth)
            predicted = head(level)  #                                                                          Eq. 3
            w, guides, scales, f3 = predicted[:, : self.taps], [], [], None
            if self.bilateral:
                f1, f2, f3 = F.softplus(predicted[:, self.taps :].to(x.dtype)).split(1, 1)
                guides, scales = [normal, depth], [f1, f2]
            images.append(cross_bilateral_filter(x, w, guides, scales, f3, normalize=self.normalize))  #    Eqs. 4-8
        return answered(frame, self.fuse(images)), None


class _NonNegative(Wrapper):
    """Clamps negative radiance to 0."""

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        output, state = self.inner(frame, state)
        return output.lit(lambda image: image.clamp_min(0)), state


@register_model(
    "cascaded",
    "the paper's network to the letter: P+K, width 40, 5x5 kernels, bilateral weights",
    kind="kernel",
    paper="DOI 10.1007/s00371-023-02951-6",
)
@published
def cascaded(
    width: int = 40,
    kernel_size: int = 5,
    cascade: Cascade = "P+K",
    bilateral: bool = True,
    normalize: Normalize = "softmax",
) -> Model:
    """The paper's network, and its ablations.

    Args:
        width: feature channels of every convolution: the paper's 40 for two networks, 64 for ``"K"`` or ``"P"`` alone.
        kernel_size: k of the kernel network.
        cascade: ``"P+K"`` as in the paper, or ``"K"``, ``"P"``, ``"K+P"``, ``"K+K"`` as in its Table 3.
        bilateral: whether features adjust the kernels, see its Table 4.
        normalize: see :class:`KernelNetwork`.

    Raises:
        InputError: there is no such cascade.
    """
    check_choice("cascade", cascade, Cascade)
    networks: list[Model] = [
        Tiled(PixelNetwork(width) if part == "P" else KernelNetwork(width, kernel_size, bilateral, normalize))
        for part in cascade.split("+")
    ]
    networks[-1] = _NonNegative(networks[-1])
    return Chain(**dict(zip(("initial", "final")[-len(networks) :], networks, strict=True)))
