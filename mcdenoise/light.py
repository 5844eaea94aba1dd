"""Light that is none: NaN, infinite and negative values of a rendered image, replaced so that they do not spread."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.errors import InputError
from mcdenoise.ops._rows import by_rows

# Largest valid radiance, in any unit. Divided by the smallest albedo (0.04), squared, and summed over the 3 x 1024
# values of the largest window, it stays below the largest float32: (25e16)^2 3072 = 2e38.
LARGEST_RADIANCE = 1e16
# Least radiance of an infinite light without finite neighbours: the largest that a half float holds.
_SUN = 65504.0
# Negative light above this fraction of a channel's light of both signs is noise around its mean, which must be kept;
# above this fraction of an image's, half as much as there is positive light, the image is no radiance.
_MANY, _MOST_NEGATIVE = 0.01, 1 / 3
# Mean negative light that is too little to refuse an image for: the rounding of a black one.
_LEAST_NEGATIVE = 1e-5
# A layer with a larger fraction of invalid pixels is not radiance; replacing them would damage the color.
_MOST_BROKEN = 0.1
# Side of the window in which negative light is taken from positive light.
_WINDOW = 7
_COLOR_NUMBERS, _LAYER_NUMBERS = 9, 2


class Repairs(NamedTuple):
    """What was invalid in a color, and its layers.

    Args:
        filled: number of pixels without a value (NaN, or minus infinity in some channel), filled from around them.
        limited: number of pixels with infinite values, or values above 1e16.
        clamped: number of pixels with negative values.
        negative: sum of the negative light of a channel as a fraction of its light of both signs; the largest of all.
        gained: change of the mean of an image because of negative light; the largest of a batch.
        place: row and column of the most negative value.
    """

    filled: int = 0
    limited: int = 0
    clamped: int = 0
    negative: float = 0.0
    gained: float = 0.0
    place: tuple[int, int] = (0, 0)

    @property
    def pixels(self) -> int:
        """Number of invalid pixels; one that is invalid in two ways counts twice."""
        return self.filled + self.limited + self.clamped

    @property
    def doubt(self) -> str:
        """A warning, if the light of the image has changed by more than a hundredth; else empty."""
        if self.negative <= _MANY:
            return ""
        kept = abs(self.gained) <= _MANY
        change = "its mean is kept, by light of the pixels around" if kept else f"its mean rises by {self.gained:.1%}"
        row, column = self.place
        return (
            f"color: expected radiance, not negative, found {self.negative:.1%} of the light negative, in "
            f"{self.clamped} pixels, most at row {row}, column {column}; they are set to 0, and {change}"
        )


def replace_invalid(color: Tensor) -> tuple[Tensor, int]:
    """Replace radiance that is NaN, infinite, negative or too large, so that it does not spread.

    A pixel with NaN or minus infinity is filled from around it: by the mean of its valid 3x3 neighbours, and where it
    has none, from the nearest pixels of ever coarser images. Infinity, and radiance above 1e16 for which float32
    arithmetic may overflow, is the largest valid value of the 3x3 neighbours or of the pixel's own channels; where a
    whole block of 3x3 pixels is infinite, it is the largest value of the image, and at least 65504, so that an infinite
    sun stays bright. A negative value is 0, and the pixel's other channels stay. If a channel has more than 1 % of
    negative light, which is noise around its mean, that light is taken from the positive values in the window of
    7x7 pixels around it, where these have as much, so that the mean stays.

    Args:
        color: ``(B, C, H, W)`` radiance.

    Returns:
        The valid radiance (``color`` itself if all was valid), and the number of replaced pixels.

    Raises:
        InputError: an image of the batch has no valid value at all, or its negative light is more than half of its
            positive light.

    Example:
        >>> color = torch.ones(1, 3, 3, 3)
        >>> color[0, 1, 1, 1] = float("nan")
        >>> clean, replaced = replace_invalid(color)
        >>> replaced, clean[0, :, 1, 1].tolist()
        (1, [1.0, 1.0, 1.0])
    """
    if is_valid(color):
        return color, 0
    clean, _, numbers = repair(color, {}, reads=True)
    return clean, repairs_from(numbers.tolist(), ()).pixels


def is_valid(image: Tensor) -> bool:
    """Whether nothing is to be repaired. A single pass suffices, because NaN propagates."""
    low, high = torch.aminmax(image)
    return bool(low >= 0 and high <= LARGEST_RADIANCE and high < torch.inf)


def repair(color: Tensor, layers: Mapping[str, Tensor], *, reads: bool) -> tuple[Tensor, Mapping[str, Tensor], Tensor]:
    """Apply :func:`replace_invalid` to a color and layers that are parts of it, so that their sums stay.

    A pixel without a value in any of them is filled in all. An infinite or negative layer is what the color has beyond
    the others, and layers that are together brighter than a color that was replaced are scaled to it.

    Args:
        color: ``(B, C, H, W)``.
        layers: ``(B, C, H, W)`` by name.
        reads: whether values may be read on the host, to leave out what is not needed.

    Returns:
        The valid color and layers, and numbers ``(N,)`` on their device for :func:`repairs_from`.
    """
    hole = _hole(color)
    usable = ~(hole | _high(color).any(1, keepdim=True))
    of_layers: list[Tensor] = []
    for layer in layers.values():
        broken = usable & (_hole(layer) | _high(layer).any(1, keepdim=True))
        of_layers += [broken.float().mean(), _negative(layer, hole)[1].amax()]
        hole = hole | _hole(layer)
    top = _numbers_of(color, hole).amax((1, 2, 3), keepdim=True).clamp_min(_SUN)
    lit = by_rows(_limited, color, hole, top.expand_as(hole), reach=3)
    light, ratio, by_channel = _negative(color, hole)
    clean = lit.clamp_min(0)
    noisy = by_channel > _MANY
    if not reads or bool(noisy.any()):
        clean = torch.where(noisy, by_rows(_balanced, lit, reach=2 * (_WINDOW // 2)), clean)
    gained = torch.where(hole, 0, clean - lit).float().sum((1, 2, 3)) / light
    worst = torch.where(hole, 0, lit).amin(1).amin(0).flatten().argmin()
    everything = torch.where(hole, 0, torch.cat([color, *layers.values()], 1))
    numbers = [
        hole.sum(),
        _high(everything).any(1).sum(),
        (everything < 0).any(1).sum(),
        hole.flatten(1).all(1).any(),
        by_channel.amax(),
        ratio.amax(),
        gained.gather(0, gained.abs().argmax(0, keepdim=True)).sum(),
        torch.div(worst, color.shape[3], rounding_mode="floor"),
        worst % color.shape[3],
    ]
    parts = {name: _numbers_of(layer, hole).clamp_min(0) for name, layer in layers.items()}
    if parts:
        pairs = zip((color, *layers.values()), (clean, *parts.values()), strict=True)
        changed = torch.stack([torch.ne(before, after) for before, after in pairs]).any(0)
        total = functools.reduce(torch.add, parts.values())
        # What the color has beyond the valid layers is that of the invalid ones.
        bad = {name: (_high(layer) | (layer < 0)).to(clean.dtype) for name, layer in layers.items()}
        missing = (clean - total).clamp_min(0) / functools.reduce(torch.add, bad.values()).clamp_min(1)
        scale = torch.where(changed & (total > clean), clean / torch.where(total > 0, total, 1), 1)
        parts = {name: (part + missing * bad[name]) * scale for name, part in parts.items()}
    images = [clean, *parts.values()]
    if not reads or bool(hole.any()):
        images = [by_rows(_from_neighbours, image, hole, reach=1) for image in images]
        # In the middle of 3x3 holes.
        alone = by_rows(lambda hole: F.max_pool2d((~hole).float(), 3, 1, 1) == 0, hole, reach=1)
        if not reads or bool(alone.any()):
            images = [torch.where(alone, filled(image, ~alone), image) for image in images]
    dtype = torch.promote_types(color.dtype, torch.float32)
    stacked = torch.stack([number.to(dtype) for number in (*numbers, *of_layers)])
    return images[0], dict(zip(parts, images[1:], strict=True)), stacked


def filled(image: Tensor, known: Tensor) -> Tensor:
    """Fill the unknown pixels of an image from the known ones around them, however large the gap is.

    Each pixel takes the mean of the known pixels of the smallest block that has any, of 2, 4, 8 ... pixels a side, with
    bilinear interpolation between blocks: the way outside in that costs a third more than the image itself.

    Args:
        image: ``(B, C, H, W)``; unknown pixels may hold anything that is finite.
        known: ``(B, 1, H, W)`` bool.

    Returns:
        ``(B, C, H, W)``, within the range of the known pixels; 0 in an image without any.

    Example:
        >>> image = torch.tensor([[[[3.0, 0.0, 0.0, 0.0, 0.0]]]])
        >>> filled(image, image > 0)
        tensor([[[[3., 3., 3., 3., 3.]]]])
    """
    dtype = torch.promote_types(image.dtype, torch.float32)
    weight = known.to(dtype)
    # Halved again and again, and normalised at once, so that nothing overflows.
    levels = [(torch.where(known, image, 0).to(dtype), weight)]
    while max(levels[-1][0].shape[2:]) > 1:
        value, weight = levels[-1]
        weights = F.avg_pool2d(weight, 2, ceil_mode=True)
        sums = F.avg_pool2d(value * weight, 2, ceil_mode=True)
        some = weights > 0
        levels.append((torch.where(some, sums / torch.where(some, weights, 1), 0), some.to(dtype)))
    coarse = levels.pop()[0]
    for value, weight in reversed(levels):
        wide = F.interpolate(coarse, value.shape[2:], mode="bilinear", align_corners=False)
        coarse = torch.where(weight > 0, value, wide)
    return torch.where(known, image, coarse.to(image.dtype))


def repairs_from(numbers: Sequence[float], layers: Sequence[str]) -> Repairs:
    """What was invalid, from the numbers of :func:`repair`.

    Raises:
        InputError: an image cannot be repaired, or a layer is no radiance.
    """
    filled, limited, clamped, empty, negative, ratio, gained, row, column = numbers[:_COLOR_NUMBERS]
    for number, name in enumerate(layers):
        start = _COLOR_NUMBERS + _LAYER_NUMBERS * number
        broken, signed = numbers[start : start + _LAYER_NUMBERS]
        if broken > _MOST_BROKEN or signed > _MOST_NEGATIVE:
            share = f"in {broken:.0%} of the pixels" if broken > _MOST_BROKEN else f"{signed:.0%} of its light negative"
            raise InputError(f"layer '{name}': expected radiance, not negative and finite, found {share}; leave it out")
    if empty:
        raise InputError("buffer 'color': expected radiance, found NaN in every pixel; render the frame again")
    if ratio > _MOST_NEGATIVE:
        raise InputError(
            f"buffer 'color': expected radiance, not negative, found {ratio:.0%} of the light negative, "
            "so it holds something else, such as a difference; give the radiance itself"
        )
    return Repairs(int(filled), int(limited), int(clamped), negative, gained, (int(row), int(column)))


def _hole(image: Tensor) -> Tensor:
    """``(B, 1, H, W)``: pixels without a value in some channel."""
    return (image.isnan() | (image == -torch.inf)).any(1, keepdim=True)


def _high(image: Tensor) -> Tensor:
    """Values that are infinite or too large."""
    return image > min(LARGEST_RADIANCE, torch.finfo(image.dtype).max)


def _numbers_of(image: Tensor, hole: Tensor) -> Tensor:
    """The image with 0 where it has no number."""
    return torch.where(hole | _high(image), 0, image)


def _negative(image: Tensor, hole: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """All light of an image; its negative light, and that of each channel, as a fraction of the light of both signs."""
    known = _numbers_of(image, hole).float()
    positive, negative = known.clamp_min(0).mean((2, 3), keepdim=True), -known.clamp_max(0).mean((2, 3), keepdim=True)
    tiny = torch.finfo(torch.float32).tiny
    of_image = positive.sum((1, 2, 3)), negative.sum((1, 2, 3))
    ratio = torch.where(of_image[1] > _LEAST_NEGATIVE, of_image[1] / (of_image[0] + of_image[1]).clamp_min(tiny), 0)
    light = (of_image[0] - of_image[1]).clamp_min(tiny) * image.shape[2] * image.shape[3]
    return light, ratio, negative / (positive + negative).clamp_min(tiny)


def _limited(image: Tensor, hole: Tensor, top: Tensor) -> Tensor:
    """Finite values in place of infinite and too large ones, and 0 in holes."""
    high, known = _high(image), _numbers_of(image, hole)
    around = F.max_pool2d(known, 3, 1, 1).maximum(known.amax(1, keepdim=True))
    # Blocks of 3x3 pixels, or what lies in the image of them, without a finite value, and the rim of these blocks.
    near = F.max_pool2d((~(high | hole)).to(known.dtype), 3, 1, 1)
    sun = F.max_pool2d(1 - near, 5, 1, 2) > 0
    return torch.where(high, torch.where(sun, top, around), known)


def _balanced(image: Tensor) -> Tensor:
    """Clamp negative values, and take their light from positive ones in the window around each, where it has enough."""
    dtype = torch.promote_types(image.dtype, torch.float32)
    positive, negative = image.to(dtype).clamp_min(0), -image.to(dtype).clamp_max(0)
    there, owed = (F.avg_pool2d(each, _WINDOW, 1, _WINDOW // 2) for each in (positive, negative))
    enough = there > owed
    # Each takes from its window in proportion to the light of the pixels in it, so that the sum of all is exact.
    taken = torch.where(enough, negative / torch.where(enough, there, 1), 0)
    return (positive * (1 - F.avg_pool2d(taken, _WINDOW, 1, _WINDOW // 2)).clamp_min(0)).to(image.dtype)


def _from_neighbours(image: Tensor, hole: Tensor) -> Tensor:
    """The mean of the 3x3 neighbours that have a value in each hole that has any."""
    # Divide before summing, and not in half precision, so that bright neighbours do not overflow.
    dtype = torch.promote_types(image.dtype, torch.float32)
    total = F.avg_pool2d(torch.where(hole, 0, image).to(dtype) / 9, 3, 1, 1, divisor_override=1)
    count = F.avg_pool2d((~hole).to(dtype), 3, 1, 1, divisor_override=1)
    return torch.where(hole, (total * (9 / count.clamp_min(1))).to(image.dtype), image)
