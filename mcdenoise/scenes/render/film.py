"""Pixel filter and lens: where in and around a pixel its samples lie, and which pixels they go to."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcdenoise.data.camera_path import Array
from mcdenoise.errors import InputError

_SIZE = 4096
# Largest distance of a sample from the pixel's centre, in pixels.
_RADII = {"centre": 0.0, "box": 0.5, "tent": 1.0, "gaussian": 2.0, "blackman_harris": 0.75}
FILTERS = tuple(_RADII)


@dataclass(frozen=True)
class Film:
    """Distribution of the samples of a pixel.

    Args:
        filter: one of ``FILTERS``: all samples at the centre, a box of one pixel, a tent of radius 1, a Gaussian of
            deviation 0.5, or Blackman-Harris over 1.5 pixels as in Cycles.
        aperture: radius of the lens, scene units; 0 is a pinhole.
        focus: distance along the viewing axis at which a lens is sharp, scene units.
        splat: whether a sample goes to all pixels that the filter reaches, as in Mitsuba, or to its own, as in Cycles.

    Raises:
        InputError: the filter is unknown, or a number is invalid.
    """

    filter: str = "box"
    aperture: float = 0.0
    focus: float = 1.0
    splat: bool = True

    def __post_init__(self) -> None:
        if self.filter not in FILTERS:
            raise InputError(f"pixel filter: expected one of {', '.join(FILTERS)}, found '{self.filter}'")
        if not 0 <= self.aperture < math.inf:
            raise InputError(f"aperture: expected a radius of at least 0, found {self.aperture:g}")
        if not 0 < self.focus < math.inf:
            raise InputError(f"focus: expected a distance above 0, found {self.focus:g}")

    @property
    def spreads(self) -> bool:
        """Whether samples go to several pixels."""
        return self.splat and _RADII[self.filter] > 0.5


def curve(name: str, x: NDArray[Any]) -> Array:
    """The filter at distances from the pixel's centre, in pixels."""
    r = np.abs(np.asarray(x, dtype=np.float64))
    if name == "box":
        return np.asarray((r <= 0.5) * 1.0)
    if name == "tent":
        return np.asarray(np.maximum(1 - r, 0))
    if name == "gaussian":
        return np.asarray(np.maximum(np.exp(-2 * r**2) - np.exp(-8.0), 0))
    # Blackman-Harris, 1.5 pixels wide, as Cycles has it by default.
    t = np.pi * (r / 0.75)
    window = 0.35875 + 0.48829 * np.cos(t) + 0.14128 * np.cos(2 * t) + 0.01168 * np.cos(3 * t)
    return np.asarray(np.where(r < 0.75, window, 0))


def offsets(name: str) -> Array:
    """Distances from the pixel's centre at even steps of the filter's integral: a table to draw samples from."""
    radius = _RADII[name]
    edges = np.linspace(-radius, radius, 4001)
    total = np.concatenate([[0], np.cumsum(curve(name, (edges[:-1] + edges[1:]) / 2))])
    return np.asarray(np.interp(np.linspace(0, 1, _SIZE) * total[-1], total, edges))


def splat(name: str, values: NDArray[Any], x: NDArray[Any], y: NDArray[Any], size: tuple[int, int]) -> Array:
    """Images of samples that each go to all pixels in reach of the filter.

    Args:
        name: of the filter.
        values: ``(H*W, S, C)`` samples, S in each pixel.
        x: ``(H*W, S)`` horizontal place in the pixel, from its left edge.
        y: ``(H*W, S)`` vertical place in the pixel, from its upper edge.
        size: width and height.

    Returns:
        ``(H*W, C)``.
    """
    width, height = size
    pixels, _, channels = values.shape
    total, weights = np.zeros((height + 4, width + 4, channels)), np.zeros((height + 4, width + 4, 1))
    for down in range(-2, 3):
        along_y = curve(name, y - (down + 0.5))
        if not along_y.any():
            continue
        for right in range(-2, 3):
            weight = along_y * curve(name, x - (right + 0.5))
            if weight.any():
                at = slice(2 + down, 2 + down + height), slice(2 + right, 2 + right + width)
                total[at] += np.einsum("ps,psc->pc", weight, values).reshape(height, width, channels)
                weights[at] += weight.sum(1).reshape(height, width, 1)
    image = total / np.maximum(weights, 1e-9)
    return np.asarray(image[2:-2, 2:-2].reshape(pixels, channels))
