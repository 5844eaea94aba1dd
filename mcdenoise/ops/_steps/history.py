"""The steps of a history from frame to frame: the color that enters it, where lights are seen, and the blend."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.ops._check import check_shapes
from mcdenoise.ops._constants import (
    BRIGHTER,
    EVEN,
    LIGHT_WINDOW,
    NO_ALBEDO,
    RECENT_ALPHA,
    RECENT_FRAMES,
    STILL,
)
from mcdenoise.ops._history import MEAN, RECENT, RECENT_MEAN, SQUARE, Blended, light_changes, root_variance
from mcdenoise.ops._op import op, plain
from mcdenoise.ops._surface import Surface
from mcdenoise.ops._window import block_means, of_blocks
from mcdenoise.ops.fireflies import LIMIT, clamp_fireflies
from mcdenoise.ops.lag import history_lag
from mcdenoise.ops.temporal import accumulate, check_accumulate


def incoming(color: Tensor, limit: float | Tensor = LIMIT, *, compared: bool = True) -> Tensor:
    """A frame as it enters a history: without fireflies.

    ``clamp_fireflies(color)``, and for the test for lag the fourth root ``r`` of the mean over its channels, in which a
    firefly hides little, and ``r^2``. Any power keeps the ratio of a difference to its noise at any exposure; a
    logarithm would need a unit.

    Args:
        color: ``(B, 3, H, W)`` radiance, finite and non-negative.
        limit: see :func:`mcdenoise.ops.clamp_fireflies`; a number, or ``(B, 1, 1, 1)`` of each image.
        compared: whether the two channels for the test for lag are wanted; they have no derivative.

    Returns:
        ``(B, 5, H, W)``, or ``(B, 3, H, W)`` without the two; at least float32, in which half precision is computed.
    """
    color = clamp_fireflies(color.to(torch.promote_types(color.dtype, torch.float32)), limit=limit)
    if not compared:
        return color
    root = color.detach().mean(1, keepdim=True).clamp_min(0).sqrt().sqrt()
    return torch.cat([color, root, root.square()], 1)


@op("numba", root="B 1 H W")
def lights(root: Tensor) -> Tensor:
    """Find the lights in one frame: blocks of 3x3 pixels that are alike and brighter than the window around them.

    A block is alike if its fourth roots of radiance differ by at most 3 % of the largest; a pixel is bright if its own
    is above 1.2 times the mean of the 9x9 window around it (twice, in radiance).

    Args:
        root: ``(B, 1, H, W)`` fourth root of the radiance, as :func:`incoming` has it; non-negative.

    Returns:
        ``(B, 1, H, W)`` of 0 and 1 in the dtype of ``root``; no derivative.
    """
    root = root.detach()
    if min(root.shape[-2:]) < 3 or root.numel() == 0:
        return torch.zeros_like(root)
    largest, smallest = F.max_pool2d(root, 3, 1), -F.max_pool2d(-root, 3, 1)
    even = (largest - smallest <= EVEN * largest).to(root.dtype)
    some = F.max_pool2d(F.pad(even, (2, 2, 2, 2)), 3, 1)
    around = F.avg_pool2d(root, LIGHT_WINDOW, 1, LIGHT_WINDOW // 2, count_include_pad=False)
    return some * (root > BRIGHTER * around)


def without_history(entering: Tensor) -> Tensor:
    """All channels of a history of this one frame.

    Args:
        entering: ``(B, 3 or 5, H, W)`` of :func:`incoming`.

    Returns:
        ``(B, 3 or 9, H, W)``.
    """
    return torch.cat([entering, entering[:, : SQUARE.start]], 1) if entering.shape[1] > SQUARE.start else entering


def _check_blend(
    entering: Tensor,
    previous: Tensor,
    surface: Surface | None,
    previous_surface: Surface | None,
    alpha_min: float,
    specular_length: float,
    lag_threshold: float,
) -> None:
    if not specular_length >= 0:
        raise ValueError(f"specular_length: expected at least 0, found {specular_length}")
    channels = ("C", "C") if math.isinf(lag_threshold) else (str(SQUARE.stop), str(RECENT.stop))
    check_shapes(entering=(entering, f"B {channels[0]} H W"), previous=(previous, f"B {channels[1]} H W"))
    check_accumulate(previous, surface, previous_surface, alpha_min)


@op(
    "numba",
    check=_check_blend,
    previous="B C H W",
    previous_length="B 1 H W",
    motion="[B 2 H W]",
    albedo="[B 3 H W]",
)
def blend(
    entering: Tensor,
    previous: Tensor,
    previous_length: Tensor,
    motion: Tensor | None,
    surface: Surface | None = None,
    previous_surface: Surface | None = None,
    *,
    alpha_min: float = 0.1,
    albedo: Tensor | None = None,
    specular_length: float = math.inf,
    lag_threshold: float = math.inf,
) -> Blended:
    """Accumulate a frame, with a shorter history where that is known to be wrong.

    1. :func:`mcdenoise.ops.accumulate`.
    2. Where nothing diffuse is seen (no channel of the albedo reaches 1e-4: mirrors, glass) and the motion is longer
       than 0.05 pixels, the history is shortened to ``specular_length`` frames and this one. Which pixels those are is
       known in this frame, the history's length in the previous one; so it is shortened after it was blended in:
       ``lerp(color, history, p)`` with a smaller ``p`` lies on the way back to ``color``.
    3. With a finite ``lag_threshold``, histories are replaced by shorter ones as far as
       :func:`mcdenoise.ops.history_lag` says, of the fourth roots of radiance, in half the resolution: a second
       history of about four frames for the current frame, and the long one for that. The variance of the noise is the
       variance of the root over the history. Then both are scaled by the change of the light that larger windows
       show, see :func:`mcdenoise.ops._history.light_changes`. The decisions have no derivative.

    Args:
        entering: ``(B, 5, H, W)`` of :func:`incoming`; any number of channels without a test for lag.
        previous: ``(B, 9, H, W)`` history of the previous frame, ``color`` of an earlier result or
            :func:`without_history`; the channels of ``entering`` without a test for lag.
        previous_length: ``(B, 1, H, W)`` its length.
        motion: see :func:`mcdenoise.ops.accumulate`; ``None`` also shortens no history of mirrors.
        surface: see :func:`mcdenoise.ops.reproject`.
        previous_surface: see :func:`mcdenoise.ops.reproject`.
        alpha_min: see :func:`mcdenoise.ops.accumulate`.
        albedo: ``(B, 3, H, W)``, which says where mirrors and glass are; without it no history is shortened for them.
        specular_length: in frames, at least 0.
        lag_threshold: see :func:`mcdenoise.ops.history_lag`; infinity makes no test.

    Returns:
        See :class:`Blended`; the dtypes of ``entering`` and of ``previous_length``.

    Raises:
        TypeError: as :func:`mcdenoise.ops.accumulate`.
        ValueError: as :func:`mcdenoise.ops.accumulate`, or ``specular_length`` is negative.
    """
    tests = not math.isinf(lag_threshold)
    recent_alpha = max(alpha_min, RECENT_ALPHA)
    both = without_history(entering) if tests else entering
    color, length = plain(accumulate)(
        *(both, previous, previous_length, motion, surface, previous_surface),
        alpha_min=alpha_min,
    )
    pixels = max(length.shape[-2] * length.shape[-1], 1)
    kept = (length > 1).sum((1, 2, 3)) / pixels
    if albedo is not None and motion is not None and specular_length < math.inf:
        color, length = _shortened(specular_length + 1, alpha_min, both, color, length, albedo, motion)
    if tests:
        color, length = _without_lag(lag_threshold, alpha_min, recent_alpha, both, color, length)
    return Blended(color, length.to(previous_length.dtype), kept)


def _weight_of_history(length: Tensor, alpha_min: float) -> Tensor:
    """In a result of that length, see :func:`mcdenoise.ops.accumulate`."""
    return 1 - (1 / length).clamp_min(alpha_min)


def _shortened(
    longest: float, alpha_min: float, color: Tensor, blended: Tensor, length: Tensor, albedo: Tensor, motion: Tensor
) -> tuple[Tensor, Tensor]:
    """Color and length if the history of mirrors and glass that move is no longer than that."""
    # A reduction over the channels takes a hundred times as long.
    # No hypot, which graphs in ONNX do not have.
    moves = motion[:, :1].square() + motion[:, 1:].square() > STILL**2
    specular = albedo.amax(1, keepdim=True) < NO_ALBEDO
    too_long = moves & specular & (length > longest)
    weight = _weight_of_history(length.clamp_max(longest), alpha_min)
    weight = weight / _weight_of_history(length, alpha_min).clamp_min(1e-6)
    shortened = torch.lerp(color, blended, weight.to(color.dtype))
    return torch.where(too_long, shortened, blended), torch.where(too_long, longest, length)


def _without_lag(
    threshold: float, alpha_min: float, recent_alpha: float, color: Tensor, blended: Tensor, length: Tensor
) -> tuple[Tensor, Tensor]:
    """Color and length without lag: the frame corrects the recent history, and the recent history the long one."""
    mean, variance = blended[:, MEAN], root_variance(blended, length)
    # Accumulated with the long one's weight of the frame, which is the smaller one.
    weight = _weight_of_history(length, recent_alpha) / _weight_of_history(length, alpha_min).clamp_min(1e-6)
    recent = torch.lerp(color[:, RECENT], blended[:, RECENT], weight)
    recent = torch.lerp(recent, color[:, RECENT], _lag(threshold, recent[:, 3:], color[:, RECENT_MEAN], variance))
    given_up = _lag(threshold, mean, recent[:, 3:], variance / length.clamp_max(RECENT_FRAMES))
    shorter = torch.cat([recent, recent[:, 3:].square() + variance], 1)
    longer = torch.lerp(blended[:, : RECENT.start], shorter, given_up)
    history, length = torch.cat([longer, recent], 1), torch.lerp(length, length.clamp_max(1 / recent_alpha), given_up)
    return history * light_changes(history, length, color[:, MEAN]), length


def _lag(threshold: float, history: Tensor, recent: Tensor, variance: Tensor) -> Tensor:
    """The test in half the resolution, for a quarter of the time: a window holds as many pixels, in blocks of four."""
    halves = (block_means(image.detach(), 2) for image in (history, recent, variance / 4))
    return of_blocks(history_lag(*halves, threshold=threshold), 2, *history.shape[-2:])
