"""Shots to cut training clips from."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, Self, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array: TypeAlias = NDArray[Any]


class Shot(ABC):
    """Consecutive frames on disk, as input of the network behind the front."""

    @property
    @abstractmethod
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""

    @property
    @abstractmethod
    def noise_seeds(self) -> int:
        """Number of noisy colors of a frame."""

    @property
    @abstractmethod
    def references(self) -> int:
        """Number of the last frames that have a reference."""

    @property
    @abstractmethod
    def demodulated(self) -> bool:
        """Whether the radiance of the color is demodulated."""

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def cut(self, frames: slice) -> Self:
        """Select consecutive frames; their history is kept."""

    @abstractmethod
    def views(self, frames: slice, rows: slice, columns: slice, noise_seed: int) -> Mapping[str, Array]:
        """A part of each buffer, not copied where it need not be; the reference only of frames that have one."""

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
        found = self.views(frames, rows, columns, noise_seed)
        # Pixels are moved once, when they are copied.
        return {
            name: _copied(view if view.ndim == 3 else turn(view), channels.get(name)) for name, view in found.items()
        }


def _copied(image: Array, order: list[int] | None) -> Tensor:
    """Copy channels in this order, by default all, as float32."""
    if image.ndim == 3:
        return torch.from_numpy(image.astype(np.float32))
    channels = range(image.shape[1]) if order is None else order
    part = np.empty((image.shape[0], len(channels), *image.shape[2:]), np.float32)
    return torch.from_numpy(np.stack([image[:, i] for i in channels], 1, out=part))
