"""The U-Net backbone of the pixel and the kernel network."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from mcdenoise.nn._cpu import ConvBlock, halved
from mcdenoise.ops._window import corner, parts_of, up_to_multiple

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
    (``2 ** (levels - 1)``) by repeating its edge, and the features are cropped.

    Args:
        in_channels: number of input channels.
        widths: feature channels of the convolutions of each level, finest first (the paper's 40, 40, 40, 40).
        scales: number of resolutions to return, finest first; 3 in the paper.

    Raises:
        ValueError: there are fewer levels than scales.
    """

    def __init__(self, in_channels: int, widths: Sequence[int], scales: int = 3) -> None:
        super().__init__()
        self.widths, self.levels, self.scales = list(widths), len(widths), scales
        if self.levels < scales:
            raise ValueError(f"widths: expected at least {scales} levels, found {self.levels}")
        self.multiple: int = 2 ** (self.levels - 1)
        entering = [in_channels, *self.widths[:-1]]
        self.encoder = nn.ModuleList(_block(*each) for each in zip(entering, self.widths, strict=True))
        upwards = list(itertools.pairwise(self.widths[::-1]))
        self.up = nn.ModuleList(nn.ConvTranspose2d(coarser, finer, 2, stride=2) for coarser, finer in upwards)
        self.decoder = nn.ModuleList(_block(2 * finer, finer) for _, finer in upwards)

    def reach(self, scale: int) -> int:
        """Largest distance in pixels between a feature of scale ``2 ** scale`` and an input pixel that it depends on.

        The sum of two 3x3 convolutions per level, down and up, and the rest of a block of the coarsest pixels.
        """
        down, up = range(self.levels), range(scale, self.levels - 1)
        convolutions: int = sum(2 << level for level in (*down, *up))
        return convolutions + self.multiple - 1

    @property
    def live(self) -> Live:
        """What it holds at its peak."""
        return Live(_LIVE_WIDTHS * self.widths[0])

    def forward(self, x: Tensor) -> list[Tensor]:
        """Compute features at each of the scales.

        Args:
            x: ``(B, in_channels, H, W)``.

        Returns:
            Tensors ``(B, width, ceil(H / s), ceil(W / s))`` for ``s`` = 1, 2, 4, ..., each with the width of its level.
        """
        height, width = x.shape[-2:]
        # Sizes are rounded up to multiples, so that halves are simple expressions in a graph for any image size.
        x = up_to_multiple(x, self.multiple, "replicate")
        skips: list[Tensor] = []
        for level, block in enumerate(self.encoder):
            if level:
                x = halved(x)
            x = block(x)
            skips.append(x)
        features = [skips.pop()]
        for up, block in zip(self.up, self.decoder, strict=True):
            x = block(torch.cat([up(x), skips.pop()], 1))
            features.append(x)
        scales = enumerate(features[: -self.scales - 1 : -1])
        return [corner(each, parts_of(height, 1 << scale), parts_of(width, 1 << scale)) for scale, each in scales]


def _block(in_channels: int, out_channels: int) -> nn.Sequential:
    block = ConvBlock(
        nn.Conv2d(in_channels, out_channels, 3, padding=1),
        nn.ReLU(inplace=True),
        nn.Conv2d(out_channels, out_channels, 3, padding=1),
        nn.ReLU(inplace=True),
    )
    for layer in block:
        if isinstance(layer, nn.Conv2d):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
    return block
