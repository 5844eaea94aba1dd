"""Motion, without derivatives, and accumulation, with them, as torch operators.

Pixel by pixel the taps of a history lie anywhere: there is nothing to vectorise, only forty passes over the image to
save. So one pass does all that :func:`mcdenoise.ops._steps.history.blend` asks of it, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from mcdenoise.ops._constants import DEPTH_LIMIT, LABEL_WEIGHT, NO_ALBEDO, NORMAL_LIMIT_SQUARED, PLANE_LIMIT
from mcdenoise.ops._numba._runtime import compiled, share_rows, source
from mcdenoise.ops._operator import custom_op
from mcdenoise.ops._surface import Surface, comparable

# Pixels whose taps are held at a time: they stay in the first-level cache.
_CHUNK = 128


@custom_op(
    "mcdenoise::motion_from_position",
    device_types="cpu",
    schema="(Tensor position, Tensor previous_view_projection) -> Tensor",
)
def motion_from_position(position: Tensor, previous_view_projection: Tensor) -> Tensor:
    """See :func:`mcdenoise.ops.motion_from_position`."""
    dtype = torch.promote_types(position.dtype, torch.float32)
    batch, _, height, width = position.shape
    motion = torch.empty((batch, 2, height, width), dtype=dtype, device="cpu")
    if motion.numel():
        arguments = (
            motion.numpy(),
            source(position.to(dtype)),
            previous_view_projection.detach().to(dtype).contiguous().numpy(),
        )
        share_rows(position, lambda *rows: _motion(*arguments, *rows), light=True)
    return motion


@motion_from_position.register_fake
def _(position: Tensor, previous_view_projection: Tensor) -> Tensor:
    batch, _, height, width = position.shape
    dtype = torch.promote_types(position.dtype, torch.float32)
    return position.new_empty((batch, 2, height, width), dtype=dtype)


@compiled
def _motion(motion: Any, position: Any, matrices: Any, b: int, first: int, last: int) -> None:
    _, _, height, width = motion.shape
    memory, strides, _ = position
    number = motion.dtype.type
    m, one, half, infinite = matrices[b], number(1), number(0.5), number(np.inf)
    m00, m01, m03, m10, m11, m13 = m[0, 0], m[0, 1], m[0, 3], m[1, 0], m[1, 1], m[1, 3]
    m20, m21, m23, m30, m31, m33 = m[2, 0], m[2, 1], m[2, 3], m[3, 0], m[3, 1], m[3, 3]
    wide, high = number(width) * half, number(height) * half
    for y in range(first, last):
        start, down = b * strides[0] + y * strides[2], number(y) + half
        across, along = motion[b, 0, y], motion[b, 1, y]
        for i in range(width):
            at = start + i * strides[3]
            px, py, pz = memory[at], memory[at + strides[1]], memory[at + 2 * strides[1]]
            w = px * m03 + py * m13 + pz * m23 + m33
            # Infinity times zero and the difference of two infinities are NaN.
            in_front = w > 0 and (px - px) + (py - py) + (pz - pz) == 0
            u, v = (px * m00 + py * m10 + pz * m20 + m30) / w, (px * m01 + py * m11 + pz * m21 + m31) / w
            across[i] = (u + one) * wide - (number(i) + half) if in_front else infinite
            along[i] = (v + one) * high - down if in_front else infinite


def reproject(
    previous: Tensor,
    motion: Tensor | None,
    surface: Surface | None,
    previous_surface: Surface | None,
    rule: str,
    *limits: float | None,
) -> Any:
    """See :func:`mcdenoise.ops.reproject`; without motion the reference reads every pixel once, and is as fast."""
    if motion is None:
        return NotImplemented
    here, there = comparable(surface, previous_surface)
    return _reproject(previous, motion, list(here), list(there), rule == "bmfr", *_limits(here, *limits))


@custom_op(
    "mcdenoise::reproject",
    device_types="cpu",
    schema="(Tensor previous, Tensor motion, Tensor?[] surface, Tensor?[] previous_surface, bool bmfr, "
    "float position_limit, float normal_limit) -> (Tensor, Tensor)",
)
def _reproject(
    previous: Tensor,
    motion: Tensor,
    surface: list[Tensor | None],
    previous_surface: list[Tensor | None],
    bmfr: bool,
    position_limit: float,
    normal_limit: float,
) -> tuple[Tensor, Tensor]:
    """The surfaces have the same buffers."""
    nothing = previous.new_empty((0, 0, 0, 0))
    # A length is read, and has no effect.
    settings = (1.0, position_limit, normal_limit, 1.0, None, math.inf, 0.0, bmfr)
    value, weight, _ = _pass(nothing, previous, previous[:, :1], motion, surface, previous_surface, *settings)
    return value.to(previous.dtype), weight.to(previous.dtype)


@_reproject.register_fake
def _(previous: Tensor, *_: Any) -> tuple[Tensor, Tensor]:
    return torch.empty_like(previous), torch.empty_like(previous[:, :1])


class Shorter(NamedTuple):
    """The settings that shorten histories, see :func:`mcdenoise.ops._steps.history.blend`.

    Args:
        recent_alpha: smallest weight of the current frame in a second, shorter history of the first channels.
        albedo: ``(B, 3, H, W)``, which says where a mirror or glass is seen.
        longest: the longest history of mirrors and glass while the image moves, in frames.
        still: largest motion, in pixels, that counts as standing still.
    """

    recent_alpha: float = 1.0
    albedo: Tensor | None = None
    longest: float = math.inf
    still: float = 0.0


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
    shorter: Shorter = Shorter(),  # noqa: B008
) -> tuple[Tensor, Tensor, Tensor]:
    """As ``accumulate``, with a history that is shorter in places or channels; and how many pixels of a row have one.

    Channels that ``previous`` has more than ``color`` are the second history of the first of them.
    """
    here, there = comparable(surface, previous_surface)
    settings = (alpha_min, rule == "bmfr", *_limits(here, position_limit, normal_limit), *shorter)
    result: tuple[Tensor, Tensor, Tensor] = _blend(
        color, previous, previous_length, motion, list(here), list(there), *settings
    )
    return result


def _limits(here: Surface, position_limit: float | None, normal_limit: float | None) -> tuple[float, float]:
    if position_limit is None:
        position_limit = DEPTH_LIMIT if here.position is None else PLANE_LIMIT
    return position_limit, NORMAL_LIMIT_SQUARED if normal_limit is None else normal_limit


@custom_op(
    "mcdenoise::accumulate",
    device_types="cpu",
    schema="(Tensor color, Tensor previous, Tensor previous_length, Tensor? motion, Tensor?[] surface, "
    "Tensor?[] previous_surface, float alpha_min, bool bmfr, float position_limit, float normal_limit, "
    "float recent_alpha, Tensor? albedo, float longest, float still) -> (Tensor, Tensor, Tensor)",
)
def _blend(
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
    recent_alpha: float,
    albedo: Tensor | None,
    longest: float,
    still: float,
) -> tuple[Tensor, Tensor, Tensor]:
    """The surfaces have the same buffers."""
    settings = (alpha_min, position_limit, normal_limit, recent_alpha, albedo, longest, still, bmfr)
    accumulated, length, kept = _pass(color, previous, previous_length, motion, surface, previous_surface, *settings)
    return accumulated.to(color.dtype), length.to(previous_length.dtype), kept


def _pass(
    color: Tensor,
    previous: Tensor,
    previous_length: Tensor,
    motion: Tensor | None,
    surface: Sequence[Tensor | None],
    previous_surface: Sequence[Tensor | None],
    alpha_min: float,
    position_limit: float,
    normal_limit: float,
    recent_alpha: float,
    albedo: Tensor | None,
    longest: float,
    still: float,
    bmfr: bool,
    taps: tuple[Tensor, Tensor] | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Results in the dtype of the sums; of each pixel, into ``taps``, weights and places in ``previous``."""
    dtype = torch.promote_types(color.dtype, torch.float32)
    accumulated = torch.empty(previous.shape, dtype=dtype, device="cpu")
    length = torch.empty(previous_length.shape, dtype=dtype, device="cpu")
    kept = torch.zeros(previous.shape[0], previous.shape[2], dtype=torch.int64, device="cpu")
    if accumulated.numel():
        nothing = torch.empty((0, 0, 0, 0), device="cpu")
        surfaces = (
            tuple(source((nothing if buffer is None else buffer).to(dtype)) for buffer in buffers)
            for buffers in (surface, previous_surface)
        )
        images = (
            source((nothing if image is None else image).to(dtype))
            for image in (color, previous, previous_length, motion, albedo)
        )
        # In the dtype of the sums: a number in double precision would make the sums so.
        limits = accumulated.new_tensor(
            [alpha_min, position_limit, normal_limit, LABEL_WEIGHT, recent_alpha, NO_ALBEDO, longest, still]
        ).numpy()
        if taps is None:
            taps = nothing.to(dtype), nothing.long()
        records = tuple(each.numpy() for each in taps)
        arguments = (accumulated.numpy(), length.numpy(), kept.numpy(), *images, *surfaces, *limits, bmfr, *records)
        share_rows(previous, lambda *rows: _accumulate(*arguments, *rows))
    return accumulated, length, kept


@_blend.register_fake
def _(color: Tensor, previous: Tensor, previous_length: Tensor, *_: Any) -> tuple[Tensor, Tensor, Tensor]:
    kept = previous.new_empty((previous.shape[0], previous.shape[2]), dtype=torch.int64)
    return color.new_empty(previous.shape), previous_length.new_empty(previous_length.shape), kept


@compiled
def _accumulate(
    accumulated: Any,
    lengths: Any,
    counts: Any,
    color: Any,
    previous: Any,
    previous_length: Any,
    motion: Any,
    albedo: Any,
    here: Any,
    there: Any,
    alpha_min: float,
    position_limit: float,
    normal_limit: float,
    label_weight: float,
    recent_alpha: float,
    no_albedo: float,
    longest: float,
    still: float,
    bmfr: bool,
    tap_weights: Any,
    tap_places: Any,
    b: int,
    first: int,
    last: int,
) -> None:
    """Rows ``first`` to ``last`` of the result, by the rules of :func:`mcdenoise.ops.reproject`.

    And of their taps, where there is room for them. Without a color the result is the history, and its weight instead
    of its length.

    In one piece, and with the memory of each image in a variable: handed to other functions, arrays are counted, pixel
    by pixel, which takes ten times as long as all the rest. The taps of a run of pixels are found first and summed
    then, channel by channel: the planes of an image often begin a power of two apart, and the cache holds few such.
    """
    _, channels, height, width = accumulated.shape
    (new, new_strides, fresh), (old, old_strides, _), (old_length, length_strides, _) = color, previous, previous_length
    moved, motion_strides, moves = motion
    (p, p_strides, positions), (n, n_strides, normals), (d, d_strides, depths), (k, k_strides, labels) = here
    (tap_p, tap_p_strides, _), (tap_n, tap_n_strides, _), (tap_d, tap_d_strides, _), (tap_k, tap_k_strides, _) = there
    tint, tint_strides, tints = albedo
    taps = 4 if moves else 1
    number = accumulated.dtype.type
    one, zero, half, least = number(1), number(0), number(0.5), number(1e-6)
    weights, places = np.empty((_CHUNK, 4), accumulated.dtype), np.empty((_CHUNK, 4), np.uint64)
    own = np.empty(4, np.bool_)
    sums, values = np.empty((channels, _CHUNK), accumulated.dtype), np.empty(_CHUNK, accumulated.dtype)
    # Weight of the frame, and that in the recent history.
    alphas = np.empty((2, _CHUNK), accumulated.dtype)
    for y in range(first, last):
        count = 0
        for x0 in range(0, width, _CHUNK):
            size = min(_CHUNK, width - x0)
            for i in range(size):
                x = x0 + i
                at_p = b * p_strides[0] + y * p_strides[2] + x * p_strides[3]
                at_n = b * n_strides[0] + y * n_strides[2] + x * n_strides[3]
                normal, point = (zero, zero, zero), (zero, zero, zero)
                if normals:
                    normal = (n[at_n], n[at_n + n_strides[1]], n[at_n + 2 * n_strides[1]])
                if positions:
                    point = (p[at_p], p[at_p + p_strides[1]], p[at_p + 2 * p_strides[1]])
                at_motion = b * motion_strides[0] + y * motion_strides[2] + x * motion_strides[3]
                depth = d[b * d_strides[0] + y * d_strides[2] + x * d_strides[3]] if depths else zero
                hit = math.isfinite(depth)
                qx, qy = number(x), number(y)
                if moves:
                    qx += moved[at_motion]
                    qy += moved[at_motion + motion_strides[1]]
                # Not so for a NaN either.
                reachable = -1 < qx < width and -1 < qy < height
                left, top = (np.int64(qx) - (qx < 0), np.int64(qy) - (qy < 0)) if reachable else (0, 0)
                fx, fy = qx - number(left), qy - number(top)
                label = k[b * k_strides[0] + y * k_strides[2] + x * k_strides[3]] if labels else zero
                weight = length = own_weight = own_length = zero
                kept = 0
                for tap in range(taps if reachable else 0):
                    row, column = top + tap // 2, left + tap % 2
                    if row < 0 or row >= height or column < 0 or column >= width:
                        continue
                    at_tap_p = np.uint64(b * tap_p_strides[0] + row * tap_p_strides[2] + column * tap_p_strides[3])
                    at_tap_n = np.uint64(b * tap_n_strides[0] + row * tap_n_strides[2] + column * tap_n_strides[3])
                    if normals:
                        turn = zero
                        for c in range(3):
                            difference = tap_n[at_tap_n + np.uint64(c * tap_n_strides[1])] - normal[c]
                            turn += difference * difference
                        if not (turn < normal_limit or (turn == normal_limit and not bmfr)):
                            continue
                    if bmfr or depths:
                        squares = across = zero
                        for c in range(3 if positions else 0):
                            difference = tap_p[at_tap_p + np.uint64(c * tap_p_strides[1])] - point[c]
                            squares += difference * difference
                            if normals:
                                across += difference * normal[c]
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
                    taken = (
                        bilinear
                        * old_length[b * length_strides[0] + row * length_strides[2] + column * length_strides[3]]
                    )
                    weight += bilinear
                    length += taken
                    if labels:
                        at_label = b * tap_k_strides[0] + row * tap_k_strides[2] + column * tap_k_strides[3]
                        own[kept] = tap_k[at_label] == label
                        if own[kept]:
                            own_weight += bilinear
                            own_length += taken
                    weights[i, kept] = bilinear
                    places[i, kept] = b * old_strides[0] + row * old_strides[2] + column * old_strides[3]
                    kept += 1
                if own_weight > label_weight:
                    found, kept = kept, 0
                    for tap in range(found):
                        if own[tap]:
                            weights[i, kept], places[i, kept] = weights[i, tap], places[i, tap]
                            kept += 1
                    weight, length = own_weight, own_length
                # Rejected taps may be NaN, and 0 * NaN is NaN: point them at an accepted tap with weight 0.
                for tap in range(kept, 4):
                    weights[i, tap] = zero
                    places[i, tap] = places[i, 0] if kept else np.uint64(0)
                if not fresh:
                    lengths[b, 0, y, x] = weight
                    for tap in range(kept if weight > 0 else 0):
                        weights[i, tap] /= weight
                    continue
                if not weight > 0:
                    alphas[:, i] = one
                    lengths[b, 0, y, x] = one
                    continue
                inverse = one / weight
                for tap in range(kept):
                    weights[i, tap] *= inverse
                length = length * inverse + one
                newest = one / length
                alpha = max(newest, alpha_min)
                excess = one
                if bmfr:
                    # The history is shortened from the rounded length, while it was blended with the unrounded one.
                    length = min(np.rint(length - one) + one, number(255))
                    newest = one / length
                    excess = (one - alpha) / max(one - max(newest, alpha_min), least)
                if length > one:
                    count += 1
                if moves and tints and length > longest:
                    dx, dy = moved[at_motion], moved[at_motion + motion_strides[1]]
                    at_tint = b * tint_strides[0] + y * tint_strides[2] + x * tint_strides[3]
                    specular = dx * dx + dy * dy > still * still
                    for c in range(3):
                        specular = specular and tint[at_tint + c * tint_strides[1]] < no_albedo
                    if specular:
                        length, newest = longest, one / longest
                        alpha = one - excess * (one - max(newest, alpha_min))
                lengths[b, 0, y, x] = length
                alphas[0, i] = alpha
                alphas[1, i] = one - excess * (one - max(newest, recent_alpha))
            if tap_weights.shape[0]:
                for i in range(size):
                    for tap in range(4):
                        tap_weights[b, y, x0 + i, tap] = weights[i, tap]
                        tap_places[b, y, x0 + i, tap] = np.int64(places[i, tap])
            for i in range(size):
                w0, w1, w2, w3 = weights[i, 0], weights[i, 1], weights[i, 2], weights[i, 3]
                i0, i1, i2, i3 = places[i, 0], places[i, 1], places[i, 2], places[i, 3]
                plane = np.uint64(0)
                for c in range(channels):
                    sums[c, i] = (
                        w0 * old[i0 + plane] + w1 * old[i1 + plane] + w2 * old[i2 + plane] + w3 * old[i3 + plane]
                    )
                    plane += np.uint64(old_strides[1])
            if not fresh:
                for c in range(channels):
                    for i in range(size):
                        accumulated[b, c, y, x0 + i] = sums[c, i] if lengths[b, 0, y, x0 + i] > 0 else zero
                continue
            for c in range(channels):
                recent = 1 if c >= fresh else 0
                start = b * new_strides[0] + (c - recent * fresh) * new_strides[1]
                start += y * new_strides[2] + x0 * new_strides[3]
                if new_strides[3] == 1:
                    values[:size] = new[start : start + size]
                else:
                    for i in range(size):
                        values[i] = new[start + i * new_strides[3]]
                out, history, alpha = accumulated[b, c, y, x0 : x0 + size], sums[c], alphas[recent]
                for i in range(size):
                    # From the nearer end, as torch.lerp does.
                    change = values[i] - history[i]
                    far = history[i] + alpha[i] * change
                    near = values[i] - change * (one - alpha[i])
                    out[i] = far if alpha[i] < half else near if alpha[i] < one else values[i]
        counts[b, y] = count


# With derivatives.

# Buffer by buffer: lists in which something may be missing have no derivatives.
_SURFACES = (*Surface._fields, *(f"previous_{name}" for name in Surface._fields))
_ARGUMENTS = (
    "Tensor color, Tensor old, Tensor old_length, Tensor? motion, "
    + "".join(f"Tensor? {name}, " for name in _SURFACES)
    + "float alpha_min, str rule, float? position_limit, float? normal_limit"
)


@custom_op("mcdenoise::accumulate_pair", device_types="cpu", schema=f"({_ARGUMENTS}) -> (Tensor, Tensor)")
def _accumulate_pair(*arguments: Any) -> tuple[Tensor, Tensor]:
    return blended(*_as_called(arguments))[:2]


def _as_called(arguments: Sequence[Any]) -> list[Any]:
    """The arguments of the op of those of the operator; a surface of nothing is none."""
    surfaces = Surface(*arguments[4:8]), Surface(*arguments[8:12])
    known = (surface if any(each is not None for each in surface) else None for surface in surfaces)
    return [*arguments[:4], *known, *arguments[12:]]


@_accumulate_pair.register_fake
def _(color: Tensor, previous: Tensor, previous_length: Tensor, *_: Any) -> tuple[Tensor, Tensor]:
    return color.new_empty(previous.shape), previous_length.new_empty(previous_length.shape)


def accumulate(
    color: Tensor,
    previous: Tensor,
    previous_length: Tensor,
    motion: Tensor | None,
    surface: Surface | None,
    previous_surface: Surface | None,
    alpha_min: float,
    rule: str,
    *limits: float | None,
) -> Any:
    """See :func:`mcdenoise.ops.accumulate`."""
    here, there = comparable(surface, previous_surface)
    return _accumulate_pair(color, previous, previous_length, motion, *here, *there, alpha_min, rule, *limits)


def _by_name(plain: Callable[..., Any], arguments: Sequence[Any]) -> Any:
    images, settings = arguments[:6], arguments[6:]
    names = ("alpha_min", "rule", "position_limit", "normal_limit")
    return plain(*images, **dict(zip(names, settings, strict=True)))


class _Gradients:
    """The derivatives of both results: find the taps again, then each pixel's gradients, then those of its taps."""

    operator, of_all = _accumulate_pair, True

    @staticmethod
    def adapted(plain: Callable[..., Any]) -> Callable[..., Any]:
        """The reference implementation, with the arguments of the operator."""
        return lambda *arguments: _by_name(plain, _as_called(arguments))

    def __call__(self, needed: Sequence[Any], gradient: Tensor, of_length: Tensor, *arguments: Any) -> tuple[Any, ...]:
        color, previous, previous_length, motion = arguments[:4]
        surface, previous_surface, limits = Surface(*arguments[4:8]), Surface(*arguments[8:12]), arguments[-2:]
        alpha_min, rule = arguments[12:14]
        dtype = torch.promote_types(color.dtype, torch.float32)
        batch, channels, height, width = previous.shape
        images = [image.detach().to(dtype).contiguous() for image in (color, previous, previous_length)]
        moved = color.new_zeros((0, 0, 0, 0)) if motion is None else motion.detach()
        found = [torch.zeros_like(image) for image in images] + [torch.zeros_like(moved, dtype=dtype)]
        if previous.numel():
            weights = images[0].new_empty((batch, height, width, 4))
            taps = weights, torch.empty(weights.shape, dtype=torch.int64, device="cpu")
            settings = (alpha_min, *_limits(surface, *limits), 1.0, None, math.inf, 0.0, rule == "bmfr")
            _pass(images[0], images[1], images[2], motion, surface, previous_surface, *settings, taps)
            # The gradients of each pixel's history and of its length.
            spread = images[0].new_empty((batch, channels + 1, height, width))
            given = [each.to(dtype).contiguous() for each in (gradient, of_length)]
            arrays = [each.numpy() for each in (*images, moved.to(dtype).contiguous(), *given, *taps, spread)]
            results = [each.numpy() for each in found]
            least = images[0].new_tensor([alpha_min]).numpy()[0]
            handed = (results[0], results[3], *arrays, least, rule == "bmfr")
            share_rows(color, lambda *rows: _differentiate_pixels(*handed, *rows))
            # Pixels of many rows may have a tap in common, planes have nothing: so results are the same in every run.
            planes = spread.flatten(2)[:, None]
            share_rows(planes, lambda *rows: _spread(results[1], results[2], *arrays[-3:], *rows))
        inputs = (color, previous, previous_length, moved)
        own = [each.to(like.dtype) for each, like in zip(found, inputs, strict=True)]
        return (*own[:3], None if motion is None else own[3], *[None] * len(arguments[4:]))


accumulate_gradients = _Gradients()


@compiled
def _differentiate_pixels(
    of_color: Any,
    of_motion: Any,
    color: Any,
    previous: Any,
    lengths: Any,
    motion: Any,
    gradient: Any,
    of_length: Any,
    weights: Any,
    places: Any,
    spread: Any,
    alpha_min: float,
    bmfr: bool,
    b: int,
    first: int,
    last: int,
) -> None:
    """Derivatives in a pixel's color and motion, and those that are spread over the taps of its history and length."""
    _, channels, height, width = color.shape
    number = color.dtype.type
    one, zero = number(1), number(0)
    moves = motion.size > 0
    old, spans = previous[b].reshape(channels, height * width), lengths[b].reshape(height * width)
    values = np.empty(4, color.dtype)
    for y in range(first, last):
        for x in range(width):
            w0, w1, w2, w3 = weights[b, y, x, 0], weights[b, y, x, 1], weights[b, y, x, 2], weights[b, y, x, 3]
            if not w0 + w1 + w2 + w3 > zero:
                for c in range(channels):
                    of_color[b, c, y, x] = gradient[b, c, y, x]
                    spread[b, c, y, x] = zero
                spread[b, channels, y, x] = zero
                continue
            start = b * channels * height * width
            p0, p1 = places[b, y, x, 0] - start, places[b, y, x, 1] - start
            p2, p3 = places[b, y, x, 2] - start, places[b, y, x, 3] - start
            newest = one / (w0 * spans[p0] + w1 * spans[p1] + w2 * spans[p2] + w3 * spans[p3] + one)
            alpha = max(newest, alpha_min)
            of_alpha = zero
            values[:] = zero
            for c in range(channels):
                own, slope = old[c], gradient[b, c, y, x]
                history = w0 * own[p0] + w1 * own[p1] + w2 * own[p2] + w3 * own[p3]
                of_alpha += slope * (color[b, c, y, x] - history)
                of_color[b, c, y, x] = slope * alpha
                slope_of_history = slope * (one - alpha)
                spread[b, c, y, x] = slope_of_history
                values[0] += slope_of_history * own[p0]
                values[1] += slope_of_history * own[p1]
                values[2] += slope_of_history * own[p2]
                values[3] += slope_of_history * own[p3]
            # A rounded length has no derivative.
            slope_of_length = zero if bmfr else of_length[b, 0, y, x]
            if newest >= alpha_min:
                slope_of_length -= of_alpha * newest * newest
            spread[b, channels, y, x] = slope_of_length
            if not moves:
                continue
            for tap in range(4):
                values[tap] += slope_of_length * spans[places[b, y, x, tap] - start]
            mean = w0 * values[0] + w1 * values[1] + w2 * values[2] + w3 * values[3]
            qx, qy = number(x) + motion[b, 0, y, x], number(y) + motion[b, 1, y, x]
            left, top = np.int64(math.floor(qx)), np.int64(math.floor(qy))
            fx, fy = qx - number(left), qy - number(top)
            total = across = along = zero
            for tap in range(4):
                place = places[b, y, x, tap] - start
                # An accepted tap that stands in for a rejected one.
                if tap and place == p0:
                    continue
                right, below = place % width > left, place // width > top
                wide, high = fx if right else one - fx, fy if below else one - fy
                total += wide * high
                across += (values[tap] - mean) * (high if right else -high)
                along += (values[tap] - mean) * (wide if below else -wide)
            of_motion[b, 0, y, x], of_motion[b, 1, y, x] = across / total, along / total


@compiled
def _spread(
    of_previous: Any, of_length: Any, weights: Any, places: Any, spread: Any, b: int, first: int, last: int
) -> None:
    """Add the gradients of pixels to those of their taps, for some of the planes; the last plane is the length."""
    _, channels, height, width = of_previous.shape
    start = b * channels * height * width
    for c in range(first, last):
        plane = of_previous[b, c] if c < channels else of_length[b, 0]
        flat = plane.reshape(height * width)
        for y in range(height):
            for x in range(width):
                slope = spread[b, c, y, x]
                if slope != 0:
                    for tap in range(4):
                        flat[places[b, y, x, tap] - start] += weights[b, y, x, tap] * slope
