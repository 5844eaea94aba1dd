"""Coats, mirrors, glass and metal, added in view of the camera to a scene that is otherwise mostly diffuse.

A diffuse surface is lit through its albedo. A coat, a mirror or a pane also shows a different part of the scene, and
this reflection does not have the surface's texture. Rendered scenes have many such surfaces, which a denoiser has to
handle.
"""

from __future__ import annotations

import math

import numpy as np

from mcdenoise.data.camera_path import Array
from mcdenoise.scenes.random.builder import TURNS, SceneBuilder, ball, box, drum, place, rod, rotate, sheet
from mcdenoise.scenes.random.furniture import glass_block, ornament
from mcdenoise.scenes.random.materials import Bsdf, diffuse, glass, lacquer, mirror, pane, random_metal, rough_plastic
from mcdenoise.scenes.random.textures import Rng, log_uniform, planks, texture

# Minimum area in square metres of a floor, a wall or a table top.
_LARGE = 0.3
# Weight of a shiny object among the points that a camera looks at.
_WEIGHT = 3


def shine(builder: SceneBuilder, rng: Rng) -> None:
    """Coat diffuse materials, and add one to four shiny objects, each of which says where cameras will look."""
    areas = builder.areas()
    builder.change_materials(lambda name, bsdf: _coated(rng, bsdf, areas.get(name, 0.0) > _LARGE))
    adders = [_wall_mirror, _wall_mirror, _vitrine, _standing_pane, _jewels, _lacquered_box, _glass_picture]
    for _ in range(int(rng.integers(1, 5))):
        known = len(builder.points)
        adders[int(rng.integers(len(adders)))](builder, rng)
        builder.points += builder.points[known:] * (_WEIGHT - 1)


def _coated(rng: Rng, bsdf: Bsdf, large: bool) -> Bsdf:
    """A material with changed contrast, and usually with a coat."""
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
        # Dark wood under lacquer: highlights are many times as bright as the surface.
        wood = planks(rng)
        image = np.clip(wood * rng.uniform(0.08, 0.4) / max(float(wood.mean()), 0.05), 0.004, 0.9)
    tiling = (float(repeat[0]), float(repeat[1]))
    kind = rng.random()
    if kind < 0.42:
        return diffuse(image, tiling)
    if kind < 0.62:
        return lacquer(image, tiling, nonlinear=bool(rng.random() < 0.7))
    if kind < 0.93:
        return rough_plastic(image, log_uniform(rng, 0.01, 0.3), tiling)
    return random_metal(rng)


def _contrast(rng: Rng, image: Array) -> Array:
    """Change the contrast of a texture, from nearly none to black and white."""
    factor = log_uniform(rng, 0.12, 3)
    mean = image.mean(axis=(0, 1))
    return np.asarray(np.clip(mean + factor * (image - mean), 0.01, 0.9))


def _wall_place(builder: SceneBuilder, rng: Rng) -> tuple[Array, float, float]:
    """A place on one of the four sides, with +z inwards, and the width and height of that side."""
    low, high = builder.low, builder.high
    wall = int(rng.integers(4))
    along, across = (2, 0) if wall % 2 else (0, 2)
    width, height = float((high - low)[along]), float(high[1])
    where = (low + high) / 2
    where[along] += rng.uniform(-0.35, 0.35) * width
    where[across] = (low if wall < 2 else high)[across]
    where[1] = rng.uniform(0.4, 0.6) * height
    return place(where, TURNS[wall]), width, height


def _wall_mirror(builder: SceneBuilder, rng: Rng) -> None:
    """A mirror on a wall, sometimes slightly rough or tilted, with or without a frame."""
    frame, width, height = _wall_place(builder, rng)
    half_size = rng.uniform(0.2, 0.5) * min(width, 3.0), rng.uniform(0.25, 0.42) * min(height, 2.6)
    silver = mirror(str(rng.choice(["Ag", "Al"]))) if rng.random() < 0.75 else random_metal(rng)
    tilt = rotate("x", rng.uniform(-4, 8) if rng.random() < 0.4 else 0.0)
    parts = [sheet((0, 0, 0.06), half_size, builder.material(silver), tilt)]
    if rng.random() < 0.7:
        rim = builder.material(lacquer(texture(rng), nonlinear=True) if rng.random() < 0.5 else random_metal(rng))
        parts.append(box((0, 0, 0.01), (2 * half_size[0] + 0.1, 2 * half_size[1] + 0.1, 0.02), rim))
        for side in (-1, 1):
            parts.append(box((side * (half_size[0] + 0.03), 0, 0.05), (0.06, 2 * half_size[1] + 0.1, 0.08), rim))
    builder.add(parts, frame, look=(0, 0, 0))


def _glass_picture(builder: SceneBuilder, rng: Rng) -> None:
    """A large textured panel on a wall behind glass."""
    frame, width, height = _wall_place(builder, rng)
    half_size = rng.uniform(0.2, 0.4) * min(width, 3.0), rng.uniform(0.2, 0.4) * min(height, 2.6)
    image = builder.material(diffuse(_contrast(rng, texture(rng))))
    cover = sheet((0, 0, rng.uniform(0.05, 0.3)), half_size, builder.material(pane()))
    builder.add([sheet((0, 0, 0.03), half_size, image), cover], frame, look=(0, 0, 0))


def _spot(builder: SceneBuilder, rng: Rng) -> Array:
    """A place on the ground, away from the sides."""
    low, high = builder.low, builder.high
    where = low + (high - low) * rng.uniform(0.2, 0.8, 3)
    where[1] = 0.0
    return np.asarray(where)


def _standing_pane(builder: SceneBuilder, rng: Rng) -> None:
    """A standing screen of thin or thick glass through which the background is visible."""
    frame = place(_spot(builder, rng), rng.uniform(0, 360))
    wide, tall = rng.uniform(0.4, 1.2), rng.uniform(0.5, 1.0) * min(float(builder.high[1]) - 0.1, 1.9)
    rim = builder.material(random_metal(rng))
    if rng.random() < 0.7:
        filling = sheet((0, tall / 2, 0), (wide / 2, tall / 2), builder.material(pane()))
    else:
        filling = box((0, tall / 2, 0), (wide, tall, 0.03), builder.material(glass()))
    posts = [rod((x, 0, 0), (x, tall, 0), 0.015, rim) for x in (-wide / 2, wide / 2)]
    builder.add([filling, *posts], frame, look=(0, tall / 2, 0))


def _vitrine(builder: SceneBuilder, rng: Rng) -> None:
    """Ornaments on a block under a glass box."""
    frame = place(_spot(builder, rng), rng.uniform(0, 360))
    edge, base = rng.uniform(0.3, 0.7), min(rng.uniform(0.05, 0.8), 0.4 * builder.high[1])
    block = builder.material(_coated(rng, diffuse(texture(rng)), large=True))
    clear = builder.material(pane())
    parts = [box((0, base / 2, 0), (edge, base, edge), block)]
    for quarter in range(4):
        wall = rotate("y", 90.0 * quarter)
        middle = wall[:3, :3] @ np.array((0, 0, edge / 2)) + (0, base + edge / 2, 0)
        parts.append(sheet(middle, (edge / 2, edge / 2), clear, wall))
    parts.append(sheet((0, base + edge, 0), (edge / 2, edge / 2), clear, rotate("x", -90)))
    builder.add(parts, frame, look=(0, base + edge / 2, 0))
    builder.add(ornament(builder, rng, 0.8 * edge), frame @ place((0, base + 0.002, 0)))


def _jewels(builder: SceneBuilder, rng: Rng) -> None:
    """Balls, cylinders and blocks of glass, mirror and metal next to each other on a glossy plate."""
    where = _spot(builder, rng)
    radius, height = rng.uniform(0.3, 0.6), min(rng.uniform(0.02, 0.7), 0.4 * builder.high[1])
    plate = builder.material(_coated(rng, diffuse(texture(rng)), large=True))
    frame = place(where, rng.uniform(0, 360))
    builder.add(drum((0, 0, 0), height, radius, plate), frame, look=(0, height + 0.1, 0))
    count = int(rng.integers(3, 7))
    for number in range(count):
        angle = 2 * math.pi * number / count
        size = rng.uniform(0.1, 0.35) * radius * 2
        spot = frame @ place((0.62 * radius * math.cos(angle), height + 0.002, 0.62 * radius * math.sin(angle)))
        kind = rng.random()
        if kind < 0.35:
            parts = glass_block(builder, rng, size)
        else:
            shell = mirror(str(rng.choice(["Ag", "Au", "Cu"]))) if kind < 0.6 else random_metal(rng)
            if kind > 0.85:
                shell = lacquer(_contrast(rng, texture(rng)), nonlinear=True)
            material = builder.material(shell)
            parts = [ball((0, size / 2, 0), size / 2, material)]
            if rng.random() < 0.3:
                parts = drum((0, 0, 0), size, 0.3 * size, material)
        builder.add(parts, spot, movable=True)


def _lacquered_box(builder: SceneBuilder, rng: Rng) -> None:
    """A chest or a low table of dark lacquered wood that reflects the objects on it."""
    frame = place(_spot(builder, rng), rng.uniform(0, 360))
    wide, deep, tall = rng.uniform(0.6, 1.6), rng.uniform(0.4, 1.0), min(rng.uniform(0.1, 0.7), 0.4 * builder.high[1])
    wood = planks(rng) if rng.random() < 0.7 else texture(rng)
    dark = np.clip(wood * rng.uniform(0.05, 0.5), 0.003, 0.9)
    tiling = (float(rng.integers(1, 4)), float(rng.integers(1, 4)))
    coat = lacquer(dark, tiling, nonlinear=True)
    if rng.random() >= 0.6:
        coat = rough_plastic(dark, rng.uniform(0.02, 0.15), tiling)
    builder.add([box((0, tall / 2, 0), (wide, tall, deep), builder.material(coat))], frame, look=(0, tall, 0))
    for _ in range(int(rng.integers(1, 4))):
        spot = place((rng.uniform(-0.35, 0.35) * wide, tall, rng.uniform(-0.3, 0.3) * deep), rng.uniform(0, 360))
        builder.add(ornament(builder, rng, rng.uniform(0.12, 0.4)), frame @ spot, movable=True)
