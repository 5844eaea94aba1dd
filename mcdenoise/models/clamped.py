"""A wrapper that clamps fireflies: single pixels that are far brighter than all others around them, in one frame only.

A network that removes noise spreads a firefly over a spot. Where few paths find a small light, many spots add up to an
image that is far brighter than nearly all pixels of the converged one. The clamped image lacks their light.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from mcdenoise.frame import Frame
from mcdenoise.models._fireflies import GAIN, believed, clamped_fraction, light_of, light_of_fireflies, with_light
from mcdenoise.models._interface import Note, Output, State
from mcdenoise.models._motion import motion_to_previous
from mcdenoise.models._state import own_pair, own_state
from mcdenoise.models._wrapper import Wrapper
from mcdenoise.models.accumulated import CAUSTICS
from mcdenoise.noise import noise_of
from mcdenoise.ops._steps.history import incoming

# Fraction of the light up to which bright pixels are fireflies, and from which they are caustics, and the limit of
# fireflies. With one sample a pixel a limit of 15 has a smaller SMAPE in most scenes, but a lower PSNR.
_RARE, _COMMON, _LIMIT = 0.05, 0.15, 30.0
# Level of noise below which a bright pixel is no firefly: where pixels vary by less than some two per cent.
_CLEAN = 0.004


class Kept(NamedTuple):
    """What is known of the frame before.

    Args:
        light: ``(B, 1, H, W)`` how much of its demodulated radiance was believed to last.
        view_projection: ``(B, 4, 4)`` its camera.
    """

    light: Tensor
    view_projection: Tensor | None


class Clamped(Wrapper):
    """Hands a method frames with clamped fireflies, see :func:`without_fireflies`.

    Light that is there in frame after frame is none. Nor is a bright pixel of a frame that has hardly any noise. The
    method does not see such light, which it would take for noise: it is added to the image as it is.

    Args:
        inner: any method.
    """

    stage, whole = "clamp", True
    takes = frozenset({"albedo"})
    persistence = 1 / GAIN  # of the limit's lack

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        kept, inner = own_pair(state, "clamped")
        before = own_state(kept, Kept, frame, channels=1)
        clamped, steady_light, after, note = _clamped(frame, before)
        output, inner = self.inner(clamped, inner)
        output = output._replace(image=output.image + steady_light.to(output.image.dtype)).noted(note)
        return output, None if after is None and inner is None else (after, inner)


def without_fireflies(frame: Frame) -> Frame:
    """The frame with clamped fireflies (:func:`mcdenoise.ops.clamp_fireflies` of the demodulated radiance).

    The limit rises from 30 to 120 with the fraction of the light that fireflies have: the more it is, the more likely
    they are caustics. All other pixels remain as they are, and all of them do in a frame with hardly any noise.
    """
    clamped, clean, _, _ = _clamped(frame, None)
    return frame.replace(color=clamped.color + clean)


def _clamped(frame: Frame, kept: Kept | None) -> tuple[Frame, Tensor, Kept | None, Note]:
    """The frame with clamped fireflies, the light that the clamp took and that is none, what to keep, and a note."""
    light = incoming(frame.color, frame.albedo, torch.inf, compared=False)
    common = ((light_of_fireflies(light) - _RARE) / (_COMMON - _RARE)).clamp(0, 1)
    limit = (_LIMIT * (CAUSTICS / _LIMIT) ** common).reshape(-1, 1, 1, 1).to(light.dtype)
    clamped = incoming(light, None, limit, compared=False)
    full, least = light_of(light), light_of(clamped)
    # What the neighbours of a bright pixel have in the mean takes its place, as its own light is no noise of theirs.
    without = with_light(frame.color.detach(), full.detach(), torch.where(least < full, least / limit, full).detach())
    clean = noise_of(without, frame.albedo, frame.normal).level < _CLEAN
    before = None if kept is None or kept.light.shape != full.shape else kept
    motion = None if before is None else motion_to_previous(frame, before.view_projection)
    lasting = believed(full, least, limit, None if before is None else before.light, motion)
    after = torch.where(clean, full, torch.maximum(lasting, least))
    color, bright = with_light(frame.color, full, least), with_light(frame.color, full, after)
    note = Note("fireflies", value=clamped_fraction(frame.color, bright))
    keeps = frame.hints.keep_all or not frame.hints.last
    kept = Kept(torch.where(clean, full.detach(), lasting), frame.view_projection) if keeps else None
    return frame.replace(color=color), bright - color, kept, note
