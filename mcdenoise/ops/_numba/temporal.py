"""Reprojection and accumulation on a CPU.

The taps of a history lie anywhere, so that torch makes forty passes over the image. Here the taps of a run of pixels
are found first, and summed then, channel by channel, while the run is in the first-level cache.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mcdenoise.ops._constants import DEPTH_LIMIT, LABEL_WEIGHT, NO_ALBEDO, NORMAL_LIMIT_SQUARED, PLANE_LIMIT, STILL
from mcdenoise.ops._numba._runtime import compiled, share_rows
from mcdenoise.ops._surface import Surface, comparable

# Pixels of a run.
_RUN = 128


def reproject(
    previous: Tensor,
    motion: Tensor | None,
    surface: Surface | None,
    previous_surface: Surface | None,
    position_limit: float | None,
    normal_limit: float | None,
) -> Any:
    """See :func:`mcdenoise.ops.reproject`; without motion the reference reads every pixel once, and is as fast."""
    if motion is None:
        return NotImplemented
    dtype = torch.promote_types(previous.dtype, torch.float32)
    value = torch.empty(previous.shape, dtype=dtype, device="cpu")
    weight = value.new_empty((len(value), 1, *value.shape[2:]))
    if value.numel():
        taps = _taps(dtype, motion, surface, previous_surface, position_limit, normal_limit)
        arguments = (value.numpy(), weight.numpy(), _planes(previous, dtype), *taps)
        share_rows(previous, lambda *rows: _reproject(*arguments, *rows))
    return value.to(previous.dtype), weight.to(previous.dtype)


def accumulate(*arguments: Any) -> tuple[Tensor, Tensor]:
    """See :func:`mcdenoise.ops.accumulate`."""
    return blended(*arguments)[:2]


def blended(
    color: Tensor,
    previous: Tensor,
    previous_length: Tensor,
    motion: Tensor | None,
    surface: Surface | None,
    previous_surface: Surface | None,
    alpha_min: float,
    position_limit: float | None = None,
    normal_limit: float | None = None,
    recent_alpha: float = 1.0,
    albedo: Tensor | None = None,
    longest: float = math.inf,
) -> tuple[Tensor, Tensor, Tensor]:
    """As ``accumulate``, with a history that is shorter in places or channels; and how many pixels of a row have one.

    Channels that ``previous`` has more than ``color`` are the second, shorter history of the first of them, in which
    the frame has a weight of at least ``recent_alpha``. Where the albedo shows mirrors or glass and the image moves, no
    history is longer than ``longest``.
    """
    dtype = torch.promote_types(color.dtype, torch.float32)
    batch, _, height, _ = previous.shape
    result = torch.empty(previous.shape, dtype=dtype, device="cpu")
    length = torch.empty(previous_length.shape, dtype=dtype, device="cpu")
    kept = torch.zeros(batch, height, dtype=torch.int64, device="cpu")
    if result.numel():
        taps = _taps(dtype, motion, surface, previous_surface, position_limit, normal_limit)
        images = (_planes(image, dtype) for image in (previous, previous_length, color, albedo))
        # In the dtype of the sums: a number in double precision would make the sums so.
        settings = result.new_tensor([alpha_min, recent_alpha, longest, NO_ALBEDO, STILL**2]).numpy()
        arguments = (result.numpy(), length.numpy(), kept.numpy(), *images, settings, *taps)
        share_rows(previous, lambda *rows: _blend(*arguments, *rows))
    return result.to(color.dtype), length.to(previous_length.dtype), kept


def _planes(image: Tensor | None, dtype: torch.dtype) -> Any:
    """``(B, C, H * W)`` side by side in memory; of no channels where there is no image."""
    if image is None:
        return torch.empty((1, 0, 0), dtype=dtype, device="cpu").numpy()
    return image.detach().to(dtype).contiguous().flatten(2).numpy()


def _taps(
    dtype: torch.dtype,
    motion: Tensor | None,
    surface: Surface | None,
    previous_surface: Surface | None,
    position_limit: float | None,
    normal_limit: float | None,
) -> Sequence[Any]:
    """What :func:`_find_taps` needs: motion, surfaces, limits."""
    here, there = comparable(surface, previous_surface)
    if position_limit is None:
        position_limit = DEPTH_LIMIT if here.position is None else PLANE_LIMIT
    normal_limit = NORMAL_LIMIT_SQUARED if normal_limit is None else normal_limit
    limits = torch.tensor([position_limit, normal_limit, LABEL_WEIGHT], dtype=dtype, device="cpu").numpy()
    surfaces = (tuple(_planes(buffer, dtype) for buffer in buffers) for buffers in (here, there))
    return (_planes(motion, dtype), *surfaces, limits)


@compiled
def _reproject(
    value: Any,
    weight: Any,
    previous: Any,
    motion: Any,
    here: Any,
    there: Any,
    limits: Any,
    b: int,
    first: int,
    last: int,
) -> None:
    _, _, height, width = value.shape
    weights, places = np.empty((4, _RUN), value.dtype), np.empty((4, _RUN), np.uint64)
    for y in range(first, last):
        for x0 in range(0, width, _RUN):
            x1 = min(x0 + _RUN, width)
            found = weight[b, 0, y, x0:x1]
            _find_taps(found, weights, places, motion, here, there, limits, height, width, b, y, x0)
            _sum_taps(value, found, weights, places, previous, b, y, x0)


@compiled
def _blend(
    result: Any,
    lengths: Any,
    counts: Any,
    previous: Any,
    previous_length: Any,
    color: Any,
    albedo: Any,
    settings: Any,
    motion: Any,
    here: Any,
    there: Any,
    limits: Any,
    b: int,
    first: int,
    last: int,
) -> None:
    """Rows ``first`` to ``last`` of the result, of the lengths, and of the number of pixels that have a history."""
    _, channels, height, width = result.shape
    fresh = color.shape[1]
    weights, places = np.empty((4, _RUN), result.dtype), np.empty((4, _RUN), np.uint64)
    # Weight of the frame, and that in the recent history.
    total, alphas = np.empty(_RUN, result.dtype), np.empty((2, _RUN), result.dtype)
    for y in range(first, last):
        for x0 in range(0, width, _RUN):
            x1 = min(x0 + _RUN, width)
            start, end = y * width + x0, y * width + x1
            found, alpha, recent_alpha = total[: x1 - x0], alphas[0, : x1 - x0], alphas[1, : x1 - x0]
            _find_taps(found, weights, places, motion, here, there, limits, height, width, b, y, x0)
            _sum_taps(result, found, weights, places, previous, b, y, x0)
            _sum_taps(lengths, found, weights, places, previous_length, b, y, x0)
            length = lengths[b, 0, y, x0:x1]
            counts[b, y] += _weigh(alpha, length, found, settings)
            if albedo.shape[1] and motion.shape[1]:
                _shorten(alpha, length, albedo, motion, settings, b, start)
            if channels > fresh:
                _weigh_recent(recent_alpha, alpha, length, settings)
            for c in range(channels):
                values = color[b, c if c < fresh else c - fresh, start:end]
                _blend_run(result[b, c, y, x0:x1], values, alpha if c < fresh else recent_alpha, found)


@compiled
def _blend_run(history: Any, color: Any, alpha: Any, found: Any) -> None:
    for i in range(history.size):
        history[i] = between(history[i], color[i], alpha[i]) if found[i] > 0 else color[i]


@compiled
def _find_taps(
    total: Any,
    weights: Any,
    places: Any,
    motion: Any,
    here: Any,
    there: Any,
    limits: Any,
    height: int,
    width: int,
    b: int,
    y: int,
    x0: int,
) -> None:
    """The taps of a run of pixels by the rules of :func:`mcdenoise.ops.reproject`: kept weights, and their fractions.

    A tap that is not kept has the weight 0, and the place of one that is kept, since it may be NaN, and 0 * NaN is NaN.
    """
    number, start = weights.dtype.type, y * width + x0
    one, zero, moves = number(1), number(0), motion.shape[1] > 0
    weights[1:], places[1:] = zero, 0
    for i in range(total.size):
        qx, qy = number(x0 + i), number(y)
        if moves:
            qx += motion[b, 0, start + i]
            qy += motion[b, 1, start + i]
        # Not so for a NaN either.
        reachable = -1 < qx < width and -1 < qy < height
        left, top = (np.int64(qx) - (qx < 0), np.int64(qy) - (qy < 0)) if reachable else (-2, -2)
        fx, fy = qx - number(left), qy - number(top)
        for tap in range(4 if moves else 1):
            row, column = top + tap // 2, left + tap % 2
            inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
            bilinear = (fx if tap % 2 else one - fx) * (fy if tap // 2 else one - fy)
            weights[tap, i] = bilinear if inside else zero
            places[tap, i] = np.uint64(row * width + column) if inside else np.uint64(0)
    (position, normal, depth, label), (position_before, normal_before, depth_before, label_before) = here, there
    for tap in range(4 if moves else 1):
        weight, place = weights[tap, : total.size], places[tap, : total.size]
        if normal.shape[1]:
            _reject_turned(weight, place, normal, normal_before, limits[1], b, start)
        if depth.shape[1]:
            points = (position, position_before, normal)
            _reject_distant(weight, place, depth, depth_before, *points, limits[0], b, start)
    if label.shape[1]:
        _prefer_label(total.size, weights, places, label, label_before, limits[2], b, start)
    _normalize(total, weights, places)


@compiled
def _reject_turned(weight: Any, place: Any, normal: Any, before: Any, limit: Any, b: int, start: int) -> None:
    """Reject taps whose normals are too far apart: NaN is."""
    zero = weight.dtype.type(0)
    for i in range(weight.size):
        squares = zero
        for c in range(3):
            difference = before[b, c, place[i]] - normal[b, c, start + i]
            squares += difference * difference
        if not squares <= limit:
            weight[i] = zero


@compiled
def _reject_distant(
    weight: Any,
    place: Any,
    depth: Any,
    depth_before: Any,
    position: Any,
    before: Any,
    normal: Any,
    limit: Any,
    b: int,
    start: int,
) -> None:
    """By the distance of points off the tangent plane, or from each other without normals; or of depths."""
    zero, points, flat = weight.dtype.type(0), position.shape[1] > 0, normal.shape[1] > 0
    for i in range(weight.size):
        near, far = depth[b, 0, start + i], depth_before[b, 0, place[i]]
        distance = abs(far - near)
        if points:
            squares, across = zero, zero
            for c in range(3):
                difference = before[b, c, place[i]] - position[b, c, start + i]
                squares += difference * difference
                across += difference * normal[b, c, start + i] if flat else zero
            distance = abs(across) if flat else math.sqrt(squares)
        # Where nothing was hit there is no distance to compare.
        if math.isfinite(far) != math.isfinite(near) or (math.isfinite(near) and not distance <= limit * near):
            weight[i] = zero


@compiled
def _prefer_label(
    size: int, weights: Any, places: Any, label: Any, before: Any, enough: Any, b: int, start: int
) -> None:
    """Keep the taps of the pixel's own label alone, if these weigh enough."""
    zero = weights.dtype.type(0)
    for i in range(size):
        own = zero
        for tap in range(4):
            if before[b, 0, places[tap, i]] == label[b, 0, start + i]:
                own += weights[tap, i]
        for tap in range(4 if own > enough else 0):
            if before[b, 0, places[tap, i]] != label[b, 0, start + i]:
                weights[tap, i] = zero


@compiled
def _normalize(total: Any, weights: Any, places: Any) -> None:
    for i in range(total.size):
        total[i] = weights[0, i] + weights[1, i] + weights[2, i] + weights[3, i]
        if total[i] < np.finfo(total.dtype).tiny:
            total[i], weights[:, i] = 0, 0
        safe = places[0, i]
        for tap in range(1, 4):
            safe = places[tap, i] if weights[tap, i] > 0 else safe
        for tap in range(4):
            if weights[tap, i] > 0:
                weights[tap, i] /= total[i]
            else:
                places[tap, i] = safe


@compiled
def _sum_taps(values: Any, total: Any, weights: Any, places: Any, image: Any, b: int, y: int, x0: int) -> None:
    """Sums over the taps of a run of pixels, channel by channel; 0 where no tap is kept."""
    zero = values.dtype.type(0)
    (w0, w1, w2, w3), (p0, p1, p2, p3) = weights, places
    for c in range(values.shape[1]):
        plane, out = image[b, c], values[b, c, y, x0 : x0 + total.size]
        for i in range(total.size):
            upper = w0[i] * plane[p0[i]] + w1[i] * plane[p1[i]]
            lower = w2[i] * plane[p2[i]] + w3[i] * plane[p3[i]]
            out[i] = upper + lower if total[i] > 0 else zero


@compiled
def _weigh(alpha: Any, length: Any, total: Any, settings: Any) -> int:
    """Weights of the frame, and its length in place of the history's; how many pixels have a history."""
    number, count = length.dtype.type, 0
    one = number(1)
    for i in range(length.size):
        if total[i] > 0:
            alpha[i] = max(one / (length[i] + one), settings[0])
            length[i] += one
            count += length[i] > one
        else:
            alpha[i], length[i] = one, one
    return count


@compiled
def _shorten(alpha: Any, length: Any, albedo: Any, motion: Any, settings: Any, b: int, start: int) -> None:
    """Make no history of mirrors and glass that move longer than the longest one."""
    alpha_min, _, longest, no_albedo, still = settings
    for i in range(length.size):
        across, down = motion[b, 0, start + i], motion[b, 1, start + i]
        specular = across * across + down * down > still
        for c in range(3):
            specular = specular and albedo[b, c, start + i] < no_albedo
        if specular and length[i] > longest:
            one = type(longest)(1)
            kept = (one - alpha[i]) * _of_history(longest, alpha_min)
            alpha[i] = one - kept / max(_of_history(length[i], alpha_min), type(longest)(1e-6))
            length[i] = longest


@compiled
def _weigh_recent(recent: Any, alpha: Any, length: Any, settings: Any) -> None:
    number = length.dtype.type
    one, alpha_min, recent_alpha = number(1), settings[0], settings[1]
    for i in range(length.size):
        kept = (one - alpha[i]) * _of_history(length[i], recent_alpha)
        recent[i] = one - kept / max(_of_history(length[i], alpha_min), number(1e-6))


@compiled
def _of_history(length: Any, alpha_min: Any) -> Any:
    """The weight of the history in a result of that length."""
    one = type(length)(1)
    return one - max(one / length, alpha_min)


@compiled
def between(a: Any, b: Any, fraction: Any) -> Any:
    """From the nearer end, as torch.lerp does."""
    one, change = type(a)(1), b - a
    return a + fraction * change if fraction + fraction < one else b - change * (one - fraction)
