"""Takes by number: the place, its cameras and movements, and how its frames are sampled."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from mcdenoise.data.camera_path import Array, Camera
from mcdenoise.scenes.assets import Assets
from mcdenoise.scenes.random.builder import rotate
from mcdenoise.scenes.random.cameras import distance, movements, shoot
from mcdenoise.scenes.render.film import Film
from mcdenoise.scenes.takes.furnish import Stock
from mcdenoise.scenes.takes.places import build

FRAMES, REFERENCES = 16, 3
_KIND = 1
# Width and height of clips and of stills: about the same number of paths each.
_CLIP, _STILL = (192, 128), (384, 256)
_STILLS = 0.35

_SAMPLES = {1: 0.42, 2: 0.15, 4: 0.15, 8: 0.12, 16: 0.09, 32: 0.04, 64: 0.03}
_FILTERS = {"centre": 0.2, "box": 0.25, "tent": 0.1, "gaussian": 0.2, "blackman_harris": 0.25}
_FEATURES = {"noisy": 0.5, "exact": 0.2, "clean": 0.3}
_GLOSSY = {"black": 0.35, "white": 0.3, "color": 0.35}
_SPLAT, _LENS, _BLUR = 0.35, 0.2, (1.0, 8.0)
_MOVING, _TURNING_SKY, _LARGEST_ZOOM = 0.35, 0.1, 3.0

_Value = TypeVar("_Value")


@dataclass(frozen=True, eq=False)
class Take:
    """What is rendered as one file.

    Args:
        number: of the take: all below follows from it and the assets.
        attempt: how many places were drawn before it that showed too little.
        scene: a Mitsuba dictionary; shapes of the type ``"mesh"`` hold their triangles.
        cameras: one a frame.
        moves: see :class:`mcdenoise.data.camera_path.CameraPath`.
        void: whether the background is transparent and black.
        size: width and height in pixels.
        spp: samples a pixel of the noisy frames.
        film: filter of the pixel, and lens.
        features: ``"noisy"`` by the samples of the color, ``"exact"`` by a ray through each pixel's centre without a
            lens, ``"clean"`` by further samples.
        glossy: albedo of glass, mirrors and metals: ``"black"``, ``"white"`` or their ``"color"``.
        white_lamps: whether lamps have an albedo of 1, else of 0.
        credits: names, authors and licences of the assets in it.
    """

    number: int
    attempt: int
    scene: dict[str, Any]
    cameras: list[Camera]
    moves: dict[str, Array]
    void: bool
    size: tuple[int, int]
    spp: int
    film: Film
    features: str
    glossy: str
    white_lamps: bool
    credits: tuple[str, ...]

    @property
    def settings(self) -> dict[str, Any]:
        """How it is sampled, for the header of its file."""
        names = ("spp", "filter", "splat", "aperture", "focus", "features", "glossy", "white_lamps", "void", "attempt")
        return {name: {**vars(self), **vars(self.film)}[name] for name in names}


def draw_take(
    number: int,
    assets: Assets,
    attempt: int = 0,
    *,
    frames: int = FRAMES,
    size: tuple[int, int] | None = None,
    stills: bool = True,
    plain: bool = False,
) -> Take:
    """The take of a number, the same on every machine with the same assets.

    Args:
        number: 0 or more.
        assets: what scenes are made of.
        attempt: another draw of the same number.
        frames: of a take that is no still.
        size: width and height in pixels; by default those of training.
        stills: whether it may be a still.
        plain: whether it is a shot, sampled once at pixel centres through a pinhole, with features without noise.
    """
    place_rng, camera_rng, move_rng, rng = (
        np.random.default_rng(child) for child in np.random.SeedSequence((number, attempt)).spawn(4)
    )
    stock = Stock(assets)
    # Another attempt is a place of the same kind, so that hard kinds are as many.
    builder, void = build(place_rng, stock, float(np.random.default_rng((number, _KIND)).random()))
    still = rng.random() < _STILLS and stills and not plain
    size = size or (_STILL if still else _CLIP)
    count = 1 if still else frames
    cameras = shoot(builder, camera_rng, count)
    # Half of them show a whole place; the others have the pixels of a larger image, with wide plain surfaces.
    zoom = math.exp(max(0.0, rng.uniform(-1, 1)) * math.log(_LARGEST_ZOOM))
    fov = math.degrees(2 * math.atan(math.tan(math.radians(cameras[0].fov_x) / 2) / zoom))
    cameras = [replace(camera, fov_x=fov) for camera in cameras]
    moves: dict[str, Array] = {}
    if not still and move_rng.random() < _MOVING:
        moves = movements(builder, move_rng, count, cameras[0])
    scene = builder.scene()
    if not still and "sky" in scene and move_rng.random() < _TURNING_SKY:
        # The sun travels, and the shadows with it.
        speed = float(move_rng.choice([-1, 1]) * np.exp(move_rng.uniform(math.log(0.2), math.log(3))))
        moves["sky"] = np.stack([rotate("y", speed * frame) for frame in range(count)])
    kind = _draw(rng, _FILTERS)
    focus = distance(builder, cameras[0])
    blur = math.exp(rng.uniform(*np.log(_BLUR)))
    pixel = 2 * focus * math.tan(math.radians(fov) / 2) / size[0]
    lens, splat = rng.random() < _LENS, rng.random() < _SPLAT
    take = Take(
        number=number,
        attempt=attempt,
        scene=scene,
        cameras=cameras,
        moves=moves,
        void=void,
        size=size,
        spp=_draw(rng, _SAMPLES),
        film=Film(
            filter=kind,
            # The plane of focus shows a point at distance z with a blur of 2 aperture |z - focus| / z.
            aperture=blur * pixel if lens and kind != "centre" else 0.0,
            focus=focus,
            splat=bool(splat and kind in ("tent", "gaussian")),
        ),
        features=_draw(rng, _FEATURES) if kind != "centre" else "exact",
        glossy=_draw(rng, _GLOSSY),
        white_lamps=bool(rng.random() < 0.5),
        credits=tuple(sorted(stock.credits)),
    )
    if not plain:
        return take
    return replace(take, spp=1, features="exact", film=Film("centre", focus=focus, splat=False))


def _draw(rng: np.random.Generator, weights: Mapping[_Value, float]) -> _Value:
    values = list(weights)
    return values[int(rng.choice(len(values), p=list(weights.values())))]
