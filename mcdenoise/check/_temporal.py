"""Rows of the ops that carry images from frame to frame, and of the fused steps between them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Generator, Tensor

from mcdenoise import ops
from mcdenoise.check._pixels import WALL, noise, proportional, sky, sparks
from mcdenoise.check.case import Draw, Op, between, constant, dim, numbers, radiance, some, uniform
from mcdenoise.check.regimes import IMAGE, ORDINARY, SMALL, Argument, checked, extreme, ordinary, stiff
from mcdenoise.ops import Surface
from mcdenoise.ops._steps import history


def _compared(light: str, other: str) -> Any:
    """Another image is drawn as a multiple of the first."""

    def relate(inputs: dict[str, Any], settings: Mapping[str, Any]) -> None:
        inputs[light] = inputs[light].abs()
        inputs[other] = inputs[other] * inputs[light]
        proportional(light)(inputs, settings)

    return relate


def _goes_on(drawn: dict[str, Any]) -> None:
    drawn["history"], drawn["variance"] = torch.zeros_like(drawn["history"]), torch.zeros_like(drawn["variance"])


_NO_NOISE = {"recent": constant(1.0045), "variance": constant(0), "threshold": 3.0}
# Settings for which differences are 1 to 2 times the threshold, so that the result is neither 0 nor 1.
_LAG = checked(
    ops.history_lag,
    {
        "history": Argument(),
        "recent": Argument(between(1, 3), limits=numbers(0, 1e-30)),
        "variance": noise(0.25, 0.5, 1e15),
    },
    ordinary("darker by half", (1, 3, 4, 5), between(0.8, 1), recent=between(0.25, 0.75), threshold=4.0),
    # Without noise only the smallest visible difference counts; its square is smaller than the step of finite
    # differences in the variance.
    stiff("no noise", image=constant(0.9), smooth=("history", "recent"), **_NO_NOISE),
    extreme("the light goes on", (1, 3, 5, 6), uniform, change=_goes_on),
    extreme("the light goes on at 1e30", (1, 3, 5, 6), constant(1e30), change=_goes_on),
    settings={"threshold": (5.5, 3.0, 3.5, 2.0), "kernel_size": (5, 3, 3, 7)},
    image=between(0.8, 1),
    fireflies=None,
    relate=_compared("history", "recent"),
)


def _one_sample(drawn: dict[str, Any]) -> None:
    """A sample in one pixel of each stratum, and none in the first stratum."""
    drawn["weight"] = torch.zeros_like(drawn["weight"])
    drawn["weight"][..., 1::3, 2::3] = 1
    drawn["weight"][..., :3, :3] = 0


def _off(drawn: dict[str, Any]) -> None:
    drawn["current"][..., :3, :] = 0


def _gradient_rounds(inputs: dict[str, Any], settings: dict[str, Any]) -> dict[str, Tensor]:
    """Relative to the maximum luminance, values below the smallest number of float32 become 0."""
    if not inputs["current"].numel():
        return {}
    limits = torch.finfo(torch.float32)
    largest = max(float(inputs[name].abs().max()) for name in ("current", "previous"))
    powers = {"current": 1, "previous": 1, "variance": 2}
    return {
        name: inputs[name].abs().clamp_min(limits.tiny / limits.eps * largest**power)
        for name, power in powers.items()
        if name in inputs
    }


_LIT, _BOTH = between(0.1, 1.1), ("current", "previous")
_NOISY, _LIGHT = (*_BOTH, "variance"), "current previous variance"
_GRADIENT = checked(
    ops.temporal_gradient,
    {
        # Darken all pixels by similar factors: a change beyond the noise, but not to black.
        "current": Argument(between(0.4, 0.5), 1, numbers(1)),
        "previous": Argument(channels=1),
        "weight": Argument(between(0.5, 1), 1),
        "variance": noise(0.025, 0.05, 50, 1e15),
        **WALL,
    },
    stiff("nearly all noise", (1, 1, 4, 4), _LIT, _BOTH, variance=between(0.3, 0.6), levels=2),
    # Central differences would need a negative weight.
    extreme("one sample a stratum", (1, 1, 5, 7), _LIT, _BOTH, change=_one_sample, levels=1),
    # Infinity has no finite difference.
    extreme("sky", (1, 1, 4, 4), _LIT, _NOISY, change=sky, stratum=2, levels=2),
    # There is no derivative at the limits of the result.
    extreme("a light goes out", (1, 1, 6, 6), _LIT, ("depth",), only="current previous depth", change=_off, levels=2),
    settings={
        "stratum": (2, 3, 1, 2),
        "levels": (2, 1, 2, 0),
        "only": (None, f"{_LIGHT} weight", f"{_LIGHT} depth", "current previous normal"),
        "current": (between(0.4, 0.5), between(2, 2.1)),
    },
    sizes=SMALL,
    image=_LIT,
    fireflies=stiff("fireflies", (1, 1, 3, 4), dim, ("weight", "normal", "depth"), stratum=2, levels=2),
    relate=_compared("previous", "current"),
    rounds=_gradient_rounds,
)


def _camera(eye_z: float = 0.0, unit: float = 1.0, w: float = 1.0) -> Draw:
    """Row-vector world-to-clip matrices of a camera that looks along +z; no entry is zero but in special cases."""

    def draw(g: Generator, *shape: int) -> Tensor:
        matrix = torch.tensor(
            [[1.2, 0.05, 0.02, 0.03], [-0.04, 1.5, 0.01, -0.02], [0.06, -0.03, 1.01, 1.0], [0.1, 0.2, -0.5, -eye_z]],
            dtype=torch.float64,
        )
        matrix[3] *= unit
        matrix[:, 3] *= w
        return matrix.repeat(shape[0], 1, 1)

    return draw


def _points(scale: float = 1.0) -> Draw:
    """Points in front of the camera."""
    sides = torch.tensor([2.0, 2.0, 3.0], dtype=torch.float64).reshape(3, 1, 1)
    first = torch.tensor([-1.0, -1.0, 2.0], dtype=torch.float64).reshape(3, 1, 1)
    return lambda g, *shape: scale * (first + sides * uniform(g, *shape))


def motion_rounds(inputs: dict[str, Any], settings: dict[str, Any]) -> dict[str, Tensor | float]:
    """A place is rounded as a number up to the image's size, and with it all that is derived from it."""
    size = float(max(inputs["position" if "position" in inputs else "motion"].shape[-2:]))
    return {"motion": inputs["motion"].abs() + size} if "motion" in inputs else {"result": size}


_PREVIOUS = "previous_view_projection"
_AT_ORIGIN = {_PREVIOUS: _camera(unit=0.0)}
_MOTION = checked(
    ops.motion_from_position,
    {
        "position": Argument(_points(), 3, {"some NaN": some(torch.nan, _points())}),
        # Points near the plane of the camera have very large motion.
        _PREVIOUS: Argument(_camera(), 4, {f"w of {w:g}": _camera(w=w) for w in (1e-15, 1e15)}, lambda *_: (4,)),
    },
    ordinary("5x7", (1, 3, 5, 7)),
    # The previous camera was at z = 3.5, and the points are at z = 2 to 5, some of them close to its plane.
    stiff("points behind the camera", (1, 3, 3, 3), **{_PREVIOUS: _camera(3.5)}),
    extreme("scene in millimetres", position=_points(1e3), **{_PREVIOUS: _camera(unit=1e3)}),
    extreme("behind the camera", position=_points(-1.0)),
    # At the camera itself motion would be infinite.
    *(extreme(f"distance {d:g}", position=_points(d), **_AT_ORIGIN) for d in (0.0, 1e-30, 1e-4, 1e10, 1e30)),
    extreme("nothing hit", (1, 3, 2, 3), smooth=(_PREVIOUS,), position=some(torch.inf, _points())),
    extreme("no image", (0, 3, 3, 4)),
    limits={},
    fireflies=None,
    rounds=motion_rounds,
    # Behind the camera, motion is infinite.
    finite=False,
)


def _resample_rounds(inputs: dict[str, Any], settings: dict[str, Any]) -> dict[str, Tensor | float]:
    """Where neighbours are equal, a rounded value may be at its limit, or not, and terms of its derivative cancel.

    The magnitudes of the weights' derivatives add up to at most 3 along one axis, and those of the weights to 1.4 along
    the other.
    """
    previous, motion = inputs["previous"], inputs["motion"]
    largest = previous.abs().amax((2, 3), keepdim=True).sum(1, keepdim=True) if previous.numel() else 0.0
    return {**motion_rounds(inputs, settings), "gradient of motion": torch.zeros_like(motion) + 3 * 1.4 * largest}


def _moving(g: Generator, *shape: int) -> Tensor:
    """Motion by -1, 0 or 1 pixels, plus a fraction away from the kinks at 0 and 1."""
    return torch.randint(-1, 2, shape, generator=g) + uniform(g, *shape, low=0.1, high=0.9)


def _far_out(drawn: dict[str, Any]) -> None:
    drawn["motion"][..., 0], drawn["motion"][..., 1] = 1e4 + 0.5, -1e4 - 0.5


def _unknown(drawn: dict[str, Any]) -> None:
    motion = drawn["motion"]
    motion[:, 0, :, 0], motion[:, 1, :, 1], motion[..., 2] = torch.inf, torch.nan, -torch.inf


_ENDS = {f"{value:g}": some(value, _moving) for value in (1e-30, 1e30, torch.inf, -torch.inf, torch.nan)}
_RESAMPLED = checked(
    ops.resample,
    {"previous": IMAGE, "motion": Argument(_moving, 2, _ENDS)},
    # Zero is a whole pixel, where the derivative in the motion jumps.
    ordinary("still", (1, 3, 2, 3), uniform, ("previous",), motion=constant(0)),
    extreme("out of the image", (1, 3, 2, 3), uniform, ("previous", "motion"), change=_far_out),
    extreme("motion unknown", (1, 1, 2, 4), uniform, ("previous", "motion"), change=_unknown),
    image=uniform,
    fireflies=stiff("fireflies", (1, 3, 4, 5), radiance),
    rounds=_resample_rounds,
)


def _walls(g: Generator, *shape: int) -> Tensor:
    """Position, normal, depth and label of two walls, chosen at random for each pixel: half of the taps differ."""
    facing = torch.tensor([[0.0, 0.6, -0.8], [0.8, 0.0, -0.6]], dtype=torch.float64)
    side = torch.randint(0, 2, (shape[0], *shape[2:]), generator=g)
    rough = uniform(g, shape[0], 7, *shape[2:], low=-1)
    normal, depth = facing[side].movedim(-1, 1) + 0.02 * rough[:, :3], 5 + 5 * side[:, None] + 0.03 * rough[:, 3:4]
    label = torch.randint(0, 2, (shape[0], 1, *shape[2:]), generator=g)
    return torch.cat([0.03 * rough[:, 4:6], depth, normal / normal.norm(dim=1, keepdim=True), depth, label], 1)


def _surfaces(inputs: dict[str, Any], settings: Mapping[str, Any]) -> None:
    for name in ("surface", "previous_surface"):
        inputs[name] = Surface(*inputs[name].split([3, 3, 1, 1], 1))


def _buffers(*names: str) -> Any:
    """The surfaces have these buffers only."""

    def change(drawn: dict[str, Any]) -> None:
        for name in ("surface", "previous_surface"):
            drawn[name] = Surface(**{buffer: getattr(drawn[name], buffer) for buffer in names})

    return change


def _at(depth: float) -> Any:
    """A wall without normals, at that depth in both frames."""

    def change(drawn: dict[str, Any]) -> None:
        for surface in (drawn["surface"], drawn["previous_surface"]):
            surface.depth[:], surface.position[:, 2], surface.normal[:] = depth, depth, 0

    return change


def _sky_above(drawn: dict[str, Any]) -> None:
    for surface in (drawn["surface"], drawn["previous_surface"]):
        surface.position[..., :2, 1:] = surface.depth[..., :2, 1:] = torch.inf


def _all_new(drawn: dict[str, Any]) -> None:
    drawn["surface"].normal.neg_()


def _nan_elsewhere(drawn: dict[str, Any]) -> None:
    drawn["previous_surface"].normal[..., 1] = drawn["previous"][..., 1] = torch.nan


def _history(function: Any) -> Op:
    accumulating = function is ops.accumulate
    length = {"color": IMAGE, "previous_length": Argument(between(1, 6), 1, numbers(1, 255, 65504))}
    arguments = {"previous": IMAGE, "motion": Argument(_moving, 2)} | (length if accumulating else {})
    surfaces = {name: Argument(_walls, 8) for name in ("surface", "previous_surface")}
    alone: dict[str, Any] = {"only": " ".join(arguments)}

    def smooth(*names: str) -> tuple[str, ...]:
        return tuple(name for name in names if name in arguments)

    everything = smooth("color", "previous", "previous_length", "motion")
    return checked(
        function,
        arguments | surfaces,
        ordinary("all buffers, labels", (1, 3, 3, 3), uniform),
        ordinary("position and depth", (1, 1, 3, 3), uniform, change=_buffers("position", "depth")),
        ordinary("normal", (1, 1, 3, 3), uniform, change=_buffers("normal"), normal_limit=0.3),
        # Zero is a whole pixel, where the derivative in the motion jumps.
        ordinary("still", (1, 3, 2, 3), uniform, smooth("color", "previous", "previous_length"), motion=constant(0)),
        extreme("out of the image", (1, 3, 2, 3), uniform, everything, change=_far_out, **alone),
        extreme("motion unknown", (1, 1, 2, 4), uniform, everything, change=_unknown, **alone),
        # Without surfaces: a tap of no weight may be the only one that shows the surface.
        *(extreme(f"motion {name}", motion=draw, **alone) for name, draw in _ENDS.items()),
        extreme("sky", (1, 1, 3, 4), uniform, everything, change=_sky_above),
        extreme("new surfaces only", (1, 3, 2, 3), uniform, everything, change=_all_new),
        # There are no finite differences of NaN.
        extreme("NaN on another surface", (1, 3, 2, 3), uniform, smooth("color", "motion"), change=_nan_elsewhere),
        *(
            (
                ordinary("long history", (1, 1, 3, 3), uniform, previous_length=between(12, 40), **alone),
                extreme("1e4 frames, never forgotten", previous_length=constant(1e4), alpha_min=1e-6, **alone),
            )
            if accumulating
            else ()
        ),
        *(extreme(f"depth {z:g}", change=_at(z)) for z in (0.0, 1e-6, 1e10, torch.inf)),
        settings={"only": (alone["only"], None), "change": (None, _buffers("depth"), None, None)},
        image=uniform,
        smooth=everything,
        fireflies=stiff("fireflies", (1, 3, 2, 3), radiance, everything),
        relate=_surfaces,
        rounds=motion_rounds,
    )


OPS = (_LAG, _GRADIENT, _MOTION, _history(ops.reproject), _RESAMPLED, _history(ops.accumulate))


def _step(function: Any, arguments: dict[str, Argument], smooth: tuple[str, ...] = (), **more: Any) -> Op:
    """A fused step, for ordinary images; between accumulation and convolutions frames are in float32 at least."""
    # A light is three pixels wide.
    regimes: dict[str, Any] = {"sizes": {"5x7": (1, 3, 5, 7), **ORDINARY}, "limits": {}, "fireflies": None}
    return checked(function, arguments, smooth=smooth, half_precision=False, **regimes, **more)


def _bright_corner(g: Generator, *shape: int) -> Tensor:
    root = uniform(g, *shape, low=0.1, high=3.0)
    root[..., : shape[-2] // 2 + 1, : shape[-1] // 2 + 1] = 6
    return root


_DRAWN = between(0.1, 3.0)
_COLOR = Argument(_DRAWN, 3)
STEPS = (
    _step(history.incoming, {"color": Argument(sparks(_DRAWN, 400, (0, 0)), 3)}),
    _step(history.lights, {"root": Argument(_bright_corner, 1)}),
    _step(
        history.blend,
        {
            "entering": _COLOR,
            "previous": _COLOR,
            "previous_length": Argument(between(1.0, 6.0), 1),
            # Stay away from whole pixels, where the derivative jumps.
            "motion": Argument(between(0.1, 0.4), 2),
        },
        ("entering", "previous", "motion"),
        rounds=motion_rounds,
    ),
)
