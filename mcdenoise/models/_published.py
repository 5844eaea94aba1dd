"""What the methods of the paper's comparison have in common: the accumulation before them, and what networks see."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.models._interface import Model
from mcdenoise.models.accumulated import Accumulated
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.nn.inputs import image_statistics, unit_features_of
from mcdenoise.ops import remodulate

# Of the BMFR scene "classroom", squared, in scene units (its world is in metres).
POSITION_LIMIT, NORMAL_LIMIT = 0.01, 1.0
# Darker radiance counts as this before the power, whose derivative at zero is infinite.
_DARKEST = 1e-6


def as_published(
    method: Model, alpha_min: float, position_limit: float, normal_limit: float, *, also: Sequence[str] = ()
) -> Model:
    """A method on demodulated radiance that is accumulated by the published rule (Koskela et al. 2019), and no more.

    Args:
        method: any.
        alpha_min: smallest weight of the current frame in the accumulation.
        position_limit: squared distance in scene units below which two points are one.
        normal_limit: likewise for normals.
        also: see :class:`mcdenoise.models.Accumulated`.
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
            also=also,
        )
    )


def check_odd(kernel_size: int) -> None:
    """``InputError`` for a kernel without a centre."""
    if kernel_size < 1 or kernel_size % 2 == 0:
        raise InputError(f"kernel_size: expected odd and at least 1, found {kernel_size}")


class TenChannels(nn.Module):
    """A network whose input is an image and seven channels of features in [0, 1]."""

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """The depth scale of the whole image."""
        return image_statistics(frame)

    def features(self, frame: Frame) -> list[Tensor]:
        """Albedo, normal and depth, normalised to the range from 0 to 1 (Sec. 4.2 of the paper)."""
        return unit_features_of(frame.replace(statistics=frame.statistics or self.statistics(frame)))

    def input_of(self, frame: Frame, image: Tensor) -> Tensor:
        """The image, albedo, ``normal / 2 + 1 / 2`` and depth, ``(B, 10, H, W)``."""
        return torch.cat([image, *self.features(frame)], 1)


def displayed(frame: Frame) -> Tensor:
    """Demodulated radiance with its albedo, as a display shows it: ``max(x, 1e-6)^(1 / 2.2)``, ``(B, 3, H, W)``."""
    lit = frame.color if frame.albedo is None else remodulate(frame.color, frame.albedo)
    return lit.clamp_min(_DARKEST).pow(1 / 2.2)
