"""The vocabulary of buffers: names, layout, unit and range of everything that a renderer provides; checks of values."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import torch
from torch import Tensor

from mcdenoise.errors import InputError, level_of_caller
from mcdenoise.light import LARGEST_RADIANCE

# Half floats and a renderer's own arithmetic may exceed a range by this.
_ROUNDING = 1e-2


@dataclass(frozen=True)
class BufferSpec:
    """Channels, range and meaning of a buffer.

    Args:
        channels: number of channels.
        low: smallest legal value.
        high: largest legal value.
        meaning: unit and convention, for messages and documentation.
        infinite: whether infinity is legal, within the range (nothing was hit, or there is no previous position).
        slack: values may exceed ``high`` by this before they are rejected; they are clamped.
        forgiven: whether larger values are also clamped, with a warning, if they are less than half of the buffer.
    """

    channels: int
    low: float
    high: float
    meaning: str
    infinite: bool = False
    slack: float = _ROUNDING
    forgiven: bool = False


_UNBOUNDED = float("inf")

BUFFERS: dict[str, BufferSpec] = {
    "color": BufferSpec(3, 0.0, _UNBOUNDED, "noisy radiance, scene-linear RGB, not clamped"),
    "albedo": BufferSpec(
        3, 0.0, 1.0, "diffuse reflectance, linear RGB; 0 where there is none", slack=1.0, forgiven=True
    ),
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
    "diffuse": BufferSpec(3, 0.0, LARGEST_RADIANCE, "noisy radiance by diffuse reflection, with albedo"),
    "specular": BufferSpec(3, 0.0, LARGEST_RADIANCE, "noisy radiance by specular reflection"),
    "specular_albedo": BufferSpec(3, 0.0, 1.0, "specular reflectance, linear RGB", slack=1.0, forgiven=True),
    "roughness": BufferSpec(1, 0.0, 1.0, "perceptual roughness: 0 is a mirror"),
    "emission": BufferSpec(3, 0.0, LARGEST_RADIANCE, "radiance sent out by the surface itself, without noise"),
    "variance": BufferSpec(3, 0.0, _UNBOUNDED, "variance of the mean that color is, of each channel"),
    "alpha": BufferSpec(1, 0.0, 1.0, "coverage: 0 where only background is seen"),
    "mask": BufferSpec(1, 0.0, 1.0, "validity: 0 where a pixel is void, such as a texel outside of all charts"),
    "reference": BufferSpec(3, 0.0, LARGEST_RADIANCE, "converged radiance, scene-linear RGB"),
    "current": BufferSpec(3, 0.0, LARGEST_RADIANCE, "radiance of this frame alone, where color is accumulated"),
    "recent": BufferSpec(3, 0.0, LARGEST_RADIANCE, "radiance of the last few frames, where color is accumulated"),
    "length": BufferSpec(1, 0.0, _UNBOUNDED, "history length of an accumulated color, in frames"),
}


# Buffers of radiance, which scale with the light of a scene; the first three channels of samples also do.
RADIANCE = ("color", "current", "recent", "diffuse", "specular", "emission")

# Buffers that only tell where a pixel was in the previous frame: they are not needed without a history.
MOTION = frozenset({"position", "motion", "previous_position"})


def tells_motion(buffers: Collection[str]) -> bool:
    """Whether these buffers tell where a pixel was in the previous frame: motion, or positions and cameras."""
    return "motion" in buffers or {"position", "view_projection"} <= set(buffers)


# Which axis of an array holds the channels.
Layout: TypeAlias = Literal["HWC", "CHW"]

_MATRIX = BufferSpec(0, -_UNBOUNDED, _UNBOUNDED, "world-to-clip matrix")
MATRIX = "view_projection"
_ANYTHING = BufferSpec(0, -_UNBOUNDED, _UNBOUNDED, "anything", infinite=True)


def check_values(name: str, value: Tensor) -> Tensor:
    """The values, clamped to the range of their buffer."""
    spec = _spec_of(name)
    low, high = (float(extreme) for extreme in torch.aminmax(value.detach()))
    # NaN propagates through minimum and maximum and fails the comparison; only then is every value checked again.
    if not -_UNBOUNDED < low <= high < _UNBOUNDED and (bad := _illegal(spec, value)).any():
        where = bad.nonzero()[0].tolist()
        place = f"first at row {where[2]}, column {where[3]}" if len(where) == 4 else f"first at {where[1:]}"
        _judge(name, low, high, int(bad.sum()), place=f", {place}")
    if low >= spec.low and high <= spec.high:
        return value
    _judge(name, low, high, above=float(_above(spec, value)) if high > _limit(spec) else 0.0)
    return value.clamp(spec.low, spec.high)


def clamped(
    buffers: Mapping[str, Tensor],
) -> tuple[dict[str, Tensor], list[Tensor], Callable[[Sequence[float]], None]]:
    """Like :func:`check_values` of several buffers without waiting for their device.

    Returns:
        The buffers that are clamped to their range; numbers on the device that tell which values are illegal; and what
        raises errors, and warns, as soon as these numbers are known.
    """
    changes: dict[str, Tensor] = {}
    numbers: list[Tensor] = []
    for name, value in buffers.items():
        spec, seen = _spec_of(name), value.detach()
        numbers += [*torch.aminmax(seen), _illegal(spec, seen).sum(), _above(spec, seen)]
        if spec.high != _UNBOUNDED or spec.low != -_UNBOUNDED:
            changes[name] = value.clamp(spec.low, spec.high)

    def judge(read: Sequence[float]) -> None:
        found = iter(read)
        for name in buffers:
            _judge(name, *(next(found) for _ in range(4)))

    return changes, numbers, judge


def _spec_of(name: str) -> BufferSpec:
    return _MATRIX if name == MATRIX else BUFFERS.get(name, _ANYTHING)


def _limit(spec: BufferSpec) -> float:
    """Values up to this are clamped; it includes the rounding of the largest radiance."""
    return spec.high + max(spec.slack, 1e-6 * spec.high)


def _above(spec: BufferSpec, value: Tensor) -> Tensor:
    """The fraction of values above the limit."""
    return (value > _limit(spec)).double().mean()


def _illegal(spec: BufferSpec, value: Tensor) -> Tensor:
    if spec.infinite:
        return torch.isnan(value) | ((value == -_UNBOUNDED) & (spec.low != -_UNBOUNDED))
    return ~torch.isfinite(value)


def _judge(name: str, low: float, high: float, illegal: float = 0, above: float = 0, *, place: str = "") -> None:
    """Reject a number of illegal values, or a range; warn if the fraction ``above`` its limit is small."""
    spec = _spec_of(name)
    if illegal:
        expected = "finite values or inf" if spec.infinite else "finite values"
        advice = "set them to inf where there is none" if spec.infinite else "render the buffer again"
        raise InputError(
            f"buffer '{name}': expected {expected} ({spec.meaning}), "
            f"found {illegal:.0f} NaN or infinite ones{place}; {advice}, or leave the buffer out"
        )
    # Single large reflectances are the fault of a pixel; if most are large, the buffer has another unit or content.
    forgiven = high > _limit(spec) and spec.forgiven and above < 0.5
    if forgiven:
        warnings.warn(
            f"buffer '{name}': expected values up to {spec.high:g} ({spec.meaning}), found some up to {high:.4g}, "
            f"which count as {spec.high:g}; leave the buffer out if it is another one",
            stacklevel=level_of_caller(),
        )
    if low < spec.low - _ROUNDING or (high > _limit(spec) and not forgiven):
        raise InputError(
            f"buffer '{name}': expected values in [{spec.low:g}, {spec.high:g}] ({spec.meaning}), "
            f"found [{low:.4g}, {high:.4g}]"
        )


_FLOATS = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
# What torch itself makes of tensors while it records a graph or differentiates.
_OF_TORCH = ("torch._subclasses", "torch._functorch", "torch._C", "torch.fx", "torch.nn.parameter")


def ordinary(what: str, value: object) -> Tensor:
    """A dense tensor of a float dtype with which all of torch computes; anything else is refused in one line."""
    if not isinstance(value, Tensor):
        raise InputError(f"{what}: expected a torch.Tensor, found {type(value).__name__}")
    if type(value) is not Tensor and not type(value).__module__.startswith(_OF_TORCH):
        found, advice = f"its subclass {type(value).__name__}", "pass as_subclass(torch.Tensor) of it"
    elif value.is_nested or value.layout != torch.strided:
        found, advice = "a nested one" if value.is_nested else f"one of {value.layout}", "pass to_dense() of it"
    # A graph of torch.compile cannot ask.
    elif not torch.compiler.is_compiling() and value.is_neg():
        found, advice = "a view with the negative bit", "pass resolve_neg() of it"
    elif value.dtype not in _FLOATS:
        expected = "a floating-point dtype" + ("" if not value.is_floating_point() else " of 16, 32 or 64 bits")
        raise InputError(f"{what}: expected {expected}, found {value.dtype}")
    else:
        return value
    raise InputError(f"{what}: expected an ordinary torch.Tensor, found {found}; {advice}")
