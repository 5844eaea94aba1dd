"""Rooms without furniture, procedural furniture for them, still lifes, colonnades and light experiments."""

from __future__ import annotations

import math

import numpy as np

from mcdenoise.data.camera_path import Array
from mcdenoise.scenes.random.builder import TURNS, SceneBuilder, ball, box, place, rod, sheet
from mcdenoise.scenes.random.furniture import curtain, decorate, furniture, glass_block, ornament, picture_frame
from mcdenoise.scenes.random.lights import daylight, sky, softbox, studio
from mcdenoise.scenes.random.materials import (
    Bsdf,
    diffuse,
    pane,
    random_metal,
    random_opaque,
    rough_metal,
    rough_plastic,
)
from mcdenoise.scenes.random.textures import Color, Rng, log_uniform, texture, wall_color

# A room with more shapes than this gets no more furniture.
_ENOUGH_SHAPES = 290
_WALL = 0.25
# Probability of blinds or curtains: light through them takes more samples than a reference has.
_DRESSED = 0.2


def still_life(rng: Rng) -> SceneBuilder:
    """Ornaments on a table or on the ground, under the sky or in a studio."""
    builder = SceneBuilder((-1.9, 0.05, -1.9), (1.9, 1.5, 1.9))
    repeat = float(rng.integers(6, 25))
    top = builder.material(random_opaque(rng, (repeat, repeat), textured=0.7))
    builder.add([box((0, -0.05, 0), (12, 0.1, 12), top)])
    if rng.random() < 0.5:
        back = builder.material(random_opaque(rng, (4, 2)))
        builder.add([box((0, 1.5, -1.5), (12, 3.2, 0.1), back)])
        builder.low[2] = -1.4
        if rng.random() < 0.5:
            builder.add([box((-1.9, 1.5, 0), (0.1, 3.2, 6), builder.material(random_opaque(rng, (2, 1))))])
            builder.low[0] = -1.8
    decorate(builder, rng, (0, 0, 0), rng.uniform(0.6, 1.1), int(rng.integers(6, 16)))
    for _ in range(int(rng.integers(0, 4))):
        size = rng.uniform(0.15, 0.6)
        x, z = rng.uniform(-0.7, 0.7, 2)
        builder.add(glass_block(builder, rng, size), place((x, 0, z)), movable=True, look=(0, size / 2, 0))
    light = rng.random()
    if light < 0.45:
        builder.set_sky(sky(rng, *daylight(rng, 0.7, (0.3, 1), (-0.7, 1.8))))
    elif light < 0.6:
        builder.set_sky(studio(rng, 0.5))
    if light > 0.45:
        lights = int(rng.integers(1, 5))
        for _ in range(lights):
            angle, away = rng.uniform(0, 2 * math.pi), rng.uniform(0.8, 2.0)
            origin = np.array((away * math.cos(angle), rng.uniform(0.8, 2.4), away * math.sin(angle)))
            softbox(builder, rng, origin, rng.uniform(-0.4, 0.4, 3) * (1, 0, 1), rng.uniform(8, 40) / lights)
    return builder


def colonnade(rng: Rng) -> SceneBuilder:
    """A courtyard under the sky with columns, surrounded by galleries that receive little light from the sky."""
    width, depth, height = rng.uniform(4, 9), rng.uniform(6, 14), rng.uniform(2.6, 4.2)
    aisle, floors = rng.uniform(1.5, 3), int(rng.integers(1, 3))
    outer = width / 2 + aisle
    builder = SceneBuilder((-outer + 0.4, 0.3, -depth / 2), (outer - 0.4, height * floors, depth / 2))
    stone = builder.material(_coat(rng, wall_color(rng)))
    wall = builder.material(random_opaque(rng, (4, 2), textured=0.7))
    shaft = builder.material(random_opaque(rng, (2, 3), textured=0.5))
    floor = builder.material(random_opaque(rng, (float(round(width)), float(round(depth))), textured=0.8))
    builder.add([box((0, -0.1, 0), (2 * outer + 2, 0.2, depth + 4), floor)])
    columns = int(rng.integers(3, 8))
    radius, round_shafts = rng.uniform(0.12, 0.35), rng.random() < 0.7
    for side in (-1, 1):
        builder.add([box((side * outer, floors * height / 2, 0), (0.3, floors * height, depth), wall)])
        for level in range(floors):
            base, x = level * height, side * width / 2
            for z in np.linspace(-depth / 2 + 0.4, depth / 2 - 0.4, columns):
                if round_shafts:
                    builder.add([rod((x, base, z), (x, base + height - 0.3, z), radius, shaft)])
                else:
                    builder.add([box((x, base + height / 2, z), (2 * radius, height, 2 * radius), shaft)])
                builder.add([box((x, base + height - 0.3, z), (2.8 * radius, 0.15, 2.8 * radius), stone)])
                builder.add([box((x, base + 0.06, z), (2.8 * radius, 0.12, 2.8 * radius), stone)])
            roof = (side * (width / 2 + aisle / 2), base + height - 0.1, 0)
            builder.add([box(roof, (aisle + 2 * radius, 0.2, depth), stone)])
    for end in (-1, 1):
        if rng.random() < 0.75:
            middle = (0, floors * height / 2, end * (depth / 2 + 0.15))
            builder.add([box(middle, (2 * outer, floors * height, 0.3), wall)])
    for z in np.linspace(-depth / 2, depth / 2, int(rng.integers(2, 6))):
        if rng.random() < 0.5:
            cloth = place((float(rng.choice([-1, 1])) * (width / 2 - radius), height - 0.2, z), 90)
            builder.add(curtain(builder, rng, 1.0, rng.uniform(0.8, 1.8)), cloth)
    for _ in range(int(rng.integers(2, 7))):
        _put_on_floor(builder, rng, [])
    for _ in range(6):
        builder.points.append(rng.uniform(builder.low * (1, 1, 0.9), builder.high * (1, 0.7, 0.9)))
    builder.set_sky(sky(rng, *daylight(rng, 0.75, (0.6, 1.8), (-0.5, 1.8))))
    return builder


def light_experiment(rng: Rng) -> SceneBuilder:
    """Glossy plates that reflect emitting balls of very different sizes."""
    builder = SceneBuilder((-2.4, 0.3, -1.2), (2.4, 2.6, 4))
    builder.add([box((0, -0.1, 1), (8, 0.2, 8), builder.material(random_opaque(rng, (3, 3))))])
    builder.add([box((0, 2, -2.2), (8, 5, 0.2), builder.material(random_opaque(rng, (3, 2))))])
    metal = rng.random() < 0.6
    plates, lights = int(rng.integers(3, 6)), int(rng.integers(3, 6))
    for number in range(plates):
        alpha = log_uniform(rng, 0.02, 0.4)
        look = texture(rng) if rng.random() < 0.3 else wall_color(rng)
        material = builder.material(rough_metal("Al", alpha) if metal else _coat(rng, look, alpha))
        angle = 12 + 50 * number / plates
        center = (0, 0.15 + 0.7 * (1 - math.cos(math.radians(angle))) * 1.6, 0.9 - 0.55 * number)
        builder.add([box(center, (3.6, 0.03, 0.45), material, tilt=angle)], look=center)
    black = builder.material(diffuse((0.02, 0.02, 0.02)))
    for number, radius in enumerate(np.geomspace(0.02, 0.35, lights)):
        x = (number - (lights - 1) / 2) * 3.4 / lights
        power = 6 * float(np.exp(rng.uniform(-0.7, 0.7))) / lights
        red, green, blue = (channel * power / (math.pi * radius**2) for channel in wall_color(rng))
        builder.add([ball((x, rng.uniform(1.6, 2.1), -1.2), radius, black, (red, green, blue))], movable=True)
    # Without this light the far corners would be black.
    builder.set_sky(studio(rng, rng.uniform(0.03, 0.2)))
    for _ in range(int(rng.integers(1, 5))):
        where = (rng.uniform(-1.8, 1.8), 0, rng.uniform(1.2, 2.2))
        builder.add(ornament(builder, rng, rng.uniform(0.2, 0.5)), place(where, rng.uniform(0, 360)), movable=True)
    return builder


def empty_room(rng: Rng) -> SceneBuilder:
    """Floor, ceiling, beams and pillars; the walls are added later."""
    large = rng.random() < 0.25
    size = rng.uniform((2.4, 2.3, 3.0), (5.5, 3.2, 6.5)) * ((1.6, 1.4, 1.6) if large else (1, 1, 1))
    width, height, depth = size
    builder = SceneBuilder((-width / 2, 0, -depth / 2), (width / 2, height, depth / 2))
    repeat = float(rng.integers(1, 6))
    ground = random_opaque(rng, (repeat, round(repeat * depth / width)), textured=0.85)
    builder.add([box((0, -0.1, 0), (width + 2 * _WALL, 0.2, depth + 2 * _WALL), builder.material(ground))])
    white = builder.material(diffuse(wall_color(rng)))
    builder.add([box((0, height + 0.1, 0), (width + 2 * _WALL, 0.2, depth + 2 * _WALL), white)])
    if rng.random() < 0.35:
        wood = builder.material(random_opaque(rng, (1, 4), textured=0.6))
        for z in np.linspace(-depth / 2, depth / 2, int(rng.integers(3, 9)))[1:-1]:
            builder.add([box((0, height - 0.09, z), (width, 0.18, 0.12), wood)])
    if rng.random() < 0.3:
        pillar = builder.material(random_opaque(rng, (1, 3)))
        x, z = rng.uniform(-0.3, 0.3, 2) * (width, depth)
        builder.add([rod((x, 0, z), (x, height, z), rng.uniform(0.06, 0.2), pillar)])
    if rng.random() < 0.5:
        rug = builder.material(random_opaque(rng, textured=0.95))
        where = (rng.uniform(-0.15, 0.15) * width, 0.006, 0)
        builder.add([box(where, (width * rng.uniform(0.3, 0.7), 0.012, depth * rng.uniform(0.3, 0.6)), rug)])
    return builder


def _wall_frame(builder: SceneBuilder, wall: int) -> tuple[Array, float, float]:
    """Placement of a wall (+z points into the room, y = 0 is the floor), its length and its height."""
    width, height, depth = builder.high - builder.low
    position = [(0, 0, -depth / 2), (-width / 2, 0, 0), (0, 0, depth / 2), (width / 2, 0, 0)][wall]
    return place(position, TURNS[wall]), float(width if wall % 2 == 0 else depth), float(height)


def closed_wall(builder: SceneBuilder, rng: Rng, wall: int) -> None:
    """A wall without windows, with pictures, and at times a door."""
    frame, length, height = _wall_frame(builder, wall)
    look = texture(rng) if rng.random() < 0.35 else wall_color(rng)
    surface = builder.material(_coat(rng, look, repeat=(float(rng.integers(1, 5)), float(rng.integers(1, 4)))))
    parts = [box((0, height / 2, -_WALL / 2), (length + 2 * _WALL, height, _WALL), surface)]
    if rng.random() < 0.6:
        trim = builder.material(diffuse(wall_color(rng)))
        parts.append(box((0, 0.05, 0.01), (length, 0.1, 0.02), trim))
    if rng.random() < 0.3:
        door = builder.material(random_opaque(rng, textured=0.5))
        x = rng.uniform(-0.3, 0.3) * length
        parts.append(box((x, 1.0, 0.015), (0.85, 2.0, 0.05), door))
        parts.append(ball((x + 0.35, 1.0, 0.07), 0.03, builder.material(random_metal(rng))))
    builder.add(parts, frame)
    for _ in range(int(rng.integers(0, 4))):
        where = place((rng.uniform(-0.4, 0.4) * length, rng.uniform(0.45, 0.75) * height, 0.0))
        builder.add(picture_frame(builder, rng), frame @ where, look=(0, 0, 0))


def wall_with_windows(builder: SceneBuilder, rng: Rng, wall: int, glow: Color | None = None) -> float:
    """A wall with a row of windows with bars; returns the windows' area.

    Args:
        builder: collects the objects.
        rng: the source of randomness.
        wall: 0 to 3.
        glow: radiance of a sheet behind each window, instead of what is outside.
    """
    frame, length, height = _wall_frame(builder, wall)
    count = int(rng.integers(1, 4)) if length > 3 else 1
    sill = float(rng.choice([0.0, rng.uniform(0.3, 1.1)], p=[0.2, 0.8]))
    top = rng.uniform(0.75, 0.95) * height
    pitch = length / count
    wide = pitch * rng.uniform(0.25, 0.85)
    surface = builder.material(_coat(rng, wall_color(rng)))
    bar = builder.material(diffuse(wall_color(rng)))
    over = height - top
    parts = [box((0, height - over / 2, -_WALL / 2), (length + 2 * _WALL, over, _WALL), surface)]
    if sill > 0:
        parts.append(box((0, sill / 2, -_WALL / 2), (length + 2 * _WALL, sill, _WALL), surface))
        parts.append(box((0, sill, 0.05), (length * 0.98, 0.03, 0.14), bar))
    middles = [(number + 0.5) * pitch - length / 2 for number in range(count)]
    edges = [-length / 2 - _WALL, *(x + s * wide / 2 for x in middles for s in (-1, 1)), length / 2 + _WALL]
    for left, right in zip(edges[::2], edges[1::2], strict=True):
        middle = ((left + right) / 2, (sill + top) / 2, -_WALL / 2)
        parts.append(box(middle, (right - left, top - sill, _WALL), surface))
    columns, rows = (int(n) for n in rng.integers(0, 4, 2))
    glazed = rng.random() < 0.12
    dressing = rng.choice(["none", "blinds", "curtains"], p=[1 - _DRESSED, 0.4 * _DRESSED, 0.6 * _DRESSED])
    tall = top - sill
    for x in middles:
        for n in range(columns):
            left = x + wide * ((n + 1) / (columns + 1) - 0.5)
            parts.append(box((left, sill + tall / 2, -0.12), (0.04, tall, 0.05), bar))
        for n in range(rows):
            parts.append(box((x, sill + tall * (n + 1) / (rows + 1), -0.12), (wide, 0.04, 0.05), bar))
        if glow is not None:
            black = builder.material(diffuse((0.02, 0.02, 0.02)))
            parts.append(sheet((x, sill + tall / 2, -_WALL - 0.02), (wide / 2, tall / 2), black, radiance=glow))
        if glazed:
            parts.append(sheet((x, sill + tall / 2, -0.14), (wide / 2, tall / 2), builder.material(pane())))
        if dressing == "blinds":
            slats = int(np.clip(tall / 0.08, 6, 24))
            tilt, slat = rng.uniform(-50, 50), (wide, 0.004, tall / slats * 0.9)
            parts += [box((x, sill + tall * (n + 0.5) / slats, -0.05), slat, bar, 0, tilt) for n in range(slats)]
        elif dressing == "curtains":
            part = wide * rng.uniform(0.2, 0.45)
            for side in (-1, 1):
                hook = place((x + side * (wide - part) / 2, top + 0.1, 0.12))
                builder.add(curtain(builder, rng, part, top if rng.random() < 0.5 else tall + 0.2), frame @ hook)
    builder.add(parts, frame, look=(middles[0], (sill + top) / 2, 0.3))
    return count * wide * (top - sill) * (0.5 if dressing != "none" else 1)


def furnish(builder: SceneBuilder, rng: Rng) -> None:
    """Put procedural furniture on the floor of a room, in proportion to its area."""
    size = builder.high - builder.low
    taken: list[tuple[float, float, float]] = []
    pieces = int(np.clip(size[0] * size[2] / rng.uniform(2.5, 6), 2, 9))
    for _ in range(pieces):
        if len(builder.boxes()[0]) > _ENOUGH_SHAPES:
            break
        _put_on_floor(builder, rng, taken)


def _put_on_floor(builder: SceneBuilder, rng: Rng, taken: list[tuple[float, float, float]]) -> None:
    """Find a free place for a piece of furniture, usually along the walls, and put objects on it.

    ``taken`` has x, z and radius of existing pieces; the new one is added.
    """
    low, high = builder.low, builder.high
    parts, radius, top = furniture(builder, rng, float(high[1]))
    for _ in range(12):
        lowest = low + radius
        x, z = (rng.uniform(lowest[axis], max(high[axis] - radius, lowest[axis] + 0.01)) for axis in (0, 2))
        turn = rng.uniform(0, 360) if rng.random() < 0.4 else 90 * float(rng.integers(4))
        if rng.random() < 0.6:
            wall = int(rng.integers(4))
            turn = TURNS[wall]
            first, last = low + 0.6 * radius, high - 0.6 * radius
            x, z = ((x, first[2]), (first[0], z), (x, last[2]), (last[0], z))[wall]
        if all(math.hypot(x - a, z - b) > radius + c for a, b, c in taken):
            taken.append((x, z, radius))
            builder.add(parts, place((x, 0, z), turn), movable=len(parts) < 12 and top == 0)
            lows, highs = (corners[-len(parts) :] for corners in builder.boxes())
            builder.points.append((lows.min(axis=0) + highs.max(axis=0)) / 2)
            if top > 0:
                decorate(builder, rng, (x, top, z), 0.6 * radius, int(rng.integers(1, 5)))
            return


def _coat(rng: Rng, look: Color | Array, alpha: float = 0.0, repeat: tuple[float, float] = (1, 1)) -> Bsdf:
    """Paint for walls: diffuse, or glossy with the given roughness."""
    if alpha == 0 and rng.random() < 0.7:
        return diffuse(look, repeat)
    return rough_plastic(look, alpha or rng.uniform(0.1, 0.4), repeat)
