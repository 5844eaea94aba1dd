"""The steps between the convolutions of networks, one pass each, without derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
import triton
import triton.language as tl
from torch import Tensor

from mcdenoise.ops._constants import BLOCK, DARK, FARTHEST, SHORTEST
from mcdenoise.ops._operator import custom_op
from mcdenoise.ops._triton._images import (
    expm1,
    is_finite,
    is_inside,
    launch,
    log1p,
    read_plane,
    sums_of,
    tile,
    write_plane,
)
from mcdenoise.ops._window import accumulator_dtype, computing_dtype

_SHORTEST, _FARTHEST = tl.constexpr(SHORTEST), tl.constexpr(FARTHEST)
_BLOCK, _DARK = tl.constexpr(BLOCK), tl.constexpr(DARK)
# Programs of an image, whose threads each add up their pixels, and pixels that a program has at a time.
_PROGRAMS, _LANES = 64, 128


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
) -> Tensor:
    """See :func:`mcdenoise.ops._steps.network.buffers_input`."""
    dtype = computing_dtype(image)
    buffers = (albedo, normal, depth, current, length, exposure, *scale)
    result: Tensor = _buffers_input(image, *buffers, image_factor, logarithms, dtype)
    return result


@custom_op(
    "mcdenoise::triton_buffers_input",
    schema="(Tensor image, Tensor albedo, Tensor normal, Tensor depth, Tensor current, Tensor? length, "
    "Tensor exposure, Tensor near, Tensor typical, Tensor? image_factor, bool logarithms, ScalarType dtype) "
    "-> Tensor",
)
def _buffers_input(image: Tensor, *given: Any) -> Tensor:
    *buffers, logarithms, dtype = given
    result = _empty_input(image, dtype)
    sums = sums_of(image, *buffers)
    given_too = {"LENGTH": buffers[4] is not None, "FACTOR": buffers[-1] is not None}
    launch(_stack_buffers, image, sums, result, image, *buffers, LOGARITHMS=logarithms, **given_too)
    return result


@_buffers_input.register_fake
def _(image: Tensor, *given: Any) -> Tensor:
    return _empty_input(image, given[-1])


def _empty_input(image: Tensor, dtype: torch.dtype) -> Tensor:
    batch, _, height, width = image.shape
    shape = (batch, 14, height, width)
    return torch.empty(shape, dtype=dtype, device=image.device, memory_format=torch.channels_last)


@triton.jit
def _normalized(depth: tl.tensor, near: tl.tensor, typical: tl.tensor) -> tl.tensor:
    """See :func:`mcdenoise.ops._steps.network.normalized_depth`."""
    hit = is_finite(depth)
    in_units = tl.minimum(tl.maximum(tl.where(hit, depth, 1) / near, _SHORTEST), 1 / _SHORTEST)
    return tl.where(hit, in_units / (in_units + typical), 1)


@triton.jit
def _stack_buffers(
    out: tl.tuple,
    image: tl.tuple,
    albedo: tl.tuple,
    normal: tl.tuple,
    depth: tl.tuple,
    current: tl.tuple,
    length: tl.tuple,
    exposure: tl.tuple,
    near: tl.tuple,
    typical: tl.tuple,
    factor: tl.tuple,
    height: tl.tensor,
    width: tl.tensor,
    LOGARITHMS: tl.constexpr,
    LENGTH: tl.constexpr,
    FACTOR: tl.constexpr,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
    WIDE: tl.constexpr,
    SUM: tl.constexpr,
) -> None:
    b, y, x = tile(0, ROWS, COLUMNS, WIDE)
    mine = is_inside(y, x, height, width)
    exposed = read_plane(exposure, b, 0, y * 0, x * 0, mine, SUM)
    # Factors beyond the image are zeros, which nothing is divided by.
    unit = read_plane(near, b, 0, y * 0, x * 0, mine, SUM)
    unit = tl.where(mine, unit, 1)
    far = read_plane(typical, b, 0, y * 0, x * 0, mine, SUM)
    scaled = read_plane(factor, b, 0, y * 0, x * 0, mine, SUM) if FACTOR else 1.0
    for c in tl.static_range(3):
        value = read_plane(image, b, c, y, x, mine, SUM) * scaled
        write_plane(out, log1p(value) if LOGARITHMS else value, b, c, y, x, mine)
        write_plane(out, read_plane(albedo, b, c, y, x, mine, SUM), b, 3 + c, y, x, mine)
        write_plane(out, read_plane(normal, b, c, y, x, mine, SUM) * 0.5 + 0.5, b, 6 + c, y, x, mine)
        write_plane(out, log1p(read_plane(current, b, c, y, x, mine, SUM) * exposed), b, 10 + c, y, x, mine)
    write_plane(out, _normalized(read_plane(depth, b, 0, y, x, mine, SUM), unit, far), b, 9, y, x, mine)
    fraction = tl.zeros_like(exposed) + 1
    if LENGTH:
        fraction = 1 / tl.where(mine, read_plane(length, b, 0, y, x, mine, SUM), 1)
    write_plane(out, fraction, b, 13, y, x, mine)


def network_guides(normal: Tensor, depth: Tensor, scale: tuple[Tensor, Tensor]) -> Tensor:
    """See :func:`mcdenoise.ops._steps.network.network_guides`."""
    result: Tensor = _network_guides(normal, depth, *scale)
    return result


@custom_op(
    "mcdenoise::triton_network_guides",
    schema="(Tensor normal, Tensor depth, Tensor near, Tensor typical) -> Tensor",
)
def _network_guides(normal: Tensor, depth: Tensor, near: Tensor, typical: Tensor) -> Tensor:
    result = _empty_guides(normal)
    launch(_guide, normal, sums_of(normal, depth, near, typical), result, normal, depth, near, typical)
    return result


@_network_guides.register_fake
def _empty_guides(normal: Tensor, *_: Any) -> Tensor:
    return normal.new_empty((normal.shape[0], 4, *normal.shape[2:]))


@triton.jit
def _guide(
    out: tl.tuple,
    normal: tl.tuple,
    depth: tl.tuple,
    near: tl.tuple,
    typical: tl.tuple,
    height: tl.tensor,
    width: tl.tensor,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
    WIDE: tl.constexpr,
    SUM: tl.constexpr,
) -> None:
    b, y, x = tile(0, ROWS, COLUMNS, WIDE)
    mine = is_inside(y, x, height, width)
    for c in tl.static_range(3):
        write_plane(out, read_plane(normal, b, c, y, x, mine, SUM) * 0.5 + 0.5, b, c, y, x, mine)
    unit = tl.where(mine, read_plane(near, b, 0, y * 0, x * 0, mine, SUM), 1)
    far = read_plane(typical, b, 0, y * 0, x * 0, mine, SUM)
    write_plane(out, _normalized(read_plane(depth, b, 0, y, x, mine, SUM), unit, far), b, 3, y, x, mine)


def depth_scale(depth: Tensor) -> tuple[Tensor, Tensor]:
    """See :func:`mcdenoise.ops._steps.network.depth_scale`."""
    result: tuple[Tensor, Tensor] = _depth_scale(depth)
    return result


@custom_op("mcdenoise::triton_depth_scale", schema="(Tensor depth) -> (Tensor, Tensor)")
def _depth_scale(depth: Tensor) -> tuple[Tensor, Tensor]:
    dtype = accumulator_dtype(depth.dtype)
    root = _mean(depth, torch.ones((len(depth), 1, 1, 1), dtype=dtype, device=depth.device), logarithms=False)
    near = torch.where(root > 0, 1 / torch.where(root > 0, root, 1).square(), 1)
    return near, torch.exp(_mean(depth, near, logarithms=True))


@_depth_scale.register_fake
def _(depth: Tensor) -> tuple[Tensor, Tensor]:
    near = depth.new_empty((len(depth), 1, 1, 1), dtype=accumulator_dtype(depth.dtype))
    return near, torch.empty_like(near)


def _mean(depth: Tensor, near: Tensor, *, logarithms: bool) -> Tensor:
    """The mean of ``1 / sqrt(d)``, or of the logarithms of depths in units of the near one, over each image's hits."""
    batch, _, height, width = depth.shape
    programs = max(min(_PROGRAMS, triton.cdiv(height * width, _LANES)), 1)
    # Each thread has its own sums: a shared sum would depend on the order of the threads.
    parts = near.new_zeros((batch, 2, programs * _LANES))
    if depth.numel():
        strides = depth.stride()
        with torch.cuda.device_of(depth):
            _add_up[programs, batch](
                depth.detach(),
                (strides[0], strides[2], strides[3]),
                near,
                parts,
                height * width,
                width,
                LOGARITHMS=logarithms,
                LANES=_LANES,
                PROGRAMS=programs,
                SUM=tl.float64 if near.dtype == torch.float64 else tl.float32,
            )
    total, count = parts.sum(2).unbind(1)
    return (total / count.clamp_min(1)).reshape(-1, 1, 1, 1)


@triton.jit
def _add_up(
    depth: tl.tensor,
    strides: tl.tuple,
    near: tl.tensor,
    parts: tl.tensor,
    pixels: tl.tensor,
    width: tl.tensor,
    LOGARITHMS: tl.constexpr,
    LANES: tl.constexpr,
    PROGRAMS: tl.constexpr,
    SUM: tl.constexpr,
) -> None:
    b, lane = tl.program_id(1).to(tl.int64), tl.arange(0, LANES)
    first = tl.program_id(0) * LANES
    total, count = tl.zeros([LANES], SUM), tl.zeros([LANES], SUM)
    unit = tl.load(near + b)
    for start in range(first, pixels, PROGRAMS * LANES):
        pixel = start + lane
        y, x = (pixel // width).to(tl.int64), (pixel % width).to(tl.int64)
        mine = pixel < pixels
        d = tl.load(depth + b * strides[0] + y * strides[1] + x * strides[2], mask=mine, other=0).to(SUM)
        hit = mine & is_finite(d)
        if LOGARITHMS:
            in_units = tl.minimum(tl.maximum(tl.where(hit, d, 1) / unit, _SHORTEST), 1 / _SHORTEST)
            counts = hit & (in_units <= _FARTHEST)
            value = tl.log(tl.where(counts, in_units, 1))
        else:
            counts = hit & (d >= _SHORTEST)
            value = 1 / tl.sqrt(tl.where(counts, d, 1))
        total += tl.where(counts, value, 0)
        count += counts.to(SUM)
    own = parts + b * (2 * PROGRAMS * LANES) + first + lane
    tl.store(own, total)
    tl.store(own + PROGRAMS * LANES, count)


def gated_fusion(
    fine: Tensor,
    coarse: Tensor,
    weight: Tensor,
    bias: Tensor,
    residual: Tensor | None,
    maximum: Tensor | None,
    logarithms: bool,
) -> Any:
    """See :func:`mcdenoise.ops._steps.network.gated_fusion`."""
    if logarithms and residual is not None:
        return NotImplemented
    return _gated_fusion(fine, coarse, weight, bias, residual, maximum, logarithms)


@custom_op(
    "mcdenoise::triton_gated_fusion",
    schema="(Tensor fine, Tensor coarse, Tensor weight, Tensor bias, Tensor? residual, Tensor? maximum, "
    "bool logarithms) -> Tensor",
)
def _gated_fusion(
    fine: Tensor,
    coarse: Tensor,
    weight: Tensor,
    bias: Tensor,
    residual: Tensor | None,
    maximum: Tensor | None,
    logarithms: bool,
) -> Tensor:
    result = _empty_fused(fine, coarse, weight, bias, residual)
    channels = fine.shape[1]
    # As images of one pixel, the same for every image of a batch.
    weights = torch.cat([weight.flatten(), bias]).reshape(1, -1, 1, 1).expand(len(fine), -1, 1, 1)
    launch(
        _fuse,
        fine,
        sums_of(fine, coarse, residual),
        *(result, fine, coarse, weights, residual, maximum),
        CHANNELS=channels,
        RESIDUAL=residual is not None,
        MAXIMUM=maximum is not None,
        LOGARITHMS=logarithms,
    )
    return result


@_gated_fusion.register_fake
def _empty_fused(fine: Tensor, coarse: Tensor, weight: Tensor, bias: Tensor, residual: Any, *_: Any) -> Tensor:
    return torch.empty(fine.shape, dtype=sums_of(fine, residual), device=fine.device)


@triton.jit
def _detail(
    fine: tl.tuple,
    residual: tl.tuple,
    b: tl.tensor,
    c: tl.tensor,
    y: tl.tensor,
    x: tl.tensor,
    inside: tl.tensor,
    RESIDUAL: tl.constexpr,
    LOGARITHMS: tl.constexpr,
    SUM: tl.constexpr,
) -> tl.tensor:
    value = read_plane(fine, b, c, y, x, inside, SUM)
    if RESIDUAL:
        value += read_plane(residual, b, c, y, x, inside, SUM)
    if LOGARITHMS:
        value = log1p(value)
    return value


@triton.jit
def _fuse(
    out: tl.tuple,
    fine: tl.tuple,
    coarse: tl.tuple,
    weights: tl.tuple,
    residual: tl.tuple,
    maximum: tl.tuple,
    height: tl.tensor,
    width: tl.tensor,
    CHANNELS: tl.constexpr,
    RESIDUAL: tl.constexpr,
    MAXIMUM: tl.constexpr,
    LOGARITHMS: tl.constexpr,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
    WIDE: tl.constexpr,
    SUM: tl.constexpr,
) -> None:
    b, y, x = tile(0, ROWS, COLUMNS, WIDE)
    mine = is_inside(y, x, height, width)
    exponent = read_plane(weights, b, 18 * CHANNELS, y * 0, x * 0, mine, SUM)
    for tap in range(9):
        dy, dx = tap // 3 - 1, tap % 3 - 1
        there_y, there_x = y + dy, x + dx
        inside = mine & is_inside(there_y, there_x, height, width)
        for c in tl.static_range(CHANNELS):
            detail = _detail(fine, residual, b, c, there_y, there_x, inside, RESIDUAL, LOGARITHMS, SUM)
            wide = read_plane(coarse, b, c, there_y // 2, there_x // 2, inside, SUM)
            exponent += read_plane(weights, b, c * 9 + tap, y * 0, x * 0, mine, SUM) * detail
            exponent += read_plane(weights, b, (CHANNELS + c) * 9 + tap, y * 0, x * 0, mine, SUM) * wide
    alpha = 1 / (1 + tl.exp(-exponent))
    for c in tl.static_range(CHANNELS):
        total, count = tl.zeros_like(alpha), tl.zeros_like(alpha)
        for place in tl.static_range(4):
            there_y, there_x = y // 2 * 2 + place // 2, x // 2 * 2 + place % 2
            inside = mine & is_inside(there_y, there_x, height, width)
            # The mean is one of radiance, also where the detail is logarithms.
            total += _detail(fine, residual, b, c, there_y, there_x, inside, RESIDUAL, False, SUM)
            count += inside.to(SUM)
        low = total / tl.maximum(count, 1)
        if LOGARITHMS:
            low = log1p(low)
        here = _detail(fine, residual, b, c, y, x, mine, RESIDUAL, LOGARITHMS, SUM)
        fused = here + alpha * (read_plane(coarse, b, c, y // 2, x // 2, mine, SUM) - low)
        if MAXIMUM:
            most = read_plane(maximum, b, 0, y * 0, x * 0, mine, SUM)
            fused = expm1(tl.minimum(tl.maximum(fused, 0), most))
        write_plane(out, fused, b, c, y, x, mine)


def low_frequencies_of(fine: Tensor, coarse: Tensor, maximum: Tensor, exposure: Tensor | None) -> Tensor:
    """See :func:`mcdenoise.ops._steps.network.low_frequencies_of`."""
    result: Tensor = _low_frequencies_of(fine, coarse, maximum, exposure)
    return result


@custom_op(
    "mcdenoise::triton_low_frequencies_of",
    schema="(Tensor fine, Tensor coarse, Tensor maximum, Tensor? exposure) -> Tensor",
)
def _low_frequencies_of(fine: Tensor, coarse: Tensor, maximum: Tensor, exposure: Tensor | None) -> Tensor:
    result = _empty_like(fine)
    if not fine.numel():
        return result
    means = _halved(fine)
    for _ in range(BLOCK.bit_length() - 2):
        means, coarse = _halved(means), _halved(coarse)
    most = torch.expm1(maximum)
    if exposure is not None:
        means, coarse, most = means * exposure, coarse * exposure, most / exposure
    sums = sums_of(fine, coarse, most)
    rows, columns = means.shape[-2:]
    launch(_exchange, fine, sums, result, fine, coarse, means, most, CHANNELS=fine.shape[1], rows=rows, columns=columns)
    return result


@_low_frequencies_of.register_fake
def _empty_like(fine: Tensor, *_: Any) -> Tensor:
    return torch.empty(fine.shape, dtype=fine.dtype, device=fine.device)


def _halved(image: Tensor) -> Tensor:
    return F.avg_pool2d(image, 2, ceil_mode=True, count_include_pad=False)


@triton.jit
def _between(place: tl.tensor, count: tl.tensor, SUM: tl.constexpr) -> tl.tuple:
    """The two blocks between whose centres a pixel lies, and how near it is to the second, in [0, 1]."""
    at = tl.maximum((place.to(SUM) + 0.5) / _BLOCK - 0.5, 0)
    first = at.to(tl.int32)
    return first, tl.minimum(first + 1, count - 1), at - first.to(SUM)


@triton.jit
def _exchange(
    out: tl.tuple,
    fine: tl.tuple,
    wanted: tl.tuple,
    found: tl.tuple,
    most: tl.tuple,
    height: tl.tensor,
    width: tl.tensor,
    rows: tl.tensor,
    columns: tl.tensor,
    CHANNELS: tl.constexpr,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
    WIDE: tl.constexpr,
    SUM: tl.constexpr,
) -> None:
    b, y, x = tile(0, ROWS, COLUMNS, WIDE)
    mine = is_inside(y, x, height, width)
    above, below, fy = _between(y, rows, SUM)
    left, right, fx = _between(x, columns, SUM)
    highest = read_plane(most, b, 0, y * 0, x * 0, mine, SUM)
    for c in tl.static_range(CHANNELS):
        upper = read_plane(wanted, b, c, above, left, mine, SUM) * (1 - fx)
        upper += read_plane(wanted, b, c, above, right, mine, SUM) * fx
        lower = read_plane(wanted, b, c, below, left, mine, SUM) * (1 - fx)
        lower += read_plane(wanted, b, c, below, right, mine, SUM) * fx
        goal = upper * (1 - fy) + lower * fy + _DARK
        upper = read_plane(found, b, c, above, left, mine, SUM) * (1 - fx)
        upper += read_plane(found, b, c, above, right, mine, SUM) * fx
        lower = read_plane(found, b, c, below, left, mine, SUM) * (1 - fx)
        lower += read_plane(found, b, c, below, right, mine, SUM) * fx
        own = upper * (1 - fy) + lower * fy + _DARK
        value = read_plane(fine, b, c, y, x, mine, SUM) * (goal / own)
        write_plane(out, tl.minimum(value, highest), b, c, y, x, mine)


def softplus(x: Tensor, units: Sequence[float]) -> Tensor:
    """See :func:`mcdenoise.ops._steps.network.softplus`."""
    result: Tensor = _softplus(x, [float(unit) for unit in units])
    return result


@custom_op("mcdenoise::triton_softplus", schema="(Tensor x, float[] units) -> Tensor")
def _softplus(x: Tensor, units: list[float]) -> Tensor:
    result = _empty_planes(x)
    launch(_soften, x, result.dtype, result, x, UNITS=tuple(units))
    return result


@_softplus.register_fake
def _empty_planes(x: Tensor, *_: Any) -> Tensor:
    return torch.empty(x.shape, dtype=accumulator_dtype(x.dtype), device=x.device)


@triton.jit
def _soften(
    out: tl.tuple,
    x: tl.tuple,
    height: tl.tensor,
    width: tl.tensor,
    UNITS: tl.constexpr,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
    WIDE: tl.constexpr,
    SUM: tl.constexpr,
) -> None:
    b, row, column = tile(0, ROWS, COLUMNS, WIDE)
    mine = is_inside(row, column, height, width)
    for c in tl.static_range(len(UNITS)):
        value = read_plane(x, b, c, row, column, mine, SUM)
        soft = log1p(tl.exp(tl.minimum(value, 20)))
        write_plane(out, tl.where(value > 20, value, soft) * UNITS[c], b, c, row, column, mine)
