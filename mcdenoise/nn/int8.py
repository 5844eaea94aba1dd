"""A calibrated U-Net's features, computed by convolutions of 8-bit integers.

A tensor t is stored as integers ``q = round(t / s) + z`` from 0 to 255. Its scale s follows from its range on the
calibration frames; values outside are clamped. Its zero point z is 0 behind a ReLU (Jacob et al. 2018, "Quantization
and Training of Neural Networks for Efficient Integer-Arithmetic-Only Inference", Eq. 1). Weights have one scale per
output channel, and the zero point 0. Concatenated channels keep their own scales: the weights of the next convolution
compensate for the difference.

Products are summed exactly, in 32 bits. The convolutions are oneDNN's, as torch's compiler calls them.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import NamedTuple, TypeAlias

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mcdenoise.nn._cpu import max_pool

# Zero point of tensors that are concatenated with signed values: three eighths of the integers are negative.
_SIGNED = 96
# Fraction of a channel's smallest and of its largest values that may be clamped.
_BEYOND = 1e-4
Layers: TypeAlias = nn.ModuleList | Sequence[nn.Module]
_wanted: ContextVar[bool] = ContextVar("int8", default=False)


def has_int8() -> bool:
    """Whether the processor sums products of 8-bit integers without overflow, and torch uses its instructions."""
    vnni = getattr(torch.cpu, "_is_vnni_supported", None)
    return bool(vnni is not None and vnni() and hasattr(torch.ops.onednn, "qconv2d_pointwise"))


@contextmanager
def integers(enabled: bool = True) -> Iterator[None]:
    """Let calibrated U-Nets compute in integers inside this block if no derivative is requested, like autocast."""
    token = _wanted.set(enabled)
    try:
        yield
    finally:
        _wanted.reset(token)


def wants_integers() -> bool:
    """Whether :func:`integers` is active."""
    return _wanted.get()


class Stored(NamedTuple):
    """The quantization of a tensor: scales per channel and a zero point."""

    scales: Tensor  # of each channel
    zero: int

    @classmethod
    def over(cls, ranges: Tensor, channels: int, *, signed: bool) -> Stored:
        """Quantization for the ranges ``(C, 2)`` of its channels, or ``(1, 2)`` of all; each range contains 0."""
        zero = _SIGNED if signed else 0
        scales = ranges[:, 1] / (255 - zero)
        if zero:
            scales = scales.maximum(ranges[:, 0] / -zero)
        return cls(scales.clamp_min(1e-8).expand(channels), zero)

    def beside(self, other: Stored) -> Stored:
        """Quantization of this tensor's channels followed by another tensor's."""
        return Stored(torch.cat([self.scales, other.scales]), self.zero)

    def store(self, t: Tensor) -> Tensor:
        """Quantize ``(B, C, H, W)`` values to integers, channels last."""
        t = t.float().contiguous(memory_format=torch.channels_last) / self.scales.view(-1, 1, 1)
        # Truncation after adding one half is rounding.
        return t.add_(self.zero + 0.5).clamp_(0, 255).to(torch.uint8)

    def restore(self, q: Tensor) -> Tensor:
        """Convert integers to float32 values."""
        return (q.float() - self.zero) * self.scales.view(-1, 1, 1)


class Convolution:
    """A quantized convolution, optionally with ReLU.

    Args:
        weight: ``(C', C, K, K)``.
        bias: ``(C',)``.
        given: quantization of the input.
        result: quantization of the result, with one scale for all channels; ``None`` for floating-point values.
        stride: in pixels.
        relu: whether a ReLU follows.
    """

    def __init__(
        self, weight: Tensor, bias: Tensor, given: Stored, result: Stored | None, stride: int = 1, *, relu: bool = True
    ) -> None:
        scale = float(given.scales.max())
        weight = weight.detach().float() * (given.scales / scale).view(1, -1, 1, 1)
        steps = weight.abs().amax((1, 2, 3)).clamp_min(1e-12) / 127
        rounded = (weight / steps.view(-1, 1, 1, 1)).round().to(torch.int8)
        self._given = scale, given.zero
        self._shape = [stride] * 2, [(weight.shape[-1] - 1) // 2] * 2, [1, 1], 1
        packed = torch.ops.onednn.qconv_prepack(rounded, steps, *self._given, *self._shape)
        self._weights = packed, steps, torch.zeros(len(weight), dtype=torch.int64), bias.detach().float()
        self._result = (1.0, 0) if result is None else (float(result.scales[0]), result.zero)
        self._relu = "relu" if relu else "none"

    def __call__(self, q: Tensor, dtype: torch.dtype = torch.uint8) -> Tensor:
        """Convolve integers ``(B, C, H, W)`` to integers, or to values of the dtype."""
        result: Tensor = torch.ops.onednn.qconv2d_pointwise(
            *(q, *self._given, *self._weights, *self._shape, *self._result, dtype, self._relu, [], "")
        )
        return result


class Int8UNet:
    """The levels of a :class:`mcdenoise.nn.UNet` in integers.

    Args:
        encoder: the two convolutions of each level, finest first.
        up: the 2x2 transposed convolutions, coarsest first.
        decoder: the two convolutions after each of these, coarsest first.
        ranges: ranges of the tensors, see :func:`measure`.

    Raises:
        ValueError: the number of ranges does not match the number of tensors.
    """

    def __init__(self, encoder: Layers, up: Layers, decoder: Layers, ranges: Tensor) -> None:
        blocks = [_convolutions(block) for block in encoder]
        channels = blocks[0][0].in_channels
        besides = [0, *(own[0].in_channels - before[1].out_channels for before, own in itertools.pairwise(blocks))]
        count = channels + sum(besides) + 5 * len(blocks) - 3
        if ranges.shape != (count, 2):
            raise ValueError(f"ranges: expected shape {(count, 2)}, found {tuple(ranges.shape)}")
        signed = bool((ranges[:channels, 0] < 0).any())
        self._input = given = Stored.over(ranges[:channels], channels, signed=signed)
        rest, skips = ranges[channels:], list[Stored]()
        self._coarse, self._encoder = list[Stored](), list[tuple[Convolution, ...]]()
        for level, (block, beside) in enumerate(zip(blocks, besides, strict=True)):
            if beside:
                self._coarse.append(Stored.over(rest[:beside], beside, signed=True))
                given, rest = given.beside(self._coarse[-1]), rest[beside:]
            # The upsampled features need the zero point of the features that they are concatenated with.
            pair, given = _block(block, given, rest[:2], signed=level < len(blocks) - 1)
            self._encoder.append(pair)
            skips.append(given)
            rest = rest[2:]
        self._features = [skips.pop()]
        self._decoder = list[tuple[Convolution, ...]]()
        for wide, own in zip(up, decoder, strict=True):
            assert isinstance(wide, nn.ConvTranspose2d)
            assert wide.bias is not None
            between = Stored.over(rest[:1], wide.out_channels, signed=True)
            # A 2x2 transposed convolution is a 1x1 convolution with four times the channels.
            weight = wide.weight.permute(2, 3, 1, 0).reshape(-1, wide.in_channels, 1, 1)
            first = Convolution(weight, wide.bias.repeat(4), self._features[-1], between, relu=False)
            pair, given = _block(_convolutions(own), between.beside(skips.pop()), rest[1:3], values=not skips)
            self._decoder.append((first, *pair))
            self._features.append(given)
            rest = rest[3:]

    def __call__(self, x: Tensor, coarse: Sequence[Tensor], count: int, dtype: torch.dtype) -> list[Tensor]:
        """Features of the finest levels, finest first.

        Args:
            x: ``(B, C, H, W)``, a multiple of the coarsest level's pixels in size.
            coarse: the additional input of each level but the finest, or nothing.
            count: number of levels to return.
            dtype: dtype of the features.
        """
        q, skips = self._input.store(x), []
        for level, (first, second) in enumerate(self._encoder):
            if level:
                q = max_pool(q)
            if level and coarse:
                q = torch.cat([q, self._coarse[level - 1].store(coarse[level - 1])], 1)
            q = second(first(q))
            skips.append(q)
        features = [skips.pop()]
        for up, first, second in self._decoder:
            q = torch.cat([_spread(up(q)), skips.pop()], 1)
            # The finest features are returned as values, because no integer convolution follows.
            q = second(first(q), torch.uint8 if skips else dtype)
            features.append(q)
        coarser = zip(features[-2::-1], self._features[-2::-1], strict=True)
        return [features[-1], *(stored.restore(q).to(dtype) for q, stored in coarser)][:count]


def measure(
    encoder: Layers,
    up: Layers,
    decoder: Layers,
    x: Tensor,
    coarse: Sequence[Tensor],
) -> Tensor:
    """Ranges ``(N, 2)`` of 0 and the values of each tensor for one input, in float32.

    The arguments are those of :class:`Int8UNet`.

    The order is that of the computation: each channel of the input; for each encoder level each channel of its
    additional input, and the results of its two convolutions; for each decoder level the results of all three.
    """
    found, skips = [_ranges(x)], list[Tensor]()
    for level, block in enumerate(encoder):
        if level:
            x = F.max_pool2d(x, 2)
        if level and coarse:
            found.append(_ranges(coarse[level - 1]))
            x = torch.cat([x, coarse[level - 1]], 1)
        for layer in _convolutions(block):
            x = F.relu(layer(x))
            found.append(union(_ranges(x)))
        skips.append(x)
    skips.pop()
    for wide, block in zip(up, decoder, strict=True):
        x = wide(x)
        found.append(union(_ranges(x)))
        x = torch.cat([x, skips.pop()], 1)
        for layer in _convolutions(block):
            x = F.relu(layer(x))
            found.append(union(_ranges(x)))
    return torch.cat(found)


def union(ranges: Tensor) -> Tensor:
    """Merge ``(N, 2)`` ranges into the ``(1, 2)`` range that contains all of them."""
    return torch.stack([ranges[:, 0].amin(), ranges[:, 1].amax()])[None]


def _ranges(x: Tensor) -> Tensor:
    """``(C, 2)``."""
    values = x.transpose(0, 1).flatten(1).sort(1).values
    beyond = round(values.shape[1] * _BEYOND)
    return torch.stack([values[:, beyond].clamp_max(0), values[:, -1 - beyond].clamp_min(0)], 1)


def _convolutions(block: nn.Module) -> list[nn.Conv2d]:
    return [layer for layer in block.modules() if isinstance(layer, nn.Conv2d)]


def _block(
    layers: Sequence[nn.Conv2d], given: Stored, ranges: Tensor, *, signed: bool = False, values: bool = False
) -> tuple[tuple[Convolution, Convolution], Stored]:
    """Two quantized convolutions, and the quantization of the result; ``values`` leaves the result unquantized."""
    first, second = layers
    assert first.bias is not None
    assert second.bias is not None
    middle = Stored.over(ranges[:1], first.out_channels, signed=False)
    result = Stored.over(ranges[1:], second.out_channels, signed=signed)
    pair = (
        Convolution(first.weight, first.bias, given, middle, first.stride[0]),
        Convolution(second.weight, second.bias, middle, None if values else result),
    )
    return pair, result


def _spread(q: Tensor) -> Tensor:
    """Reorder ``(B, 4 C, H, W)``, grouped by pixel of a 2x2 block, to ``(B, C, 2 H, 2 W)``; channels last."""
    batch, _, height, width = q.shape
    pixels = q.permute(0, 2, 3, 1).reshape(batch, height, width, 2, 2, -1).transpose(2, 3)
    return pixels.reshape(batch, 2 * height, 2 * width, -1).permute(0, 3, 1, 2)
