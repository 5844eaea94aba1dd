"""Which rectangles of an image to compute, where not all of it is asked for."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import torch.nn.functional as F
from torch import Tensor

# Rectangles begin and end at multiples of this.
TILE = 32
# A network on more than this share of the image costs as much as on all of it.
_WORTHWHILE = 0.9


class Region(NamedTuple):
    """A rectangle of an image, in pixels; ``bottom`` and ``right`` are outside."""

    top: int
    left: int
    bottom: int
    right: int

    def of(self, image: Tensor) -> Tensor:
        """That part of ``(..., H, W)``."""
        return image[..., self.top : self.bottom, self.left : self.right]

    def grown(self, margin: int, size: tuple[int, int]) -> Region:
        """With a margin on all sides, as far as the image goes."""
        height, width = size
        return Region(
            max(self.top - margin, 0),
            max(self.left - margin, 0),
            min(self.bottom + margin, height),
            min(self.right + margin, width),
        )

    def within(self, around: Region) -> Region:
        """The same pixels, counted from the corner of a larger rectangle."""
        return Region(*(side - start for side, start in zip(self, (around.top, around.left) * 2, strict=True)))

    def halved(self) -> Region:
        """The pixels of the image at half its size that have any of these in them."""
        return Region(self.top // 2, self.left // 2, -(-self.bottom // 2), -(-self.right // 2))

    def split(self, side: int) -> list[Region]:
        """In tiles of about the same size, whose sides are multiples of 32 pixels, and no longer than ``side``.

        Args:
            side: a multiple of 32 pixels.
        """
        rows, columns = _steps(self.top, self.bottom, side), _steps(self.left, self.right, side)
        return [Region(top, left, bottom, right) for top, bottom in pairwise(rows) for left, right in pairwise(columns)]

    @property
    def pixels(self) -> int:
        """How many there are."""
        return (self.bottom - self.top) * (self.right - self.left)


def _steps(start: int, end: int, longest: int) -> list[int]:
    count = -(-(end - start) // longest)
    step = -(-(end - start) // (count * TILE)) * TILE
    return [*range(start, end, step), end]


def regions(needed: Tensor, halo: int) -> list[Region]:
    """Rectangles that hold all pixels that are needed; the whole image where computing less would hardly pay.

    Args:
        needed: ``(B, 1, H, W)`` true where a result is asked for, in any image of the batch.
        halo: how far around a rectangle the network has to look, in pixels.

    Returns:
        Rectangles that do not overlap, without the halo; none where nothing is needed.
    """
    size = height, width = needed.shape[-2], needed.shape[-1]
    padded = F.pad(needed[:, 0], (0, -width % TILE, 0, -height % TILE))
    # Pooling would be of floats, in twice the time.
    tiles = padded.reshape(len(needed), padded.shape[1] // TILE, TILE, -1, TILE).any(2).any(3).any(0)
    boxes = [
        Region(top * TILE, left * TILE, min(bottom * TILE, height), min(right * TILE, width))
        for top, left, bottom, right in _boxes(tiles, -(-2 * halo // TILE))
    ]
    cost = sum(box.grown(halo, size).pixels for box in boxes)
    return [Region(0, 0, height, width)] if cost > _WORTHWHILE * height * width else boxes


def halved(parts: list[Region], margin: int, size: tuple[int, int]) -> list[Region]:
    """Rectangles of an image at half its size, no longer than ``parts``, that hold these with a margin around them.

    Args:
        parts: rectangles of the image.
        margin: in pixels of the image.
        size: of the image, height and width.
    """
    if not parts:
        return []
    tops, lefts, bottoms, rights = zip(*parts, strict=True)
    box = Region(min(tops), min(lefts), max(bottoms), max(rights)).grown(margin, size).halved()
    end = Region(0, 0, *size).halved()
    box = Region(
        box.top // TILE * TILE,
        box.left // TILE * TILE,
        min(-(-box.bottom // TILE) * TILE, end.bottom),
        min(-(-box.right // TILE) * TILE, end.right),
    )
    longest = max(max(part.bottom - part.top, part.right - part.left) for part in parts)
    return box.split(-(-longest // TILE) * TILE)


def _boxes(tiles: Tensor, gap: int) -> list[Region]:
    """Boxes around groups of tiles; groups whose halos touch are one."""
    boxes = [Region(y, x, y + 1, x + 1) for y, x in tiles.nonzero().tolist()]
    merged = True
    while merged:
        merged, left = False, boxes
        boxes = []
        for box in left:
            near = next((i for i, other in enumerate(boxes) if _near(box, other, gap)), None)
            if near is None:
                boxes.append(box)
                continue
            other, merged = boxes[near], True
            boxes[near] = Region(
                min(box.top, other.top),
                min(box.left, other.left),
                max(box.bottom, other.bottom),
                max(box.right, other.right),
            )
    return boxes


def _near(a: Region, b: Region, gap: int) -> bool:
    rows = a.top <= b.bottom + gap and b.top <= a.bottom + gap
    return rows and a.left <= b.right + gap and b.left <= a.right + gap
