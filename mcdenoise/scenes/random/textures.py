"""Procedural textures: reflectances in [0.02, 0.9] as ``(H, W, 3)`` arrays, most of which tile seamlessly."""

from __future__ import annotations

import colorsys
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mcdenoise.data.camera_path import Array

Color = tuple[float, float, float]
Rng = np.random.Generator
# How often paints are, and their least and largest saturation and value.
_PAINTS = {
    "neutral": (0.3, (0, 0.12), (0.25, 0.9)),
    "pastel": (0.25, (0.1, 0.4), (0.4, 0.85)),
    "saturated": (0.2, (0.6, 0.97), (0.25, 0.85)),
    "dark": (0.1, (0, 0.7), (0.02, 0.12)),
    "wood": (0.15, (0.4, 0.75), (0.12, 0.6)),
}


def log_uniform(rng: Rng, low: float, high: float) -> float:
    """A random number whose logarithm is even."""
    return float(np.exp(rng.uniform(math.log(low), math.log(high))))


def random_color(rng: Rng) -> Color:
    """A reflectance: neutral, pastel, saturated, dark or bright."""
    hue = rng.random()
    kind = str(rng.choice(list(_PAINTS), p=[chance for chance, _, _ in _PAINTS.values()]))
    if kind == "wood":
        hue = rng.uniform(0.04, 0.11)
    saturation, value = (rng.uniform(*limits) for limits in _PAINTS[kind][1:])
    red, green, blue = colorsys.hsv_to_rgb(float(hue), float(saturation), float(value))
    return max(red, 0.02), max(green, 0.02), max(blue, 0.02)


def wall_color(rng: Rng) -> Color:
    """A bright paint in most cases, for indirect light; sometimes any color."""
    if rng.random() < 0.25:
        return random_color(rng)
    red, green, blue = colorsys.hsv_to_rgb(rng.random(), rng.uniform(0, 0.25), rng.uniform(0.5, 0.88))
    return red, green, blue


def texture(rng: Rng) -> Array:
    """A random pattern in random colours and at a random scale."""
    plain: tuple[Callable[[Rng], Array], ...] = (checker, tiles, tiles, planks, planks, stripes, dots)
    patterns = (*plain, marble, marble, wallpaper, glyphs, picture)
    return patterns[int(rng.integers(len(patterns)))](rng)


def checker(rng: Rng) -> Array:
    """Squares of two colours."""
    y, x = _grid(_side(rng))
    cells = 2 * int(rng.integers(1, 9))
    return _mix((np.floor(x * cells) + np.floor(y * cells)) % 2, rng)


def tiles(rng: Rng) -> Array:
    """Tiles or bricks of uneven tone with grout between them."""
    y, x = _grid(_side(rng))
    rows, columns = (int(n) for n in rng.integers(2, 13, 2))
    rows += rows % 2
    row = np.floor(y * rows).astype(int)
    shifted = (x * columns + (0.5 * (row % 2) if rng.random() < 0.6 else 0)) % columns
    column = np.floor(shifted).astype(int)
    tone = rng.uniform(1 - rng.uniform(0, 0.6), 1, (rows, columns))[row, column]
    grout = rng.uniform(0.03, 0.15)
    joint = (y * rows % 1 < grout) | (shifted % 1 < grout)
    stone = tone * (1 + 0.2 * (_noise(len(x), 16, rng) - 0.5))
    return _reflectance(np.where(joint[..., None], random_color(rng), stone[..., None] * random_color(rng)))


def planks(rng: Rng) -> Array:
    """Boards with wood grain and gaps."""
    y, x = _grid(_side(rng))
    boards, pieces = int(rng.integers(3, 14)), int(rng.integers(1, 4))
    board = np.floor(x * boards).astype(int)
    along = (y + rng.random(boards)[board]) % 1
    tone = rng.uniform(0.6, 1.1, (boards, pieces))[board, np.floor(along * pieces).astype(int)]
    grain = 1 + 0.25 * np.sin(2 * math.pi * boards * 4 * x + 6 * _noise(len(x), 6, rng) + 9 * tone)
    gap = (x * boards % 1 < 0.05) | (along * pieces % 1 < 0.01)
    return _reflectance((tone * grain * np.where(gap, 0.3, 1))[..., None] * random_color(rng))


def stripes(rng: Rng) -> Array:
    """Soft or hard lines at a random angle."""
    y, x = _grid(_side(rng))
    waves = rng.integers(-12, 13, 2)
    if not waves.any():
        waves[0] = 6
    wave = np.sin(2 * math.pi * (waves[0] * x + waves[1] * y))
    hard = rng.random() < 0.5
    return _mix(np.where(wave > rng.uniform(-0.7, 0.7), 1.0, 0.0) if hard else 0.5 + 0.5 * wave, rng)


def dots(rng: Rng) -> Array:
    """Round dots on a regular grid."""
    y, x = _grid(_side(rng))
    count = int(rng.integers(2, 14))
    distance = np.hypot(x * count % 1 - 0.5, y * count % 1 - 0.5)
    return _mix((distance < rng.uniform(0.12, 0.42)) * 1.0, rng)


def marble(rng: Rng) -> Array:
    """Smooth noise of several octaves, unchanged or folded into veins."""
    side = _side(rng)
    first, gain = int(2 ** rng.integers(1, 6)), rng.uniform(0.35, 0.8)
    value = np.zeros((side, side))
    weight = 0.0
    for octave in range(4):
        if first * 2**octave <= side // 2:
            value += gain**octave * _noise(side, first * 2**octave, rng)
            weight += gain**octave
    value /= max(weight, 1)
    if rng.random() < 0.4:
        value = np.abs(2 * value - 1) ** rng.uniform(0.3, 1)
    contrast = rng.uniform(1, 4)
    return _mix(np.clip(0.5 + contrast * (value - value.mean()), 0, 1), rng)


def wallpaper(rng: Rng) -> Array:
    """Ornaments from products of waves."""
    y, x = _grid(_side(rng))
    m, n, k = (int(number) for number in rng.integers(1, 7, 3))
    wave = np.sin(2 * math.pi * m * x) * np.sin(2 * math.pi * n * y) + 0.6 * np.cos(2 * math.pi * k * (x + y))
    wave += 0.5 * np.cos(2 * math.pi * k * (x - y))
    return _mix((wave > rng.uniform(-0.4, 0.8)) * 1.0, rng)


def glyphs(rng: Rng) -> Array:
    """Lines of small random signs that resemble print."""
    side, cell = 256, int(rng.choice([8, 12, 16]))
    page = np.zeros((side, side))
    for top in range(cell, side - cell, cell + cell // 2):
        for left in range(cell, side - cell, cell):
            if rng.random() < 0.83:
                sign = np.kron(rng.random((3, 3)) < 0.55, np.ones((cell // 4, cell // 4)))
                page[top : top + len(sign), left : left + len(sign)] = sign
    return _mix(page, rng)


def picture(rng: Rng) -> Array:
    """Coloured noise with the spectrum of photographs, overlaid with a few flat shapes."""
    side = _side(rng)
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.rfftfreq(side)[None])
    frequency[0, 0] = 1
    layers = [
        np.fft.irfft2(
            np.fft.rfft2(rng.standard_normal((side, side))) / frequency ** rng.uniform(0.8, 1.6), (side, side)
        )
        for _ in range(3)
    ]
    image = np.stack([0.5 + 0.22 * layer / layer.std() for layer in layers], axis=-1)
    mixing = np.eye(3) * 0.5 + rng.dirichlet(np.ones(3), 3) * 0.5
    image = np.asarray(image @ mixing.T)
    y, x = _grid(side)
    for _ in range(int(rng.integers(0, 6))):
        cx, cy, radius = rng.random(), rng.random(), rng.uniform(0.04, 0.25)
        if rng.random() < 0.5:
            inside = np.hypot(x - cx, y - cy) < radius
        else:
            inside = (np.abs(x - cx) < radius) & (np.abs(y - cy) < rng.uniform(0.02, 0.3))
        image[inside] = random_color(rng)
    return _reflectance(image)


def leaf_mask(rng: Rng) -> Array:
    """Opacity ``(H, W, 1)`` of a twig with pointed leaves, 0 or 1."""
    side = 64
    y, x = _grid(side)
    mask = np.abs(x - 0.5) < 0.02
    leaves = int(rng.integers(3, 7))
    for number in range(leaves):
        for sign in (-1, 1):
            angle = rng.uniform(0.4, 0.9) * sign
            dx, dy = x - 0.5, y - (number + 0.6) / (leaves + 0.8)
            along = dx * math.sin(angle) * 1.0 + dy * math.cos(angle)
            across = dx * math.cos(angle) - dy * math.sin(angle)
            width = 0.13 * np.clip(along * (0.42 - along) / 0.044, 0, 1)
            mask |= (np.abs(across) < width) & (along > 0)
    return np.asarray(mask[..., None] * 1.0)


def tint(brightness: Array, color: Color) -> Array:
    """A texture of one color with varying brightness, ``(H, W, 3)`` in 0 to 0.9."""
    return np.asarray(np.clip(brightness[..., None] * np.array(color), 0, 0.9))


def _grid(side: int) -> tuple[Array, Array]:
    y, x = np.mgrid[0:side, 0:side] / side
    return y, x


def _side(rng: Rng) -> int:
    return int(rng.choice([64, 128, 256], p=[0.2, 0.4, 0.4]))


def _noise(side: int, cells: int, rng: Rng) -> Array:
    """Value noise in [0, 1]: random numbers at the corners of a periodic grid, smoothly interpolated."""
    corners = rng.random((cells, cells))
    position = np.arange(side) * cells / side
    low = np.floor(position).astype(int)
    part = position - low
    part = part * part * (3 - 2 * part)
    high = (low + 1) % cells
    rows = corners[low] * (1 - part)[:, None] + corners[high] * part[:, None]
    return np.asarray(rows[:, low] * (1 - part) + rows[:, high] * part)


def _mix(weight: NDArray[np.floating[Any]], rng: Rng) -> Array:
    first, second = random_color(rng), random_color(rng)
    if rng.random() < 0.5:
        # Shades of one colour are more common than two colours.
        factor = rng.uniform(0.25, 0.85)
        second = (first[0] * factor, first[1] * factor, first[2] * factor)
    return _reflectance(weight[..., None] * np.array(first) + (1 - weight[..., None]) * np.array(second))


def _reflectance(image: Array) -> Array:
    return np.asarray(np.clip(image, 0.02, 0.9))
