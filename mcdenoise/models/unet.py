"""The U-Net backbone of the pixel and the kernel network."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mcdenoise.ops._autograd import Function


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

    Raises:
        ValueError: there are too few levels.
    """

    scales = 3

    def __init__(self, in_channels: int, width: int, levels: int = 4) -> None:
        super().__init__()
        # The coarsest level is the encoder's alone.
        if levels <= self.scales:
            raise ValueError(f"levels: expected at least {self.scales + 1}, found {levels}")
        self.levels, self.width = levels, width
        self.multiple: int = 2 ** (levels - 1)
        self.encoder = nn.ModuleList(_block(in_channels if level == 0 else width, width) for level in range(levels))
        self.up = nn.ModuleList(_Upsampling(width, width, 2, stride=2) for _ in range(levels - 1))
        self.decoder = nn.ModuleList(_block(2 * width, width) for _ in range(levels - 1))

    def reach(self, scale: int) -> int:
        """How far from a pixel of the input a feature of scale ``2 ** scale`` may depend on it, in pixels of the input.

        Two 3x3 convolutions at each level on the way down and up again, and the rest of a block of the coarsest pixels.
        """
        down, up = range(self.levels), range(scale, self.levels - 1)
        convolutions: int = sum(2 << level for level in (*down, *up))
        return convolutions + self.multiple - 1

    def forward(self, x: Tensor) -> list[Tensor]:
        """Features at full, half and quarter resolution.

        Args:
            x: ``(B, in_channels, H, W)``.

        Returns:
            Three tensors ``(B, width, ceil(H / s), ceil(W / s))`` for ``s`` = 1, 2, 4.
        """
        height, width = x.shape[-2:]
        missing = (0, -width % self.multiple, 0, -height % self.multiple)
        if any(missing):
            x = F.pad(x, missing, mode="replicate")
        skips: list[Tensor] = []
        for level, block in enumerate(self.encoder):
            x = block(x if level == 0 else _max_pool(x))
            skips.append(x)
        skips.pop()
        features: list[Tensor] = []
        for up, block in zip(self.up, self.decoder, strict=True):
            x = block(torch.cat([up(x), skips.pop()], 1))
            features.append(x)
        finest_first = features[: -self.scales - 1 : -1]
        return [f[..., : -(-height // 2**s), : -(-width // 2**s)] for s, f in enumerate(finest_first)]


class _Upsampling(nn.ConvTranspose2d):
    """A transposed convolution whose bias learns in a twentieth of the time."""

    def forward(self, x: Tensor, output_size: list[int] | None = None) -> Tensor:
        if self.bias is None or not torch.is_grad_enabled():
            return super().forward(x, output_size)
        return _Biased.apply(F.conv_transpose2d(x, self.weight, self.bias.detach(), self.stride), self.bias)


class _Biased(Function):
    """A result that a bias is in already, with its derivative in the bias: a plain sum.

    On a CPU torch takes four times as long for that as for all other derivatives of a transposed convolution together.
    """

    @staticmethod
    def forward(result: Tensor, bias: Tensor) -> Tensor:
        return result

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        ctx.dtype = inputs[1].dtype

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        return gradient, gradient.sum((0, 2, 3)).to(ctx.dtype)


class _ReLU(nn.Module):
    """ReLU in place: neither the convolution before it nor its own derivative needs what it overwrites."""

    def forward(self, x: Tensor) -> Tensor:
        if x.dtype == torch.bfloat16 and x.device.type == "cpu" and not torch.compiler.is_compiling():
            return _ReLUOfBits.apply(x)
        return F.relu(x, inplace=True)


class _ReLUOfBits(Function):
    """ReLU of bfloat16 in place.

    The sign of a bfloat16 is that of its bits as an integer, which a CPU clamps and compares many times as fast.
    """

    @staticmethod
    def forward(x: Tensor) -> Tensor:
        x.view(torch.int16).clamp_min_(0)
        return x

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.mark_dirty(*inputs)
        ctx.save_for_backward(output)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        result: Tensor = ctx.saved_tensors[0]
        if torch.is_grad_enabled():
            return torch.where(result > 0, gradient, 0)
        bits: Tensor = torch.ops.aten.threshold_backward(gradient.view(torch.int16), result.view(torch.int16), 0)
        return bits.view(torch.bfloat16)


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
