"""The demonstration scene: a small living room with a window, a lamp, and a camera that walks past a column.

It contains typical difficulties of denoising: textures, glossy and mirror-like surfaces, glass, soft shadows, a corner
with indirect light only, parallax and disocclusion. All lights can be sampled directly, so that a single path per pixel
already gives an image. The description is plain Python and numpy, as
:func:`mcdenoise.scenes.render.render_sequence` expects it; Mitsuba is not needed to build it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mcdenoise.data.camera_path import Array, Camera
from mcdenoise.scenes.random.builder import Part, ball, box, plate, rod, rotate, scene_of, sheet
from mcdenoise.scenes.random.materials import diffuse, glass, mirror, rough_metal, rough_plastic
from mcdenoise.scenes.random.textures import tint


def demo_scene() -> dict[str, Any]:
    """The room as a Mitsuba dictionary; units are metres, y is up, the floor is y = 0.

    Example:
        >>> demo_scene()["type"]
        'scene'
    """
    return scene_of(_room() | _lights() | _shelf() | _still_life() | _foreground())


def demo_cameras(frames: int = 16) -> list[Camera]:
    """Cameras of a sideways walk: 4 centimetres per frame, with a person's sway.

    Args:
        frames: number of cameras; a longer path continues the same walk back and forth.

    Example:
        >>> len(demo_cameras(3))
        3
    """
    cameras = []
    for frame in range(frames):
        phase = 2 * math.pi * frame / 64
        x = -0.62 * math.cos(phase)
        origin = (x, 1.35 + 0.02 * math.sin(5 * phase), 3.05 - 0.3 * math.sin(phase))
        cameras.append(Camera.look_at(origin, (0.25 * x, 0.82, -1.2), fov_x=58))
    return cameras


def _room() -> dict[str, Part]:
    plaster = diffuse((0.72, 0.69, 0.63))
    return {
        "floor": sheet((0, 0, 0.5), (3, 3.5), rough_plastic(_planks(), 0.15), rotate("x", -90)),
        "ceiling": sheet((0, 2.7, 0.5), (3, 3.5), diffuse((0.8, 0.8, 0.78)), rotate("x", 90)),
        "wall_back": sheet((0, 1.35, -3), (3, 1.35), diffuse(_wallpaper())),
        "wall_left": sheet((-3, 1.35, 0.5), (3.5, 1.35), plaster, rotate("y", 90)),
        "wall_right": sheet((3, 1.35, 0.5), (3.5, 1.35), diffuse((0.62, 0.16, 0.1)), rotate("y", -90)),
        "wall_front": sheet((0, 1.35, 4), (3, 1.35), plaster, rotate("y", 180)),
        "skirting": box((0, 0.06, -2.98), (6, 0.12, 0.04), diffuse((0.75, 0.74, 0.7))),
    }


def _lights() -> dict[str, Part]:
    black = diffuse((0, 0, 0))
    frame = diffuse((0.7, 0.7, 0.68))
    return {
        "window": sheet((-2.96, 1.6, -0.9), (1.1, 0.8), black, rotate("y", 90), (10.5, 11.5, 13.0)),
        "window_post": box((-2.93, 1.6, -0.9), (0.05, 1.7, 0.06), frame),
        "window_bar": box((-2.93, 1.6, -0.9), (0.05, 0.06, 2.3), frame),
        "window_sill": box((-2.9, 0.77, -0.9), (0.2, 0.05, 2.4), frame),
        "lamp_bulb": ball((2.05, 1.62, -2.2), 0.17, black, (21.0, 13.0, 6.5)),
        "lamp_stand": rod((2.05, 0, -2.2), (2.05, 1.46, -2.2), 0.025, rough_metal("Al", 0.15)),
        "lamp_foot": box((2.05, 0.02, -2.2), (0.3, 0.04, 0.3), rough_metal("Al", 0.15)),
    }


def _shelf() -> dict[str, Part]:
    """Two shelves of books and a painting on the back wall: fine detail that the filter should preserve."""
    rng = np.random.default_rng(7)
    wood = diffuse((0.33, 0.2, 0.11))
    parts: dict[str, Part] = {}
    red, blue, ochre = (0.6, 0.12, 0.08), (0.1, 0.25, 0.42), (0.75, 0.6, 0.25)
    palette = [red, blue, ochre, (0.12, 0.36, 0.25), (0.7, 0.68, 0.6), (0.3, 0.12, 0.3)]
    for level, base in enumerate((1.1, 1.65)):
        parts[f"board_{level}"] = box((-1.35, base - 0.02, -2.83), (1.8, 0.04, 0.3), wood)
        left = -2.2
        for book in range(16):
            width, height = rng.uniform(0.05, 0.1), rng.uniform(0.26, 0.42)
            color = palette[int(rng.integers(len(palette)))]
            parts[f"book_{level}_{book}"] = box(
                (left + width / 2, base + height / 2, -2.84), (0.94 * width, height, 0.2), rough_plastic(color, 0.25)
            )
            left += width
    parts["picture_frame"] = box((0.75, 1.6, -2.97), (1.3, 0.95, 0.05), wood)
    parts["picture"] = sheet((0.75, 1.6, -2.94), (0.6, 0.425), diffuse(_painting()))
    return parts


def _still_life() -> dict[str, Part]:
    return {
        "rug": plate((0.1, 0.012, -0.7), 1.5, diffuse(_rings())),
        "plinth": box((0.75, 0.3, -1.25), (0.6, 0.6, 0.6), diffuse(_tiles()), turn=25),
        "glass_ball": ball((0.75, 0.8, -1.25), 0.2, glass()),
        "copper_ball": ball((-0.3, 0.47, -0.95), 0.46, rough_metal("Cu", 0.18)),
        "blue_ball": ball((0.42, 0.235, -0.2), 0.22, rough_plastic((0.04, 0.16, 0.5), 0.05)),
        "green_ball": ball((-0.95, 0.185, -0.3), 0.17, rough_plastic((0.1, 0.42, 0.12), 0.3)),
        "mirror_ball": ball((-0.08, 0.143, -0.1), 0.13, mirror()),
        "yellow_cube": box((-1.5, 0.2, -1.3), (0.4, 0.4, 0.4), rough_plastic((0.75, 0.45, 0.05), 0.2), turn=35),
        "bench": box((-1.5, 0.42, -2.5), (1.7, 0.06, 0.5), diffuse((0.5, 0.33, 0.18))),
        "bench_leg_0": box((-2.2, 0.2, -2.5), (0.08, 0.4, 0.4), diffuse((0.5, 0.33, 0.18))),
        "bench_leg_1": box((-0.8, 0.2, -2.5), (0.08, 0.4, 0.4), diffuse((0.5, 0.33, 0.18))),
        "cushion": ball((-2.0, 0.65, -2.5), 0.2, diffuse((0.1, 0.4, 0.42))),
    }


def _foreground() -> dict[str, Part]:
    """A folding screen that shades a corner, and a slim column that the camera walks past."""
    paper = diffuse(_lattice())
    return {
        "screen_0": box((1.62, 0.7, -0.75), (0.6, 1.4, 0.03), paper, turn=55),
        "screen_1": box((1.96, 0.7, -0.75), (0.6, 1.4, 0.03), paper, turn=-55),
        "column": rod((-0.72, 0, 1.1), (-0.72, 2.7, 1.1), 0.055, rough_plastic((0.55, 0.28, 0.12), 0.15)),
    }


def _planks() -> Array:
    rng = np.random.default_rng(1)
    rows, columns, boards = 512, 512, 24
    y, x = np.mgrid[0:rows, 0:columns]
    board = x * boards // columns
    shift = rng.integers(0, rows, boards)[board]
    piece = ((y + shift) % rows) * 3 // rows
    tone = rng.uniform(0.75, 1.2, (boards, 3))[board, piece]
    grain = 1 + 0.12 * np.sin(0.9 * x + 3 * np.sin(0.02 * (y + 40 * board)) + 9 * tone)
    gap = (x % (columns / boards) < 1.3) | (((y + shift) % rows) % (rows / 3) < 1.5)
    brightness = tone * grain * np.where(gap, 0.35, 1)
    return tint(brightness, (0.42, 0.25, 0.13))


def _wallpaper() -> Array:
    y, x = np.mgrid[0:270, 0:600] / 100
    stripe = 0.93 + 0.07 * np.sign(np.sin(2 * math.pi * x / 0.3))
    leaf = np.sin(2 * math.pi * x / 0.3) * np.sin(2 * math.pi * y / 0.3) > 0.55
    return tint(stripe * np.where(leaf, 1.12, 1), (0.36, 0.5, 0.47))


def _painting() -> Array:
    """A red sun over hills."""
    y, x = np.mgrid[170:0:-1, 0:240] / np.array((170, 240)).reshape(2, 1, 1)
    image = np.stack((0.95 - 0.4 * y, 0.75 - 0.25 * y, 0.45 + 0.25 * y), axis=-1)
    image[(x - 0.68) ** 2 * 2 + (y - 0.38) ** 2 < 0.025] = (0.85, 0.12, 0.05)
    hills = (
        ((0.2, 0.32, 0.42), 0.55, 7.0, 0.0),
        ((0.12, 0.25, 0.25), 0.68, 5.0, 1.5),
        ((0.05, 0.12, 0.1), 0.84, 9.0, 4.0),
    )
    for color, height, frequency, phase in hills:
        image[y > height + 0.09 * np.sin(frequency * x + phase)] = color
    return image


def _rings() -> Array:
    """Stripes over the radius: the texture coordinates of a disk are radius and angle."""
    colors = np.array([(0.55, 0.08, 0.07), (0.75, 0.66, 0.5), (0.08, 0.13, 0.25), (0.7, 0.42, 0.12), (0.75, 0.66, 0.5)])
    radius = np.arange(256)
    petals = np.sin(np.linspace(0, 2 * math.pi * 24, 768, endpoint=False))[:, None] * 3
    return np.asarray(colors[((radius[None] + petals) // 18).astype(int) % len(colors)])


def _tiles() -> Array:
    y, x = np.mgrid[0:256, 0:256]
    checker = (x // 32 + y // 32) % 2
    return np.where(checker[..., None] == 1, (0.78, 0.75, 0.68), (0.09, 0.2, 0.22))


def _lattice() -> Array:
    y, x = np.mgrid[0:320, 0:150]
    bar = (x % 50 < 8) | (y % 80 < 8) | (x > 142) | (y > 312)
    return np.where(bar[..., None], (0.1, 0.05, 0.03), (0.75, 0.7, 0.58))
