"""The vocabulary of the project: what a renderer hands over for one frame, in which layout, unit and range."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import torch
from torch import Tensor

from mcdenoise.errors import InputError
from mcdenoise.ops._rows import by_rows

# How far half floats and a renderer's own arithmetic may lead out of a range.
_ROUNDING = 1e-2
# Largest radiance that counts as such, in whatever unit. Divided by the smallest albedo (0.04), squared, and summed
# over the 3 x 1024 numbers of the largest window of squares, it stays below the largest float32: (25e16)^2 3072 = 2e38.
LARGEST_RADIANCE = 1e16


@dataclass(frozen=True)
class BufferSpec:
    """What a buffer holds: its channels, range and meaning.

    Args:
        channels: number of channels.
        low: smallest legal value.
        high: largest legal value.
        meaning: unit and convention, for messages and documentation.
        infinite: whether infinity is legal, within the range (nothing was hit, or there is no previous position).
        slack: how far values may overshoot ``high`` before they are refused; up to there they are clamped.
    """

    channels: int
    low: float
    high: float
    meaning: str
    infinite: bool = False
    slack: float = _ROUNDING


_UNBOUNDED = float("inf")

BUFFERS: dict[str, BufferSpec] = {
    "color": BufferSpec(3, 0.0, _UNBOUNDED, "noisy radiance, scene-linear RGB, not clamped"),
    "albedo": BufferSpec(3, 0.0, 1.0, "diffuse reflectance, linear RGB; 0 where there is none", slack=1.0),
    "normal": BufferSpec(3, -1.0, 1.0, "shading normal, world space, unit length; 0 where nothing was hit"),
    "depth": BufferSpec(
        1, 0.0, _UNBOUNDED, "distance along the view axis, scene units; inf where nothing was hit", infinite=True
    ),
    "position": BufferSpec(3, -_UNBOUNDED, _UNBOUNDED, "world-space hit point, scene units"),
    "motion": BufferSpec(
        2, -_UNBOUNDED, _UNBOUNDED, "pixels, x right, y down: previous = current + motion", infinite=True
    ),
    "previous_position": BufferSpec(
        3, -_UNBOUNDED, _UNBOUNDED, "where the surface point seen now was in the previous frame, world space"
    ),
    "reference": BufferSpec(3, 0.0, LARGEST_RADIANCE, "converged radiance, scene-linear RGB"),
}


# What says where a pixel was in the frame before, and nothing else: of no use to a frame without one.
OF_THE_PAST = frozenset({"position", "motion", "previous_position"})

_MATRIX = BufferSpec(0, -_UNBOUNDED, _UNBOUNDED, "world-to-clip matrix")


# eq=False: comparing tensors has no single truth value, so frames are equal only to themselves.
@dataclass(frozen=True, eq=False)
class Frame:
    """One frame of a renderer's outputs: every buffer is ``(B, C, H, W)``, all of the same batch, size and device.

    Only ``color`` is required. Constructing a frame checks shapes, dtypes and devices (cheap); :meth:`validate` also
    looks at every value.

    Args:
        color: ``(B, 3, H, W)`` noisy radiance, scene-linear, non-negative, unclamped.
        albedo: ``(B, 3, H, W)`` diffuse reflectance in [0, 1]; 0 on emitters, mirrors, glass and background.
        normal: ``(B, 3, H, W)`` world-space unit shading normal in [-1, 1]; 0 where nothing was hit.
        depth: ``(B, 1, H, W)`` distance along the view axis in scene units; ``inf`` where nothing was hit.
        position: ``(B, 3, H, W)`` world-space hit point in scene units.
        motion: ``(B, 2, H, W)`` pixels, x right and y down, ``previous_position = current_position + motion``;
            infinite where there is no previous position.
        previous_position: ``(B, 3, H, W)`` world-space position, in the previous frame, of the surface point that is
            seen now; equal to ``position`` where nothing moves. The normal that this point had then is not kept: what
            compares normals across frames compares the current one, as if objects only moved and did not turn.
        view_projection: ``(B, 4, 4)`` row-vector world-to-clip matrix, ``clip = [x y z 1] @ M``; clip y points down.
        reference: ``(B, 3, H, W)`` converged radiance of the same pixels.

    Raises:
        InputError: a buffer has the wrong type, number of channels, size, dtype or device. The message names it.

    Example:
        >>> frame = Frame(color=torch.rand(1, 3, 4, 6), depth=torch.ones(1, 1, 4, 6))
        >>> frame.size
        (4, 6)
        >>> Frame(color=torch.rand(1, 3, 4, 6), albedo=torch.rand(1, 3, 4, 5))
        Traceback (most recent call last):
        ...
        mcdenoise.errors.InputError: buffer 'albedo': expected shape (1, 3, 4, 6) like 'color', found (1, 3, 4, 5)
    """

    color: Tensor
    albedo: Tensor | None = None
    normal: Tensor | None = None
    depth: Tensor | None = None
    position: Tensor | None = None
    motion: Tensor | None = None
    previous_position: Tensor | None = None
    view_projection: Tensor | None = None
    reference: Tensor | None = None

    def __post_init__(self) -> None:
        _check_buffer("color", self.color)
        if self.color.ndim != 4 or self.color.shape[1] != 3 or 0 in self.color.shape:
            raise InputError(f"buffer 'color': expected shape (B, 3, H, W), found {tuple(self.color.shape)}")
        batch, _, height, width = self.color.shape
        for name, value in self.items():
            _check_buffer(name, value)
            if value.device != self.color.device:
                raise InputError(
                    f"buffer '{name}': expected on {self.color.device} like 'color', found on {value.device}"
                )
            spec = BUFFERS.get(name)
            expected = (batch, spec.channels, height, width) if spec else (batch, 4, 4)
            if tuple(value.shape) != expected:
                raise InputError(f"buffer '{name}': expected shape {expected} like 'color', found {tuple(value.shape)}")

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.color.shape[2], self.color.shape[3]

    def items(self) -> Iterator[tuple[str, Tensor]]:
        """Name and tensor of every buffer that is present."""
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None:
                yield field.name, value

    def replace(self, **changes: Tensor | None) -> Frame:
        """The same frame with some buffers changed."""
        buffers: dict[str, Any] = dict(self.items()) | changes
        return Frame(**buffers)

    def to(self, target: torch.device | torch.dtype | str) -> Frame:
        """Every buffer moved to a device or converted to a dtype."""
        return Frame(**{name: value.to(target) for name, value in self.items()})

    def with_depth(self) -> Frame:
        """The same frame; without a depth but with positions and a camera, its depth is the clip w of the positions."""
        if self.depth is not None or self.position is None or self.view_projection is None:
            return self
        column = self.view_projection[:, :, 3, None, None]
        depth = (self.position * column[:, :3]).sum(1, keepdim=True) + column[:, 3:]
        return self.replace(depth=torch.where(depth > 0, depth, torch.inf))

    def without_past(self) -> Frame:
        """The same frame without the buffers that only a frame with a past needs."""
        return self.replace(**dict.fromkeys(OF_THE_PAST))

    def validate(self) -> tuple[Frame, int]:
        """Look at every value: repair what is a renderer's daily bread, refuse what would spoil the result.

        Pixels of ``color`` with NaN, infinity, a negative value or one above 1e16 get the mean of their usable 3x3
        neighbours (0 if there is none), so that they never spread. Values of ``albedo`` and ``normal`` that overshoot
        their range by rounding are clamped, and so are albedos up to 2 (rough conductors evaluated at the normal).

        Returns:
            The clean frame, and the number of pixels of ``color`` that were replaced.

        Raises:
            InputError: another buffer holds NaN, an illegal infinity or a value far outside its range.
        """
        return self.inspect()[:2]

    def inspect(self) -> Inspected:
        """As :meth:`validate`, and say what was seen of the features."""
        changes: dict[str, Tensor | None] = {}
        ranges: dict[str, tuple[float, float]] = {}
        color, replaced = replace_invalid(self.color)
        if replaced:
            changes["color"] = color
        for name, value in self.items():
            if name != "color":
                clean, ranges[name] = _check_values(name, value)
                if clean is not value:
                    changes[name] = clean
        return Inspected(self.replace(**changes) if changes else self, replaced, ranges)


class Inspected(NamedTuple):
    """A frame that was looked at.

    Args:
        frame: with valid values.
        replaced: number of pixels of ``color`` that were replaced.
        ranges: smallest and largest value of every buffer but ``color``, by name.
    """

    frame: Frame
    replaced: int
    ranges: dict[str, tuple[float, float]]


def replace_invalid(color: Tensor) -> tuple[Tensor, int]:
    """Replace pixels with NaN, infinite, negative or absurdly large radiance by the mean of usable 3x3 neighbours.

    Absurdly large is what is above :data:`LARGEST_RADIANCE` (1e16), from which on arithmetic in float32 overflows: of
    one such number a network makes an image of NaN.

    Args:
        color: ``(B, C, H, W)`` radiance.

    Returns:
        The clean radiance (``color`` itself where nothing was wrong), and the number of pixels that were replaced.

    Example:
        >>> color = torch.ones(1, 3, 3, 3)
        >>> color[0, 1, 1, 1] = float("nan")
        >>> clean, replaced = replace_invalid(color)
        >>> replaced, clean[0, :, 1, 1].tolist()
        (1, [1.0, 1.0, 1.0])
    """
    # One pass sees whether there is anything to look for: a NaN comes through.
    low, high = torch.aminmax(color)
    if low >= 0 and high <= LARGEST_RADIANCE and high < torch.inf:
        return color, 0
    usable = by_rows(_usable, color)
    return by_rows(_mended, color, usable, reach=1), int((~usable).sum())


def _usable(color: Tensor) -> Tensor:
    valid = torch.isfinite(color) & (color >= 0) & (color <= LARGEST_RADIANCE)
    return valid.all(dim=1, keepdim=True)


def _mended(color: Tensor, usable: Tensor) -> Tensor:
    zeroed = torch.where(usable, color, 0)
    # Divided before they are summed, and never in half precision: bright neighbours must not add up to infinity.
    dtype = torch.promote_types(color.dtype, torch.float32)
    total = torch.nn.functional.avg_pool2d(zeroed.to(dtype) / 9, 3, stride=1, padding=1, divisor_override=1)
    count = torch.nn.functional.avg_pool2d(usable.to(dtype), 3, stride=1, padding=1, divisor_override=1)
    return torch.where(usable, color, (total * (9 / count.clamp_min(1))).to(color.dtype))


def _check_buffer(name: str, value: object) -> None:
    if not isinstance(value, Tensor):
        raise InputError(f"buffer '{name}': expected a torch.Tensor, found {type(value).__name__}")
    if not value.is_floating_point():
        raise InputError(f"buffer '{name}': expected a floating-point dtype, found {value.dtype}")


def _check_values(name: str, value: Tensor) -> tuple[Tensor, tuple[float, float]]:
    """The values, clamped, and their extremes."""
    spec = BUFFERS.get(name, _MATRIX)
    low, high = (float(extreme) for extreme in torch.aminmax(value))
    # A NaN comes through the extremes and fails the comparison; only then is it worth to look at every value again.
    if not -_UNBOUNDED < low <= high < _UNBOUNDED:
        _refuse_illegal(name, spec, value)
    if (spec.high == _UNBOUNDED and spec.low == -_UNBOUNDED) or (low >= spec.low and high <= spec.high):
        return value, (low, high)
    if low < spec.low - _ROUNDING or high > spec.high + spec.slack:
        raise InputError(
            f"buffer '{name}': expected values in [{spec.low:g}, {spec.high:g}] ({spec.meaning}), "
            f"found [{low:.4g}, {high:.4g}]"
        )
    return value.clamp(spec.low, spec.high), (max(low, spec.low), min(high, spec.high))


def _refuse_illegal(name: str, spec: BufferSpec, value: Tensor) -> None:
    bad = ~torch.isfinite(value)
    if spec.infinite:
        bad = torch.isnan(value) | ((value == -_UNBOUNDED) & (spec.low != -_UNBOUNDED))
    if bad.any():
        where = bad.nonzero()[0].tolist()
        place = f"first at row {where[2]}, column {where[3]}" if len(where) == 4 else f"first at {where[1:]}"
        raise InputError(
            f"buffer '{name}': expected finite values ({spec.meaning}), "
            f"found {int(bad.sum())} NaN or infinite ones, {place}; render the buffer again or leave it out"
        )
