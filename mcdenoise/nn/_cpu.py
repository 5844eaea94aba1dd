"""What works round torch on a CPU: the layers of a U-Net, with the same results in less time.

Each behaves as the torch layer that it is named after, with its derivatives; what is faster is chosen where nobody asks
for a derivative and nothing is compiled.
"""

from __future__ import annotations

import functools
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mcdenoise.ops._autograd import Function


def layout_of(x: Tensor) -> torch.memory_format:
    """Channels of several layouts are concatenated number by number."""
    channels_last = x.is_contiguous(memory_format=torch.channels_last)
    return torch.channels_last if channels_last else torch.contiguous_format


class ConvBlock(nn.Sequential):
    """Convolutions and ReLUs in turn, which are one step where no derivative is asked for."""

    def forward(self, x: Tensor) -> Tensor:
        fused = is_plain_inference(x)
        for layer in self:
            if not fused:
                x = layer(x)
            elif isinstance(layer, nn.Conv2d):
                x = _convolved_with_relu(x, layer)
        return x


def _convolved_with_relu(x: Tensor, layer: nn.Conv2d) -> Tensor:
    """A convolution and ReLU, in one where oneDNN can: torch has this for what it compiles only."""
    dtype = torch.get_autocast_dtype("cpu") if torch.is_autocast_enabled("cpu") else x.dtype
    if not _has_fused_convolution(dtype):
        return F.relu_(layer(x))
    weight, bias = (parameter.to(dtype) for parameter in layer.parameters())
    result: Tensor = torch.ops.mkldnn._convolution_pointwise(
        x.to(dtype), weight, bias, layer.padding, layer.stride, layer.dilation, 1, "relu", [], ""
    )
    return result


@functools.cache
def _has_fused_convolution(dtype: torch.dtype) -> bool:
    try:
        onednn = torch.ops.mkldnn
        supported = {torch.float32: True, torch.bfloat16: onednn._is_mkldnn_bf16_supported()}
        return supported.get(dtype, False) and hasattr(onednn, "_convolution_pointwise")
    except AttributeError:
        # Built without oneDNN.
        return False


class Upsampling(nn.ConvTranspose2d):
    """A transposed convolution whose bias learns in a twentieth of the time."""

    def forward(self, x: Tensor, output_size: list[int] | None = None) -> Tensor:
        # A bias that does not learn needs nothing, and torch's own has derivatives forward.
        if self.bias is None or not (self.bias.requires_grad and torch.is_grad_enabled()):
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


class ReLU(nn.Module):
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


def max_pool(x: Tensor) -> Tensor:
    """``F.max_pool2d(x, 2)`` of what is not negative, in less time where nobody asks which of the pixels it was."""
    if not is_plain_inference(x):
        return F.max_pool2d(x, 2)
    # Behind a ReLU, bfloat16 numbers are in the order of their bits as integers, which a CPU compares twice as fast.
    values = x.view(torch.int16) if x.dtype == torch.bfloat16 else x
    rows = torch.maximum(values[..., ::2, :], values[..., 1::2, :])
    return torch.maximum(rows[..., ::2], rows[..., 1::2]).view(x.dtype)


def is_plain_inference(x: Tensor) -> bool:
    return x.device.type == "cpu" and not torch.is_grad_enabled() and not torch.compiler.is_compiling()
