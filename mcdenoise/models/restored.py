"""A wrapper that gives back the detail that a method has smoothed.

What a denoiser removes, ``n = color - image``, is noise and, where it smooths too much, detail. The two are told apart
by their correlation: the noise of different pixels is independent, apart from neighbours under a renderer's pixel
filter, while detail continues over several pixels. Such tests of the whiteness of the residual tell how far a
restoration may go (Almeida and Figueiredo 2013, "Parameter Estimation for Blind and Non-Blind Deblurring Using Residual
Whiteness Measures", IEEE Transactions on Image Processing 22). No weights are learnt.
"""

from __future__ import annotations

from dataclasses import replace
from math import lcm

import torch

from mcdenoise.frame import Frame
from mcdenoise.models._interface import Needs, Output, State
from mcdenoise.models._wrapper import Wrapper
from mcdenoise.ops._steps.residual import CELL, REACH, weight_of_noisy


class Restored(Wrapper):
    """Blends the noisy color into the result of a method as far as what it removed is correlated, so is not noise.

    ``result = image + w (color - image)``. With the relative difference ``r = (color - image) / mean(image)``, the mean
    over 3x3 pixels, ``A`` the mean of ``r(x)^2`` over a window of 28x28 pixels, ``C`` that of ``r(x) r(x + 2 pixels)``
    over rows and columns, and ``s`` the standard deviation of ``C`` if ``r`` is independent, the weight is
    ``w = clamp(4 (C - 3 s) / A, 0, 1)``. Layers and alpha are blended with the same weights.

    Args:
        inner: any method.
    """

    stage = "restore"

    @property
    def needs(self) -> Needs:
        """The needs of the inner method; windows add to its reach."""
        needs = super().needs
        reach = None if needs.reach is None else needs.reach + REACH
        return replace(needs, reach=reach, stride=lcm(needs.stride, CELL))

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        output, state = self.inner(frame, state)
        weight = weight_of_noisy(frame.color, output.image)
        layers = {name: torch.lerp(layer, frame.layers[name], weight) for name, layer in output.layers.items()}
        alpha = None if output.alpha is None or frame.alpha is None else output.alpha.lerp(frame.alpha, weight)
        image = torch.lerp(output.image, frame.color, weight)
        return output._replace(image=image, layers=layers, alpha=alpha), state
