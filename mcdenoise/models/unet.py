"""The U-Net backbone of the pixel and the kernel network."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class UNet(nn.Module):
    """A U-Net of constant width that hands out the features of its last three decoder levels.

    Each level is two 3x3 convolutions with ReLU; 2x2 max-pooling goes down, a 2x2 transposed convolution goes up, and
    the encoder's features of the same scale are concatenated before the decoder's convolutions (Ronneberger et al.
    2015; the paper's Sec. 3.2 and Fig. 2). Any image size: the image is padded to a multiple of ``2 ** (levels - 1)``
    by repeating its edge, and the features are cropped.

    Args:
        in_channels: channels of the input.
        width: feature channels of every convolution (the paper's 40).
        levels: number of scales, at least 4; 4 in the paper.
        coarse_channels: channels that the encoder is given at each scale but the finest, beside its own features.

    Raises:
        ValueError: there are too few levels.
    """

    scales = 3

    def __init__(self, in_channels: int, width: int, levels: int = 4, coarse_channels: int = 0) -> None:
        super().__init__()
        # The coarsest level is the encoder's alone.
        if levels <= self.scales:
            raise ValueError(f"levels: expected at least {self.scales + 1}, found {levels}")
        self.levels, self.width = levels, width
        self.multiple: int = 2 ** (levels - 1)
        self.encoder = nn.ModuleList(
            _block(width + coarse_channels if level else in_channels, width) for level in range(levels)
        )
        self.up = nn.ModuleList(nn.ConvTranspose2d(width, width, 2, stride=2) for _ in range(levels - 1))
        self.decoder = nn.ModuleList(_block(2 * width, width) for _ in range(levels - 1))

    def reach(self, scale: int) -> int:
        """How far from a pixel of the input a feature of scale ``2 ** scale`` may depend on it, in pixels of the input.

        Two 3x3 convolutions at each level on the way down and up again, and the rest of a block of the coarsest pixels.
        """
        down, up = range(self.levels), range(scale, self.levels - 1)
        convolutions: int = sum(2 << level for level in (*down, *up))
        return convolutions + self.multiple - 1

    def forward(self, x: Tensor, coarse: Sequence[Tensor] = ()) -> list[Tensor]:
        """Features at full, half and quarter resolution.

        Args:
            x: ``(B, in_channels, H, W)``.
            coarse: what the encoder is given besides, ``(B, coarse_channels, ceil(H / s), ceil(W / s))`` for ``s`` = 2,
                4, ...: one for each scale but the finest, or none.

        Returns:
            Three tensors ``(B, width, ceil(H / s), ceil(W / s))`` for ``s`` = 1, 2, 4.
        """
        height, width = x.shape[-2:]
        x = _padded(x, (height + -height % self.multiple, width + -width % self.multiple))
        skips: list[Tensor] = []
        for level, block in enumerate(self.encoder):
            if level:
                x = _max_pool(x)
            if level and coarse:
                x = torch.cat([x, _padded(coarse[level - 1].to(x.dtype), x.shape[-2:])], 1)
            x = block(x)
            skips.append(x)
        skips.pop()
        features: list[Tensor] = []
        for up, block in zip(self.up, self.decoder, strict=True):
            x = block(torch.cat([up(x), skips.pop()], 1))
            features.append(x)
        finest_first = features[: -self.scales - 1 : -1]
        return [f[..., : -(-height // 2**s), : -(-width // 2**s)] for s, f in enumerate(finest_first)]


def _padded(x: Tensor, size: Sequence[int]) -> Tensor:
    """``x``, its last row and column repeated up to ``size``."""
    missing = (0, size[1] - x.shape[-1], 0, size[0] - x.shape[-2])
    return F.pad(x, missing, mode="replicate") if any(missing) else x


class _ReLU(nn.Module):
    """ReLU in place: neither the convolution before it nor its own derivative needs what it overwrites."""

    def forward(self, x: Tensor) -> Tensor:
        if x.dtype == torch.bfloat16 and _plain_inference(x):
            # The sign of a bfloat16 is that of its bits as an integer, which a CPU clamps ten times as fast.
            x.view(torch.int16).clamp_min_(0)
            return x
        return F.relu(x, inplace=True)


def _max_pool(x: Tensor) -> Tensor:
    """``F.max_pool2d(x, 2)``, in half the time where nobody asks which of the pixels it was."""
    if not _plain_inference(x):
        return F.max_pool2d(x, 2)
    rows = torch.maximum(x[..., ::2, :], x[..., 1::2, :])
    return torch.maximum(rows[..., ::2], rows[..., 1::2])


def _plain_inference(x: Tensor) -> bool:
    return x.device.type == "cpu" and not torch.is_grad_enabled() and not torch.compiler.is_compiling()


def _block(in_channels: int, out_channels: int) -> nn.Sequential:
    block = nn.Sequential(
        nn.Conv2d(in_channels, out_channels, 3, padding=1),
        _ReLU(),
        nn.Conv2d(out_channels, out_channels, 3, padding=1),
        _ReLU(),
    )
    for layer in block:
        if isinstance(layer, nn.Conv2d):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
    return block
