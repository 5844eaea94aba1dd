"""Errors of whole models, and what must hold for them whatever the image is."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from mcdenoise.errors import InputError
from mcdenoise.models import create_model, pretrained_models
from mcdenoise.stability._check import DTYPES, Check, name_of

EXPOSURES = (1e-4, 1e-2, 1e2, 1e4)
_DRAWS = 3
# A convolution rounds weights, activations and results, each of which is a relative change of its products such as the
# one that is tried; and of three random ones the largest is not the largest of all, but that is hardly four times it.
ALLOWED = 3 * 4


@dataclass(frozen=True)
class ModelCase:
    """Inputs of a model, by what is special about them; see :meth:`mcdenoise.models.Cascade.forward`."""

    name: str
    size: tuple[int, int] = (8, 9)
    color: float | None = None
    changes: dict[str, float] = field(default_factory=dict)

    def inputs(self) -> dict[str, Tensor]:
        """Six decades of radiance on two walls, with a bit of sky; float32."""
        g = torch.Generator().manual_seed(0)
        shape = (1, 3, *self.size)
        color = 10 ** (4 * torch.rand(shape, generator=g) - 2)
        normal = torch.nn.functional.normalize(torch.randn(shape, generator=g))
        depth = 1 + 9 * torch.rand(shape, generator=g)[:, :1]
        depth[..., :1, :1] = torch.inf
        inputs = {
            "color": color if self.color is None else torch.full(shape, self.color),
            "albedo": torch.rand(shape, generator=g),
            "normal": normal,
            "depth": depth,
        }
        for name, value in self.changes.items():
            inputs[name] = inputs[name] * value if name == "normal" else torch.full_like(inputs[name], value)
        inputs["current"] = inputs["color"] * torch.rand(shape, generator=g)
        inputs["length"] = 1 + 30 * torch.rand(shape, generator=g)[:, :1].round()
        if self.name == "one firefly of 1e6":
            inputs["color"][..., self.size[0] // 2, self.size[1] // 2] = 1e6
        return inputs


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


def select(names: Sequence[str] | None = None) -> list[str]:
    """Names of models with shipped weights; all of these for ``None``.

    Raises:
        InputError: there are no shipped weights of such a name.
    """
    shipped = sorted(pretrained_models())
    unknown = [name for name in names or () if name not in shipped]
    if unknown:
        raise InputError(f"models: expected some of {', '.join(shipped)}, found {', '.join(unknown)}")
    return shipped if names is None else list(names)


def check_model(name: str, dtypes: Sequence[torch.dtype] = DTYPES) -> Iterator[Check]:
    """Everything that must hold for a model with its shipped weights, in each dtype.

    In half precision the convolutions run in it and everything else in float32, as ``Denoiser`` runs them.

    Args:
        name: of the model.
        dtypes: of the convolutions.
    """
    model = create_model(name, pretrained=True).eval()
    exact = copy.deepcopy(model).double()
    for dtype in dtypes:
        for case in CASES:
            yield from _check_case(name, model, exact, case, dtype)
        yield _check_exposure(name, model, exact, CASES[0], dtype)


def _check_case(name: str, model: nn.Module, exact: nn.Module, case: ModelCase, dtype: torch.dtype) -> Iterator[Check]:
    """Forward against float64, in units of what a relative change of all weights and inputs by ``u`` does to it."""
    inputs = case.inputs()
    color = inputs["color"].clone().requires_grad_()
    with torch.autocast("cpu", dtype, enabled=dtype != torch.float32):
        found = model(**{**inputs, "color": color}).final
    valid = bool(torch.isfinite(found).all() and (found >= 0).all())
    yield Check(
        name, case.name, name_of(dtype), "", "finite", 0, 0, 0, valid, "" if valid else "NaN, infinite or below 0"
    )
    parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
    # Of the image in units of its own brightness, so that the largest radiance does not overflow the sum.
    scale = max(float(inputs["color"].max()), torch.finfo(torch.float32).tiny)
    if not inputs["color"].any():
        scale = 1.0
    gradients = torch.autograd.grad((found / scale).sum(), [color, *parameters], allow_unused=True)
    finite = all(bool(torch.isfinite(gradient).all()) for gradient in gradients if gradient is not None)
    message = "" if finite else "a gradient is NaN or infinite"
    yield Check(name, case.name, name_of(dtype), "", "gradient", 0, 0, 0, finite, message)
    with torch.no_grad():
        yield _compared(name, exact, case, dtype, "forward", found.detach())


@torch.no_grad()
def _check_exposure(name: str, model: nn.Module, exact: nn.Module, case: ModelCase, dtype: torch.dtype) -> Check:
    """``model(s x) = s model(x)``: the worst factor of all."""
    inputs = case.inputs()
    checks: list[Check] = []
    for exposure in EXPOSURES:
        scaled = {**inputs, "color": inputs["color"] * exposure, "current": inputs["current"] * exposure}
        with torch.autocast("cpu", dtype, enabled=dtype != torch.float32):
            found = model(**scaled).final / exposure
        checks.append(_compared(name, exact, case, dtype, "exposure", found))
    return max(checks, key=lambda check: check.error)


def _compared(name: str, exact: nn.Module, case: ModelCase, dtype: torch.dtype, what: str, found: Tensor) -> Check:
    inputs = {key: value.double() for key, value in case.inputs().items()}
    expected = exact(**inputs).final
    unit = torch.finfo(dtype).eps / 2
    response = max(relative_change(_moved(exact, inputs, unit, seed), expected) for seed in range(_DRAWS))
    # Everything outside of the convolutions is in float32.
    response = max(response, torch.finfo(torch.float32).eps)
    error, allowed = relative_change(found, expected) / (2 * unit), ALLOWED * response / (2 * unit)
    message = "" if error <= allowed else f"error {error:.3g} eps, expected at most {allowed:.3g}"
    return Check(name, case.name, name_of(dtype), "", what, error, allowed, response / unit, not message, message)


def _moved(exact: nn.Module, inputs: dict[str, Tensor], unit: float, seed: int) -> Tensor:
    """The image with every weight and input changed by ``unit`` of itself, up or down."""
    generator = torch.Generator().manual_seed(seed)

    def move(tensor: Tensor) -> Tensor:
        signs = torch.randint(0, 2, tensor.shape, generator=generator) * 2 - 1
        return tensor * (1 + unit * signs)

    weights = {name: move(parameter) for name, parameter in exact.named_parameters()}
    moved = {name: move(tensor) for name, tensor in inputs.items()}
    image: Tensor = torch.func.functional_call(exact, weights, kwargs=moved, args=()).final
    return image


def relative_change(found: Tensor, expected: Tensor) -> float:
    """The largest change, relative where the image is bright, and of half its mean where it is dark."""
    unit = expected.abs().double() + expected.double().mean() / 2
    # Below the smallest normal number there are fewer digits.
    return float(((found.double() - expected).abs() / (unit + torch.finfo(torch.float32).tiny)).max())
