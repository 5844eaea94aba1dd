"""The table of ops with their test cases, for gradient checks, stability checks, benchmarks and tests.

To add an op, add an ``Op`` to ``OPS``. Sizes are tiny, because gradients are checked one element at a time, and odd,
because errors at borders show there.

Inputs avoid points without a derivative, where finite differences are meaningless: albedo near ``floor``, motion of
whole pixels, brightness near the limit of fireflies, the history length at which ``alpha`` reaches ``alpha_min``,
surfaces near the limits of the consistency test, kernel sums near zero. Cases that contain such points on purpose do
not list the inputs concerned as ``differentiable``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Generator, Tensor

from mcdenoise.check import extreme, reference
from mcdenoise.check.case import Case, Inputs, Kind, Op, map_tensors
from mcdenoise.check.case import normal as _normal
from mcdenoise.check.case import radiance as _radiance
from mcdenoise.check.case import uniform as _uniform
from mcdenoise.ops._grid import cells_of
from mcdenoise.ops.affinity import AffinityFilter, affinity_filter
from mcdenoise.ops.atrous import Atrous, atrous
from mcdenoise.ops.bilateral import CrossBilateralWeights, cross_bilateral_weights
from mcdenoise.ops.bilateral_filter import CrossBilateralFilter, cross_bilateral_filter
from mcdenoise.ops.bilateral_grid import GridSlice, GridSplat, grid_slice, grid_splat
from mcdenoise.ops.demodulation import Demodulate, Remodulate, demodulate, remodulate
from mcdenoise.ops.fireflies import ClampFireflies, clamp_fireflies
from mcdenoise.ops.fusion import LaplacianFusion, downsample, laplacian_fusion, upsample
from mcdenoise.ops.gradients import TemporalGradient, temporal_gradient
from mcdenoise.ops.importance import ImportanceFilter, importance_filter
from mcdenoise.ops.kernel_conv import KernelConv, KernelSplat, kernel_conv, kernel_splat
from mcdenoise.ops.lag import HistoryLag, history_lag
from mcdenoise.ops.moments import MomentsVariance, luminance_moments, moments_variance
from mcdenoise.ops.partition import learned_upsample, pyramid_partition
from mcdenoise.ops.regression import BlockRegression, block_regression
from mcdenoise.ops.resampling import resample
from mcdenoise.ops.softmax_splat import softmax_splat
from mcdenoise.ops.temporal import Accumulate, Surface, accumulate, motion_from_position, reproject

__all__ = ["OPS", "Case", "Inputs", "Kind", "Op", "map_tensors"]


def _filter_cases() -> tuple[Case, ...]:
    both = ("image", "kernel")

    def case(
        name: str,
        kind: Kind,
        size: tuple[int, int, int, int],
        kernel_size: int,
        border: str,
        image: Callable[..., Tensor] = _normal,
        weights: Callable[[Tensor], Tensor] = lambda kernel: kernel + 0.5,
        differentiable: tuple[str, ...] = both,
    ) -> Case:
        def tensors(g: Generator) -> Inputs:
            kernel = _uniform(g, size[0], kernel_size**2, *size[2:])
            return {"image": image(g, *size), "kernel": weights(kernel)}

        return Case(name, kind, tensors, differentiable, {"border": border})

    def softmax(kernel: Tensor) -> Tensor:
        return torch.softmax(50 * (2 * kernel - 1), 1)

    def one_pixel_without_weights(kernel: Tensor) -> Tensor:
        kernel[..., 0, 0] = 0
        return kernel

    return (
        case("replicate", "ordinary", (1, 1, 5, 7), 3, "replicate", weights=lambda kernel: 2 * kernel - 1),
        case("zeros, batch of 2, RGB", "ordinary", (2, 3, 2, 3), 3, "zeros", weights=lambda kernel: 2 * kernel - 1),
        case("renormalize, 5 channels", "ordinary", (1, 5, 3, 3), 3, "renormalize"),
        case("replicate, smaller than the kernel", "ordinary", (1, 3, 2, 3), 5, "replicate"),
        case("renormalize, smaller than the kernel", "ordinary", (1, 1, 3, 2), 5, "renormalize"),
        case("zeros, one row", "ordinary", (1, 1, 1, 6), 5, "zeros"),
        case("replicate, one pixel", "ordinary", (1, 3, 1, 1), 3, "replicate"),
        case("kernel of one tap", "ordinary", (1, 3, 3, 2), 1, "renormalize"),
        case("fireflies, peaked weights", "stiff", (1, 3, 2, 3), 3, "replicate", _radiance, softmax),
        case(
            "fireflies, weights of sum 90",
            "extreme",
            (1, 3, 2, 3),
            3,
            "renormalize",
            _radiance,
            lambda kernel: 10 * (kernel + 0.5),
        ),
        # The sum of the weights jumps at zero, so there is no derivative in the kernel.
        case(
            "a pixel without weights",
            "extreme",
            (1, 3, 2, 3),
            3,
            "renormalize",
            weights=one_pixel_without_weights,
            differentiable=("image",),
        ),
    )


def _splat_cases() -> tuple[Case, ...]:
    def case(
        name: str,
        kind: Kind,
        size: tuple[int, int, int, int],
        kernel_size: int,
        image: Callable[..., Tensor] = _normal,
        spread: float = 1.0,
    ) -> Case:
        def tensors(g: Generator) -> Inputs:
            return {"image": image(g, *size), "logits": spread * _normal(g, size[0], kernel_size**2, *size[2:])}

        return Case(name, kind, tensors, ("image", "logits"))

    return (
        case("5x7", "ordinary", (1, 1, 5, 7), 3),
        case("batch of 2, RGB", "ordinary", (2, 3, 2, 3), 3),
        case("smaller than the kernel", "ordinary", (1, 3, 2, 3), 5),
        case("one row", "ordinary", (1, 1, 1, 6), 5),
        case("one pixel", "ordinary", (1, 3, 1, 1), 3),
        case("kernel of one tap", "ordinary", (1, 3, 3, 2), 1),
        case("fireflies, peaked weights", "stiff", (1, 3, 2, 3), 3, _radiance, 8.0),
    )


def _bilateral_cases() -> tuple[Case, ...]:
    def case(
        name: str,
        kind: Kind,
        size: tuple[int, int, int],
        kernel_size: int,
        normalize: str,
        border: str = "replicate",
        *,
        channels: tuple[int, ...] = (3, 1),
        distance: bool = True,
        contrast: float = 1.0,
        largest_falloff: float = 3.0,
        logit: float = 2.0,
    ) -> Case:
        batch, height, width = size

        def falloff(g: Generator) -> Tensor:
            return largest_falloff * _uniform(g, batch, 1, height, width)

        def tensors(g: Generator) -> Inputs:
            kernel = logit * _uniform(g, batch, kernel_size**2, height, width, low=-1)
            return {
                "kernel": kernel,
                "guides": [contrast * _uniform(g, batch, c, height, width) for c in channels],
                "falloffs": [falloff(g) for _ in channels],
                "distance_falloff": 0.5 * _uniform(g, batch, 1, height, width) if distance else None,
            }

        differentiable = ("kernel", *(("guides", "falloffs") if channels else ()))
        differentiable += ("distance_falloff",) if distance else ()
        return Case(name, kind, tensors, differentiable, {"normalize": normalize, "border": border})

    return (
        case("softmax", "ordinary", (1, 3, 3), 3, "softmax", channels=(1,)),
        case("the paper's Eq. 5", "ordinary", (1, 2, 3), 3, "none"),
        case("softmax, zeros, batch of 2", "ordinary", (2, 2, 3), 3, "softmax", "zeros", channels=(3,), distance=False),
        case("softmax, renormalize", "ordinary", (1, 3, 3), 3, "softmax", "renormalize", channels=(1, 1)),
        case("Eq. 5, zeros", "ordinary", (1, 2, 3), 3, "none", "zeros", channels=(5,)),
        case("Eq. 5, renormalize, one row", "ordinary", (1, 1, 5), 3, "none", "renormalize", channels=(3,)),
        case("no guides, 5x7", "ordinary", (1, 5, 7), 3, "softmax", channels=(), distance=False),
        case("distance only", "ordinary", (1, 3, 2), 3, "softmax", channels=()),
        case("smaller than the kernel", "ordinary", (1, 2, 1), 5, "softmax", "renormalize", channels=(1,)),
        case("one pixel", "ordinary", (1, 1, 1), 3, "softmax"),
        case("falloffs up to 1e3", "stiff", (1, 2, 3), 3, "softmax", contrast=0.1, largest_falloff=1e3),
        case(
            "Eq. 5, falloffs up to 1e3", "stiff", (1, 2, 3), 3, "none", contrast=0.1, largest_falloff=1e3, channels=(1,)
        ),
        case("zero falloffs", "ordinary", (1, 2, 3), 3, "softmax", largest_falloff=0.0),
        case("logits of 50", "extreme", (1, 2, 3), 3, "softmax", logit=50.0, channels=(1,)),
        case("all but the centre vanish", "extreme", (1, 2, 3), 3, "softmax", "zeros", largest_falloff=6e4),
    )


def _bilateral_filter_cases() -> tuple[Case, ...]:
    """The cases of the weights, with an image to filter."""

    def with_image(case: Case) -> Case:
        def tensors(g: Generator) -> Inputs:
            inputs = case.tensors(g)
            kernel = inputs["kernel"]
            assert isinstance(kernel, Tensor)
            if case.settings["normalize"] == "none":
                # Weights of both signs may sum to zero.
                inputs["kernel"] = kernel = kernel.abs() + 0.1
            batch, _, height, width = kernel.shape
            return {"image": _normal(g, batch, 2, height, width), **inputs}

        return replace(case, tensors=tensors, differentiable=("image", *case.differentiable))

    return tuple(map(with_image, _bilateral_cases()))


def _image_cases(sizes: Callable[[int, int], tuple[int, int]], with_size: bool) -> tuple[Case, ...]:
    """Cases of ops of one image, whose size is ``sizes`` of the size in the case's name."""

    def case(
        kind: Kind, batch: int, channels: int, height: int, width: int, draw: Callable[..., Tensor] = _normal
    ) -> Case:
        name = f"{height}x{width}, batch of {batch}, {channels} channels" + (", fireflies" if draw is _radiance else "")
        return Case(
            name,
            kind,
            lambda g: {"image": draw(g, batch, channels, *sizes(height, width))},
            ("image",),
            {"size": (height, width)} if with_size else {},
        )

    return (
        case("ordinary", 1, 1, 5, 7),
        case("ordinary", 2, 3, 4, 6),
        case("ordinary", 1, 5, 1, 5),
        case("ordinary", 1, 3, 1, 1),
        case("extreme", 1, 3, 3, 4, _radiance),
    )


def _half(height: int, width: int) -> tuple[int, int]:
    return (height + 1) // 2, (width + 1) // 2


def _partition_cases() -> tuple[Case, ...]:
    def case(
        name: str,
        kind: Kind,
        size: tuple[int, int, int, int],
        levels: int,
        draw: Callable[..., Tensor] = _normal,
        logit: float = 2.0,
    ) -> Case:
        def tensors(g: Generator) -> Inputs:
            batch, _, height, width = size
            return {"image": draw(g, *size), "logits": logit * _normal(g, batch, levels, height, width)}

        return Case(name, kind, tensors, ("image", "logits"))

    return (
        case("RGB, 5x6, 3 levels", "ordinary", (1, 3, 5, 6), 3),
        case("batch of 2, RGB, 2 levels", "ordinary", (2, 3, 2, 4), 2),
        case("one row, 5 channels, 4 levels", "ordinary", (1, 5, 1, 5), 4),
        case("one pixel, 5 levels", "ordinary", (1, 3, 1, 1), 5),
        case("one level", "ordinary", (1, 1, 2, 3), 1),
        case("fireflies, peaked weights", "stiff", (1, 3, 3, 2), 3, _radiance, 10.0),
    )


def _learned_cases() -> tuple[Case, ...]:
    def case(
        name: str,
        kind: Kind,
        size: tuple[int, int, int, int],
        side: int,
        border: str,
        draw: Callable[..., Tensor] = _normal,
        spread: float = 1.0,
    ) -> Case:
        batch, channels, height, width = size

        def tensors(g: Generator) -> Inputs:
            coarse = _half(height, width)
            kernel = 4 * torch.softmax(spread * _normal(g, batch, side**2, *coarse), 1)
            return {"image": draw(g, batch, channels, *coarse), "kernel": kernel}

        settings = {"size": (height, width), "border": border}
        return Case(f"{name}, {border}", kind, tensors, ("image", "kernel"), settings)

    return (
        case("RGB, 5x4", "ordinary", (1, 3, 5, 4), 4, "replicate"),
        case("batch of 2, RGB", "ordinary", (2, 3, 4, 2), 4, "zeros"),
        case("2x2 taps, 5 channels", "ordinary", (1, 5, 3, 2), 2, "zeros"),
        case("6x6 taps, one row", "ordinary", (1, 1, 1, 4), 6, "replicate"),
        case("one pixel", "ordinary", (1, 3, 1, 1), 4, "replicate"),
        case("fireflies, peaked weights", "stiff", (1, 3, 3, 4), 4, "replicate", _radiance, 10.0),
    )


def _fusion_cases() -> tuple[Case, ...]:
    def case(
        name: str, kind: Kind, size: tuple[int, int, int, int], alphas: int, draw: Callable[..., Tensor] = _normal
    ) -> Case:
        batch, channels, height, width = size

        def tensors(g: Generator) -> Inputs:
            return {
                "fine": draw(g, *size),
                "coarse": draw(g, batch, channels, *_half(height, width)),
                "alpha": _uniform(g, batch, alphas, height, width),
            }

        return Case(name, kind, tensors, ("fine", "coarse", "alpha"))

    return (
        case("5x7", "ordinary", (1, 1, 5, 7), 1),
        case("batch of 2, RGB", "ordinary", (2, 3, 2, 4), 1),
        case("an alpha for each channel", "ordinary", (1, 3, 3, 2), 3),
        case("one row, 5 channels", "ordinary", (1, 5, 1, 5), 1),
        case("one pixel", "ordinary", (1, 3, 1, 1), 1),
        case("fireflies", "extreme", (1, 3, 3, 3), 1, _radiance),
    )


def _demodulation_cases(image: str) -> tuple[Case, ...]:
    def case(
        name: str,
        kind: Kind,
        size: tuple[int, int, int, int],
        albedo: Callable[[Tensor], Tensor] = lambda values: values,
        draw: Callable[..., Tensor] = _uniform,
        **settings: float,
    ) -> Case:
        def tensors(g: Generator) -> Inputs:
            return {image: draw(g, *size), "albedo": albedo(_uniform(g, *size, low=0.05))}

        return Case(name, kind, tensors, (image, "albedo"), settings)

    def half_zero(values: Tensor) -> Tensor:
        values[..., ::2] = 0
        return values

    def one_channel_zero(values: Tensor) -> Tensor:
        values[:, 0] = 0
        return values

    def near_floor(values: Tensor) -> Tensor:
        # Stay 5e-4 away from the kink at the floor, on both sides.
        values[:, :2] = torch.where(values[:, :2] < 0.5, 0.0095, 0.0105)
        return values

    return (
        case("5x7", "ordinary", (1, 1, 5, 7)),
        case("batch of 2, RGB", "ordinary", (2, 3, 3, 2)),
        case("one row, 5 channels", "ordinary", (1, 5, 1, 3)),
        case("one pixel, floor 0.5", "ordinary", (1, 3, 1, 1), floor=0.5),
        case("no albedo in every other column", "ordinary", (1, 3, 2, 5), half_zero),
        case("no red in the albedo", "ordinary", (1, 3, 3, 3), one_channel_zero),
        case("albedo of 3", "extreme", (1, 3, 2, 3), lambda values: 3 * values),
        case("fireflies", "stiff", (1, 3, 3, 3), draw=_radiance),
        case("fireflies, albedo near the floor", "extreme", (1, 3, 3, 3), near_floor, _radiance),
    )


def _firefly_cases() -> tuple[Case, ...]:
    def case(
        name: str,
        kind: Kind,
        size: tuple[int, int, int, int],
        *fireflies: tuple[int, int],
        draw: Callable[..., Tensor] = _uniform,
        value: float = 1e4,
        differentiable: bool = True,
        **settings: float,
    ) -> Case:
        def tensors(g: Generator) -> Inputs:
            image = draw(g, *size)
            for row, column in fireflies:
                image[..., row, column] = value
            return {"image": image}

        return Case(name, kind, tensors, ("image",) if differentiable else (), settings)

    def constant(g: Generator, *shape: int) -> Tensor:
        return torch.full(shape, 0.3, dtype=torch.float64)

    def black(g: Generator, *shape: int) -> Tensor:
        return torch.zeros(shape, dtype=torch.float64)

    def dark(g: Generator, *shape: int) -> Tensor:
        return torch.full(shape, 1e-4, dtype=torch.float64)

    def sparse(g: Generator, *shape: int) -> Tensor:
        image = torch.zeros(shape, dtype=torch.float64)
        image[..., ::2, ::3] = _uniform(g, *image[..., ::2, ::3].shape)
        image[..., 0, 0] *= 9
        return image

    def half_precision_range(g: Generator, *shape: int) -> Tensor:
        """Pixels so bright that a sum of three channels overflows, beside the smallest normal number."""
        image = _uniform(g, *shape, low=5e4, high=6.5e4)
        image[..., ::2] = torch.finfo(torch.float16).tiny
        return image

    # Small windows have low limits, so that they clamp some pixels too.
    return (
        case("5x7, one firefly", "ordinary", (1, 1, 5, 7), (2, 3)),
        case("batch of 2, RGB, window of 3", "ordinary", (2, 3, 3, 4), limit=1.5, kernel_size=3),
        case("window of 5", "ordinary", (1, 3, 4, 3), limit=1.5, kernel_size=5),
        case("one row, 5 channels", "ordinary", (1, 5, 1, 6), limit=1.2),
        case("one column", "ordinary", (1, 3, 5, 1), limit=1.2, kernel_size=3),
        case("smaller than the window", "ordinary", (1, 3, 2, 3), limit=1.2),
        case("one pixel", "ordinary", (1, 3, 1, 1)),
        case("64 channels", "ordinary", (1, 64, 1, 2), limit=0.8),
        case("constant", "ordinary", (1, 3, 3, 4), draw=constant),
        case("firefly in the corner", "stiff", (1, 3, 4, 5), (0, 0)),
        case("firefly at the border", "stiff", (1, 3, 4, 5), (3, 2)),
        case("fireflies side by side", "stiff", (1, 3, 4, 5), (1, 1), (1, 2), (2, 1), limit=2.0),
        case("fireflies of 100", "stiff", (1, 3, 3, 4), draw=_radiance, limit=2.0),
        # Black neighbours are excluded from the mean; this jumps at zero, so there is no derivative.
        case("black", "extreme", (1, 3, 3, 3), draw=black, differentiable=False),
        case("one bright pixel on black", "extreme", (1, 3, 3, 4), (1, 1), draw=black, differentiable=False),
        case("one pixel in five lit", "extreme", (1, 3, 3, 5), draw=sparse, limit=1.5, differentiable=False),
        # Finite differences are meaningless beside 1e30.
        case("1e30 beside 1e-4", "extreme", (1, 3, 3, 5), (1, 4), draw=dark, value=1e30, differentiable=False),
        case("range of half precision", "extreme", (1, 3, 3, 5), draw=half_precision_range, limit=1.1),
    )


def _lag_cases() -> tuple[Case, ...]:
    def case(
        name: str,
        kind: Kind,
        size: tuple[int, int, int, int],
        change: float,
        noise: float = 0.5,
        differentiable: tuple[str, ...] = ("history", "recent", "variance"),
        **settings: float,
    ) -> Case:
        def tensors(g: Generator) -> Inputs:
            history = _uniform(g, *size, low=0.8)
            recent = change * (1 + noise * _uniform(g, *size, low=-1)) * history
            variance = noise**2 * _uniform(g, size[0], 1, *size[2:], low=0.2)
            return {"history": history, "recent": recent, "variance": variance}

        return Case(name, kind, tensors, differentiable, settings)

    # Settings for which differences are 1 to 2 times the threshold, so that the result is neither 0 nor 1.
    return (
        case("5x7", "ordinary", (1, 1, 5, 7), 2.0, threshold=10.0),
        case("batch of 2, RGB, window of 3", "ordinary", (2, 3, 3, 4), 2.0, threshold=3.0, kernel_size=3),
        case("window of 5", "ordinary", (1, 3, 4, 3), 2.0, threshold=6.5, kernel_size=5),
        case("one row, 5 channels", "ordinary", (1, 5, 1, 6), 2.0, threshold=3.0, kernel_size=3),
        case("no change", "ordinary", (1, 3, 4, 5), 1.0),
        case("darker by half", "ordinary", (1, 3, 4, 5), 0.5, threshold=4.0),
        # Without noise only the smallest visible difference counts; its square is smaller than the step of finite
        # differences in the variance.
        case("no noise", "stiff", (1, 1, 1, 1), 1.0045, 0.0, ("history", "recent"), threshold=3.0),
    )


def _wall(g: Generator, batch: int, height: int, width: int) -> Inputs:
    """Normals and depths of a rough surface, for which the weights of taps are neither 0 nor 1."""
    toward = torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64).reshape(1, 3, 1, 1)
    normal = toward + 0.05 * _normal(g, batch, 3, height, width)
    depth = _uniform(g, batch, 1, height, width, low=4, high=5)
    return {"normal": normal / normal.norm(dim=1, keepdim=True), "depth": depth}


def _bright(g: Generator, *shape: int) -> Tensor:
    return 100 * _uniform(g, *shape)


def _dim(g: Generator, *shape: int) -> Tensor:
    return _radiance(g, *shape) / 100


def _importance_cases() -> tuple[Case, ...]:
    both = ("image", "importance")

    def case(
        name: str,
        kind: Kind,
        size: tuple[int, int, int, int],
        kernel_size: int,
        spread: float = 1.0,
        image: Callable[..., Tensor] = _normal,
        differentiable: tuple[str, ...] = both,
    ) -> Case:
        def tensors(g: Generator) -> Inputs:
            drawn = image(g, *size)
            return {"image": drawn, "importance": spread * _normal(g, size[0], 1, *size[2:])}

        return Case(name, kind, tensors, differentiable, {"kernel_size": kernel_size})

    return (
        case("3x3", "ordinary", (1, 1, 4, 5), 3),
        case("5x5, batch of 2, RGB", "ordinary", (2, 3, 2, 3), 5),
        case("7x7, larger than the image", "ordinary", (1, 2, 3, 2), 7),
        case("one pixel, 13x13", "ordinary", (1, 3, 1, 1), 13),
        case("map of zeros", "stiff", (1, 1, 3, 4), 3, spread=0.0),
        case("map of about 20", "stiff", (1, 2, 3, 4), 5, spread=20.0),
        # The step of finite differences is too coarse where the weights are nearly those of a maximum.
        case("fireflies", "stiff", (1, 3, 3, 4), 5, image=_radiance, differentiable=("image",)),
        case("map of about 1e4", "extreme", (1, 1, 3, 4), 3, spread=1e4, differentiable=("image",)),
    )


def _atrous_cases() -> tuple[Case, ...]:
    everything = ("light", "variance", "normal", "depth")

    def case(
        name: str,
        kind: Kind,
        size: tuple[int, int, int],
        inputs: tuple[str, ...] = everything,
        draw: Callable[..., Tensor] = _uniform,
        noise: float = 0.3,
        smooth: tuple[str, ...] | None = None,
        change: Callable[[dict[str, Any]], None] | None = None,
        **settings: float,
    ) -> Case:
        batch, height, width = size

        def tensors(g: Generator) -> Inputs:
            light = draw(g, batch, 3, height, width)
            # A standard deviation proportional to the mean, like that of a sample.
            spread = noise * _uniform(g, batch, 1, height, width, low=0.5) * light.mean(1, keepdim=True)
            drawn: dict[str, Any] = {"light": light, "variance": spread.square(), **_wall(g, *size)}
            if change is not None:
                change(drawn)
            return {argument: drawn[argument] for argument in inputs}

        return Case(name, kind, tensors, inputs if smooth is None else smooth, settings)

    def sky(drawn: dict[str, Any]) -> None:
        drawn["depth"][..., 0, :] = torch.inf
        drawn["normal"][..., 0, :] = 0

    def corner(drawn: dict[str, Any]) -> None:
        drawn["normal"][..., 2:] = torch.tensor([0.8, 0.0, 0.6], dtype=torch.float64).reshape(3, 1, 1)
        drawn["depth"][..., 2:] *= 2

    return (
        case("2x3", "ordinary", (1, 2, 3)),
        case("batch of 2", "ordinary", (2, 1, 2)),
        case("light alone", "ordinary", (1, 2, 2), ("light", "variance")),
        case("one row, normals", "ordinary", (1, 1, 3), ("light", "variance", "normal")),
        case("one pixel", "ordinary", (1, 1, 1)),
        case("taps 2 pixels apart", "ordinary", (1, 1, 4), step=2),
        case("taps beyond the image", "ordinary", (1, 1, 2), step=16),
        case("other tolerances", "ordinary", (1, 1, 3), sigma_z=3.0, sigma_n=8.0, sigma_l=1.0),
        # The step of finite differences is too coarse for deviations of 1e-4 beside deviations of 1e2.
        case("fireflies", "stiff", (1, 1, 4), draw=_dim, smooth=("normal", "depth")),
        case("little noise", "stiff", (1, 1, 3), draw=_bright, noise=0.02),
        case("an edge", "stiff", (1, 1, 4), change=corner, smooth=("light", "variance")),
        # Infinity has no finite difference.
        case("sky", "extreme", (1, 2, 2), change=sky, smooth=("light", "variance", "normal")),
        # Central differences would need a negative variance.
        case("no noise", "extreme", (1, 1, 3), noise=0.0, smooth=("light", "normal", "depth")),
    )


_BEFORE = ("previous", "previous_features", "previous_bandwidth", "previous_weight")


def _affinity_cases() -> tuple[Case, ...]:
    here = ("image", "features", "bandwidth", "center")

    def case(
        name: str,
        kind: Kind,
        size: tuple[int, int, int],
        inputs: tuple[str, ...] = here,
        draw: Callable[..., Tensor] = _normal,
        kernel_size: int = 3,
        dilation: int = 1,
        *,
        channels: tuple[int, int] = (1, 2),
        largest: float = 2.0,
        change: Callable[[Inputs], None] | None = None,
        smooth: tuple[str, ...] | None = None,
    ) -> Case:
        batch, height, width = size

        def tensors(g: Generator) -> Inputs:
            def one(low: float = 0.1, high: float = 1.0) -> Tensor:
                return _uniform(g, batch, 1, height, width, low=low, high=high)

            drawn: Inputs = {}
            for before in ("", "previous_"):
                drawn[before.rstrip("_") or "image"] = draw(g, batch, channels[0], height, width)
                drawn[f"{before}features"] = _uniform(g, batch, channels[1], height, width)
                drawn[f"{before}bandwidth"] = one(high=largest)
            drawn |= {"center": one(), "previous_weight": one()}
            if change is not None:
                change(drawn)
            return {argument: drawn[argument] for argument in inputs}

        settings = {"kernel_size": kernel_size, "dilation": dilation}
        return Case(name, kind, tensors, inputs if smooth is None else smooth, settings)

    def no_center(drawn: Inputs) -> None:
        drawn["center"] = torch.zeros_like(drawn["center"])  # type: ignore[arg-type]

    def unknown(drawn: Inputs) -> None:
        known = drawn["previous_weight"]
        assert isinstance(known, Tensor)
        known[..., 0] = 0

    return (
        case("2x3", "ordinary", (1, 2, 3)),
        case("frame before, batch of 2", "ordinary", (2, 1, 2), (*here, *_BEFORE)),
        case("5x5 taps, one row, RGB", "ordinary", (1, 1, 4), kernel_size=5, channels=(3, 1)),
        case("taps 2 pixels apart", "ordinary", (1, 2, 3), dilation=2),
        case("taps beyond the image", "ordinary", (1, 2, 2), dilation=8),
        case("one tap", "ordinary", (1, 1, 2), kernel_size=1),
        case("one pixel, frame before", "ordinary", (1, 1, 1), (*here, *_BEFORE), channels=(3, 8)),
        case("one column, taps 2 pixels apart, frame before", "ordinary", (1, 4, 1), (*here, *_BEFORE), dilation=2),
        case("fireflies", "stiff", (1, 2, 2), draw=_dim),
        case("bandwidths of up to 30", "stiff", (1, 2, 2), (*here, *_BEFORE), largest=30.0),
        # Central differences would need a negative weight, which is clamped.
        case(
            "no weight of the centre", "extreme", (1, 1, 3), change=no_center, smooth=("image", "features", "bandwidth")
        ),
        case("unknown history", "extreme", (1, 2, 2), (*here, *_BEFORE), change=unknown),
    )


def _luminance_cases() -> tuple[Case, ...]:
    def case(
        name: str, kind: Kind, batch: int, height: int, width: int, draw: Callable[..., Tensor] = _uniform
    ) -> Case:
        return Case(name, kind, lambda g: {"light": draw(g, batch, 3, height, width)}, ("light",))

    return (
        case("5x7", "ordinary", 1, 5, 7),
        case("batch of 2", "ordinary", 2, 2, 3),
        case("one row", "ordinary", 1, 1, 5),
        case("one pixel", "ordinary", 1, 1, 1),
        case("fireflies", "stiff", 1, 3, 4, _radiance),
    )


def _moments_cases() -> tuple[Case, ...]:
    everything = ("moments", "normal", "depth")

    def case(
        name: str,
        kind: Kind,
        size: tuple[int, int, int],
        kernel_size: int,
        inputs: tuple[str, ...] = everything,
        draw: Callable[..., Tensor] = _uniform,
        spread: float = 1.0,
        **settings: float,
    ) -> Case:
        batch, height, width = size

        def tensors(g: Generator) -> Inputs:
            mean = draw(g, batch, 1, height, width)
            more = spread * _uniform(g, batch, 1, height, width, low=0.5)
            drawn: Inputs = {"moments": torch.cat([mean, mean.square() * (1 + more)], 1), **_wall(g, *size)}
            return {argument: drawn[argument] for argument in inputs}

        return Case(name, kind, tensors, inputs, {"kernel_size": kernel_size, **settings})

    return (
        case("the pixel alone", "ordinary", (1, 3, 4), 1, ("moments",)),
        case("window of 3", "ordinary", (1, 2, 2), 3),
        case("window of 7, batch of 2", "ordinary", (2, 1, 2), 7),
        case("moments alone", "ordinary", (1, 2, 5), 3, ("moments",)),
        case("one pixel", "ordinary", (1, 1, 1), 7),
        case("one row, other tolerances", "ordinary", (1, 1, 6), 5, sigma_z=3.0, sigma_n=8.0),
        case("fireflies", "stiff", (1, 2, 3), 3, draw=_dim),
        case("moments that cancel", "stiff", (1, 3, 3), 1, ("moments",), spread=1e-3),
    )


def _guide(g: Generator, batch: int, height: int, width: int, bins: int) -> Tensor:
    """Guides between the centres of bins, or beyond the first and the last, but not near them."""
    shape = (batch, 1, height, width)
    between = torch.randint(bins + 1, shape, generator=g) - 0.5 + _uniform(g, *shape, low=0.15, high=0.85)
    return (between.clamp(0.02 * bins, 0.98 * bins) * 256 / bins - 0.5) / 255


def _grid_splat_cases() -> tuple[Case, ...]:
    def case(
        name: str,
        kind: Kind,
        size: tuple[int, int, int, int],
        cell: int,
        bins: int,
        image: Callable[..., Tensor] = _normal,
        differentiable: tuple[str, ...] = ("image", "guide"),
    ) -> Case:
        def tensors(g: Generator) -> Inputs:
            return {"image": image(g, *size), "guide": _guide(g, size[0], *size[2:], bins)}

        return Case(name, kind, tensors, differentiable, {"cell": cell, "bins": bins})

    return (
        case("3x4 in cells of 2", "ordinary", (1, 3, 3, 4), 2, 2),
        case("batch of 2, cells beyond the border", "ordinary", (2, 1, 3, 5), 4, 2),
        case("cells of 3, 4 bins", "ordinary", (1, 1, 4, 3), 3, 4),
        case("one bin", "ordinary", (1, 2, 2, 3), 2, 1),
        case("cells of one pixel", "ordinary", (2, 1, 2, 1), 1, 2),
        case("one pixel", "ordinary", (1, 3, 1, 1), 8, 3),
        case("fireflies of 100", "stiff", (1, 1, 2, 3), 2, 2, lambda g, *shape: _radiance(g, *shape) / 100),
        # Finite differences in the guide of a firefly are too inaccurate for the dark pixels beside it.
        case("fireflies", "extreme", (1, 3, 3, 3), 2, 2, _radiance, ("image",)),
    )


def _grid_slice_cases() -> tuple[Case, ...]:
    def case(
        name: str,
        kind: Kind,
        size: tuple[int, int, int, int],
        cell: int,
        bins: int,
        grid: Callable[..., Tensor] = _normal,
        filled: Callable[[Tensor], Tensor] = lambda drawn: drawn,
        differentiable: tuple[str, ...] = ("grid", "filled", "guide"),
    ) -> Case:
        batch, channels, height, width = size
        cells = (cells_of(height, cell), cells_of(width, cell), bins)

        def tensors(g: Generator) -> Inputs:
            return {
                "grid": grid(g, batch, channels, *cells),
                "filled": filled(_uniform(g, batch, 1, *cells, low=0.2)),
                "guide": _guide(g, batch, height, width, bins),
            }

        return Case(name, kind, tensors, differentiable, {"cell": cell})

    def half_empty(drawn: Tensor) -> Tensor:
        return (drawn > 0.6).to(drawn.dtype)

    return (
        case("3x4 in cells of 2", "ordinary", (1, 3, 3, 4), 2, 2),
        case("batch of 2, cells beyond the border", "ordinary", (2, 1, 3, 5), 4, 2),
        case("cells of 3, 4 bins", "ordinary", (1, 1, 4, 3), 3, 4),
        case("one bin, all filled", "ordinary", (1, 2, 2, 3), 2, 1, filled=torch.ones_like, differentiable=("grid",)),
        case("cells of one pixel", "ordinary", (2, 1, 2, 1), 1, 2),
        case("one pixel", "ordinary", (1, 3, 1, 1), 8, 3),
        case("fireflies of 100", "stiff", (1, 1, 2, 3), 2, 2, lambda g, *shape: _radiance(g, *shape) / 100),
        case("fireflies", "extreme", (1, 3, 3, 3), 2, 2, _radiance, differentiable=("grid",)),
        # Where all cells around a pixel are empty, the result jumps once one of them is filled.
        case("empty cells", "extreme", (1, 3, 3, 5), 2, 4, filled=half_empty, differentiable=("grid",)),
        case("no cell is filled", "extreme", (1, 1, 2, 2), 2, 2, filled=torch.zeros_like, differentiable=("grid",)),
    )


def _gradient_cases() -> tuple[Case, ...]:
    everything = ("current", "previous", "weight", "variance", "normal", "depth")
    both = ("current", "previous")

    def case(
        name: str,
        kind: Kind,
        size: tuple[int, int, int],
        inputs: tuple[str, ...] = everything,
        draw: Callable[..., Tensor] = _uniform,
        noise: float = 0.05,
        change: float = 0.4,
        smooth: tuple[str, ...] | None = None,
        alter: Callable[[dict[str, Any]], None] | None = None,
        **settings: float,
    ) -> Case:
        batch, height, width = size

        def tensors(g: Generator) -> Inputs:
            previous = draw(g, batch, 1, height, width) + 0.1
            # Darken all pixels by similar factors: a change beyond the noise, but not to black.
            current = previous * (change + 0.1 * _uniform(g, batch, 1, height, width))
            drawn: dict[str, Any] = {
                "current": current,
                "previous": previous,
                "weight": _uniform(g, batch, 1, height, width, low=0.5),
                "variance": (noise * previous * _uniform(g, batch, 1, height, width, low=0.5)).square(),
                **_wall(g, *size),
            }
            if alter is not None:
                alter(drawn)
            return {argument: drawn[argument] for argument in inputs}

        return Case(name, kind, tensors, inputs if smooth is None else smooth, settings)

    def one_sample(drawn: dict[str, Any]) -> None:
        """A sample in one pixel of each stratum, and none in the first stratum."""
        drawn["weight"] = torch.zeros_like(drawn["weight"])
        drawn["weight"][..., 1::3, 2::3] = 1
        drawn["weight"][..., :3, :3] = 0

    def sky(drawn: dict[str, Any]) -> None:
        drawn["depth"][..., 0, :] = torch.inf
        drawn["normal"][..., 0, :] = 0

    def off(drawn: dict[str, Any]) -> None:
        drawn["current"][..., :3, :] = 0

    def dark(drawn: dict[str, Any]) -> None:
        drawn["current"], drawn["previous"] = 0 * drawn["current"], 0 * drawn["previous"]

    def still(drawn: dict[str, Any]) -> None:
        drawn["current"] = drawn["previous"].clone()

    return (
        case("3x4, strata of 2", "ordinary", (1, 3, 4), stratum=2, levels=2),
        case("batch of 2", "ordinary", (2, 2, 3), levels=1),
        case("luminance alone", "ordinary", (1, 5, 7), both, levels=2),
        case("strata of a pixel, normals", "ordinary", (1, 2, 3), (*both, "normal"), stratum=1, levels=3),
        case("one row, depths", "ordinary", (1, 1, 7), (*both, "variance", "depth"), sigma_z=3.0, levels=2),
        case("one pixel", "ordinary", (1, 1, 1)),
        case("no filter", "ordinary", (1, 4, 4), (*both, "weight", "variance"), levels=0, threshold=1.0),
        case("brighter", "ordinary", (1, 3, 4), (*both, "variance"), change=2.0, levels=2),
        case("fireflies", "stiff", (1, 3, 4), draw=_dim, smooth=("weight", "normal", "depth"), stratum=2, levels=2),
        case("nearly all noise", "stiff", (1, 4, 4), (*both, "variance"), noise=0.6, smooth=both, levels=2),
        # Central differences would need a negative weight.
        case("one sample a stratum", "extreme", (1, 5, 7), (*both, "weight"), alter=one_sample, smooth=both, levels=1),
        # Infinity has no finite difference.
        case("sky", "extreme", (1, 4, 4), alter=sky, smooth=(*both, "variance"), stratum=2, levels=2),
        # There is no derivative at the limits of the result.
        case("a light goes out", "extreme", (1, 6, 6), (*both, "depth"), alter=off, smooth=("depth",), levels=2),
        case("no light", "extreme", (1, 3, 4), alter=dark, smooth=()),
        case("nothing changes", "extreme", (1, 3, 4), alter=still, smooth=()),
        case("noise only", "extreme", (1, 3, 4), (*both, "variance"), noise=50.0, smooth=()),
    )


def _regression_cases() -> tuple[Case, ...]:
    both = ("image", "features")

    def case(
        name: str,
        kind: Kind,
        size: tuple[int, int, int, int],
        count: int = 2,
        draw: Callable[..., Tensor] = _normal,
        features: Callable[..., Tensor] = _normal,
        differentiable: tuple[str, ...] = both,
        **settings: Any,
    ) -> Case:
        batch, _, height, width = size

        def tensors(g: Generator) -> Inputs:
            return {"image": draw(g, *size), "features": features(g, batch, count, height, width)}

        return Case(name, kind, tensors, differentiable, {"block": 4, **settings})

    def wall(g: Generator, *shape: int) -> Tensor:
        """Two constant features, and two of which one is twice the other."""
        rest = _uniform(g, shape[0], 1, *shape[2:])
        return torch.cat([torch.full_like(rest, -0.8), rest, 2 * rest, torch.zeros_like(rest)], 1)

    def far(g: Generator, *shape: int) -> Tensor:
        return 1e6 + _uniform(g, *shape)

    def equal(g: Generator, *shape: int) -> Tensor:
        return torch.full(shape, 0.3, dtype=torch.float64)

    def nearly(g: Generator, *shape: int) -> Tensor:
        """Two features that differ by a thousandth."""
        first = _normal(g, shape[0], 1, *shape[2:])
        return torch.cat([first, first + 1e-3 * _normal(g, shape[0], 1, *shape[2:])], 1)

    def scene(g: Generator, *shape: int) -> Tensor:
        """Positions in millimetres."""
        return 1e3 * (5 + _uniform(g, *shape))

    return (
        case("one block", "ordinary", (1, 1, 4, 4)),
        case("batch of 2, RGB, blocks over the border", "ordinary", (2, 3, 3, 5), offset=(1, 3)),
        case("a square", "ordinary", (1, 1, 4, 4), squares=1),
        case("blocks of 3, a large ridge", "ordinary", (1, 2, 4, 3), block=3, ridge=0.1, squares=2),
        case("one row", "ordinary", (1, 1, 1, 6), 1, offset=(3, 2)),
        case("one pixel", "ordinary", (1, 3, 1, 1), differentiable=("image",)),
        case("fireflies", "stiff", (1, 1, 4, 4), draw=_radiance, differentiable=("image",)),
        case("features that differ by a thousandth", "stiff", (1, 1, 4, 4), features=nearly, differentiable=("image",)),
        case("position in millimetres", "stiff", (1, 1, 4, 5), 3, features=scene, squares=3, differentiable=("image",)),
        # Finite differences are too inaccurate for dependent features, and for features with a large mean.
        case("a flat wall", "extreme", (1, 1, 4, 5), 4, features=wall, squares=1, differentiable=("image",)),
        case("features all equal", "extreme", (1, 3, 4, 4), features=equal, squares=2, differentiable=("image",)),
        case("positions of 1e6", "extreme", (1, 1, 4, 4), features=far, squares=2, differentiable=("image",)),
        case("more features than pixels", "extreme", (1, 1, 2, 2), 5, squares=2, differentiable=("image",)),
    )


def _camera(batch: int, eye_z: float, unit: float) -> Tensor:
    """Row-vector world-to-clip matrices of a camera that looks along +z; no entry is zero."""
    matrix = torch.tensor(
        [[1.2, 0.05, 0.02, 0.03], [-0.04, 1.5, 0.01, -0.02], [0.06, -0.03, 1.01, 1.0], [0.1, 0.2, -0.5, -eye_z]],
        dtype=torch.float64,
    )
    matrix[3] *= unit
    return matrix.repeat(batch, 1, 1)


def _motion_cases() -> tuple[Case, ...]:
    def case(name: str, kind: Kind, batch: int, height: int, width: int, eye_z: float = 0.0, unit: float = 1.0) -> Case:
        def tensors(g: Generator) -> Inputs:
            depth = _uniform(g, batch, 1, height, width, low=2, high=5)
            position = torch.cat([_uniform(g, batch, 2, height, width, low=-1), depth], 1)
            return {"position": unit * position, "previous_view_projection": _camera(batch, eye_z, unit)}

        return Case(name, kind, tensors, ("position", "previous_view_projection"))

    def nothing_hit(g: Generator) -> Inputs:
        position = _uniform(g, 1, 3, 2, 3, low=2, high=5)
        position[..., 0] = torch.inf
        return {"position": position, "previous_view_projection": _camera(1, 0.0, 1.0)}

    return (
        case("5x7", "ordinary", 1, 5, 7),
        case("batch of 2", "ordinary", 2, 2, 3),
        case("one row", "ordinary", 1, 1, 5),
        case("one pixel", "ordinary", 1, 1, 1),
        case("scene in millimetres", "extreme", 1, 3, 3, unit=1000.0),
        # The previous camera was at z = 3.5, and the points are at z = 2 to 5, some of them close to its plane.
        case("points behind the camera", "stiff", 1, 3, 3, eye_z=3.5),
        Case("nothing hit", "extreme", nothing_hit, ("previous_view_projection",)),
    )


def _motion(g: Generator, batch: int, height: int, width: int, reach: int = 1) -> Tensor:
    """Motion by whole pixels up to ``reach``, plus a fraction away from the kinks at 0 and 1."""
    whole = torch.randint(-reach, reach + 1, (batch, 2, height, width), generator=g)
    return whole + _uniform(g, batch, 2, height, width, low=0.1, high=0.9)


class _History(NamedTuple):
    """Tensors that a history case may change in place after drawing."""

    previous: Tensor
    motion: Tensor
    here: dict[str, Tensor]
    there: dict[str, Tensor]


def _surface(g: Generator, batch: int, height: int, width: int) -> dict[str, Tensor]:
    """Two walls, chosen at random for each pixel, so that about half of the taps clearly show the other wall."""
    facing = torch.tensor([[0.0, 0.6, -0.8], [0.8, 0.0, -0.6]], dtype=torch.float64)
    wall = torch.randint(0, 2, (batch, height, width), generator=g)
    normal = facing[wall].movedim(-1, 1) + 0.02 * _uniform(g, batch, 3, height, width, low=-1)
    depth = 5 + 5 * wall[:, None] + 0.03 * _uniform(g, batch, 1, height, width, low=-1)
    position = torch.cat([0.03 * _uniform(g, batch, 2, height, width, low=-1), depth], 1)
    label = torch.randint(0, 2, (batch, 1, height, width), generator=g).double()
    return {"position": position, "normal": normal / normal.norm(dim=1, keepdim=True), "depth": depth, "label": label}


def _move_far_out(motion: Tensor) -> None:
    motion[..., 0], motion[..., 1] = 1e4 + 0.5, -1e4 - 0.5


def _forget_some(motion: Tensor) -> None:
    motion[:, 0, :, 0], motion[:, 1, :, 1], motion[..., 2] = torch.inf, torch.nan, -torch.inf


def _history_cases(accumulating: bool) -> tuple[Case, ...]:
    def case(
        name: str,
        kind: Kind,
        size: tuple[int, int, int, int],
        surface: tuple[str, ...] = (),
        change: Callable[[_History], None] | None = None,
        *,
        lengths: tuple[float, float] = (1.0, 6.0),
        alpha_min: float = 0.1,
        draw: Callable[..., Tensor] = _uniform,
        smooth: tuple[str, ...] = ("color", "previous", "previous_length", "motion"),
        **settings: Any,
    ) -> Case:
        batch, _, height, width = size

        def tensors(g: Generator) -> Inputs:
            drawn = _History(
                draw(g, *size),
                _motion(g, batch, height, width),
                _surface(g, batch, height, width),
                _surface(g, batch, height, width),
            )
            if change is not None:
                change(drawn)
            inputs: Inputs = {"previous": drawn.previous, "motion": drawn.motion}
            if surface:
                inputs["surface"] = Surface(**{part: drawn.here[part] for part in surface})
                inputs["previous_surface"] = Surface(**{part: drawn.there[part] for part in surface})
            if accumulating:
                low, high = lengths
                inputs["color"] = draw(g, *size)
                inputs["previous_length"] = _uniform(g, batch, 1, height, width, low=low, high=high)
            return inputs

        if accumulating:
            settings["alpha_min"] = alpha_min
        arguments = ("color", "previous", "previous_length", "motion") if accumulating else ("previous", "motion")
        return Case(name, kind, tensors, tuple(name for name in arguments if name in smooth), settings)

    everything = ("position", "normal", "depth")

    def far_out(drawn: _History) -> None:
        _move_far_out(drawn.motion)

    def unknown(drawn: _History) -> None:
        _forget_some(drawn.motion)

    def still(drawn: _History) -> None:
        drawn.motion.zero_()

    def sky(drawn: _History) -> None:
        for surface in (drawn.here, drawn.there):
            surface["position"][..., :2, 1:] = surface["depth"][..., :2, 1:] = torch.inf

    def all_new(drawn: _History) -> None:
        drawn.here["normal"].neg_()

    def nan_elsewhere(drawn: _History) -> None:
        drawn.there["normal"][..., 1] = drawn.previous[..., 1] = torch.nan

    # "bmfr" rounds the length, which then has no derivative.
    rounded = ("color", "previous", "motion")
    bmfr: dict[str, Any] = {"rule": "bmfr", "smooth": rounded, "alpha_min": 0.2, "lengths": (1.0, 3.4)}
    return (
        case("5x7, no surface", "ordinary", (1, 1, 5, 7)),
        case("relative, all buffers, batch of 2, RGB", "ordinary", (2, 3, 2, 3), everything),
        case("relative, depth", "ordinary", (1, 1, 3, 4), ("depth",)),
        case("relative, position and depth", "ordinary", (1, 1, 3, 3), ("position", "depth"), position_limit=0.03),
        case("relative, normal", "ordinary", (1, 1, 3, 3), ("normal",), normal_limit=0.3),
        case("labels", "ordinary", (1, 1, 3, 4), ("label",)),
        case("relative, all buffers, labels", "ordinary", (1, 3, 3, 3), (*everything, "label")),
        case("bmfr", "ordinary", (1, 3, 3, 3), ("position", "normal"), position_limit=0.5, normal_limit=0.25, **bmfr),
        case("one row, 5 channels", "ordinary", (1, 5, 1, 5), ("depth",)),
        case("one pixel", "ordinary", (1, 3, 1, 1)),
        # Zero is a whole pixel, where the derivative in the motion jumps.
        case("still", "ordinary", (1, 3, 2, 3), everything, still, smooth=("color", "previous", "previous_length")),
        case("long history", "ordinary", (1, 1, 3, 3), lengths=(12.0, 40.0)),
        case("history length of a byte", "extreme", (1, 1, 3, 3), **{**bmfr, "lengths": (250.0, 255.0)}),
        case("fireflies", "stiff", (1, 3, 2, 3), everything, draw=_radiance),
        case("out of the image", "extreme", (1, 3, 2, 3), everything, far_out),
        case("motion unknown", "extreme", (1, 1, 2, 4), (), unknown),
        case("sky", "extreme", (1, 1, 3, 4), everything, sky),
        case("new surfaces only", "extreme", (1, 3, 2, 3), everything, all_new),
        # There are no finite differences of NaN.
        case("NaN on another surface", "extreme", (1, 3, 2, 3), everything, nan_elsewhere, smooth=("color", "motion")),
    )


def _resampling_cases() -> tuple[Case, ...]:
    def case(
        name: str,
        kind: Kind,
        size: tuple[int, int, int, int],
        change: Callable[[Tensor], object] | None = None,
        *,
        draw: Callable[..., Tensor] = _uniform,
        smooth: tuple[str, ...] = ("previous", "motion"),
    ) -> Case:
        def tensors(g: Generator) -> Inputs:
            motion = _motion(g, size[0], *size[2:])
            if change is not None:
                change(motion)
            return {"previous": draw(g, *size), "motion": motion}

        return Case(name, kind, tensors, smooth)

    return (
        case("5x7", "ordinary", (1, 1, 5, 7)),
        case("batch of 2, RGB", "ordinary", (2, 3, 4, 5)),
        case("RGB", "ordinary", (1, 3, 4, 5)),
        case("one row, 5 channels", "ordinary", (1, 5, 1, 5)),
        case("one pixel", "ordinary", (1, 3, 1, 1)),
        # Zero is a whole pixel, where the derivative in the motion jumps.
        case("still", "ordinary", (1, 3, 2, 3), lambda motion: motion.zero_(), smooth=("previous",)),
        case("fireflies", "stiff", (1, 3, 4, 5), draw=_radiance),
        case("out of the image", "extreme", (1, 3, 2, 3), _move_far_out),
        case("motion unknown", "extreme", (1, 1, 2, 4), _forget_some),
    )


def _softmax(settings: dict[str, Any]) -> bool:
    return bool(settings["normalize"] == "softmax")


_IMAGE, _HISTORY = ("image",), ("color", "previous")

OPS: tuple[Op, ...] = (
    Op(
        kernel_conv,
        reference.kernel_conv,
        _filter_cases() + extreme.filters(),
        KernelConv,
        images=_IMAGE,
        rounding=extreme.filter_rounding,
    ),
    Op(
        kernel_splat,
        reference.kernel_splat,
        _filter_cases() + extreme.filters(),
        KernelSplat,
        images=_IMAGE,
        rounding=extreme.filter_rounding,
    ),
    Op(
        softmax_splat,
        reference.softmax_splat,
        _splat_cases() + extreme.splats(),
        images=_IMAGE,
        rounding=extreme.splat_rounding,
    ),
    Op(
        cross_bilateral_weights,
        reference.cross_bilateral_weights,
        _bilateral_cases() + extreme.bilateral(),
        CrossBilateralWeights,
        weights=_softmax,
        rounding=extreme.bilateral_rounding,
    ),
    Op(
        cross_bilateral_filter,
        reference.cross_bilateral_filter,
        _bilateral_filter_cases() + extreme.bilateral_filters(),
        CrossBilateralFilter,
        images=_IMAGE,
        rounding=extreme.bilateral_filter_rounding,
    ),
    Op(
        downsample,
        reference.downsample,
        _image_cases(lambda height, width: (height, width), with_size=False) + extreme.images(halved=False),
        images=_IMAGE,
    ),
    Op(
        upsample,
        reference.upsample,
        _image_cases(_half, with_size=True) + extreme.images(halved=True),
        images=_IMAGE,
    ),
    Op(
        laplacian_fusion,
        reference.laplacian_fusion,
        _fusion_cases() + extreme.fusions(),
        LaplacianFusion,
        images=("fine", "coarse"),
    ),
    Op(
        pyramid_partition,
        reference.pyramid_partition,
        _partition_cases() + extreme.partitions(),
        images=_IMAGE,
        rounding=extreme.partition_rounding,
    ),
    Op(
        learned_upsample,
        reference.learned_upsample,
        _learned_cases() + extreme.learned(),
        images=_IMAGE,
    ),
    Op(
        demodulate,
        reference.demodulate,
        _demodulation_cases("color") + extreme.demodulations("color"),
        Demodulate,
        images=("color",),
    ),
    Op(
        remodulate,
        reference.remodulate,
        _demodulation_cases("image") + extreme.demodulations("image"),
        Remodulate,
        images=_IMAGE,
    ),
    Op(
        grid_splat,
        reference.grid_splat,
        _grid_splat_cases() + extreme.grid_splats(),
        GridSplat,
        images=_IMAGE,
        rounding=extreme.grid_rounding,
    ),
    Op(
        grid_slice,
        reference.grid_slice,
        _grid_slice_cases() + extreme.grid_slices(),
        GridSlice,
        images=("grid",),
        rounding=extreme.grid_rounding,
    ),
    Op(
        clamp_fireflies,
        reference.clamp_fireflies,
        _firefly_cases() + extreme.fireflies(),
        ClampFireflies,
        images=_IMAGE,
        rounding=extreme.firefly_rounding,
    ),
    Op(history_lag, reference.history_lag, _lag_cases() + extreme.lags(), HistoryLag),
    Op(
        importance_filter,
        reference.importance_filter,
        _importance_cases() + extreme.importances(),
        ImportanceFilter,
        images=_IMAGE,
        rounding=extreme.importance_rounding,
    ),
    Op(
        atrous,
        reference.atrous,
        _atrous_cases() + extreme.transforms(),
        Atrous,
        rounding=extreme.transform_rounding,
    ),
    Op(
        affinity_filter,
        reference.affinity_filter,
        _affinity_cases() + extreme.affinities(),
        AffinityFilter,
        images=("image", "previous"),
        rounding=extreme.affinity_rounding,
    ),
    Op(
        luminance_moments,
        reference.luminance_moments,
        _luminance_cases() + extreme.luminances(),
        least_dtype=torch.float32,
    ),
    Op(
        moments_variance,
        reference.moments_variance,
        _moments_cases() + extreme.moments(),
        MomentsVariance,
    ),
    Op(
        temporal_gradient,
        reference.temporal_gradient,
        _gradient_cases() + extreme.gradients(),
        TemporalGradient,
        rounding=extreme.gradient_rounding,
    ),
    Op(
        block_regression,
        reference.block_regression,
        _regression_cases() + extreme.regressions(),
        BlockRegression,
        images=_IMAGE,
    ),
    Op(
        motion_from_position,
        reference.motion_from_position,
        _motion_cases() + extreme.motions(),
        least_dtype=torch.float32,
        rounding=extreme.motion_rounding,
    ),
    Op(
        reproject,
        reference.reproject,
        _history_cases(accumulating=False) + extreme.histories(accumulating=False),
        images=("previous",),
        rounding=extreme.history_rounding,
    ),
    Op(
        resample,
        reference.resample,
        _resampling_cases() + extreme.resamplings(),
        images=("previous",),
        rounding=extreme.resampling_rounding,
    ),
    Op(
        accumulate,
        reference.accumulate,
        _history_cases(accumulating=True) + extreme.histories(accumulating=True),
        Accumulate,
        images=_HISTORY,
        rounding=extreme.history_rounding,
    ),
)
