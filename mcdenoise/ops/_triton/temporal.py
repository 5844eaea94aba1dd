"""Motion and accumulation, one pass each, without derivatives; also with the options of a history's blend."""

from __future__ import annotations

import math
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from mcdenoise.ops._constants import DEPTH_LIMIT, LABEL_WEIGHT, NO_ALBEDO, NORMAL_LIMIT_SQUARED, PLANE_LIMIT, STILL
from mcdenoise.ops._operator import custom_op
from mcdenoise.ops._surface import Surface, comparable
from mcdenoise.ops._triton._images import is_finite, is_inside, launch, read_plane, sums_of, tile, write_plane

_LABEL_WEIGHT, _NO_ALBEDO, _STILL = tl.constexpr(LABEL_WEIGHT), tl.constexpr(NO_ALBEDO), tl.constexpr(STILL)


@custom_op(
    "mcdenoise::triton_motion_from_position",
    schema="(Tensor position, Tensor previous_view_projection) -> Tensor",
)
def motion_from_position(position: Tensor, previous_view_projection: Tensor) -> Tensor:
    """See :func:`mcdenoise.ops.motion_from_position`."""
    motion = _empty_motion(position)
    matrix = previous_view_projection.reshape(-1, 16, 1, 1)
    launch(_project, position, motion.dtype, motion, position, matrix)
    return motion


@motion_from_position.register_fake
def _empty_motion(position: Tensor, *_: Any) -> Tensor:
    batch, _, height, width = position.shape
    dtype = torch.promote_types(position.dtype, torch.float32)
    return torch.empty((batch, 2, height, width), dtype=dtype, device=position.device)


@triton.jit
def _clip(
    matrix: tl.tuple,
    b: tl.tensor,
    column: tl.constexpr,
    point: tl.tuple,
    zero: tl.tensor,
    mine: tl.tensor,
    SUM: tl.constexpr,
) -> tl.tensor:
    """One coordinate of the clip space."""
    found = read_plane(matrix, b, 12 + column, zero, zero, mine, SUM)
    for axis in tl.static_range(3):
        found += point[axis] * read_plane(matrix, b, 4 * axis + column, zero, zero, mine, SUM)
    return found


@triton.jit
def _project(
    motion: tl.tuple,
    position: tl.tuple,
    matrix: tl.tuple,
    height: tl.tensor,
    width: tl.tensor,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
    WIDE: tl.constexpr,
    SUM: tl.constexpr,
) -> None:
    b, y, x = tile(0, ROWS, COLUMNS, WIDE)
    mine = is_inside(y, x, height, width)
    hit, point = mine, ()
    for axis in tl.static_range(3):
        value = read_plane(position, b, axis, y, x, mine, SUM)
        hit = hit & is_finite(value)
        point = point + (value,)
    zero = y * 0
    w = _clip(matrix, b, 3, point, zero, mine, SUM)
    in_front = hit & (w > 0)
    w = tl.where(in_front, w, 1)
    u = (_clip(matrix, b, 0, point, zero, mine, SUM) / w + 1) / 2 * width.to(SUM) - (x.to(SUM) + 0.5)
    v = (_clip(matrix, b, 1, point, zero, mine, SUM) / w + 1) / 2 * height.to(SUM) - (y.to(SUM) + 0.5)
    write_plane(motion, tl.where(in_front, u, float("inf")), b, 0, y, x, mine)
    write_plane(motion, tl.where(in_front, v, float("inf")), b, 1, y, x, mine)


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
    rule: str,
    position_limit: float | None,
    normal_limit: float | None,
    recent_alpha: float = 1.0,
    albedo: Tensor | None = None,
    longest: float = math.inf,
) -> tuple[Tensor, Tensor, Tensor]:
    """As ``accumulate``, with a history that is shorter in places or channels; and whether a pixel has one.

    Args:
        color: see :func:`mcdenoise.ops.accumulate`.
        previous: channels that it has more than ``color`` are a second history of the first of them.
        previous_length: see :func:`mcdenoise.ops.accumulate`.
        motion: likewise.
        surface: likewise.
        previous_surface: likewise.
        alpha_min: likewise.
        rule: likewise.
        position_limit: likewise.
        normal_limit: likewise.
        recent_alpha: smallest weight of the current frame in the second history.
        albedo: ``(B, 3, H, W)``, which says where a mirror or glass is seen.
        longest: the longest history of mirrors and glass while the image moves, in frames.
    """
    here, there = comparable(surface, previous_surface)
    if position_limit is None:
        position_limit = DEPTH_LIMIT if here.position is None else PLANE_LIMIT
    if normal_limit is None:
        normal_limit = NORMAL_LIMIT_SQUARED
    limits = (alpha_min, position_limit, normal_limit, recent_alpha, longest)
    result: tuple[Tensor, Tensor, Tensor] = _blend(
        color, previous, previous_length, motion, albedo, list(here), list(there), list(limits), rule == "bmfr"
    )
    return result


@custom_op(
    "mcdenoise::triton_accumulate",
    schema="(Tensor color, Tensor previous, Tensor previous_length, Tensor? motion, Tensor? albedo, "
    "Tensor?[] surface, Tensor?[] previous_surface, float[] limits, bool bmfr) -> (Tensor, Tensor, Tensor)",
)
def _blend(
    color: Tensor,
    previous: Tensor,
    previous_length: Tensor,
    motion: Tensor | None,
    albedo: Tensor | None,
    surface: list[Tensor | None],
    previous_surface: list[Tensor | None],
    limits: list[float],
    bmfr: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    accumulated, length, kept = _empty_blended(color, previous, previous_length)
    sums = sums_of(color, previous, previous_length, motion)
    position, normal, depth, label = (buffer is not None for buffer in surface)
    alpha_min, position_limit, normal_limit, recent_alpha, longest = limits
    launch(
        _accumulate,
        accumulated,
        sums,
        *(accumulated, length, kept, color, previous, previous_length, motion, albedo, *surface, *previous_surface),
        ALPHA_MIN=alpha_min,
        POSITION_LIMIT=position_limit,
        NORMAL_LIMIT=normal_limit,
        RECENT_ALPHA=recent_alpha,
        LONGEST=longest,
        CHANNELS=previous.shape[1],
        FRESH=color.shape[1],
        MOVES=motion is not None,
        MIRRORS=motion is not None and albedo is not None and longest < math.inf,
        POSITION=position,
        NORMAL=normal,
        DEPTH=depth,
        LABEL=label,
        BMFR=bmfr,
    )
    return accumulated, length, kept


@_blend.register_fake
def _empty_blended(color: Tensor, previous: Tensor, previous_length: Tensor, *_: Any) -> tuple[Tensor, Tensor, Tensor]:
    def empty(like: Tensor, dtype: torch.dtype) -> Tensor:
        return torch.empty(like.shape, dtype=dtype, device=like.device)

    return (
        empty(previous, color.dtype),
        empty(previous_length, previous_length.dtype),
        empty(previous_length, torch.bool),
    )


@triton.jit
def _alike(
    here: tl.tuple,
    there: tl.tuple,
    b: tl.tensor,
    y: tl.tensor,
    x: tl.tensor,
    row: tl.tensor,
    column: tl.tensor,
    mine: tl.tensor,
    kept: tl.tensor,
    POSITION_LIMIT: tl.constexpr,
    NORMAL_LIMIT: tl.constexpr,
    POSITION: tl.constexpr,
    NORMAL: tl.constexpr,
    DEPTH: tl.constexpr,
    BMFR: tl.constexpr,
    SUM: tl.constexpr,
) -> tl.tensor:
    """Which of the taps ``kept`` show the surface of their pixels, see :func:`mcdenoise.ops.reproject`."""
    position, normal, depth = here
    tap_position, tap_normal, tap_depth = there
    squares = tl.zeros(mine.shape, SUM)
    across, turn = squares, squares
    for c in tl.static_range(3):
        if NORMAL:
            own = read_plane(normal, b, c, y, x, mine, SUM)
            difference = read_plane(tap_normal, b, c, row, column, kept, SUM) - own
            turn += difference * difference
        if POSITION:
            offset = read_plane(tap_position, b, c, row, column, kept, SUM)
            offset -= read_plane(position, b, c, y, x, mine, SUM)
            squares += offset * offset
            if NORMAL:
                across += offset * own
    if NORMAL:
        kept = kept & ((turn < NORMAL_LIMIT) if BMFR else (turn <= NORMAL_LIMIT))
    if BMFR:
        if POSITION:
            kept = kept & (squares < POSITION_LIMIT)
    elif DEPTH:
        distance = read_plane(depth, b, 0, y, x, mine, SUM)
        tap_distance = read_plane(tap_depth, b, 0, row, column, kept, SUM)
        hit, tap_hit = is_finite(distance), is_finite(tap_distance)
        # An infinite distance is from nothing that was hit.
        apart = tl.abs(tl.where(tap_hit, tap_distance, 0) - tl.where(hit, distance, 0))
        if POSITION:
            apart = tl.abs(across) if NORMAL else tl.sqrt(squares)
        kept = kept & ((hit & tap_hit & (apart <= POSITION_LIMIT * distance)) | ((hit == 0) & (tap_hit == 0)))
    return kept


@triton.jit
def _accumulate(
    accumulated: tl.tuple,
    lengths: tl.tuple,
    histories: tl.tuple,
    color: tl.tuple,
    previous: tl.tuple,
    previous_length: tl.tuple,
    motion: tl.tuple,
    albedo: tl.tuple,
    position: tl.tuple,
    normal: tl.tuple,
    depth: tl.tuple,
    label: tl.tuple,
    tap_position: tl.tuple,
    tap_normal: tl.tuple,
    tap_depth: tl.tuple,
    tap_label: tl.tuple,
    height: tl.tensor,
    width: tl.tensor,
    ALPHA_MIN: tl.constexpr,
    POSITION_LIMIT: tl.constexpr,
    NORMAL_LIMIT: tl.constexpr,
    RECENT_ALPHA: tl.constexpr,
    LONGEST: tl.constexpr,
    CHANNELS: tl.constexpr,
    FRESH: tl.constexpr,
    MOVES: tl.constexpr,
    MIRRORS: tl.constexpr,
    POSITION: tl.constexpr,
    NORMAL: tl.constexpr,
    DEPTH: tl.constexpr,
    LABEL: tl.constexpr,
    BMFR: tl.constexpr,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
    WIDE: tl.constexpr,
    SUM: tl.constexpr,
) -> None:
    b, y, x = tile(0, ROWS, COLUMNS, WIDE)
    mine = is_inside(y, x, height, width)
    left, top, reachable = x, y, mine
    fx, fy = tl.zeros([ROWS * COLUMNS], SUM), tl.zeros([ROWS * COLUMNS], SUM)
    across, along = fx, fx
    if MOVES:
        across, along = read_plane(motion, b, 0, y, x, mine, SUM), read_plane(motion, b, 1, y, x, mine, SUM)
        qx, qy = x.to(SUM) + across, y.to(SUM) + along
        # Not so for a NaN either.
        reachable = mine & (qx > -1) & (qx < width.to(SUM)) & (qy > -1) & (qy < height.to(SUM))
        qx, qy = tl.where(reachable, qx, 0), tl.where(reachable, qy, 0)
        left, top = tl.floor(qx).to(x.dtype), tl.floor(qy).to(y.dtype)
        fx, fy = qx - left.to(SUM), qy - top.to(SUM)
    weights, own_weights, rows, columns = (), (), (), ()
    enough = tl.zeros([ROWS * COLUMNS], SUM)
    for tap in tl.static_range(4 if MOVES else 1):
        row, column = top + tap // 2, left + tap % 2
        kept = reachable & is_inside(row, column, height, width)
        kept = _alike(
            (position, normal, depth),
            (tap_position, tap_normal, tap_depth),
            b,
            y,
            x,
            row,
            column,
            mine,
            kept,
            POSITION_LIMIT,
            NORMAL_LIMIT,
            POSITION,
            NORMAL,
            DEPTH,
            BMFR,
            SUM,
        )
        bilinear = (fx if tap % 2 == 1 else 1 - fx) * (fy if tap // 2 == 1 else 1 - fy)
        weight = tl.where(kept, bilinear, 0)
        own_weight = weight
        if LABEL:
            same = read_plane(tap_label, b, 0, row, column, kept, SUM) == read_plane(label, b, 0, y, x, mine, SUM)
            own_weight = tl.where(kept & same, bilinear, 0)
            enough += own_weight
        weights, own_weights = weights + (weight,), own_weights + (own_weight,)
        rows, columns = rows + (row,), columns + (column,)
    total, length = tl.zeros([ROWS * COLUMNS], SUM), tl.zeros([ROWS * COLUMNS], SUM)
    used = ()
    for tap in tl.static_range(4 if MOVES else 1):
        weight = tl.where(enough > _LABEL_WEIGHT, own_weights[tap], weights[tap]) if LABEL else weights[tap]
        used = used + (weight,)
        total += weight
        # A rejected tap is not read: it may be NaN.
        length += weight * read_plane(previous_length, b, 0, rows[tap], columns[tap], weight > 0, SUM)
    found = total > 0
    inverse = 1 / tl.where(found, total, 1)
    # As tensors: a number beside one, where it is no operator's, would be rounded to float32.
    least, least_recent = tl.full([ROWS * COLUMNS], ALPHA_MIN, SUM), tl.full([ROWS * COLUMNS], RECENT_ALPHA, SUM)
    length = tl.where(found, length * inverse + 1, 1)
    newest = 1 / length
    alpha = tl.where(found, tl.maximum(newest, least), 1)
    excess = tl.zeros([ROWS * COLUMNS], SUM) + 1
    if BMFR:
        # The rounded length is shortened, while the blend used the unrounded one. Halves are rounded to even.
        whole = tl.floor(length - 0.5)
        tie = (length - 0.5 == whole) & (whole - 2 * tl.floor(whole / 2) == 1)
        length = tl.where(found, tl.minimum(tl.where(tie, whole - 1, whole) + 1, 255), 1)
        newest = 1 / length
        excess = (1 - alpha) / tl.maximum(1 - tl.maximum(newest, least), tl.full([ROWS * COLUMNS], 1e-6, SUM))
    write_plane(histories, length > 1, b, 0, y, x, mine)
    if MIRRORS:
        specular = found & (length > LONGEST) & (across * across + along * along > _STILL * _STILL)
        for c in tl.static_range(3):
            specular = specular & (read_plane(albedo, b, c, y, x, mine, SUM) < _NO_ALBEDO)
        length = tl.where(specular, tl.full([ROWS * COLUMNS], LONGEST, SUM), length)
        newest = tl.where(specular, 1 / length, newest)
        alpha = tl.where(specular, 1 - excess * (1 - tl.maximum(newest, least)), alpha)
    write_plane(lengths, length, b, 0, y, x, mine)
    recent = tl.where(found, 1 - excess * (1 - tl.maximum(newest, least_recent)), 1)
    for c in tl.static_range(CHANNELS):
        history = tl.zeros([ROWS * COLUMNS], SUM)
        for tap in tl.static_range(4 if MOVES else 1):
            value = read_plane(previous, b, c, rows[tap], columns[tap], used[tap] > 0, SUM)
            history += (used[tap] * inverse) * value
        new = read_plane(color, b, c if c < FRESH else c - FRESH, y, x, mine, SUM)
        fraction = alpha if c < FRESH else recent
        # From the nearer end, as torch.lerp does.
        change = new - history
        mixed = tl.where(fraction < 0.5, history + fraction * change, new - change * (1 - fraction))
        write_plane(accumulated, tl.where(fraction < 1, mixed, new), b, c, y, x, mine)
