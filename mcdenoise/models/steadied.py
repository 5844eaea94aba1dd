"""Stabilization: the last step of a method that denoises frames separately blends in the previous result.

This is temporal anti-aliasing (Karis 2014, "High-Quality Temporal Supersampling") restricted to unchanged light: where
highlights, reflections or shadows have moved, the previous result differs by more than the noise explains. No weights
are learnt; a network trained for this task on some hundred clips trusted the previous frame too much.
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
from mcdenoise.models.recurrent import PREVIOUS, PREVIOUS_LIGHT, PREVIOUS_WEIGHT
from mcdenoise.models.with_oidn import CENTRED, NOISY
from mcdenoise.nn.oidn import oidn_exposure
from mcdenoise.ops._window import accumulator_dtype

# Sides of the windows over which the previous result is compared with this frame, and how much a difference equal to
# the deviation of single samples reduces the logarithm of its weight.
_WINDOWS, _DOUBTS = (3, 15), (2.0, 6.0)
_LEAST_NOISE = 0.02  # smallest deviation of single samples, relative to their mean
_LEAST_MEAN = 0.01  # smallest mean for relative differences; the typical radiance of the image is 0.18


class Steadied(nn.Module):
    """Blends a denoised image with the previous result where the light has not changed.

    ``result = (color + n previous) / (1 + n)`` with ``n = history same exp(-sum_s c_s d_s / noise)``. ``same`` is the
    fraction of the previous frame that shows the same surface; ``d_s`` are the differences of the means over 3x3 and
    15x15 pixels, and ``noise`` is the mean deviation of single samples over 15x15, all relative to the mean.

    The previous result is known in two forms: as it was, which reprojection blurs a little; and demodulated and
    multiplied by this frame's albedo, which is sharp, but has the noise of both albedos. Their mean has a smaller error
    than either. An albedo from rays through the pixels' centres has no noise, so the second form is taken alone.

    It has to be wrapped in :class:`mcdenoise.models.Recurrent`, and takes ``noisy`` and ``centred`` of
    :class:`mcdenoise.models.with_oidn.WithOidn` from ``frame.extra``.

    Args:
        history: weight of the previous result relative to this frame's where the light has not changed; above 0.

    Raises:
        InputError: ``history`` is not above 0.
    """

    def __init__(self, history: float = 4.0) -> None:
        super().__init__()
        if not 0 < history < math.inf:
            raise InputError(f"history: expected above 0, found {history}")
        self.history, self.persistence = history, history / (1 + history)
        uses = frozenset({NOISY, CENTRED, PREVIOUS, PREVIOUS_LIGHT, PREVIOUS_WEIGHT})
        self.needs = Needs(uses=uses, trainable=False, reach=max(_WINDOWS) // 2)

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """The exposure of the whole image."""
        return {"oidn_exposure": oidn_exposure(frame.color)}

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        exposure = (frame.statistics or self.statistics(frame))["oidn_exposure"]
        image = frame.color.to(accumulator_dtype(frame.color.dtype))
        noisy = frame.extra.get(NOISY, image)
        centred = frame.extra.get(CENTRED, torch.zeros_like(image[:, :1]))
        same = frame.extra.get(PREVIOUS_WEIGHT, torch.zeros_like(centred))
        before, light = (frame.extra.get(name, image).to(image.dtype) for name in (PREVIOUS, PREVIOUS_LIGHT))
        before = torch.where(centred > 0, light, (before + light) / 2)

        # In the image's unit, because scaling it by the exposure would add a rounding error.
        least = _LEAST_MEAN / exposure
        noise = _relative(noisy, image, torch.ones_like(same), max(_WINDOWS), least, inside=True) + _LEAST_NOISE
        n = self.history * same
        for window, doubt in zip(_WINDOWS, _DOUBTS, strict=True):
            n = n * torch.exp(-doubt * _relative(before, image, same, window, least) / noise)
        return Output(torch.lerp(image, before, n / (1 + n)).to(frame.color.dtype)), None


def _relative(
    image: Tensor, other: Tensor, counted: Tensor, window: int, least: Tensor, *, inside: bool = False
) -> Tensor:
    """Relative difference of two images over a window: of their means, or with ``inside`` the mean over the pixels."""
    both = torch.cat([(image - other).abs(), other] if inside else [image, other], 1) * counted
    a, b, count = _means(torch.cat([both, counted], 1), window).split([3, 3, 1], 1)
    apart = (a if inside else (a - b).abs()).mean(1, keepdim=True)
    typical = (b if inside else (a + b) / 2).mean(1, keepdim=True)
    relative: Tensor = apart / (typical + least * (count + 1e-4))
    return relative


def _means(image: Tensor, window: int) -> Tensor:
    """Means over the window around each pixel, with zeros outside the image."""
    across = F.avg_pool2d(image, (1, window), 1, (0, window // 2))
    return F.avg_pool2d(across, (window, 1), 1, (window // 2, 0))
