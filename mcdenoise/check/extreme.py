"""Stiff and extreme inputs of each op, as produced by broken shaders, half-float files and careless settings.

All of them are valid: the op must return the result of its equation, finite or infinite, up to rounding. Cases with
``differentiable`` inputs are scaled so that finite differences are accurate.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
import torch.nn.functional as F
from torch import Generator, Tensor

from mcdenoise.check.case import Case, Inputs, Rounding, map_tensors, normal, radiance, uniform
from mcdenoise.ops._constants import FARTHEST_FEATURE
from mcdenoise.ops._edges import SIGMA_N, SIGMA_Z
from mcdenoise.ops._window import Border, inside, offsets, pad, shifted, unpad
from mcdenoise.ops.affinity import tap_of, taps_of
from mcdenoise.ops.bilateral import cross_bilateral_weights
from mcdenoise.ops.fireflies import clamp_fireflies
from mcdenoise.ops.gradients import sums_of_strata
from mcdenoise.ops.temporal import Surface, reproject

Draw = Callable[..., Tensor]

# Black, far below and far above the range of half precision, its maximum, a firefly, and a denormal number.
RADIANCES = (0.0, 1e-30, 65504.0, 1e6, 1e30, 1e-40)


def _constant(value: float) -> Draw:
    def draw(g: Generator, *shape: int) -> Tensor:
        return torch.full(shape, value, dtype=torch.float64)

    return draw


def _alternating(size: float) -> Draw:
    """A checkerboard of both signs, for which sums over neighbours cancel."""

    def draw(g: Generator, *shape: int) -> Tensor:
        signs = 1 - 2 * (torch.arange(shape[-2])[:, None] + torch.arange(shape[-1])) % 2
        return size * signs * (1 + 0.1 * uniform(g, *shape))

    return draw


def _forty_decades(g: Generator, *shape: int) -> Tensor:
    return 10 ** uniform(g, *shape, low=-30, high=10)


# Images for all ops, by name.
IMAGES: dict[str, Draw] = {
    **{f"constant {value:g}": _constant(value) for value in RADIANCES},
    "six decades": radiance,
    "forty decades": _forty_decades,
    "alternating signs": _alternating(1e4),
    "alternating signs at the end of half precision": _alternating(6e4),
}
# Sizes that are difficult for borders, windows and strides.
SIZES: dict[str, tuple[int, int, int, int]] = {
    "one pixel": (1, 1, 1, 1),
    "one row of 9": (1, 3, 1, 9),
    "one column of 9": (1, 3, 9, 1),
    "64 channels": (1, 64, 2, 3),
    "no image": (0, 3, 3, 4),
}


def _tried() -> list[tuple[str, tuple[int, int, int, int], Draw]]:
    """All images in one size, and all sizes with one image."""
    images = [(name, (1, 3, 3, 5), draw) for name, draw in IMAGES.items()]
    return images + [(f"{name}, six decades", size, radiance) for name, size in SIZES.items()]


def filters() -> tuple[Case, ...]:
    """Cases of ``kernel_conv`` and ``kernel_splat``."""

    def weights(g: Generator, batch: int, *shape: int) -> Tensor:
        return torch.softmax(3 * normal(g, batch, *shape), 1)

    def case(
        name: str,
        size: tuple[int, int, int, int],
        image: Draw,
        border: str,
        kernel: Draw = weights,
        kernel_size: int = 3,
    ) -> Case:
        def tensors(g: Generator) -> Inputs:
            batch, _, height, width = size
            return {"image": image(g, *size), "kernel": kernel(g, batch, kernel_size**2, height, width)}

        return Case(f"{name}, {border}", "extreme", tensors, (), {"border": border})

    def one_infinite(g: Generator, *shape: int) -> Tensor:
        kernel = weights(g, *shape)
        kernel[:, 2, 1, 1] = torch.inf
        return kernel

    def scaled(factor: float) -> Draw:
        return lambda g, *shape: factor * weights(g, *shape)

    borders = itertools.cycle(("replicate", "zeros", "renormalize"))
    size = (1, 3, 3, 4)
    stiff = Case(
        "sum of the weights of 1e-3",
        "stiff",
        lambda g: {"image": normal(g, 1, 2, 2, 3), "kernel": 1e-3 * weights(g, 1, 9, 2, 3)},
        ("image",),
        {"border": "renormalize"},
    )
    return (
        stiff,
        *(case(name, size, draw, next(borders)) for name, size, draw in _tried()),
        case("all weights zero", size, radiance, "replicate", _constant(0.0)),
        case("all weights zero", size, radiance, "renormalize", _constant(0.0)),
        # The mean does not depend on the scale of the weights; its gradient contains their square.
        *(case(f"weights of {scale:g}", size, radiance, "renormalize", scaled(scale)) for scale in (1e-15, 1e15)),
        case("one weight infinite", size, radiance, "replicate", one_infinite),
        case("7x7 on 1x2", (1, 3, 1, 2), radiance, "renormalize", kernel_size=7),
        case("weights that cancel", size, radiance, "replicate", _alternating(1e4)),
    )


def filter_rounding(inputs: Inputs, settings: dict[str, Any]) -> Rounding:
    """The derivative of ``sum(k x) / sum(k)`` in a weight is the pixel minus the mean, each over ``sum(k)``."""
    if settings["border"] != "renormalize":
        return Rounding()
    image, kernel = inputs["image"], inputs["kernel"]
    assert isinstance(image, Tensor)
    assert isinstance(kernel, Tensor)
    size = round(kernel.shape[1] ** 0.5)
    kernel = torch.where(inside(kernel.shape[-2], kernel.shape[-1], size, kernel.device), kernel, 0)
    total = kernel.sum(1, keepdim=True).abs()
    # The maximum over the window, which bounds the mean of the absolute values.
    brightest = torch.nn.functional.max_pool2d(image.abs().sum(1, keepdim=True), size, 1, size // 2)
    factor = torch.where(total > 0, kernel.abs().sum(1, keepdim=True) / total**2, 0)
    return Rounding(gradients={"kernel": (brightest * factor).expand_as(kernel)})


def splats() -> tuple[Case, ...]:
    """Cases of ``softmax_splat``."""

    def case(name: str, size: tuple[int, int, int, int], image: Draw, logits: Draw, kernel_size: int = 3) -> Case:
        def tensors(g: Generator) -> Inputs:
            batch, _, height, width = size
            return {"image": image(g, *size), "logits": logits(g, batch, kernel_size**2, height, width)}

        return Case(name, "extreme", tensors, ())

    def spread(factor: float, offset: float = 0.0) -> Draw:
        return lambda g, *shape: offset + factor * normal(g, *shape)

    size = (1, 3, 3, 4)
    return (
        *(case(name, size, draw, normal) for name, size, draw in _tried()),
        case("logits of 1e4", size, radiance, spread(1.0, 1e4)),
        case("logits of -1e4", size, radiance, spread(1.0, -1e4)),
        case("logits to +-1e4", size, radiance, spread(1e4)),
        case("all logits equal", size, radiance, _constant(0.0)),
        case("7x7 on 1x2", (1, 3, 1, 2), radiance, normal, kernel_size=7),
    )


def splat_rounding(inputs: Inputs, settings: dict[str, Any]) -> Rounding:
    """The gradient of a logit, ``w (x[p] - out[q])`` with ``w <= 1``, has two terms of the size of pixels."""
    image, logits = inputs["image"], inputs["logits"]
    assert isinstance(image, Tensor)
    assert isinstance(logits, Tensor)
    if not image.numel():
        return Rounding()
    size = round(logits.shape[1] ** 0.5)
    # The mean at a target of a pixel contains pixels up to twice the radius away.
    brightest = torch.nn.functional.max_pool2d(image.abs().sum(1, keepdim=True), 2 * size - 1, 1, size - 1)
    return Rounding(gradients={"logits": size**2 * brightest.expand_as(logits)})


def bilateral() -> tuple[Case, ...]:
    """Cases of ``cross_bilateral_weights``."""

    def case(
        name: str,
        guide: Draw,
        scale: float,
        logits: Draw = normal,
        *,
        size: tuple[int, int, int] = (1, 2, 3),
        channels: int = 1,
        kernel_size: int = 3,
        normalize: str = "softmax",
        border: str = "renormalize",
        differentiable: tuple[str, ...] = (),
    ) -> Case:
        batch, height, width = size

        def tensors(g: Generator) -> Inputs:
            return {
                "kernel": logits(g, batch, kernel_size**2, height, width),
                "guides": [guide(g, batch, channels, height, width)],
                "falloffs": [scale * uniform(g, batch, 1, height, width, low=0.5)],
                "distance_falloff": uniform(g, batch, 1, height, width),
            }

        settings = {"normalize": normalize, "border": border}
        return Case(name, "stiff" if differentiable else "extreme", tensors, differentiable, settings)

    def spread(width: float, offset: float = 0.0) -> Draw:
        return lambda g, *shape: offset + uniform(g, *shape, low=-width, high=width)

    def one(value: float) -> Draw:
        def draw(g: Generator, *shape: int) -> Tensor:
            logits = normal(g, *shape)
            logits[:, 2] = value
            return logits

        return draw

    def far_and_near(g: Generator, *shape: int) -> Tensor:
        """Depths of 1e10, as of a sky, beside depths of 0 to 1."""
        return torch.where(uniform(g, *shape) < 0.5, 1e10, uniform(g, *shape))

    def normals(length: float) -> Draw:
        """Normals of which some are zero and the others have this length."""

        def draw(g: Generator, *shape: int) -> Tensor:
            direction = torch.nn.functional.normalize(normal(g, *shape))
            return length * direction * (uniform(g, shape[0], 1, *shape[2:]) < 0.7)

        return draw

    everything = ("kernel", "guides", "falloffs", "distance_falloff")
    small, flat = spread(1e-4), _constant(0.5)
    return (
        case("f of 1e6, guides 1e-4 apart", small, 1e6, differentiable=everything),
        case("f of 1e8, guides 1e-4 apart", small, 1e8, differentiable=("kernel", "distance_falloff")),
        case("logits 1e4 and 1 apart", spread(1.0), 1.0, spread(1.0, 1e4), differentiable=everything),
        case("f of 1e8, guides 1 apart", spread(1.0), 1e8),
        case("f of 1e8, guides of 1e4 and 1e-4 apart", spread(1e-4, 1e4), 1e8),
        case("constant guide, f of 1e8", flat, 1e8),
        case("logits to +-1e4", flat, 1.0, spread(1e4)),
        case("logits of -1e4", flat, 1.0, spread(1.0, -1e4)),
        case("one logit infinite", flat, 1.0, one(torch.inf)),
        case("one logit of minus infinity", flat, 1.0, one(-torch.inf)),
        case("all weights zero, as logits", flat, 1.0, _constant(-torch.inf)),
        case("all weights zero", flat, 1.0, _constant(0.0), normalize="none"),
        case("one weight infinite", flat, 1.0, one(torch.inf), normalize="none"),
        case("Eq. 5, f of 1e8", spread(1.0), 1e8, uniform, normalize="none"),
        case("Eq. 5, weights of 1e30", spread(1.0), 1.0, spread(1e30), normalize="none"),
        case("depth 0 and 1e10", far_and_near, 1e8),
        case("normals of length 0 and 1", normals(1.0), 1e3, channels=3),
        case("normals of length 1e3", normals(1e3), 1e3, channels=3),
        case("64 channels", uniform, 1e3, channels=64),
        case("7x7 on 1x2", uniform, 1e3, size=(1, 1, 2), kernel_size=7, border="zeros"),
        case("one pixel, f of 1e8", uniform, 1e8, size=(1, 1, 1)),
        case("one row, f of 1e8", uniform, 1e8, size=(1, 1, 9), border="replicate"),
        case("no image", uniform, 1.0, size=(0, 3, 4)),
    )


def bilateral_rounding(inputs: Inputs, settings: dict[str, Any]) -> Rounding:
    """The exponent is a sum of large terms; its rounding error counts as that of a logit of the sum of their sizes.

    ``exponent[t] = logit[t] - sum_g f_g d_g[t]^2 - f_d |o_t|^2`` has an error of eps times ``|logit| + sum_g f_g d_g^2
    + f_d |o_t|^2``, however small the inputs and the result are. A weight, ``w exp(exponent)``, has the same relative
    error.
    """
    kernel, guides, falloffs, distance = (inputs[name] for name in ("kernel", "guides", "falloffs", "distance_falloff"))
    assert isinstance(kernel, Tensor)
    assert isinstance(guides, list)
    assert isinstance(falloffs, list)
    size = round(kernel.shape[1] ** 0.5)
    height, width = kernel.shape[-2:]
    terms = torch.zeros_like(kernel)
    for guide, falloff in zip(guides, falloffs, strict=True):
        padded = pad(guide, size // 2, settings["border"])
        for tap, dy, dx in offsets(size):
            difference = shifted(padded, size // 2, dy, dx, height, width) - guide
            terms[:, tap : tap + 1] += falloff.abs() * difference.square().sum(1, keepdim=True)
    if isinstance(distance, Tensor):
        for tap, dy, dx in offsets(size):
            terms[:, tap : tap + 1] += distance.abs() * (dy * dy + dx * dx)
    exists = inside(height, width, size, kernel.device)
    if settings["border"] == "renormalize":
        terms = torch.where(exists, terms, 0)
    own = kernel.abs()
    if settings["normalize"] == "none":
        return Rounding({"kernel": own * (1 + terms)})
    exponent = torch.where(exists | (settings["border"] != "renormalize"), kernel - terms, -torch.inf)
    weights = torch.softmax(exponent.clamp(-1e300, 1e300), 1)
    return Rounding({"kernel": own + terms}, gradients=_softmax_gradients(inputs, 2 * weights, settings["border"]))


def bilateral_filters() -> tuple[Case, ...]:
    """Cases of ``cross_bilateral_filter``: those of the weights, with an image."""

    def with_image(case: Case) -> Case:
        def tensors(g: Generator) -> Inputs:
            inputs = case.tensors(g)
            kernel = inputs["kernel"]
            assert isinstance(kernel, Tensor)
            if case.settings["normalize"] == "none":
                # Weights of both signs may sum to zero.
                inputs["kernel"] = kernel.abs()
            return {"image": radiance(g, kernel.shape[0], 3, *kernel.shape[2:]), **inputs}

        return replace(case, tensors=tensors, differentiable=())

    # A mean with an infinite weight is undefined.
    return tuple(with_image(case) for case in bilateral() if case.name != "one weight infinite")


def bilateral_filter_rounding(inputs: Inputs, settings: dict[str, Any]) -> Rounding:
    """The rounding of the weights, and gradients that are differences of terms of the size of a weight times the image.

    The latter applies if the weights are normalized, by a softmax or by the sum of the weights inside the image.
    """
    weights = bilateral_rounding(inputs, settings)
    image, kernel = inputs["image"], inputs["kernel"]
    assert isinstance(image, Tensor)
    assert isinstance(kernel, Tensor)
    if not len(image) or (settings["normalize"] == "none" and settings["border"] != "renormalize"):
        return weights
    if settings["normalize"] == "none":
        unsigned = {name: value for name, value in inputs.items() if name != "image"} | {"kernel": kernel.abs()}
        fractions = cross_bilateral_weights(**unsigned, **settings)  # type: ignore[arg-type]
        fractions = fractions / fractions.sum(1, keepdim=True).clamp_min(torch.finfo(fractions.dtype).tiny)
        gradients = _softmax_gradients(inputs, 2 * fractions.nan_to_num(), "renormalize")
        gradients["kernel"] = 2 * fractions.nan_to_num() / kernel.abs()
        weights = replace(weights, gradients=gradients)
    brightest = image.abs().sum(1, keepdim=True).amax((2, 3), keepdim=True)
    return Rounding(weights.arguments, gradients=map_tensors(lambda size: brightest * size, weights.gradients))


def _softmax_gradients(inputs: Inputs, exponent: Tensor, border: Border) -> Inputs:
    """``w (v - sum(w v))`` is a difference of terms of the size of ``w``, and so are the gradients that follow."""
    guides, falloffs, distance = inputs["guides"], inputs["falloffs"], inputs["distance_falloff"]
    assert isinstance(guides, list)
    assert isinstance(falloffs, list)
    size = round(exponent.shape[1] ** 0.5)
    height, width = exponent.shape[-2:]
    of_guides, of_falloffs = [], []
    for guide, falloff in zip(guides, falloffs, strict=True):
        padded = pad(guide, size // 2, border)
        far, near, own = torch.zeros_like(padded), torch.zeros_like(guide), torch.zeros_like(falloff)
        for tap, dy, dx in offsets(size):
            difference = (shifted(padded, size // 2, dy, dx, height, width) - guide).abs()
            pull = 2 * falloff.abs() * difference * exponent[:, tap : tap + 1]
            shifted(far, size // 2, dy, dx, height, width).add_(pull)
            near += pull
            own += difference.square().sum(1, keepdim=True) * exponent[:, tap : tap + 1]
        of_guides.append(near + unpad(far, size // 2, border))
        of_falloffs.append(own)
    gradients: Inputs = {"kernel": exponent, "guides": of_guides, "falloffs": of_falloffs}
    if isinstance(distance, Tensor):
        squares = torch.tensor([dy * dy + dx * dx for _, dy, dx in offsets(size)], dtype=exponent.dtype)
        gradients["distance_falloff"] = (exponent * squares[:, None, None]).sum(1, keepdim=True)
    return gradients


def images(halved: bool) -> tuple[Case, ...]:
    """Cases of ``downsample``, or of ``upsample`` to twice the size."""

    def case(name: str, size: tuple[int, int, int, int], draw: Draw) -> Case:
        settings = {"size": (2 * size[2] - 1, 2 * size[3])} if halved else {}
        return Case(name, "extreme", lambda g: {"image": draw(g, *size)}, (), settings)

    return tuple(case(*tried) for tried in _tried())


def fusions() -> tuple[Case, ...]:
    """Cases of ``laplacian_fusion``."""

    def case(name: str, size: tuple[int, int, int, int], draw: Draw, alpha: Draw = uniform) -> Case:
        batch, channels, height, width = size

        def tensors(g: Generator) -> Inputs:
            return {
                "fine": draw(g, *size),
                "coarse": draw(g, batch, channels, (height + 1) // 2, (width + 1) // 2),
                "alpha": alpha(g, batch, 1, height, width),
            }

        return Case(name, "extreme", tensors, ())

    return (
        *(case(*tried) for tried in _tried()),
        case("alpha 0", (1, 3, 3, 4), radiance, _constant(0.0)),
        case("alpha 1", (1, 3, 3, 4), radiance, _constant(1.0)),
    )


def partitions() -> tuple[Case, ...]:
    """Cases of ``pyramid_partition``."""

    def three(g: Generator, *shape: int) -> Tensor:
        return 3 * normal(g, *shape)

    def case(name: str, size: tuple[int, int, int, int], image: Draw, logits: Draw = three, levels: int = 3) -> Case:
        def tensors(g: Generator) -> Inputs:
            return {"image": image(g, *size), "logits": logits(g, size[0], levels, *size[2:])}

        return Case(name, "extreme", tensors, ())

    return (
        *(case(*tried) for tried in _tried()),
        case("equal logits of 1e4", (1, 3, 3, 4), radiance, _constant(1e4)),
        case("logits of 1e4, of both signs", (1, 3, 3, 4), radiance, _alternating(1e4)),
        case("7 levels of 3x2", (1, 3, 3, 2), radiance, levels=7),
    )


def partition_rounding(inputs: Inputs, settings: dict[str, Any]) -> Rounding:
    """The gradient of a softmax, ``w (v - sum(w v))``, is a difference of terms of the size of ``w``."""
    image, logits = inputs["image"], inputs["logits"]
    assert isinstance(image, Tensor)
    assert isinstance(logits, Tensor)
    return Rounding(gradients={"logits": 2 * torch.softmax(logits, 1) * image.abs().sum(1, keepdim=True)})


def learned() -> tuple[Case, ...]:
    """Cases of ``learned_upsample``."""

    def weights(g: Generator, *shape: int) -> Tensor:
        return 4 * torch.softmax(3 * normal(g, *shape), 1)

    def case(
        name: str,
        size: tuple[int, int, int, int],
        image: Draw,
        border: str,
        kernel: Draw = weights,
        side: int = 4,
    ) -> Case:
        def tensors(g: Generator) -> Inputs:
            return {"image": image(g, *size), "kernel": kernel(g, size[0], side**2, *size[2:])}

        settings = {"size": (2 * size[2] - 1, 2 * size[3]), "border": border}
        return Case(f"{name}, {border}", "extreme", tensors, (), settings)

    borders = itertools.cycle(("replicate", "zeros"))
    return (
        *(case(name, size, draw, next(borders)) for name, size, draw in _tried()),
        case("all weights zero", (1, 3, 3, 4), radiance, "replicate", _constant(0.0)),
        case("weights that cancel", (1, 3, 3, 4), radiance, "zeros", _alternating(1e4)),
        case("8x8 taps on 1x2", (1, 3, 1, 2), radiance, "replicate", side=8),
    )


def demodulations(image: str) -> tuple[Case, ...]:
    """Cases of ``demodulate`` and ``remodulate``."""

    def case(name: str, size: tuple[int, int, int, int], draw: Draw, albedo: Draw = uniform) -> Case:
        return Case(name, "extreme", lambda g: {image: draw(g, *size), "albedo": albedo(g, *size)}, ())

    def barely(g: Generator, *shape: int) -> Tensor:
        """Half-precision albedos on both sides of the threshold below which a pixel counts as untextured."""
        return 1e-4 * (1 + 2.0 ** -uniform(g, *shape, low=6, high=12) * torch.sign(normal(g, *shape)))

    return (
        *(case(*tried) for tried in _tried()),
        *(case(f"albedo {value:g}", (1, 3, 2, 3), radiance, _constant(value)) for value in (0.0, 1e-8, 1e-4, 5.0, 1e4)),
        case("albedo about 1e-4", (1, 3, 5, 7), radiance, barely),
    )


def fireflies() -> tuple[Case, ...]:
    """Cases of ``clamp_fireflies``."""

    def case(name: str, size: tuple[int, int, int, int], draw: Draw, **settings: float) -> Case:
        return Case(name, "extreme", lambda g: {"image": draw(g, *size)}, (), settings)

    return (
        *(case(f"{name}, limit 2", size, draw, limit=2.0) for name, size, draw in _tried() if "signs" not in name),
        case("limit 1e-6", (1, 3, 3, 4), radiance, limit=1e-6),
        case("limit 1e30", (1, 3, 3, 4), radiance, limit=1e30),
        case("window of 99", (1, 3, 3, 4), radiance, kernel_size=99),
    )


def firefly_rounding(inputs: Inputs, settings: dict[str, Any]) -> Rounding:
    """The derivative of ``x limit n / y`` in a bright ``x`` is a difference of terms of the size ``limit n / y``."""
    image = inputs["image"]
    assert isinstance(image, Tensor)
    before, after = image.sum(1, keepdim=True), clamp_fireflies(image, **settings).sum(1, keepdim=True)
    factor = torch.where(before > 0, after / torch.where(before > 0, before, 1), 1)
    return Rounding(gradients={"image": (2 * image.shape[1] * factor).expand_as(image)})


def lags() -> tuple[Case, ...]:
    """Cases of ``history_lag``."""

    def case(
        name: str, size: tuple[int, int, int, int], history: Draw, recent: Draw | None = None, noise: float = 0.3
    ) -> Case:
        def tensors(g: Generator) -> Inputs:
            images = {"history": history(g, *size), "recent": (recent or history)(g, *size)}
            variance = (noise * images["history"].mean(1, keepdim=True)).square()
            return {**images, "variance": variance}

        return Case(name, "extreme", tensors, ())

    size = (1, 3, 5, 6)
    return (
        *(case(*tried) for tried in _tried()),
        case("the light goes out", size, radiance, _constant(0.0)),
        case("the light goes on", size, _constant(0.0), lambda g, *shape: uniform(g, *shape, low=0.5)),
        case("the light goes on at 1e30", size, _constant(0.0), _constant(1e30)),
        case("1e30 and 1e-30", size, _constant(1e30), _constant(1e-30)),
        case("radiance without noise", size, radiance, noise=0.0),
        case("noise of 1e15 times the light", size, _constant(1.0), noise=1e15),
    )


def transforms() -> tuple[Case, ...]:
    """Cases of ``atrous``."""

    def case(
        name: str,
        size: tuple[int, int, int, int],
        light: Draw,
        normals: Draw = normal,
        depth: Draw = lambda g, *shape: uniform(g, *shape, low=1, high=9),
        noise: float = 0.5,
        step: int = 1,
    ) -> Case:
        batch, _, height, width = size

        def tensors(g: Generator) -> Inputs:
            image, shape = light(g, batch, 3, height, width), (batch, 1, height, width)
            variance = (noise * image.abs().mean(1, keepdim=True)).square().clamp_max(1e34)
            return {"light": image, "variance": variance, "normal": normals(g, *image.shape), "depth": depth(g, *shape)}

        return Case(name, "extreme", tensors, (), {"step": step})

    size = (1, 3, 3, 5)
    return (
        *(case(*tried) for tried in _tried()),
        case("taps 64 pixels apart", size, radiance, step=64),
        case("radiance without noise", size, radiance, noise=0.0),
        case("noise of 1e15 times the light", size, radiance, noise=1e15),
        *(case(f"depth {value:g}", size, radiance, depth=_constant(value)) for value in (0.0, 1e-30, 1e30, math.inf)),
        case("depths of forty decades", size, radiance, depth=_forty_decades),
        case("no normals", size, radiance, normals=_constant(0.0)),
    )


def transform_rounding(inputs: Inputs, settings: dict[str, Any]) -> Rounding:
    """A weight below the smallest number of float32 becomes 0, however large the value is that it multiplies.

    A pixel has 25 weights. A derivative multiplies them by the range of the images and by the derivative of the
    exponent in the argument, which is at most 1e4 where it matters.
    """
    tensors = {name: value for name, value in inputs.items() if isinstance(value, Tensor)}
    light, variance = tensors["light"], tensors["variance"]
    if not light.numel():
        return Rounding()
    limits = torch.finfo(torch.float32)
    size = float(light.abs().amax() + variance.amax())
    least = float(variance.amin()) + 1e-20
    slopes = {"light": least**-0.5, "variance": 1e4 / least, "normal": 128.0, "depth": 1e4 / 1e-30}
    lost = 25 * limits.tiny / limits.eps * size
    return Rounding(gradients={name: torch.full_like(tensors[name], lost * slopes[name]) for name in tensors})


def affinities() -> tuple[Case, ...]:
    """Cases of ``affinity_filter``."""

    def case(
        name: str,
        size: tuple[int, int, int, int],
        image: Draw,
        features: Draw = uniform,
        bandwidth: float = 2.0,
        center: float = 0.5,
        *,
        before: bool = False,
        kernel_size: int = 3,
        dilation: int = 1,
    ) -> Case:
        batch, _, height, width = size

        def tensors(g: Generator) -> Inputs:
            def frame(prefix: str) -> Inputs:
                widths = bandwidth * uniform(g, batch, 1, height, width, low=0.5)
                named = {"features": features(g, batch, 4, height, width), "bandwidth": widths}
                return {f"{prefix}{key}": value for key, value in named.items()}

            inputs: Inputs = {"image": image(g, *size), **frame("")}
            inputs["center"] = center * uniform(g, batch, 1, height, width, low=0.5)
            if before:
                inputs |= {"previous": image(g, *size), **frame("previous_")}
                inputs["previous_weight"] = uniform(g, batch, 1, height, width).round()
            return inputs

        return Case(name, "extreme", tensors, (), {"kernel_size": kernel_size, "dilation": dilation})

    size = (1, 3, 3, 4)
    return (
        *(case(*tried) for tried in _tried()),
        case("7x7 taps, frame before", size, radiance, before=True, kernel_size=7),
        case("taps 64 pixels apart", size, radiance, dilation=64),
        *(case(f"features of {value:g}", size, radiance, _alternating(value)) for value in (1e-30, 6e4, 1e18, 1e30)),
        case("equal features", size, radiance, _constant(0.3), 1e6),
        case("bandwidths of 0", size, radiance, normal, 0.0, before=True),
        case("bandwidths of 1e6", size, radiance, normal, 1e6, before=True),
        case("unlike all neighbours, no weight of the centre", size, radiance, normal, 1e6, 0.0),
        case("no weight of the centre, frame before", size, radiance, center=0.0, before=True),
    )


def affinity_rounding(inputs: Inputs, settings: dict[str, Any]) -> Rounding:
    """The derivative of a mean in a weight is the value of its tap minus the mean, each over the sum of the weights.

    In addition, a weight below the smallest number of float32 may become 0: then the weight times its value is lost.
    """
    tensors = {name: value for name, value in inputs.items() if isinstance(value, Tensor)}
    image, here = tensors["image"], tensors["features"]
    if not image.numel():
        return Rounding()
    limits, radius = torch.finfo(torch.float32), settings["kernel_size"] // 2 * settings["dilation"]
    values = [tensors[name] for name in ("image", "previous") if name in tensors]
    brightest = max(float(each.abs().sum(1).amax()) for each in values)
    total, lost = tensors["center"].clamp_min(1e-6), torch.zeros_like(tensors["center"])
    taps = []
    for name in ("", "previous_")[: len(values)]:
        there, bandwidth = tensors[f"{name}features"], tensors[f"{name}bandwidth"]
        known = tensors["previous_weight"] if name else torch.ones_like(bandwidth)
        padded, inside = (F.pad(each, (radius,) * 4) for each in (there, known))
        for at in taps_of(**settings, skip_center=not name):
            difference = (here - tap_of(padded, here, *at)).clamp(-FARTHEST_FEATURE, FARTHEST_FEATURE)
            distance = difference.square().sum(1, keepdim=True)
            weight = torch.exp(-bandwidth * distance)
            counts = tap_of(inside, here, *at)
            gone = torch.where(weight < limits.tiny, weight / limits.eps, 0)
            total, lost = total + counts * weight, lost + counts * gone * brightest
            taps.append((name, at, difference.abs(), distance, weight + gone, counts, bandwidth))
    gradients: Inputs = {"center": 2 * brightest / total}
    sums = {name: torch.zeros_like(each) for name, each in tensors.items() if name not in gradients}
    far = {name: F.pad(sums[name], (radius,) * 4) for name in sums}
    for name, at, difference, distance, weight, counts, bandwidth in taps:
        term = 2 * brightest / total * weight
        pull = 2 * bandwidth * counts * term * difference
        sums["features"] += pull
        sums[f"{name}bandwidth"] += counts * term * distance
        tap_of(far[f"{name}features"], here, *at).add_(pull)
        if name:
            tap_of(far["previous_weight"], here, *at).add_(term)
    gradients |= {name: each + tap_of(far[name], here, 0, 0) for name, each in sums.items()}
    return Rounding(result=float((lost / total).amax()), gradients=gradients)


def _guides() -> dict[str, Draw]:
    """Constant guides at the ends of the range and beyond, and a guide of two values."""

    def two(g: Generator, *shape: int) -> Tensor:
        return (uniform(g, *shape) > 0.5).double()

    return {
        "0": _constant(0.0),
        "1": _constant(1.0),
        "0 or 1": two,
        "beyond the range": lambda g, *shape: 6 * uniform(g, *shape) - 2,
    }


def grid_splats() -> tuple[Case, ...]:
    """Cases of ``grid_splat``."""

    def case(
        name: str,
        size: tuple[int, int, int, int],
        image: Draw,
        guide: Draw = uniform,
        cell: int = 2,
        bins: int = 4,
    ) -> Case:
        def tensors(g: Generator) -> Inputs:
            return {"image": image(g, *size), "guide": guide(g, size[0], 1, *size[2:])}

        return Case(name, "extreme", tensors, (), {"cell": cell, "bins": bins})

    return (
        *(case(*tried) for tried in _tried()),
        *(case(f"guide {name}", (1, 3, 3, 4), radiance, draw) for name, draw in _guides().items()),
        # At bin centres the tents of the neighbouring bins end.
        case("guide at the centres of bins", (1, 1, 2, 3), radiance, _guides()["0 or 1"], bins=256),
        case("cells larger than the image", (1, 3, 3, 4), radiance, cell=100),
    )


def grid_slices() -> tuple[Case, ...]:
    """Cases of ``grid_slice``."""

    def case(
        name: str,
        size: tuple[int, int, int, int],
        image: Draw,
        guide: Draw = uniform,
        filled: Draw = lambda g, *shape: (uniform(g, *shape) > 0.3).double(),
    ) -> Case:
        batch, channels, rows, columns = size

        def tensors(g: Generator) -> Inputs:
            # Draw an image over the rows and columns of cells.
            grid = image(g, batch, channels, rows, columns)[..., None] * uniform(g, batch, 1, rows, columns, 4)
            known = filled(g, batch, 1, rows, columns, 4)
            return {"grid": grid, "filled": known, "guide": guide(g, batch, 1, 2 * rows, 2 * columns - 1)}

        return Case(name, "extreme", tensors, (), {"cell": 2})

    return (
        *(case(*tried) for tried in _tried()),
        *(case(f"guide {name}", (1, 3, 2, 3), radiance, draw) for name, draw in _guides().items()),
        case("cells of weight 1e-3", (1, 3, 2, 3), radiance, filled=_constant(1e-3)),
    )


def grid_rounding(inputs: Inputs, settings: dict[str, Any]) -> Rounding:
    """The coordinate of a guide is a number up to the number of bins, and proportional to the guide.

    So the rounding errors of the coordinate, and of the height of a tent, count as those of a guide of 1. The
    derivatives of a mean, ``sum a' (c - mean) / sum a``, are differences of terms of the size of ``c`` and of the mean.
    """
    tensors = {name: value for name, value in inputs.items() if isinstance(value, Tensor)}
    guide = tensors["guide"]
    magnitude: Inputs = {"guide": guide.abs().clamp_min(1)}
    if not len(guide):
        return Rounding(magnitude)
    bins = settings["bins"] if "bins" in settings else tensors["grid"].shape[-1]
    around, slope = "vy,ux,bwyx", 255 / 256 * bins
    position = guide[:, :1].clamp(0, 1) * slope + 0.5 / 256 * bins - 0.5
    distance = (position - torch.arange(bins).reshape(-1, 1, 1)).abs()
    rows, columns = (_tents(side, settings["cell"]) for side in guide.shape[2:])
    heights, near = (1 - distance).clamp_min(0), (distance < 1).double()
    if "image" in tensors:
        image = tensors["image"].abs()
        total = torch.einsum(f"{around}->bvuw", rows, columns, heights)[:, None]
        inverse = torch.where(total > 0, 1 / total, 0)
        mean = torch.einsum(f"{around},bcyx->bcvuw", rows, columns, heights, image) * inverse
        own = torch.einsum(f"{around},bvuw->byx", rows, columns, near, inverse[:, 0])[:, None] * image
        terms = own + torch.einsum(f"{around},bcvuw->bcyx", rows, columns, near, mean * inverse)
        return Rounding(magnitude, gradients={"guide": slope * terms.sum(1, keepdim=True)})
    grid, filled = tensors["grid"].abs(), tensors["filled"]
    total = torch.einsum(f"{around},bvuw->byx", rows, columns, heights, filled[:, 0])[:, None]
    inverse = torch.where(total > 0, 1 / total, 0)
    mean = torch.einsum(f"{around},bcvuw->bcyx", rows, columns, heights, grid * filled) * inverse
    cells = torch.einsum(f"{around},bcvuw->bcyx", rows, columns, near, grid * filled)
    weights = torch.einsum(f"{around},bvuw->byx", rows, columns, near, filled[:, 0])[:, None]
    of_guide = ((cells + weights * mean) * inverse).sum(1, keepdim=True) * slope
    own = torch.einsum(f"{around},byx->bvuw", rows, columns, heights, inverse[:, 0])[:, None] * grid
    of_filled = own + torch.einsum(f"{around},bcyx->bcvuw", rows, columns, heights, mean * inverse)
    return Rounding(magnitude, gradients={"guide": of_guide, "filled": of_filled.sum(1, keepdim=True)})


def _tents(side: int, cell: int) -> Tensor:
    """``(cells, side)`` weight of each pixel of a row in each cell."""
    place = (torch.arange(side, dtype=torch.float64) + 0.5) / cell
    return (1 - (place - torch.arange(-(-side // cell))[:, None] - 0.5).abs()).clamp_min(0)


def importances() -> tuple[Case, ...]:
    """Cases of ``importance_filter``."""

    def case(
        name: str, size: tuple[int, int, int, int], image: Draw, worth: Draw = normal, kernel_size: int = 3
    ) -> Case:
        def tensors(g: Generator) -> Inputs:
            return {"image": image(g, *size), "importance": worth(g, size[0], 1, *size[2:])}

        return Case(name, "extreme", tensors, (), {"kernel_size": kernel_size})

    def ten_thousands(g: Generator, *shape: int) -> Tensor:
        return uniform(g, *shape, low=-1e4, high=1e4)

    def cliff(g: Generator, *shape: int) -> Tensor:
        """An importance with a step: on either side, windows contain only small or only large values."""
        drawn = 0.1 * normal(g, *shape)
        return drawn + torch.where(torch.arange(shape[-1]) < shape[-1] // 2, -1e4, 1e4)

    size = (1, 3, 3, 5)
    return (
        *(case(*tried) for tried in _tried()),
        case("map of -1e4 to 1e4", size, radiance, ten_thousands, 5),
        case("map with a cliff of 2e4", (1, 3, 2, 8), radiance, cliff),
        *(case(f"map of {value:g}", size, radiance, _constant(value), 5) for value in (-1e30, -1e4, 1e4, 1e30)),
        case("window of 21", (1, 3, 3, 4), radiance, kernel_size=21),
    )


def importance_rounding(inputs: Inputs, settings: dict[str, Any]) -> Rounding:
    """A weight below the smallest number of float32 becomes 0, and derivatives of weights near 1 are small differences.

    Two windows with weights ``a`` and ``b`` and means ``x`` and ``y`` are merged to ``a x / s + b y / s``,
    ``s = a + b``, whose derivative in ``a`` is ``x / s - a x / s^2 - b y / s^2``. These terms may cancel. Because ``s``
    is at least 1, their sum is at most three times the brightest pixel, per channel, per merge of two windows, and per
    window that contains the pixel.
    """
    image, importance = inputs["image"], inputs["importance"]
    assert isinstance(image, Tensor)
    assert isinstance(importance, Tensor)
    if not image.numel():
        return Rounding()
    size, kernel_size = float(image.abs().amax()), int(settings["kernel_size"])
    rows, columns = (min(kernel_size, side) for side in image.shape[-2:])
    windows, joinings = rows * columns, 4 * kernel_size.bit_length()
    lost = windows * torch.finfo(torch.float32).tiny
    terms = torch.full_like(importance, 3 * image.shape[1] * windows * joinings * size)
    return Rounding(result=lost * size, gradients={"image": torch.full_like(image, lost), "importance": terms})


def luminances() -> tuple[Case, ...]:
    """Cases of ``luminance_moments``."""
    return tuple(
        Case(name, "extreme", lambda g, draw=draw, size=size: {"light": draw(g, size[0], 3, *size[2:])}, ())  # type: ignore[misc]
        for name, size, draw in _tried()
    )


def moments() -> tuple[Case, ...]:
    """Cases of ``moments_variance``."""

    def case(name: str, size: tuple[int, int, int, int], draw: Draw, spread: float = 1.0, kernel_size: int = 3) -> Case:
        batch, _, height, width = size

        def tensors(g: Generator) -> Inputs:
            mean = draw(g, batch, 1, height, width)
            return {
                "moments": torch.cat([mean, mean.square() * (1 + spread)], 1),
                "normal": normal(g, batch, 3, height, width),
                "depth": uniform(g, batch, 1, height, width, low=1, high=9),
            }

        return Case(name, "extreme", tensors, (), {"kernel_size": kernel_size})

    return (
        *(case(*tried) for tried in _tried()),
        case("moments that cancel altogether", (1, 3, 3, 5), radiance, 0.0, 1),
        case("window of 21", (1, 3, 3, 4), radiance, kernel_size=21),
    )


def gradients() -> tuple[Case, ...]:
    """Cases of ``temporal_gradient``."""

    def case(
        name: str, size: tuple[int, int, int, int], draw: Draw, noise: float = 0.1, depth: Draw | None = None
    ) -> Case:
        batch, _, height, width = size
        shape = (batch, 1, height, width)

        def tensors(g: Generator) -> Inputs:
            previous = draw(g, *shape).abs()
            return {
                "current": previous * uniform(g, *shape),
                "previous": previous,
                "weight": uniform(g, *shape),
                "variance": (noise * previous).square().clamp_max(1e34),
                "normal": normal(g, batch, 3, height, width),
                "depth": uniform(g, *shape, low=1, high=9) if depth is None else depth(g, *shape),
            }

        return Case(name, "extreme", tensors, (), {"levels": 2, "stratum": 2})

    size = (1, 3, 3, 5)
    return (
        *(case(*tried) for tried in _tried()),
        case("noise of 1e15 times the light", size, radiance, noise=1e15),
        *(case(f"depth {value:g}", size, radiance, depth=_constant(value)) for value in (0.0, 1e-30, 1e30, math.inf)),
    )


# Powers of the unit of luminance in the unit of each argument.
_POWERS = {"current": 1, "previous": 1, "variance": 2}


def gradient_rounding(inputs: Inputs, settings: dict[str, Any]) -> Rounding:
    """The derivatives of ``sqrt((D / M)^2 - (t / M)^2 V)`` are differences of terms that may cancel completely.

    An example is the weight of a single pixel, on which ``D / M`` does not depend. With ``|dD| <= dM`` the terms are at
    most ``2 ((D / M)^2 + t^2 V / M^2) dM / M + (t^2 V / M^2) dV / V`` over the result.
    """
    names = ("current", "previous", "weight")
    tensors = {name: inputs[name].clone().requires_grad_() for name in names if isinstance(inputs.get(name), Tensor)}  # type: ignore[union-attr]
    if not tensors["current"].numel():
        return Rounding()
    defaults: dict[str, Any] = {
        "stratum": 3,
        "levels": 5,
        "threshold": 2.0,
        "sigma_z": SIGMA_Z,
        "sigma_n": SIGMA_N,
        **settings,
    }
    threshold = defaults.pop("threshold")
    others = {name: inputs.get(name) for name in ("weight", "variance", "normal", "depth")}
    with torch.enable_grad():
        difference, size, noise = sums_of_strata(**{**others, **tensors}, **defaults)  # type: ignore[arg-type]
        some = size > 0
        size = torch.where(some, size, 1)
        change, noisy = (difference / size).square().detach(), threshold**2 * (noise / size.square()).detach()
        found = some & (change > noisy)
        result = torch.sqrt(torch.where(found, change - noisy, 1))
        of_size = torch.where(found, 2 * (change + noisy) / result, 0) * torch.log(size)
        of_noise = torch.where(found, noisy / result, 0) * torch.log(torch.where(noise > 0, noise, 1))
        # A pixel has the gradient terms of all pixels of its stratum.
        terms = defaults["stratum"] ** 2 * (of_size + of_noise).sum()
        found_gradients = torch.autograd.grad(terms, list(tensors.values()), allow_unused=True, materialize_grads=True)
    # Relative to the maximum luminance, values below the smallest number of float32 become 0.
    limits = torch.finfo(torch.float32)
    largest = max(float(tensors[name].detach().abs().max()) for name in ("current", "previous"))
    lost = {name: limits.tiny / limits.eps * largest**power for name, power in _POWERS.items()}
    seen = {name: inputs[name] for name in lost if isinstance(inputs.get(name), Tensor)}
    arguments: Inputs = {name: value.abs().clamp_min(lost[name]) for name, value in seen.items()}  # type: ignore[union-attr]
    gradients: Inputs = dict(zip(tensors, found_gradients, strict=True))
    facing, deviation = inputs.get("normal"), inputs.get("variance")
    if isinstance(facing, Tensor) and isinstance(deviation, Tensor) and found.any():
        # So do squared weights, however large the variance is that they multiply.
        spread = float(deviation.max()) / (float(size.detach()[found].min()) * largest) ** 2
        lost_weight = 9 * defaults["levels"] * limits.tiny / limits.eps * threshold**2 * spread
        gradients["normal"] = torch.full_like(facing, 2 * SIGMA_N * lost_weight)
        distance = inputs.get("depth")
        if isinstance(distance, Tensor):
            gradients["depth"] = 2 * lost_weight / (1e-3 * distance.clamp_min(1e-30))
    return Rounding(arguments, gradients=gradients)


def regressions() -> tuple[Case, ...]:
    """Cases of ``block_regression``."""

    def case(name: str, size: tuple[int, int, int, int], draw: Draw, features: Draw = normal, squares: int = 1) -> Case:
        batch, _, height, width = size

        def tensors(g: Generator) -> Inputs:
            return {"image": draw(g, *size), "features": features(g, batch, 2, height, width)}

        return Case(name, "extreme", tensors, (), {"block": 3, "offset": (1, 2), "squares": squares})

    size = (1, 3, 3, 4)
    return (
        *(case(*tried) for tried in _tried()),
        # No squares: a feature that is nearly all in one pixel is proportional to its square.
        *(case(f"features {name}", size, radiance, draw, squares=0) for name, draw in IMAGES.items()),
    )


def motions() -> tuple[Case, ...]:
    """Cases of ``motion_from_position``."""

    def case(name: str, position: Draw, w: float = 1.0, size: tuple[int, int, int, int] = (1, 3, 3, 4)) -> Case:
        """A case with a camera at the origin that looks along z; ``w`` scales the last column of its matrix."""

        def tensors(g: Generator) -> Inputs:
            matrix = torch.eye(4, dtype=torch.float64).repeat(size[0], 1, 1)
            matrix[:, 2, 3], matrix[:, 3, 3] = w, 0
            return {"position": position(g, *size), "previous_view_projection": matrix}

        return Case(name, "extreme", tensors, ())

    def before(distance: float) -> Draw:
        return lambda g, *shape: distance * uniform(g, *shape, low=0.5)

    def some(value: float) -> Draw:
        def draw(g: Generator, *shape: int) -> Tensor:
            position = before(3.0)(g, *shape)
            position[:, 1, 0] = value
            return position

        return draw

    return (
        *(case(f"distance {distance:g}", before(distance)) for distance in (1e-30, 1e-4, 1e10, 1e30)),
        case("at the eye", _constant(0.0)),
        case("some infinite", some(torch.inf)),
        case("some NaN", some(torch.nan)),
        case("behind the camera", lambda g, *shape: -before(3.0)(g, *shape)),
        # Points near the plane of the camera have very large motion.
        case("w of 1e-15", before(1.0), 1e-15),
        case("w of 1e15", before(1.0), 1e15),
        case("one row of 9", before(3.0), size=(1, 3, 1, 9)),
        case("no image", before(3.0), size=(0, 3, 3, 4)),
    )


def motion_rounding(inputs: Inputs, settings: dict[str, Any]) -> Rounding:
    """Motion is a difference of two pixel positions, which are rounded as numbers up to the image's size."""
    position = inputs["position"]
    assert isinstance(position, Tensor)
    return Rounding(result=float(max(position.shape[-2:])))


def histories(accumulating: bool) -> tuple[Case, ...]:
    """Cases of ``reproject`` and ``accumulate``."""

    def case(
        name: str,
        size: tuple[int, int, int, int] = (1, 3, 3, 4),
        draw: Draw = radiance,
        *,
        motion: Draw = lambda g, *shape: uniform(g, *shape, low=-0.9, high=0.9),
        length: Draw = lambda g, *shape: uniform(g, *shape, low=1, high=30),
        surface: Callable[[Generator, int, int, int], Surface] | None = None,
        alpha_min: float = 0.1,
        rule: str = "relative",
    ) -> Case:
        batch, _, height, width = size
        settings: dict[str, Any] = {"rule": rule}
        if accumulating:
            settings["alpha_min"] = alpha_min

        def tensors(g: Generator) -> Inputs:
            inputs: Inputs = {"previous": draw(g, *size), "motion": motion(g, batch, 2, height, width)}
            if surface is not None:
                seen = surface(g, batch, height, width)
                inputs["surface"], inputs["previous_surface"] = seen, seen
            if accumulating:
                inputs["color"] = draw(g, *size)
                inputs["previous_length"] = length(g, batch, 1, height, width)
            return inputs

        return Case(name, "extreme", tensors, (), settings)

    def moved(value: float) -> Draw:
        def draw(g: Generator, *shape: int) -> Tensor:
            motion = torch.zeros(shape, dtype=torch.float64)
            motion[:, :, :, 1] = value
            return motion

        return draw

    def wall(depth: float, normal_length: float = 1.0) -> Callable[[Generator, int, int, int], Surface]:
        def surface(g: Generator, batch: int, height: int, width: int) -> Surface:
            facing = torch.tensor([0.0, 0.0, -normal_length], dtype=torch.float64).reshape(1, 3, 1, 1)
            position = torch.cat([uniform(g, batch, 2, height, width), torch.full((batch, 1, height, width), depth)], 1)
            return Surface(position, facing.repeat(batch, 1, height, width), position[:, 2:])

        return surface

    return (
        *(case(*tried) for tried in _tried()),
        *(case(f"motion {value:g}", motion=moved(value)) for value in (1e10, 1e30, torch.inf, -torch.inf, torch.nan)),
        *(case(f"motion {value:g}", motion=moved(value)) for value in (1e-3, 1e-30)),
        *(case(f"history of {n:g} frames", length=_constant(n)) for n in (1.0, 255.0, 1e4, 65504.0)),
        case("history of 1e4 frames, never forgotten", length=_constant(1e4), alpha_min=1e-6),
        *(case(f"depth {depth:g}", surface=wall(depth)) for depth in (0.0, 1e-6, 1e4, 1e10, torch.inf)),
        case("normals of length 0", surface=wall(5.0, 0.0)),
        case("normals of length 1e3", surface=wall(5.0, 1e3)),
    )


def resamplings() -> tuple[Case, ...]:
    """Cases of ``resample``."""

    def case(
        name: str, size: tuple[int, int, int, int] = (1, 3, 3, 4), draw: Draw = radiance, motion: float | None = None
    ) -> Case:
        def tensors(g: Generator) -> Inputs:
            batch, _, height, width = size
            moved = uniform(g, batch, 2, height, width, low=-0.9, high=0.9)
            if motion is not None:
                moved[..., 1] = motion
            return {"previous": draw(g, *size), "motion": moved}

        return Case(name, "extreme", tensors, ())

    return (
        *(case(*tried) for tried in _tried()),
        *(case(f"motion {value:g}", motion=value) for value in (1e10, 1e30, torch.inf, -torch.inf, torch.nan, 1e-30)),
    )


def resampling_rounding(inputs: Inputs, settings: dict[str, Any]) -> Rounding:
    """``q = p + motion`` is rounded as a number up to the image's size, and terms of both signs are added."""
    motion, previous = inputs["motion"], inputs["previous"]
    assert isinstance(motion, Tensor)
    assert isinstance(previous, Tensor)
    magnitude = motion.abs() + float(max(motion.shape[-2:]))
    # The magnitudes of the weights' derivatives add up to at most 3 along one axis, and those of the weights to 1.4
    # along the other.
    terms = 3 * 1.4 * previous.abs().amax((2, 3), keepdim=True).sum(1, keepdim=True) if previous.numel() else 0.0
    return Rounding({"motion": magnitude}, gradients={"motion": torch.zeros_like(motion) + terms})


def history_rounding(inputs: Inputs, settings: dict[str, Any]) -> Rounding:
    """``q = p + motion`` is rounded as a number up to the image's size, and with it the bilinear weights."""
    motion, previous = inputs["motion"], inputs["previous"]
    assert isinstance(motion, Tensor)
    assert isinstance(previous, Tensor)
    # The derivative in the motion contains differences of neighbours, and of the accepted taps and their weights.
    here, there = inputs.get("surface"), inputs.get("previous_surface")
    assert here is None or isinstance(here, Surface)
    assert there is None or isinstance(there, Surface)
    images = [image for image in (previous, inputs.get("previous_length")) if isinstance(image, Tensor)]
    around = [torch.nn.functional.max_pool2d(image.nan_to_num().abs(), 3, 1, 1) for image in images if len(motion)]
    rules = {name: value for name, value in settings.items() if name != "alpha_min"}
    gradient = torch.zeros_like(motion)
    if around:
        largest, kept = reproject(torch.cat(around, 1), motion, here, there, **rules)
        terms = largest.sum(1, keepdim=True)
        if "color" in inputs:
            color = inputs["color"]
            assert isinstance(color, Tensor)
            # The derivative in the history length is the difference of the current color and the history.
            terms = terms * (2 + color.abs().sum(1, keepdim=True))
        gradient = gradient + 8 * (1 + terms) / torch.where(kept > 0, kept, torch.inf)
    magnitude = motion.abs() + float(max(motion.shape[-2:]))
    return Rounding({"motion": magnitude}, gradients={"motion": gradient})
