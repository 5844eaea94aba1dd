"""A parlour as a test scene, with many non-diffuse effects; it is never used for training.

It contains a lacquered table of dark wood with highlights; a mirror that reflects a window and a lamp; bottles and
glasses before a patterned wall; books with thin black gaps between them; a page of text-like marks; rods as thin as
hair; contact shadows; and a pillar that moves and uncovers the background. The description is plain Python and numpy,
as :func:`mcdenoise.scenes.render.render_sequence` expects it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mcdenoise.data.camera_path import Array, Camera
from mcdenoise.scenes.random.builder import Part, ball, box, drum, rgb, rod, rotate, scene_of, sheet
from mcdenoise.scenes.random.materials import Bsdf, diffuse, glass, mirror, pane, rough_metal, rough_plastic
from mcdenoise.scenes.random.textures import Color, tint

_TABLE = 0.74


def parlour_scene() -> dict[str, Any]:
    """The room as a Mitsuba dictionary; units are metres, y is up, the floor is y = 0.

    Example:
        >>> parlour_scene()["type"]
        'scene'
    """
    pillar = box((-0.8, 1.3, 0.6), (0.16, 2.6, 0.16), rough_plastic((0.5, 0.46, 0.4), 0.3))
    return scene_of(_room() | _lights() | _table() | _bottles() | _shelf() | _rods() | {"pillar": pillar})


def parlour_cameras(frames: int = 8) -> list[Camera]:
    """Cameras of a walk to the right, 3 centimetres per frame.

    Example:
        >>> len(parlour_cameras(3))
        3
    """
    return [
        Camera.look_at((-0.12 + 0.03 * frame, 1.55 + 0.004 * frame, 2.2 - 0.015 * frame), (0.05, 1.05, -1.6), fov_x=54)
        for frame in range(frames)
    ]


def parlour_moves(frames: int = 8) -> dict[str, Array]:
    """The pillar's motion to the right, 7 centimetres per frame, as in :class:`mcdenoise.data.camera_path.CameraPath`.

    Example:
        >>> parlour_moves(3)["pillar"].shape
        (3, 4, 4)
    """
    path = np.tile(np.eye(4), (frames, 1, 1))
    path[:, 0, 3] = 0.07 * np.arange(frames)
    return {"pillar": path}


def _room() -> dict[str, Part]:
    return {
        "floor": sheet((0, 0, 0.4), (3, 3.6), rough_plastic(_parquet(), 0.12), rotate("x", -90)),
        "ceiling": sheet((0, 2.7, 0.4), (3, 3.6), diffuse((0.78, 0.77, 0.74)), rotate("x", 90)),
        "wall_back": sheet((0, 1.35, -3), (3, 1.35), diffuse(_damask())),
        "wall_left": sheet((-3, 1.35, 0.4), (3.6, 1.35), diffuse((0.3, 0.38, 0.42)), rotate("y", 90)),
        "wall_right": sheet((3, 1.35, 0.4), (3.6, 1.35), diffuse((0.66, 0.6, 0.5)), rotate("y", -90)),
        "wall_front": sheet((0, 1.35, 4), (3, 1.35), diffuse((0.7, 0.68, 0.62)), rotate("y", 180)),
        "mirror": sheet((-1.15, 1.5, -2.95), (0.55, 0.6), mirror()),
        "mirror_frame": box((-1.15, 1.5, -2.985), (1.22, 1.32, 0.05), rough_metal("Au", 0.2)),
        "page": sheet((0.42, 1.6, -2.985), (0.3, 0.4), diffuse(_writing())),
    }


def _lights() -> dict[str, Part]:
    """A window and a lamp behind the camera, which are reflected in mirror and table, and a visible lamp."""
    black = diffuse((0, 0, 0))
    return {
        "window": sheet((-2.1, 1.65, 3.96), (0.7, 0.75), black, rotate("y", 180), (13.0, 14.5, 16.5)),
        "window_post": box((-2.1, 1.65, 3.93), (0.05, 1.5, 0.05), diffuse((0.7, 0.7, 0.68))),
        "window_bar": box((-2.1, 1.65, 3.93), (1.4, 0.05, 0.05), diffuse((0.7, 0.7, 0.68))),
        "lamp_behind": ball((-1.3, 1.8, 0.7), 0.1, black, (26.0, 16.0, 7.5)),
        "lamp": ball((0.2, 1.28, -2.0), 0.075, black, (42.0, 27.0, 13.0)),
        "lamp_stand": rod((0.2, _TABLE, -2.0), (0.2, _TABLE + 0.48, -2.0), 0.012, rough_metal("Al", 0.1)),
        "spot": ball((1.5, 2.3, -0.4), 0.05, black, (75.0, 66.0, 50.0)),
    }


def _table() -> dict[str, Part]:
    wood = rough_plastic(_dark_wood(), 0.035)
    legs = {
        f"leg_{i}": box((x, 0.35, z), (0.07, 0.7, 0.07), diffuse((0.06, 0.03, 0.02)))
        for i, (x, z) in enumerate(((-1.0, -0.6), (1.2, -0.6), (-1.0, -2.1), (1.2, -2.1)))
    }
    return {
        "table_top": sheet((0.1, _TABLE, -1.35), (1.25, 0.9), wood, rotate("x", -90)),
        "table_side": box((0.1, _TABLE - 0.03, -1.35), (2.5, 0.055, 1.8), diffuse((0.05, 0.025, 0.015))),
        **legs,
        "bowl": ball((-0.42, _TABLE + 0.15, -1.0), 0.15, rough_metal("Cu", 0.12)),
        "ball": ball((-0.08, _TABLE + 0.07, -0.72), 0.07, mirror()),
        "cup": ball((0.86, _TABLE + 0.09, -0.85), 0.09, rough_plastic((0.65, 0.62, 0.56), 0.05)),
        # Diffuse objects with contact shadows.
        "die": box((0.3, _TABLE + 0.04, -0.62), (0.08, 0.08, 0.08), diffuse((0.75, 0.7, 0.6)), turn=30),
        "slab": box((-0.72, _TABLE + 0.012, -0.75), (0.24, 0.024, 0.16), diffuse((0.15, 0.3, 0.24)), turn=-20),
        "letter": sheet(
            (0.55, _TABLE + 0.003, -0.66), (0.13, 0.09), diffuse(_writing()), rotate("y", -15) @ rotate("x", -90)
        ),
    }


def _bottles() -> dict[str, Part]:
    """Closed solids of glass, as Mitsuba's dielectric requires, and thin tumblers."""
    parts: dict[str, Part] = {}
    tints: list[Color] = [(0.35, 0.75, 0.4), (0.85, 0.5, 0.15), (0.9, 0.95, 0.95)]
    for index, (x, z, height) in enumerate(((0.5, -1.85, 0.3), (0.68, -1.7, 0.24), (0.9, -1.9, 0.34))):
        tinted = glass() | {"specular_transmittance": rgb(tints[index])}
        parts |= _solid(f"bottle_{index}", (x, _TABLE + 0.001, z), height, 0.055, tinted)
        parts |= _solid(f"neck_{index}", (x, _TABLE + 0.002 + height, z), 0.1, 0.018, tinted)
    for index, (x, z) in enumerate(((0.38, -1.35), (0.62, -1.3), (0.5, -1.08))):
        parts[f"tumbler_{index}"] = rod((x, _TABLE + 0.001, z), (x, _TABLE + 0.131, z), 0.042, pane())
    parts["glass_ball"] = ball((0.15, _TABLE + 0.085, -1.2), 0.084, glass())
    return parts


def _solid(name: str, foot: Color, height: float, radius: float, bsdf: Bsdf) -> dict[str, Part]:
    return dict(zip((f"{name}_side", f"{name}_top", f"{name}_foot"), drum(foot, height, radius, bsdf), strict=True))


def _shelf() -> dict[str, Part]:
    """Two shelves of books, a few millimetres apart, before a black back wall."""
    rng = np.random.default_rng(12)
    wood = diffuse((0.22, 0.13, 0.07))
    parts: dict[str, Part] = {"shelf_back": box((1.65, 1.55, -2.98), (1.3, 1.1, 0.03), diffuse((0.01, 0.01, 0.01)))}
    for level, base in enumerate((1.05, 1.55)):
        parts[f"board_{level}"] = box((1.65, base - 0.02, -2.84), (1.3, 0.04, 0.28), wood)
        left, book = 1.02, 0
        while left < 2.22:
            width, height = rng.uniform(0.03, 0.065), rng.uniform(0.28, 0.42)
            red, green, blue = (0.05 + 0.6 * rng.random(3) ** 1.5).tolist()
            parts[f"book_{level}_{book}"] = box(
                (left + width / 2, base + height / 2, -2.83),
                (width, height, 0.2),
                rough_plastic((red, green, blue), 0.3),
            )
            left, book = left + width + float(rng.choice([0.003, 0.006, 0.012])), book + 1
    return parts


def _rods() -> dict[str, Part]:
    """Rods of 1 to 4 millimetres that hang from the ceiling, bright and dark, and one that leans."""
    rods: dict[str, Part] = {}
    for index in range(10):
        x, z = -0.62 + 0.055 * index, -1.7 - 0.04 * (index % 3)
        metal = rough_metal("Al", 0.2) if index % 2 else diffuse((0.02, 0.02, 0.02))
        rods[f"rod_{index}"] = rod((x, 1.25, z), (x, 2.7, z), 0.0005 * (1 + index % 4), metal)
    rods["rod_leaning"] = rod((-0.35, _TABLE, -0.55), (1.05, 1.75, -1.9), 0.0025, diffuse((0.8, 0.78, 0.7)))
    return rods


def _dark_wood() -> Array:
    y, x = np.mgrid[0:512, 0:768] / 512
    rings = 6 * (x + 0.12 * np.sin(5 * y) + 0.05 * np.sin(17 * y + 3 * x))
    grain = 0.5 + 0.5 * np.sin(2 * math.pi * 4 * rings) * np.sin(90 * x + 8 * np.sin(9 * y))
    return tint(0.35 + grain, (0.13, 0.055, 0.025))


def _parquet() -> Array:
    rng = np.random.default_rng(3)
    y, x = np.mgrid[0:480, 0:480]
    tone = rng.uniform(0.7, 1.25, (12, 12))[y // 40, x // 40]
    along = np.where((y // 40 + x // 40) % 2, y, x) % 10
    return tint(tone * np.where(along < 1, 0.5, 1.0), (0.36, 0.22, 0.12))


def _damask() -> Array:
    """Wallpaper: pale leaves on a dark ground, with fine stripes."""
    y, x = np.mgrid[0:540, 0:1200] / 200
    leaf = np.sin(2 * math.pi * x / 0.45) * np.sin(2 * math.pi * y / 0.6) + 0.4 * np.sin(2 * math.pi * (x + y) / 0.15)
    stripe = np.where((x * 200).astype(int) % 6 < 3, 1.0, 0.82)
    pattern = np.where(leaf > 0.35, 0.72, 0.24) * stripe
    return np.asarray(pattern[..., None] * np.array((0.85, 1.0, 0.92)))


def _writing() -> Array:
    """Black marks on white in lines of words, of the size of print."""
    rng = np.random.default_rng(8)
    page = np.full((320, 240), 0.82)
    for top in range(16, 300, 10):
        left = 16
        while left < 220:
            for _ in range(int(rng.integers(2, 8))):
                glyph = rng.random((6, 4)) < 0.55
                if left + 4 > 224:
                    break
                page[top : top + 6, left : left + 4][glyph] = 0.03
                left += 5
            left += 5
    return np.repeat(page[..., None], 3, axis=-1)
