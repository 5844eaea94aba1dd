"""A wrapper that clamps fireflies: single pixels that are far brighter than all others around them.

A network that removes noise spreads a firefly over a spot. Where few paths find a small light, many spots add up to an
image that is far brighter than nearly all pixels of the converged one. The clamped image lacks their light.
"""

from __future__ import annotations

import torch

from mcdenoise.frame import Frame
from mcdenoise.models._interface import Needs, Output, State
from mcdenoise.models._journal import timed
from mcdenoise.models._wrapper import Wrapper
from mcdenoise.models.accumulated import CAUSTICS, light_of_fireflies
from mcdenoise.ops._steps.history import incoming

# Fraction of the light up to which bright pixels are fireflies, and from which they are caustics, and the limit of
# fireflies. With one sample a pixel a limit of 15 has a smaller SMAPE in most scenes, but a lower PSNR.
_RARE, _COMMON, _LIMIT = 0.05, 0.15, 30.0


class Clamped(Wrapper):
    """Hands a method frames with clamped fireflies, see :func:`without_fireflies`.

    Args:
        inner: any method.
    """

    @property
    def needs(self) -> Needs:
        """The needs of the inner method; albedo is used, and the limit depends on the whole image."""
        needs = self.inner.needs
        return Needs(needs.buffers, needs.uses | {"albedo"}, needs.trainable, None, needs.stride)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        with timed("clamp", frame.color.device):
            clamped = without_fireflies(frame)
        return self.inner(clamped, state)


def without_fireflies(frame: Frame) -> Frame:
    """The frame with clamped fireflies (:func:`mcdenoise.ops.clamp_fireflies` of the demodulated radiance).

    The limit rises from 30 to 120 with the fraction of the light that fireflies have: the more it is, the more likely
    they are caustics. All other pixels remain as they are.
    """
    light = incoming(frame.color, frame.albedo, torch.inf, compared=False)
    common = ((light_of_fireflies(light) - _RARE) / (_COMMON - _RARE)).clamp(0, 1)
    limit = (_LIMIT * (CAUSTICS / _LIMIT) ** common).reshape(-1, 1, 1, 1).to(light.dtype)
    before, after = (image.sum(1, keepdim=True) for image in (light, incoming(light, None, limit, compared=False)))
    # A quotient of equal numbers is exactly 1. The derivative of 0 / 0 would be NaN.
    lit = before > 0
    factor = torch.where(lit, after / torch.where(lit, before, 1), 1)
    return frame.replace(color=(frame.color * factor).to(frame.color.dtype))
