"""What shines: coats, mirrors, glass and metal in a place that is otherwise mostly matt, well in view.

A matt surface has the light of its albedo; a coat, a mirror or a pane shows another place than its own, and the grain
below it is not in what it reflects. Rendered scenes are full of such surfaces, and a denoiser has to tell them.
"""

from __future__ import annotations

import math

import numpy as np

from mcdenoise.data.camera_path import Array
from mcdenoise.scenes.random.furniture import glass_block, ornament
from mcdenoise.scenes.random.materials import (
    Bsdf,
    diffuse,
    glass,
    lacquer,
    mirror,
    pane,
    random_metal,
    rough_plastic,
)
from mcdenoise.scenes.random.stage import Part, Stage, ball, box, drum, place, rod, rotate, sheet
from mcdenoise.scenes.random.textures import planks, texture

Rng = np.random.Generator
# Square metres of the box around what is a floor, a wall or a table top.
_LARGE = 0.3
# How many times a shining thing counts among the points that a camera looks at.
_WEIGHT = 3


def shine(stage: Stage, rng: Rng) -> None:
    """Coat what is matt and add one to four things that shine, where cameras will look."""
    areas = stage.areas()
    stage.change_materials(lambda name, bsdf: _coated(rng, bsdf, areas.get(name, 0.0) > _LARGE))
    adders = [_wall_mirror, _wall_mirror, _vitrine, _standing_pane, _jewels, _lacquered_box, _glass_picture]
    for _ in range(int(rng.integers(1, 5))):
        adders[int(rng.integers(len(adders)))](stage, rng)


def _coated(rng: Rng, bsdf: Bsdf, large: bool) -> Bsdf:
    """The same look with another contrast, and mostly with a coat over it."""
    inner = bsdf.get("bsdf", {})
    key = next((name for name in ("reflectance", "diffuse_reflectance") if name in inner), None)
    if bsdf["type"] != "twosided" or key is None:
        return bsdf
    image = np.asarray(inner[key]["bitmap"])
    repeat = np.diag(inner[key]["to_uv"])[:2]
    if image.shape[0] > 2:
        image = _contrast(rng, image)
        repeat = repeat * float(rng.choice([1, 1, 2, 4]))
    elif large and rng.random() < 0.4:
        image = _contrast(rng, texture(rng))
        repeat = np.full(2, float(rng.integers(1, 5)))
    if rng.random() < (0.25 if large else 0.12):
        # Dark wood under lacquer: highlights are many times as bright as what they lie on.
        wood = planks(rng)
        image = np.clip(wood * rng.uniform(0.08, 0.4) / max(float(wood.mean()), 0.05), 0.004, 0.9)
    tiling = (float(repeat[0]), float(repeat[1]))
    kind = rng.random()
    if kind < 0.42:
        return diffuse(image, tiling)
    if kind < 0.62:
        return lacquer(image, tiling, nonlinear=bool(rng.random() < 0.7))
    if kind < 0.93:
        alpha = float(np.exp(rng.uniform(math.log(0.01), math.log(0.3))))
        return rough_plastic(image, alpha, tiling)
    return random_metal(rng)


def _contrast(rng: Rng, image: Array) -> Array:
    """From hardly to be seen to black and white."""
    factor = float(np.exp(rng.uniform(math.log(0.12), math.log(3))))
    mean = image.mean(axis=(0, 1))
    return np.asarray(np.clip(mean + factor * (image - mean), 0.01, 0.9))


def _look_at(stage: Stage, point: Array) -> None:
    stage.points.extend([point] * _WEIGHT)


def _wall_place(stage: Stage, rng: Rng) -> tuple[Array, float, float]:
    """Somewhere on one of the four sides of the stage, +z inwards; how wide the side is and how high."""
    low, high = stage.low, stage.high
    wall = int(rng.integers(4))
    width = float((high - low)[0 if wall % 2 == 0 else 2])
    height = float(high[1])
    along = rng.uniform(-0.35, 0.35)
    middle = (low + high) / 2
    x, z = middle[0], middle[2]
    if wall % 2 == 0:
        x += along * width
        z = low[2] if wall == 0 else high[2]
    else:
        z += along * width
        x = low[0] if wall == 1 else high[0]
    y = rng.uniform(0.4, 0.6) * height
    return place((float(x), float(y), float(z)), (0, 90, 180, -90)[wall]), width, height


def _wall_mirror(stage: Stage, rng: Rng) -> None:
    """A mirror on a wall, at times a little blind or tilted, with or without a frame."""
    frame, width, height = _wall_place(stage, rng)
    half = rng.uniform(0.2, 0.5) * min(width, 3.0), rng.uniform(0.25, 0.42) * min(height, 2.6)
    silver = mirror(str(rng.choice(["Ag", "Al"]))) if rng.random() < 0.75 else random_metal(rng)
    tilt = rotate("x", float(rng.uniform(-4, 8)) if rng.random() < 0.4 else 0.0)
    parts = [sheet((0, 0, 0.06), half, stage.material(silver), tilt)]
    if rng.random() < 0.7:
        rim = stage.material(lacquer(texture(rng), (1, 1), nonlinear=True) if rng.random() < 0.5 else random_metal(rng))
        parts.append(box((0, 0, 0.01), (2 * half[0] + 0.1, 2 * half[1] + 0.1, 0.02), rim))
        for side in (-1, 1):
            parts.append(box((side * (half[0] + 0.03), 0, 0.05), (0.06, 2 * half[1] + 0.1, 0.08), rim))
    stage.add(parts, frame)
    _look_at(stage, frame[:3, 3])


def _glass_picture(stage: Stage, rng: Rng) -> None:
    """A large textured panel on a wall behind a pane."""
    frame, width, height = _wall_place(stage, rng)
    half = rng.uniform(0.2, 0.4) * min(width, 3.0), rng.uniform(0.2, 0.4) * min(height, 2.6)
    image = stage.material(diffuse(_contrast(rng, texture(rng))))
    parts = [
        sheet((0, 0, 0.03), half, image, np.eye(4)),
        sheet((0, 0, float(rng.uniform(0.05, 0.3))), half, stage.material(pane()), np.eye(4)),
    ]
    stage.add(parts, frame)
    _look_at(stage, frame[:3, 3])


def _spot(stage: Stage, rng: Rng) -> Array:
    """A place on the ground, away from the sides."""
    low, high = stage.low, stage.high
    where = low + (high - low) * rng.uniform(0.2, 0.8, 3)
    where[1] = 0.0
    return np.asarray(where)


def _standing_pane(stage: Stage, rng: Rng) -> None:
    """A screen of thin or of thick glass that stands in the room, with what is behind it to be seen through it."""
    where, turn = _spot(stage, rng), float(rng.uniform(0, 360))
    wide, tall = rng.uniform(0.4, 1.2), rng.uniform(0.5, 1.0) * min(float(stage.high[1]) - 0.1, 1.9)
    rim = stage.material(random_metal(rng))
    parts: list[Part] = []
    if rng.random() < 0.7:
        parts.append(sheet((0, tall / 2, 0), (wide / 2, tall / 2), stage.material(pane()), np.eye(4)))
    else:
        parts.append(box((0, tall / 2, 0), (wide, tall, 0.03), stage.material(glass())))
    for side in (-1, 1):
        parts.append(rod((side * wide / 2, 0, 0), (side * wide / 2, tall, 0), 0.015, rim))
    stage.add(parts, place(where, turn))
    _look_at(stage, where + np.array((0, tall / 2, 0)))


def _vitrine(stage: Stage, rng: Rng) -> None:
    """Ornaments on a block under a box of panes."""
    where, turn = _spot(stage, rng), float(rng.uniform(0, 360))
    edge, base = float(rng.uniform(0.3, 0.7)), float(rng.uniform(0.05, 0.8))
    base = min(base, 0.4 * float(stage.high[1]))
    block = stage.material(_coated(rng, diffuse(texture(rng)), large=True))
    clear = stage.material(pane())
    parts = [box((0, base / 2, 0), (edge, base, edge), block)]
    for quarter in range(4):
        wall = rotate("y", 90.0 * quarter)
        middle = wall[:3, :3] @ np.array((0, 0, edge / 2)) + (0, base + edge / 2, 0)
        parts.append(sheet(middle, (edge / 2, edge / 2), clear, wall))
    parts.append(sheet((0, base + edge, 0), (edge / 2, edge / 2), clear, rotate("x", -90)))
    frame = place(where, turn)
    stage.add(parts, frame)
    stage.add(ornament(stage, rng, 0.8 * edge), frame @ place((0, base + 0.002, 0)))
    _look_at(stage, where + np.array((0, base + edge / 2, 0)))


def _jewels(stage: Stage, rng: Rng) -> None:
    """Balls, drums and blocks of glass, mirror and metal beside each other on a glossy plate."""
    where = _spot(stage, rng)
    radius, height = float(rng.uniform(0.3, 0.6)), float(rng.uniform(0.02, 0.7))
    height = min(height, 0.4 * float(stage.high[1]))
    plate = stage.material(_coated(rng, diffuse(texture(rng)), large=True))
    frame = place(where, float(rng.uniform(0, 360)))
    stage.add(drum((0, 0, 0), height, radius, plate), frame)
    count = int(rng.integers(3, 7))
    for number in range(count):
        angle = 2 * math.pi * number / count
        size = float(rng.uniform(0.1, 0.35)) * radius * 2
        spot = frame @ place((0.62 * radius * math.cos(angle), height + 0.002, 0.62 * radius * math.sin(angle)))
        kind = rng.random()
        parts: list[Part]
        if kind < 0.35:
            parts = glass_block(stage, rng, size)
        else:
            shell = mirror(str(rng.choice(["Ag", "Au", "Cu"]))) if kind < 0.6 else random_metal(rng)
            if kind > 0.85:
                shell = lacquer(_contrast(rng, texture(rng)), (1, 1), nonlinear=True)
            material = stage.material(shell)
            parts = [ball((0, size / 2, 0), size / 2, material)]
            if rng.random() < 0.3:
                parts = drum((0, 0, 0), size, 0.3 * size, material)
        stage.add(parts, spot, movable=True)
    _look_at(stage, where + np.array((0, height + 0.1, 0)))


def _lacquered_box(stage: Stage, rng: Rng) -> None:
    """A chest or a low table of dark lacquered wood with things on it, whose reflections it shows."""
    where, turn = _spot(stage, rng), float(rng.uniform(0, 360))
    wide, deep, tall = rng.uniform(0.6, 1.6), rng.uniform(0.4, 1.0), rng.uniform(0.1, 0.7)
    tall = min(float(tall), 0.4 * float(stage.high[1]))
    wood = planks(rng) if rng.random() < 0.7 else texture(rng)
    dark = np.clip(wood * rng.uniform(0.05, 0.5), 0.003, 0.9)
    tiling = (float(rng.integers(1, 4)), float(rng.integers(1, 4)))
    coat = (
        lacquer(dark, tiling, nonlinear=True)
        if rng.random() < 0.6
        else rough_plastic(dark, float(rng.uniform(0.02, 0.15)), tiling)
    )
    frame = place(where, turn)
    stage.add([box((0, tall / 2, 0), (wide, tall, deep), stage.material(coat))], frame)
    for _ in range(int(rng.integers(1, 4))):
        spot = place((rng.uniform(-0.35, 0.35) * wide, tall, rng.uniform(-0.3, 0.3) * deep), rng.uniform(0, 360))
        stage.add(ornament(stage, rng, float(rng.uniform(0.12, 0.4))), frame @ spot, movable=True)
    _look_at(stage, where + np.array((0, tall, 0)))
