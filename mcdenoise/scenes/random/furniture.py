"""Furniture and ornaments made of simple shapes; each stands on y = 0 around the vertical axis, in metres."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import product
from typing import TypeAlias

import numpy as np

from mcdenoise.scenes.random.builder import Part, SceneBuilder, ball, box, drum, place, plate, rod, rotate, sheet
from mcdenoise.scenes.random.materials import (
    diffuse,
    foliage,
    glass,
    pane,
    random_material,
    random_metal,
    random_opaque,
)
from mcdenoise.scenes.random.textures import Rng, picture, random_color

# Parts, radius, and the height of the top, 0 without one.
Piece: TypeAlias = tuple[list[Part], float, float]


def ornament(builder: SceneBuilder, rng: Rng, size: float) -> list[Part]:
    """A small object of about ``size`` metres to put on a table."""
    ornaments = _ball, _ball, _block, _can, _goblet, _ring, _heap, _urchin, _book_pile, _stack, _plant
    return ornaments[int(rng.integers(len(ornaments)))](builder, rng, size)


def furniture(builder: SceneBuilder, rng: Rng, height: float) -> Piece:
    """A piece of furniture for a room of that height, its radius, and the height of its top (0 if it has none)."""
    makers: list[Callable[[SceneBuilder, Rng, float], Piece]] = [_table, _table, _chair, _chair, _shelf, _sofa, _stairs]
    makers += [_screen, _crates, _big_plant, _pedestal, _railing]
    return makers[int(rng.integers(len(makers)))](builder, rng, height)


def picture_frame(builder: SceneBuilder, rng: Rng) -> list[Part]:
    """A picture of about a metre to hang on a wall; it faces +z, with its centre at the origin."""
    width, height = rng.uniform(0.3, 1.4), rng.uniform(0.3, 1.1)
    frame = builder.material(random_opaque(rng, textured=0.2))
    image = builder.material(diffuse(picture(rng)))
    parts = [
        box((0, 0, 0.02), (width + 0.1, height + 0.1, 0.04), frame),
        sheet((0, 0, 0.045), (width / 2, height / 2), image),
    ]
    if rng.random() < 0.3:
        parts.append(sheet((0, 0, 0.06), (width / 2, height / 2), builder.material(pane())))
    return parts


def curtain(builder: SceneBuilder, rng: Rng, width: float, height: float) -> list[Part]:
    """Folded cloth along x that hangs down from y = 0."""
    cloth = builder.material(random_opaque(rng, (0.2, 3)))
    folds = int(np.clip(width / rng.uniform(0.06, 0.14), 4, 30))
    step = width / folds
    slope = rng.uniform(25, 60)
    half, turns = (step / 2 / math.cos(math.radians(slope)), height / 2), (rotate("y", -slope), rotate("y", slope))
    middles = [(-width / 2 + step * (fold + 0.5), -height / 2, 0) for fold in range(folds)]
    return [sheet(middle, half, cloth, turns[fold % 2]) for fold, middle in enumerate(middles)]


def decorate(builder: SceneBuilder, rng: Rng, center: tuple[float, float, float], radius: float, count: int) -> None:
    """Put ornaments onto a surface without overlap."""
    taken: list[tuple[float, float, float]] = []
    for _ in range(3 * count):
        size = rng.uniform(0.15, 0.5) * min(radius, 1.0)
        angle, away = rng.uniform(0, 2 * math.pi), (radius - size / 2) * math.sqrt(rng.random()) * 0.85
        x, z = center[0] + away * math.cos(angle), center[2] + away * math.sin(angle)
        if any(math.hypot(x - a, z - b) < 0.5 * (size + c) for a, b, c in taken):
            continue
        taken.append((x, z, size))
        parts, frame = ornament(builder, rng, size), place((x, center[1], z), rng.uniform(0, 360))
        builder.add(parts, frame, movable=True, look=(0, 0.5 * size, 0))
        if len(taken) == count:
            return


def glass_block(builder: SceneBuilder, rng: Rng, size: float) -> list[Part]:
    """A solid piece of glass that causes caustics."""
    material = builder.material(glass(rng.uniform(1.4, 1.7)))
    if rng.random() < 0.6:
        return [ball((0, size / 2, 0), size / 2, material)]
    return [box((0, size / 2, 0), (size * 0.6, size, size * 0.6), material, rng.uniform(0, 90))]


def _ball(builder: SceneBuilder, rng: Rng, size: float) -> list[Part]:
    return [ball((0, size / 2, 0), size / 2, builder.material(random_material(rng)))]


def _block(builder: SceneBuilder, rng: Rng, size: float) -> list[Part]:
    width, height, depth = size * rng.uniform(0.4, 1, 3)
    return [box((0, height / 2, 0), (width, height, depth), builder.material(random_material(rng)))]


def _can(builder: SceneBuilder, rng: Rng, size: float) -> list[Part]:
    return drum((0, 0, 0), size * rng.uniform(0.5, 1.2), size * rng.uniform(0.15, 0.4), _any(builder, rng))


def _goblet(builder: SceneBuilder, rng: Rng, size: float) -> list[Part]:
    """Foot, stem and bowl: a glass, a candlestick, a lamp without light."""
    material = _any(builder, rng)
    bowl = size * rng.uniform(0.2, 0.35)
    return [
        *drum((0, 0, 0), 0.04 * size, bowl * 0.9, material),
        rod((0, 0.04 * size, 0), (0, 0.5 * size, 0), 0.05 * size, material),
        ball((0, 0.5 * size + bowl, 0), bowl, material),
    ]


def _ring(builder: SceneBuilder, rng: Rng, size: float) -> list[Part]:
    """Beads along an upright or a lying circle."""
    material = builder.material(random_opaque(rng) if rng.random() < 0.5 else random_metal(rng))
    beads, radius = int(rng.integers(10, 25)), 0.4 * size
    bead = min(radius * math.sin(math.pi / beads) * rng.uniform(0.8, 1.4), 0.2 * size)
    upright = rng.random() < 0.5
    angles = [2 * math.pi * number / beads for number in range(beads)]
    places = [(math.cos(angle) * radius, math.sin(angle) * radius) for angle in angles]
    return [ball((c, radius + bead + s, 0) if upright else (c, bead, s), bead, material) for c, s in places]


def _heap(builder: SceneBuilder, rng: Rng, size: float) -> list[Part]:
    """Overlapping balls: fruit, stones, a blob."""
    materials = [_any(builder, rng) for _ in range(int(rng.integers(1, 4)))]
    parts = []
    for _ in range(int(rng.integers(5, 16))):
        radius = size * rng.uniform(0.08, 0.24)
        x, z = rng.uniform(-0.35, 0.35, 2) * size
        y = radius + rng.uniform(0, 0.6) * max(0.0, 0.5 - math.hypot(x, z) / size) * size
        parts.append(ball((x, y, z), radius, materials[int(rng.integers(len(materials)))]))
    return parts


def _urchin(builder: SceneBuilder, rng: Rng, size: float) -> list[Part]:
    """A ball with spikes, which are thinner than a pixel."""
    material = builder.material(random_opaque(rng) if rng.random() < 0.7 else random_metal(rng))
    center = np.array((0, 0.5 * size, 0))
    parts = [ball(center, 0.15 * size, material)]
    for _ in range(int(rng.integers(20, 45))):
        axis = rng.standard_normal(3)
        tip = center + 0.5 * size * axis / np.linalg.norm(axis)
        parts.append(rod(center, tip, 0.01 * size, material))
    return parts


def _book_pile(builder: SceneBuilder, rng: Rng, size: float) -> list[Part]:
    parts, top = [], 0.0
    for _ in range(int(rng.integers(2, 7))):
        thick = size * rng.uniform(0.05, 0.16)
        material = builder.material(random_opaque(rng))
        where = (rng.uniform(-0.05, 0.05) * size, top + thick / 2, 0)
        sizes = (size * rng.uniform(0.6, 0.9), thick, size * rng.uniform(0.45, 0.65))
        parts.append(box(where, sizes, material, rng.uniform(-25, 25)))
        top += thick
    return parts


def _stack(builder: SceneBuilder, rng: Rng, size: float) -> list[Part]:
    """Bodies of revolution on top of each other: a vase, a bottle, a chess piece."""
    material = _any(builder, rng)
    parts, top = [], 0.0
    for _ in range(int(rng.integers(2, 5))):
        radius = size * rng.uniform(0.1, 0.3)
        if rng.random() < 0.5:
            parts.append(ball((0, top + radius, 0), radius, material))
            top += 1.8 * radius
        else:
            height = size * rng.uniform(0.05, 0.35)
            parts.extend(drum((0, top, 0), height, radius, material))
            top += height
    return parts


def _plant(builder: SceneBuilder, rng: Rng, size: float) -> list[Part]:
    pot = builder.material(random_opaque(rng))
    green = (rng.uniform(0.03, 0.2), rng.uniform(0.15, 0.45), rng.uniform(0.02, 0.15))
    leaf = builder.material(foliage(rng, green if rng.random() < 0.8 else random_color(rng)))
    parts = drum((0, 0, 0), 0.3 * size, 0.17 * size, pot)
    for _ in range(int(rng.integers(10, 28))):
        turn, lean, length = rng.uniform(0, 360), rng.uniform(5, 80), size * rng.uniform(0.3, 0.75)
        rotation = rotate("y", turn) @ rotate("x", lean)
        center = np.array((0, 0.3 * size, 0)) + rotation[:3, 1] * length / 2
        half = (length * rng.uniform(0.12, 0.4), length / 2)
        parts.append(sheet(center, half, leaf, rotation @ rotate("y", rng.uniform(-40, 40))))
    return parts


def _table(builder: SceneBuilder, rng: Rng, _: float) -> Piece:
    top, legs = builder.material(random_opaque(rng, textured=0.6)), _any_opaque(builder, rng)
    height, thick = rng.uniform(0.4, 0.95), rng.uniform(0.02, 0.07)
    if rng.random() < 0.35:
        radius = rng.uniform(0.3, 0.8)
        plinth = [rod((0, 0, 0), (0, height, 0), 0.05, legs), plate((0, 0.01, 0), 0.5 * radius, legs)]
        return [*drum((0, height - thick, 0), thick, radius, top), *plinth], radius, height
    width, depth = rng.uniform(0.6, 1.8), rng.uniform(0.5, 1.0)
    parts = [box((0, height - thick / 2, 0), (width, thick, depth), top)]
    leg = rng.uniform(0.02, 0.08)
    for x, z in product((-1, 1), repeat=2):
        foot = (x * (width / 2 - leg), (height - thick) / 2, z * (depth / 2 - leg))
        parts.append(box(foot, (leg, height - thick, leg), legs))
    return parts, math.hypot(width, depth) / 2, height


def _chair(builder: SceneBuilder, rng: Rng, _: float) -> Piece:
    wood, seat = _any_opaque(builder, rng), _any_opaque(builder, rng)
    back = rng.uniform(0.8, 1.15)
    parts = [box((0, 0.45, 0), (0.44, 0.04, 0.44), seat)]
    for x, (z, top) in product((-0.2, 0.2), ((0.2, 0.45), (-0.2, back))):
        parts.append(rod((x, 0, z), (x, top, z), 0.018, wood))
    bars = int(rng.integers(2, 7))
    if rng.random() < 0.5:
        parts.extend(box((0, 0.55 + (back - 0.6) * n / bars, -0.2), (0.4, 0.04, 0.02), wood) for n in range(bars))
    else:
        parts.extend(rod((x, 0.45, -0.2), (x, back, -0.2), 0.01, wood) for x in np.linspace(-0.15, 0.15, bars))
        parts.append(box((0, back, -0.2), (0.44, 0.06, 0.03), wood))
    return parts, 0.35, 0.0


def _shelf(builder: SceneBuilder, rng: Rng, height: float) -> Piece:
    """Shelves with books and jars, open towards +z."""
    wood = builder.material(random_opaque(rng, textured=0.5))
    width, depth, boards = rng.uniform(0.7, 1.4), rng.uniform(0.22, 0.35), int(rng.integers(2, 5))
    top = min(rng.uniform(0.8, 2.1), height - 0.3)
    covers = [_any_opaque(builder, rng) for _ in range(6)] + [builder.material(random_material(rng))]
    parts = [box((x * width / 2, top / 2, 0), (0.03, top, depth), wood) for x in (-1, 1)]
    parts.append(box((0, top / 2, -depth / 2), (width, top, 0.015), wood))
    for y in np.linspace(0.05, top, boards + 1):
        parts.append(box((0, y, 0), (width, 0.025, depth), wood))
    gap = (top - 0.05) / boards
    for board in range(boards):
        base, x = 0.05 + gap * board + 0.0125, -width / 2 + 0.03
        while x < width / 2 - 0.13 and len(parts) < 75:
            cover = covers[int(rng.integers(len(covers)))]
            thick, tall = rng.uniform(0.02, 0.08), rng.uniform(0.5, 0.9) * gap
            if rng.random() < 0.85:
                parts.append(box((x + thick / 2, base + tall / 2, 0), (thick, tall, depth * 0.8), cover))
                x += thick + 0.002
            else:
                radius = min(0.05, 0.4 * gap)
                parts.append(ball((x + radius, base + radius, 0), radius, cover))
                x += 2 * radius + rng.uniform(0, 0.2)
    return parts, 0.5 * width, 0.0


def _sofa(builder: SceneBuilder, rng: Rng, _: float) -> Piece:
    cloth = builder.material(random_opaque(rng, (3, 3)))
    width = rng.uniform(0.8, 2.0)
    parts = [
        box((0, 0.22, 0), (width, 0.36, 0.8), cloth),
        box((0, 0.55, -0.32), (width, 0.6, 0.18), cloth, tilt=-8),
        *(box((x, 0.32, 0), (0.16, 0.55, 0.8), cloth) for x in (-width / 2, width / 2)),
    ]
    for _cushion in range(int(rng.integers(0, 4))):
        cushion = builder.material(random_opaque(rng, textured=0.7))
        x = rng.uniform(-0.35, 0.35) * width
        parts.append(box((x, 0.55, -0.1), (0.4, 0.4, 0.12), cushion, rng.uniform(-30, 30), -20))
    return parts, math.hypot(width, 0.8) / 2, 0.0


def _stairs(builder: SceneBuilder, rng: Rng, height: float) -> Piece:
    stone, rail = _any_opaque(builder, rng), _any_opaque(builder, rng)
    steps, width = int(rng.integers(4, 10)), rng.uniform(0.6, 1.2)
    rise, tread = min(0.18, (height - 0.5) / steps), 0.26
    parts = []
    for step in range(steps):
        z, top = (step - steps / 2 + 0.5) * tread, rise * (step + 1)
        parts.append(box((0, top / 2, z), (width, top, tread), stone))
        parts.append(rod((width / 2, top, z), (width / 2, top + 0.7, z), 0.012, rail))
    start, end = ((width / 2, rise * n + 0.7, (n - steps / 2 - 0.5) * tread) for n in (1, steps))
    parts.append(rod(start, end, 0.025, rail))
    return parts, steps * tread / 2 + 0.2, 0.0


def _screen(builder: SceneBuilder, rng: Rng, height: float) -> Piece:
    """A folding screen: closed panels or slats."""
    material = builder.material(random_opaque(rng, textured=0.6))
    tall, panels, slope = min(rng.uniform(1.0, 1.9), height - 0.4), int(rng.integers(2, 5)), rng.uniform(20, 60)
    slats = rng.random() < 0.4
    parts: list[Part] = []
    for number in range(panels):
        x, turn = (number - panels / 2 + 0.5) * 0.45, slope if number % 2 else -slope
        if slats:
            count = int(rng.integers(8, 16))
            heights = np.linspace(0.1, tall, count)
            parts.extend(box((x, y, 0), (0.5, tall / count * 0.5, 0.015), material, turn, 25) for y in heights)
        else:
            parts.append(box((x, tall / 2, 0), (0.5, tall, 0.025), material, turn))
    return parts, 0.25 * panels + 0.1, 0.0


def _crates(builder: SceneBuilder, rng: Rng, _: float) -> Piece:
    parts: list[Part] = []
    for _crate in range(int(rng.integers(1, 5))):
        edge = rng.uniform(0.2, 0.6)
        x, z = rng.uniform(-0.3, 0.3, 2)
        parts.append(box((x, edge / 2, z), (edge, edge, edge), _any_opaque(builder, rng), rng.uniform(0, 90)))
    if rng.random() < 0.5:
        parts.append(box((0, 0.6 + 0.15, 0), (0.3, 0.3, 0.3), _any(builder, rng), rng.uniform(0, 90)))
    return parts, 0.6, 0.0


def _big_plant(builder: SceneBuilder, rng: Rng, height: float) -> Piece:
    size = min(rng.uniform(0.8, 1.7), height - 0.6)
    return _plant(builder, rng, size), 0.3 * size, 0.0


def _pedestal(builder: SceneBuilder, rng: Rng, _: float) -> Piece:
    height, radius = rng.uniform(0.3, 1.1), rng.uniform(0.2, 0.4)
    material = builder.material(random_opaque(rng, textured=0.6))
    if rng.random() < 0.5:
        return drum((0, 0, 0), height, radius, material), radius, height
    return [box((0, height / 2, 0), (1.4 * radius, height, 1.4 * radius), material)], radius, height


def _railing(builder: SceneBuilder, rng: Rng, _: float) -> Piece:
    material, length = builder.material(random_metal(rng) if rng.random() < 0.3 else random_opaque(rng)), 1.6
    bars = int(rng.integers(8, 24))
    parts = [rod((x, 0, 0), (x, 1, 0), 0.01, material) for x in np.linspace(-length / 2, length / 2, bars)]
    return [*parts, box((0, 1, 0), (length, 0.04, 0.06), material)], length / 2, 0.0


def _any(builder: SceneBuilder, rng: Rng) -> dict[str, str]:
    return builder.material(random_material(rng))


def _any_opaque(builder: SceneBuilder, rng: Rng) -> dict[str, str]:
    return builder.material(random_opaque(rng, textured=0.25))
