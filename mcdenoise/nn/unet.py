"""The U-Net backbone of the pixel and the kernel network."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mcdenoise.nn._cpu import ConvBlock, ReLU, Upsampling, layout_of, max_pool
from mcdenoise.ops._window import corner

# Peak numbers per pixel, measured: 4.5 widths inside the U-Net, and 54 for the surrounding images and features, which
# stay float32.
_LIVE_WIDTHS, _LIVE_IMAGES = 4.5, 54


class Live(NamedTuple):
    """Numbers per pixel of an image that a method holds at its peak, including its input and result.

    Args:
        features: in the precision of the convolutions.
        images: in float32.
    """

    features: float
    images: float = _LIVE_IMAGES

    def bytes(self, *, bfloat16: bool) -> float:
        """The memory per pixel; ``bfloat16``: whether convolutions run in it, else in float32."""
        return self.features * (2 if bfloat16 else 4) + self.images * 4


class UNet(nn.Module):
    """A U-Net that returns features of an image at several resolutions: full, half, quarter and so on.

    Each level has two 3x3 convolutions with ReLU; 2x2 max-pooling goes down, a 2x2 transposed convolution goes up, and
    the encoder's features of the same scale are concatenated before the decoder's convolutions (Ronneberger et al.
    2015; the paper's Sec. 3.2 and Fig. 2). Any image size: the image is padded to whole pixels of the coarsest level
    (``2 ** (levels - 1)``, with ``half`` twice as many) by repeating its edge, and the features are cropped.

    With ``half``, there is no level at full resolution, which would take most of the time: the first convolution is 4x4
    with stride 2, and a :class:`Head` predicts 2x2 pixels from each feature (``F.pixel_shuffle``, Shi et al. 2016).

    Args:
        in_channels: number of input channels.
        widths: feature channels of the convolutions of each level, finest first (the paper's 40, 40, 40, 40).
        scales: number of resolutions to return, finest first; 3 in the paper.
        coarse_channels: channels of the additional encoder input at each scale but the finest.
        half: whether the finest level has half the resolution.

    Raises:
        ValueError: there are fewer levels than scales.
    """

    def __init__(
        self, in_channels: int, widths: Sequence[int], scales: int = 3, coarse_channels: int = 0, half: bool = False
    ) -> None:
        super().__init__()
        self.widths, self.levels, self.scales = list(widths), len(widths), scales
        self.stride = 2 if half else 1
        if self.levels <= self.level(scales - 1):
            raise ValueError(f"widths: expected at least {self.level(scales - 1) + 1} levels, found {self.levels}")
        levels = self.levels
        self.multiple: int = self.stride * 2 ** (levels - 1)
        entering = [in_channels] + [finer + coarse_channels for finer in self.widths[:-1]]
        strides = [self.stride] + [1] * (levels - 1)
        self.encoder = nn.ModuleList(_block(*each) for each in zip(entering, self.widths, strides, strict=True))
        upwards = list(itertools.pairwise(self.widths[::-1]))
        self.up = nn.ModuleList(Upsampling(coarser, finer, 2, stride=2) for coarser, finer in upwards)
        self.decoder = nn.ModuleList(_block(2 * finer, finer) for _, finer in upwards)

    def level(self, scale: int) -> int:
        """The level that holds the features of a scale."""
        return max(0, scale - self.stride + 1)

    def reach(self, scale: int) -> int:
        """Largest distance in pixels between a feature of scale ``2 ** scale`` and an input pixel that it depends on.

        The sum of two 3x3 convolutions per level, down and up, and the rest of a block of the coarsest pixels.
        """
        down, up = range(self.levels), range(self.level(scale), self.levels - 1)
        convolutions: int = sum(2 * self.stride << level for level in (*down, *up))
        return convolutions + self.multiple - 1

    @property
    def live(self) -> Live:
        """What it holds at its peak."""
        return Live(_LIVE_WIDTHS * self.widths[0])

    def forward(self, x: Tensor, coarse: Sequence[Tensor] = ()) -> list[Tensor]:
        """Compute features at each of the scales.

        Args:
            x: ``(B, in_channels, H, W)``.
            coarse: additional encoder inputs, ``(B, coarse_channels, ceil(H / s), ceil(W / s))`` for ``s`` = 2, 4, ...,
                with ``half`` from 4 on: one for each level but the finest, or none.

        Returns:
            Tensors ``(B, width, ceil(H / s), ceil(W / s))`` for ``s`` = 1, 2, 4, ..., with ``half`` 2, 2, 4, ..., each
            with the width of its level.
        """
        height, width = x.shape[-2:]
        # Sizes are rounded up to multiples, so that halves are simple expressions in a graph for any image size.
        x = self._whole(x)
        features = self._features(x, coarse)
        found = []
        for scale in range(self.scales):
            level = self.level(scale)
            side = self.stride << level
            found.append(corner(features[level], (height + side - 1) // side, (width + side - 1) // side))
        return found

    def _features(self, x: Tensor, coarse: Sequence[Tensor]) -> list[Tensor]:
        """Features of each level, finest first."""
        skips: list[Tensor] = []
        for level, block in enumerate(self.encoder):
            if level:
                x = max_pool(x)
            if level and coarse:
                given = coarse[level - 1].to(x.dtype, memory_format=layout_of(x))
                x = torch.cat([x, _padded(given, x.shape[-2:])], 1)
            x = block(x)
            skips.append(x)
        features = [skips.pop()]
        for up, block in zip(self.up, self.decoder, strict=True):
            x = block(torch.cat([up(x), skips.pop()], 1))
            features.append(x)
        return features[::-1]

    def _whole(self, x: Tensor) -> Tensor:
        """Pad to whole pixels of the coarsest level."""
        return _padded(x, [(side + self.multiple - 1) // self.multiple * self.multiple for side in x.shape[-2:]])


class Head(nn.Conv2d):
    """A 3x3 convolution that predicts channels from the features of a scale.

    Args:
        unet: the U-Net that computes the features.
        scale: index of the scale.
        channels: number of channels to predict for each pixel.
    """

    def __init__(self, unet: UNet, scale: int, channels: int) -> None:
        side = 1 if scale else unet.stride
        super().__init__(unet.widths[unet.level(scale)], channels * side**2, 3, padding=1)
        self.side = side

    def forward(self, features: Tensor, size: Sequence[int]) -> Tensor:  # type: ignore[override]
        """Predict.

        Args:
            features: ``(B, width, h, w)``.
            size: height and width of the prediction.

        Returns:
            ``(B, channels, *size)``.
        """
        predicted = super().forward(features)
        return predicted if self.side == 1 else corner(F.pixel_shuffle(predicted, self.side), *size)


def _padded(x: Tensor, size: Sequence[int]) -> Tensor:
    """Repeat the last row and column of ``x`` up to ``size``."""
    below, right = size[0] - x.shape[-2], size[1] - x.shape[-1]
    # A graph for any image size cannot branch on whether padding is needed.
    if torch.compiler.is_compiling():
        return F.pad(x, (0, right, 0, below), mode="replicate")
    # torch's padding takes several times as long, and computes in float32 under autocast.
    for dim, missing in ((-2, below), (-1, right)):
        if missing:
            edge = x.narrow(dim, -1, 1)
            x = torch.cat([x, *[edge] * missing], dim)
    return x


def _block(in_channels: int, out_channels: int, stride: int = 1) -> nn.Sequential:
    block = ConvBlock(
        nn.Conv2d(in_channels, out_channels, 2 + stride, stride, padding=1),
        ReLU(),
        nn.Conv2d(out_channels, out_channels, 3, padding=1),
        ReLU(),
    )
    for layer in block:
        if isinstance(layer, nn.Conv2d):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
    return block
