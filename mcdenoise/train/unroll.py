"""A method over the frames of a clip, with the gradient through its state."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from mcdenoise.models import Model, Output
from mcdenoise.train.clips import Clip
from mcdenoise.train.losses import RESULT


def unroll(model: Model, clip: Clip) -> Output:
    """Denoise the frames of a clip one after the other, from no state on.

    A method that has no state after the first frame has none at all: for it every frame is a first one, and the others
    are computed at once.

    Args:
        model: any method.
        clip: of T frames.

    Returns:
        The image and its stages, ``(B, T, 3, H, W)`` each.

    Raises:
        TypeError: the method has no state after the first frame, and one after a later frame.

    Differentiable in the weights of the method and in the clip, through the state.
    """
    output, state = model(clip.frame(0))
    found = [_named(output, clip)]
    if state is None and len(clip) > 1:
        output, state = model(clip.frames(1))
        if state is not None:
            raise TypeError("model: expected no state, as after the first frame of the clip, found one")
        found.append(_named(output, clip))
    else:
        for t in range(1, len(clip)):
            output, state = model(clip.frame(t), state)
            found.append(_named(output, clip))
    images = {name: torch.cat([each[name] for each in found], 1) for name in found[0]}
    return Output(images.pop(RESULT), images)


def _named(output: Output, clip: Clip) -> dict[str, Tensor]:
    images = {**output.stages, RESULT: output.image}
    return {name: clip.apart(image) for name, image in images.items()}


class Unrolled(nn.Module):
    """:func:`unroll` as a module of the buffers of a clip: what a device, or several, compute in a step.

    Args:
        model: any method that is a module.
    """

    def __init__(self, model: Model) -> None:
        super().__init__()
        self.model = model

    def forward(self, buffers: Mapping[str, Tensor]) -> Output:
        """Images ``(B, T, 3, H, W)`` of ``(B, T, C, H, W)`` buffers."""
        return unroll(self.model, Clip(dict(buffers)))
