"""The identity, and accumulation alone: the baselines of every comparison."""

from __future__ import annotations

import math

from torch import nn

from mcdenoise.frame import Frame
from mcdenoise.models._interface import Model, Needs, Output, State
from mcdenoise.models._layers import answered, carried
from mcdenoise.models._registry import register_model
from mcdenoise.models.accumulated import Accumulated
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.ops.lag import THRESHOLD


@register_model("noisy", kind="filter")
class Noisy(nn.Module):
    """Returns the frame's color unchanged."""

    def __init__(self) -> None:
        super().__init__()
        self.needs = Needs(trainable=False, reach=0)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        return answered(frame, frame.color, carried(frame)), None


@register_model("accumulated", kind="filter")
def accumulated(*, alpha_min: float = 0.1, anti_lag: bool = True) -> Model:
    """Temporal accumulation without a spatial filter, the first step of ``wild``.

    Args:
        alpha_min: smallest weight of the current frame, see :class:`mcdenoise.models.Accumulated`.
        anti_lag: whether the history is shortened where the light has changed, see :func:`mcdenoise.ops.history_lag`.
    """
    return Demodulated(Accumulated(Noisy(), alpha_min=alpha_min, lag_threshold=THRESHOLD if anti_lag else math.inf))
