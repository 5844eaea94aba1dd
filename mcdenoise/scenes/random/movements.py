"""Movements of small objects and lamps in a random scene, and where a lens is focused."""

from __future__ import annotations

import math

import numpy as np

from mcdenoise.data.camera_path import Array, Camera
from mcdenoise.scenes.random.builder import SceneBuilder, bounds, rotate
from mcdenoise.scenes.random.textures import Rng

_NEAREST_FOCUS = 0.3


def distance(builder: SceneBuilder, camera: Camera) -> float:
    """Distance along the viewing axis to the point of interest that a camera looks at."""
    origin, forward = camera.to_world[:3, 3], camera.to_world[:3, 2]
    ways = np.array([point - origin for point in builder.points]).reshape(-1, 3)
    depth = ways @ forward
    ways, depth = ways[depth > _NEAREST_FOCUS], depth[depth > _NEAREST_FOCUS]
    if len(depth) == 0:
        return 2.0
    return float(depth[np.argmax(depth / np.linalg.norm(ways, axis=1))])


def movements(builder: SceneBuilder, rng: Rng, frames: int, camera: Camera) -> dict[str, Array]:
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


def _motion(builder: SceneBuilder, rng: Rng, frames: int, names: list[str]) -> dict[str, Array]:
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
