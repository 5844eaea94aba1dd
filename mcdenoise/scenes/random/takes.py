"""Takes of a random scene: one clip or several stills, with sampling, filter, lens and number of samples.

Each of these is drawn from its own random stream, so that the scene does not depend on them.
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
# Minimum ratio of reference samples to noisy samples: a reference with nearly the same noise would teach nothing.
CLEANER = 4
_STREAM = 101
_CENTRE_FRACTION = 1 / 3
_FILTERS = {"box": 0.5, "gaussian": 0.25, "tent": 0.1, "mitchell": 0.15}
_SAMPLES = {1: 0.5, 2: 0.14, 4: 0.14, 8: 0.1, 16: 0.08, 32: 0.025, 64: 0.015}
_LENS_FRACTION = 0.2
# Blur in pixels of a point at twice the focus distance.
_BLUR = (1.0, 8.0)


@dataclass(frozen=True)
class Take:
    """A sequence to render.

    Args:
        name: name of its folder.
        made: the scene with the cameras of this take.
        film: filter and lens, ``None`` for samples at the pixel centre.
        spp: samples per pixel of the noisy color.
        view: number of the take among those of the scene.
    """

    name: str
    made: RandomScene
    film: Film | None
    spp: int
    view: int = 0


def random_takes(
    seed: int,
    frames: int,
    *,
    sampling: Sampling = "centre",
    spp: int | None = 1,
    stills: float = 0.0,
    shiny: bool = False,
    width: int = 160,
) -> list[Take]:
    """The takes of a seed: one clip of ``frames`` frames, or half as many stills, each with its own film.

    Args:
        seed: seed of the scene, 0 or more.
        frames: number of frames of a clip.
        sampling: at the pixel centre, through a filter, or mixed: a third at the centre and the rest filtered.
        spp: samples per pixel of the noisy color; ``None`` draws them, from 1 (half of the takes) to 64 (rarely).
        stills: fraction of the seeds with stills.
        shiny: see :func:`mcdenoise.scenes.random.random_scene`.
        width: width of the image in pixels.

    Example:
        >>> [take.name for take in random_takes(3, 2)]
        ['random0003']
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(_STREAM,)))
    if rng.random() >= stills:
        made = random_scene(seed, frames, shiny=shiny)
        return [_take(f"random{seed:04d}", made, rng, sampling, spp, width)]
    takes = []
    for view in range(max(1, frames // 2)):
        made = random_scene(seed, 1, shiny=shiny, view=view)
        still = RandomScene(made.scene, made.cameras, focus=made.focus)
        take = _take(f"random{seed:04d}_{view}", still, rng, sampling, spp, width)
        takes.append(replace(take, view=view))
    return takes


def _take(
    name: str, made: RandomScene, rng: np.random.Generator, sampling: Sampling, spp: int | None, width: int
) -> Take:
    # Draw all values, used or not, so that one option does not change what another option draws.
    centre, drawn = rng.random() < _CENTRE_FRACTION, _draw(rng, _SAMPLES)
    film = _film(rng, made.cameras[0], made.focus, width)
    filtered = sampling == "filtered" or (sampling == "mixed" and not centre)
    return Take(name, made, film if filtered else None, drawn if spp is None else spp)


def _film(rng: np.random.Generator, camera: Camera, focus: float, width: int) -> Film:
    name, lens, blur = _draw(rng, _FILTERS), rng.random() < _LENS_FRACTION, math.exp(rng.uniform(*np.log(_BLUR)))
    if not lens:
        return Film(name)
    pixel = 2 * focus * math.tan(math.radians(camera.fov_x) / 2) / width
    # The plane of focus shows a point at distance z with a blur of 2 aperture |z - focus| / z.
    return Film(name, aperture=blur * pixel, focus=focus)


def _draw(rng: np.random.Generator, weights: Mapping[_Value, float]) -> _Value:
    values = list(weights)
    return values[int(rng.choice(len(values), p=list(weights.values())))]
