"""A wrapper that divides the albedo out of the radiance before a method, and multiplies it back after it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from mcdenoise.frame import Frame, scale_samples
from mcdenoise.models._interface import Note, Output, State, at_hand
from mcdenoise.models._wrapper import Wrapper
from mcdenoise.ops import NO_ALBEDO, demodulate, remodulate
from mcdenoise.ops._rows import by_rows
from mcdenoise.ops.demodulation import modulation


class Demodulated(Wrapper):
    """Divides the radiance by the albedo, and multiplies every image of the result by it.

    This is skipped for a frame without an albedo, and if the divisor of :func:`mcdenoise.ops.demodulate` is one in
    every pixel and no derivative in the albedo is asked for.

    Args:
        inner: any method. Its frame has demodulated radiance: the color, the color of the current frame, diffuse
            radiance, samples, and the variance. Specular radiance is not demodulated.
    """

    stage = "accumulate"
    takes = frozenset({"albedo"})

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """The statistics of the inner model for the demodulated frame."""
        return super().statistics(frame if _why_not(frame.albedo) else _without_albedo(frame))

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        albedo = frame.albedo
        reason = "" if frame.hints.keep_all and albedo is not None else _why_not(albedo)
        note = Note("demodulate", reason or "albedo", float(reason != ""))
        if albedo is None or reason:
            output, state = self.inner(frame, state)
            return output.noted(note), state
        handed, wanted = [_without_albedo(frame)], frame.hints.stages
        # The method can free the images that it no longer needs: ``nn.Module.__call__`` would keep its arguments.
        del frame
        step = self.inner.forward if isinstance(self.inner, nn.Module) else self.inner
        output, state = step(handed.pop(), state)
        # A network that ends with a convolution returns half precision under autocast.
        return output.lit(partial(remodulated, albedo), stages=wanted).noted(note), state


def _without_albedo(frame: Frame) -> Frame:
    albedo = frame.albedo
    assert albedo is not None
    changes: dict[str, Any] = {
        name: by_rows(demodulate, image, albedo)
        for name in ("color", "current", "recent", "diffuse")
        if (image := frame.buffer(name)) is not None
    }
    changes["layers"] = {name: by_rows(demodulate, layer, albedo) for name, layer in frame.layers.items()}
    if frame.variance is not None:
        # Var(x / a) = Var(x) / a^2.
        changes["variance"] = demodulate(demodulate(frame.variance, albedo), albedo)
    if frame.samples is not None:
        changes["samples"] = scale_samples(frame.samples, 1 / modulation(albedo).to(frame.samples.dtype))
    return frame.replace(**changes)


def remodulated(albedo: Tensor, image: Tensor) -> Tensor:
    """The image, which may be of half precision, multiplied by the albedo in that of the albedo."""
    return by_rows(remodulate, image.to(albedo.dtype), albedo)


def _why_not(albedo: Tensor | None) -> str:
    """Reason for skipping the demodulation; empty if it is needed."""
    if albedo is None:
        return "no albedo"
    # The derivative in an albedo of one is not zero: it is also divided by.
    if not at_hand(albedo.device) or (albedo.requires_grad and torch.is_grad_enabled()):
        return ""
    low, high = (float(value) for value in torch.aminmax(albedo.detach()))
    return "albedo is one everywhere" if low == high == 1 else "no albedo anywhere" if high < NO_ALBEDO else ""
