"""Errors of networks, and properties that must hold for all images."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from mcdenoise.check.stability._check import DTYPES, Check, bounded, held
from mcdenoise.check.stability._rounding import Rounded
from mcdenoise.frame import Frame
from mcdenoise.methods import parse_method
from mcdenoise.models import Accumulated, Skipping
from mcdenoise.models._wrapper import parts_of
from mcdenoise.ops import use

EXPOSURES = (1e-4, 1e-2, 1e2, 1e4)
_DRAWS = 8
_LEAST_RADIANCE = 1e-30
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
    exact = _Exact(model)
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
    frame, about = case.frame(), (name, case.name, dtype)
    color = frame.color.clone().requires_grad_()
    with torch.autocast("cpu", dtype, enabled=dtype != torch.float32):
        found = _image(model, frame.replace(color=color))
    valid = bool(torch.isfinite(found).all() and (found >= 0).all())
    yield held(*about, "finite", "" if valid else "NaN, infinite or below 0")
    parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
    # Differentiate the image relative to its brightness, so that bright images do not overflow the sum; the minimum is
    # 1e-30, as in `auto_exposure`.
    scale = max(float(frame.color.max()), _LEAST_RADIANCE) if frame.color.any() else 1.0
    gradients = torch.autograd.grad((found / scale).sum(), [color, *parameters], allow_unused=True)
    finite = all(bool(torch.isfinite(gradient).all()) for gradient in gradients if gradient is not None)
    yield held(*about, "gradient", "" if finite else "a gradient is NaN or infinite")
    yield exact.compared(*about, "forward", case, found.detach())


@torch.no_grad()
def _check_exposure(name: str, model: nn.Module, exact: _Exact, case: ModelCase, dtype: torch.dtype) -> Check:
    """``model(s x) = s model(x)``, for the factor ``s`` with the largest error."""
    frame = case.frame()
    checks: list[Check] = []
    for exposure in EXPOSURES:
        current = None if frame.current is None else frame.current * exposure
        with torch.autocast("cpu", dtype, enabled=dtype != torch.float32):
            found = _image(model, frame.replace(color=frame.color * exposure, current=current)) / exposure
        checks.append(exact.compared(name, case.name, dtype, "exposure", case, found))
    return max(checks, key=lambda check: check.error)


class _Exact:
    """A model in float64: its images, and how much they change when each of its steps is rounded.

    Args:
        model: in float32.
    """

    def __init__(self, model: nn.Module) -> None:
        self._model = copy.deepcopy(model).double()
        self._known: dict[tuple[str, torch.dtype], tuple[Tensor, float]] = {}

    def compared(self, name: str, about: str, dtype: torch.dtype, what: str, case: ModelCase, found: Tensor) -> Check:
        """Compare an image with the exact one."""
        if (case.name, dtype) not in self._known:
            self._known[case.name, dtype] = self._found(case, dtype)
        image, change = self._known[case.name, dtype]
        eps = torch.finfo(dtype).eps
        return bounded(
            name, about, dtype, what, relative_change(found, image) / eps, ALLOWED * change / eps, 2 * change / eps
        )

    @torch.no_grad()
    def _found(self, case: ModelCase, dtype: torch.dtype) -> tuple[Tensor, float]:
        """The exact image, and its largest change in several experiments."""
        frame = case.frame().to(torch.float64)
        # Everything except convolutions is in float32.
        rounded = Rounded(torch.float32, torch.finfo(torch.float32).eps / 2, convolutions=torch.finfo(dtype).eps / 2)
        copies = frame.map(lambda image: rounded.rounded(image.repeat(_DRAWS, *(1,) * (image.ndim - 1))))
        # Like the image, also where a batch is large enough for another backend.
        with use("torch"):
            image = _image(self._model, frame)
            with rounded:
                changed = _image(self._model, copies)
        largest = max(relative_change(each, image) for each in changed.split(1))
        return image, max(largest, torch.finfo(torch.float32).eps)


def joined(frames: Sequence[Frame]) -> Frame:
    """Frames as one batch."""
    buffers = [dict(frame.items()) for frame in frames]
    return frames[0].replace(**{name: torch.cat([each[name] for each in buffers]) for name in frames[0].buffers})


def relative_change(found: Tensor, expected: Tensor) -> float:
    """Maximum change relative to the pixel's value plus half of the mean of the image."""
    unit = expected.abs().double() + expected.double().mean() / 2
    # Numbers below the smallest normal number have fewer digits.
    return float(((found.double() - expected).abs() / (unit + torch.finfo(torch.float32).tiny)).max())
