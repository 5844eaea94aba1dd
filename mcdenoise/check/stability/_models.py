"""Errors of networks, and properties that must hold for all images."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from mcdenoise.check.stability._check import DTYPES, Check, name_of
from mcdenoise.frame import Frame
from mcdenoise.methods import parse_method
from mcdenoise.models import Accumulated, Skipping, parts_of

EXPOSURES = (1e-4, 1e-2, 1e2, 1e4)
_DRAWS = 8
_LEAST_RADIANCE = 1e-30
# A convolution rounds weights, activations and results; each rounding is a relative change of its products like the
# random changes that are tried.
ROUNDED = 3
# The largest of eight random changes is not the maximum, but that is hardly four times as large.
ALLOWED = 4


@dataclass(frozen=True)
class ModelCase:
    """A test frame for a model, with a history."""

    name: str
    size: tuple[int, int] = (8, 9)
    color: float | None = None
    changes: dict[str, float] = field(default_factory=dict)

    def frame(self) -> Frame:
        """Six decades of radiance on two walls, with a bit of sky; float32."""
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
    """Run all checks for a network in each dtype: a trained model without its accumulation.

    In half precision only the convolutions run in it and everything else in float32, as ``Denoiser`` does.

    Args:
        name: a model, see :func:`mcdenoise.methods.parse_method`. There are no checks for a model that is not trained,
            or that has a state of its own.
        dtypes: dtypes of the convolutions.

    Raises:
        InputError: there is no such model.
    """
    whole = parse_method(name).denoiser().model
    model = _without_history(whole)
    if not isinstance(model, nn.Module) or not whole.needs.trainable or model(CASES[0].frame())[1] is not None:
        return
    exact = copy.deepcopy(model).double()
    for dtype in dtypes:
        for case in CASES:
            yield from _check_case(name, model, exact, case, dtype)
        yield _check_exposure(name, model, exact, CASES[0], dtype)


def _without_history(model: Any) -> Any:
    """The model inside the accumulation, which receives a color and its history length."""
    for accumulated in parts_of(model, Accumulated):
        inner = accumulated.inner
        return inner.inner if isinstance(inner, Skipping) else inner
    return model


def _image(model: nn.Module, frame: Frame) -> Tensor:
    image: Tensor = model(frame)[0].image
    return image


def _check_case(name: str, model: nn.Module, exact: nn.Module, case: ModelCase, dtype: torch.dtype) -> Iterator[Check]:
    """Compare with float64, in units of the effect of a relative change of all weights and inputs by ``u``."""
    frame = case.frame()
    color = frame.color.clone().requires_grad_()
    with torch.autocast("cpu", dtype, enabled=dtype != torch.float32):
        found = _image(model, frame.replace(color=color))
    valid = bool(torch.isfinite(found).all() and (found >= 0).all())
    yield Check(
        name, case.name, name_of(dtype), "", "finite", 0, 0, 0, valid, "" if valid else "NaN, infinite or below 0"
    )
    parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
    # Normalize the image by its brightness, so that the sum does not overflow; values below 1e-30 count as 1e-30, as in
    # `auto_exposure`.
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
def _check_exposure(name: str, model: nn.Module, exact: nn.Module, case: ModelCase, dtype: torch.dtype) -> Check:
    """``model(s x) = s model(x)``: the check with the worst factor."""
    frame = case.frame()
    checks: list[Check] = []
    for exposure in EXPOSURES:
        current = None if frame.current is None else frame.current * exposure
        with torch.autocast("cpu", dtype, enabled=dtype != torch.float32):
            found = _image(model, frame.replace(color=frame.color * exposure, current=current)) / exposure
        checks.append(_compared(name, exact, case, dtype, "exposure", found))
    return max(checks, key=lambda check: check.error)


def _compared(name: str, exact: nn.Module, case: ModelCase, dtype: torch.dtype, what: str, found: Tensor) -> Check:
    frame = case.frame().to(torch.float64)
    expected = _image(exact, frame)
    unit = torch.finfo(dtype).eps / 2
    products = max(relative_change(_moved(exact, frame, unit, seed), expected) for seed in range(_DRAWS))
    sums = max(relative_change(_summed(exact, frame, seed), expected) for seed in range(_DRAWS))
    # Everything but the convolutions is in float32.
    response = ROUNDED * max(products, torch.finfo(torch.float32).eps) + sums
    error, allowed = relative_change(found, expected) / (2 * unit), ALLOWED * response / (2 * unit)
    message = "" if error <= allowed else f"error {error:.3g} eps, expected at most {allowed:.3g}"
    return Check(name, case.name, name_of(dtype), "", what, error, allowed, response / unit, not message, message)


def _moved(exact: nn.Module, frame: Frame, unit: float, seed: int) -> Tensor:
    """The image after changing every weight and buffer by the relative amount ``unit``, up or down."""
    generator = torch.Generator().manual_seed(seed)

    def move(tensor: Tensor) -> Tensor:
        signs = torch.randint(0, 2, tensor.shape, generator=generator) * 2 - 1
        return tensor * (1 + unit * signs)

    weights = {name: move(parameter) for name, parameter in exact.named_parameters()}
    output, _ = torch.func.functional_call(exact, weights, (frame.map(move),))
    image: Tensor = output.image
    return image


def _summed(exact: nn.Module, frame: Frame, seed: int) -> Tensor:
    """The image with the result of every convolution changed as float32 may change a sum of n products in some order.

    The k-th partial sum of products of random signs is about sqrt(k) of one of them and rounded by ``u`` of that, so
    that the roundings of all of them add up to ``u n / sqrt(2)`` of a product: ``u sqrt(n / 2)`` of the root of the sum
    of their squares (Higham, Accuracy and Stability of Numerical Algorithms, 2002, Sec. 2.8 and 4.2).
    """
    generator = torch.Generator().manual_seed(seed)
    unit = torch.finfo(torch.float32).eps / 2

    def change(layer: nn.Module, given: tuple[Any, ...], result: Tensor) -> Tensor:
        assert isinstance(layer, nn.Conv2d | nn.ConvTranspose2d)
        squared = copy.deepcopy(layer)
        for parameter in squared.parameters():
            parameter.square_()
        # Call forward directly, because a call would run this hook again.
        spread = squared.forward(given[0].square(), *given[1:]).sqrt()
        signs: Tensor = torch.randint(0, 2, result.shape, generator=generator) * 2 - 1
        terms = layer.weight.numel() / layer.out_channels
        if isinstance(layer, nn.ConvTranspose2d):
            terms /= math.prod(layer.stride)
        return result + unit * math.sqrt(terms / 2) * spread * signs

    convolutions = [each for each in exact.modules() if isinstance(each, nn.Conv2d | nn.ConvTranspose2d)]
    handles = [each.register_forward_hook(change) for each in convolutions]
    try:
        return _image(exact, frame)
    finally:
        for handle in handles:
            handle.remove()


def relative_change(found: Tensor, expected: Tensor) -> float:
    """The largest change, relative to the pixel in bright areas, and to half the image's mean in dark ones."""
    unit = expected.abs().double() + expected.double().mean() / 2
    # Subnormal numbers have fewer digits.
    return float(((found.double() - expected).abs() / (unit + torch.finfo(torch.float32).tiny)).max())
