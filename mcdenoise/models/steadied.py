"""The last step of a method that denoises every frame by itself: its result of the frame before is blended in.

As temporal anti-aliasing does (Karis 2014, "High-Quality Temporal Supersampling"), where the light is still the same:
where highlights, reflections or shadows have moved on, it differs from this frame by more than noise explains. Nothing
is learnt: what a network learnt of some hundred clips to do here was to trust the frame before too much.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.models._interface import Needs, Output, State
from mcdenoise.models._layers import answered
from mcdenoise.models.recurrent import PREVIOUS, PREVIOUS_LIGHT, PREVIOUS_WEIGHT
from mcdenoise.models.with_oidn import EXACT, NOISY
from mcdenoise.nn.oidn import oidn_exposure

# Sides of the squares over which the result before is compared with this frame, and how much a difference of as much as
# single samples deviate takes from the logarithm of its weight.
_WINDOWS, _DOUBTS = (3, 15), (4.0, 12.0)
# The same sums in fewer steps: over 3 pixels, and of 5 such sums that are 3 pixels apart.
_SUMS = {3: ((3, 1),), 15: ((3, 1), (5, 3))}
_LEAST_NOISE = 0.02  # that single samples deviate by, in parts of their mean
_LEAST_MEAN = 0.01  # of what differences are parts, where the typical radiance of the image is 0.18


class Steadied(nn.Module):
    """Blends a denoised image, and the result of the frame before where its light is still the same.

    ``result = (color + n previous) / (1 + n)`` with ``n = history same exp(-sum_s c_s d_s / noise)``: ``same`` is how
    much of the frame before shows the same surface; d are the differences of the means over 3x3 and 15x15 pixels, and
    noise the mean deviation of single samples over 15x15, all in parts of the mean. The frame before is taken without
    its albedo and with this frame's where that is exact.

    It stands in :class:`mcdenoise.models.Recurrent`, and finds ``noisy`` and ``exact`` of
    :class:`mcdenoise.models.with_oidn.WithOidn` in ``frame.extra``.

    Args:
        history: parts of the result before for each of this frame, where nothing speaks against it; above 0.

    Raises:
        InputError: ``history`` is not above 0.
    """

    def __init__(self, history: float = 10.0) -> None:
        super().__init__()
        if not 0 < history < math.inf:
            raise InputError(f"history: expected above 0, found {history}")
        self.history = history

    @property
    def needs(self) -> Needs:
        """Color; of use is what it blends."""
        uses = frozenset({NOISY, EXACT, PREVIOUS, PREVIOUS_LIGHT, PREVIOUS_WEIGHT})
        return Needs(uses=uses, trainable=False, reach=max(_WINDOWS) // 2)

    @property
    def persistence(self) -> float:
        """What one more frame leaves of the results before, see :func:`mcdenoise.models.frames_remembered`."""
        return self.history / (1 + self.history)

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """The exposure of the whole image."""
        return {"oidn_exposure": oidn_exposure(frame.color)}

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        exposure = (frame.statistics or self.statistics(frame))["oidn_exposure"]
        image = frame.color
        noisy = frame.extra.get(NOISY, image)
        exact = frame.extra.get(EXACT, torch.zeros_like(image[:, :1]))
        same = frame.extra.get(PREVIOUS_WEIGHT, torch.zeros_like(exact))
        # What is textured stays sharp with an exact albedo, and gets the noise of another.
        before = torch.where(exact > 0, frame.extra.get(PREVIOUS_LIGHT, image), frame.extra.get(PREVIOUS, image))

        # In units of the image: to multiply it with its exposure would round it once more.
        least = _LEAST_MEAN / exposure
        noise = _relative(noisy, image, torch.ones_like(same), max(_WINDOWS), least, inside=True) + _LEAST_NOISE
        n = self.history * same
        for window, doubt in zip(_WINDOWS, _DOUBTS, strict=True):
            n = n * torch.exp(-doubt * _relative(before, image, same, window, least) / noise)
        return answered(frame, torch.lerp(image, before, n / (1 + n)), None), None


def _relative(
    image: Tensor, other: Tensor, counted: Tensor, window: int, least: Tensor, *, inside: bool = False
) -> Tensor:
    """How far two images are apart over a window: their means, or (``inside``) their pixels; in parts of the mean."""
    both = torch.cat([(image - other).abs(), other] if inside else [image, other], 1) * counted
    a, b, count = _means(torch.cat([both, counted], 1), window).split([3, 3, 1], 1)
    apart = (a if inside else (a - b).abs()).mean(1, keepdim=True)
    typical = (b if inside else (a + b) / 2).mean(1, keepdim=True)
    relative: Tensor = apart / (typical + least * (count + 1e-4))
    return relative


def _means(image: Tensor, window: int) -> Tensor:
    """Means over the square around each pixel, with zeros beyond the border."""
    image = F.pad(image, [window // 2] * 4)
    for axis in (-1, -2):
        for taps, apart in _SUMS[window]:
            length = image.shape[axis] - (taps - 1) * apart
            first, *others = (image.narrow(axis, i * apart, length) for i in range(taps))
            image = sum(others, first)
    return image / window**2
