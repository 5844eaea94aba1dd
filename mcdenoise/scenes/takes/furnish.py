"""Models of the assets in a scene: their materials, and places for them on floors, along walls and on tables."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mcdenoise.data.camera_path import Array
from mcdenoise.errors import InputError
from mcdenoise.scenes.assets import Assets, Model, Surface, read_normal_map
from mcdenoise.scenes.random.builder import TURNS, SceneBuilder, place, shape
from mcdenoise.scenes.random.furniture import ornament
from mcdenoise.scenes.random.lights import bulb, light_color
from mcdenoise.scenes.random.materials import Bsdf, bitmap, diffuse, lacquer, mirror, pane, random_metal, rough_plastic
from mcdenoise.scenes.random.rooms import furnish
from mcdenoise.scenes.random.textures import Rng

# Triangles of a scene, which bound the memory and the time to build it.
_ENOUGH = 500_000
_SMALL, _LEAST = 0.5, 0.03
_INDOORS = ("Living room", "Bedroom", "Kitchen", "Bathroom", "Office")
_OUTDOORS = ("Exterior", "Vehicles", "Characters")


@dataclass
class Stock:
    """The assets of one scene, and what it has used of them.

    Args:
        assets: what there is.
        credits: name, author and licence of everything used.
        triangles: in the scene so far.
    """

    assets: Assets
    credits: set[str] = field(default_factory=set)
    triangles: int = 0

    def model(self, rng: Rng, choices: list[Model]) -> Model | None:
        """One of these models, or none where there is none, or where the scene is full."""
        return None if not choices or self.triangles > _ENOUGH else choices[int(rng.integers(len(choices)))]

    def _things(self, keep: Callable[[Model], bool]) -> list[Model]:
        return [model for model in self.assets.models if not model.opening and keep(model)]

    def small(self) -> list[Model]:
        """Things that stand on tables."""
        return self._things(lambda model: _LEAST < max(model.size) < _SMALL and model.elevation == 0)

    def pieces(self, theme: str, largest: Array) -> list[Model]:
        """Things that stand on the floor of a room of a size."""
        kinds = (theme, "Miscellaneous", "Lights")
        found = self._things(lambda model: model.category in kinds and model.elevation < 0.1)
        return [model for model in found if max(model.size) > 0.35 and (np.array(model.size) < largest).all()]

    def hung(self, theme: str) -> list[Model]:
        """Things that hang on a wall."""
        return self._things(lambda model: model.category in (theme, "Miscellaneous") and 0.5 < model.elevation < 2)

    def outside(self) -> list[Model]:
        """Things that stand on the ground outdoors."""
        found = self._things(lambda model: model.category in _OUTDOORS and model.elevation < 0.1)
        return [model for model in found if max(model.size) < 9]

    def image(self, rng: Rng, paths: Sequence[Path]) -> Path:
        """One of these skies or normal maps."""
        path = paths[int(rng.integers(len(paths)))]
        self.credits.add(self.assets.credit(path))
        return path


def add_model(
    builder: SceneBuilder,
    rng: Rng,
    stock: Stock,
    model: Model,
    frame: Array,
    *,
    scale: float = 1.0,
    movable: bool = False,
    brightness: float = 0.0,
) -> bool:
    """Put a model into the scene; returns whether it could be read.

    Args:
        builder: collects the objects.
        rng: the source of randomness.
        stock: what there is.
        model: what to add.
        frame: place of the middle of its bottom; its front faces +z.
        scale: enlargement.
        movable: whether it may move.
        brightness: flux of its lamps together.
    """
    try:
        found = model.read()
    except InputError:
        return False
    half = np.array(model.size) / 2 * scale
    box = place((0, float(half[1]), 0), scale=half.tolist())
    parts = [shape("mesh", box, builder.material(_bsdf(rng, surface)), mesh=mesh) for mesh, surface in found]
    for lamp in model.lamps if brightness else ():
        radius = max(lamp.diameter / 2 * scale, 0.01)
        center = box[:3, :3] @ np.clip(lamp.center, -1, 1) + box[:3, 3]
        color, black = light_color(rng), builder.material(diffuse((0.02, 0.02, 0.02)))
        parts.append(bulb(center, radius, black, brightness / len(model.lamps), color))
    builder.add(parts, frame, movable=movable, look=(0, half[1], 0))
    stock.credits.add(f"{model.name} ({model.credit})")
    stock.triangles += sum(len(mesh.faces) for mesh, _ in found)
    return True


def _bsdf(rng: Rng, surface: Surface) -> Bsdf:
    """A material of a model, at times made glossier than its author did, because renderers' users do so."""
    look = surface.color.astype(np.float64)
    image = np.clip(look if look.ndim == 3 else np.tile(look, (2, 2, 1)), 0, 0.95)
    if not isinstance(surface.opacity, float):
        return {"type": "mask", "opacity": bitmap(surface.opacity.astype(np.float64)), "bsdf": diffuse(image)}
    if surface.opacity < 0.7:
        return pane()
    change = rng.random()
    if surface.shine > 0.6 and float(image.mean()) < 0.3 and change < 0.5:
        return random_metal(rng) if change < 0.3 else mirror()
    if change < 0.08:
        return lacquer(image, nonlinear=bool(rng.random() < 0.5))
    if change < 0.12:
        return random_metal(rng)
    if surface.shine > 0.04 or change > 0.8:
        alpha = math.sqrt(2 / (max(surface.exponent, 1) + 2)) * rng.uniform(0.4, 1)
        return rough_plastic(image, float(np.clip(alpha, 0.02, 0.45)))
    return diffuse(image)


def bumpy(rng: Rng, stock: Stock, bsdf: Bsdf, repeat: float) -> Bsdf:
    """A one-layer material with a normal map over it, if there is one."""
    path = stock.image(rng, stock.assets.normals) if stock.assets.normals else None
    if path is None or bsdf["type"] != "twosided":
        return bsdf
    normals = bitmap(read_normal_map(path).astype(np.float64), (repeat, repeat))
    return {"type": "twosided", "bsdf": {"type": "normalmap", "normalmap": normals, "bsdf": bsdf["bsdf"]}}


class Floor:
    """Free places on a rectangle; pieces keep their distance by the boxes around them."""

    def __init__(self, low: Array, high: Array) -> None:
        self.low, self.high = low, high
        self._taken: list[tuple[float, float, float, float]] = []

    def find(self, rng: Rng, width: float, depth: float, top: float = 0.0, *, walls: float = 0.7) -> Array | None:
        """A free place at a height: along a wall, facing inwards, or anywhere."""
        for _ in range(14):
            wall = int(rng.integers(4))
            turn = TURNS[wall]
            along = rng.random() < walls
            if not along and rng.random() < 0.5:
                turn = rng.uniform(0, 360)
            c, s = abs(math.cos(math.radians(turn))), abs(math.sin(math.radians(turn)))
            half = np.array((c * width + s * depth, s * width + c * depth)) / 2
            low, high = self.low[[0, 2]] + half + 0.02, self.high[[0, 2]] - half - 0.02
            if (low > high).any():
                continue
            x, z = rng.uniform(low, high)
            if along:
                x, z = ((x, low[1]), (low[0], z), (x, high[1]), (high[0], z))[wall]
            box = (x - half[0], x + half[0], z - half[1], z + half[1])
            if all(box[1] < a or box[0] > b or box[3] < c_ or box[2] > d for a, b, c_, d in self._taken):
                self._taken.append(box)
                return place((x, top, z), turn)
        return None


def fill_room(builder: SceneBuilder, rng: Rng, stock: Stock, brightness: float) -> None:
    """Furnish a room of one theme, with small things on what has a top; without models, with procedural pieces."""
    if not stock.assets.models:
        furnish(builder, rng)
        return
    room = builder.high - builder.low
    kind = _INDOORS[int(rng.integers(len(_INDOORS)))]
    pieces, hung = stock.pieces(kind, room * (0.75, 0.95, 0.75)), stock.hung(kind)
    floor = Floor(builder.low, builder.high)
    for _ in range(int(np.clip(room[0] * room[2] / rng.uniform(1.3, 3), 4, 16))):
        model = stock.model(rng, pieces)
        if model is None:
            break
        frame = floor.find(rng, model.size[0], model.size[2])
        if frame is None:
            continue
        lit = brightness * rng.uniform(0.05, 0.4) if model.lamps else 0.0
        small = max(model.size) < 1.2
        if add_model(builder, rng, stock, model, frame, movable=small, brightness=lit) and model.top > 0.1:
            fill_top(builder, rng, stock, frame, model.size[0], model.size[2], model.top)
    for _ in range(int(rng.integers(0, 4))):
        model = stock.model(rng, hung)
        if model is None or model.size[2] > 0.8:
            continue
        wall = int(rng.integers(4))
        side = room[0] if wall % 2 == 0 else room[2]
        x = float(rng.uniform(-0.35, 0.35) * side)
        y = min(model.elevation, float(room[1]) - model.size[1] - 0.02)
        deep = float(room[2] if wall % 2 == 0 else room[0]) / 2 - model.size[2] / 2
        frame = place((0, 0, 0), TURNS[wall]) @ place((x, y, -deep))
        add_model(builder, rng, stock, model, frame, brightness=0.1 * brightness)


def fill_top(
    builder: SceneBuilder, rng: Rng, stock: Stock, frame: Array, width: float, depth: float, top: float, most: int = 7
) -> None:
    """Put small things on a top, mostly models."""
    half = np.array((width, 0, depth)) * 0.45
    surface, small = Floor(-half, half), stock.small()
    for _ in range(int(rng.integers(1, most + 1))):
        model = stock.model(rng, small)
        size = rng.uniform(0.06, 0.3) * min(1.0, max(width, depth))
        if model is not None and rng.random() < 0.2:
            model = None
        spot = surface.find(rng, *((size, size) if model is None else (model.size[0], model.size[2])), top, walls=0)
        if spot is None:
            continue
        if model is None:
            builder.add(ornament(builder, rng, size), frame @ spot, movable=True, look=(0, 0, 0))
        else:
            add_model(builder, rng, stock, model, frame @ spot, movable=True)
