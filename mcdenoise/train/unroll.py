"""Running a method over the frames of a clip, with gradients through its state."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from mcdenoise.models import Model, Output, State
from mcdenoise.train.clips import Clip
from mcdenoise.train.losses import RESULT


def unroll(model: Model, clip: Clip, *, has_state: bool = True) -> Output:
    """Denoise the frames of a clip one after the other, beginning without a state.

    Args:
        model: any method.
        clip: a clip of T frames.
        has_state: whether the method has a state; without one, all frames are computed at once as first frames, which
            is faster.

    Returns:
        The image and its stages, ``(B, T, 3, H, W)`` each.

    Raises:
        TypeError: the method has a state although ``has_state`` is false.

    Differentiable in the weights of the method and in the clip, through the state.

    Example:
        >>> clip = Clip({"color": torch.rand(2, 4, 3, 8, 8)})
        >>> unroll(lambda frame, state=None: (Output(frame.color), None), clip).image.shape
        torch.Size([2, 4, 3, 8, 8])
    """
    state: State = None
    found: list[dict[str, Tensor]] = []
    for frame in map(clip.frame, range(len(clip))) if has_state else [clip.frame()]:
        output, state = model(frame, state)
        images = {**output.stages, RESULT: output.image}
        found.append({name: torch.unflatten(image, 0, (clip.batch, -1)) for name, image in images.items()})
    if state is not None and not has_state:
        raise TypeError("model: expected none with a state, found one")
    joined = {name: torch.cat([each[name] for each in found], 1) for name in found[0]}
    return Output(joined.pop(RESULT), joined)


class Unrolled(nn.Module):
    """:func:`unroll` as a module that takes the buffers of a clip, for running on one or several devices.

    Args:
        model: any method that is a module.
        has_state: whether the method has a state.
    """

    def __init__(self, model: Model, *, has_state: bool = True) -> None:
        super().__init__()
        self.model, self.has_state = model, has_state

    def forward(self, buffers: Mapping[str, Tensor]) -> Output:
        """Compute images ``(B, T, 3, H, W)`` from ``(B, T, C, H, W)`` buffers."""
        return unroll(self.model, Clip(dict(buffers)), has_state=self.has_state)
