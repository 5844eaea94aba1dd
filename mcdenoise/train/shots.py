"""Shots to cut training clips from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array: TypeAlias = NDArray[Any]


@dataclass(frozen=True)
class Shot:
    """Consecutive frames as input of the network behind the front.

    Args:
        buffers: for each noise seed a function that returns the buffers by name: ``(T, C, H, W)``, and
            ``view_projection`` ``(T, 4, 4)``. One of fewer frames, such as a reference, is that of the last ones.
        frames: indices of the frames of the shot in the buffers.
        size: height and width in pixels.
        referenced: index of the first frame that has a reference.
        demodulated: whether the radiance of the color is demodulated.
    """

    buffers: tuple[Callable[[], Mapping[str, Array]], ...]
    frames: range
    size: tuple[int, int]
    referenced: int = 0
    demodulated: bool = False

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def noise_seeds(self) -> int:
        """Number of noisy colors of a frame."""
        return len(self.buffers)

    @property
    def references(self) -> int:
        """Number of the last frames that have a reference."""
        return max(0, self.frames.stop - max(self.frames.start, self.referenced))

    def cut(self, frames: slice) -> Shot:
        """Select consecutive frames; their history is kept."""
        return replace(self, frames=self.frames[frames])

    def read(
        self,
        frames: slice = slice(None),
        rows: slice = slice(None),
        columns: slice = slice(None),
        *,
        noise_seed: int = 0,
        channels: Mapping[str, list[int]] = {},
        turn: Callable[[Array], Array] = lambda image: image,
    ) -> dict[str, Tensor]:
        """Copy a part of the shot: ``(T, C, H, W)`` float32 by name, and ``view_projection`` ``(T, 4, 4)``.

        The reference is that of the frames that have one; where none has, it is left out.

        Args:
            frames: range of frames.
            rows: range of rows.
            columns: range of columns.
            noise_seed: index of the noise seed.
            channels: for some buffers, the selection and order of channels.
            turn: returns another view of ``(T, C, H, W)``, flipped or rotated.

        Raises:
            InputError: a file is damaged.
        """
        buffers, chosen = self.buffers[noise_seed](), self.frames[frames]
        found = {}
        for name, array in buffers.items():
            lacking = len(buffers["color"]) - len(array)
            part = array[max(chosen.start - lacking, 0) : max(chosen.stop - lacking, 0)]
            if len(part) and part.ndim == 3:
                found[name] = torch.from_numpy(part.astype(np.float32))
            elif len(part):
                # Pixels are moved once, when they are copied.
                found[name] = _copied(turn(part[:, :, rows, columns]), channels.get(name))
        return found


def _copied(image: Array, order: list[int] | None) -> Tensor:
    """Copy channels in this order, by default all, as float32."""
    channels = range(image.shape[1]) if order is None else order
    part = np.empty((image.shape[0], len(channels), *image.shape[2:]), np.float32)
    return torch.from_numpy(np.stack([image[:, i] for i in channels], 1, out=part))
