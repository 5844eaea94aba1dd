"""Builders and rows of the ops that filter an image with weights of each pixel."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Generator, Tensor

from mcdenoise import ops
from mcdenoise.check.case import (
    Draw,
    Inputs,
    Op,
    alternating,
    between,
    constant,
    dim,
    normal,
    radiance,
    softmax,
    times,
    uniform,
)
from mcdenoise.check.regimes import SMALL, Size, checked, extreme, ordinary, stiff
from mcdenoise.ops._window import inside, offsets, pad, shifted

_IMAGE = ("image",)
_TINY = torch.finfo(torch.float32).tiny / torch.finfo(torch.float32).eps


def some(value: float, draw: Draw = normal) -> Draw:
    """The same number in one channel of all pixels, or of one image in its first column."""

    def drawn(g: Generator, *shape: int) -> Tensor:
        numbers = draw(g, *shape)
        numbers[(slice(None), 2) if shape[1] > 3 else (..., 0)] = value
        return numbers

    return drawn


def _filtered(g: Generator, size: Size, image: Draw, kernel: Draw = between(0.5, 1.5), kernel_size: int = 3) -> Inputs:
    return {"image": image(g, *size), "kernel": kernel(g, size[0], kernel_size**2, *size[2:])}


def _filter(function: Any) -> Op:
    def no_weight(g: Generator, *shape: int) -> Tensor:
        kernel = uniform(g, *shape, low=0.5)
        kernel[..., 0, 0] = 0
        return kernel

    return checked(
        function,
        _filtered,
        ordinary("5x5 taps, RGB", (1, 3, 2, 3), border="replicate", kernel_size=5),
        ordinary("weights of both signs", (1, 3, 2, 3), kernel=between(-1, 1), border="zeros"),
        stiff("peaked weights", (1, 3, 2, 3), radiance, kernel=softmax(15), border="replicate"),
        stiff("sum of the weights of 1e-3", smooth=("image",), kernel=softmax(3, 1e-3), border="renormalize"),
        # The sum of the weights jumps at zero, so there is no derivative in the kernel.
        extreme("a pixel without weights", image=normal, smooth=("image",), kernel=no_weight, border="renormalize"),
        *(extreme(f"no weights, {border}", kernel=constant(0), border=border) for border in ("zeros", "renormalize")),
        # The mean does not depend on the scale of the weights; its gradient contains their square.
        *(extreme(f"weights of {w:g}", kernel=softmax(3, w), border="renormalize") for w in (1e-15, 90, 1e15)),
        extreme("one weight infinite", kernel=some(torch.inf, softmax(3)), border="replicate"),
        extreme("7x7 on 1x2", (1, 3, 1, 2), kernel=softmax(3), kernel_size=7, border="renormalize"),
        extreme("weights that cancel", kernel=alternating(1e4), border="replicate"),
        settings=(
            {"border": "replicate"},
            {"border": "zeros"},
            {"border": "renormalize"},
            {"border": "zeros", "kernel_size": 5},
            {"border": "renormalize", "kernel_size": 1},
            {"border": "replicate", "kernel_size": 5},
            {"border": "renormalize", "kernel_size": 5},
        ),
        images=_IMAGE,
    )


def _splatted(g: Generator, size: Size, image: Draw, logits: Draw = normal, kernel_size: int = 3) -> Inputs:
    return {"image": image(g, *size), "logits": logits(g, size[0], kernel_size**2, *size[2:])}


_SPLAT = checked(
    ops.softmax_splat,
    _splatted,
    extreme("logits of 1e4", logits=times(1, normal, 1e4)),
    extreme("logits to +-1e4", logits=times(1e4, normal)),
    extreme("7x7 on 1x2", (1, 3, 1, 2), kernel_size=7),
    settings=({}, {"kernel_size": 5}, {}, {}, {"kernel_size": 1}),
    fireflies=stiff("fireflies, peaked weights", (1, 3, 2, 3), radiance, logits=times(8, normal)),
    images=_IMAGE,
)


def _bilateral(
    g: Generator,
    size: Size,
    image: Draw,
    kernel: Draw = between(-2, 2),
    guide: Draw = uniform,
    scale: float = 3.0,
    channels: tuple[int, ...] = (1,),
    distance: float | None = 0.5,
    kernel_size: int = 3,
    normalize: str = "softmax",
    *,
    filtered: bool,
) -> Inputs:
    batch, _, height, width = size

    def one(count: int, draw: Draw = uniform) -> Tensor:
        return draw(g, batch, count, height, width)

    logits = one(kernel_size**2, kernel)
    if filtered and normalize == "none":
        # Weights of both signs may sum to zero.
        logits = logits.abs() + 0.1
    return {
        **({"image": image(g, *size)} if filtered else {}),
        "kernel": logits,
        "guides": [one(count, guide) for count in channels],
        "falloffs": [scale * one(1) for _ in channels],
        "distance_falloff": None if distance is None else distance * one(1),
    }


def _bilateral_rounds(inputs: dict[str, Any], settings: dict[str, Any]) -> dict[str, Tensor]:
    """The exponent is a sum of large terms; its rounding error counts as that of a logit of the sum of their sizes.

    The error of ``logit[t] - sum_g f_g d_g[t]^2 - f_d |o_t|^2`` is eps times ``|logit| + sum_g f_g d_g^2 + f_d
    |o_t|^2``, however small inputs and result are. A weight, ``w exp(exponent)``, has the same relative error.
    """
    border = settings.get("border", "replicate")
    own, distance = inputs["kernel"].abs(), inputs["distance_falloff"]
    size = round(own.shape[1] ** 0.5)
    terms = torch.zeros_like(own)
    for guide, falloff in zip(inputs["guides"], inputs["falloffs"], strict=True):
        padded = pad(guide, size // 2, border)
        for tap, dy, dx in offsets(size):
            difference = shifted(padded, size // 2, dy, dx, *own.shape[2:]) - guide
            terms[:, tap : tap + 1] += falloff * difference.square().sum(1, keepdim=True)
    if distance is not None:
        squares = [dy * dy + dx * dx for _, dy, dx in offsets(size)]
        terms = terms + distance * torch.tensor(squares, dtype=own.dtype)[:, None, None]
    # Those outside have no weight.
    there = inside(own.shape[2], own.shape[3], size, own.device) | (border != "renormalize")
    terms = torch.where(there, terms, 0)
    return {"kernel": own * (1 + terms) if settings.get("normalize") == "none" else own + terms}


def _weighted(function: Any) -> Op:
    def far_and_near(g: Generator, *shape: int) -> Tensor:
        """Depths of 1e10, as of a sky, beside depths of 0 to 1."""
        return torch.where(uniform(g, *shape) < 0.5, 1e10, uniform(g, *shape))

    def normals(length: float) -> Draw:
        """Normals of which some are zero and the others have this length."""
        return lambda g, *shape: length * F.normalize(normal(g, *shape)) * (uniform(g, shape[0], 1, *shape[2:]) < 0.7)

    def row(name: str, scale: float = 1.0, size: Size = (1, 3, 2, 3), **given: Any) -> Any:
        return extreme(name, size, scale=scale, **{"border": "renormalize", "distance": 1.0, **given})

    small, flat = between(-1e-4, 1e-4), constant(0.5)
    exact: dict[str, Any] = {"border": "renormalize", "distance": 1.0}
    filtered = function is ops.cross_bilateral_filter
    infinite = row("one weight infinite", guide=flat, kernel=some(torch.inf, uniform), normalize="none")
    return checked(
        function,
        partial(_bilateral, filtered=filtered),
        ordinary("5x5 taps, normals and depth", (1, 3, 1, 2), kernel_size=5, channels=(3, 1)),
        ordinary("no guides", (1, 3, 2, 3), channels=(), distance=None),
        ordinary("distance only", (1, 1, 3, 2), channels=()),
        ordinary("zero falloffs", scale=0.0),
        stiff("falloffs up to 1e3", guide=between(0, 0.1), scale=1e3),
        stiff("f of 1e6, guides 1e-4 apart", guide=small, scale=1e6, **exact),
        # Known to eps times the logits.
        replace(
            stiff("logits 1e4 and 1 apart", guide=between(-1, 1), kernel=times(1, between(-1, 1), 1e4), **exact),
            kind="extreme",
        ),
        row("f of 1e8, guides 1e-4 apart", 1e8, guide=small),
        row("f of 1e8, guides of 1e4 and 1e-4 apart", 1e8, guide=times(1, small, 1e4)),
        row("logits to +-1e4", guide=flat, kernel=between(-1e4, 1e4)),
        row("logits of -1e4", guide=flat, kernel=times(1, between(-1, 1), -1e4)),
        row("one logit infinite", guide=flat, kernel=some(torch.inf)),
        row("one logit of minus infinity", guide=flat, kernel=some(-torch.inf)),
        row("all weights zero, as logits", guide=flat, kernel=constant(-torch.inf)),
        row("all weights zero", guide=flat, kernel=constant(0), normalize="none"),
        # A mean with an infinite weight is undefined.
        *(() if filtered else (infinite,)),
        row("Eq. 5, f of 1e8", 1e8, guide=between(-1, 1), kernel=uniform, normalize="none"),
        row("depth 0 and 1e10", 1e8, guide=far_and_near),
        *(row(f"normals of length 0 and {n:g}", 1e3, guide=normals(n), channels=(3,)) for n in (1, 1e3)),
        row("64 channels", 1e3, channels=(64,)),
        row("7x7 on 1x2", 1e3, (1, 3, 1, 2), kernel_size=7, border="zeros"),
        row("no image", size=(0, 3, 3, 4)),
        settings=(
            {"normalize": "softmax", "border": "replicate"},
            {"normalize": "none", "border": "zeros", "channels": (3,)},
            {"normalize": "softmax", "border": "renormalize", "channels": (1, 1)},
            {"normalize": "none", "border": "renormalize"},
            {"normalize": "softmax", "border": "zeros", "channels": (3, 1), "distance": None},
            {"normalize": "none", "border": "replicate", "channels": (3, 1)},
        ),
        sizes=SMALL,
        limits={},
        fireflies=stiff("fireflies", (1, 3, 2, 3), dim) if filtered else None,
        images=_IMAGE if filtered else (),
        weights=lambda settings: not filtered and settings.get("normalize", "softmax") == "softmax",
        rounds=_bilateral_rounds,
    )


def _learned(g: Generator, size: Size, image: Draw, kernel: Draw = softmax(1, 4), side: int = 4) -> Inputs:
    batch, channels, *half = size[0], size[1], (size[2] + 1) // 2, (size[3] + 1) // 2
    return {"image": image(g, batch, channels, *half), "kernel": kernel(g, batch, side**2, *half)}


_LEARNED = checked(
    ops.learned_upsample,
    _learned,
    extreme("no weights", kernel=constant(0), border="replicate"),
    extreme("weights that cancel", kernel=alternating(1e4), border="zeros"),
    extreme("8x8 taps on 1x2", (1, 3, 1, 3), side=8, border="replicate"),
    settings=(
        {"border": "replicate"},
        {"border": "zeros"},
        {"border": "replicate", "side": 6},
        {"border": "zeros", "side": 2},
    ),
    fireflies=stiff("fireflies, peaked weights", (1, 3, 3, 4), radiance, kernel=softmax(10, 4), border="replicate"),
    images=_IMAGE,
)


def _partitioned(g: Generator, size: Size, image: Draw, logits: Draw = times(2, normal), levels: int = 3) -> Inputs:
    return {"image": image(g, *size), "logits": logits(g, size[0], levels, *size[2:])}


_PARTITION = checked(
    ops.pyramid_partition,
    _partitioned,
    extreme("logits of 1e4, of both signs", logits=alternating(1e4)),
    extreme("7 levels of 3x2", (1, 3, 3, 2), levels=7),
    settings=({"levels": 3}, {"levels": 2}, {"levels": 4}, {"levels": 5}, {"levels": 1}),
    fireflies=stiff("fireflies, peaked weights", (1, 3, 3, 2), radiance, logits=times(10, normal)),
    images=_IMAGE,
)


def _important(g: Generator, size: Size, image: Draw, importance: Draw = normal) -> Inputs:
    return {"image": image(g, *size), "importance": importance(g, size[0], 1, *size[2:])}


def _cliff(g: Generator, *shape: int) -> Tensor:
    """An importance with a step: on either side, windows contain only small or only large values."""
    return 0.1 * normal(g, *shape) + torch.where(torch.arange(shape[-1]) < shape[-1] // 2, -1e4, 1e4)


def _lost(inputs: dict[str, Any], settings: dict[str, Any]) -> dict[str, float]:
    """A weight below the smallest number of float32 may become 0; all weights add up to at least 1e-6."""
    images = [inputs[name] for name in ("image", "previous") if name in inputs]
    largest = max((float(image.abs().amax()) for image in images if image.numel()), default=0.0)
    return {"result": 2 * settings.get("kernel_size", 7) ** 2 * _TINY * largest / 1e-6}


_IMPORTANCE = checked(
    ops.importance_filter,
    _important,
    stiff("map of zeros", importance=constant(0), kernel_size=3),
    stiff("map of about 20", (1, 2, 3, 4), importance=times(20, normal), kernel_size=5),
    extreme("map of -1e4 to 1e4", smooth=("image",), importance=between(-1e4, 1e4), kernel_size=5),
    extreme("map with a cliff of 2e4", (1, 3, 2, 8), importance=_cliff, kernel_size=3),
    *(extreme(f"map of {m:g}", importance=constant(m), kernel_size=5) for m in (-1e30, -1e4, 1e4, 1e30)),
    settings=({"kernel_size": 3}, {"kernel_size": 5}, {"kernel_size": 7}, {"kernel_size": 13}),
    # The step of finite differences is too coarse where the weights are nearly those of a maximum.
    fireflies=stiff("fireflies", (1, 3, 3, 4), radiance, smooth=_IMAGE, kernel_size=5),
    images=_IMAGE,
    rounds=_lost,
)


def _alike(
    g: Generator,
    size: Size,
    image: Draw,
    features: Draw = uniform,
    bandwidth: Draw = between(0.1, 2),
    center: Draw = between(0.1, 1),
    before: bool = False,
    weight: Draw = between(0.1, 1),
) -> Inputs:
    def one(draw: Draw, count: int = 1) -> Tensor:
        return draw(g, size[0], count, *size[2:])

    def frame(prefix: str) -> Inputs:
        return {f"{prefix}features": one(features, 2), f"{prefix}bandwidth": one(bandwidth)}

    inputs: Inputs = {"image": image(g, *size), **frame(""), "center": one(center)}
    if before:
        inputs |= {"previous": image(g, *size), **frame("previous_"), "previous_weight": one(weight)}
    return inputs


_AFFINITY = checked(
    ops.affinity_filter,
    _alike,
    ordinary("5x5 taps, RGB", (1, 3, 1, 3), kernel_size=5, dilation=1),
    ordinary("one tap", (1, 1, 1, 2), kernel_size=1),
    stiff("bandwidths of up to 30", bandwidth=between(0, 30), before=True, kernel_size=3),
    # Central differences would need a negative weight, which is clamped.
    extreme("no weight of the centre", (1, 1, 1, 3), normal, ("image", "features", "bandwidth"), center=constant(0)),
    extreme("unknown history", weight=some(0.0, between(0.1, 1)), before=True, kernel_size=3),
    extreme("taps 64 pixels apart", dilation=64, kernel_size=3),
    *(extreme(f"features of {n:g}", features=alternating(n), kernel_size=3) for n in (1e-30, 6e4, 1e18, 1e30)),
    *(
        extreme(f"bandwidths of {n:g}", features=normal, bandwidth=constant(n), before=True, kernel_size=3)
        for n in (0, 1e6)
    ),
    extreme("unlike all", features=normal, bandwidth=constant(1e6), center=constant(0), kernel_size=3),
    settings=(
        {"kernel_size": 3, "dilation": 1},
        {"kernel_size": 3, "dilation": 1, "before": True},
        {"kernel_size": 3, "dilation": 2, "before": True},
        {"kernel_size": 3, "dilation": 8},
    ),
    sizes=SMALL,
    fireflies=stiff("fireflies", (1, 1, 2, 2), dim, kernel_size=3),
    images=("image", "previous"),
    rounds=_lost,
)


OPS = (
    _filter(ops.kernel_conv),
    _filter(ops.kernel_splat),
    _SPLAT,
    _weighted(ops.cross_bilateral_weights),
    _weighted(ops.cross_bilateral_filter),
    _PARTITION,
    _LEARNED,
    _IMPORTANCE,
    _AFFINITY,
)
