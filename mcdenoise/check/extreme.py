"""Stiff and extreme inputs of each op: what broken shaders, half-float files and careless settings hand over.

All of them are valid: an op has to give what its equation says, to rounding, or the infinity that it says.
Where a case has ``differentiable`` inputs its numbers are scaled so that a difference quotient still means something.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Generator, Tensor

from mcdenoise.check.case import Case, Inputs, Rounding, map_tensors, normal, radiance, uniform
from mcdenoise.ops._window import Border, inside, offsets, pad, shifted, unpad
from mcdenoise.ops.bilateral import cross_bilateral_weights
from mcdenoise.ops.fireflies import clamp_fireflies
from mcdenoise.ops.temporal import Surface, reproject

Draw = Callable[..., Tensor]

# Black, far below and far above what half precision holds, its largest number, a firefly, and denormal.
RADIANCES = (0.0, 1e-30, 65504.0, 1e6, 1e30, 1e-40)


def _constant(value: float) -> Draw:
    def draw(g: Generator, *shape: int) -> Tensor:
        return torch.full(shape, value, dtype=torch.float64)

    return draw


def _alternating(size: float) -> Draw:
    """A checkerboard of both signs, so that a sum over neighbours cancels."""

    def draw(g: Generator, *shape: int) -> Tensor:
        signs = 1 - 2 * (torch.arange(shape[-2])[:, None] + torch.arange(shape[-1])) % 2
        return size * signs * (1 + 0.1 * uniform(g, *shape))

    return draw


def _forty_decades(g: Generator, *shape: int) -> Tensor:
    return 10 ** uniform(g, *shape, low=-30, high=10)


# Each image that an op may meet, by what is special about it.
IMAGES: dict[str, Draw] = {
    **{f"constant {value:g}": _constant(value) for value in RADIANCES},
    "six decades": radiance,
    "forty decades": _forty_decades,
    "alternating signs": _alternating(1e4),
    "alternating signs at the end of half precision": _alternating(6e4),
}
# Sizes that borders, windows and strides trip over.
SIZES: dict[str, tuple[int, int, int, int]] = {
    "one pixel": (1, 1, 1, 1),
    "one row of 9": (1, 3, 1, 9),
    "one column of 9": (1, 3, 9, 1),
    "64 channels": (1, 64, 2, 3),
    "no image": (0, 3, 3, 4),
}


def _tried() -> list[tuple[str, tuple[int, int, int, int], Draw]]:
    """Every image at one size, and every size with one image."""
    images = [(name, (1, 3, 3, 5), draw) for name, draw in IMAGES.items()]
    return images + [(f"{name}, six decades", size, radiance) for name, size in SIZES.items()]


def filters() -> tuple[Case, ...]:
    """Of ``kernel_conv`` and ``kernel_splat``."""

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
        # A mean does not care for the scale of its weights. Its gradient has their square.
        *(case(f"weights of {scale:g}", size, radiance, "renormalize", scaled(scale)) for scale in (1e-15, 1e15)),
        case("one weight infinite", size, radiance, "replicate", one_infinite),
        case("7x7 on 1x2", (1, 3, 1, 2), radiance, "renormalize", kernel_size=7),
        case("weights that cancel", size, radiance, "replicate", _alternating(1e4)),
    )


def filter_rounding(inputs: Inputs, settings: dict[str, Any]) -> Rounding:
    """``sum(k x) / sum(k)`` grows with a weight by the pixel and shrinks by the mean, each over ``sum(k)``."""
    if settings["border"] != "renormalize":
        return Rounding()
    image, kernel = inputs["image"], inputs["kernel"]
    assert isinstance(image, Tensor)
    assert isinstance(kernel, Tensor)
    size = round(kernel.shape[1] ** 0.5)
    kernel = torch.where(inside(kernel.shape[-2], kernel.shape[-1], size, kernel.device), kernel, 0)
    total = kernel.sum(1, keepdim=True).abs()
    # Over the pixels that a window reaches, which is more than the mean of their absolute values.
    brightest = torch.nn.functional.max_pool2d(image.abs().sum(1, keepdim=True), size, 1, size // 2)
    share = torch.where(total > 0, kernel.abs().sum(1, keepdim=True) / total**2, 0)
    return Rounding(gradients={"kernel": (brightest * share).expand_as(kernel)})


def bilateral() -> tuple[Case, ...]:
    """Of ``cross_bilateral_weights``."""

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
                "scales": [scale * uniform(g, batch, 1, height, width, low=0.5)],
                "distance_scale": uniform(g, batch, 1, height, width),
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
        """Depths without limit: the sky at 1e10 beside what stands at 0."""
        return torch.where(uniform(g, *shape) < 0.5, 1e10, uniform(g, *shape))

    def normals(length: float) -> Draw:
        """Some of them zero, the others of that length."""

        def draw(g: Generator, *shape: int) -> Tensor:
            direction = torch.nn.functional.normalize(normal(g, *shape))
            return length * direction * (uniform(g, shape[0], 1, *shape[2:]) < 0.7)

        return draw

    everything = ("kernel", "guides", "scales", "distance_scale")
    small, flat = spread(1e-4), _constant(0.5)
    return (
        case("f of 1e6, guides 1e-4 apart", small, 1e6, differentiable=everything),
        case("f of 1e8, guides 1e-4 apart", small, 1e8, differentiable=("kernel", "distance_scale")),
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
    """The exponent is a sum of large terms: its rounding is that of a logit of the sum of their sizes.

    ``exponent[t] = logit[t] - sum_g f_g d_g[t]^2 - f_d |o_t|^2`` is known to eps times ``|logit| + sum_g f_g d_g^2 +
    f_d |o_t|^2``, however small the inputs and the result are. Of a weight, ``w exp(exponent)``, it is the same share.
    """
    kernel, guides, scales, distance = (inputs[name] for name in ("kernel", "guides", "scales", "distance_scale"))
    assert isinstance(kernel, Tensor)
    assert isinstance(guides, list)
    assert isinstance(scales, list)
    size = round(kernel.shape[1] ** 0.5)
    height, width = kernel.shape[-2:]
    terms = torch.zeros_like(kernel)
    for guide, scale in zip(guides, scales, strict=True):
        padded = pad(guide, size // 2, settings["border"])
        for tap, dy, dx in offsets(size):
            difference = shifted(padded, size // 2, dy, dx, height, width) - guide
            terms[:, tap : tap + 1] += scale.abs() * difference.square().sum(1, keepdim=True)
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
    """Of ``cross_bilateral_filter``: those of the weights, with an image."""

    def with_image(case: Case) -> Case:
        def tensors(g: Generator) -> Inputs:
            inputs = case.tensors(g)
            kernel = inputs["kernel"]
            assert isinstance(kernel, Tensor)
            if case.settings["normalize"] == "none":
                # Weights of both signs may have the sum zero.
                inputs["kernel"] = kernel.abs()
            return {"image": radiance(g, kernel.shape[0], 3, *kernel.shape[2:]), **inputs}

        return replace(case, tensors=tensors, differentiable=())

    # A mean with an infinite weight is none.
    return tuple(with_image(case) for case in bilateral() if case.name != "one weight infinite")


def bilateral_filter_rounding(inputs: Inputs, settings: dict[str, Any]) -> Rounding:
    """What is rounded in the weights, and differences of terms of the size of a weight times the image.

    So it is where the weights are normalised, by a softmax or by the sum of those inside the image.
    """
    weights = bilateral_rounding(inputs, settings)
    image, kernel = inputs["image"], inputs["kernel"]
    assert isinstance(image, Tensor)
    assert isinstance(kernel, Tensor)
    if not len(image) or (settings["normalize"] == "none" and settings["border"] != "renormalize"):
        return weights
    if settings["normalize"] == "none":
        unsigned = {name: value for name, value in inputs.items() if name != "image"} | {"kernel": kernel.abs()}
        shares = cross_bilateral_weights(**unsigned, **settings)  # type: ignore[arg-type]
        shares = shares / shares.sum(1, keepdim=True).clamp_min(torch.finfo(shares.dtype).tiny)
        gradients = _softmax_gradients(inputs, 2 * shares.nan_to_num(), "renormalize")
        gradients["kernel"] = 2 * shares.nan_to_num() / kernel.abs()
        weights = replace(weights, gradients=gradients)
    brightest = image.abs().sum(1, keepdim=True).amax((2, 3), keepdim=True)
    return Rounding(weights.arguments, gradients=map_tensors(lambda size: brightest * size, weights.gradients))


def _softmax_gradients(inputs: Inputs, exponent: Tensor, border: Border) -> Inputs:
    """``w (v - sum(w v))`` is a difference of terms of the size of ``w``, and so is all that follows."""
    guides, scales, distance = inputs["guides"], inputs["scales"], inputs["distance_scale"]
    assert isinstance(guides, list)
    assert isinstance(scales, list)
    size = round(exponent.shape[1] ** 0.5)
    height, width = exponent.shape[-2:]
    of_guides, of_scales = [], []
    for guide, scale in zip(guides, scales, strict=True):
        padded = pad(guide, size // 2, border)
        far, near, own = torch.zeros_like(padded), torch.zeros_like(guide), torch.zeros_like(scale)
        for tap, dy, dx in offsets(size):
            difference = (shifted(padded, size // 2, dy, dx, height, width) - guide).abs()
            pull = 2 * scale.abs() * difference * exponent[:, tap : tap + 1]
            shifted(far, size // 2, dy, dx, height, width).add_(pull)
            near += pull
            own += difference.square().sum(1, keepdim=True) * exponent[:, tap : tap + 1]
        of_guides.append(near + unpad(far, size // 2, border))
        of_scales.append(own)
    gradients: Inputs = {"kernel": exponent, "guides": of_guides, "scales": of_scales}
    if isinstance(distance, Tensor):
        squares = torch.tensor([dy * dy + dx * dx for _, dy, dx in offsets(size)], dtype=exponent.dtype)
        gradients["distance_scale"] = (exponent * squares[:, None, None]).sum(1, keepdim=True)
    return gradients


def images(halved: bool) -> tuple[Case, ...]:
    """Of ``downsample``, and of ``upsample`` to the double size."""

    def case(name: str, size: tuple[int, int, int, int], draw: Draw) -> Case:
        settings = {"size": (2 * size[2] - 1, 2 * size[3])} if halved else {}
        return Case(name, "extreme", lambda g: {"image": draw(g, *size)}, (), settings)

    return tuple(case(*tried) for tried in _tried())


def fusions() -> tuple[Case, ...]:
    """Of ``laplacian_fusion``."""

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


def demodulations(image: str) -> tuple[Case, ...]:
    """Of ``demodulate`` and ``remodulate``."""

    def case(name: str, size: tuple[int, int, int, int], draw: Draw, albedo: Draw = uniform) -> Case:
        return Case(name, "extreme", lambda g: {image: draw(g, *size), "albedo": albedo(g, *size)}, ())

    def barely(g: Generator, *shape: int) -> Tensor:
        """Albedos to both sides of the one below which there is no texture, as half precision has them."""
        return 1e-4 * (1 + 2.0 ** -uniform(g, *shape, low=6, high=12) * torch.sign(normal(g, *shape)))

    return (
        *(case(*tried) for tried in _tried()),
        *(case(f"albedo {value:g}", (1, 3, 2, 3), radiance, _constant(value)) for value in (0.0, 1e-8, 1e-4, 5.0, 1e4)),
        case("albedo about 1e-4", (1, 3, 5, 7), radiance, barely),
    )


def fireflies() -> tuple[Case, ...]:
    """Of ``clamp_fireflies``."""

    def case(name: str, size: tuple[int, int, int, int], draw: Draw, **settings: float) -> Case:
        return Case(name, "extreme", lambda g: {"image": draw(g, *size)}, (), settings)

    return (
        *(case(f"{name}, limit 2", size, draw, limit=2.0) for name, size, draw in _tried() if "signs" not in name),
        case("limit 1e-6", (1, 3, 3, 4), radiance, limit=1e-6),
        case("limit 1e30", (1, 3, 3, 4), radiance, limit=1e30),
        case("window of 99", (1, 3, 3, 4), radiance, kernel_size=99),
    )


def firefly_rounding(inputs: Inputs, settings: dict[str, Any]) -> Rounding:
    """``x limit n / y`` does not grow with a bright ``x``: it grows by ``limit n / y`` and shrinks by as much."""
    image = inputs["image"]
    assert isinstance(image, Tensor)
    before, after = image.sum(1, keepdim=True), clamp_fireflies(image, **settings).sum(1, keepdim=True)
    factor = torch.where(before > 0, after / torch.where(before > 0, before, 1), 1)
    return Rounding(gradients={"image": (2 * image.shape[1] * factor).expand_as(image)})


def lags() -> tuple[Case, ...]:
    """Of ``history_lag``."""

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
    """Of ``atrous``."""

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
    """A weight below the smallest number of float32 is 0, however large the number it would have been multiplied with.

    Of these there are 25 a pixel. A derivative multiplies them with the range of the images, and with that of the
    exponent in the argument, which is at most 1e4 where it counts.
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


def importances() -> tuple[Case, ...]:
    """Of ``importance_filter``."""

    def case(
        name: str, size: tuple[int, int, int, int], image: Draw, worth: Draw = normal, kernel_size: int = 3
    ) -> Case:
        def tensors(g: Generator) -> Inputs:
            return {"image": image(g, *size), "importance": worth(g, size[0], 1, *size[2:])}

        return Case(name, "extreme", tensors, (), {"kernel_size": kernel_size})

    def ten_thousands(g: Generator, *shape: int) -> Tensor:
        return uniform(g, *shape, low=-1e4, high=1e4)

    def cliff(g: Generator, *shape: int) -> Tensor:
        """Windows on both sides of it see nothing but the lowest and nothing but the highest."""
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
    """A weight below the smallest number of float32 is 0, and derivatives of weights near 1 are small differences.

    Two windows of weights ``a`` and ``b`` and means ``x`` and ``y`` are joined to ``a x / s + b y / s``, ``s = a + b``,
    whose derivative in ``a`` is ``x / s - a x / s^2 - b y / s^2``. These terms may cancel. As ``s`` is at least 1, they
    are together at most three times the largest pixel, in every channel, in each joining of two windows, for each of
    the windows that a pixel is in.
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
    """Of ``luminance_moments``."""
    return tuple(
        Case(name, "extreme", lambda g, draw=draw, size=size: {"light": draw(g, size[0], 3, *size[2:])}, ())  # type: ignore[misc]
        for name, size, draw in _tried()
    )


def moments() -> tuple[Case, ...]:
    """Of ``moments_variance``."""

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


def motions() -> tuple[Case, ...]:
    """Of ``motion_from_position``."""

    def case(name: str, position: Draw, w: float = 1.0, size: tuple[int, int, int, int] = (1, 3, 3, 4)) -> Case:
        """Seen from a camera at the origin that looks along z; ``w`` scales its last column."""

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
        # Of points beside the plane of the eye the motion is a very large number.
        case("w of 1e-15", before(1.0), 1e-15),
        case("w of 1e15", before(1.0), 1e15),
        case("one row of 9", before(3.0), size=(1, 3, 1, 9)),
        case("no image", before(3.0), size=(0, 3, 3, 4)),
    )


def motion_rounding(inputs: Inputs, settings: dict[str, Any]) -> Rounding:
    """A motion is a difference of two places in the image, which are rounded as numbers up to its size."""
    position = inputs["position"]
    assert isinstance(position, Tensor)
    return Rounding(result=float(max(position.shape[-2:])))


def histories(accumulating: bool) -> tuple[Case, ...]:
    """Of ``reproject`` and ``accumulate``."""

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


def history_rounding(inputs: Inputs, settings: dict[str, Any]) -> Rounding:
    """``q = p + motion`` is rounded as a number up to the image's size, and with it the bilinear weights."""
    motion, previous = inputs["motion"], inputs["previous"]
    assert isinstance(motion, Tensor)
    assert isinstance(previous, Tensor)
    # The derivative in the motion is a difference of neighbours, and one of the kept taps and of their weights.
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
            # A longer history trades the present for the past.
            terms = terms * (2 + color.abs().sum(1, keepdim=True))
        gradient = gradient + 8 * (1 + terms) / torch.where(kept > 0, kept, torch.inf)
    magnitude = motion.abs() + float(max(motion.shape[-2:]))
    return Rounding({"motion": magnitude}, gradients={"motion": gradient})
