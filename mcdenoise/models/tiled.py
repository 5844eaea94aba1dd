"""A method in tiles: as small as memory wants them, and only where a result is asked for."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.frame import BUFFERS, Frame
from mcdenoise.models._interface import Model, Note, Output, State, at_hand, prepared
from mcdenoise.models._wrapper import Wrapper
from mcdenoise.ops._window import mirrored

# Rectangles begin and end at multiples of this.
TILE = 32
# A method on more than this fraction of the image costs as much as on all of it.
_WORTHWHILE = 0.9
# Width of the mirror image around an image, at least. Convolutions take what is beyond their input as black: without a
# border the corners of a constant image are off by 60 % (a network like that of wild), and pixels at the edge have 1.3
# times the error. Twice the width gains nothing more.
MIRRORED = 16


class Tiled(Wrapper):
    """Runs a method on tiles of the image, each with a margin of the pixels on which it depends.

    The result is that of the whole image, up to the rounding of convolutions, whose order of summation may depend on
    the size of the image. Without a reason to divide the image, the method runs once on all of it.

    Around the image a method that looks far, such as a network, sees its mirror image, so that a constant image stays
    constant. Training goes without: its crops are pieces of larger images.

    Args:
        inner: a method without a state. One that depends on the whole image (``needs.reach`` is ``None``) is never
            divided.
        side: longest side of a tile in pixels, a multiple of 32; ``None`` for no limit.
        border: width of the mirror image around the image, rounded up to the method's stride; a method with a smaller
            reach goes without.
    """

    def __init__(self, inner: Model, side: int | None = None, border: int = MIRRORED) -> None:
        super().__init__(inner)
        self.side, self.border = side, border

    @property
    def halo(self) -> int | None:
        """Margin around a tile without which its pixels would not be the same, in pixels."""
        needs = self.inner.needs
        if needs.reach is None or TILE % needs.stride:
            return None
        return -(-needs.reach // needs.stride) * needs.stride

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        parts = self._parts(frame)
        if parts is None:
            output, state = self._within(Region(0, 0, *frame.size), frame.replace(skip=None), state)
            return output.noted(Note("network", "on 100% of the pixels")), state
        frame = frame if frame.statistics else prepared(self.inner, frame)
        whole: Output | None = None
        halo = self.halo or 0
        for part in parts:
            around = part.grown(halo, frame.size)
            output, after = self._within(around, frame)
            if after is not None:
                raise TypeError("inner: expected a method without a state to compute in tiles, found one with a state")
            whole = _known(frame, output) if whole is None else whole._replace(notes=output.notes)
            for result, image in zip(_images(whole), _images(output), strict=True):
                part.of(result).copy_(part.within(around).of(image))
        computed = sum(part.pixels for part in parts) / (frame.size[0] * frame.size[1])
        note = Note("network", f"on {computed:.0%} of the pixels", 1 - computed)
        return (_known(frame, Output(frame.color)) if whole is None else whole).noted(note), None

    def _within(self, around: Region, frame: Frame, state: State = None) -> tuple[Output, State]:
        """The method on a rectangle of the frame, with a mirror image on those sides where the frame ends."""
        (height, width), needs = frame.size, self.inner.needs
        stride = needs.stride
        border = -(-self.border // stride) * stride
        if self.training or not 0 < border <= (self.halo or 0):
            return self.inner(frame if around == Region(0, 0, height, width) else frame.crop(*around.slices), state)
        frame = frame if frame.statistics else prepared(self.inner, frame)
        top, left = (0 if start else border for start in (around.top, around.left))
        below = border + -height % stride if around.bottom == height else 0
        right = border + -width % stride if around.right == width else 0
        unused = {name: None for name, _ in frame.items() if name in BUFFERS and name not in needs.buffers | needs.uses}
        seen = frame.replace(**{**unused, "color": frame.color, "alpha": frame.alpha}).crop(*around.slices)

        def bordered(image: Tensor) -> Tensor:
            # A camera is no image.
            return image if image.dim() == 3 else mirrored(image, (top, below), (left, right))

        output, state = self.inner(seen.map(bordered), state)
        inside = Region(top, left, top + around.bottom - around.top, left + around.right - around.left)
        return output.map(lambda image: inside.of(image).contiguous()), state

    def _parts(self, frame: Frame) -> list[Region] | None:
        """The tiles to compute; ``None`` for the whole image at once."""
        whole = [Region(0, 0, *frame.size)]
        if self.halo is None or torch.compiler.is_compiling():
            return None
        skipped = frame.skip if at_hand(frame.color.device) and not frame.hints.keep_all else None
        parts = whole if skipped is None else regions(~skipped.mask, self.halo)
        if self.side is not None:
            parts = [tile for part in parts for tile in part.split(self.side)]
        return None if parts == whole else parts


def with_border(image: Tensor, width: int = MIRRORED) -> Tensor:
    """``(..., H, W)`` with its mirror image around it, for a method that sees the whole image."""
    return mirrored(image, (width, width), (width, width))


def without_border(image: Tensor, width: int = MIRRORED) -> Tensor:
    """The opposite of :func:`with_border`."""
    height, columns = (side - 2 * width for side in image.shape[-2:])
    return image.narrow(-2, width, height).narrow(-1, width, columns).contiguous()


def _known(frame: Frame, output: Output) -> Output:
    """Images of the whole frame for an output of a tile: in pixels that are not computed the known result."""
    known = frame.color if frame.skip is None else frame.skip.image
    stages = {name: known.to(image.dtype, copy=True) for name, image in output.stages.items()}
    layers = {name: frame.layers[name].to(layer.dtype, copy=True) for name, layer in output.layers.items()}
    before = frame.color[:, :1] if frame.alpha is None else frame.alpha
    alpha = None if output.alpha is None else before.to(output.alpha.dtype, copy=True)
    return Output(known.to(output.image.dtype, copy=True), stages, layers, alpha, output.notes)


def _images(output: Output) -> list[Tensor]:
    alpha = [] if output.alpha is None else [output.alpha]
    return [output.image, *output.stages.values(), *output.layers.values(), *alpha]


class Region(NamedTuple):
    """A rectangle of an image, in pixels; ``bottom`` and ``right`` are outside."""

    top: int
    left: int
    bottom: int
    right: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Its rows and columns."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

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
        halo: how far around a rectangle the method has to look, in pixels.

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


def _boxes(tiles: Tensor, gap: int) -> list[Region]:
    """Boxes around groups of tiles; groups whose halos touch are one."""
    boxes: list[Region] = []
    for row, column in tiles.nonzero().tolist():
        box = Region(row, column, row + 1, column + 1)
        while near := next((other for other in boxes if _near(box, other, gap)), None):
            boxes.remove(near)
            box = Region(*map(min, box[:2], near[:2]), *map(max, box[2:], near[2:]))
        boxes.append(box)
    return boxes


def _near(a: Region, b: Region, gap: int) -> bool:
    rows = a.top <= b.bottom + gap and b.top <= a.bottom + gap
    return rows and a.left <= b.right + gap and b.left <= a.right + gap
