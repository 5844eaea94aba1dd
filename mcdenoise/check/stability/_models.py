"""Errors of networks, and derivatives, on unusual frames."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from mcdenoise.check.case import DTYPES
from mcdenoise.check.stability._check import Check, bounded
from mcdenoise.check.stability._frames import ALLOWED, PATTERNS, relative_change, shots
from mcdenoise.check.stability._rounding import Rounded
from mcdenoise.frame import Frame
from mcdenoise.methods import parse_method
from mcdenoise.models import Accumulated, Skipping
from mcdenoise.models._wrapper import parts_of
from mcdenoise.ops import use

_LEAST_RADIANCE = 1e-30
_SIZE = (8, 9)
# A network sees neither, and invalid pixels are repaired before.
_UNSEEN = ("motion", "position", "mask", "void")


def frames() -> dict[str, Frame]:
    """The first frames of the shots that a network may see, in float32, with a history."""
    g, found = torch.Generator().manual_seed(0), {}
    for name, (first, *_) in shots(torch.float32, _SIZE).items():
        color = first.color
        if name.startswith(_UNSEEN) or not (color.isfinite() & (color >= 0)).all():
            continue
        noise, length = torch.rand(color.shape, generator=g), 30 * torch.rand(color[:, :1].shape, generator=g).round()
        found[name] = first.replace(current=color * noise, length=1 + length)
    return found


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
    model, every = _without_history(whole), frames()
    if not isinstance(model, nn.Module) or not whole.needs.trainable or model(every["ordinary"])[1] is not None:
        return
    exact = copy.deepcopy(model).double()
    for dtype in dtypes:
        for case, frame in every.items():
            if whole.needs.buffers <= frame.buffers:
                yield from _check_case(model, exact, frame, (name, case, dtype))


def _without_history(model: Any) -> Any:
    """The model inside the accumulation; it takes an accumulated color and its history length, like those of a case."""
    for accumulated in parts_of(model, Accumulated):
        inner = accumulated.inner
        return inner.inner if isinstance(inner, Skipping) else inner
    return model


def _image(model: nn.Module, frame: Frame) -> Tensor:
    image: Tensor = model(frame)[0].image
    return image


def _check_case(
    model: nn.Module, double: nn.Module, frame: Frame, about: tuple[str, str, torch.dtype]
) -> Iterator[Check]:
    """Check that gradients are finite, and compare the image with float64."""
    color, dtype = frame.color.clone().requires_grad_(), about[2]
    with torch.autocast("cpu", dtype, enabled=dtype != torch.float32):
        found = _image(model, frame.replace(color=color))
    parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
    # Differentiate the image relative to its brightness, so that bright images do not overflow the sum; the minimum is
    # 1e-30, as in `auto_exposure`.
    scale = max(float(frame.color.max()), _LEAST_RADIANCE) if frame.color.any() else 1.0
    gradients = torch.autograd.grad((found / scale).sum(), [color, *parameters], allow_unused=True)
    finite = all(bool(torch.isfinite(gradient).all()) for gradient in gradients if gradient is not None)
    yield bounded(*about, "gradient", message="" if finite else "a gradient is NaN or infinite")
    exact, change = _exact(double, frame.to(torch.float64), dtype)
    eps = torch.finfo(dtype).eps
    error = relative_change(found.detach(), exact) / eps
    yield bounded(*about, "forward", error, ALLOWED * change / eps, 2 * change / eps)


@torch.no_grad()
def _exact(model: nn.Module, frame: Frame, dtype: torch.dtype) -> tuple[Tensor, float]:
    """The image in float64, and how much it changes at most when each step is rounded, in several experiments."""
    # Everything except convolutions is in float32.
    rounded = Rounded(torch.float32, torch.finfo(torch.float32).eps / 2, convolutions=torch.finfo(dtype).eps / 2)
    copies = frame.map(lambda image: rounded.rounded(image.repeat(PATTERNS, *(1,) * (image.ndim - 1))))
    # Like the image, also where a batch is large enough for another backend.
    with use("torch"):
        image = _image(model, frame)
        with rounded:
            changed = _image(model, copies)
    largest = max(relative_change(each, image) for each in changed.split(1))
    return image, max(largest, torch.finfo(torch.float32).eps)
