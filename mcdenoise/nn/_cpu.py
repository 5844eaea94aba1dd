"""Layers of a U-Net that avoid slow paths of torch on a CPU, with the same results.

Faster code runs only if no derivative is requested and nothing is being compiled.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mcdenoise.ops._backend import is_transformed
from mcdenoise.ops._window import computing_dtype


class ConvBlock(nn.Sequential):
    """Alternating convolutions and ReLUs; each pair runs as one step if no derivative is requested."""

    def forward(self, x: Tensor) -> Tensor:
        return _run(list(self), x)


class UpConvBlock(ConvBlock):
    """A :class:`ConvBlock` of upsampled features and the skipped ones of the finer level, concatenated.

    Nearest-neighbour upsampling gives each 2x2 pixels one value, so that a 3x3 kernel sees four different ones: both
    together are a transposed convolution with a 4x4 kernel of sums of weights. If no derivative is requested, and in an
    exported graph, the first convolution is computed so: four ninths of the work, and no upsampled features.
    """

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:  # type: ignore[override]
        """Convolve ``(B, C, H, W)`` and ``(B, S, 2 H, 2 W)``."""
        dtype, exporting = computing_dtype(x), torch.compiler.is_exporting()
        if not (_are_pairs(list(self)) and (exporting or _is_fused(x, dtype))):
            return super().forward(torch.cat([F.interpolate(x, scale_factor=2.0), skip.to(x.dtype)], 1))
        first, others = cast(nn.Conv2d, self[0]), list(self)[1:]
        coarse, fine = first.weight.split([x.shape[1], skip.shape[1]], 1)
        x = F.conv_transpose2d(x.to(dtype), _kernels_of_pixels(coarse).to(dtype), stride=2, padding=1)
        if exporting:
            return _run(others, x + F.conv2d(skip.to(dtype), fine, first.bias, padding=1))
        # The result of a single pixel has another layout, onto which oneDNN adds nothing in bfloat16.
        x = x.contiguous(memory_format=torch.channels_last)
        return _run(others[1:], _convolved(skip, fine, first.bias, dtype, "relu", onto=x))


# A pixel contributes to 4 pixels of the finer level along each axis, to each with the sum of these of 3 weights.
_ALONG = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 1.0], [1.0, 1.0, 0.0], [1.0, 0.0, 0.0]], device="cpu")
_SUMS = torch.kron(_ALONG, _ALONG)


def _kernels_of_pixels(weight: Tensor) -> Tensor:
    """The kernels ``(C, O, 4, 4)`` with which pixels contribute to upsampled ones, from ``(O, C, 3, 3)``."""
    # A matrix product takes a sixth of the time of sums of slices.
    with _without_autocast("cpu"):
        kernels: Tensor = (weight.flatten(2) @ _SUMS.to(weight.dtype).T).reshape(*weight.shape[:2], 4, 4)
    return kernels.transpose(0, 1)


def _run(layers: Sequence[nn.Module], x: Tensor) -> Tensor:
    """Alternating convolutions and ReLUs, fused by oneDNN if possible; torch offers this only to its compiler."""
    dtype = computing_dtype(x)
    fused = _is_fused(x, dtype) and _are_pairs(layers)
    for layer in layers:
        if not fused:
            x = layer(x)
        elif isinstance(layer, nn.Conv2d):
            x = _convolved(x, layer.weight, layer.bias, dtype, "relu")
    return x


def _are_pairs(layers: Sequence[nn.Module]) -> bool:
    """Whether layers are still convolutions and ReLUs in turn, whose calls no hook sees or changes."""
    # A user may replace activations, normalise weights, or look at features.
    kinds = [type(layer) for layer in layers]
    hooked = any(layer._forward_hooks or layer._forward_pre_hooks for layer in layers)
    return kinds == [nn.Conv2d, nn.ReLU] * (len(kinds) // 2) and not hooked


def _convolved(
    x: Tensor,
    weight: Tensor,
    bias: Tensor | None,
    dtype: torch.dtype,
    then: str | None = None,
    *,
    onto: Tensor | None = None,
) -> Tensor:
    """A convolution with a border of one pixel, added to ``onto``, which is overwritten; ``then`` a function of it."""
    x, weight, bias = x.to(dtype), weight.to(dtype), None if bias is None else bias.to(dtype)
    shape = [1, 1], [1, 1], [1, 1], 1  # padding, stride, dilation, groups
    if onto is None:
        onto = torch.ops.mkldnn._convolution_pointwise(x, weight, bias, *shape, then or "none", [], "")
    else:
        torch.ops.mkldnn._convolution_pointwise_.binary(onto, x, weight, bias, *shape, "add", 1.0, then, [], "")
    return onto


def convolved_in_float32(x: Tensor, layer: nn.Conv2d, near: Tensor) -> Tensor:
    """A convolution, with a border of one pixel, of features that may be bfloat16, with a float32 result.

    oneDNN convolves bfloat16 with sums in float32, and rounds these at last. If no derivative is requested, what it
    rounds is the difference from an image that the result resembles, so that hardly anything is lost. Weights and bias
    are rounded to bfloat16, as those of all other layers.

    Args:
        x: ``(B, C, H, W)``.
        layer: a convolution of 3x3 pixels to N channels.
        near: ``(B, N, H, W)`` in the same dtype, what the result resembles.
    """
    if x.dtype != torch.bfloat16 or not _is_fused(x, x.dtype):
        with _without_autocast(x.device.type):
            return cast(Tensor, layer(x.to(layer.weight.dtype)))
    near = near.contiguous(memory_format=torch.channels_last)
    return _convolved(x, layer.weight, layer.bias, x.dtype, onto=-near).to(torch.float32).add_(near)


def halved(x: Tensor) -> Tensor:
    """The largest of each 2x2 pixels of ``(B, C, 2 H, 2 W)``; as the larger of two, in half of the time."""
    if not _is_fused(x, x.dtype):
        return F.max_pool2d(x, 2)
    rows = torch.maximum(x[..., ::2, :], x[..., 1::2, :])
    return torch.maximum(rows[..., ::2], rows[..., 1::2])


def channels_last(x: Tensor, dtype: torch.dtype) -> Tensor:
    """``x`` with the channels of a pixel side by side, as convolutions are fast; vmap has no such layout."""
    return x.to(dtype, memory_format=torch.preserve_format if is_transformed() else torch.channels_last)


def _without_autocast(device_type: str) -> AbstractContextManager[object]:
    """Compute in the precision of the operands; devices without values have no autocast to disable."""
    known = torch.amp.is_autocast_available(device_type)
    return torch.autocast(device_type, enabled=False) if known else nullcontext()


@functools.cache
def has_fused_convolution(dtype: torch.dtype) -> bool:
    """Whether oneDNN convolves numbers of a dtype on this processor."""
    try:
        onednn = torch.ops.mkldnn
        supported = {torch.float32: True, torch.bfloat16: onednn._is_mkldnn_bf16_supported()}
        return supported.get(dtype, False) and hasattr(onednn, "_convolution_pointwise")
    except AttributeError:
        # torch was built without oneDNN.
        return False


def _is_fused(x: Tensor, dtype: torch.dtype) -> bool:
    """Whether oneDNN convolves, and applies a function to the result in the same step."""
    inference = x.device.type == "cpu" and not torch.is_grad_enabled() and not torch.compiler.is_compiling()
    # It has no rule for derivatives in forward mode, which are zero then.
    return inference and not is_transformed() and has_fused_convolution(dtype)
