"""Pictures in the page: 8-bit codes of scene-linear radiance, close-ups, and temporal profiles."""

from __future__ import annotations

import base64
import io
import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import avg_pool2d

from mcdenoise.metrics import display_codes, psnr_srgb, smape_linear

Image = NDArray[np.float32]
Codes = NDArray[np.uint8]

# Radiance of the largest code; brighter pixels look the same in the page.
BRIGHTEST = 64.0
_GAMMA = 2.2
# For pictures of at most so many pixels together: lossless if they are few, then ever coarser, so that they take some
# 20 megabytes at most. Chroma is never subsampled, for colours are compared.
FORMATS: tuple[tuple[float, str, dict[str, Any]], ...] = (
    (2e6, "webp", {"lossless": True, "quality": 40, "method": 2}),
    (2e7, "jpeg", {"quality": 88, "subsampling": 0}),
    (6e7, "jpeg", {"quality": 75, "subsampling": 0}),
)


def encode(radiance: Image) -> Codes:
    """Scene-linear radiance as codes: ``255 (c(x) / c(64))^(1/2.2)`` with ``c(x) = x / (1 + x)``, rounded.

    Steps are about 2 % between 0.1 and 2, and grow towards both ends. Negative and NaN pixels are stored as 0.

    Args:
        radiance: of any shape.
    """
    x = np.clip(np.nan_to_num(radiance, nan=0.0, posinf=BRIGHTEST), 0.0, BRIGHTEST)
    compressed = x / (1 + x) * ((1 + BRIGHTEST) / BRIGHTEST)
    return np.asarray(np.rint(255 * compressed ** (1 / _GAMMA)), dtype=np.uint8)


def decode(codes: NDArray[Any]) -> NDArray[np.float64]:
    """The radiance that codes stand for; the inverse of :func:`encode` without the rounding.

    Args:
        codes: in [0, 255], of any shape, not only whole ones.
    """
    compressed = (np.asarray(codes, dtype=np.float64) / 255) ** _GAMMA * (BRIGHTEST / (1 + BRIGHTEST))
    return compressed / (1 - compressed)


def to_srgb(radiance: Image) -> Codes:
    """As a display shows it at exposure 0: clamped to [0, 1], sRGB curve, 8 bit."""
    image = torch.from_numpy(np.nan_to_num(np.ascontiguousarray(radiance, dtype=np.float32)))
    return np.asarray(display_codes(image.permute(2, 0, 1)).permute(1, 2, 0).numpy())


def smaller(radiance: Image, factor: int) -> Image:
    """Means of squares of so many pixels a side; rows and columns that do not fill one are dropped."""
    image = torch.from_numpy(radiance).permute(2, 0, 1)[None]
    return np.asarray(avg_pool2d(image, factor)[0].permute(1, 2, 0).numpy())


def data_uri(pixels: Codes, image_format: str = "webp", **options: Any) -> str:
    """An image file as text that a page can hold.

    Args:
        pixels: ``(H, W, 3)``.
        image_format: ``webp``, ``jpeg`` or ``png``.
        options: of Pillow's writer of that format; WebP is lossless by default.
    """
    import PIL.Image

    file = io.BytesIO()
    PIL.Image.fromarray(np.ascontiguousarray(pixels)).save(file, image_format, **(options or FORMATS[0][2]))
    return f"data:image/{image_format};base64,{base64.b64encode(file.getvalue()).decode()}"


@dataclass(frozen=True)
class Crop:
    """A part of a frame.

    Args:
        left: first column.
        top: first row.
        width: pixels.
        height: pixels.
        reason: why this part is shown.
    """

    left: int
    top: int
    width: int
    height: int
    reason: str

    def of(self, image: NDArray[Any]) -> NDArray[Any]:
        """That part of an ``(H, W, ...)`` image."""
        return image[self.top : self.top + self.height, self.left : self.left + self.width]


def choose_crops(images: list[Image], reference: Image) -> list[Crop]:
    """Two parts where the images differ most from each other, and one where the reference has most detail.

    Difference is the standard deviation over the images, detail the gradient, both as displayed. The parts are about a
    sixth of the width and do not overlap; where the frame is too small for three of them, there are fewer.

    Args:
        images: ``(H, W, 3)``, scene-linear, of the methods that are compared.
        reference: ``(H, W, 3)``.
    """
    height, width, _ = reference.shape
    crop_width = min(max(width // 6, 32), 192, width)
    crop_height = min(crop_width * 3 // 4, height)
    shown = np.stack([to_srgb(image).mean(-1, dtype=np.float32) for image in images or [reference]])
    down, right = np.gradient(to_srgb(reference).mean(-1, dtype=np.float32))
    difference, detail = (_window_means(x, crop_height, crop_width) for x in (shown.std(0), np.hypot(down, right)))
    crops: list[Crop] = []
    for score, reason in (
        (difference, "methods differ most"),
        (difference, "methods differ most, elsewhere"),
        (detail, "most detail in the reference"),
    ):
        free = score.copy()
        for crop in crops:
            top, left = max(crop.top - crop_height + 1, 0), max(crop.left - crop_width + 1, 0)
            free[top : crop.top + crop_height, left : crop.left + crop_width] = -1
        top, left = np.unravel_index(int(np.argmax(free)), free.shape)
        if free[top, left] >= 0:
            crops.append(Crop(int(left), int(top), crop_width, crop_height, reason))
    return crops


def crop_errors(image: Image, reference: Image) -> tuple[float, float]:
    """PSNR as displayed in decibels, and SMAPE of scene-linear radiance, of two ``(H, W, 3)`` images."""
    pair = [torch.from_numpy(np.ascontiguousarray(x)).permute(2, 0, 1)[None] for x in (image, reference)]
    return float(psnr_srgb(*pair)), float(smape_linear(*pair))


def choose_row(clips: list[list[Codes]]) -> tuple[int, int, int]:
    """The stretch of a row where the methods change most from frame to frame, away from the border of the frame.

    Args:
        clips: of each method the same two or more successive frames, ``(H, W, 3)`` codes.

    Returns:
        Row, first column, and number of columns: about half of the width.
    """
    height, width, _ = clips[0][0].shape
    columns = max(width // 2, min(width, 64))
    change = np.zeros((height, width))
    for clip in clips:
        for before, after in itertools.pairwise(clip):
            change += np.abs(after.astype(np.float32) - before).mean(-1)
    means = _window_means(change, 1, columns)
    border = height // 10
    inner = means[border : height - border]
    row, left = np.unravel_index(int(np.argmax(inner)), inner.shape)
    return int(row) + border, int(left), columns


def _window_means(values: NDArray[Any], height: int, width: int) -> NDArray[np.float64]:
    """Mean over every window of a size, by the place of its top left corner."""
    sums = np.zeros((values.shape[0] + 1, values.shape[1] + 1))
    sums[1:, 1:] = values.cumsum(0, dtype=np.float64).cumsum(1)
    windows = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    return np.asarray(windows / (height * width))
