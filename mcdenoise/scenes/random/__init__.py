"""Random training scenes: rooms, courts and still lifes; the same seed gives the same scene.

They vary what a denoiser has to handle: light through windows, small and large lamps, sun, gloss, glass, fine and
coarse textures, thin parts, and moving cameras and objects. The description is plain Python and numpy, as
:func:`mcdenoise.scenes.render.render_sequence` expects it; Mitsuba is not needed to build it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from mcdenoise.data.camera_path import Array, Camera
from mcdenoise.scenes.random.builder import SceneBuilder, bounds, rotate
from mcdenoise.scenes.random.cameras import shoot
from mcdenoise.scenes.random.rooms import build
from mcdenoise.scenes.random.shiny import shine

__all__ = ["RandomScene", "random_scene"]

_MOVING_FRACTION = 0.15
# Stream of a seed from which further views are drawn.
_VIEWS = 100
_NEAREST_FOCUS = 0.3


@dataclass(frozen=True, eq=False)
class RandomScene:
    """A scene with its camera path.

    Args:
        scene: a Mitsuba dictionary for :func:`mcdenoise.scenes.render.render_sequence`; units are metres, y is up.
        cameras: one per frame.
        moves: id of an object in ``scene`` to ``(T, 4, 4)`` world-space transforms, one per frame, applied after the
            scene has placed the object. Empty for most seeds.
        focus: distance along the viewing axis of the first camera to the point that it looks at.
    """

    scene: dict[str, Any]
    cameras: list[Camera]
    moves: dict[str, Array] = field(default_factory=dict)
    focus: float = 2.0


def random_scene(seed: int, frames: int = 8, zoom: float = 1.0, *, shiny: bool = False, view: int = 0) -> RandomScene:
    """Make a random scene. The same seed gives the same scene, and a longer shot begins like a shorter one.

    Args:
        seed: seed of the scene, 0 or more.
        frames: number of cameras.
        zoom: enlargement of the image's centre: the cameras see a crop of a larger image, with large uniform surfaces
            and fast motion, at the cost of a small image.
        shiny: add coats, mirrors, glass and metal, and let the cameras look at them.
        view: selects other cameras in the same scene.

    Example:
        >>> made = random_scene(3, frames=2)
        >>> made.scene["type"], len(made.cameras)
        ('scene', 2)
    """
    place_rng, camera_rng, move_rng, level_rng, shine_rng = (
        np.random.default_rng(child) for child in np.random.SeedSequence(seed).spawn(5)
    )
    if view:
        camera_rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_VIEWS, view)))
    builder = build(place_rng)
    if shiny:
        shine(builder, shine_rng)
    cameras = shoot(builder, camera_rng, frames)
    moves = movements(builder, move_rng, frames, cameras[0]) if move_rng.random() < _MOVING_FRACTION else {}
    if zoom != 1:
        cameras = [replace(camera, fov_x=narrowed(camera.fov_x, zoom)) for camera in cameras]
    scene = _exposed(builder.scene(), 10 ** float(level_rng.uniform(-1.5, 1.5)))
    return RandomScene(scene, cameras, moves, distance(builder, cameras[0]))


def distance(builder: SceneBuilder, camera: Camera) -> float:
    """Distance along the viewing axis to the point of interest that a camera looks at."""
    origin, forward = camera.to_world[:3, 3], camera.to_world[:3, 2]
    ways = np.array([point - origin for point in builder.points]).reshape(-1, 3)
    depth = ways @ forward
    ways, depth = ways[depth > _NEAREST_FOCUS], depth[depth > _NEAREST_FOCUS]
    if len(depth) == 0:
        return 2.0
    return float(depth[np.argmax(depth / np.linalg.norm(ways, axis=1))])


def narrowed(fov: float, zoom: float) -> float:
    return math.degrees(2 * math.atan(math.tan(math.radians(fov) / 2) / zoom))


def movements(builder: SceneBuilder, rng: np.random.Generator, frames: int, camera: Camera) -> dict[str, Array]:
    """Let one to three small objects slide, swing or rotate, or let a lamp swing."""
    moves: dict[str, Array] = {}
    bulbs = [name for name in builder.lamps if _is_small(builder, [name])]
    if bulbs and rng.random() < 0.3:
        moves.update(_motion(builder, rng, frames, [bulbs[int(rng.integers(len(bulbs)))]]))
    groups = [names for names in builder.groups.values() if _is_small(builder, names)]
    # Objects in front of the camera come first.
    groups.sort(key=lambda names: -_facing(builder, names, camera))
    for index in rng.permutation(min(len(groups), 5))[: int(rng.integers(1, 4))]:
        moves.update(_motion(builder, rng, frames, groups[int(index)]))
    return moves


def _motion(builder: SceneBuilder, rng: np.random.Generator, frames: int, names: list[str]) -> dict[str, Array]:
    """One movement for all shapes of a group; at frame 0 they are in their original place."""
    center = _center(builder, names)
    direction = rng.normal(0, 1, 3) * (1, 0.2, 1)
    direction *= math.exp(rng.uniform(math.log(0.005), math.log(0.08))) / np.linalg.norm(direction)
    spin = float(rng.choice([0.0, rng.uniform(-12, 12)]))
    swing, phase = rng.uniform(0.05, 0.5), rng.uniform(0, 2 * math.pi)
    transforms = np.empty((frames, 4, 4))
    for frame in range(frames):
        away = direction * (math.sin(swing * frame + phase) - math.sin(phase)) / swing
        turned = rotate("y", spin * frame)
        turned[:3, 3] = center - turned[:3, :3] @ center + away
        transforms[frame] = turned
    return {name: transforms.copy() for name in names}


def _center(builder: SceneBuilder, names: list[str]) -> Array:
    return np.asarray(np.mean([builder.placed(name)[:3, 3] for name in names], axis=0))


def _is_small(builder: SceneBuilder, names: list[str]) -> bool:
    """Whether a group is smaller than 1.5 metres in each direction."""
    corners = [bounds("cube", builder.placed(name)) for name in names]
    low, high = np.min([c[0] for c in corners], axis=0), np.max([c[1] for c in corners], axis=0)
    return bool((high - low).max() < 1.5)


def _facing(builder: SceneBuilder, names: list[str], camera: Camera) -> float:
    """Cosine of the angle between the viewing direction and the direction to a group."""
    way = _center(builder, names) - camera.to_world[:3, 3]
    return float(way @ camera.to_world[:3, 2] / max(float(np.linalg.norm(way)), 1e-9))


def _exposed(scene: dict[str, Any], level: float) -> dict[str, Any]:
    """Scale all lights of the scene, because a denoiser must not depend on the unit of radiance."""
    scaled: dict[str, Any] = {}
    for name, entry in scene.items():
        if not isinstance(entry, dict):
            scaled[name] = entry
        elif entry["type"] == "envmap":
            scaled[name] = {**entry, "bitmap": entry["bitmap"] * level}
        elif "intensity" in entry:
            scaled[name] = {**entry, "intensity": _times(entry["intensity"], level)}
        elif "emitter" in entry:
            emitter = {**entry["emitter"], "radiance": _times(entry["emitter"]["radiance"], level)}
            scaled[name] = {**entry, "emitter": emitter}
        else:
            scaled[name] = entry
    return scaled


def _times(color: dict[str, Any], factor: float) -> dict[str, Any]:
    return {**color, "value": [factor * channel for channel in color["value"]]}
