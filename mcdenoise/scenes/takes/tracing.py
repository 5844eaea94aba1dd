"""Tracing the frames of a take with Mitsuba: one program for color and features of the same samples."""

from __future__ import annotations

import importlib
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcdenoise.data.camera_path import Array, Camera
from mcdenoise.scenes.render.tracer import Tracer
from mcdenoise.scenes.takes.draw import Take
from mcdenoise.scenes.takes.filters import offsets, splat
from mcdenoise.scenes.takes.looks import look_of

MAX_DEPTH, _RR_DEPTH = 8, 3
# Samples of each half of a reference: 11 x 12 strata.
HALF = 132
_CLEAN, _PROBE = 16, 8
_WAVEFRONT = 2**22
# No light of a scene is as bright by far: such a sample is an error of rounding, and one would spoil a reference.
_LARGEST = 1e8
_NULLS = 3
# Channels of a sample: color 3, albedo 3, normal 3, hit, depth, motion 2, roughness.
_COLOR, _ALBEDO, _NORMAL, _HIT, _DEPTH, _MOTION, _ROUGHNESS = 3, 6, 9, 9, 10, 11, 13
_CHANNELS = 14
_COLUMNS = 5

Samples = NDArray[np.float32]


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


class TakeTracer:
    """A take's scene, ready to be traced.

    Args:
        take: what to trace.
        variant: a variant of Mitsuba.
        threads: of Dr.Jit; 0 for all processors.
        half: samples a pixel of each half of a reference.

    Raises:
        InputError: see :class:`mcdenoise.scenes.render.tracer.Tracer`.
    """

    def __init__(self, take: Take, variant: str, threads: int = 0, half: int = HALF) -> None:
        self.take, self.half = take, half
        # Reading the scene with one thread may wait for ever; see Tracer.
        self._tracer = Tracer(take.scene, variant, MAX_DEPTH, take.moves, merge=False)
        self._mi, self._dr = self._tracer.mitsuba, importlib.import_module("drjit")
        if threads:
            self._dr.set_thread_count(threads)
        self.name = self._tracer.name
        self._scalar = variant.startswith("scalar")
        self._path = self._mi.load_dict({"type": "path", "max_depth": MAX_DEPTH, "rr_depth": _RR_DEPTH})
        self._masked = any(isinstance(e, Mapping) and e.get("type") == "mask" for e in take.scene.values())
        self._table, self._index = self._looks()
        self._offsets = self._float_table(offsets(take.filter))

    def place(self, frame: int) -> None:
        """Put what moves to its place in a frame."""
        self._tracer.place(frame)

    def noisy(self, frame: int) -> dict[str, Array]:
        """Color and features of a frame: ``(C, H, W)`` by name."""
        take = self.take
        samples = self._trace(frame, take.spp, (take.number, frame, 0), color=True)
        pixels = self._means(samples)
        if take.features == "exact" and (take.filter != "centre" or take.spp > 1):
            pixels[:, 3:] = self._means(self._trace(frame, 1, (0,), color=False, exact=True), plain=True)[:, 3:]
        elif take.features == "clean":
            clean = self._means(self._trace(frame, _CLEAN, (take.number, frame, 3), color=False))
            pixels[:, 3:] = clean[:, 3:]
        hit = pixels[:, _HIT : _HIT + 1]
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.where(hit > 0, pixels[:, _DEPTH : _DEPTH + 1] / hit, np.inf)
        found = {
            "color": pixels[:, :_COLOR],
            "albedo": np.clip(pixels[:, _COLOR:_ALBEDO], 0, 1),
            "normal": pixels[:, _ALBEDO:_NORMAL],
            "depth": depth,
            "motion": pixels[:, _MOTION:_ROUGHNESS],
            "alpha": np.clip(hit, 0, 1),
            "roughness": np.clip(pixels[:, _ROUGHNESS:], 0, 1),
        }
        width, height = take.size
        return {name: image.T.reshape(-1, height, width) for name, image in found.items()}

    def halves(self, frame: int) -> tuple[Array, Array]:
        """Two independent halves of the reference of a frame, ``(3, H, W)`` each."""
        width, height = self.take.size
        seeds = ((self.take.number, frame, part) for part in (1, 2))
        first, second = (self._mean_color(frame, seed).T.reshape(3, height, width) for seed in seeds)
        return first, second

    def noise(self, frame: int) -> float:
        """SMAPE between two means of a few samples: 0 without noise, 1 where few samples find light at all."""
        seeds = ((self.take.number, frame, part) for part in (4, 5))
        both = [self._trace(frame, _PROBE, seed, color=True)[0].mean(1) for seed in seeds]
        first, second = (samples[:, :3].mean(-1) for samples in both)
        total, seen = first + second, both[0][:, _HIT] > 0
        # What is seen and has no light in any sample is as noisy as can be.
        lit = total > 1e-3 * total.mean()
        noise = np.where(lit, np.abs(first - second) / np.maximum(total, 1e-30), 1)
        return float(noise[lit | seen].mean())

    def release(self) -> None:
        """Give the memory back that Dr.Jit keeps for the next scene."""
        self._dr.flush_malloc_cache()

    def _mean_color(self, frame: int, seed: tuple[int, ...]) -> Array:
        samples = self._trace(frame, self.half, seed, color=True, features=self.take.void, stratified=True)
        return np.asarray(samples[0][..., :3].mean(1, dtype=np.float64))

    def _means(self, samples: tuple[Samples, Samples, Samples], plain: bool = False) -> Array:
        """Pixels of samples; features of what was not hit do not count for the depth."""
        values, x, y = samples
        if self.take.splat and not plain:
            return splat(self.take.filter, values, x, y, self.take.size)
        return np.asarray(values.mean(1, dtype=np.float64))

    def _trace(
        self,
        frame: int,
        spp: int,
        seed: Sequence[int],
        *,
        color: bool,
        features: bool = True,
        exact: bool = False,
        stratified: bool = False,
    ) -> tuple[Samples, Samples, Samples]:
        """Samples ``(H*W, spp, 14)``, and their places in the pixels."""
        take, (width, height) = self.take, self.take.size
        now, before = (self._lens(take.cameras[number]) for number in (frame, max(frame - 1, 0)))
        # Samples that are weighed afterwards lie evenly in the pixel.
        even = take.splat and not stratified
        shot = _Shot(now, before, self._movements(frame), spp, color, features, exact, stratified, even)
        values = np.zeros((height, width * spp, _CHANNELS), np.float32)
        places = np.full((2, height, width * spp), 0.5, np.float32)
        rows = height if self._scalar else max(1, min(height, _WAVEFRONT // (width * spp)))
        for top in range(0, height, rows):
            count = min(rows, height - top)
            part = slice(top, top + count)
            state = int(np.random.SeedSequence((*seed, top)).generate_state(1)[0])
            table = self._rows(shot, state, top, count).reshape(-1, count, width * spp)
            values[part], places[:, part] = np.moveaxis(table[:_CHANNELS], 0, -1), table[_CHANNELS:]
        flat = values.reshape(height * width, spp, _CHANNELS)
        return flat, places[0].reshape(height * width, spp), places[1].reshape(height * width, spp)

    def _rows(self, shot: _Shot, state: int, top: int, rows: int) -> NDArray[np.float32]:
        """Channels and places ``(16, rows * W * spp)``."""
        mi, dr, width, spp = self._mi, self._dr, self.take.size[0], shot.spp
        count = rows * width * spp
        kind = {"type": "multijitter", "sample_count": spp} if shot.stratified else {"type": "independent"}
        sampler = mi.load_dict(kind)
        if self._scalar:
            sampler.seed(state, 1)
            found = []
            for number in range(count):
                column, row = number // spp % width, number // spp // width + top
                if shot.stratified and number % spp == 0:
                    # The strata are those of one pixel.
                    sampler.seed((state + number) % 2**32, 1)
                found.append([float(value) for value in self._sample(shot, sampler, column, row)])
                sampler.advance()
            return np.nan_to_num(np.array(found, np.float32).T, posinf=0, neginf=0)
        if shot.stratified:
            sampler.set_samples_per_wavefront(spp)
        sampler.seed(dr.opaque(mi.UInt32, state), count)
        pixel = dr.arange(mi.UInt32, count) // dr.opaque(mi.UInt32, spp)
        column, row = pixel % dr.opaque(mi.UInt32, width), pixel // dr.opaque(mi.UInt32, width)
        row += dr.opaque(mi.UInt32, top)
        sample = self._sample(shot, sampler, column, row)
        dr.eval([value for value in sample if not isinstance(value, int | float)])
        table = np.stack([np.broadcast_to(np.array(value, dtype=np.float32), count) for value in sample])
        return np.nan_to_num(table, posinf=0, neginf=0)

    def _sample(self, shot: _Shot, sampler: Any, column: Any, row: Any) -> list[Any]:
        """The 14 channels of a sample, and its place in the pixel."""
        mi, dr, (width, height) = self._mi, self._dr, self.take.size
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
        if lens is not None and self.take.aperture > 0:
            disk = mi.warp.square_to_uniform_disk_concentric(lens) * self.take.aperture
            start = [origin[i] + left[i] * disk.x + up[i] * disk.y for i in range(3)]
            way = [origin[i] + way[i] * self.take.focus - start[i] for i in range(3)]
        ray = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(*start), dr.normalize(mi.Vector3f(*way))))
        channels: list[Any] = [0.0] * _CHANNELS
        if shot.color:
            radiance = self._path.sample(self._tracer.scene, sampler, ray)[0]
            sane = dr.all(dr.isfinite(radiance)) & (dr.max(radiance) < _LARGEST)
            channels[:3] = list(dr.select(sane, radiance, mi.Color3f(0)))
        if shot.features:
            channels[3:] = self._features(ray, shot)
            if shot.color and self.take.void:
                channels[:3] = [channel * channels[_HIT] for channel in channels[:3]]
        return [*channels, *inside]

    def _features(self, ray: Any, shot: _Shot) -> list[Any]:
        mi, dr = self._mi, self._dr
        scene = self._tracer.scene
        hit = scene.ray_intersect(ray)
        for _ in range(_NULLS if self._masked else 0):
            if self._scalar and not hit.is_valid():
                break
            clear = hit.bsdf(ray).eval_null_transmission(hit, hit.is_valid())
            through = hit.is_valid() & (sum(clear) > 1.5)
            hit = dr.select(through, scene.ray_intersect(hit.spawn_ray(ray.d), through), hit)
        valid = hit.is_valid()
        if self._scalar and not valid:
            return [0.0] * 7 + [0.0, *self._motion(ray, hit, False, shot), 0.0]
        normal = hit.sh_frame.n
        normal = dr.select(valid, dr.select(dr.dot(normal, ray.d) > 0, -normal, normal), mi.Normal3f(0))
        bsdf = hit.bsdf(ray)
        diffuse = valid & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse)
        look = self._row(hit)
        albedo = dr.select(diffuse, bsdf.eval_diffuse_reflectance(hit, diffuse), mi.Color3f(*look[1:4]))
        albedo = dr.select(dr.all(dr.isfinite(albedo)), albedo, mi.Color3f(0))
        lamp = valid & (hit.shape.is_emitter())
        albedo = dr.select(lamp, mi.Color3f(1.0 if self.take.white_lamps else 0.0), albedo)
        albedo = dr.select(valid, albedo, mi.Color3f(0))
        forward, origin = mi.Vector3f(*shot.camera[6:9]), mi.Point3f(*shot.camera[9:12])
        depth = dr.select(valid, dr.dot(hit.p - origin, forward), 0)
        motion = self._motion(ray, hit, valid, shot)
        roughness = dr.select(valid, look[0], 0)
        return [*albedo, *normal, dr.select(valid, mi.Float(1), mi.Float(0)), depth, *motion, roughness]

    def _motion(self, ray: Any, hit: Any, valid: Any, shot: _Shot) -> Any:
        """Way to where the point was in the previous frame, in pixels; what is not hit turns with the camera."""
        mi, dr = self._mi, self._dr
        if self._scalar and not valid:
            now = then = mi.Vector3f(ray.d)
        else:
            earlier = hit.p
            if shot.moved is not None:
                index = self._row(hit)[4]
                rows = self._moved_rows(shot.moved, index)
                x, y, z = hit.p.x, hit.p.y, hit.p.z
                turned = mi.Point3f(*(m[0] * x + m[1] * y + m[2] * z + m[3] for m in rows))
                earlier = dr.select(index >= 0, turned, earlier)
            now = dr.select(valid, hit.p - mi.Point3f(*shot.camera[9:12]), mi.Vector3f(ray.d))
            then = dr.select(valid, earlier - mi.Point3f(*shot.before[9:12]), mi.Vector3f(ray.d))
        start, end = self._raster(now, shot.camera), self._raster(then, shot.before)
        return [end[0] - start[0], end[1] - start[1]]

    def _raster(self, way: Any, camera: Sequence[Any]) -> tuple[Any, Any]:
        dr, (width, height) = self._dr, self.take.size
        left, up, forward = (sum(way[i] * camera[3 * k + i] for i in range(3)) for k in range(3))
        # A point behind the camera is far outside of the image.
        scale = width / 2 / (dr.maximum(forward, 1e-4) * camera[12])
        return width / 2 - left * scale, height / 2 - up * scale

    def _shift(self, u: Any) -> Any:
        """The place of a sample by the filter, from the pixel's centre."""
        dr, last = self._dr, len(self._offsets) - 1
        position = u * last
        if self._scalar:
            low = min(int(position), last - 1)
            return float(self._offsets[low] + (self._offsets[low + 1] - self._offsets[low]) * (position - low))
        mi = self._mi
        low = dr.minimum(mi.UInt32(position), last - 1)
        first, second = (dr.gather(mi.Float, self._offsets, low + k) for k in range(2))
        return first + (second - first) * (position - mi.Float(low))

    def _lens(self, camera: Camera) -> list[Any]:
        """Axes, origin and half the width at distance 1, as values that are not part of the program."""
        k = math.tan(math.radians(camera.fov_x) / 2)
        numbers = [*camera.to_world[:3].T.ravel().tolist(), k]
        return numbers if self._scalar else [self._dr.opaque(self._mi.Float, number) for number in numbers]

    def _movements(self, frame: int) -> Any:
        """For each moving shape its transform to the previous frame; ``None`` where nothing moves."""
        moves, movers = self.take.moves, self._tracer.movers
        if not movers:
            return None
        earlier = max(frame - 1, 0)
        rows = [(moves[name][earlier] @ np.linalg.inv(moves[name][frame]))[:3] for name in movers]
        return self._float_table(np.concatenate([*rows, np.zeros((3, 4))]).ravel())

    def _moved_rows(self, table: Any, index: Any) -> list[list[Any]]:
        if self._scalar:
            start = 12 * max(int(index), 0)
            return [[float(table[start + 4 * i + j]) for j in range(4)] for i in range(3)]
        mi, dr = self._mi, self._dr
        start = mi.UInt32(dr.maximum(index, 0)) * 12
        return [[dr.gather(mi.Float, table, start + (4 * i + j)) for j in range(4)] for i in range(3)]

    def _looks(self) -> tuple[Any, dict[str, int]]:
        """Roughness, albedo without diffuse reflection, and number among the moving shapes, of each shape."""
        take, mi, shapes = self.take, self._mi, self._tracer.scene.shapes()
        materials = {name: look_of(e) for name, e in take.scene.items() if name.startswith("material_")}
        places: dict[str, int] = {}
        for number, shape in enumerate(shapes):
            whole = number if self._scalar else _registered(mi, self._dr, shape)
            places[shape.id()] = whole
        table = np.zeros((max(places.values(), default=0) + 1, _COLUMNS))
        table[:, 4] = -1
        movers = {name: number for number, name in enumerate(self._tracer.movers)}
        for name, row in places.items():
            entry = take.scene.get(name, {})
            look = materials.get(entry.get("bsdf", {}).get("id", "")) if isinstance(entry, Mapping) else None
            if look is not None:
                color = {"black": (0, 0, 0), "white": (1, 1, 1), "color": look.color}[take.glossy]
                table[row, :4] = (look.roughness, *color)
            table[row, 4] = movers.get(name, -1)
        return self._float_table(table.ravel()), places

    def _row(self, hit: Any) -> list[Any]:
        mi, dr = self._mi, self._dr
        if self._scalar:
            start = _COLUMNS * self._index.get(hit.shape.id(), 0)
            return [float(self._table[start + k]) for k in range(_COLUMNS)]
        start = dr.reinterpret_array(mi.UInt32, hit.shape) * _COLUMNS
        return [dr.gather(mi.Float, self._table, start + k, hit.is_valid()) for k in range(_COLUMNS)]

    def _float_table(self, values: Array) -> Any:
        return values if self._scalar else self._mi.Float(np.ascontiguousarray(values, dtype=np.float32))


def _registered(mi: Any, dr: Any, shape: Any) -> int:
    """The number by which compiled programs know a shape."""
    return int(np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape)))[0])
