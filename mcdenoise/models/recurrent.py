"""A wrapper that gives a method its own previous image, reprojected to the current frame."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from mcdenoise.frame import MOTION, Frame
from mcdenoise.models._interface import Model, Note, Output, State
from mcdenoise.models._motion import comparable, has_motion, motion_unless_still, surface_before
from mcdenoise.models._state import own_state
from mcdenoise.models._wrapper import Wrapper
from mcdenoise.ops import Surface, demodulate, remodulate, reproject, resample

# Keys in ``frame.extra``: the reprojected previous image, and its weight, the fraction that shows the same surface.
PREVIOUS, PREVIOUS_WEIGHT = "previous", "previous_weight"
PREVIOUS_LIGHT = "previous_light"  # the previous image with the albedo of this frame
_ROUNDED = 8  # largest rounding error of the weight of all four taps, which is 1, in units of eps


class Before(NamedTuple):
    """State after a frame. Zeros are the state before the first frame: their weight is 0.

    Args:
        image: ``(B, C, H, W)`` the channels to reproject; for :class:`Recurrent` 6: the method's image, and the same
            demodulated.
        weight: ``(B, 1, 1, 1)`` 1, or 0 if there was no frame.
        surface: surface of the frame.
        view_projection: ``(B, 4, 4)`` camera of the frame.
    """

    image: Tensor
    weight: Tensor
    surface: Surface
    view_projection: Tensor | None


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
        image, weight, notes = from_before(frame, state, channels=6, sharp=True)
        image, light = image.split(3, 1)
        albedo = frame.buffer(self.albedo)
        light = light if albedo is None else remodulate(light, albedo)
        before = {PREVIOUS: image, PREVIOUS_LIGHT: light, PREVIOUS_WEIGHT: weight}
        handed = frame.replace(extra={**frame.extra, **before})
        output, _ = self.inner(handed)
        light = output.image if albedo is None else demodulate(output.image, albedo)
        return output.noted(*notes), to_be_kept(frame, torch.cat([output.image, light], 1))


def to_be_kept(frame: Frame, image: Tensor) -> Before | None:
    """The state for the next frame from an image ``(B, C, H, W)`` of this frame; ``None`` after the last frame."""
    if not _keeps(frame):
        return None
    surface = Surface(frame.position, frame.normal, frame.depth)
    return Before(image, torch.ones_like(image[:, :1, :1, :1]), surface, frame.view_projection)


def from_before(
    frame: Frame, state: State, channels: int, keeper: str = "recurrent", *, sharp: bool = False
) -> tuple[Tensor, Tensor, tuple[Note, ...]]:
    """Reproject the previous image to this frame.

    Args:
        frame: with a depth, if it can be computed (:meth:`mcdenoise.frame.Frame.with_depth`).
        state: result of :func:`to_be_kept`, or ``None``.
        channels: number of channels of the image.
        keeper: name of the method for messages.
        sharp: whether pixels whose four nearest show the same surface are resampled by bicubic interpolation.

    Returns:
        ``(B, channels, H, W)`` image, and ``(B, 1, H, W)`` in [0, 1] the fraction that shows the same surface; both are
        zero in a first frame, after a change of the image size, and without motion. Notes about the history.

    Raises:
        InputError: the state belongs to another method.
    """
    before = own_state(state, Before, frame, channels=channels, keeper=keeper)
    shape = (frame.color.shape[0], channels, *frame.size)
    if before is None:
        return _nothing(frame, shape, "first frame")
    if before.image.shape != shape:
        return _nothing(frame, shape, "size change")
    if not has_motion(frame, before.view_projection):
        return _nothing(frame, shape, "no motion")
    motion = motion_unless_still(frame, before.view_projection)
    found, weight = reproject(before.image, motion, *comparable(surface_before(frame), before.surface))
    if sharp and motion is not None:
        whole = weight > 1 - _ROUNDED * torch.finfo(weight.dtype).eps
        found = torch.where(whole, resample(before.image, motion), found)
    weight = weight * before.weight
    return found, weight, _notes(frame, "", weight.mean())


def _nothing(frame: Frame, shape: tuple[int, ...], reset: str) -> tuple[Tensor, Tensor, tuple[Note, ...]]:
    """The result of :func:`from_before` without a previous image, for the reason ``reset``."""
    return frame.color.new_zeros(shape), torch.zeros_like(frame.color[:, :1]), _notes(frame, reset, 0.0)


def _keeps(frame: Frame) -> bool:
    return frame.hints.keep_all or not frame.hints.last


def _notes(frame: Frame, reset: str, history: float | Tensor) -> tuple[Note, ...]:
    keeps = _keeps(frame)
    return (
        Note("history", reset, value=history),
        Note("reproject", reset or "the image of the frame before", float(reset != "")),
        Note("remember", "for the next frame" if keeps else "last frame", float(not keeps)),
    )
