"""Places of takes: furnished rooms, desks, streets, pools, things in the void, and the experiments of light."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from mcdenoise.data.camera_path import Array
from mcdenoise.scenes.assets import Mesh, read_sky
from mcdenoise.scenes.random.builder import TURNS, SceneBuilder, box, place, shape, sheet
from mcdenoise.scenes.random.lights import add_lamps, daylight, light_color, scaled, sky, softbox, studio, sun_direction
from mcdenoise.scenes.random.materials import diffuse, glass, random_opaque
from mcdenoise.scenes.random.rooms import (
    closed_wall,
    colonnade,
    empty_room,
    light_experiment,
    still_life,
    wall_with_windows,
)
from mcdenoise.scenes.random.shiny import shine
from mcdenoise.scenes.random.textures import Color, Rng, random_color
from mcdenoise.scenes.takes.furnish import Floor, Stock, add_model, bumpy, fill_room, fill_top

_BUMPY, _FINE, _SHINY = 0.2, 0.12, 0.35
# Fraction of day rooms whose windows are lights themselves, which takes fewer samples than a sky behind them.
_GLOWING = 0.5
# Turns a sheet to face upwards.
_UPWARDS = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=np.float64)


def build(rng: Rng, stock: Stock, pick: float) -> tuple[SceneBuilder, bool]:
    """A random place, and whether its background is void; ``pick`` from 0 to 1 chooses the kind."""
    kinds: list[tuple[Callable[[Rng, Stock], SceneBuilder], float]] = [
        (_day, 0.28),
        (_evening, 0.22),
        (_desk, 0.16),
        (_street, 0.14),
        (_pool, 0.05),
        (_display, 0.06),
        (lambda rng, _: still_life(rng), 0.04),
        (lambda rng, _: colonnade(rng), 0.03),
        (lambda rng, _: light_experiment(rng), 0.02),
    ]
    if not stock.assets.models:
        # What consists of models only would be empty.
        kinds[2], kinds[3], kinds[5] = (kinds[6][0], 0.22), (kinds[7][0], 0.08), (kinds[6][0], 0.06)
    number = int(np.searchsorted(np.cumsum([chance for _, chance in kinds[:-1]]), pick))
    builder = kinds[number][0](rng, stock)
    areas = builder.areas()

    def change(name: str, bsdf: dict[str, object]) -> dict[str, object]:
        if areas.get(name, 0) > 0.3 and rng.random() < _FINE:
            bsdf = _print(rng, areas[name])
        return bumpy(rng, stock, bsdf, float(rng.integers(1, 9))) if rng.random() < _BUMPY else bsdf

    if rng.random() < _SHINY:
        shine(builder, rng)
    builder.change_materials(change)
    return builder, number == 5


def _print(rng: Rng, area: float) -> dict[str, object]:
    """Line art, grain of single texels, or a grid of hairlines, on paint."""
    side, kind = 256, rng.integers(3)
    if kind == 0:
        weight = rng.random((side, side, 1))
    elif kind == 1:
        weight = np.zeros((side, side, 1))
        for _ in range(60):
            start, way = rng.uniform(0, side, 2), rng.normal(0, 1, 2)
            points = (start + np.arange(200)[:, None] * way / np.linalg.norm(way)).astype(int) % side
            weight[points[:, 0], points[:, 1]] = 1
    else:
        step = int(rng.choice([4, 8, 16]))
        weight = np.zeros((side, side, 1))
        weight[::step], weight[:, ::step] = 1, 1
    ink, paper = np.array(random_color(rng)), np.array(random_color(rng))
    repeat = max(1.0, round(math.sqrt(area) * rng.uniform(0.5, 3)))
    return diffuse(weight * ink + (1 - weight) * paper, (repeat, repeat))


def any_sky(rng: Rng, stock: Stock, level: float, sun: Array | None, ratio: float) -> Array:
    """A photographed sky of that mean radiance, or a painted one."""
    if not stock.assets.skies or rng.random() < 0.4:
        return sky(rng, level, sun, ratio)
    image = read_sky(stock.image(rng, stock.assets.skies)).astype(np.float64)
    image = np.roll(image, int(rng.integers(image.shape[1])), axis=1)
    rows = np.sin((np.arange(len(image)) + 0.5) / len(image) * math.pi)[:, None, None]
    return np.asarray(image * level / max(float((image * rows).mean() / rows.mean()), 1e-6))


def _room(rng: Rng, windows: list[int], glow: Color | None = None) -> tuple[SceneBuilder, float]:
    """A room without furniture, and the area of its windows."""
    builder = empty_room(rng)
    opening = 0.0
    for wall in range(4):
        if wall in windows:
            opening += wall_with_windows(builder, rng, wall, glow)
        else:
            closed_wall(builder, rng, wall)
    return builder, opening


def _day(rng: Rng, stock: Stock) -> SceneBuilder:
    """A furnished room lit through its windows."""
    windows = rng.permutation(4)[: int(rng.choice([1, 2, 3], p=[0.4, 0.4, 0.2]))].tolist()
    color = scaled(light_color(rng), 10)
    glow = color if rng.random() < _GLOWING else None
    builder, opening = _room(rng, windows, glow)
    level = float(np.clip(0.25 * builder.surface() / max(opening, 0.1), 1.5, 40)) * math.exp(rng.uniform(-0.7, 0.7))
    sun = sun_direction(rng, TURNS[(windows[0] + 2) % 4]) if rng.random() < 0.65 else None
    if glow is None:
        builder.set_sky(any_sky(rng, stock, level, sun, float(np.exp(rng.uniform(-1, 1.6)))))
    lamps = rng.random() < 0.25
    if lamps:
        add_lamps(builder, rng, int(rng.integers(1, 3)), 0.1)
    fill_room(builder, rng, stock, 0.1 * builder.surface() if lamps else 0.0)
    return builder


def _evening(rng: Rng, stock: Stock) -> SceneBuilder:
    """A furnished room lit by lamps, at times with a window to the night."""
    windows = [int(rng.integers(4))] if rng.random() < 0.3 else []
    builder, _ = _room(rng, windows)
    if windows:
        builder.set_sky(any_sky(rng, stock, float(np.exp(rng.uniform(-5, -0.5))), None, 0))
    add_lamps(builder, rng, int(rng.choice([1, 2, 3], p=[0.4, 0.35, 0.25])), 0.35)
    fill_room(builder, rng, stock, 0.5 * builder.surface())
    return builder


def _desk(rng: Rng, stock: Stock) -> SceneBuilder:
    """Small things on a table before a wall, seen from near."""
    wide, deep = rng.uniform(0.9, 1.8), rng.uniform(0.6, 0.9)
    builder = SceneBuilder((-wide * 0.8, 0.05, -deep / 2), (wide * 0.8, 1.1, deep * 1.6))
    top = builder.material(random_opaque(rng, (1.0, 1.0), textured=0.7))
    builder.add([box((0, -0.02, 0), (wide, 0.04, deep), top)])
    wall = builder.material(random_opaque(rng, (2, 2), textured=0.5))
    floor = builder.material(random_opaque(rng, (4, 4), textured=0.7))
    builder.add([box((0, 0.6, -deep / 2 - 0.1), (8, 3.0, 0.1), wall), box((0, -0.8, 1), (8, 0.1, 6), floor)])
    if rng.random() < 0.5:
        side = float(rng.choice([-1, 1]))
        builder.add([box((side * (wide / 2 + 0.4), 0.6, 1), (0.1, 3.0, 6), wall)])
    if rng.random() < 0.4:
        shelf = place((0, rng.uniform(0.35, 0.6), -deep / 2 + 0.1))
        builder.add([box((0, -0.01, 0), (wide, 0.02, 0.25), top)], shelf)
        fill_top(builder, rng, stock, shelf, wide, 0.25, 0.0, most=9)
    fill_top(builder, rng, stock, np.eye(4), wide, deep, 0.0, most=16)
    lights = int(rng.integers(0, 3))
    sun = sun_direction(rng, 0.0) if rng.random() < 0.5 else None
    if lights == 0 or rng.random() < 0.6:
        builder.set_sky(any_sky(rng, stock, rng.uniform(0.1, 1), sun, float(np.exp(rng.uniform(-0.7, 1.8)))))
    for _ in range(lights):
        origin = np.array((rng.uniform(-1, 1), rng.uniform(0.5, 1.6), rng.uniform(0, 1.4)))
        softbox(builder, rng, origin, rng.uniform(-0.4, 0.4, 3) * (1, 0, 1), rng.uniform(3, 15) / lights)
    return builder


def _street(rng: Rng, stock: Stock) -> SceneBuilder:
    """Ground under a sky, with plants, vehicles, people and blocks of houses."""
    reach = rng.uniform(4, 9)
    builder = SceneBuilder((-reach, 0.25, -reach), (reach, 2.6, reach))
    repeat = float(rng.integers(8, 40))
    ground = builder.material(random_opaque(rng, (repeat, repeat), textured=0.85))
    builder.add([box((0, -0.1, 0), (80, 0.2, 80), ground)])
    for _ in range(int(rng.integers(0, 6))):
        angle, away = rng.uniform(0, 2 * math.pi), rng.uniform(1.3, 2.2) * reach
        size = rng.uniform((3, 2.5, 3), (9, 10, 9))
        house = builder.material(random_opaque(rng, (4, 4), textured=0.9))
        middle = (away * math.cos(angle) * 1.2, size[1] / 2, away * math.sin(angle) * 1.2)
        builder.add([box(middle, size, house, rng.uniform(0, 90))])
    floor, choices = Floor(builder.low, builder.high), stock.outside()
    for _ in range(int(rng.integers(4, 15))):
        model = stock.model(rng, choices)
        frame = floor.find(rng, model.size[0], model.size[2], walls=0) if model else None
        if model and frame is not None:
            add_model(builder, rng, stock, model, frame, movable=max(model.size) < 3)
    builder.set_sky(any_sky(rng, stock, *daylight(rng, 0.75, (0.6, 1.8), (-0.5, 1.8))))
    return builder


def _pool(rng: Rng, stock: Stock) -> SceneBuilder:
    """A basin of water under a sky, with things around it and in it."""
    wide, deep = rng.uniform(1.5, 4), rng.uniform(1.5, 4)
    builder = SceneBuilder((-wide, 0.15, -deep), (wide, 1.8, deep))
    tiles = builder.material(random_opaque(rng, (4, 4), textured=0.95))
    stone = builder.material(random_opaque(rng, (6, 6), textured=0.6))
    depth = rng.uniform(0.2, 0.8)
    parts = [box((0, -depth - 0.05, 0), (wide + 0.4, 0.1, deep + 0.4), tiles)]
    for sign in (-1, 1):
        parts.append(box((sign * (wide / 2 + 2.0), -0.5, 0), (4, 1, deep + 8), stone))
        parts.append(box((0, -0.5, sign * (deep / 2 + 2.0)), (wide, 1, 4), stone))
    builder.add(parts)
    level = -rng.uniform(0.02, 0.15)
    surface = place((0, level, 0), scale=(wide / 2, rng.uniform(0.003, 0.02), deep / 2))
    water = builder.material(glass(1.33))
    builder.add([shape("mesh", surface, water, mesh=_waves(rng))])
    for _ in range(4):
        builder.points.append(rng.uniform((-wide / 3, -depth, -deep / 3), (wide / 3, 0, deep / 3)))
    fill_top(builder, rng, stock, np.eye(4), 0.8 * wide, 0.8 * deep, -depth, most=5)
    for sign in (-1, 1):
        frame = place((0, 0, sign * (deep / 2 + 0.5)))
        fill_top(builder, rng, stock, frame, 1.5 * wide, 0.8, 0.0, most=6)
    builder.set_sky(any_sky(rng, stock, *daylight(rng, 0.6, (0.6, 1.8), (-0.5, 1))))
    return builder


def _waves(rng: Rng, side: int = 80) -> Mesh:
    """A rippled square, with smooth normals."""
    z, x = np.mgrid[-1 : 1 : side * 1j, -1 : 1 : side * 1j]
    height = np.zeros_like(x)
    for _ in range(8):
        wave = rng.normal(0, 9, 2)
        height += np.sin(wave[0] * x + wave[1] * z + rng.uniform(0, 2 * math.pi)) / 8
    vertices = np.stack([x, height, z], -1).reshape(-1, 3).astype(np.float32)
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).reshape(-1)
    first = np.stack([corner, corner + side, corner + 1], -1)
    faces = np.concatenate([first, np.stack([corner + 1, corner + side, corner + side + 1], -1)]).astype(np.int32)
    by_z, by_x = np.gradient(height, 2 / (side - 1))
    normals = np.stack([-by_x, np.ones_like(x), -by_z], -1).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Mesh(vertices, faces, None, normals.astype(np.float32))


def _display(rng: Rng, stock: Stock) -> SceneBuilder:
    """A few things before nothing, as for a composite."""
    builder = SceneBuilder((-1.6, -0.6, -1.6), (1.6, 1.6, 1.6))
    choices = [model for model in stock.assets.models if not model.opening]
    for number in range(int(rng.integers(1, 5))):
        model = stock.model(rng, choices)
        if model is None:
            break
        spot = rng.uniform(-0.5, 0.5, 3) * (1 if number else 0)
        frame = place(spot - (0, 0.3, 0), rng.uniform(0, 360))
        size = rng.uniform(0.5, 1.1)
        add_model(builder, rng, stock, model, frame, scale=size / max(model.size), movable=True)
    if rng.random() < 0.3:
        base = builder.material(random_opaque(rng, textured=0.5))
        builder.add([sheet((0, -0.31, 0), (0.8, 0.8), base, _UPWARDS)])
    if rng.random() < 0.7:
        builder.set_sky(any_sky(rng, stock, 0.7, sun_direction(rng), float(np.exp(rng.uniform(-0.7, 1.8)))))
    else:
        builder.set_sky(studio(rng, 0.5))
    return builder
