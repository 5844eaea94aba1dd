"""Errors without a reference: images denoised from one rendering are compared with another of the same frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from mcdenoise.data import Sequence
from mcdenoise.data.color_space import to_rec709
from mcdenoise.errors import InputError, naming
from mcdenoise.evaluate.folder import open_images, read_image

NOISY = "noisy"
# Sides of the squares whose difference is the surroundings of a pixel. Pixel filters reach less far than the inner one.
_OUTER, _INNER = 11, 5
# As in relMSE, in the unit of the squared radiance.
_EPSILON = 0.01
# Sides of blocks in pixels, and how many a frame has along its shorter side at least.
_SMALLEST, _LARGEST, _BLOCKS = 8, 32, 8
# A mean over blocks lies within two deviations of its expectation in 95 of 100 cases.
_DEVIATIONS = 2.0


@dataclass
class Halves:
    """Errors of denoised images, estimated from two renderings of the same frames with independent noise.

    With the renderings A and B, the image D that was denoised from A, and the image T without noise, which nobody has,
    the mean of ``w (|D - B|^2 - |A - B|^2 / 2)`` is that of ``w |D - T|^2``: the noise of B is independent of D and of
    the weight. Differences between images are known better, since the noise cancels. The weight is that of relMSE, with
    the mean of both renderings around the pixel, and without it.

    Args:
        first: name of A.
        other: name of B.
        frames: number of frames.
        sums: weighted squared errors, by name of the images and summed over each block of pixels, ``(N,)``; ``noisy``
            is A itself.
        pixels: number of pixels of each block, ``(N,)``.
        doubts: warnings: an image looks as if it had been denoised from B.
    """

    first: str
    other: str
    frames: int = 0
    sums: dict[str, Tensor] = field(default_factory=dict)
    pixels: Tensor = field(default_factory=lambda: torch.zeros(1))
    doubts: list[str] = field(default_factory=list)

    def error(self, name: str) -> tuple[float, float]:
        """The weighted squared error of an image, and by how much it may be off (95 %)."""
        return _mean(self.sums[name], self.pixels)

    def difference(self, name: str, other: str) -> tuple[float, float]:
        """By how much the error of one image exceeds that of another, and by how much this may be off (95 %)."""
        return _mean(self.sums[name] - self.sums[other], self.pixels)

    @property
    def ranking(self) -> list[str]:
        """Names of the images, the smallest error first."""
        return sorted(self.sums, key=lambda name: self.error(name)[0])

    def as_json(self) -> dict[str, Any]:
        """The errors, and the differences from the smallest one, as JSON values, each with its uncertainty."""
        best, *others = self.ranking
        return {
            "first": self.first,
            "other": self.other,
            "frames": self.frames,
            "error": {name: self.error(name) for name in (best, *others)},
            "differences": {name: self.difference(name, best) for name in others},
        }


@torch.no_grad()
def evaluate_halves(
    sequence: Sequence, other: Sequence, images: Mapping[str, Path], on_frame: Callable[[int], None]
) -> Halves:
    """Estimate the errors of denoised images without a reference.

    Args:
        sequence: the frames that were denoised.
        other: the same frames with as many samples of another seed, which no image has seen.
        images: folders of denoised images, or files of one frame, by names for the result.
        on_frame: called with the number of each finished frame.

    Raises:
        InputError: frames are missing, too small, or equal in both renderings, or an image has other pixels.
    """
    numbers = dict(zip(sequence.numbers, other.numbers, strict=False))
    same = sequence.numbers == other.numbers or len(sequence.numbers) == len(other.numbers) == 1
    if not same or sequence.size != other.size or min(sequence.size) < _SMALLEST * 4:
        raise InputError(
            f"--half {other.root}: expected the frames of {sequence.root} with another seed, of {_SMALLEST * 4} x "
            f"{_SMALLEST * 4} pixels or more, found {_described(other)} for {_described(sequence)}"
        )
    files = {name: open_images(path, sequence, sequence.numbers) for name, path in images.items()}
    result, closer = Halves(str(sequence.root), str(other.root)), dict.fromkeys(files, torch.zeros(1))
    for number, others in numbers.items():
        first, second = _color(sequence, number), _color(other, others)
        if torch.equal(first, second):
            raise InputError(
                f"--half {other.root}: expected other noise than in {sequence.root}, found the same image as frame "
                f"{number}; render with another seed"
            )
        weight, noise = weights(first, second), (first - second).square() / 2
        squares = {NOISY: noise}
        for name, paths in files.items():
            image = read_image(paths[number], sequence).double()
            squares[name] = (image - second).square() - noise
            gain = (image - second).square() - (image - first).square()
            closer[name] = closer[name] + _blocks(weight * gain)
        for name, square in squares.items():
            result.sums[name] = result.sums.get(name, torch.zeros(1)) + _blocks(weight * square)
        result.pixels = result.pixels + _blocks(torch.ones_like(weight))
        result.frames += 1
        on_frame(number)
    for name, sums in closer.items():
        value, margin = _mean(sums, result.pixels)
        if value < -margin:
            result.doubts.append(
                f"{name}: its noise is that of {other.root}; expected images denoised from {sequence.root}, and as "
                "many samples in both: its error may be wrong"
            )
    return result


def weights(first: Tensor, other: Tensor) -> Tensor:
    """The weight of each pixel, ``(1, 1, H, W)``, from the brightness around it and not from its own noise.

    Args:
        first: ``(1, 3, H, W)`` one rendering.
        other: the other one.
    """
    light = ((first + other) / 2).mean(1, keepdim=True)
    around, count = (_square(each, _OUTER) - _square(each, _INNER) for each in (light, torch.ones_like(light)))
    return 1 / ((around / count).square() + _EPSILON)


def _square(image: Tensor, side: int) -> Tensor:
    return functional.avg_pool2d(image, side, 1, side // 2) * side**2


def _blocks(values: Tensor) -> Tensor:
    """Sums of the mean over the channels over blocks of pixels, ``(N,)``."""
    height, width = values.shape[-2:]
    side = min(_LARGEST, max(_SMALLEST, min(height, width) // _BLOCKS))
    padded = functional.pad(values.mean(1, keepdim=True), (0, -width % side, 0, -height % side))
    return functional.avg_pool2d(padded, side).flatten() * side**2


def _mean(sums: Tensor, pixels: Tensor) -> tuple[float, float]:
    """A mean over pixels, and two deviations of it, from how much the blocks differ."""
    total = pixels.sum()
    mean = sums.sum() / total
    rest = (sums - mean * pixels).square().sum() * len(sums) / (len(sums) - 1)
    return float(mean), _DEVIATIONS * math.sqrt(float(rest)) / float(total)


def _color(sequence: Sequence, number: int) -> Tensor:
    with naming(f"{sequence.root}, frame {number}"):
        frame = sequence.frame(number, reference=False).validate()[0]
        return to_rec709(frame.color.double(), sequence.metadata(number))


def _described(sequence: Sequence) -> str:
    height, width = sequence.size
    return f"{len(sequence)} frames ({sequence.numbers[0]} to {sequence.numbers[-1]}) of {width} x {height} pixels"
