"""Reproject the previous frame, test which of its pixels show the same surface, and accumulate."""

from __future__ import annotations

import torch
from torch import Tensor

from mcdenoise.ops._check import check_shapes
from mcdenoise.ops._constants import DEPTH_LIMIT, LABEL_WEIGHT, NORMAL_LIMIT_SQUARED, PLANE_LIMIT
from mcdenoise.ops._module import module_of
from mcdenoise.ops._numbers import numbers_like
from mcdenoise.ops._op import op
from mcdenoise.ops._surface import Surface, check_surfaces, comparable


def motion_from_position(position: Tensor, previous_view_projection: Tensor) -> Tensor:
    """The motion of each point of a static surface: its place in the previous frame minus its place now.

    ``clip = [x y z 1] @ M``, ``(u, v) = (clip.xy / clip.w + 1) / 2``, ``motion = (u W, v H) - current pixel centre``.

    Args:
        position: ``(B, 3, H, W)`` world-space hit points of the current frame, scene units.
        previous_view_projection: ``(B, 4, 4)`` row-vector world-to-clip matrix of the previous frame, clip y down.

    Returns:
        ``(B, 2, H, W)`` motion in pixels, x right and y down, ``previous = current + motion``; infinite where the
        point was behind the previous camera or is not finite. Half precision gives float32. Holds for any position
        whose ``clip.w`` is between 1e-15 and 1e15, to eps times the image's size.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: shapes disagree.

    Differentiable in ``position`` and ``previous_view_projection``, to any order, where the point was in front.
    Half precision is projected in float32 (a pixel of a wide image needs more than 11 bits).

    Source: Koskela et al. 2019 (BMFR), ``accumulate_noisy_data``.

    Example:
        >>> position = torch.tensor([0.5, 0.0, 1.0]).reshape(1, 3, 1, 1)
        >>> motion_from_position(position, torch.eye(4)[None]).flatten().tolist()  # u = 0.75 of one pixel
        [0.25, 0.0]
    """
    check_shapes(position=(position, "B 3 H W"), previous_view_projection=(previous_view_projection, "B 4 4"))
    height, width = position.shape[-2:]
    dtype = torch.promote_types(position.dtype, torch.float32)
    matrix = previous_view_projection.to(dtype)
    # Where nothing was hit the position may be infinite, which would reach the matrix as a NaN gradient.
    hit = torch.isfinite(position).all(1, keepdim=True)
    point = torch.where(hit, position.to(dtype), 0)
    # Products and sums: autocast would round those of a matrix product to half precision.
    clip = matrix[:, 3, :, None, None]
    for axis in range(3):
        clip = clip + point[:, axis : axis + 1] * matrix[:, axis, :, None, None]
    w = clip[:, 3:]
    in_front = hit & (w > 0)
    scale = numbers_like(point, [width, height]).reshape(1, 2, 1, 1)
    previous = (clip[:, :2] / torch.where(in_front, w, 1) + 1) / 2 * scale
    centre = _pixel_grid(height, width, position.device, dtype) + 0.5
    return torch.where(in_front, previous - centre, torch.inf)


@op("numba", check=check_surfaces, previous="B C H W", motion="[B 2 H W]")
def reproject(
    previous: Tensor,
    motion: Tensor | None,
    surface: Surface | None = None,
    previous_surface: Surface | None = None,
    *,
    position_limit: float | None = None,
    normal_limit: float | None = None,
) -> tuple[Tensor, Tensor]:
    """Fetch the previous frame at the previous place of each pixel, from the bilinear taps that show the same surface.

    Around ``q = p + motion[p]`` each of the four pixels ``q_k`` with bilinear weight ``b_k`` is kept if it lies in
    the image and passes the consistency test; then ``weight = sum_kept b_k`` and
    ``value = sum_kept b_k previous[q_k] / weight`` (0 where nothing is kept).

    The test compares whatever both surfaces have:

    - positions: ``|dot(P_k - P, N)| <= position_limit * depth``, the distance off the tangent plane (``|P_k - P|``
      without normals; default 0.02). They need depths beside them;
    - depths alone: ``|d_k - d| <= position_limit * d`` (default 0.1); a pixel that hit nothing matches only such ones;
    - normals: ``|N_k - N|^2 <= normal_limit`` (default 0.5).

    The published rule has limits in scene units, which the scene must supply.

    A label is a preference: of the taps that pass, those of the pixel's own label are kept if they weigh more than
    0.001 together, else all of them. So a label that is wrong now and then shortens no history.

    Args:
        previous: ``(B, C, H, W)`` anything of the previous frame.
        motion: ``(B, 2, H, W)`` pixels, ``previous position = current position + motion``; a non-finite value means
            that there is no previous position. ``None`` means that nothing moves in the image: each pixel is tested
            against itself, and the result is, bit by bit, that of a motion of zeros.
        surface: the current frame's surface; ``None`` tests only for the image border.
        previous_surface: the previous frame's surface.
        position_limit: see above.
        normal_limit: see above.

    Returns:
        ``(B, C, H, W)`` value in the dtype of ``previous``, and ``(B, 1, H, W)`` kept weight in [0, 1].
        Correct for any motion, known or not, and any value of rejected taps; a place in the image is known to
        eps times its size.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: shapes disagree, or there are positions without depths.

    Differentiable in ``previous`` (to any order) and, between the pixel centres, in ``motion``; the test is a
    decision and has no derivative. Without a test it is ``kornia.geometry.transform.remap`` inside the image.

    Source: Koskela et al. 2019 (BMFR), ``accumulate_noisy_data``; Schied et al. 2017 (SVGF), Sec. 4.1.

    Example:
        >>> previous = torch.tensor([[[[1.0, 2.0, 3.0]]]])
        >>> motion = torch.tensor([0.5, 0.0]).reshape(1, 2, 1, 1).expand(1, 2, 1, 3)
        >>> value, weight = reproject(previous, motion)
        >>> value.flatten().tolist(), weight.flatten().tolist()
        ([1.5, 2.5, 3.0], [1.0, 1.0, 0.5])
    """
    here, there = comparable(surface, previous_surface)
    dtype = torch.promote_types(previous.dtype, torch.float32)
    there = Surface(*(None if buffer is None else buffer.to(dtype) for buffer in there))
    if motion is None:
        kept = torch.ones_like(previous[:, :1], dtype=torch.bool)
        kept = _alike(kept, here, there, position_limit, normal_limit)
        return torch.where(kept, previous, 0), kept.to(previous.dtype)
    height, width = previous.shape[-2:]

    known, base, fraction = places_before(motion, dtype)
    x0, y0 = base.split(1, 1)
    fx, fy = fraction.split(1, 1)

    # For each tap, one gather fetches all buffers to compare, and one all values to sum.
    tested = [buffer for buffer in there if buffer is not None]
    stack = torch.cat(tested, 1).flatten(2) if tested else None
    taps: list[tuple[Tensor, Tensor, Tensor]] = []
    alike = []
    for dy in (0, 1):
        for dx in (0, 1):
            x, y = x0 + dx, y0 + dy
            kept = known & (x >= 0) & (x < width) & (y >= 0) & (y < height)
            index = (y.clamp(0, height - 1) * width + x.clamp(0, width - 1)).flatten(2)
            tap_surface = Surface()
            if stack is not None:
                tap = stack.gather(2, index.expand(-1, stack.shape[1], -1)).reshape(*stack.shape[:2], height, width)
                parts = iter(torch.split(tap, [buffer.shape[1] for buffer in tested], 1))
                tap_surface = Surface(*(None if buffer is None else next(parts) for buffer in there))
            kept = _alike(kept, here, tap_surface, position_limit, normal_limit)
            bilinear = (fx if dx else 1 - fx) * (fy if dy else 1 - fy)
            if here.label is not None:
                alike.append(kept & (tap_surface.label == here.label.to(dtype)))
            taps.append((index, kept, torch.where(kept, bilinear, 0)))
    if alike:
        enough = sum(torch.where(own, tap[2], 0) for own, tap in zip(alike, taps, strict=True)) > LABEL_WEIGHT
        taps = [
            (index, kept & (own | ~enough), torch.where(own | ~enough, bilinear, 0))
            for own, (index, kept, bilinear) in zip(alike, taps, strict=True)
        ]
    values = torch.zeros_like(previous, dtype=dtype)
    weight = torch.zeros_like(fx)
    source = previous.to(dtype).flatten(2)
    for index, kept, bilinear in taps:
        value = source.gather(2, index.expand(-1, source.shape[1], -1)).reshape(values.shape)
        # A rejected tap may be NaN, and 0 * NaN is NaN.
        values = values + bilinear * torch.where(kept, value, 0)
        weight = weight + bilinear
    # The inverse of a denormal number may be infinite.
    found = weight >= torch.finfo(dtype).tiny
    values = torch.where(found, values / torch.where(found, weight, 1), 0)
    weight = torch.where(found, weight, 0)
    return values.to(previous.dtype), weight.to(previous.dtype)


def check_accumulate(
    previous: Tensor, surface: Surface | None, previous_surface: Surface | None, alpha_min: float
) -> None:
    """``TypeError`` or ``ValueError`` for arguments, besides shapes of images, that :func:`accumulate` refuses."""
    if not 0 < alpha_min <= 1:
        raise ValueError(f"alpha_min: expected in (0, 1], found {alpha_min}")
    check_surfaces(previous, surface, previous_surface)


@op(
    "numba",
    check=check_accumulate,
    color="B C H W",
    previous="B C H W",
    previous_length="B 1 H W",
    motion="[B 2 H W]",
)
def accumulate(
    color: Tensor,
    previous: Tensor,
    previous_length: Tensor,
    motion: Tensor | None,
    surface: Surface | None = None,
    previous_surface: Surface | None = None,
    *,
    alpha_min: float = 0.1,
    position_limit: float | None = None,
    normal_limit: float | None = None,
) -> tuple[Tensor, Tensor]:
    """Blend a noisy frame with its reprojected history: an average at first, an exponential window later.

    With the reprojected history ``h`` and its length ``n`` (:func:`reproject`),
    ``alpha = max(1 / (n + 1), alpha_min)``, ``accumulated = alpha color + (1 - alpha) h`` and ``length = n + 1``;
    where no tap is kept, ``accumulated = color`` and ``length = 1``. The published code has ``alpha_min=0.2``, and
    rounds the length to a byte.

    Args:
        color: ``(B, C, H, W)`` noisy radiance of the current frame, usually demodulated.
        previous: ``(B, C, H, W)`` accumulated radiance of the previous frame.
        previous_length: ``(B, 1, H, W)`` history length of the previous frame, in frames, at least 1.
        motion: ``(B, 2, H, W)`` pixels, ``previous position = current position + motion``; ``None`` where nothing moves
            in the image; the result is, bit by bit, that of a motion of zeros, in less time.
        surface: see :func:`reproject`.
        previous_surface: see :func:`reproject`.
        alpha_min: smallest weight of the current frame, in (0, 1].
        position_limit: see :func:`reproject`.
        normal_limit: see :func:`reproject`.

    Returns:
        ``(B, C, H, W)`` accumulated radiance in the dtype of ``color``, and ``(B, 1, H, W)`` history length in that of
        ``previous_length``. Between ``color`` and ``previous`` for any motion. The error of a history that is stored in
        the dtype's unit roundoff ``u`` stays below ``u / alpha_min`` of its largest value, however many frames; the
        length counts up to ``1 / u`` and stays there.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: shapes disagree, ``alpha_min`` is outside (0, 1], or as in :func:`reproject`.

    Differentiable in ``color``, ``previous``, ``previous_length`` and ``motion``, to any order.

    Source: Koskela et al. 2019 (BMFR), ``accumulate_noisy_data``.

    Example:
        >>> color, previous = torch.full((1, 3, 2, 2), 4.0), torch.zeros(1, 3, 2, 2)
        >>> accumulated, length = accumulate(color, previous, torch.full((1, 1, 2, 2), 3.0), torch.zeros(1, 2, 2, 2))
        >>> accumulated.unique().tolist(), length.unique().tolist()
        ([1.0], [4.0])
    """
    dtype = torch.promote_types(color.dtype, torch.float32)
    channels = color.shape[1]
    both, weight = reproject(
        torch.cat([previous.to(dtype), previous_length.to(dtype)], 1),
        motion,
        surface,
        previous_surface,
        position_limit=position_limit,
        normal_limit=normal_limit,
    )
    history, length = both[:, :channels], both[:, channels:]
    found = weight > 0
    alpha = torch.where(found, (1 / (length + 1)).clamp_min(alpha_min), 1)
    accumulated = torch.lerp(history, color.to(dtype), alpha)
    accumulated = torch.where(found, accumulated, color.to(dtype))
    length = torch.where(found, length + 1, 1)
    return accumulated.to(color.dtype), length.to(previous_length.dtype)


Accumulate = module_of(accumulate)


def places_before(motion: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
    """The place of each pixel in the previous frame, ``q = p + motion[p]``.

    Args:
        motion: ``(B, 2, H, W)`` pixels.
        dtype: in which places are computed.

    Returns:
        ``(B, 1, H, W)`` whether the motion is finite; ``(B, 2, H, W)`` integers, x first, the pixel at or before the
        place, or one that is far outside with all its neighbours; and ``(B, 2, H, W)`` the rest of the way to the
        place, in [0, 1) if it is not far outside. Where the motion is not finite, both are those of a motion of zeros.
    """
    height, width = motion.shape[-2:]
    motion = motion.to(dtype)
    known = torch.isfinite(motion).all(1, keepdim=True)
    q = _pixel_grid(height, width, motion.device, dtype) + torch.where(known, motion, 0)
    # Far outside counts as just outside, which is exact as an integer.
    limit = numbers_like(q, [width + 1, height + 1]).reshape(1, 2, 1, 1)
    base = torch.minimum(torch.maximum(q.detach().floor(), torch.full_like(limit, -2)), limit)
    return known, base.long(), q - base


def _pixel_grid(height: int, width: int, device: torch.device, dtype: torch.dtype) -> Tensor:
    """``(1, 2, H, W)`` integer pixel indices, x first."""
    # All of kornia comes with it, which takes as long to import as a single frame to denoise.
    from kornia.geometry.grid import create_meshgrid

    return create_meshgrid(height, width, normalized_coordinates=False, device=device, dtype=dtype).permute(0, 3, 1, 2)


def _alike(
    kept: Tensor, here: Surface, tap: Surface, position_limit: float | None, normal_limit: float | None
) -> Tensor:
    """The kept pixels in which both are the same surface."""
    if here.normal is not None and tap.normal is not None:
        limit = NORMAL_LIMIT_SQUARED if normal_limit is None else normal_limit
        kept = kept & ((tap.normal - here.normal).square().sum(1, keepdim=True) <= limit)
    if here.depth is None or tap.depth is None:
        return kept
    hit, tap_hit = torch.isfinite(here.depth), torch.isfinite(tap.depth)
    # Where nothing was hit there is no distance to compare: background matches background.
    depth = torch.where(hit, here.depth, 0).to(tap.depth.dtype)
    if here.position is not None and tap.position is not None:
        offset = tap.position - here.position
        if here.normal is not None:
            distance = (offset * here.normal).sum(1, keepdim=True).abs()
        else:
            distance = torch.linalg.vector_norm(offset, dim=1, keepdim=True)
        near = distance <= (PLANE_LIMIT if position_limit is None else position_limit) * depth
    else:
        distance = (torch.where(tap_hit, tap.depth, 0) - depth).abs()
        near = distance <= (DEPTH_LIMIT if position_limit is None else position_limit) * depth
    return kept & ((hit & tap_hit & near) | ~(hit | tap_hit))
