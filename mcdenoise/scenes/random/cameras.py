"""Random camera paths through free space, movements of objects and lamps, and where a lens is focused."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from mcdenoise.data.camera_path import Array, Camera
from mcdenoise.scenes.random.builder import SceneBuilder, bounds, rotate
from mcdenoise.scenes.random.textures import Rng, log_uniform

# Last frame of a path; a longer shot goes back and forth.
_HORIZON = 16
# Minimum distance in metres to the bounding box of any object.
_CLEARANCE = 0.12
_TRIES = 150
_NEAREST_FOCUS = 0.3


class _View(NamedTuple):
    origin: Array
    target: Array
    fov_x: float


def shoot(builder: SceneBuilder, rng: Rng, frames: int) -> list[Camera]:
    """A camera path through free space; its first frames do not depend on its length."""
    boxes = builder.boxes()
    moving = rng.random() > 0.2
    best: tuple[float, list[_View]] = (-1.0, [])
    for _ in range(_TRIES):
        start = _propose(builder, rng)
        views = _moved(start, rng) if moving else [start] * (_HORIZON + 1)
        score = 0.0
        if _is_free(builder, boxes, views):
            score = min(_score(boxes, views[frame]) for frame in (0, _HORIZON // 2, _HORIZON))
        if score > best[0]:
            best = (score, views)
        if score >= 1:
            break
    seen = [best[1][_HORIZON - abs(frame % (2 * _HORIZON) - _HORIZON)] for frame in range(frames)]
    return [Camera.look_at(one.origin.tolist(), one.target.tolist(), one.fov_x) for one in seen]


def _propose(builder: SceneBuilder, rng: Rng) -> _View:
    low, high = builder.low + 0.25, builder.high - 0.25
    origin = rng.uniform(low, high)
    if rng.random() < 0.7 and high[1] > 1.5:
        # Mostly at eye level.
        origin[1] = np.clip(rng.normal(1.35, 0.3), low[1], high[1])
    points = builder.points or [(low + high) / 2]
    target = points[int(rng.integers(len(points)))] + rng.normal(0, 0.15, 3)
    fov = rng.uniform(45, 75) if rng.random() < 0.6 else rng.uniform(20, 45)
    return _View(origin, target, fov)


def _is_free(builder: SceneBuilder, boxes: tuple[Array, Array], views: list[_View]) -> bool:
    """Whether every camera of a path is inside the bounds and outside all objects."""
    origins = np.array([view.origin for view in views])[:, None]
    lows, highs = boxes
    inside = ((origins > lows - _CLEARANCE) & (origins < highs + _CLEARANCE)).all(axis=-1)
    out = (origins < builder.low) | (origins > builder.high)
    return not (inside.any() or out.any())


def _score(boxes: tuple[Array, Array], view: _View) -> float:
    """1 or more if a camera sees several objects at sufficient distance; objects are represented by their boxes."""
    lows, highs = boxes
    forward = view.target - view.origin
    distance = float(np.linalg.norm(forward))
    if not len(lows) or distance < 0.5 or abs(forward[1]) > 0.9 * distance:
        return 0.0
    forward /= distance
    left = np.cross((0.0, 1.0, 0.0), forward)
    left /= np.linalg.norm(left)
    up = np.cross(forward, left)
    extent = math.tan(math.radians(view.fov_x) / 2)
    steps = np.linspace(-0.85, 0.85, 7) * extent
    rays = np.array([forward + a * left + b * up for a in steps for b in steps])
    with np.errstate(divide="ignore", invalid="ignore"):
        first = (lows[None] - view.origin) / rays[:, None]
        second = (highs[None] - view.origin) / rays[:, None]
    enter = np.nanmax(np.minimum(first, second), axis=-1)
    leave = np.nanmin(np.maximum(first, second), axis=-1)
    hit = np.where((leave > enter) & (enter > 0), enter, np.inf)
    nearest, which = hit.min(axis=1), hit.argmin(axis=1)
    seen = np.isfinite(nearest)
    close = float((nearest < 0.45).mean())
    kinds = len(set(which[seen].tolist()))
    median = float(np.median(np.where(seen, nearest, 20)))
    return min(kinds / 8, 1) * min(median / 1.0, 1) * (1 - close) * min(float(seen.mean()) / 0.5, 1) + (
        0.1 if close < 0.1 and kinds >= 7 and median > 0.9 and seen.mean() > 0.45 else 0
    )


def _moved(view: _View, rng: Rng) -> list[_View]:
    """A path with a movement of 0.3 to 12 pixels per frame in an image 256 pixels wide."""
    speed = log_uniform(rng, 0.3, 12)
    angle = math.radians(view.fov_x) / 256 * speed
    forward = view.target - view.origin
    length = float(np.linalg.norm(forward))
    left = np.cross((0.0, 1.0, 0.0), forward / length)
    step = angle * length
    kind = rng.choice(["dolly", "forward", "orbit", "pan", "free"], p=[0.3, 0.2, 0.15, 0.15, 0.2])
    sign = float(rng.choice([-1, 1]))
    drift = rng.normal(0, 1, 3) * (1, 0.3, 1)
    drift *= step / np.linalg.norm(drift)
    # A hand's sway is a sum of waves, so that any frame can be computed without the previous ones.
    sway = rng.choice([0.0, rng.uniform(0.1, 1.5)], p=[0.5, 0.5]) * math.radians(view.fov_x) / 256
    waves, phases = rng.uniform(0.4, 2.2, (3, 2)), rng.uniform(0, 2 * math.pi, (3, 2))

    def move(frame: int) -> _View:
        origin, target = view.origin, view.target
        shift = np.sin(waves * frame + phases).sum(axis=1) * sway * length
        if kind == "dolly":
            offset = sign * frame * step * left
            origin, target = origin + offset, target + 0.7 * offset
        elif kind == "forward":
            # Moving straight ahead moves only the edges of the image, and by less.
            origin = origin + sign * min(2 * frame * step, 0.6 * length) * forward / length
            target = target + sign * forward
        elif kind == "orbit":
            origin = target + _turned(-forward, sign * frame * angle)
        elif kind == "pan":
            target = origin + _turned(forward, sign * frame * angle)
        else:
            origin, target = origin + frame * drift, target + 0.3 * frame * np.roll(drift, 1)
        return _View(origin, target + shift, view.fov_x)

    return [move(frame) for frame in range(_HORIZON + 1)]


def _turned(vector: Array, angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array((c * vector[0] + s * vector[2], vector[1], c * vector[2] - s * vector[0]))


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
    bulbs = [name for name in builder.lamps() if _is_small(builder, [name])]
    if bulbs and rng.random() < 0.3:
        moves.update(_motion(builder, rng, frames, [bulbs[int(rng.integers(len(bulbs)))]]))
    groups = [names for names in builder.groups if _is_small(builder, names)]
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
        transforms[frame] = rotate("y", spin * frame)
        transforms[frame, :3, 3] = center - transforms[frame, :3, :3] @ center + away
    return dict.fromkeys(names, transforms)


def _center(builder: SceneBuilder, names: list[str]) -> Array:
    return np.asarray(np.mean([builder.placed(name)[:3, 3] for name in names], axis=0))


def _is_small(builder: SceneBuilder, names: list[str]) -> bool:
    """Whether a group is smaller than 1.5 metres in each direction."""
    corners = np.concatenate([bounds("cube", builder.placed(name)) for name in names])
    return bool(np.ptp(corners, axis=0).max() < 1.5)


def _facing(builder: SceneBuilder, names: list[str], camera: Camera) -> float:
    """Cosine of the angle between the viewing direction and the direction to a group."""
    way = _center(builder, names) - camera.to_world[:3, 3]
    return float(way @ camera.to_world[:3, 2] / max(float(np.linalg.norm(way)), 1e-9))
