"""The numba backends of the steps between the convolutions of networks, as torch operators without derivatives.

They go row by row, each by a few vectorised loops: no argument is copied as a whole, whatever its layout and
precision, and of intermediate results only a few rows are stored.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mcdenoise.ops._constants import BLOCK, DARK, FARTHEST, SHORTEST
from mcdenoise.ops._numba._runtime import (
    compiled,
    exp,
    expm1,
    log,
    log1p,
    read_row,
    readable,
    rounded,
    share_rows,
    source,
)
from mcdenoise.ops._numba.fusion import downsample
from mcdenoise.ops._operator import custom_op
from mcdenoise.ops._window import accumulator_dtype, computing_dtype

# Pixels whose channels are gathered at a time: they stay in the second-level cache.
CHUNK = 1024


def network_input(image: Tensor, features: Tensor, logarithms: bool) -> Any:
    """See :func:`mcdenoise.ops._steps.network.network_input`."""
    dtype = computing_dtype(image)
    if torch.float16 in (image.dtype, features.dtype, dtype):
        return NotImplemented
    return _network_input(image, features, logarithms, dtype)


@custom_op(
    "mcdenoise::network_input",
    device_types="cpu",
    schema="(Tensor image, Tensor features, bool logarithms, ScalarType dtype) -> Tensor",
)
def _network_input(image: Tensor, features: Tensor, logarithms: bool, dtype: torch.dtype) -> Tensor:
    result = _empty_input(image, features, logarithms, dtype)
    if result.numel():
        sums = torch.promote_types(dtype, torch.float32)
        arguments = (source(result), source(readable(image, sums)), source(readable(features, sums)))
        buffer = np.empty((result.shape[1], CHUNK), torch.empty((), dtype=sums, device="cpu").numpy().dtype)
        share_rows(image, lambda *rows: _stack(*arguments, logarithms, np.empty_like(buffer), result.shape[3], *rows))
    return result


@_network_input.register_fake
def _empty_input(image: Tensor, features: Tensor, _: bool, dtype: torch.dtype) -> Tensor:
    batch, channels, height, width = image.shape
    shape = (batch, channels + features.shape[1], height, width)
    return torch.empty(shape, dtype=dtype, device=image.device, memory_format=torch.channels_last)


@compiled
def _stack(
    out: Any, image: Any, features: Any, logarithms: bool, rows: Any, width: int, b: int, first: int, last: int
) -> None:
    memory, strides, channels = out
    own, one = image[2], rows.dtype.type(1)
    bits = np.empty((channels, rows.shape[1]), memory.dtype)
    for y in range(first, last):
        for x0 in range(0, width, rows.shape[1]):
            n = min(rows.shape[1], width - x0)
            for c in range(own):
                read_row(rows[c, :n], image, b, c, y, x0)
                if logarithms:
                    _to_logarithms(rows[c, :n], one)
            for c in range(own, channels):
                read_row(rows[c, :n], features, b, c - own, y, x0)
            for c in range(channels):
                round_row(bits[c, :n], rows[c])
            start = b * strides[0] + y * strides[2] + x0 * strides[3]
            interleave(memory[start : start + n * channels], bits)


def buffers_input(
    image: Tensor,
    albedo: Tensor,
    normal: Tensor,
    depth: Tensor,
    current: Tensor,
    length: Tensor | None,
    exposure: Tensor,
    scale: tuple[Tensor, Tensor],
    logarithms: bool,
    image_factor: Tensor | None,
) -> Any:
    """See :func:`mcdenoise.ops._steps.network.buffers_input`."""
    dtype = computing_dtype(image)
    if torch.float16 in (image.dtype, albedo.dtype, dtype):
        return NotImplemented
    buffers = (albedo, normal, depth, current, length, exposure, *scale)
    return _buffers_input(image, *buffers, image_factor, logarithms, dtype)


@custom_op(
    "mcdenoise::buffers_input",
    device_types="cpu",
    schema="(Tensor image, Tensor albedo, Tensor normal, Tensor depth, Tensor current, Tensor? length, "
    "Tensor exposure, Tensor near, Tensor typical, Tensor? image_factor, bool logarithms, ScalarType dtype) "
    "-> Tensor",
)
def _buffers_input(
    image: Tensor,
    albedo: Tensor,
    normal: Tensor,
    depth: Tensor,
    current: Tensor,
    length: Tensor | None,
    exposure: Tensor,
    near: Tensor,
    typical: Tensor,
    image_factor: Tensor | None,
    logarithms: bool,
    dtype: torch.dtype,
) -> Tensor:
    batch, _, height, width = image.shape
    result = torch.empty((batch, 14, height, width), dtype=dtype, memory_format=torch.channels_last, device="cpu")
    if result.numel():
        sums = torch.promote_types(dtype, torch.float32)
        nothing = source(torch.empty((0, 0, 0, 0), dtype=sums, device="cpu"))
        images = tuple(source(readable(buffer, sums)) for buffer in (image, albedo, normal, depth, current))
        lengths = nothing if length is None else source(readable(length, sums))
        factor = torch.ones_like(exposure) if image_factor is None else image_factor
        factors = torch.cat([each.to(sums).expand(batch, 1, 1, 1) for each in (exposure, near, typical, factor)], 1)
        buffer = np.empty((14, CHUNK), factors.numpy().dtype)
        arguments = (source(result), images, lengths, factors.flatten(1).numpy(), logarithms)
        share_rows(image, lambda *rows: _stack_buffers(*arguments, np.empty_like(buffer), width, *rows))
    return result


@_buffers_input.register_fake
def _(image: Tensor, *arguments: Any) -> Tensor:
    batch, _, height, width = image.shape
    shape = (batch, 14, height, width)
    return torch.empty(shape, dtype=arguments[-1], device=image.device, memory_format=torch.channels_last)


@compiled
def _stack_buffers(
    out: Any,
    images: Any,
    length: Any,
    factors: Any,
    logarithms: bool,
    rows: Any,
    width: int,
    b: int,
    first: int,
    last: int,
) -> None:
    image, albedo, normal, depth, current = images
    memory, strides, channels = out
    exposure, near, typical, factor = factors[b]
    half, one = rows.dtype.type(0.5), rows.dtype.type(1)
    bits = np.empty((channels, rows.shape[1]), memory.dtype)
    for y in range(first, last):
        for x0 in range(0, width, rows.shape[1]):
            n = min(rows.shape[1], width - x0)
            for c in range(3):
                row = rows[c, :n]
                read_row(row, image, b, c, y, x0)
                if logarithms:
                    _to_logarithms(row, factor)
                else:
                    for x in range(n):
                        row[x] *= factor
                read_row(rows[3 + c, :n], albedo, b, c, y, x0)
                row = rows[6 + c, :n]
                read_row(row, normal, b, c, y, x0)
                for x in range(n):
                    row[x] = row[x] * half + half
                row = rows[10 + c, :n]
                read_row(row, current, b, c, y, x0)
                _to_logarithms(row, exposure)
            row = rows[9, :n]
            read_row(row, depth, b, 0, y, x0)
            _normalize(row, near, typical)
            row = rows[13, :n]
            if length[2]:
                read_row(row, length, b, 0, y, x0)
                for x in range(n):
                    row[x] = one / row[x]
            else:
                row[:] = one
            for c in range(channels):
                round_row(bits[c, :n], rows[c])
            start = b * strides[0] + y * strides[2] + x0 * strides[3]
            interleave(memory[start : start + n * channels], bits)


def network_guides(normal: Tensor, depth: Tensor, scale: tuple[Tensor, Tensor]) -> Any:
    """See :func:`mcdenoise.ops._steps.network.network_guides`."""
    if normal.dtype not in (torch.float32, torch.float64):
        return NotImplemented
    return _network_guides(normal, depth, *scale)


@custom_op(
    "mcdenoise::network_guides",
    device_types="cpu",
    schema="(Tensor normal, Tensor depth, Tensor near, Tensor typical) -> Tensor",
)
def _network_guides(normal: Tensor, depth: Tensor, near: Tensor, typical: Tensor) -> Tensor:
    result = _empty_guides(normal)
    if result.numel():
        images = tuple(source(image.to(result.dtype)) for image in (normal, depth))
        factors = torch.cat([each.to(result.dtype).expand(len(normal), 1, 1, 1) for each in (near, typical)], 1)
        scales = factors.flatten(1).numpy()
        share_rows(normal, lambda *rows: _guide(result.numpy(), *images, scales, *rows), light=True)
    return result


@_network_guides.register_fake
def _empty_guides(normal: Tensor, *_: Any) -> Tensor:
    return normal.new_empty((normal.shape[0], 4, *normal.shape[2:]))


@compiled
def _guide(out: Any, normal: Any, depth: Any, scales: Any, b: int, first: int, last: int) -> None:
    half = out.dtype.type(0.5)
    near, typical = scales[b]
    for y in range(first, last):
        for c in range(3):
            row = out[b, c, y]
            read_row(row, normal, b, c, y, 0)
            for x in range(row.size):
                row[x] = row[x] * half + half
        read_row(out[b, 3, y], depth, b, 0, y, 0)
        _normalize(out[b, 3, y], near, typical)


@compiled
def _to_logarithms(values: Any, factor: Any) -> None:
    for x in range(values.size):
        values[x] = log1p(values[x] * factor)


@compiled
def round_row(bits: Any, values: Any) -> None:
    for x in range(bits.size):
        bits[x] = rounded(values[x], bits)


@compiled
def interleave(pixels: Any, rows: Any) -> None:
    """Rows of channels to pixels with their channels side by side."""
    channels = rows.shape[0]
    n = pixels.size // channels
    for c in range(channels):
        row = rows[c]
        for x in range(n):
            pixels[x * channels + c] = row[x]


def network_features(
    albedo: Tensor,
    normal: Tensor,
    depth: Tensor,
    current: Tensor,
    length: Tensor | None,
    exposure: Tensor,
    scale: tuple[Tensor, Tensor],
) -> Any:
    """See :func:`mcdenoise.ops._steps.network.network_features`."""
    if albedo.dtype not in (torch.float32, torch.float64):
        return NotImplemented
    return _network_features(albedo, normal, depth, current, length, exposure, *scale)


@custom_op(
    "mcdenoise::network_features",
    device_types="cpu",
    schema="(Tensor albedo, Tensor normal, Tensor depth, Tensor current, Tensor? length, Tensor exposure, "
    "Tensor near, Tensor typical) -> Tensor",
)
def _network_features(
    albedo: Tensor,
    normal: Tensor,
    depth: Tensor,
    current: Tensor,
    length: Tensor | None,
    exposure: Tensor,
    near: Tensor,
    typical: Tensor,
) -> Tensor:
    result = _empty_features(albedo)
    if result.numel():
        nothing = source(torch.empty((0, 0, 0, 0), dtype=result.dtype, device="cpu"))
        images = tuple(source(image.to(result.dtype)) for image in (albedo, normal, depth, current))
        lengths = nothing if length is None else source(length.to(result.dtype))
        factors = torch.cat([exposure, near, typical], 1).to(result.dtype).flatten(1).numpy()
        share_rows(albedo, lambda *rows: _assemble(result.numpy(), images, lengths, factors, *rows))
    return result


@_network_features.register_fake
def _empty_features(albedo: Tensor, *_: Any) -> Tensor:
    return albedo.new_empty((albedo.shape[0], 11, *albedo.shape[2:]))


@compiled
def _assemble(out: Any, images: Any, length: Any, factors: Any, b: int, first: int, last: int) -> None:
    albedo, normal, depth, current = images
    half, one = out.dtype.type(0.5), out.dtype.type(1)
    exposure, near, typical = factors[b]
    for y in range(first, last):
        for c in range(3):
            read_row(out[b, c, y], albedo, b, c, y, 0)
            row = out[b, 3 + c, y]
            read_row(row, normal, b, c, y, 0)
            for x in range(row.size):
                row[x] = row[x] * half + half
            row = out[b, 7 + c, y]
            read_row(row, current, b, c, y, 0)
            _to_logarithms(row, exposure)
        row = out[b, 6, y]
        read_row(row, depth, b, 0, y, 0)
        _normalize(row, near, typical)
        row = out[b, 10, y]
        if length[2]:
            read_row(row, length, b, 0, y, 0)
            for x in range(row.size):
                row[x] = one / row[x]
        else:
            row[:] = one


@compiled
def _normalize(depths: Any, near: Any, typical: Any) -> None:
    shortest, infinity, one = depths.dtype.type(SHORTEST), depths.dtype.type(np.inf), depths.dtype.type(1)
    longest = one / shortest
    for x in range(depths.size):
        depth = depths[x]
        in_units = min(max(depth / near, shortest), longest)
        depths[x] = in_units / (in_units + typical) if depth < infinity else one


@custom_op("mcdenoise::depth_scale", device_types="cpu", schema="(Tensor depth) -> (Tensor, Tensor)")
def depth_scale(depth: Tensor) -> tuple[Tensor, Tensor]:
    """See :func:`mcdenoise.ops._steps.network.depth_scale`."""
    batch, _, height, _ = depth.shape
    dtype = accumulator_dtype(depth.dtype)
    image = source(readable(depth, dtype))
    rows = torch.zeros((2, batch, height), dtype=dtype, device="cpu")
    arguments = (rows.numpy(), image, depth.shape[3])
    share_rows(depth, lambda *fraction: _roots_of_rows(*arguments, *fraction), light=True)
    root = _mean(rows)
    near = torch.where(root > 0, 1 / root.square(), 1).to(dtype)
    share_rows(depth, lambda *fraction: _logarithms_of_rows(*arguments, near.numpy(), *fraction), light=True)
    return near.reshape(batch, 1, 1, 1), torch.exp(_mean(rows)).to(dtype).reshape(batch, 1, 1, 1)


def _mean(rows: Tensor) -> Tensor:
    """The mean of each image, from the sums and the numbers of summands of its rows."""
    totals = rows.double().sum(2)
    return totals[0] / totals[1].clamp_min(1)


@depth_scale.register_fake
def _(depth: Tensor) -> tuple[Tensor, Tensor]:
    near = depth.new_empty((depth.shape[0], 1, 1, 1), dtype=accumulator_dtype(depth.dtype))
    return near, torch.empty_like(near)


@compiled
def _roots_of_rows(out: Any, depth: Any, width: int, b: int, first: int, last: int) -> None:
    row = np.empty(width, out.dtype)
    zero, one, infinity = out.dtype.type(0), out.dtype.type(1), out.dtype.type(np.inf)
    shortest = out.dtype.type(SHORTEST)
    for y in range(first, last):
        read_row(row, depth, b, 0, y, 0)
        count = 0
        for x in range(width):
            known = (row[x] >= shortest) & (row[x] < infinity)
            count += known
            row[x] = one / math.sqrt(row[x] if known else one) if known else zero
        out[0, b, y] = _sum(row)
        out[1, b, y] = count


@compiled
def _sum(values: Any) -> Any:
    """In eight parts, which LLVM adds side by side."""
    parts = np.zeros(8, values.dtype)
    whole = values.size // 8 * 8
    for x in range(0, whole, 8):
        for k in range(8):
            parts[k] += values[x + k]
    for x in range(whole, values.size):
        parts[0] += values[x]
    return parts.sum()


@compiled
def _logarithms_of_rows(out: Any, depth: Any, width: int, near: Any, b: int, first: int, last: int) -> None:
    row, unit, zero = np.empty(width, out.dtype), near[b], out.dtype.type(0)
    infinity, shortest, farthest = out.dtype.type(np.inf), out.dtype.type(SHORTEST), out.dtype.type(FARTHEST)
    for y in range(first, last):
        read_row(row, depth, b, 0, y, 0)
        count = 0
        for x in range(width):
            in_units = max(row[x] / unit, shortest)
            known = (row[x] < infinity) & (in_units <= farthest)
            count += known
            row[x] = log(in_units) if known else zero
        out[0, b, y] = _sum(row)
        out[1, b, y] = count


@custom_op("mcdenoise::softplus", device_types="cpu", schema="(Tensor x, float[] units) -> Tensor")
def softplus(x: Tensor, units: list[float]) -> Tensor:
    """See :func:`mcdenoise.ops._steps.network.softplus`."""
    result = _empty_planes(x)
    if result.numel():
        arguments = (result.numpy(), source(readable(x, result.dtype)), result.new_tensor(units).numpy())
        share_rows(x, lambda *rows: _softplus_rows(*arguments, *rows), light=True)
    return result


@softplus.register_fake
def _empty_planes(x: Tensor, *_: Any) -> Tensor:
    return x.new_empty(x.shape, dtype=accumulator_dtype(x.dtype))


@compiled
def _softplus_rows(out: Any, x: Any, units: Any, b: int, first: int, last: int) -> None:
    for y in range(first, last):
        for c in range(out.shape[1]):
            row = out[b, c, y]
            read_row(row, x, b, c, y, 0)
            zero = row.dtype.type(0)
            for i in range(row.size):
                row[i] = units[c] * (max(row[i], zero) + log1p(exp(-abs(row[i]))))


@custom_op(
    "mcdenoise::gated_fusion",
    device_types="cpu",
    schema="(Tensor fine, Tensor coarse, Tensor weight, Tensor bias, Tensor? residual, Tensor? maximum, "
    "bool logarithms) -> Tensor",
)
def gated_fusion(
    fine: Tensor,
    coarse: Tensor,
    weight: Tensor,
    bias: Tensor,
    residual: Tensor | None,
    maximum: Tensor | None,
    logarithms: bool,
) -> Tensor:
    """See :func:`mcdenoise.ops._steps.network.gated_fusion`."""
    result = _empty_planes(fine)
    dtype = result.dtype
    if result.numel():
        nothing = source(torch.empty((0, 0, 0, 0), dtype=dtype, device="cpu"))
        limits = (
            torch.empty(0, dtype=dtype, device="cpu")
            if maximum is None
            else maximum.to(dtype).expand(len(fine), 1, 1, 1).flatten()
        )
        arguments = (
            result.numpy(),
            source(readable(fine, dtype)),
            nothing if residual is None else source(readable(residual, dtype)),
            source(readable(coarse, dtype)),
            weight.detach().to(dtype).contiguous().numpy(),
            bias.detach().to(dtype).numpy(),
            limits.numpy(),
            logarithms,
        )
        share_rows(fine, lambda *rows: _fuse(*arguments, *rows))
    return result


@gated_fusion.register_fake
def _(fine: Tensor, *_: Any) -> Tensor:
    return _empty_planes(fine)


@compiled
def _fuse(
    out: Any,
    fine: Any,
    residual: Any,
    coarse: Any,
    weight: Any,
    bias: Any,
    maximum: Any,
    logarithms: bool,
    b: int,
    first: int,
    last: int,
) -> None:
    """Rows ``first`` to ``last`` of the result, two at a time: they share the blocks whose mean is exchanged."""
    _, channels, height, width = out.shape
    dtype = out.dtype
    # Four rows of both images, the coarse one upsampled, with the zeros of the convolution around them.
    ring = np.zeros((4, 2 * channels, width + 2), dtype)
    alpha, change = np.empty(width, dtype), np.empty((channels, width), dtype)
    half = np.empty((width + 1) // 2, dtype)
    above, below = np.empty(width, dtype), np.empty(width, dtype)
    begin = first // 2 * 2
    for y in range(begin, last, 2):
        for row in range(y - 1 if y == begin else y + 1, y + 3):
            _fetch_both(ring[row % 4], fine, logarithms, residual, coarse, half, change[0], b, row, height)
        for c in range(channels):
            upper = ring[y % 4, c, 1 : width + 1]
            lower = ring[(y + 1 if y + 1 < height else y) % 4, c, 1 : width + 1]
            low = ring[y % 4, channels + c, 1 : width + 1]
            if logarithms:
                # The logarithms are those of means of radiance, which is read once more.
                read_row(above, fine, b, c, y, 0)
                read_row(below, fine, b, c, min(y + 1, height - 1), 0)
                _mean_of_blocks(half, above, below)
                _to_logarithms(half, dtype.type(1))
                _double(change[c], half)
            else:
                _mean_of_blocks(half, upper, lower)
                _double(change[c], half)
            for x in range(width):
                change[c, x] = low[x] - change[c, x]
        for row in range(max(y, first), min(y + 2, last)):
            alpha[:] = bias[0]
            for dy in range(3):
                rows = ring[(row + dy - 1) % 4]
                for c in range(2 * channels):
                    _correlate(alpha, rows[c], weight[0, c, dy])
            _sigmoid(alpha)
            for c in range(channels):
                values = out[b, c, row]
                _add_fraction(values, ring[row % 4, c, 1 : width + 1], alpha, change[c])
                if maximum.size:
                    _to_radiance(values, maximum[b])


@compiled
def _fetch_both(
    rows: Any,
    fine: Any,
    logarithms: bool,
    residual: Any,
    coarse: Any,
    half: Any,
    buffer: Any,
    b: int,
    y: int,
    height: int,
) -> None:
    """Row ``y`` of the fine and of the upsampled coarse image; zeros beyond the image."""
    channels, width = fine[2], buffer.size
    if y < 0 or y >= height:
        rows[:] = 0
        return
    for c in range(channels):
        row = rows[c, 1 : width + 1]
        read_row(row, fine, b, c, y, 0)
        if logarithms:
            _to_logarithms(row, row.dtype.type(1))
        if residual[2]:
            read_row(buffer, residual, b, c, y, 0)
            for x in range(width):
                row[x] += buffer[x]
        read_row(half, coarse, b, c, y // 2, 0)
        _double(rows[channels + c, 1 : width + 1], half)


@compiled
def _double(row: Any, half: Any) -> None:
    """Each number twice, and the last of an odd row once."""
    for x in range(row.size // 2):
        row[2 * x] = half[x]
        row[2 * x + 1] = half[x]
    if row.size % 2:
        row[row.size - 1] = half[half.size - 1]


@compiled
def _mean_of_blocks(mean: Any, upper: Any, lower: Any) -> None:
    """Means of 2x2 pixels of two rows; of two pixels in the last column where the width is odd."""
    quarter, half, width = mean.dtype.type(0.25), mean.dtype.type(0.5), upper.size
    for x in range(width // 2):
        mean[x] = (upper[2 * x] + upper[2 * x + 1] + lower[2 * x] + lower[2 * x + 1]) * quarter
    if width % 2:
        mean[width // 2] = (upper[width - 1] + lower[width - 1]) * half


@compiled
def _correlate(total: Any, row: Any, weights: Any) -> None:
    left, centre, right = weights
    for x in range(total.size):
        total[x] += left * row[x] + centre * row[x + 1] + right * row[x + 2]


@compiled
def _sigmoid(values: Any) -> None:
    one = values.dtype.type(1)
    for x in range(values.size):
        values[x] = one / (one + exp(-values[x]))


@compiled
def _add_fraction(out: Any, values: Any, fraction: Any, change: Any) -> None:
    for x in range(out.size):
        out[x] = values[x] + fraction[x] * change[x]


@compiled
def _to_radiance(values: Any, maximum: Any) -> None:
    zero = values.dtype.type(0)
    for x in range(values.size):
        # A comparison with a NaN is false, and the NaN stays.
        value = zero if values[x] < zero else values[x]
        values[x] = expm1(maximum if value > maximum else value)


def low_frequencies_of(fine: Tensor, coarse: Tensor, maximum: Tensor, exposure: Tensor | None) -> Tensor:
    """See :func:`mcdenoise.ops._steps.network.low_frequencies_of`."""
    means, most = downsample(fine), torch.expm1(maximum)
    for _ in range(BLOCK.bit_length() - 2):
        means, coarse = downsample(means), downsample(coarse)
    if exposure is not None:
        means, coarse, most = means * exposure, coarse * exposure, most / exposure
    result: Tensor = _low_frequencies_of(fine, means, coarse, most, DARK)
    return result


@custom_op(
    "mcdenoise::low_frequencies_of",
    device_types="cpu",
    schema="(Tensor fine, Tensor means, Tensor coarse, Tensor most, float dark) -> Tensor",
)
def _low_frequencies_of(fine: Tensor, means: Tensor, coarse: Tensor, most: Tensor, dark: float) -> Tensor:
    """With ``means`` and ``coarse`` of blocks."""
    result = _empty_planes(fine)
    dtype = result.dtype
    if result.numel():
        blocks = [image.to(dtype).contiguous().numpy() for image in (means, coarse)]
        limits = most.to(dtype).expand(len(fine), 1, 1, 1).flatten()
        settings = limits.new_tensor([dark]).numpy()
        arguments = (result.numpy(), source(readable(fine, dtype)), *blocks, limits.numpy(), *settings)
        share_rows(fine, lambda *rows: _replace_means(*arguments, *rows), light=True)
    return result


@_low_frequencies_of.register_fake
def _(fine: Tensor, *_: Any) -> Tensor:
    return _empty_planes(fine)


@compiled
def _replace_means(
    out: Any, fine: Any, means: Any, coarse: Any, most: Any, dark: float, b: int, first: int, last: int
) -> None:
    _, channels, _, width = out.shape
    _, _, rows, columns = means.shape
    number = out.dtype.type
    found, wanted = np.empty(columns, out.dtype), np.empty(columns, out.dtype)
    left, right = np.empty(width, np.int64), np.empty(width, np.int64)
    fraction = np.empty(width, out.dtype)
    for x in range(width):
        left[x], right[x], fraction[x] = _between_blocks(x, columns, number(0))
    for y in range(first, last):
        upper, lower, part = _between_blocks(y, rows, number(0))
        for c in range(channels):
            for x in range(columns):
                found[x] = means[b, c, upper, x] + part * (means[b, c, lower, x] - means[b, c, upper, x]) + dark
                wanted[x] = coarse[b, c, upper, x] + part * (coarse[b, c, lower, x] - coarse[b, c, upper, x]) + dark
            row, limit = out[b, c, y], most[b]
            read_row(row, fine, b, c, y, 0)
            for x in range(width):
                i, k, s = left[x], right[x], fraction[x]
                new, old = wanted[i] + s * (wanted[k] - wanted[i]), found[i] + s * (found[k] - found[i])
                row[x] = min(row[x] * (new / old), limit)


@compiled
def _between_blocks(pixel: int, blocks: int, zero: Any) -> Any:
    """The blocks on both sides of a pixel's centre, and how far it is on the way to the second."""
    doubled = 2 * pixel + 1 - BLOCK
    if doubled < 0:
        return 0, 0, zero
    first = doubled // (2 * BLOCK)
    return first, min(first + 1, blocks - 1), type(zero)((doubled - 2 * BLOCK * first) / (2 * BLOCK))
