"""A wrapper that gives a method its own previous image, reprojected to the current frame."""

from __future__ import annotations

import torch
from torch import nn

from mcdenoise.frame import MOTION, Frame
from mcdenoise.models._history import Past, reprojected
from mcdenoise.models._interface import Model, Output, State
from mcdenoise.models._wrapper import Wrapper
from mcdenoise.ops import demodulate, remodulate

# Keys in ``frame.extra``: the reprojected previous image, and its weight, the fraction that shows the same surface.
PREVIOUS, PREVIOUS_WEIGHT = "previous", "previous_weight"
PREVIOUS_LIGHT = "previous_light"  # the previous image with the albedo of this frame


class Recurrent(Wrapper):
    """Provides a method with its own previous image, reprojected.

    The method finds it in ``frame.extra``, ``(B, 3, H, W)`` each, 0 where no tap shows the same surface:

    - ``previous``: the image. Where one of the four nearest pixels shows another surface, every reprojection blurs it a
      little more; elsewhere :func:`mcdenoise.ops.resample` keeps it sharp.
    - ``previous_light``: the demodulated image multiplied by the albedo of this frame. Textures stay sharp; but an
      albedo of few samples per pixel adds its own noise.

    ``previous_weight`` ``(B, 1, H, W)`` in [0, 1] is the fraction that shows the same surface, see
    :func:`mcdenoise.ops.reproject`; it is 0 in the first frame and without motion. A method that blends its image with
    these does not flicker and has the noise of many frames; it is trained on clips to detect where they no longer hold.

    Args:
        inner: a method without a state.
        albedo: name of the buffer that images are demodulated with; a frame without it is not demodulated.
    """

    stage, whole = "accumulate", True
    takes = MOTION | {"view_projection", "normal", "depth"}
    gives = frozenset({PREVIOUS, PREVIOUS_LIGHT, PREVIOUS_WEIGHT})

    def __init__(self, inner: Model, *, albedo: str = "albedo") -> None:
        super().__init__(inner)
        self.albedo = albedo

    @property
    def persistence(self) -> float | None:
        """``None``, unknown, unless the inner method declares it."""
        inside = self.inner.modules() if isinstance(self.inner, nn.Module) else ()
        return 0.0 if any(hasattr(each, "persistence") for each in inside) else None

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        frame = frame.with_depth()
        # The image, and the same demodulated.
        image, weight, notes = reprojected(frame, state, 6, "recurrent", sharp=True)
        image, light = image.split(3, 1)
        albedo = frame.buffer(self.albedo)
        light = light if albedo is None else remodulate(light, albedo)
        before = {PREVIOUS: image, PREVIOUS_LIGHT: light, PREVIOUS_WEIGHT: weight}
        handed = frame.replace(extra={**frame.extra, **before})
        output, _ = self.inner(handed)
        light = output.image if albedo is None else demodulate(output.image, albedo)
        return output.noted(*notes), Past.of(frame, torch.cat([output.image, light], 1))
