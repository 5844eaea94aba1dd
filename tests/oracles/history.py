"""From frame to frame."""

import functools
import itertools
import math

from torch import Tensor

from mcdenoise.ops.temporal import Surface
from oracles.loops import Image, indices, tensor_of, zeros


def motion_from_position(position: Tensor, previous_view_projection: Tensor) -> Tensor:
    """``clip = [x y z 1] @ M``; ``motion = ((clip.xy / clip.w + 1) / 2) (W, H) - centre``; infinite for ``w <= 0``."""
    batch, _, height, width = position.shape
    shape = (batch, 2, height, width)
    points, matrices, out = position.tolist(), previous_view_projection.tolist(), zeros(shape)
    for b, y, x in itertools.product(range(batch), range(height), range(width)):
        point = [*(channel[y][x] for channel in points[b]), 1.0]
        clip = [sum(p * row[column] for p, row in zip(point, matrices[b], strict=True)) for column in range(4)]
        in_front = clip[3] > 0 and all(map(math.isfinite, point))
        out[b][0][y][x] = (clip[0] / clip[3] + 1) / 2 * width - (x + 0.5) if in_front else math.inf
        out[b][1][y][x] = (clip[1] / clip[3] + 1) / 2 * height - (y + 0.5) if in_front else math.inf
    return tensor_of(out, shape)


def reproject(
    previous: Tensor,
    motion: Tensor,
    surface: Surface | None = None,
    previous_surface: Surface | None = None,
    *,
    position_limit: float | None = None,
    normal_limit: float | None = None,
) -> tuple[Tensor, Tensor]:
    """``weight = sum_kept b_k`` and ``value = sum_kept b_k previous[q_k] / weight`` over the four bilinear taps."""
    batch, channels, height, width = previous.shape
    source, moved = previous.tolist(), motion.tolist()
    here, there = _surface(surface), _surface(previous_surface)
    value, kept_weight = zeros(previous.shape), zeros((batch, 1, height, width))
    for b, y, x in itertools.product(range(batch), range(height), range(width)):
        qx, qy = x + moved[b][0][y][x], y + moved[b][1][y][x]
        if not (math.isfinite(qx) and math.isfinite(qy)):
            continue
        current = _at(here, b, y, x)
        kept = [
            ((1 - abs(qx - column)) * (1 - abs(qy - row)), row, column, _at(there, b, row, column))
            for row in (math.floor(qy), math.floor(qy) + 1)
            for column in (math.floor(qx), math.floor(qx) + 1)
            if 0 <= row < height and 0 <= column < width
        ]
        kept = [tap for tap in kept if _same_surface(current, tap[3], position_limit, normal_limit)]
        alike = [tap for tap in kept if current[3] is not None and current[3] == tap[3][3]]
        if sum(bilinear for bilinear, *_ in alike) > 1e-3:
            kept = alike
        total, sums = 0.0, [0.0] * channels
        for bilinear, row, column, _ in kept:
            total += bilinear
            for c in range(channels):
                sums[c] += bilinear * source[b][c][row][column]
        if total > 0:
            kept_weight[b][0][y][x] = total
            for c in range(channels):
                value[b][c][y][x] = sums[c] / total
    return tensor_of(value, previous.shape), tensor_of(kept_weight, (batch, 1, height, width))


def resample(previous: Tensor, motion: Tensor) -> Tensor:
    """``sum_k k(x_k - q_x) k(y_k - q_y) previous[q_k]``, limited to the range of the four nearest pixels."""
    _, channels, height, width = previous.shape
    source, moved, out = previous.tolist(), motion.tolist(), zeros(previous.shape)
    for b, y, x in itertools.product(range(len(source)), range(height), range(width)):
        qx, qy = x + moved[b][0][y][x], y + moved[b][1][y][x]
        if not (math.isfinite(qx) and math.isfinite(qy)):
            continue
        qx, qy = min(max(qx, -1.0), float(width)), min(max(qy, -1.0), float(height))
        rows, columns = (range(math.floor(q) - 1, math.floor(q) + 3) for q in (qy, qx))
        for c in range(channels):
            taps = {
                (row, column): source[b][c][min(max(row, 0), height - 1)][min(max(column, 0), width - 1)]
                for row, column in itertools.product(rows, columns)
            }
            value = sum(_keys(row - qy) * _keys(column - qx) * tap for (row, column), tap in taps.items())
            nearest = [tap for (row, column), tap in taps.items() if row in rows[1:3] and column in columns[1:3]]
            out[b][c][y][x] = min(max(value, min(nearest)), max(nearest))
    return tensor_of(out, previous.shape)


def _keys(distance: float) -> float:
    """Keys' kernel with a = -3/4."""
    a, d = -0.75, abs(distance)
    if d <= 1:
        return (a + 2) * d**3 - (a + 3) * d**2 + 1
    return a * d**3 - 5 * a * d**2 + 8 * a * d - 4 * a if d < 2 else 0.0


def accumulate(
    color: Tensor,
    previous: Tensor,
    previous_length: Tensor,
    motion: Tensor,
    surface: Surface | None = None,
    previous_surface: Surface | None = None,
    *,
    alpha_min: float = 0.1,
    position_limit: float | None = None,
    normal_limit: float | None = None,
) -> tuple[Tensor, Tensor]:
    """``alpha = max(1 / (n + 1), alpha_min)``, ``alpha color + (1 - alpha) history``, ``n + 1``; else ``color``, 1."""
    fetch = functools.partial(reproject, position_limit=position_limit, normal_limit=normal_limit)
    history, weight = (tensor.tolist() for tensor in fetch(previous, motion, surface, previous_surface))
    lengths = fetch(previous_length, motion, surface, previous_surface)[0].tolist()
    source, out, length = color.tolist(), zeros(color.shape), zeros(previous_length.shape)
    for b, c, y, x in indices(color.shape):
        n = lengths[b][0][y][x]
        found = weight[b][0][y][x] > 0
        alpha = max(1 / (n + 1), alpha_min) if found else 1.0
        out[b][c][y][x] = alpha * source[b][c][y][x] + (1 - alpha) * history[b][c][y][x]
        length[b][0][y][x] = n + 1 if found else 1.0
    return tensor_of(out, color.shape), tensor_of(length, previous_length.shape)


def _surface(surface: Surface | None) -> tuple[Image | None, ...]:
    return tuple(None if part is None else part.tolist() for part in surface or Surface())


def _at(surface: tuple[Image | None, ...], b: int, y: int, x: int) -> list[list[float] | None]:
    """Position, normal, depth and label of one pixel, each a vector or ``None``."""
    return [None if part is None else [channel[y][x] for channel in part[b]] for part in surface]


def _same_surface(
    here: list[list[float] | None],
    tap: list[list[float] | None],
    position_limit: float | None,
    normal_limit: float | None,
) -> bool:
    # Buffers that one of the two surfaces lacks are not compared.
    both = [(a, b) if a is not None and b is not None else None for a, b in zip(here, tap, strict=True)]
    positions, normals, depths, _ = both
    if normals is not None and not _squared_distance(*normals) <= (0.5 if normal_limit is None else normal_limit):
        return False
    if depths is None:
        return True
    depth, tap_depth = depths[0][0], depths[1][0]
    if not math.isfinite(depth) or not math.isfinite(tap_depth):
        return not math.isfinite(depth) and not math.isfinite(tap_depth)
    if positions is None:
        return abs(tap_depth - depth) <= (0.1 if position_limit is None else position_limit) * depth
    if normals is None:
        distance = math.sqrt(_squared_distance(*positions))
    else:
        distance = abs(sum((q - p) * n for p, q, n in zip(*positions, normals[0], strict=True)))
    return distance <= (0.02 if position_limit is None else position_limit) * depth


def _squared_distance(a: list[float], b: list[float]) -> float:
    return sum((q - p) ** 2 for p, q in zip(a, b, strict=True))
