"""Frames with the unusual values that renderers write, for networks and for the denoiser."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from mcdenoise.frame import Frame

FRAMES = 3
# Black, bright and even pixels, and some without albedo.
UNEVEN = "uneven radiance"
SIZE = (17, 23)
EXPOSURES = (1e-4, 1e-2, 1e2, 1e4)
# The maximum of eight random perturbations underestimates the true maximum, but hardly by more than this factor.
PATTERNS, ALLOWED = 8, 4
_SOME = (..., slice(3, 9), slice(None))
# Unusual values of whole buffers, and of buffers in some rows.
_EVERYWHERE = {"color": (0.0, 1e-40, 1e-30, 65504.0, 1e6, 1e30), "albedo": (0.0, 1e-8, 1.0, 1.9), "normal": (-1.0,)}
_IN_SOME_ROWS = {
    "color": (math.nan, math.inf, -1.0),
    "depth": (0.0, 1e-30, 1e10, math.inf),
    "normal": (0.0, 0.1, 1.0),
    "motion": (1e4, 1e30, math.inf, -math.inf),
    "position": (0.0, 1e10),
    "albedo": (93.0,),
}

Shots = dict[str, list[Frame]]


def frame(seed: int, dtype: torch.dtype, size: tuple[int, int] = SIZE) -> Frame:
    """A noisy wall with some mirrors that moves by a fraction of a pixel, seen from a camera at the origin."""
    g = torch.Generator().manual_seed(seed)
    height, width = size
    depth = 2 + torch.rand(1, 1, height, width, generator=torch.Generator().manual_seed(0))
    position = torch.cat([torch.rand(1, 2, height, width, generator=g) - 0.5, depth], 1)
    matrix = torch.eye(4)[None]
    matrix[:, 2, 3], matrix[:, 3, 3] = 1, 0
    albedo = torch.rand(1, 3, height, width, generator=torch.Generator().manual_seed(1)) * (depth < 2.8)
    normal = torch.tensor([0.0, 0.0, -1.0]).reshape(1, 3, 1, 1).expand(1, 3, height, width)
    return Frame(
        color=10 ** (4 * torch.rand(1, 3, height, width, generator=g) - 2),
        albedo=albedo,
        normal=normal,
        depth=depth,
        position=position,
        motion=torch.full((1, 2, height, width), 0.25),
        view_projection=matrix,
    ).to(dtype)


def shots(dtype: torch.dtype, size: tuple[int, int] = SIZE) -> Shots:
    """Short shots with the unusual values that renderers write; finite values are clamped to the range of the dtype."""
    frames, limits = [frame(seed, dtype, size) for seed in range(FRAMES)], torch.finfo(dtype)

    def changed(name: str, value: float, where: tuple[Any, ...] = (...,)) -> list[Frame]:
        value = min(max(value, limits.min), limits.max) if math.isfinite(value) else value
        buffers = [dict(frame.items())[name].clone() for frame in frames]
        for buffer in buffers:
            buffer[where] = value
        return [frame.replace(**{name: buffer}) for frame, buffer in zip(frames, buffers, strict=True)]

    def uneven(frame: Frame) -> Frame:
        color, albedo = frame.color.clone(), frame.albedo.clone()  # type: ignore[union-attr]
        color[..., 2:5, 2:9], color[..., 6, 3], color[..., 9:12, 8:] = 0, limits.max**0.5, 0.5
        albedo[..., 4:7, :] = 0
        return frame.replace(color=color, albedo=albedo)

    void = torch.ones_like(frames[0].color[:, :1])
    void[_SOME] = 0
    lacking = frames[1].replace(albedo=None, depth=None, position=None)
    return {
        "ordinary": frames,
        UNEVEN: [uneven(frame) for frame in frames],
        **{f"{name} {value:g}": changed(name, value) for name, values in _EVERYWHERE.items() for value in values},
        **{
            f"{name} {value:g} in some rows": changed(name, value, _SOME)
            for name, values in _IN_SOME_ROWS.items()
            for value in values
        },
        "one row of valid color": changed("color", math.nan, (..., slice(1, None), slice(None))),
        **{f"{h}x{w}": [frame(seed, dtype, (h, w)) for seed in range(FRAMES)] for h, w in ((1, 1), (1, 9), (9, 1))},
        "nothing but color": [Frame(color=frame.color) for frame in frames],
        # Features that contradict each other, or are missing in some frames.
        "mask 0 in some rows": [frame.replace(mask=void) for frame in frames],
        "void rows": [frame.replace(color=frame.color * void, alpha=void) for frame in frames],
        "albedo without normal": [frame.replace(normal=None) for frame in frames],
        "normal without albedo": [frame.replace(albedo=None) for frame in frames],
        "half the features in every second frame": [frames[0], lacking, *frames[2:]],
    }


def joined(frames: Sequence[Frame]) -> Frame:
    """Frames as one batch."""
    buffers = [dict(frame.items()) for frame in frames]
    return frames[0].replace(**{name: torch.cat([each[name] for each in buffers]) for name in frames[0].buffers})


def relative_change(found: Tensor, expected: Tensor) -> float:
    """Maximum change relative to the pixel's value plus half of the mean of the image."""
    unit = expected.abs().double() + expected.double().mean() / 2
    # Numbers below the smallest normal number have fewer digits.
    return float(((found.double() - expected).abs() / (unit + torch.finfo(torch.float32).tiny)).max())
