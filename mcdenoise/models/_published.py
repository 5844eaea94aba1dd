"""Common parts of the methods in the paper's comparison: the accumulation before them, and the network input."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.models._interface import Model
from mcdenoise.models.accumulated import Accumulated
from mcdenoise.models.chain import Chain
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.models.exposed import Exposed
from mcdenoise.models.tiled import Tiled
from mcdenoise.nn.inputs import image_statistics, unit_features_of
from mcdenoise.ops import remodulate

# Darker radiance is raised to this value before the power function, whose derivative at zero is infinite.
_DARKEST = 1e-6
# The published smallest weight of the current frame in the accumulation.
ALPHA = 0.2


def as_published(method: Model, alpha_min: float = ALPHA) -> Model:
    """Wrap a method with demodulation and the published accumulation (Koskela et al. 2019), and nothing else.

    The weights are the published ones. The consistency test is that of :func:`mcdenoise.ops.reproject`, whose limits
    are relative to the depth: those of the authors are in scene units, chosen for each scene, and need positions.

    Diffuse and specular light are accumulated for a method that uses them.

    Args:
        method: any.
        alpha_min: smallest weight of the current frame in the accumulation, in (0, 1].
    """
    return Demodulated(
        Accumulated(
            method,
            alpha_min=alpha_min,
            firefly_limit=float("inf"),
            specular_length=float("inf"),
            lag_threshold=float("inf"),
            also=[part for part in ("diffuse", "specular") if part in method.needs.uses],
        )
    )


def behind(wrap: Callable[..., Model], method: Callable[..., Model]) -> Callable[..., Model]:
    """A constructor of a method inside wrappers: its settings are the method's and, by keyword, those of the wrappers.

    Args:
        wrap: puts wrappers around a method; its keyword-only arguments are settings.
        method: a constructor, whose settings determine the weights.
    """
    own = inspect.signature(method)
    added = [each for each in inspect.signature(wrap).parameters.values() if each.kind is each.KEYWORD_ONLY]

    @functools.wraps(method, updated=())
    def made(*sizes: Any, **named: Any) -> Model:
        around = {each.name: named.pop(each.name) for each in added if each.name in named}
        return wrap(method(*sizes, **named), **around)

    made.__signature__ = own.replace(parameters=[*own.parameters.values(), *added])  # type: ignore[attr-defined]
    return made


def published(network: Callable[..., Model]) -> Callable[..., Model]:
    """A constructor of a network, or of a chain of tiled ones, behind exposure and :func:`as_published`."""

    def wrap(inner: Model, *, alpha_min: float = ALPHA) -> Model:
        return as_published(Exposed(inner if isinstance(inner, Chain) else Tiled(inner)), alpha_min)

    return behind(wrap, network)


def check_odd(kernel_size: int) -> None:
    """Raise ``InputError`` for an even kernel size."""
    if kernel_size < 1 or kernel_size % 2 == 0:
        raise InputError(f"kernel_size: expected odd and at least 1, found {kernel_size}")


class Network(nn.Module):
    """Base of the zoo's networks: what the whole image tells, and the features in [0, 1]."""

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """Exposure and depth scale of the whole image."""
        return image_statistics(frame)

    def input_of(self, frame: Frame, image: Tensor) -> Tensor:
        """The image, albedo, ``normal / 2 + 1 / 2`` and depth in [0, 1] (Sec. 4.2 of the paper), ``(B, 10, H, W)``."""
        return torch.cat([image, *unit_features_of(frame)], 1)


def displayed(frame: Frame) -> Tensor:
    """Radiance including albedo, gamma-mapped for a display: ``max(x, 1e-6)^(1 / 2.2)``, ``(B, 3, H, W)``."""
    lit = frame.color if frame.albedo is None else remodulate(frame.color, frame.albedo)
    return lit.clamp_min(_DARKEST).pow(1 / 2.2)
