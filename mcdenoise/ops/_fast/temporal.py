"""The fast form of accumulation as a torch operator: reprojection, test and blending in one pass, without derivatives.

Nothing is trained through it, and pixel by pixel its taps lie anywhere: there is nothing to vectorise, only forty
passes over the image to save.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mcdenoise.ops._fast._numba_filter import compiled, share_rows, source
from mcdenoise.ops._fast._operator import custom_op


@custom_op(
    "mcdenoise::accumulate",
    device_types="cpu",
    schema="(Tensor color, Tensor previous, Tensor previous_length, Tensor? motion, Tensor?[] surface, "
    "Tensor?[] previous_surface, float alpha_min, bool bmfr, float position_limit, float normal_limit) "
    "-> (Tensor, Tensor)",
)
def accumulate(
    color: Tensor,
    previous: Tensor,
    previous_length: Tensor,
    motion: Tensor | None,
    surface: list[Tensor | None],
    previous_surface: list[Tensor | None],
    alpha_min: float,
    bmfr: bool,
    position_limit: float,
    normal_limit: float,
) -> tuple[Tensor, Tensor]:
    """See :func:`mcdenoise.ops.accumulate`; the surfaces have the same buffers."""
    dtype = torch.promote_types(color.dtype, torch.float32)
    accumulated = torch.empty(color.shape, dtype=dtype)
    length = torch.empty(previous_length.shape, dtype=dtype)
    if accumulated.numel():
        nothing = torch.empty((0, 0, 0, 0))
        surfaces = (
            tuple(source((nothing if buffer is None else buffer).to(dtype)) for buffer in buffers)
            for buffers in (surface, previous_surface)
        )
        images = (
            source((nothing if image is None else image).to(dtype))
            for image in (color, previous, previous_length, motion)
        )
        limits = tuple(accumulated.new_tensor([alpha_min, position_limit, normal_limit]).tolist())
        arguments = (accumulated.numpy(), length.numpy(), *images, *surfaces, *limits, bmfr)
        share_rows(color, lambda *rows: _accumulate(*arguments, *rows))
    return accumulated.to(color.dtype), length.to(previous_length.dtype)


@accumulate.register_fake
def _(color: Tensor, previous: Tensor, previous_length: Tensor, *_: Any) -> tuple[Tensor, Tensor]:
    return color.new_empty(color.shape), previous_length.new_empty(previous_length.shape)


@compiled
def _accumulate(
    accumulated: Any,
    lengths: Any,
    color: Any,
    previous: Any,
    previous_length: Any,
    motion: Any,
    here: Any,
    there: Any,
    alpha_min: float,
    position_limit: float,
    normal_limit: float,
    bmfr: bool,
    b: int,
    first: int,
    last: int,
) -> None:
    """Rows ``first`` to ``last`` of the result, by the rules of :func:`mcdenoise.ops.reproject`.

    In one piece, and with the memory of each image in a variable: handed to other functions, arrays are counted, pixel
    by pixel, which takes ten times as long as all the rest.
    """
    _, channels, height, width = accumulated.shape
    (new, new_strides, _), (old, old_strides, _), (old_length, length_strides, _) = color, previous, previous_length
    moved, motion_strides, moves = motion
    (p, p_strides, positions), (n, n_strides, normals), (d, d_strides, depths) = here
    (tap_p, tap_p_strides, _), (tap_n, tap_n_strides, _), (tap_d, tap_d_strides, _) = there
    taps = 4 if moves else 1
    sums, one, zero = np.empty(channels, accumulated.dtype), accumulated.dtype.type(1), accumulated.dtype.type(0)
    for y in range(first, last):
        for x in range(width):
            at_new = b * new_strides[0] + y * new_strides[2] + x * new_strides[3]
            at_p = b * p_strides[0] + y * p_strides[2] + x * p_strides[3]
            at_n = b * n_strides[0] + y * n_strides[2] + x * n_strides[3]
            depth = d[b * d_strides[0] + y * d_strides[2] + x * d_strides[3]] if depths else zero
            hit = math.isfinite(depth)
            qx, qy = accumulated.dtype.type(x), accumulated.dtype.type(y)
            if moves:
                at_motion = b * motion_strides[0] + y * motion_strides[2] + x * motion_strides[3]
                qx += moved[at_motion]
                qy += moved[at_motion + motion_strides[1]]
            # Not so for a NaN either.
            reachable = -1 < qx < width and -1 < qy < height
            left, top = (math.floor(qx), math.floor(qy)) if reachable else (0, 0)
            fx, fy = qx - accumulated.dtype.type(left), qy - accumulated.dtype.type(top)
            sums[:] = 0
            weight = length = zero
            for tap in range(taps if reachable else 0):
                row, column = top + tap // 2, left + tap % 2
                if row < 0 or row >= height or column < 0 or column >= width:
                    continue
                at_tap_p = b * tap_p_strides[0] + row * tap_p_strides[2] + column * tap_p_strides[3]
                at_tap_n = b * tap_n_strides[0] + row * tap_n_strides[2] + column * tap_n_strides[3]
                if normals:
                    turn = zero
                    for c in range(3):
                        difference = tap_n[at_tap_n + c * tap_n_strides[1]] - n[at_n + c * n_strides[1]]
                        turn += difference * difference
                    if not (turn < normal_limit or (turn == normal_limit and not bmfr)):
                        continue
                if bmfr or depths:
                    squares = across = zero
                    for c in range(3 if positions else 0):
                        difference = tap_p[at_tap_p + c * tap_p_strides[1]] - p[at_p + c * p_strides[1]]
                        squares += difference * difference
                        if normals:
                            across += difference * n[at_n + c * n_strides[1]]
                    if bmfr:
                        if positions and not squares < position_limit:
                            continue
                    else:
                        tap_depth = tap_d[b * tap_d_strides[0] + row * tap_d_strides[2] + column * tap_d_strides[3]]
                        if math.isfinite(tap_depth) != hit:
                            continue
                        # Where nothing was hit there is no distance to compare.
                        if hit:
                            off_plane = abs(across) if normals else math.sqrt(squares)
                            distance = off_plane if positions else abs(tap_depth - depth)
                            if not distance <= position_limit * depth:
                                continue
                bilinear = (fx if tap % 2 else one - fx) * (fy if tap // 2 else one - fy)
                at_old = b * old_strides[0] + row * old_strides[2] + column * old_strides[3]
                at_length = b * length_strides[0] + row * length_strides[2] + column * length_strides[3]
                weight += bilinear
                length += bilinear * old_length[at_length]
                for c in range(channels):
                    sums[c] += bilinear * old[at_old + c * old_strides[1]]
            found = weight > 0
            length = length / weight if found else zero
            alpha = max(one / (length + one), alpha_min) if found else one
            for c in range(channels):
                value = new[at_new + c * new_strides[1]]
                if found:
                    history = sums[c] / weight
                    # From the nearer end, as torch.lerp does.
                    change = value - history
                    value = history + alpha * change if alpha < 0.5 else value - change * (one - alpha)
                accumulated[b, c, y, x] = value
            grown = min(np.rint(length) + one, 255) if bmfr else length + one
            lengths[b, 0, y, x] = grown if found else one
