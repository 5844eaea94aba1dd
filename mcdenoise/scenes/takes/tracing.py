"""Tracing the frames of a take with Mitsuba."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mcdenoise.data.camera_path import Array
from mcdenoise.scenes.random.materials import METALS
from mcdenoise.scenes.render.loading import Stage
from mcdenoise.scenes.render.tracer import ALBEDO, COLOR, DEPTH, HIT, NORMAL, REST, Samples, Tracer
from mcdenoise.scenes.takes.draw import Take

_DEPTHS = 8, 3
# Samples of each half of a reference: 11 x 12 strata.
HALF = 132
_CLEAN, _PROBE = 16, 8
_LAYERS = 3
_MOTION, _ROUGHNESS = slice(REST, REST + 2), slice(REST + 2, REST + 3)


class TakeTracer(Tracer):
    """A take's scene, ready to be traced.

    Args:
        take: what to trace.
        variant: a variant of Mitsuba.
        threads: of Dr.Jit; 0 for all processors.
        half: samples a pixel of each half of a reference.

    Raises:
        InputError: see :class:`mcdenoise.scenes.render.loading.Stage`.
    """

    # No light of a scene is as bright by far: such a sample is an error of rounding, and one would spoil a reference.
    largest = 1e8

    def __init__(self, take: Take, variant: str, threads: int = 0, half: int = HALF) -> None:
        self.take, self.half = take, half
        self.lamps, self.void = float(take.white_lamps), take.void
        # Reading the scene with one thread may wait for ever; see Stage.
        stage = Stage(take.scene, variant, take.moves, merge=False)
        if threads:
            stage.drjit.set_thread_count(threads)
        masked = any(isinstance(e, Mapping) and e.get("type") == "mask" for e in take.scene.values())
        layers = _LAYERS if masked else 0
        super().__init__(stage, take.cameras, take.size, take.film, _DEPTHS, looks=_looks(take), layers=layers)

    def noisy(self, frame: int) -> dict[str, Array]:
        """Color and features of a frame: ``(C, H, W)`` by name."""
        take = self.take
        pixels = self.pixels(self._scattered(frame, take.spp, 0))
        if take.features == "exact" and (take.film.filter != "centre" or take.spp > 1):
            pixels[:, 3:] = self.pixels(self.trace(frame, 1, (0,), color=False, exact=True))[:, 3:]
        elif take.features == "clean":
            pixels[:, 3:] = self.pixels(self._scattered(frame, _CLEAN, 3, color=False))[:, 3:]
        hit = pixels[:, HIT]
        # Features of what was not hit do not count for the depth.
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.where(hit > 0, pixels[:, DEPTH] / hit, np.inf)
        found = {
            "color": pixels[:, COLOR],
            "albedo": np.clip(pixels[:, ALBEDO], 0, 1),
            "normal": pixels[:, NORMAL],
            "depth": depth,
            "motion": pixels[:, _MOTION],
            "alpha": np.clip(hit, 0, 1),
            "roughness": np.clip(pixels[:, _ROUGHNESS], 0, 1),
        }
        width, height = take.size
        return {name: image.T.reshape(-1, height, width) for name, image in found.items()}

    def halves(self, frame: int) -> tuple[Array, Array]:
        """Two independent halves of the reference of a frame, ``(3, H, W)`` each."""
        width, height = self.take.size
        seeds = ((self.take.number, frame, part) for part in (1, 2))
        both = (self.radiance(frame, self.half, seed, stratified=True) for seed in seeds)
        first, second = (color.T.reshape(3, height, width) for color in both)
        return first, second

    def noise(self, frame: int) -> float:
        """SMAPE between two means of a few samples: 0 without noise, 1 where few samples find light at all."""
        both = [self._scattered(frame, _PROBE, part).values.mean(1) for part in (4, 5)]
        first, second = (samples[:, COLOR].mean(-1) for samples in both)
        total, seen = first + second, both[0][:, HIT.start] > 0
        # What is seen and has no light in any sample is as noisy as can be.
        lit = total > 1e-3 * total.mean()
        noise = np.where(lit, np.abs(first - second) / np.maximum(total, 1e-30), 1)
        return float(noise[lit | seen].mean())

    def release(self) -> None:
        """Give the memory back that Dr.Jit keeps for the next scene."""
        self._dr.flush_malloc_cache()

    def _scattered(self, frame: int, spp: int, part: int, *, color: bool = True) -> Samples:
        """Samples as the take's film has them."""
        return self.trace(frame, spp, (self.take.number, frame, part), color=color, even=self.film.spreads)

    def _glossy(self, hit: Any, bsdf: Any, diffuse: Any) -> Any:
        return self._mi.Color3f(*self._row(hit)[1:4])

    def _rest(self, ray: Any, hit: Any, valid: Any, shot: Any) -> list[Any]:
        """Way to where the point was in the previous frame, in pixels, and roughness; the sky turns with the camera."""
        mi, dr = self._mi, self._dr
        points = (hit.p, shot.camera), (self._earlier(hit, shot), shot.before)
        start, end = (
            self._raster(dr.select(valid, point - mi.Point3f(*camera[9:12]), mi.Vector3f(ray.d)), camera)
            for point, camera in points
        )
        return [end[0] - start[0], end[1] - start[1], dr.select(valid, self._row(hit)[0], 0)]

    def _raster(self, way: Any, camera: Sequence[Any]) -> tuple[Any, Any]:
        dr, (width, height) = self._dr, self.take.size
        left, up, forward = (sum(way[i] * camera[3 * k + i] for i in range(3)) for k in range(3))
        # A point behind the camera is far outside of the image.
        scale = width / 2 / (dr.maximum(forward, 1e-4) * camera[12])
        return width / 2 - left * scale, height / 2 - up * scale


def stratified(samples: int) -> int:
    """The least number of samples, from this one on, that Mitsuba's multi-jittered sampler can draw: a full grid."""
    rows = math.isqrt(samples)
    return rows * -(-samples // rows)


def _looks(take: Take) -> dict[str, tuple[float, ...]]:
    """Roughness, and albedo without diffuse reflection, of each shape, as renderers write them."""
    looks: dict[str, tuple[float, ...]] = {}
    for name, entry in take.scene.items():
        material = take.scene.get(entry.get("bsdf", {}).get("id", "")) if isinstance(entry, Mapping) else None
        if material is not None:
            while "bsdf" in material:
                material = material["bsdf"]
            alpha = material.get("alpha", float(material["type"] == "diffuse"))
            mean = float(np.mean(alpha["bitmap"] if isinstance(alpha, Mapping) else alpha))
            color = {"black": (0, 0, 0), "white": (1, 1, 1), "color": METALS.get(material.get("material"), (1, 1, 1))}
            # Perceptual roughness is the root of Beckmann's parameter.
            looks[name] = (math.sqrt(min(max(mean, 0.0), 1.0)), *color[take.glossy])
    return looks
