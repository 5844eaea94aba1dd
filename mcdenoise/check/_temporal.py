"""Builders and rows of the ops that carry images from frame to frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Generator, Tensor

from mcdenoise import ops
from mcdenoise.check._pixels import seen, sky, wall
from mcdenoise.check.case import Draw, Inputs, Op, between, constant, dim, radiance, uniform
from mcdenoise.check.regimes import SMALL, Size, checked, extreme, ordinary, stiff
from mcdenoise.ops import Surface


def _lagging(
    g: Generator,
    size: Size,
    image: Draw,
    recent: Draw | None = None,
    change: float = 2.0,
    noise: float = 0.5,
) -> Inputs:
    history = image(g, *size)
    latest = change * (1 + noise * uniform(g, *size, low=-1)) * history if recent is None else recent(g, *size)
    spread = noise * history.mean(1, keepdim=True) * uniform(g, size[0], 1, *size[2:], low=0.5)
    return {"history": history, "recent": latest, "variance": spread.square()}


# Settings for which differences are 1 to 2 times the threshold, so that the result is neither 0 nor 1.
_LAG = checked(
    ops.history_lag,
    _lagging,
    ordinary("no change", (1, 3, 4, 5), between(0.8, 1), change=1.0),
    ordinary("darker by half", (1, 3, 4, 5), between(0.8, 1), change=0.5, threshold=4.0),
    # Without noise only the smallest visible difference counts; its square is smaller than the step of finite
    # differences in the variance.
    stiff("no noise", (1, 1, 1, 1), constant(0.9), ("history", "recent"), change=1.0045, noise=0.0, threshold=3.0),
    extreme("the light goes out", (1, 3, 5, 6), recent=constant(0)),
    extreme("the light goes on", (1, 3, 5, 6), constant(0), recent=between(0.5, 1)),
    extreme("the light goes on at 1e30", (1, 3, 5, 6), constant(0), recent=constant(1e30)),
    extreme("1e30 and 1e-30", (1, 3, 5, 6), constant(1e30), recent=constant(1e-30)),
    extreme("noise of 1e15 times the light", (1, 3, 5, 6), constant(1), recent=constant(2), noise=1e15),
    settings=(
        {"threshold": 5.5, "kernel_size": 5},
        {"threshold": 3.0, "kernel_size": 3},
        {"threshold": 3.5, "kernel_size": 3},
        {"threshold": 2.0, "kernel_size": 7},
    ),
    image=between(0.8, 1),
    fireflies=None,
)


def _changing(
    g: Generator,
    size: Size,
    image: Draw,
    inputs: tuple[str, ...] | None = None,
    noise: float = 0.05,
    change: float = 0.4,
    alter: Callable[[dict[str, Any]], None] | None = None,
    depth: Draw | None = None,
) -> Inputs:
    shape = size[0], 1, *size[2:]
    previous = image(g, *shape).abs()
    # Darken all pixels by similar factors: a change beyond the noise, but not to black.
    current = previous * (change + 0.1 * uniform(g, *shape))
    spread = (noise * previous * uniform(g, *shape, low=0.5)).square().clamp_max(1e34)
    images: Inputs = {"current": current, "previous": previous, "weight": uniform(g, *shape, low=0.5)}
    return seen(images | {"variance": spread, **wall(g, size)}, inputs, alter, depth, g)


def _one_sample(drawn: dict[str, Any]) -> None:
    """A sample in one pixel of each stratum, and none in the first stratum."""
    drawn["weight"] = torch.zeros_like(drawn["weight"])
    drawn["weight"][..., 1::3, 2::3] = 1
    drawn["weight"][..., :3, :3] = 0


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


def _gradient() -> Op:
    both, lit = ("current", "previous"), between(0.1, 1.1)
    noisy = (*both, "variance")

    def off(drawn: dict[str, Any]) -> None:
        drawn["current"][..., :3, :] = 0

    def still(drawn: dict[str, Any]) -> None:
        drawn["current"] = drawn["previous"].clone()

    return checked(
        ops.temporal_gradient,
        _changing,
        ordinary("luminance alone", (1, 1, 5, 7), lit, inputs=both, levels=2),
        ordinary("strata of a pixel, normals", (1, 1, 2, 3), lit, inputs=(*both, "normal"), stratum=1, levels=3),
        ordinary("one row, depths", (1, 1, 1, 7), lit, inputs=(*noisy, "depth"), sigma_z=3.0, levels=2),
        ordinary("no filter", (1, 1, 4, 4), lit, inputs=(*noisy, "weight"), levels=0, threshold=1.0),
        ordinary("brighter", (1, 1, 3, 4), lit, inputs=noisy, change=2.0, levels=2),
        stiff("nearly all noise", (1, 1, 4, 4), lit, both, inputs=noisy, noise=0.6, levels=2),
        # Central differences would need a negative weight.
        extreme("one sample a stratum", (1, 1, 5, 7), lit, both, inputs=(*both, "weight"), alter=_one_sample, levels=1),
        # Infinity has no finite difference.
        extreme("sky", (1, 1, 4, 4), lit, noisy, alter=sky, stratum=2, levels=2),
        # There is no derivative at the limits of the result.
        extreme("a light goes out", (1, 1, 6, 6), lit, ("depth",), inputs=(*both, "depth"), alter=off, levels=2),
        extreme("nothing changes", image=lit, alter=still),
        extreme("noise only", image=lit, inputs=noisy, noise=50.0),
        extreme("noise of 1e15 times the light", noise=1e15, stratum=2, levels=2),
        *(extreme(f"depth {z:g}", depth=constant(z), stratum=2, levels=2) for z in (0.0, 1e-30, 1e30, torch.inf)),
        settings=({"stratum": 2, "levels": 2}, {"stratum": 3, "levels": 1}),
        sizes=SMALL,
        image=lit,
        fireflies=stiff("fireflies", (1, 1, 3, 4), dim, ("weight", "normal", "depth"), stratum=2, levels=2),
        rounds=_gradient_rounds,
    )


def _camera(batch: int, eye_z: float, unit: float, w: float) -> Tensor:
    """Row-vector world-to-clip matrices of a camera that looks along +z; no entry is zero but in special cases."""
    matrix = torch.tensor(
        [[1.2, 0.05, 0.02, 0.03], [-0.04, 1.5, 0.01, -0.02], [0.06, -0.03, 1.01, 1.0], [0.1, 0.2, -0.5, -eye_z]],
        dtype=torch.float64,
    )
    matrix[3] *= unit
    matrix[:, 3] *= w
    return matrix.repeat(batch, 1, 1)


def _projected(
    g: Generator,
    size: Size,
    image: Draw,
    scale: float = 1.0,
    special: float | None = None,
    eye_z: float = 0.0,
    unit: float = 1.0,
    w: float = 1.0,
) -> Inputs:
    batch, _, height, width = size
    depth = uniform(g, batch, 1, height, width, low=2, high=5)
    position = scale * torch.cat([uniform(g, batch, 2, height, width, low=-1), depth], 1)
    if special is not None:
        position[..., 0] = special
    return {"position": position, "previous_view_projection": _camera(batch, eye_z, unit, w)}


def motion_rounds(inputs: dict[str, Any], settings: dict[str, Any]) -> dict[str, Tensor | float]:
    """A place is rounded as a number up to the image's size, and with it all that is derived from it."""
    size = float(max(inputs["position" if "position" in inputs else "motion"].shape[-2:]))
    return {"motion": inputs["motion"].abs() + size} if "motion" in inputs else {"result": size}


_MOTION = checked(
    ops.motion_from_position,
    _projected,
    ordinary("5x7", (1, 3, 5, 7)),
    # The previous camera was at z = 3.5, and the points are at z = 2 to 5, some of them close to its plane.
    stiff("points behind the camera", (1, 3, 3, 3), eye_z=3.5),
    extreme("scene in millimetres", smooth=("position", "previous_view_projection"), scale=1e3, unit=1e3),
    extreme("nothing hit", (1, 3, 2, 3), smooth=("previous_view_projection",), special=torch.inf),
    *(extreme(f"distance {scale:g}", scale=scale, unit=0.0) for scale in (0.0, 1e-30, 1e-4, 1e10, 1e30)),
    extreme("some NaN", special=torch.nan),
    extreme("behind the camera", scale=-1.0),
    # Points near the plane of the camera have very large motion.
    *(extreme(f"w of {w:g}", w=w) for w in (1e-15, 1e15)),
    extreme("no image", (0, 3, 3, 4)),
    limits={},
    fireflies=None,
    least_dtype=torch.float32,
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


def _moving(g: Generator, size: Size) -> Tensor:
    """Motion by -1, 0 or 1 pixels, plus a fraction away from the kinks at 0 and 1."""
    whole = torch.randint(-1, 2, (size[0], 2, *size[2:]), generator=g)
    return whole + uniform(g, *whole.shape, low=0.1, high=0.9)


def _surface(g: Generator, size: Size) -> dict[str, Tensor]:
    """Two walls, chosen at random for each pixel, so that about half of the taps clearly show the other wall."""
    batch, _, height, width = size
    facing = torch.tensor([[0.0, 0.6, -0.8], [0.8, 0.0, -0.6]], dtype=torch.float64)
    side = torch.randint(0, 2, (batch, height, width), generator=g)
    normal = facing[side].movedim(-1, 1) + 0.02 * uniform(g, batch, 3, height, width, low=-1)
    depth = 5 + 5 * side[:, None] + 0.03 * uniform(g, batch, 1, height, width, low=-1)
    position = torch.cat([0.03 * uniform(g, batch, 2, height, width, low=-1), depth], 1)
    label = torch.randint(0, 2, (batch, 1, height, width), generator=g).double()
    return {"position": position, "normal": normal / normal.norm(dim=1, keepdim=True), "depth": depth, "label": label}


def _flat(depth: float, length: float = 1.0) -> Callable[..., None]:
    """A wall that faces the camera, the same in both frames."""

    def change(drawn: dict[str, Any], *surfaces: dict[str, Tensor]) -> None:
        for surface in surfaces:
            surface["depth"][:] = surface["position"][:, 2:] = depth
            surface["position"][:, :2], surface["normal"][:] = surfaces[0]["position"][:, :2], 0
            surface["normal"][:, 2] = -length

    return change


def _move(value: float, column: int = 1) -> Callable[..., None]:
    """One column moves by that much."""

    def change(drawn: dict[str, Any], *_: Any) -> None:
        drawn["motion"][..., column] = value

    return change


def _far_out(drawn: dict[str, Any], *_: Any) -> None:
    drawn["motion"][..., 0], drawn["motion"][..., 1] = 1e4 + 0.5, -1e4 - 0.5


def _unknown(drawn: dict[str, Any], *_: Any) -> None:
    motion = drawn["motion"]
    motion[:, 0, :, 0], motion[:, 1, :, 1], motion[..., 2] = torch.inf, torch.nan, -torch.inf


def _resampled(g: Generator, size: Size, image: Draw, change: Callable[..., None] | None = None) -> Inputs:
    drawn: Inputs = {"previous": image(g, *size), "motion": _moving(g, size)}
    if change is not None:
        change(drawn)
    return drawn


_MOTION_ROWS = (
    # Zero is a whole pixel, where the derivative in the motion jumps.
    ordinary("still", (1, 3, 2, 3), uniform, ("previous",), change=lambda drawn, *_: drawn["motion"].zero_()),
    extreme("out of the image", (1, 3, 2, 3), uniform, ("previous", "motion"), change=_far_out),
    extreme("motion unknown", (1, 1, 2, 4), uniform, ("previous", "motion"), change=_unknown),
    *(extreme(f"motion {m:g}", change=_move(m)) for m in (1e-30, 1e30, torch.inf, -torch.inf, torch.nan)),
)
_RESAMPLED = checked(
    ops.resample,
    _resampled,
    *_MOTION_ROWS,
    image=uniform,
    fireflies=stiff("fireflies", (1, 3, 4, 5), radiance),
    images=("previous",),
    rounds=_resample_rounds,
)


def _history(function: Any) -> Op:
    accumulating = function is ops.accumulate

    def build(
        g: Generator,
        size: Size,
        image: Draw,
        buffers: tuple[str, ...] = (),
        length: Draw = between(1, 6),
        change: Callable[..., None] | None = None,
    ) -> Inputs:
        inputs: dict[str, Any] = {"previous": image(g, *size), "motion": _moving(g, size)}
        here, there = _surface(g, size), _surface(g, size)
        if accumulating:
            inputs |= {"color": image(g, *size), "previous_length": length(g, size[0], 1, *size[2:])}
        if change is not None:
            change(inputs, here, there)
        if buffers:
            pair = (Surface(**{name: buffer[name] for name in buffers}) for buffer in (here, there))
            inputs |= dict(zip(("surface", "previous_surface"), pair, strict=True))
        return inputs

    def sky_above(drawn: dict[str, Any], *surfaces: dict[str, Tensor]) -> None:
        for surface in surfaces:
            surface["position"][..., :2, 1:] = surface["depth"][..., :2, 1:] = torch.inf

    def all_new(drawn: dict[str, Any], here: dict[str, Tensor], _: Any) -> None:
        here["normal"].neg_()

    def nan_elsewhere(drawn: dict[str, Any], _: Any, there: dict[str, Tensor]) -> None:
        there["normal"][..., 1] = drawn["previous"][..., 1] = torch.nan

    def smooth(*names: str) -> tuple[str, ...]:
        # "bmfr" rounds the length, which then has no derivative.
        return tuple(name for name in names if accumulating or name in ("previous", "motion"))

    everything = smooth("color", "previous", "previous_length", "motion")
    but_length, but_previous = smooth("color", "previous", "motion"), smooth("color", "motion")
    still, *moved = _MOTION_ROWS
    all_buffers = ("position", "normal", "depth")
    scene = {"rule": "bmfr", "buffers": all_buffers[:2], "position_limit": 0.5, "normal_limit": 0.25}
    bmfr = scene | ({"alpha_min": 0.2} if accumulating else {})
    only: dict[str, Any] = {"buffers": all_buffers}

    def lasting(draw: Draw, **given: Any) -> dict[str, Any]:
        return {"length": draw, **({"alpha_min": 0.1} | given if accumulating else {})}

    return checked(
        function,
        build,
        ordinary("relative, all buffers, batch of 2, RGB", (2, 3, 2, 3), uniform, **only),
        ordinary(
            "relative, position and depth", (1, 1, 3, 3), uniform, buffers=("position", "depth"), position_limit=0.03
        ),
        ordinary("relative, normal", (1, 1, 3, 3), uniform, buffers=("normal",), normal_limit=0.3),
        ordinary("relative, all buffers, labels", (1, 3, 3, 3), uniform, buffers=(*all_buffers, "label")),
        ordinary("bmfr", (1, 3, 3, 3), uniform, but_length, length=between(1, 3.4), **bmfr),
        ordinary("long history", (1, 1, 3, 3), uniform, **lasting(between(12, 40))),
        replace(still, smooth=smooth("color", "previous", "previous_length"), given={**still.given, **only}),
        *(replace(row, smooth=row.smooth and everything) for row in moved),
        extreme("history length of a byte", (1, 1, 3, 3), uniform, but_length, length=between(250, 255), **bmfr),
        extreme("sky", (1, 1, 3, 4), uniform, everything, change=sky_above, **only),
        extreme("new surfaces only", (1, 3, 2, 3), uniform, everything, change=all_new, **only),
        # There are no finite differences of NaN.
        extreme("NaN on another surface", (1, 3, 2, 3), uniform, but_previous, change=nan_elsewhere, **only),
        *(extreme(f"history of {n:g} frames", **lasting(constant(n))) for n in (1.0, 255.0, 65504.0)),
        extreme("history of 1e4 frames, never forgotten", **lasting(constant(1e4), alpha_min=1e-6)),
        *(extreme(f"depth {z:g}", change=_flat(z), **only) for z in (0.0, 1e-6, 1e10, torch.inf)),
        *(extreme(f"normals of length {n:g}", change=_flat(5.0, n), **only) for n in (0.0, 1e3)),
        settings=({}, {"buffers": ("depth",)}, {"buffers": ("depth",)}, {}),
        image=uniform,
        smooth=everything,
        fireflies=stiff("fireflies", (1, 3, 2, 3), radiance, everything, **only),
        images=("color", "previous") if accumulating else ("previous",),
        rounds=motion_rounds,
    )


OPS = (_LAG, _gradient(), _MOTION, _history(ops.reproject), _RESAMPLED, _history(ops.accumulate))
