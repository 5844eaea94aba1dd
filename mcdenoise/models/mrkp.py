"""Kernel prediction at several scales: the network of Vogels et al. 2018 as Meng et al. 2020 modified it for 1 spp.

Vogels et al. 2018, "Denoising with kernel prediction and asymmetric loss functions"; the layers are those of Meng's
public code, MultiResolutionKernelPredictionCNN, with the same 341,838 parameters. Like that code and unlike Vogels:

- the weights of a kernel are made non-negative by a ReLU and divided by their sum plus 1e-8; for each color channel
  only taps inside the image whose value is positive count. Vogels uses a softmax;
- alpha, the weight of the coarse scale, is one more channel of the kernel's convolution behind a ReLU, without an upper
  bound; Vogels uses a small network and a sigmoid;
- upsampling copies to even pixels, and odd pixels are the mean of their two or four neighbours.

Unlike that code: typical radiance is scaled to 0.5 before the network, so that the unit of radiance does not matter;
depth is ``d / (d + typical depth)``, where the code scales each frame's depth to its minimum and maximum; only the
U-Net pads its input, by repeating the edge; negative radiance, which an alpha above one allows, is clamped to 0. Meng
trains with L1 on gamma-mapped images; the paper and `mcdenoise train` use SMAPE.
"""

from __future__ import annotations

import itertools

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mcdenoise.frame import Frame
from mcdenoise.models._interface import GUIDES, Needs, Output, State
from mcdenoise.models._layers import answered, with_carried
from mcdenoise.models._published import Network, check_odd, published
from mcdenoise.models._registry import register_model
from mcdenoise.ops import downsample, kernel_conv
from mcdenoise.ops._window import accumulator_dtype, corner, parts_of, up_to_multiple

LEVELS, SCALES = 5, 3
# Added to the sum of a kernel's weights.
_EPSILON = 1e-8


class Backbone(nn.Module):
    """Meng's U-Net: one 3x3 convolution a level with 2x2 mean pooling, and 3x3 transposed convolutions up again.

    Encoder features are concatenated to those of the decoder; only the heads' convolutions follow. The image
    is padded to a multiple of 32 by repeating the edge.

    Args:
        in_channels: number of input channels.
        width: channels of every convolution, 48.
    """

    multiple: int = 2**LEVELS

    def __init__(self, in_channels: int, width: int) -> None:
        super().__init__()
        entering, coarser = [in_channels] + [width] * (LEVELS - 1), [width] + [2 * width] * (LEVELS - 1)
        self.encoder = nn.ModuleList(nn.Conv2d(each, width, 3, padding=1) for each in entering)
        self.decoder = nn.ModuleList(
            nn.ConvTranspose2d(each, width, 3, stride=2, padding=1, output_padding=1) for each in coarser
        )
        self.out_channels = 2 * width
        for layer in (*self.encoder, *self.decoder):
            with_glorot(layer)

    @staticmethod
    def reach() -> int:
        """Largest distance in pixels between a feature of any scale and an input pixel that it depends on.

        The sum of one pixel of each level on the way down, one of the next coarser level on the way up, and the rest of
        the block of the coarsest level.
        """
        steps: int = sum(3 << level for level in range(LEVELS))
        return steps + Backbone.multiple - 1

    def forward(self, x: Tensor) -> list[Tensor]:
        """Features ``(B, 2 * width, ceil(H / s), ceil(W / s))`` for ``s`` = 1, 2, 4."""
        height, width = x.shape[-2:]
        x = up_to_multiple(x, self.multiple, mode="replicate")
        skips = []
        for convolution in self.encoder:
            skips.append(F.relu(convolution(x)))
            x = F.avg_pool2d(skips[-1], 2)
        found = []
        for deconvolution, skip in zip(self.decoder, reversed(skips), strict=True):
            x = torch.cat([F.relu(deconvolution(x)), skip], 1)
            found.append(x)
        finest = enumerate(found[: -SCALES - 1 : -1])
        return [corner(each, parts_of(height, 1 << scale), parts_of(width, 1 << scale)) for scale, each in finest]


def with_glorot(layer: nn.Module) -> nn.Module:
    """Initialize a convolution with Glorot's weights and zero biases."""
    weight, bias = layer.parameters()
    nn.init.xavier_uniform_(weight)
    nn.init.zeros_(bias)
    return layer


class MrkpNetwork(Network):
    """Predicts kernels and blending weights at three scales, filters each, and blends them from coarse to fine.

    Args:
        width: channels of every convolution, 48.
        kernel_size: k of the kernels, odd, 5.

    Raises:
        InputError: a setting is out of its range.
    """

    def __init__(self, width: int = 48, kernel_size: int = 5) -> None:
        super().__init__()
        check_odd(kernel_size)
        self.unet, self.taps = Backbone(10, width), kernel_size**2
        channels = self.taps + 1
        self.heads = nn.ModuleList(
            with_glorot(nn.Conv2d(self.unet.out_channels, channels, 3, padding=1)) for _ in range(SCALES)
        )
        # Beyond the features a pixel for each head, the radius, and two pixels for each upsampling, at their scales.
        own = ((1 + kernel_size // 2) << (SCALES - 1)) + sum(4 << scale for scale in range(SCALES))
        self.needs = Needs(uses=GUIDES, reach=self.unet.reach() + own, stride=self.unet.multiple)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        dtype = accumulator_dtype(frame.color.dtype)
        levels = self.unet(self.input_of(frame, frame.color))
        # Means over blocks of 2x2, 4x4 and 8x8 pixels; the coarsest scale is not filtered.
        image = with_carried(frame).to(dtype)
        *scales, blended = itertools.accumulate(range(SCALES), lambda x, _: downsample(x), initial=image)
        for n, level, head in zip(reversed(scales), reversed(levels), reversed(self.heads), strict=True):
            predicted = F.relu(head(level).to(dtype))
            kernel, alpha = predicted.split([self.taps, 1], 1)
            blended = blend_scales(_filter(n, kernel), blended, alpha)
        return answered(frame, blended.clamp_min(0).to(frame.color.dtype)), None


def _filter(image: Tensor, kernel: Tensor) -> Tensor:
    """``sum w c / (sum w + 1e-8)`` over positive taps inside the image; for layers and alpha over all inside."""
    counted = torch.ones_like(image)
    counted[:, :3] = (image[:, :3] > 0).to(image.dtype)
    total, weight = kernel_conv(torch.cat([image * counted, counted], 1), kernel, border="zeros").chunk(2, 1)
    return total / (weight + _EPSILON)


def blend_scales(fine: Tensor, coarse: Tensor, alpha: Tensor) -> Tensor:
    """``fine - alpha U D fine + alpha U coarse`` (the paper's Eq. 2); layers and alpha are blended by a mean."""
    height, width = fine.shape[-2:]
    color = fine[:, :3] + alpha * aligned(coarse[:, :3] - downsample(fine[:, :3]), height, width)
    if fine.shape[1] == 3:
        return color
    others = torch.lerp(fine[:, 3:], aligned(coarse[:, 3:], height, width), alpha.clamp_max(1))
    return torch.cat([color, others], 1)


def aligned(image: Tensor, height: int, width: int) -> Tensor:
    """Upsample as in Meng's code: even pixels are copies, odd ones are the mean of their neighbours inside the image.

    Args:
        image: ``(B, C, ceil(H / 2), ceil(W / 2))``.
        height: height of the result.
        width: width of the result.
    """
    padded = F.pad(image, (0, 1, 0, 1), mode="replicate")
    size = [2 * side + 1 for side in image.shape[-2:]]
    return corner(F.interpolate(padded, size, mode="bilinear", align_corners=True), height, width)


mrkp = register_model(
    "mrkp", "5x5 kernels at three scales, as in Meng's code of 2020", kind="kernel", paper="Vogels et al. 2018"
)(published(MrkpNetwork))
