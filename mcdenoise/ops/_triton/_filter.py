"""The filter of :mod:`mcdenoise.ops._numba._filter` and its derivatives, in Triton, for NVIDIA GPUs.

Every program has a tile of pixels, one for each thread, and goes through the taps of the window: neighbours of a tile
lie in the cache, and kernels are read once, in whatever layout and precision they have. Only sums are held, so that the
``K*K`` weights exist for one tap at a time; the derivatives compute them once more. Channels and guides are tuples, not
an axis of a tensor: nothing moves between threads. Each pixel gathers the values that its neighbours spread to it:
no two programs add to the same number, and results are the same bit by bit in every run.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
import triton
import triton.language as tl
from torch import Tensor

from mcdenoise.ops._guides import guide_gradient
from mcdenoise.ops._window import BORDERS, Border, accumulator_dtype, kernel_size_of, unpad

# A pixel for each thread of four warps, a warp for each row: neighbours are near, and rows are read at once.
_COLUMNS, _ROWS = 32, 4
# Offsets within a plane have 32 bits where that is enough; those of planes always 64.
_NARROW = 2**31

_REPLICATE = tl.constexpr(BORDERS.index("replicate"))
_RENORMALIZE = tl.constexpr(BORDERS.index("renormalize"))

_TYPES = {torch.float32: tl.float32, torch.float64: tl.float64}

# A tensor as a kernel sees it: its memory, strides, and number of channels.
Source = tuple[Tensor, tuple[int, ...], int]


class _Inputs(NamedTuple):
    """The inputs of a filter."""

    image: Tensor
    kernel: Tensor
    guides: Sequence[Tensor]
    falloffs: Sequence[Tensor]
    distance_falloff: Tensor | None
    log_domain: bool
    border: Border

    @property
    def dtype(self) -> torch.dtype:
        """The dtype of sums."""
        return accumulator_dtype(torch.promote_types(self.image.dtype, self.kernel.dtype))

    @property
    def normalised(self) -> bool:
        """Whether weights are divided by their sum."""
        return self.log_domain or self.border == "renormalize"


def filtered(
    image: Tensor,
    kernel: Tensor,
    guides: Sequence[Tensor],
    falloffs: Sequence[Tensor],
    distance_falloff: Tensor | None,
    log_domain: bool,
    border: Border,
) -> Tensor:
    """The filtered image, contiguous and in the dtype of ``image``."""
    out = _empty(image, image.dtype)
    inputs = _Inputs(image, kernel, guides, falloffs, distance_falloff, log_domain, border)
    _run(_gather, inputs, out, _empty(image[:, :0], inputs.dtype))
    return out


def splatted(image: Tensor, kernel: Tensor, border: Border) -> Tensor:
    """The transpose of the filter without guides, contiguous and in the dtype of ``image``."""
    inputs = _Inputs(image, kernel, (), (), None, False, border)
    return _spread(image, inputs, _normalisation(inputs)[1])


def derivatives(
    gradient: Tensor,
    image: Tensor,
    kernel: Tensor,
    guides: Sequence[Tensor],
    falloffs: Sequence[Tensor],
    distance_falloff: Tensor | None,
    log_domain: bool,
    border: Border,
    of_guides: bool = False,
) -> tuple[Tensor, Tensor, list[Tensor], list[Tensor], Tensor]:
    """The derivatives in image, kernel, guides, falloffs and distance falloff, times ``gradient``.

    Each has the dtype and shape of its input, and is empty where that is absent; those in the guides are also empty
    without ``of_guides``.
    """
    inputs = _Inputs(image, kernel, guides, falloffs, distance_falloff, log_domain, border)
    mean, sums = _normalisation(inputs)
    of_kernel = torch.empty_like(kernel, dtype=inputs.dtype if of_guides else kernel.dtype)
    of_scales = [_empty(scale, scale.dtype) for scale in falloffs]
    of_distance = _empty(image[:, :0], image.dtype) if distance_falloff is None else torch.empty_like(distance_falloff)
    _run(_correlate, inputs, of_kernel, of_scales, of_distance, gradient, mean, sums)
    of_guide = []
    if of_guides:
        # The slope of an exponent is that of its logit, or its weight's times that weight.
        slopes = of_kernel if log_domain else of_kernel * kernel
        of_guide = [guide_gradient(slopes, guide, scale, border) for guide, scale in zip(guides, falloffs, strict=True)]
    return _spread(gradient, inputs, sums), of_kernel.to(kernel.dtype), of_guide, of_scales, of_distance


def _normalisation(inputs: _Inputs) -> tuple[Tensor, Tensor]:
    """The result in the dtype of the sums; of each pixel's weights the largest exponent and one over their sum.

    Both are empty where weights are not normalised.
    """
    image = inputs.image
    if not inputs.normalised:
        return _empty(image[:, :0], inputs.dtype), _empty(image[:, :0], inputs.dtype)
    mean = _empty(image, inputs.dtype)
    sums = mean.new_empty((image.shape[0], 2, *image.shape[2:]))
    _run(_gather, inputs, mean, sums)
    return mean, sums


def _spread(gradient: Tensor, inputs: _Inputs, sums: Tensor) -> Tensor:
    """Every pixel's fraction of each neighbour, added up there: the transpose of the filter."""
    # Gradients of pixels read from beyond the border are first gathered there.
    margin = kernel_size_of(inputs.kernel.shape[1], "kernel") // 2 if inputs.border == "replicate" else 0
    batch, channels, height, width = inputs.image.shape
    shape = batch, channels, height + 2 * margin, width + 2 * margin
    out = gradient.new_empty(shape, dtype=inputs.dtype if margin else inputs.image.dtype)
    _run(_scatter, inputs, out, gradient, sums, margin=margin)
    return unpad(out, margin, inputs.border).to(inputs.image.dtype) if margin else out


def _empty(like: Tensor, dtype: torch.dtype) -> Tensor:
    return torch.empty(like.shape, dtype=dtype, device=like.device)


def _source(tensor: Tensor) -> Source:
    return tensor.detach(), tensor.stride(), tensor.shape[1]


def _is_wide(tensor: Tensor) -> bool:
    """Whether offsets of pixels within one plane need more than 32 bits."""
    sizes, strides = tensor.shape[2:], tensor.stride()[2:]
    return sum((size - 1) * stride for size, stride in zip(sizes, strides, strict=True)) >= _NARROW


def _run(kernel: Any, inputs: _Inputs, *others: Tensor | Sequence[Tensor], margin: int = 0) -> None:
    """Run one of the kernels below on all tiles of the image, and of a margin around it."""
    image, distance_falloff = inputs.image, inputs.distance_falloff
    if not image.numel():
        return
    batch, channels, height, width = image.shape
    distance = image[:, :0] if distance_falloff is None else distance_falloff
    arguments = *others, inputs.kernel, image, inputs.guides, inputs.falloffs, distance
    tensors = [tensor for one in arguments for tensor in ([one] if isinstance(one, Tensor) else one)]
    grid = triton.cdiv(width + 2 * margin, _COLUMNS), triton.cdiv(height + 2 * margin, _ROWS), batch
    # Triton launches on the current device.
    with torch.cuda.device_of(image):
        kernel[grid](
            *(_source(one) if isinstance(one, Tensor) else tuple(map(_source, one)) for one in arguments),
            height,
            width,
            KERNEL_SIZE=kernel_size_of(inputs.kernel.shape[1], "kernel"),
            CHANNELS=channels,
            GUIDES=tuple(guide.shape[1] for guide in inputs.guides),
            DISTANCE=distance_falloff is not None,
            LOG_DOMAIN=inputs.log_domain,
            NORMALISED=inputs.normalised,
            BORDER=BORDERS.index(inputs.border),
            MARGIN=margin,
            ROWS=_ROWS,
            COLUMNS=_COLUMNS,
            WIDE=any(map(_is_wide, tensors)),
            SUM=_TYPES[inputs.dtype],
            LARGEST=torch.finfo(inputs.dtype).max,
        )


@triton.jit
def _tile(MARGIN: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr, WIDE: tl.constexpr) -> tl.tensor:
    """This program's image, and row and column of its pixels."""
    pixel = tl.arange(0, ROWS * COLUMNS)
    y = tl.program_id(1) * ROWS + pixel // COLUMNS - MARGIN
    x = tl.program_id(0) * COLUMNS + pixel % COLUMNS - MARGIN
    if WIDE:
        y, x = y.to(tl.int64), x.to(tl.int64)
    return tl.program_id(2).to(tl.int64), y, x


@triton.jit
def _is_inside(y: tl.tensor, x: tl.tensor, height: tl.tensor, width: tl.tensor) -> tl.tensor:
    return (y >= 0) & (y < height) & (x >= 0) & (x < width)


@triton.jit
def _place(source: tl.tuple, b: tl.tensor, channel: tl.tensor, y: tl.tensor, x: tl.tensor) -> tl.tensor:
    memory, strides, _ = source
    first = memory + b * strides[0] + tl.cast(channel, tl.int64) * strides[1]
    return first + (y * strides[2] + x * strides[3])


@triton.jit
def _read_plane(
    source: tl.tuple, b: tl.tensor, channel: tl.tensor, y: tl.tensor, x: tl.tensor, mask: tl.tensor, SUM: tl.constexpr
) -> tl.tensor:
    """One channel of some pixels; 0 where a pixel is masked."""
    return tl.load(_place(source, b, channel, y, x), mask=mask, other=0).to(SUM)


@triton.jit
def _read(
    source: tl.tuple,
    b: tl.tensor,
    y: tl.tensor,
    x: tl.tensor,
    mask: tl.tensor,
    CHANNELS: tl.constexpr,
    SUM: tl.constexpr,
) -> tl.tuple:
    """All channels of some pixels."""
    values = ()
    for c in tl.static_range(CHANNELS):
        values = values + (_read_plane(source, b, c, y, x, mask, SUM),)
    return values


@triton.jit
def _read_guides(
    guides: tl.tuple,
    b: tl.tensor,
    y: tl.tensor,
    x: tl.tensor,
    mask: tl.tensor,
    GUIDES: tl.constexpr,
    SUM: tl.constexpr,
) -> tl.tuple:
    values = ()
    for g in tl.static_range(len(GUIDES)):
        values = values + (_read(guides[g], b, y, x, mask, GUIDES[g], SUM),)
    return values


@triton.jit
def _read_falloffs(
    falloffs: tl.tuple, b: tl.tensor, y: tl.tensor, x: tl.tensor, mask: tl.tensor, SUM: tl.constexpr
) -> tl.tuple:
    values = ()
    for g in tl.static_range(len(falloffs)):
        values = values + (_read_plane(falloffs[g], b, 0, y, x, mask, SUM),)
    return values


@triton.jit
def _dot(a: tl.tuple, b: tl.tuple) -> tl.tensor:
    total = a[0] * b[0]
    for c in tl.static_range(1, len(a)):
        total += a[c] * b[c]
    return total


@triton.jit
def _sum_of(total: tl.tuple, weight: tl.tensor, values: tl.tuple) -> tl.tuple:
    """``total + weight * values``, channel by channel."""
    result = ()
    for c in tl.static_range(len(values)):
        result = result + (total[c] + weight * values[c],)
    return result


@triton.jit
def _scaled(values: tl.tuple, factor: tl.tensor) -> tl.tuple:
    result = ()
    for c in tl.static_range(len(values)):
        result = result + (values[c] * factor,)
    return result


@triton.jit
def _zeros(count: tl.constexpr, pixels: tl.constexpr, SUM: tl.constexpr) -> tl.tuple:
    values = ()
    for _ in tl.static_range(count):
        values = values + (tl.zeros([pixels], SUM),)
    return values


@triton.jit
def _squared_distances(
    guides: tl.tuple,
    here: tl.tuple,
    b: tl.tensor,
    y: tl.tensor,
    x: tl.tensor,
    mask: tl.tensor,
    GUIDES: tl.constexpr,
    SUM: tl.constexpr,
) -> tl.tuple:
    """``|difference|^2`` of each guide's values ``here`` and at some other pixels."""
    squares = ()
    for g in tl.static_range(len(GUIDES)):
        difference = _sum_of(_read(guides[g], b, y, x, mask, GUIDES[g], SUM), -1, here[g])
        squares = squares + (_dot(difference, difference),)
    return squares


@triton.jit
def _exponent(
    value: tl.tensor,
    squares: tl.tuple,
    falloff: tl.tuple,
    square_offset: tl.tensor,
    falloff_with_distance: tl.tensor,
    inside: tl.tensor,
    DISTANCE: tl.constexpr,
    LOG_DOMAIN: tl.constexpr,
    BORDER: tl.constexpr,
    LARGEST: tl.constexpr,
) -> tl.tensor:
    """The exponent of a weight in the log domain, else of the factor of the kernel's ``value``."""
    exponent = tl.zeros_like(value)
    if LOG_DOMAIN:
        # Infinity as the largest number: the weight of each of two infinite logits is not NaN, but half.
        exponent = tl.where(value > LARGEST, LARGEST, tl.where(value < -LARGEST, -LARGEST, value))
    for g in tl.static_range(len(squares)):
        exponent -= falloff[g] * squares[g]
    if DISTANCE:
        exponent -= square_offset * falloff_with_distance
    if BORDER == _RENORMALIZE:
        exponent = tl.where(inside, exponent, float("-inf"))
    return exponent


@triton.jit
def _gather(
    out: tl.tuple,
    sums: tl.tuple,
    kernel: tl.tuple,
    image: tl.tuple,
    guides: tl.tuple,
    falloffs: tl.tuple,
    distance: tl.tuple,
    height: tl.tensor,
    width: tl.tensor,
    KERNEL_SIZE: tl.constexpr,
    CHANNELS: tl.constexpr,
    GUIDES: tl.constexpr,
    DISTANCE: tl.constexpr,
    LOG_DOMAIN: tl.constexpr,
    NORMALISED: tl.constexpr,
    BORDER: tl.constexpr,
    MARGIN: tl.constexpr,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
    WIDE: tl.constexpr,
    SUM: tl.constexpr,
    LARGEST: tl.constexpr,
) -> None:
    """The result; where there is room, each pixel's largest exponent and one over the sum of its weights."""
    b, y, x = _tile(MARGIN, ROWS, COLUMNS, WIDE)
    mine = _is_inside(y, x, height, width)
    here = _read_guides(guides, b, y, x, mine, GUIDES, SUM)
    falloff = _read_falloffs(falloffs, b, y, x, mine, SUM)
    falloff_with_distance = _read_plane(distance, b, 0, y, x, mine, SUM) if DISTANCE else 0
    total = tl.zeros([ROWS * COLUMNS], SUM)
    maximum = total - LARGEST if LOG_DOMAIN else total
    result = _zeros(CHANNELS, ROWS * COLUMNS, SUM)
    for row in range(KERNEL_SIZE):
        for column in tl.static_range(KERNEL_SIZE):
            dy, dx = row - KERNEL_SIZE // 2, column - KERNEL_SIZE // 2
            there_y, there_x, inside = _neighbour(y + dy, x + dx, mine, height, width, BORDER)
            squares = _squared_distances(guides, here, b, there_y, there_x, inside, GUIDES, SUM)
            counted = inside if BORDER == _RENORMALIZE else mine
            value = _read_plane(kernel, b, row * KERNEL_SIZE + column, y, x, counted, SUM)
            square_offset = tl.cast(dy * dy + dx * dx, SUM)
            exponent = _exponent(
                value,
                squares,
                falloff,
                square_offset,
                falloff_with_distance,
                inside,
                DISTANCE,
                LOG_DOMAIN,
                BORDER,
                LARGEST,
            )
            neighbours = _read(image, b, there_y, there_x, inside, CHANNELS, SUM)
            if LOG_DOMAIN:
                # The sums so far are relative to the largest exponent so far.
                higher = tl.maximum(maximum, exponent)
                rescale, weight = tl.exp(maximum - higher), tl.exp(exponent - higher)
                maximum, total, result = higher, total * rescale, _scaled(result, rescale)
            else:
                weight = value * tl.exp(exponent)
            total += weight
            result = _sum_of(result, weight, neighbours)
    inverse = tl.where(total == 0, 0, 1 / tl.where(total == 0, 1, total))
    if NORMALISED:
        result = _scaled(result, inverse)
    for c in tl.static_range(CHANNELS):
        _write_plane(out, result[c], b, c, y, x, mine)
    _write_plane(sums, maximum, b, 0, y, x, mine)
    _write_plane(sums, inverse, b, 1, y, x, mine)


@triton.jit
def _correlate(
    of_kernel: tl.tuple,
    of_scales: tl.tuple,
    of_distance: tl.tuple,
    gradient: tl.tuple,
    mean: tl.tuple,
    sums: tl.tuple,
    kernel: tl.tuple,
    image: tl.tuple,
    guides: tl.tuple,
    falloffs: tl.tuple,
    distance: tl.tuple,
    height: tl.tensor,
    width: tl.tensor,
    KERNEL_SIZE: tl.constexpr,
    CHANNELS: tl.constexpr,
    GUIDES: tl.constexpr,
    DISTANCE: tl.constexpr,
    LOG_DOMAIN: tl.constexpr,
    NORMALISED: tl.constexpr,
    BORDER: tl.constexpr,
    MARGIN: tl.constexpr,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
    WIDE: tl.constexpr,
    SUM: tl.constexpr,
    LARGEST: tl.constexpr,
) -> None:
    """The derivatives in the inputs of a single pixel: kernel, falloffs and distance falloff."""
    b, y, x = _tile(MARGIN, ROWS, COLUMNS, WIDE)
    mine = _is_inside(y, x, height, width)
    here = _read_guides(guides, b, y, x, mine, GUIDES, SUM)
    falloff = _read_falloffs(falloffs, b, y, x, mine, SUM)
    falloff_with_distance = _read_plane(distance, b, 0, y, x, mine, SUM) if DISTANCE else 0
    upstream = _read(gradient, b, y, x, mine, CHANNELS, SUM)
    maximum = tl.zeros([ROWS * COLUMNS], SUM)
    shared = maximum
    if NORMALISED:
        maximum = _read_plane(sums, b, 0, y, x, mine, SUM)
        upstream = _scaled(upstream, _read_plane(sums, b, 1, y, x, mine, SUM))
        # The mean slope, which all weights share, since they are divided by their sum.
        shared = _dot(upstream, _read(mean, b, y, x, mine, CHANNELS, SUM))
    to_distance = tl.zeros([ROWS * COLUMNS], SUM)
    to_scales = _zeros(len(GUIDES), ROWS * COLUMNS, SUM)
    for row in range(KERNEL_SIZE):
        for column in tl.static_range(KERNEL_SIZE):
            tap = row * KERNEL_SIZE + column
            dy, dx = row - KERNEL_SIZE // 2, column - KERNEL_SIZE // 2
            there_y, there_x, inside = _neighbour(y + dy, x + dx, mine, height, width, BORDER)
            squares = _squared_distances(guides, here, b, there_y, there_x, inside, GUIDES, SUM)
            counted = inside if BORDER == _RENORMALIZE else mine
            value = _read_plane(kernel, b, tap, y, x, counted, SUM)
            square_offset = tl.cast(dy * dy + dx * dx, SUM)
            exponent = _exponent(
                value,
                squares,
                falloff,
                square_offset,
                falloff_with_distance,
                inside,
                DISTANCE,
                LOG_DOMAIN,
                BORDER,
                LARGEST,
            )
            factor = tl.exp(exponent - maximum)
            neighbours = _read(image, b, there_y, there_x, inside, CHANNELS, SUM)
            slope = (_dot(upstream, neighbours) - shared) * factor
            _write_plane(of_kernel, slope, b, tap, y, x, mine)
            if not LOG_DOMAIN:
                slope *= value
            to_distance -= slope * square_offset
            to_scales = _sum_of(to_scales, -slope, squares)
    _write_plane(of_distance, to_distance, b, 0, y, x, mine)
    for g in tl.static_range(len(GUIDES)):
        _write_plane(of_scales[g], to_scales[g], b, 0, y, x, mine)


@triton.jit
def _scatter(
    out: tl.tuple,
    gradient: tl.tuple,
    sums: tl.tuple,
    kernel: tl.tuple,
    image: tl.tuple,
    guides: tl.tuple,
    falloffs: tl.tuple,
    distance: tl.tuple,
    height: tl.tensor,
    width: tl.tensor,
    KERNEL_SIZE: tl.constexpr,
    CHANNELS: tl.constexpr,
    GUIDES: tl.constexpr,
    DISTANCE: tl.constexpr,
    LOG_DOMAIN: tl.constexpr,
    NORMALISED: tl.constexpr,
    BORDER: tl.constexpr,
    MARGIN: tl.constexpr,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
    WIDE: tl.constexpr,
    SUM: tl.constexpr,
    LARGEST: tl.constexpr,
) -> None:
    """Gather at each pixel of the image and of a margin from the pixels in whose windows it lies."""
    b, y, x = _tile(MARGIN, ROWS, COLUMNS, WIDE)
    mine = _is_inside(y + MARGIN, x + MARGIN, height + 2 * MARGIN, width + 2 * MARGIN)
    seen_y, seen_x, _ = _neighbour(y, x, mine, height, width, BORDER)
    here = _read_guides(guides, b, seen_y, seen_x, mine, GUIDES, SUM)
    result = _zeros(CHANNELS, ROWS * COLUMNS, SUM)
    for row in range(KERNEL_SIZE):
        for column in tl.static_range(KERNEL_SIZE):
            dy, dx = row - KERNEL_SIZE // 2, column - KERNEL_SIZE // 2
            from_y, from_x = y - dy, x - dx
            inside = mine & _is_inside(from_y, from_x, height, width)
            squares = _squared_distances(guides, here, b, from_y, from_x, inside, GUIDES, SUM)
            falloff = _read_falloffs(falloffs, b, from_y, from_x, inside, SUM)
            falloff_with_distance = _read_plane(distance, b, 0, from_y, from_x, inside, SUM) if DISTANCE else 0
            value = _read_plane(kernel, b, row * KERNEL_SIZE + column, from_y, from_x, inside, SUM)
            square_offset = tl.cast(dy * dy + dx * dx, SUM)
            exponent = _exponent(
                value,
                squares,
                falloff,
                square_offset,
                falloff_with_distance,
                inside,
                DISTANCE,
                LOG_DOMAIN,
                BORDER,
                LARGEST,
            )
            if NORMALISED:
                exponent -= _read_plane(sums, b, 0, from_y, from_x, inside, SUM)
            weight = tl.exp(exponent) if LOG_DOMAIN else value * tl.exp(exponent)
            if NORMALISED:
                weight *= _read_plane(sums, b, 1, from_y, from_x, inside, SUM)
            result = _sum_of(result, weight, _read(gradient, b, from_y, from_x, inside, CHANNELS, SUM))
    for c in tl.static_range(CHANNELS):
        _write_plane(out, result[c], b, c, y + MARGIN, x + MARGIN, mine)


@triton.jit
def _neighbour(
    y: tl.tensor, x: tl.tensor, mine: tl.tensor, height: tl.tensor, width: tl.tensor, BORDER: tl.constexpr
) -> tl.tensor:
    """The place that a tap reads, and whether it reads anything."""
    if BORDER == _REPLICATE:
        y, x = tl.minimum(tl.maximum(y, 0), height - 1), tl.minimum(tl.maximum(x, 0), width - 1)
    return y, x, mine & _is_inside(y, x, height, width)


@triton.jit
def _write_plane(
    source: tl.tuple,
    values: tl.tensor,
    b: tl.tensor,
    channel: tl.tensor,
    y: tl.tensor,
    x: tl.tensor,
    mask: tl.tensor,
) -> None:
    """Into one channel, if there is one."""
    tl.store(_place(source, b, channel, y, x), values, mask=mask & (channel < source[2]))
