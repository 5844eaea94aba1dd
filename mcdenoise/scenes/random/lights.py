"""Skies and lamps. Lamps get the power that their surroundings need, so small lamps are bright and cause fireflies."""

from __future__ import annotations

import colorsys
import math
from collections.abc import Callable
from functools import partial

import numpy as np

from mcdenoise.data.camera_path import Array
from mcdenoise.scenes.random.builder import Part, SceneBuilder, Vector, ball, box, drum, plate, rgb, rod, rotate, sheet
from mcdenoise.scenes.random.materials import diffuse, random_metal, random_opaque
from mcdenoise.scenes.random.textures import Color, Rng, log_uniform

Point = tuple[float, float, float]
Limits = tuple[float, float]
_SKY_ROWS = 128


def sky(rng: Rng, level: float, sun: Array | None, sun_ratio: float) -> Array:
    """A lat-long image of a gradient, clouds, a dark ground with a skyline, and a sun.

    Args:
        rng: the source of randomness.
        level: mean radiance of the upper half without the sun.
        sun: unit vector towards the sun, if there is one.
        sun_ratio: irradiance of the sun relative to that of the sky.
    """
    rows, columns = _SKY_ROWS, 2 * _SKY_ROWS
    polar = (np.arange(rows) + 0.5)[:, None] / rows * math.pi
    azimuth = (np.arange(columns) + 0.5)[None] / columns * 2 * math.pi
    up = np.cos(polar)
    ways = np.sin(azimuth) * np.sin(polar), up, -np.cos(azimuth) * np.sin(polar)
    direction = np.stack(np.broadcast_arrays(*ways), axis=-1)
    zenith = np.array(colorsys.hsv_to_rgb(rng.uniform(0.5, 0.65), rng.uniform(0, 0.75), 1))
    horizon = np.array(colorsys.hsv_to_rgb(rng.uniform(0.02, 0.15), rng.uniform(0, 0.6), rng.uniform(0.6, 2.2)))
    height = np.clip(up, 0, 1)[..., None] ** rng.uniform(0.3, 0.8)
    image = zenith * height + horizon * (1 - height) + 0 * direction
    if rng.random() < 0.4:
        image = image * (0.5 + rng.uniform(0.5, 2) * _clouds(rng, direction)[..., None])
    if sun is not None:
        glow = np.clip(direction @ sun, 0, 1)[..., None] ** rng.uniform(8, 60)
        image = image + rng.uniform(0, 3) * glow * np.array((1, 0.85, 0.6))
    above = (up > 0) * np.sin(polar)
    image = image * level / max(float((image.mean(axis=-1) * above).sum() / (above.sum() * columns)), 1e-6)
    ground = level * rng.uniform(0.05, 0.5) * np.array(colorsys.hsv_to_rgb(rng.uniform(0.05, 0.35), 0.4, 1))
    skyline = np.zeros((1, columns))
    for _ in range(int(rng.integers(0, 25))):
        left, width = int(rng.integers(columns)), int(rng.integers(2, 20))
        skyline[0, left : left + width] = rng.uniform(0, 0.35)
    image = np.where((up < skyline)[..., None], ground * rng.uniform(0.4, 1), image)
    image = np.where((up < 0)[..., None], ground, image)
    if sun is not None:
        # One or four pixels, small enough for hard shadows.
        lit = np.argsort(-(direction @ sun), axis=None)[: int(rng.choice([1, 4]))]
        solid = (math.pi / rows) * (2 * math.pi / columns) * np.sin(polar.ravel()[lit // columns])
        warmth = np.array(colorsys.hsv_to_rgb(0.09, rng.uniform(0, 0.6) * (1 - sun[1]), 1))
        image.reshape(-1, 3)[lit] = sun_ratio * math.pi * level * warmth / float(solid.sum())
    return np.asarray(image)


def _clouds(rng: Rng, direction: Array) -> Array:
    """Smooth patches in [0, 1] from a few waves over the direction."""
    total = np.zeros(direction.shape[:-1])
    for octave in range(4):
        for _ in range(3):
            wave = rng.normal(0, 2.5 * 2**octave, 3)
            total += 0.6**octave * np.sin(direction @ wave + rng.uniform(0, 2 * math.pi))
    return np.asarray(1 / (1 + np.exp(-2 * total)))


def sun_direction(rng: Rng, towards: float | None = None) -> Array:
    """A unit vector to the sun at a random height; ``towards`` is its approximate azimuth in degrees."""
    azimuth = math.radians(rng.uniform(0, 360) if towards is None else towards + rng.uniform(-65, 65))
    elevation = math.radians(rng.uniform(6, 75) if towards is None else rng.uniform(6, 50))
    level = math.cos(elevation)
    return np.array((level * math.sin(azimuth), math.sin(elevation), level * math.cos(azimuth)))


def studio(rng: Rng, level: float) -> Array:
    """Dark surroundings with a few bright panels of different colours."""
    rows, columns = 64, 128
    image = np.full((rows, columns, 3), level * rng.uniform(0.02, 0.3))
    for _ in range(int(rng.integers(1, 5))):
        top, left = int(rng.integers(0, 30)), int(rng.integers(columns - 30))
        height, width = int(rng.integers(3, 16)), int(rng.integers(3, 30))
        panel = np.array(light_color(rng)) * level * rng.uniform(2, 20)
        image[top : top + height, left : left + width] = panel
    return image


def light_color(rng: Rng) -> Color:
    """A color from candle light to cold daylight, sometimes saturated."""
    if rng.random() < 0.15:
        color = colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.4, 0.95), 1)
    else:
        warmth = rng.uniform(-0.35, 0.7)
        color = (1.0, 1 - 0.45 * max(warmth, 0) - 0.15 * max(-warmth, 0), 1 - max(warmth, 0))
        if warmth < 0:
            color = (1 + warmth, 1 + 0.4 * warmth, 1.0)
    mean = sum(color) / 3
    return color[0] / mean, max(color[1], 0.02) / mean, max(color[2], 0.02) / mean


def daylight(rng: Rng, sunny: float, level: Limits, ratio: Limits) -> tuple[float, Array | None, float]:
    """Level, sun and ratio of a :func:`sky`, from a sun's probability and the limits of the level and of log ratio."""
    sun = sun_direction(rng) if rng.random() < sunny else None
    return rng.uniform(*level), sun, float(np.exp(rng.uniform(*ratio)))


def add_lamps(builder: SceneBuilder, rng: Rng, count: int, brightness: float) -> None:
    """Add hanging, standing and hidden lamps to a room; together they light its surfaces to about ``brightness``."""
    low, high = builder.low, builder.high
    width, _, depth = high - low
    flux = brightness * math.pi * builder.surface() * 0.5
    for fraction in rng.dirichlet(np.full(count, 1.5)):
        kind = rng.choice(list(_LAMPS), p=[chance for _, chance in _LAMPS.values()])
        x, z = (rng.uniform(low[axis] + 0.15 * s, high[axis] - 0.15 * s) for axis, s in ((0, width), (2, depth)))
        _LAMPS[kind][0](builder, rng, (x, float(high[1]), z), float(flux * fraction), light_color(rng))


def softbox(builder: SceneBuilder, rng: Rng, origin: Array, target: Array, power: float) -> None:
    """An emitting rectangle or ball that faces a target."""
    color, size = light_color(rng), log_uniform(rng, 0.03, 0.6)
    black = builder.material(diffuse((0.02, 0.02, 0.02)))
    if rng.random() < 0.4:
        builder.add([bulb(origin, size / 2, black, power, color)])
        return
    half_size = (size, size * rng.uniform(0.3, 1))
    builder.add([_glowing(origin, half_size, black, power, color, _facing(origin, target, (0.0, 1.0, 0.0)))])


def _facing(origin: Array, target: Array, up: Point) -> Array:
    """A pose at a place whose +z points to a target."""
    axis = (target - origin) / np.linalg.norm(target - origin)
    side = np.cross(up, axis)
    side /= max(float(np.linalg.norm(side)), 1e-6)
    pose = np.eye(4)
    pose[:3] = np.stack((side, np.cross(axis, side), axis, origin), axis=1)
    return pose


def _glowing(
    center: Vector, half: tuple[float, float], material: dict[str, str], power: float, color: Color, rotation: Array
) -> Part:
    """A sheet that sends out a power."""
    return sheet(center, half, material, rotation, scaled(color, power / (math.pi * 4 * half[0] * half[1])))


def _panel(builder: SceneBuilder, rng: Rng, hook: Point, power: float, color: Color, *, tube: bool = False) -> None:
    """A flat light or a tube, under a white board."""
    width, _, depth = builder.high - builder.low
    x, y, z = hook[0], hook[1] - (0.1 if tube else 0.02), hook[2]
    wide, deep = 0.03, 0.3 * float(depth) / 2
    if not tube:
        wide, deep = np.exp(rng.uniform(math.log(0.04), math.log(0.5 * min(width, depth) / 2), 2)).tolist()
    white = builder.material(diffuse((0.8, 0.8, 0.8)))
    glow = _glowing((x, y, z), (wide, deep), white, power, color, rotate("x", 90))
    builder.add([glow, box((x, y + 0.012, z), (2 * wide + 0.06, 0.02, 2 * deep + 0.06), white)])


def _pendant(builder: SceneBuilder, rng: Rng, hook: Point, power: float, color: Color) -> None:
    """A bulb on a cord, bare or under a shade that blocks the light to the ceiling."""
    x, ceiling, z = hook
    radius = log_uniform(rng, 0.02, 0.2)
    y = ceiling - rng.uniform(0.15, 0.45) * float(ceiling - builder.low[1])
    cord = builder.material(diffuse((0.05, 0.05, 0.05)))
    builder.add(
        [rod((x, y + radius, z), hook, 0.006, cord), bulb((x, y, z), radius, cord, power, color)], look=(x, y, z)
    )
    if rng.random() < 0.4:
        shade = builder.material(random_opaque(rng))
        wide, top = radius * rng.uniform(1.3, 2.5), (x, y + 1.5 * radius, z)
        builder.add([rod((x, y - radius, z), top, wide, shade), plate(top, wide, shade)])


def _standing(builder: SceneBuilder, rng: Rng, hook: Point, power: float, color: Color) -> None:
    metal = builder.material(random_metal(rng))
    x, y, z = hook[0], float(builder.low[1]), hook[2]
    top = y + rng.uniform(0.35, 0.7) * float(hook[1] - y)
    radius = rng.uniform(0.04, 0.15)
    builder.add([*drum((x, y, z), 0.03, 0.15, metal), rod((x, y, z), (x, top - radius, z), 0.015, metal)])
    builder.add([bulb((x, top, z), radius, metal, power, color)], look=(x, top, z))
    if rng.random() < 0.5:
        shade = builder.material(random_opaque(rng))
        builder.add([rod((x, top - 1.4 * radius, z), (x, top + 1.4 * radius, z), 1.8 * radius, shade)])


def _cove(builder: SceneBuilder, rng: Rng, _: Point, power: float, color: Color) -> None:
    """A light strip behind a board under the ceiling, so that everything below is lit indirectly."""
    low, high = builder.low, builder.high
    side = int(rng.choice([-1, 1]))
    x = float(low[0] if side < 0 else high[0]) - side * 0.12
    y, z = float(high[1]) - 0.35, float(low[2] + high[2]) / 2
    length = 0.85 * float(high[2] - low[2])
    white = builder.material(diffuse((0.8, 0.8, 0.8)))
    glow = _glowing((x, y + 0.03, z), (0.04, length / 2), white, 1.5 * power, color, rotate("x", -90))
    rim = box((x - side * 0.1, y + 0.06, z), (0.02, 0.15, length), white)
    builder.add([glow, box((x, y, z), (0.2, 0.03, length), white), rim])


def _chandelier(builder: SceneBuilder, rng: Rng, hook: Point, power: float, color: Color) -> None:
    metal = builder.material(random_metal(rng))
    bulbs, radius = 3, rng.uniform(0.2, 0.5)
    middle = (hook[0], hook[1] - rng.uniform(0.4, 0.8), hook[2])
    builder.add([rod(middle, hook, 0.012, metal)], look=middle)
    for number in range(bulbs):
        angle = 2 * math.pi * number / bulbs
        x, y, z = hook[0] + radius * math.cos(angle), middle[1] + 0.08, hook[2] + radius * math.sin(angle)
        builder.add([rod(middle, (x, y, z), 0.01, metal), bulb((x, y + 0.05, z), 0.04, metal, power / bulbs, color)])


def _spot(builder: SceneBuilder, rng: Rng, hook: Point, power: float, color: Color, *, narrow: bool = True) -> None:
    """A spot light directed at the floor, or a point light."""
    width, _, depth = builder.high - builder.low
    origin = np.array((hook[0], hook[1] - 0.15, hook[2]))
    target = np.array((hook[0], builder.low[1], hook[2])) + rng.uniform(-1, 1, 3) * (0.3 * width, 0, 0.3 * depth)
    if not narrow:
        intensity = rgb(scaled(color, power / (4 * math.pi)))
        builder.add_light({"type": "point", "position": origin.tolist(), "intensity": intensity})
        return
    cutoff = rng.uniform(15, 55)
    intensity = rgb(scaled(color, power / (2 * math.pi * (1 - math.cos(math.radians(cutoff)))) * 0.5))
    pose = _facing(origin, target, (0.0, 0.0, 1.0))
    builder.add_light({"type": "spot", "to_world": pose, "cutoff_angle": cutoff, "intensity": intensity})


# Lamps, which hang from a hook on the ceiling or stand below it, and how often they are.
_LAMPS: dict[str, tuple[Callable[[SceneBuilder, Rng, Point, float, Color], None], float]] = {
    "panel": (_panel, 0.24),
    "tube": (partial(_panel, tube=True), 0.1),
    "bulb": (_pendant, 0.2),
    "standing": (_standing, 0.14),
    "cove": (_cove, 0.1),
    "spot": (_spot, 0.1),
    "point": (partial(_spot, narrow=False), 0.04),
    "chandelier": (_chandelier, 0.08),
}


def bulb(center: Vector, radius: float, material: dict[str, str], power: float, color: Color) -> Part:
    """A ball that sends out a power."""
    return ball(center, radius, material, scaled(color, power / (4 * math.pi**2 * radius**2)))


def scaled(color: Color, factor: float) -> Color:
    """A color of another brightness."""
    return color[0] * factor, color[1] * factor, color[2] * factor
