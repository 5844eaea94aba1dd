"""Errors of networks, and properties that must hold for all images."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import cycle
from typing import Any

import torch
from torch import Tensor, nn

from mcdenoise.check.stability._check import DTYPES, Check, name_of
from mcdenoise.frame import Frame
from mcdenoise.methods import parse_method
from mcdenoise.models import Accumulated, Skipping, parts_of
from mcdenoise.ops import use

EXPOSURES = (1e-4, 1e-2, 1e2, 1e4)
_DRAWS = 8
_LEAST_OF_HALF = torch.finfo(torch.float16).eps / 2
_LEAST_RADIANCE = 1e-30
# A convolution rounds weights, activations and results; each is a relative change of its products like the measured
# one.
ROUNDED = 3
# The maximum of eight random perturbations underestimates the true maximum, but hardly by more than this factor.
ALLOWED = 4


@dataclass(frozen=True)
class ModelCase:
    """A frame for a model, with a history; its name says what is special about it."""

    name: str
    size: tuple[int, int] = (8, 9)
    color: float | None = None
    changes: dict[str, float] = field(default_factory=dict)

    def frame(self) -> Frame:
        """A frame with four decades of radiance and some sky, in float32."""
        g = torch.Generator().manual_seed(0)
        shape = (1, 3, *self.size)
        color = 10 ** (4 * torch.rand(shape, generator=g) - 2)
        normal = torch.nn.functional.normalize(torch.randn(shape, generator=g))
        depth = 1 + 9 * torch.rand(shape, generator=g)[:, :1]
        depth[..., :1, :1] = torch.inf
        if self.color is not None:
            color = torch.full(shape, self.color)
        albedo = torch.rand(shape, generator=g)
        images = {"albedo": albedo, "normal": normal, "depth": depth}
        for name, value in self.changes.items():
            images[name] = images[name] * value if name == "normal" else torch.full_like(images[name], value)
        current = color * torch.rand(shape, generator=g)
        length = 1 + 30 * torch.rand(shape, generator=g)[:, :1].round()
        if self.name == "one firefly of 1e6":
            color[..., self.size[0] // 2, self.size[1] // 2] = 1e6
        return Frame(color=color, current=current, length=length).replace(**images)


CASES = (
    ModelCase("ordinary", (17, 23)),
    *(ModelCase(f"radiance {value:g}", color=value) for value in (0.0, 1e-40, 1e-30, 1.0, 65504.0, 1e6, 1e30)),
    ModelCase("one firefly of 1e6", color=0.0),
    *(ModelCase(f"depth {value:g}", changes={"depth": value}) for value in (0.0, 1e-30, 1e10, torch.inf)),
    *(ModelCase(f"albedo {value:g}", changes={"albedo": value}) for value in (0.0, 1.0)),
    ModelCase("normals of length 0", changes={"normal": 0.0}),
    ModelCase("normals of length 10", changes={"normal": 10.0}),
    *(ModelCase(f"{height}x{width}", (height, width)) for height, width in ((1, 1), (1, 9), (9, 1), (3, 2))),
)


def check_model(name: str, dtypes: Sequence[torch.dtype] = DTYPES) -> Iterator[Check]:
    """Check a network, that is a trainable model without its accumulation, in each dtype.

    In half precision the convolutions run in that dtype and everything else in float32, as in ``Denoiser``.

    Args:
        name: a model, see :func:`mcdenoise.methods.parse_method`. Models that are not trainable, or that have a state
            of their own, have no such checks.
        dtypes: dtypes of the convolutions.

    Raises:
        InputError: there is no such model.
    """
    whole = parse_method(name).denoiser().model
    model = _without_history(whole)
    if not isinstance(model, nn.Module) or not whole.needs.trainable or model(CASES[0].frame())[1] is not None:
        return
    with torch.no_grad():
        exact = _Exact(model, CASES)
    for dtype in dtypes:
        for case in CASES:
            yield from _check_case(name, model, exact, case, dtype)
        yield _check_exposure(name, model, exact, CASES[0], dtype)


def _without_history(model: Any) -> Any:
    """The model inside the accumulation; it takes an accumulated color and its history length, like those of a case."""
    for accumulated in parts_of(model, Accumulated):
        inner = accumulated.inner
        return inner.inner if isinstance(inner, Skipping) else inner
    return model


def _image(model: nn.Module, frame: Frame) -> Tensor:
    image: Tensor = model(frame)[0].image
    return image


def _check_case(name: str, model: nn.Module, exact: _Exact, case: ModelCase, dtype: torch.dtype) -> Iterator[Check]:
    """Check that image and gradients are finite, and compare the image with float64."""
    frame = case.frame()
    color = frame.color.clone().requires_grad_()
    with torch.autocast("cpu", dtype, enabled=dtype != torch.float32):
        found = _image(model, frame.replace(color=color))
    valid = bool(torch.isfinite(found).all() and (found >= 0).all())
    yield Check(
        name, case.name, name_of(dtype), "", "finite", 0, 0, 0, valid, "" if valid else "NaN, infinite or below 0"
    )
    parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
    # Differentiate the image relative to its brightness, so that bright images do not overflow the sum; the minimum is
    # 1e-30, as in `auto_exposure`.
    scale = max(float(frame.color.max()), _LEAST_RADIANCE)
    if not frame.color.any():
        scale = 1.0
    gradients = torch.autograd.grad((found / scale).sum(), [color, *parameters], allow_unused=True)
    finite = all(bool(torch.isfinite(gradient).all()) for gradient in gradients if gradient is not None)
    message = "" if finite else "a gradient is NaN or infinite"
    yield Check(name, case.name, name_of(dtype), "", "gradient", 0, 0, 0, finite, message)
    with torch.no_grad():
        yield _compared(name, exact, case, dtype, "forward", found.detach())


@torch.no_grad()
def _check_exposure(name: str, model: nn.Module, exact: _Exact, case: ModelCase, dtype: torch.dtype) -> Check:
    """``model(s x) = s model(x)``, for the factor ``s`` with the largest error."""
    frame = case.frame()
    checks: list[Check] = []
    for exposure in EXPOSURES:
        current = None if frame.current is None else frame.current * exposure
        with torch.autocast("cpu", dtype, enabled=dtype != torch.float32):
            found = _image(model, frame.replace(color=frame.color * exposure, current=current)) / exposure
        checks.append(_compared(name, exact, case, dtype, "exposure", found))
    return max(checks, key=lambda check: check.error)


def _compared(name: str, exact: _Exact, case: ModelCase, dtype: torch.dtype, what: str, found: Tensor) -> Check:
    unit = torch.finfo(dtype).eps / 2
    # Everything except convolutions is in float32.
    response = ROUNDED * max(exact.products(unit)[case.name], torch.finfo(torch.float32).eps) + exact.sums[case.name]
    error, allowed = relative_change(found, exact.images[case.name]) / (2 * unit), ALLOWED * response / (2 * unit)
    message = "" if error <= allowed else f"error {error:.3g} eps, expected at most {allowed:.3g}"
    return Check(name, case.name, name_of(dtype), "", what, error, allowed, response / unit, not message, message)


class _Exact:
    """A model in float64: its images, and how much they change when the model rounds.

    Args:
        model: in float32.
        cases: of the images.
    """

    def __init__(self, model: nn.Module, cases: Sequence[ModelCase]) -> None:
        self._short, self.model = model, copy.deepcopy(model).double()
        self._squared = {
            each: _with_squared_weights(each)
            for each in self.model.modules()
            if isinstance(each, nn.Conv2d | nn.ConvTranspose2d)
        }
        self._frames = {case.name: case.frame().to(torch.float64) for case in cases}
        with use("torch"):
            self.images = {name: _image(self.model, frame) for name, frame in self._frames.items()}
        # The largest changes of the images when convolutions are summed in float32.
        self.sums = self._largest([[name] for name in self.images], [self._summed])
        self._products: dict[float, dict[str, float]] = {}

    def products(self, unit: float) -> dict[str, float]:
        """The largest changes of the images when every weight and buffer changes by ``unit`` relatively."""
        if unit not in self._products:
            moves = [partial(self._moved, unit=unit, seed=seed) for seed in range(_DRAWS)]
            alike: dict[tuple[int, int], list[str]] = {}
            for name, frame in self._frames.items():
                alike.setdefault(frame.size, []).append(name)
            # In float64 a batch takes as long as its frames one by one, and in float32 a quarter of it.
            batches = list(alike.values()) if unit >= _LEAST_OF_HALF else [[name] for name in self.images]
            self._products[unit] = self._largest(batches, moves)
        return self._products[unit]

    def _largest(self, batches: list[list[str]], changes: Sequence[Callable[[Frame], Tensor]]) -> dict[str, float]:
        """The largest change of each case's image; each function may return several copies of the batch."""
        found = dict.fromkeys(self.images, 0.0)
        for names in batches:
            frame = joined([self._frames[name] for name in names])
            for change in changes:
                # Like the image, also where a batch is large enough for another backend.
                with use("torch"):
                    images = change(frame)
                for name, image in zip(cycle(names), images.split(1), strict=False):
                    found[name] = max(found[name], relative_change(image, self.images[name]))
        return found

    def _moved(self, frame: Frame, unit: float, seed: int) -> Tensor:
        generator = torch.Generator().manual_seed(seed)

        def move(tensor: Tensor) -> Tensor:
            signs = torch.randint(0, 2, tensor.shape, generator=generator) * 2 - 1
            return tensor * (1 + unit * signs)

        # Beside the unit of half precision, rounding in float32 is nothing.
        model, dtype = (self.model, torch.float64) if unit < _LEAST_OF_HALF else (self._short, torch.float32)
        weights = {name: move(parameter).to(dtype) for name, parameter in self.model.named_parameters()}
        output, _ = torch.func.functional_call(model, weights, (frame.map(move).to(dtype),))
        image: Tensor = output.image
        return image

    def _summed(self, frame: Frame) -> Tensor:
        """Images when the result of every convolution changes by the rounding error of a float32 sum of n products.

        The k-th partial sum of products with random signs has the size of sqrt(k) products, and a relative rounding
        error of ``u``. The rounding errors of all partial sums add up to ``u n / sqrt(2)`` of a product, which is
        ``u sqrt(n / 2)`` times the root of the sum of squared products (Higham, Accuracy and Stability of Numerical
        Algorithms, 2002, Sec. 2.8 and 4.2). Every image has several copies, with signs of their own.
        """
        generator = torch.Generator().manual_seed(0)
        unit = torch.finfo(torch.float32).eps / 2

        def change(layer: nn.Module, given: tuple[Any, ...], result: Tensor) -> Tensor:
            assert isinstance(layer, nn.Conv2d | nn.ConvTranspose2d)
            # The copies hardly differ.
            spread = self._squared[layer](given[0][: len(result) // _DRAWS].square(), *given[1:]).sqrt()
            spread = spread.repeat(_DRAWS, 1, 1, 1)
            signs: Tensor = torch.randint(0, 2, result.shape, generator=generator) * 2 - 1
            terms = layer.weight.numel() / layer.out_channels
            if isinstance(layer, nn.ConvTranspose2d):
                terms /= math.prod(layer.stride)
            rounded: Tensor = result + unit * math.sqrt(terms / 2) * spread * signs
            return rounded

        handles = [layer.register_forward_hook(change) for layer in self._squared]
        try:
            return _image(self.model, frame.map(lambda image: image.repeat(_DRAWS, 1, 1, 1)))
        finally:
            for handle in handles:
                handle.remove()


def joined(frames: Sequence[Frame]) -> Frame:
    """Frames as one batch."""
    buffers = [dict(frame.items()) for frame in frames]
    return frames[0].replace(**{name: torch.cat([each[name] for each in buffers]) for name in frames[0].buffers})


def _with_squared_weights(layer: nn.Module) -> nn.Module:
    squared = copy.deepcopy(layer).requires_grad_(False)
    for parameter in squared.parameters():
        parameter.square_()
    return squared


def relative_change(found: Tensor, expected: Tensor) -> float:
    """Maximum change relative to the pixel's value plus half of the mean of the image."""
    unit = expected.abs().double() + expected.double().mean() / 2
    # Numbers below the smallest normal number have fewer digits.
    return float(((found.double() - expected).abs() / (unit + torch.finfo(torch.float32).tiny)).max())
