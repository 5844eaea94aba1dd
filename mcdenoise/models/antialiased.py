"""Temporal anti-aliasing: the previous image is clamped to the colors around each pixel and blended in.

Karis 2014, "High-Quality Temporal Supersampling"; with the settings of Koskela et al. 2019 (BMFR), kernel ``taa``.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.errors import InputError
from mcdenoise.frame import MOTION, Frame
from mcdenoise.models._history import Past, reprojected
from mcdenoise.models._interface import Model, Output, State
from mcdenoise.models._state import own_pair
from mcdenoise.models._wrapper import Wrapper
from mcdenoise.ops._window import accumulator_dtype

_GAMMA = 2.2


class Antialiased(Wrapper):
    """Blends the image of a method with its own reprojected previous result, clamped to the neighbourhood.

    Radiance is gamma-mapped, ``x^(1 / 2.2)``, and mapped back afterwards. It is not clamped at 1, so that the result is
    linear radiance and scales with the exposure. In YCoCg, the previous result is clamped to a range: the mean of the
    range of the 3x3 neighbourhood and the range of its 5-pixel cross. Then ``result = alpha image + (1 - alpha)
    previous``. Surfaces are not compared and cuts are not detected: only the clamp limits the weight of the history.

    Layers and alpha are passed through from the method.

    Args:
        inner: any method.
        alpha: weight of the current image, in (0, 1].

    Raises:
        InputError: ``alpha`` is out of its range.
    """

    stage, whole = "antialias", True
    takes = MOTION | {"view_projection"}

    def __init__(self, inner: Model, *, alpha: float = 0.2) -> None:
        super().__init__(inner)
        if not 0 < alpha <= 1:
            raise InputError(f"alpha: expected in (0, 1], found {alpha}")
        self.alpha, self.persistence = alpha, 1 - alpha

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        inner, shown = own_pair(state, "antialiased")
        output, inner = self.inner(frame, inner)
        dtype = output.image.dtype
        # In half precision the exponents are rounded, too: both powers together were off by 2 %.
        image = _mapped(output.image.to(accumulator_dtype(dtype)))
        before, weight, _ = reprojected(frame, shown, 3, "antialiased")
        low, high = _range(_to_ycocg(image))
        clamped = torch.minimum(torch.maximum(_to_ycocg(before), low), high)
        blended = torch.lerp(_to_rgb(clamped), image, self.alpha).clamp_min(0)
        result = torch.where(weight > 0, blended, image)
        after = inner, Past.of(frame, result, surfaces=False)
        stages = {**output.stages, "denoised": output.image}
        return output._replace(image=(result**_GAMMA).to(dtype), stages=stages), after


def _mapped(image: Tensor) -> Tensor:
    """``x^(1 / 2.2)``, with a finite derivative at 0."""
    least = torch.finfo(image.dtype).tiny
    return torch.where(image > 0, image.clamp_min(least) ** (1 / _GAMMA), 0)


def _to_ycocg(image: Tensor) -> Tensor:
    red, green, blue = image.split(1, 1)
    return torch.cat([red + 2 * green + blue, 2 * (red - blue), 2 * green - red - blue], 1)


def _to_rgb(image: Tensor) -> Tensor:
    bright, orange, green = image.split(1, 1)
    return torch.cat([bright + orange - green, bright + green, bright - orange - green], 1) / 4


def _range(image: Tensor) -> tuple[Tensor, Tensor]:
    """Minimum and maximum of the neighbourhood: means over the 3x3 pixels and their cross; inside the image only."""
    # Negate to get the minimum and the maximum from one max-pooling.
    both = torch.cat([-image, image], 1)
    box = F.max_pool2d(both, 3, 1, 1)
    cross = torch.maximum(F.max_pool2d(both, (1, 3), 1, (0, 1)), F.max_pool2d(both, (3, 1), 1, (1, 0)))
    low, high = ((box + cross) / 2).chunk(2, 1)
    return -low, high
