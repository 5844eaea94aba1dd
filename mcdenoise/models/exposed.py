"""A wrapper that scales typical radiance to a standard value before a method, and back after it."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from mcdenoise.errors import InputError
from mcdenoise.frame import RADIANCE, Frame, Skip, scale_samples
from mcdenoise.models._interface import Model, Output, State, prepared
from mcdenoise.models._wrapper import Wrapper, parts_of
from mcdenoise.models.accumulated import Accumulated
from mcdenoise.models.recurrent import Recurrent
from mcdenoise.nn.inputs import auto_exposure


class Exposed(Wrapper):
    """Multiplies the radiance by :func:`mcdenoise.nn.auto_exposure`, and divides every image of the result by it.

    This makes a method independent of the unit of radiance: ``model(s x) = s model(x)``, also for a black image, to
    which it adds less than 1e-18 of what the method does.

    Args:
        inner: any method but one that keeps radiance for the next frame, whose exposure is another.

    Raises:
        InputError: an :class:`mcdenoise.models.Accumulated` or :class:`mcdenoise.models.Recurrent` is inside.
    """

    def __init__(self, inner: Model) -> None:
        super().__init__(inner)
        for part in parts_of(self.inner, Wrapper):
            if isinstance(part, Accumulated | Recurrent):
                name = type(part).__name__
                raise InputError(
                    f"Exposed: expected no {name} inside, whose history would have the exposure of earlier frames; "
                    f"put it around: {name}(Exposed(...))"
                )

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """The exposure, and the statistics of the inner model for the exposed frame."""
        # Black has no unit: what the method sees in it is black in any.
        lit = frame.color.amax((1, 2, 3), keepdim=True) > 0
        exposure = torch.where(lit, auto_exposure(frame.color), torch.finfo(frame.color.dtype).max ** 0.5)
        return {**super().statistics(_exposed(frame, exposure)), "exposure": exposure}

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        if "exposure" not in frame.statistics:
            frame = prepared(self, frame)
        exposure = frame.statistics["exposure"]
        output, state = self.inner(_exposed(frame, exposure), state)
        return output.lit(lambda image: image / exposure, stages=frame.hints.stages), state


def _exposed(frame: Frame, exposure: Tensor) -> Frame:
    """The frame in its own unit of light, in which its exposure is 1."""
    return scaled(frame, exposure).replace(statistics={**frame.statistics, "exposure": torch.ones_like(exposure)})


def scaled(frame: Frame, factor: Tensor) -> Frame:
    """The frame with all of its light multiplied by a factor, ``(B, 1, H, W)`` or ``(B, 1, 1, 1)``."""
    light = {name: image * factor for name, image in frame.items() if name in RADIANCE}
    samples = None if frame.samples is None else scale_samples(frame.samples, factor)
    variance = None if frame.variance is None else frame.variance * factor * factor
    skip = None if frame.skip is None else Skip(frame.skip.mask, frame.skip.image * factor)
    layers = {name: layer * factor for name, layer in frame.layers.items()}
    return frame.replace(**light, samples=samples, variance=variance, layers=layers, skip=skip)
