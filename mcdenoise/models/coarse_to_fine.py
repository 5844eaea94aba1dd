"""A method at several resolutions: each resolution passes its low frequencies to the next finer one."""

from __future__ import annotations

from dataclasses import replace

import torch.nn.functional as F
from torch import Tensor

from mcdenoise.frame import BUFFERS, Frame, Skip
from mcdenoise.models._interface import Model, Needs, Output, State, prepared
from mcdenoise.models._reads import at_hand
from mcdenoise.models._wrapper import Wrapper, parts_of
from mcdenoise.models.tiled import TILE, Tiled
from mcdenoise.ops import downsample
from mcdenoise.ops._steps.network import BLOCK, low_frequencies_of
from mcdenoise.ops._window import corner, up_to_multiple

# The buffers that stay valid when 2x2 pixels are averaged.
_IMAGES = tuple(name for name in BUFFERS if name not in ("motion", "reference"))


class CoarseToFine(Wrapper):
    """The same method, with the same weights, on an image at half its size, at a quarter, and so on.

    Each size passes its low frequencies to the next larger one
    (:func:`mcdenoise.ops._steps.network.low_frequencies_of`). A U-Net sees only about 60 pixels far; at one sample per
    pixel their mean is still noisy, and where light is sparse most of them are black.

    Args:
        inner: a method without a state whose statistics contain the ``exposure`` and the logarithm ``maximum`` of the
            largest exposed radiance, such as :class:`mcdenoise.models.cascaded_v2.PixelNetwork`.
        resolutions: number of sizes; with 1 the method is unchanged.
    """

    def __init__(self, inner: Model, resolutions: int = 3) -> None:
        super().__init__(inner)
        self.resolutions = resolutions
        for tiled in parts_of(self, Tiled):
            # A pixel more, because means are interpolated between adjacent blocks.
            tiled.margin = BLOCK if resolutions > 1 else 0

    @property
    def needs(self) -> Needs:
        """The needs of the method; the reach is that of the coarsest size."""
        needs, factor = super().needs, 1 << (self.resolutions - 1)
        reach = None if needs.reach is None else (needs.reach + BLOCK) * factor
        return replace(needs, reach=reach, stride=needs.stride * factor)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        # Each size would have its own layers, and their combination has no kernels.
        frame = frame.replace(layers={}, hints=frame.hints._replace(alpha=False))
        return Output(self._at(frame if frame.statistics else prepared(self.inner, frame), self.resolutions)), None

    def _at(self, frame: Frame, resolutions: int) -> Tensor:
        skip = None if frame.hints.keep_all or not at_hand(frame.color.device) else frame.skip
        needed = resolutions > 1 and (skip is None or not bool(skip.mask.all()))
        coarse = self._at(_halved(frame), resolutions - 1) if needed else None
        fine = self.inner(frame)[0].image
        if coarse is None:
            return fine
        return low_frequencies_of(fine, coarse, frame.statistics["maximum"], frame.statistics["exposure"])


def _halved(frame: Frame) -> Frame:
    """The frame at half its size, with the unchanged statistics of the whole image."""
    images = {}
    for name, image in frame.items():
        if name in _IMAGES:
            images[name] = downsample(image)
    others = dict.fromkeys(frame.buffers - images.keys() - frame.extra.keys())
    skip = None if frame.skip is None else Skip(_halved_mask(frame.skip.mask), {})
    return frame.replace(**(others | images), extra={}, skip=skip)


def _halved_mask(mask: Tensor) -> Tensor:
    """Halve a mask of pixels that are not needed; a half-size pixel is not needed if none near it is."""
    height, width = mask.shape[-2:]
    needed = up_to_multiple((~mask).float(), TILE)
    tiles = F.max_pool2d(F.max_pool2d(needed, TILE), 3, 1, 1)
    coarse = F.max_pool2d(tiles, 2, ceil_mode=True).bool()
    wide = coarse.repeat_interleave(TILE, -2).repeat_interleave(TILE, -1)
    return ~corner(wide, (height + 1) // 2, (width + 1) // 2)
