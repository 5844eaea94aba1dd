"""Samples of a scene by Mitsuba 3: one program for color and features of the same paths.

Mitsuba's own renderer always jitters samples inside the pixel, and its features depend on the kind of material.
Therefore the rays are generated here and traced by Mitsuba.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcdenoise.data.camera_path import Array, Camera
from mcdenoise.scenes.render.film import Film, offsets, splat
from mcdenoise.scenes.render.loading import Stage, to_previous

# Samples traced at once: enough to fill the vector units, small enough for a laptop's memory.
WAVEFRONT = 2**22
# Channels of a sample; those after the depth depend on the tracer.
COLOR, ALBEDO, NORMAL, HIT, DEPTH, REST = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 10), slice(10, 11), 11
_CHANNELS_OF_COLOR = 3
# Of a shape: roughness, albedo without diffuse reflection, number among the moving ones.
_COLUMNS, _STILL = 5, (0.0, 0.0, 0.0, 0.0, -1.0)


class Samples(NamedTuple):
    """Samples of a frame's pixels.

    Args:
        values: ``(H*W, S, C)``; only the color's channels if no features are wanted.
        places: horizontal and vertical place of each in its pixel, ``(2, H*W, S)``, where they are to be weighed.
    """

    values: NDArray[np.float32]
    places: NDArray[np.float32] | None


class _Shot(NamedTuple):
    """Where the samples of a frame are taken, and what of them is wanted; cameras are as `_lens` has them."""

    camera: list[Any]
    before: list[Any]
    moved: Any
    spp: int
    color: bool
    features: bool
    exact: bool
    stratified: bool
    even: bool


class Tracer:
    """Traces samples through a scene, one by one in the scalar variant, all at once in the others.

    Args:
        stage: the scene.
        cameras: one a frame.
        size: width and height in pixels.
        film: filter and lens.
        depths: longest path in segments, and from which segment on paths are ended at random.
        looks: roughness, and albedo of a surface without diffuse reflection, of each shape, by id.
        layers: how many surfaces with an opacity below a half features look through.
    """

    # Radiance from which on a sample is an error of rounding.
    largest = math.inf
    # Albedo of lamps, if it is not that of their material.
    lamps: float | None = None
    # Whether color is black where nothing is hit.
    void = False
    # Whether all rays go through pixel centres, and a pinhole.
    exact = False

    def __init__(
        self,
        stage: Stage,
        cameras: Sequence[Camera],
        size: tuple[int, int],
        film: Film,
        depths: tuple[int, int],
        *,
        looks: Mapping[str, Sequence[float]] | None = None,
        layers: int = 0,
    ) -> None:
        self._stage, self._cameras, self.size, self.film, self.name = stage, cameras, size, film, stage.name
        self._mi, self._dr, self._scalar, self._layers = stage.mitsuba, stage.drjit, stage.scalar, layers
        self._path = self._mi.load_dict({"type": "path", "max_depth": depths[0], "rr_depth": depths[1]})
        self._table, self._index = self._shapes(looks)
        self._offsets = self._float_table(offsets(film.filter))

    def trace(
        self,
        frame: int,
        spp: int,
        seed: Sequence[int],
        *,
        color: bool = True,
        features: bool = True,
        exact: bool = False,
        stratified: bool = False,
        even: bool = False,
    ) -> Samples:
        """Samples of a frame.

        Args:
            frame: number of the frame.
            spp: samples a pixel.
            seed: another one gives independent noise.
            color: whether radiance is wanted; else it is 0.
            features: whether the other channels are wanted.
            exact: whether all rays go through the pixel's centre, and a pinhole, whatever the film.
            stratified: stratify the samples of each pixel (correlated multi-jittered sampling) instead of sampling
                independently. The expectation is the same, and the error usually smaller.
            even: let samples lie evenly in the pixel, to be weighed by :meth:`pixels`; else the filter's weight is in
                their places.
        """
        self._stage.place(frame)
        width, height = self.size
        now, before = (self._lens(self._cameras[number]) for number in (frame, max(frame - 1, 0)))
        shot = _Shot(now, before, self._movements(frame), spp, color, features, exact or self.exact, stratified, even)
        parts = []
        rows = height if self._scalar else max(1, min(height, WAVEFRONT // (width * spp)))
        for top in range(0, height, rows):
            count = min(rows, height - top)
            # Hash the seed: with a sum of seed, frame and pass, two frames could have the same noise.
            state = int(np.random.SeedSequence((*seed, top)).generate_state(1)[0])
            parts.append(self._rows(shot, state, top, count))
        table = np.concatenate(parts).reshape(height * width, spp, -1)
        # A single sample of 0/0 would spoil a whole reference pixel.
        largest = table[..., COLOR].max(-1)
        table[~(largest < self.largest) | ~np.isfinite(table[..., COLOR]).all(-1), COLOR] = 0
        np.nan_to_num(table, copy=False, posinf=0, neginf=0)
        return Samples(table[..., :-2], np.moveaxis(table[..., -2:], -1, 0)) if even else Samples(table, None)

    def pixels(self, samples: Samples) -> Array:
        """``(H*W, C)`` pixels of samples."""
        if samples.places is not None:
            x, y = samples.places
            return splat(self.film.filter, samples.values, x, y, self.size)
        return np.asarray(samples.values.mean(1, dtype=np.float64))

    def radiance(self, frame: int, spp: int, seed: Sequence[int], *, stratified: bool = False) -> Array:
        """``(H*W, 3)`` means of the color of samples; see :meth:`trace`."""
        return self.pixels(self.trace(frame, spp, seed, features=self.void, stratified=stratified))[:, COLOR]

    def _rows(self, shot: _Shot, state: int, top: int, rows: int) -> NDArray[np.float32]:
        """Channels, and places if they are to be weighed, ``(rows * W * spp, C)``."""
        mi, dr, width, spp = self._mi, self._dr, self.size[0], shot.spp
        count = rows * width * spp
        kind = {"type": "multijitter", "sample_count": spp} if shot.stratified else {"type": "independent"}
        sampler = mi.load_dict(kind)
        if self._scalar:
            sampler.seed(state, 1)
            found, ray, inside = [], None, [0.5, 0.5]
            for number in range(count):
                if shot.stratified and number % spp == 0:
                    # The strata are those of one pixel.
                    sampler.seed((state + number) % 2**32, 1)
                if not (shot.exact and number % spp):
                    ray, inside = self._ray(shot, sampler, number // spp % width, number // spp // width + top)
                found.append(self._sample(shot, sampler, ray, inside))
                sampler.advance()
            return np.array(found, np.float32)
        if shot.stratified:
            sampler.set_samples_per_wavefront(spp)
        sampler.seed(dr.opaque(mi.UInt32, state), count)
        pixel = dr.arange(mi.UInt32, count) // dr.opaque(mi.UInt32, spp)
        column, row = pixel % dr.opaque(mi.UInt32, width), pixel // dr.opaque(mi.UInt32, width)
        row += dr.opaque(mi.UInt32, top)
        sample = self._sample(shot, sampler, *self._ray(shot, sampler, column, row))
        dr.eval([value for value in sample if not isinstance(value, int | float)])
        return np.stack([np.broadcast_to(np.array(value, dtype=np.float32), count) for value in sample], -1)

    def _ray(self, shot: _Shot, sampler: Any, column: Any, row: Any) -> tuple[Any, list[Any]]:
        """The ray of a sample, and its place in the pixel."""
        mi, dr, (width, height) = self._mi, self._dr, self.size
        x, y = mi.Float(column) + 0.5, mi.Float(row) + 0.5
        inside = [0.5, 0.5]
        lens = None
        if not shot.exact:
            place, lens = sampler.next_2d(), sampler.next_2d()
            inside = [place.x, place.y] if shot.even else [self._shift(u) + 0.5 for u in place]
            x, y = mi.Float(column) + inside[0], mi.Float(row) + inside[1]
        camera = shot.camera
        left, up, forward, origin, k = camera[:3], camera[3:6], camera[6:9], camera[9:12], camera[12]
        across, down = -(2 * x / width - 1) * k, -(2 * y / height - 1) * (k * (height / width))
        way = [left[i] * across + up[i] * down + forward[i] for i in range(3)]
        start = list(origin)
        if lens is not None and self.film.aperture > 0:
            disk = mi.warp.square_to_uniform_disk_concentric(lens) * self.film.aperture
            start = [origin[i] + left[i] * disk.x + up[i] * disk.y for i in range(3)]
            way = [origin[i] + way[i] * self.film.focus - start[i] for i in range(3)]
        return mi.RayDifferential3f(mi.Ray3f(mi.Point3f(*start), dr.normalize(mi.Vector3f(*way)))), inside

    def _sample(self, shot: _Shot, sampler: Any, ray: Any, inside: list[Any]) -> list[Any]:
        """The channels of a sample, and its place in the pixel if it is to be weighed."""
        color: list[Any] = [0.0] * _CHANNELS_OF_COLOR
        if shot.color:
            color = list(self._path.sample(self._stage.scene, sampler, ray)[0])
        features = self._features(ray, shot) if shot.features else []
        if features and shot.color and self.void:
            color = [channel * features[HIT.start - _CHANNELS_OF_COLOR] for channel in color]
        return [*color, *features, *(inside if shot.even else [])]

    def _features(self, ray: Any, shot: _Shot) -> list[Any]:
        mi, dr, scene = self._mi, self._dr, self._stage.scene
        hit = scene.ray_intersect(ray)
        for _ in range(self._layers):
            if self._scalar and not hit.is_valid():
                break
            clear = hit.bsdf(ray).eval_null_transmission(hit, hit.is_valid())
            # Opacity below a half, on average over RGB.
            through = hit.is_valid() & (sum(clear) > 1.5)
            hit = dr.select(through, scene.ray_intersect(hit.spawn_ray(ray.d), through), hit)
        valid = hit.is_valid()
        # A scalar ray without a hit has no BSDF.
        if self._scalar and not valid:
            return [0.0] * (REST - _CHANNELS_OF_COLOR) + self._rest(ray, hit, False, shot)
        normal = hit.sh_frame.n
        normal = dr.select(valid, dr.select(dr.dot(normal, ray.d) > 0, -normal, normal), mi.Normal3f(0))
        bsdf = hit.bsdf(ray)
        diffuse = valid & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse)
        albedo = dr.select(diffuse, bsdf.eval_diffuse_reflectance(hit, diffuse), self._glossy(hit, bsdf, diffuse))
        albedo = dr.select(dr.all(dr.isfinite(albedo)), albedo, mi.Color3f(0))
        if self.lamps is not None:
            albedo = dr.select(valid & (hit.shape.is_emitter()), mi.Color3f(self.lamps), albedo)
        albedo = dr.select(valid, albedo, mi.Color3f(0))
        forward, origin = mi.Vector3f(*shot.camera[6:9]), mi.Point3f(*shot.camera[9:12])
        depth = dr.select(valid, dr.dot(hit.p - origin, forward), 0)
        rest = self._rest(ray, hit, valid, shot)
        return [*albedo, *normal, dr.select(valid, mi.Float(1), mi.Float(0)), depth, *rest]

    def _glossy(self, hit: Any, bsdf: Any, diffuse: Any) -> Any:
        """Albedo of surfaces without diffuse reflection."""
        raise NotImplementedError

    def _rest(self, ray: Any, hit: Any, valid: Any, shot: _Shot) -> list[Any]:
        """The channels after the depth."""
        raise NotImplementedError

    def _earlier(self, hit: Any, shot: _Shot) -> Any:
        """Where a point that is hit was in the previous frame."""
        if shot.moved is None:
            return hit.p
        mi, index = self._mi, self._row(hit)[4]
        start = mi.UInt32(self._dr.maximum(index, 0)) * 12
        m = [self._at(shot.moved, start + k) for k in range(12)]
        x, y, z = hit.p.x, hit.p.y, hit.p.z
        turned = mi.Point3f(*(m[k] * x + m[k + 1] * y + m[k + 2] * z + m[k + 3] for k in (0, 4, 8)))
        return self._dr.select(index >= 0, turned, hit.p)

    def _shift(self, u: Any) -> Any:
        """The place of a sample by the filter, from the pixel's centre."""
        last = len(self._offsets) - 1
        position = u * last
        low = self._dr.minimum(self._mi.UInt32(position), last - 1)
        first, second = (self._at(self._offsets, low + k) for k in range(2))
        return first + (second - first) * (position - self._mi.Float(low))

    def _lens(self, camera: Camera) -> list[Any]:
        """Axes, origin and half the width at distance 1, as values that are not part of the program."""
        k = math.tan(math.radians(camera.fov_x) / 2)
        numbers = [*camera.to_world[:3].T.ravel().tolist(), k]
        return numbers if self._scalar else [self._dr.opaque(self._mi.Float, number) for number in numbers]

    def _movements(self, frame: int) -> Any:
        """For each moving shape its transform to the previous frame; ``None`` where nothing moves."""
        moves, movers = self._stage.moves, self._stage.movers
        if not movers:
            return None
        rows = [to_previous(moves[name], frame)[:3] for name in movers]
        return self._float_table(np.concatenate([*rows, np.zeros((3, 4))]).ravel())

    def _shapes(self, looks: Mapping[str, Sequence[float]] | None) -> tuple[Any, dict[str, int]]:
        """Look and number of each shape, as a table, and its row by id."""
        shapes = self._stage.scene.shapes() if looks is not None or self._stage.movers else []
        places = {
            shape.id(): number if self._scalar else self._registered(shape) for number, shape in enumerate(shapes)
        }
        table = np.tile(_STILL, (max(places.values(), default=0) + 1, 1))
        movers = {name: number for number, name in enumerate(self._stage.movers)}
        for name, row in places.items():
            table[row] = (*(looks or {}).get(name, _STILL[:4]), movers.get(name, -1))
        return self._float_table(table.ravel()), places

    def _registered(self, shape: Any) -> int:
        """The number by which compiled programs know a shape."""
        return int(np.array(self._dr.reinterpret_array(self._mi.UInt32, self._mi.ShapePtr(shape)))[0])

    def _row(self, hit: Any) -> list[Any]:
        mi, dr = self._mi, self._dr
        if self._scalar:
            shape = hit.instance or hit.shape
            row: Any = self._index.get(shape.id(), 0) if shape else 0
        else:
            whole = dr.reinterpret_array(mi.UInt32, hit.instance)
            row = dr.select(whole > 0, whole, dr.reinterpret_array(mi.UInt32, hit.shape))
        return [self._at(self._table, row * _COLUMNS + k, hit.is_valid()) for k in range(_COLUMNS)]

    def _at(self, table: Any, place: Any, active: Any = True) -> Any:
        """A number of a table."""
        return float(table[place]) if self._scalar else self._dr.gather(self._mi.Float, table, place, active)

    def _float_table(self, values: Array) -> Any:
        return values if self._scalar else self._mi.Float(np.ascontiguousarray(values, dtype=np.float32))
