"""How a random scene is photographed: one clip or several stills, and by which sampling, filter, lens and samples.

Each is drawn from a stream of its own, so that a scene is the same whatever is asked of it here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias, TypeVar

import numpy as np

from mcdenoise.data.camera_path import Camera
from mcdenoise.scenes.random import RandomScene, random_scene
from mcdenoise.scenes.render.film import Film

Sampling: TypeAlias = Literal["centre", "filtered", "mixed"]

_Value = TypeVar("_Value")
# Samples of a reference for each one of the noisy color: hardly less noisy than that, it would teach nothing.
CLEANER = 4
_STREAM = 101
_CENTRE_SHARE = 1 / 3
_FILTERS = {"box": 0.5, "gaussian": 0.25, "tent": 0.1, "mitchell": 0.15}
_SAMPLES = {1: 0.5, 2: 0.14, 4: 0.14, 8: 0.1, 16: 0.08, 32: 0.025, 64: 0.015}
_LENS_SHARE = 0.2
# Pixels across: what a point is blurred to at twice the distance that is sharp.
_BLUR = (1.0, 8.0)


@dataclass(frozen=True)
class Take:
    """A sequence to be rendered.

    Args:
        name: of its folder.
        made: the scene with the cameras of this take.
        film: filter and lens, ``None`` for samples at the pixel centre.
        spp: samples a pixel of the noisy color.
        view: which of several takes of one scene.
    """

    name: str
    made: RandomScene
    film: Film | None
    spp: int
    view: int = 0


def random_takes(
    seed: int,
    frames: int,
    zoom: float = 1.0,
    *,
    sampling: Sampling = "centre",
    spp: int | None = 1,
    stills: float = 0.0,
    shiny: bool = False,
    width: int = 160,
) -> list[Take]:
    """The takes of a seed: one clip of so many frames, or as many stills as half of that, each by its own film.

    Args:
        seed: which of the scenes, 0 or more.
        frames: of a clip.
        zoom: see :func:`mcdenoise.scenes.random.random_scene`.
        sampling: at the pixel centre, through a filter, or for a third of the takes the one and for the rest the other.
        spp: samples a pixel of the noisy color; ``None`` draws them, from 1 (half of the takes) to 64 (rarely).
        stills: fraction of the seeds that give stills.
        shiny: see :func:`mcdenoise.scenes.random.random_scene`.
        width: of the image in pixels.

    Example:
        >>> [take.name for take in random_takes(3, 2)]
        ['random0003']
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_STREAM,)))
    if rng.random() >= stills:
        made = random_scene(seed, frames, zoom, shiny=shiny)
        return [_take(f"random{seed:04d}", made, rng, sampling, spp, width)]
    takes = []
    for view in range(max(1, frames // 2)):
        made = random_scene(seed, 1, zoom, shiny=shiny, view=view)
        still = RandomScene(made.scene, made.cameras, focus=made.focus)
        take = _take(f"random{seed:04d}_{view}", still, rng, sampling, spp, width)
        takes.append(replace(take, view=view))
    return takes


def _take(
    name: str, made: RandomScene, rng: np.random.Generator, sampling: Sampling, spp: int | None, width: int
) -> Take:
    # All is drawn whether it is used or not: what one option leaves alone another one must not change.
    centre, drawn = rng.random() < _CENTRE_SHARE, _draw(rng, _SAMPLES)
    film = _film(rng, made.cameras[0], made.focus, width)
    filtered = sampling == "filtered" or (sampling == "mixed" and not centre)
    return Take(name, made, film if filtered else None, drawn if spp is None else spp)


def _film(rng: np.random.Generator, camera: Camera, focus: float, width: int) -> Film:
    name, lens, blur = _draw(rng, _FILTERS), rng.random() < _LENS_SHARE, math.exp(rng.uniform(*np.log(_BLUR)))
    if not lens:
        return Film(name)
    pixel = 2 * focus * math.tan(math.radians(camera.fov_x) / 2) / width
    # A point at distance z is blurred to 2 aperture |z - focus| / z on the plane that is sharp.
    return Film(name, aperture=blur * pixel, focus=focus)


def _draw(rng: np.random.Generator, weights: Mapping[_Value, float]) -> _Value:
    values = list(weights)
    return values[int(rng.choice(len(values), p=list(weights.values())))]
