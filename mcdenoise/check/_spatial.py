"""Rows of the ops that filter an image with weights of each pixel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Generator, Tensor

from mcdenoise import ops
from mcdenoise.check.case import (
    Draw,
    Op,
    alternating,
    between,
    constant,
    dim,
    normal,
    numbers,
    radiance,
    softmax,
    some,
    times,
    uniform,
)
from mcdenoise.check.regimes import HALF, IMAGE, SMALL, Argument, checked, extreme, half, ordinary, stiff
from mcdenoise.ops._window import inside, kernel_size_of
from mcdenoise.ops.bilateral import exponent_of

_LOGITS = {"to +-1e4": times(1e4, normal), "of 1e4": times(1, normal, 1e4), "of both signs": alternating(1e4)}
_TINY = torch.finfo(torch.float32).tiny / torch.finfo(torch.float32).eps
# The mean does not depend on the scale of the weights; its gradient contains their square.
_SUMS = {"0": constant(0), **{f"{total:g}": softmax(3, total) for total in (1e-15, 90, 1e15)}}


def _filter(function: Any) -> Op:
    return checked(
        function,
        {"image": IMAGE, "kernel": Argument(between(0.5, 1.5), 9)},
        stiff("peaked weights", (1, 3, 2, 3), radiance, kernel=softmax(15), border="replicate"),
        stiff("sum of the weights of 1e-3", smooth=("image",), kernel=softmax(3, 1e-3), border="renormalize"),
        *(extreme(f"sum of the weights of {name}", kernel=each, border="renormalize") for name, each in _SUMS.items()),
        extreme("one weight infinite", kernel=some(torch.inf, softmax(3)), border="replicate"),
        extreme("weights that cancel", kernel=alternating(1e4), border="replicate"),
        extreme("7x7 on 1x2", (1, 3, 1, 2), kernel=[49, softmax(3)], border="renormalize"),
        settings={"border": ("replicate", "zeros", "renormalize"), "kernel": (25, between(-1, 1), 9, 1)},
    )


_SPLAT = checked(
    ops.softmax_splat,
    {"image": IMAGE, "logits": Argument(normal, 9, _LOGITS)},
    extreme("7x7 on 1x2", (1, 3, 1, 2), logits=49),
    settings={"logits": (9, 25, 9, 9, 1)},
    fireflies=stiff("fireflies, peaked weights", (1, 3, 2, 3), radiance, logits=times(8, normal)),
)


def _bilateral_rounds(inputs: dict[str, Any], settings: dict[str, Any]) -> dict[str, Tensor]:
    """The exponent is a sum of large terms; its rounding error counts as that of a logit of the sum of their sizes.

    The error of ``logit[t] - sum_g f_g d_g[t]^2 - f_d |o_t|^2`` is eps times ``|logit| + sum_g f_g d_g^2 + f_d
    |o_t|^2``, however small inputs and result are. A weight, ``w exp(exponent)``, has the same relative error.
    """
    border = settings.get("border", "replicate")
    own, nothing = inputs["kernel"].abs(), torch.zeros_like(inputs["kernel"])
    size = kernel_size_of(own.shape[1], "kernel")
    guides, falloffs, distance = inputs.get("guides", ()), inputs.get("falloffs", ()), inputs.get("distance_falloff")
    terms = -exponent_of(nothing, guides, falloffs, distance, size, border)
    # Those outside have no weight.
    there = inside(own, size) | (border != "renormalize")
    terms = torch.where(there, terms, 0)
    return {"kernel": own * (1 + terms) if settings.get("normalize") == "none" else own + terms}


def _far_and_near(g: Generator, *shape: int) -> Tensor:
    """Depths of 1e10, as of a sky, beside depths of 0 to 1."""
    return torch.where(uniform(g, *shape) < 0.5, 1e10, uniform(g, *shape))


def _normals(length: float) -> Draw:
    """Normals of which some are zero and the others have this length."""
    return lambda g, *shape: length * F.normalize(normal(g, *shape)) * (uniform(g, shape[0], 1, *shape[2:]) < 0.7)


_KERNEL = {
    **_LOGITS,
    "of -1e4": times(1, between(-1, 1), -1e4),
    "0": constant(0),
    "of minus infinity": constant(-torch.inf),
    **{f"{value:g} in places": some(value) for value in (torch.inf, -torch.inf)},
}
# Normals of which some are zero; and weights that are known to eps times the exponents.
_GUIDES = {"far and near": _far_and_near, **{f"normals of {n:g}": _normals(n) for n in (1, 1e3)}}


def _weighted(function: Any) -> Op:
    filtered = function is ops.cross_bilateral_filter

    def relate(inputs: dict[str, Any], settings: Mapping[str, Any]) -> None:
        inputs["falloffs"] = inputs["falloffs"][: len(inputs["guides"])]
        if filtered and settings["normalize"] == "none":
            # Weights of both signs may sum to zero, and a mean with an infinite weight is undefined.
            inputs["kernel"] = inputs["kernel"].abs().clamp_max(1e4) + 0.1

    arguments = {
        "kernel": Argument(between(-2, 2), 9),
        "guides": Argument(uniform, (1,), _GUIDES),
        "falloffs": Argument(between(0, 3), (1, 1), {"0": constant(0), "to 1e8": between(0, 1e8)}),
        "distance_falloff": Argument(between(0, 0.5), 1),
    }
    soft = {"normalize": "softmax", "border": "renormalize"}
    return checked(
        function,
        {"image": IMAGE, **arguments} if filtered else arguments,
        ordinary("5x5 taps, normals and depth", (1, 3, 1, 2), kernel=25, guides=(3, 1), **soft),
        stiff("falloffs up to 1e3", guides=between(0, 0.1), falloffs=between(0, 1e3), **soft),
        stiff("f of 1e6, guides 1e-4 apart", guides=between(-1e-4, 1e-4), falloffs=between(0, 1e6), **soft),
        *(extreme(f"logits {name}", kernel=draw, **soft) for name, draw in _KERNEL.items()),
        extreme("all weights zero", kernel=constant(0), normalize="none", border="renormalize"),
        extreme("64 channels, f of 1e3", guides=(64,), falloffs=between(0, 1e3), **soft),
        extreme("7x7 on 1x2", (1, 3, 1, 2), kernel=49, normalize="softmax", border="zeros"),
        extreme("no image", (0, 3, 3, 4), **soft),
        settings={
            "normalize": ("softmax", "none"),
            "border": ("replicate", "zeros", "renormalize"),
            "guides": ((1,), (3,), (1, 1), (), (3, 1), (3,)),
        },
        sizes=SMALL,
        limits={},
        fireflies=stiff("fireflies", (1, 3, 2, 3), dim, **soft) if filtered else None,
        relate=relate,
        weights=lambda settings: not filtered and settings["normalize"] == "softmax",
        rounds=_bilateral_rounds,
    )


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
    {"image": IMAGE, "importance": Argument(normal, 1, _LOGITS | numbers(-1e30, -1e4, 1e4, 1e30))},
    stiff("map of zeros", importance=constant(0), kernel_size=3),
    stiff("map of about 20", (1, 2, 3, 4), importance=times(20, normal), kernel_size=5),
    extreme("map with a cliff of 2e4", (1, 3, 2, 8), importance=_cliff, kernel_size=3),
    settings={"kernel_size": (3, 5, 7, 13)},
    # The step of finite differences is too coarse where the weights are nearly those of a maximum.
    fireflies=stiff("fireflies", (1, 3, 3, 4), radiance, smooth=("image",), kernel_size=5),
    rounds=_lost,
)

_FEATURES = Argument(uniform, 2, {f"{n:g} of both signs": alternating(n) for n in (1e-30, 6e4, 1e18, 1e30)})
_BANDWIDTH = Argument(between(0.1, 2), 1, numbers(0, 1e6))
_FRAME = "image features bandwidth center"
_AFFINITY = checked(
    ops.affinity_filter,
    {
        "image": IMAGE,
        "features": _FEATURES,
        "bandwidth": _BANDWIDTH,
        "center": Argument(between(0.1, 1), 1, numbers(0)),
        "previous": IMAGE,
        "previous_features": replace(_FEATURES, limits={}),
        "previous_bandwidth": replace(_BANDWIDTH, limits={}),
        "previous_weight": Argument(between(0.1, 1), 1, {"0 in places": some(0.0, between(0.1, 1))}),
    },
    ordinary("5x5 taps, RGB", (1, 3, 1, 3), kernel_size=5, only=_FRAME),
    ordinary("one tap", (1, 1, 1, 2), kernel_size=1, only=_FRAME),
    stiff("bandwidths of up to 30", bandwidth=between(0, 30), previous_bandwidth=between(0, 30), kernel_size=3),
    extreme("taps 64 pixels apart", dilation=64, kernel_size=3, only=_FRAME),
    extreme("unlike all", features=normal, bandwidth=constant(1e6), center=constant(0), kernel_size=3, only=_FRAME),
    settings={"kernel_size": (3,), "dilation": (1, 1, 2, 8), "only": (_FRAME, None, None, _FRAME)},
    sizes=SMALL,
    fireflies=stiff("fireflies", (1, 1, 2, 2), dim, kernel_size=3, only=_FRAME),
    rounds=_lost,
)

OPS = (
    _filter(ops.kernel_conv),
    _filter(ops.kernel_splat),
    _SPLAT,
    _weighted(ops.cross_bilateral_weights),
    _weighted(ops.cross_bilateral_filter),
    checked(
        ops.pyramid_partition,
        {"image": IMAGE, "logits": Argument(times(2, normal), 3, _LOGITS)},
        extreme("7 levels of 3x2", (1, 3, 3, 2), logits=7),
        settings={"logits": (3, 2, 4, 5, 1)},
        fireflies=stiff("fireflies, peaked weights", (1, 3, 3, 2), radiance, logits=times(10, normal)),
    ),
    checked(
        ops.learned_upsample,
        {
            "image": HALF,
            "kernel": Argument(softmax(1, 4), 16, {"0": constant(0), "that cancel": alternating(1e4)}, half),
        },
        extreme("8x8 taps on 1x2", (1, 3, 1, 3), kernel=64, border="replicate"),
        settings={"border": ("replicate", "zeros"), "kernel": (16, 16, 36, 4)},
        fireflies=stiff("fireflies, peaked weights", (1, 3, 3, 4), radiance, kernel=softmax(10, 4), border="replicate"),
    ),
    _IMPORTANCE,
    _AFFINITY,
)
