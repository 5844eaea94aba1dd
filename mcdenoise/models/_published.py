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

# Squared distance for the BMFR scene "classroom" in scene units (metres).
POSITION_LIMIT, NORMAL_LIMIT = 0.01, 1.0
# Darker radiance is raised to this value before the power function, whose derivative at zero is infinite.
_DARKEST = 1e-6


def as_published(
    method: Model,
    alpha_min: float = 0.2,
    position_limit: float = POSITION_LIMIT,
    normal_limit: float = NORMAL_LIMIT,
) -> Model:
    """Wrap a method with demodulation and the published accumulation rule (Koskela et al. 2019), and nothing else.

    Diffuse and specular light are accumulated for a method that uses them.

    Args:
        method: any.
        alpha_min: smallest weight of the current frame in the accumulation, in (0, 1].
        position_limit: squared distance in scene units below which two points count as the same point, see
            :func:`mcdenoise.ops.reproject`.
        normal_limit: the same for normals.
    """
    return Demodulated(
        Accumulated(
            method,
            alpha_min=alpha_min,
            rule="bmfr",
            position_limit=position_limit,
            normal_limit=normal_limit,
            firefly_limit=float("inf"),
            specular_length=float("inf"),
            lag_threshold=float("inf"),
            also=[part for part in ("diffuse", "specular") if part in method.needs.uses],
        )
    )


def published(network: Callable[..., Model]) -> Callable[..., Model]:
    """A constructor of a network, or of a chain of tiled ones, behind exposure and :func:`as_published`.

    A model's settings are then those of the network, which determine its weights, and by keyword ``alpha_min``,
    ``position_limit`` and ``normal_limit``.
    """

    @functools.wraps(network, updated=())
    def made(*sizes: Any, **named: Any) -> Model:
        history = {name: named.pop(name) for name in accumulation if name in named}
        inner = network(*sizes, **named)
        return as_published(Exposed(inner if isinstance(inner, Chain) else Tiled(inner)), **history)

    _, *settings = inspect.signature(as_published).parameters.values()
    accumulation = {each.name: each.replace(kind=each.KEYWORD_ONLY) for each in settings}
    own = inspect.signature(network)
    every = [*own.parameters.values(), *accumulation.values()]
    made.__signature__ = own.replace(parameters=every)  # type: ignore[attr-defined]
    return made


def check_odd(kernel_size: int) -> None:
    """Raise ``InputError`` for an even kernel size."""
    if kernel_size < 1 or kernel_size % 2 == 0:
        raise InputError(f"kernel_size: expected odd and at least 1, found {kernel_size}")


class Network(nn.Module):
    """Base of the zoo's networks: what the whole image tells, and the features in [0, 1]."""

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """Exposure and depth scale of the whole image."""
        return image_statistics(frame)

    def features(self, frame: Frame) -> list[Tensor]:
        """Albedo, normal and depth, normalised to the range from 0 to 1 (Sec. 4.2 of the paper)."""
        return unit_features_of(frame.replace(statistics=frame.statistics or self.statistics(frame)))

    def input_of(self, frame: Frame, image: Tensor) -> Tensor:
        """The image, albedo, ``normal / 2 + 1 / 2`` and depth, ``(B, 10, H, W)``."""
        return torch.cat([image, *self.features(frame)], 1)


def displayed(frame: Frame) -> Tensor:
    """Radiance including albedo, gamma-mapped for a display: ``max(x, 1e-6)^(1 / 2.2)``, ``(B, 3, H, W)``."""
    lit = frame.color if frame.albedo is None else remodulate(frame.color, frame.albedo)
    return lit.clamp_min(_DARKEST).pow(1 / 2.2)
