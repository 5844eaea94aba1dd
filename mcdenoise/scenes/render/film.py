"""Rendering as Mitsuba's own renderer does: jittered samples through a pixel filter and a lens, with features.

This gives the result of Mitsuba's `aov` around `path` on an `hdrfilm`: the features of a pixel are means over its
samples, anti-aliased and, behind a lens or at edges, as noisy as the color.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mcdenoise.data.camera_path import Array, Camera
from mcdenoise.errors import InputError
from mcdenoise.scenes.render.tracer import Tracer

FILTERS = ("box", "gaussian", "tent", "mitchell")
# Number of samples in one pass over the image, limited by a laptop's memory.
_SAMPLES = 2**23
# Integrator `aov` around an integrator that returns the color twice, the second time with alpha.
_AOVS = "albedo:albedo,normal:sh_normal,position:position,distance:depth"
_ALBEDO, _NORMAL, _POSITION, _DISTANCE = slice(4, 7), slice(7, 10), slice(10, 13), 13
_WIDTHS = {"albedo": 3, "normal": 3, "position": 3, "previous_position": 3}


@dataclass(frozen=True)
class Film:
    """Distribution of the samples of a pixel.

    Args:
        filter: one of ``FILTERS``, with Mitsuba's widths: a box of one pixel, a Gaussian of deviation 0.5, a tent of
            radius 1, Mitchell and Netravali's with both parameters 1/3.
        aperture: radius of the lens, scene units; 0 is a pinhole.
        focus: distance along the viewing axis at which a lens is sharp, scene units.

    Raises:
        InputError: the filter is unknown, or a number is invalid.
    """

    filter: str = "box"
    aperture: float = 0.0
    focus: float = 1.0

    def __post_init__(self) -> None:
        if self.filter not in FILTERS:
            raise InputError(f"pixel filter: expected one of {', '.join(FILTERS)}, found '{self.filter}'")
        if not 0 <= self.aperture < math.inf:
            raise InputError(f"aperture: expected a radius of at least 0, found {self.aperture:g}")
        if not 0 < self.focus < math.inf:
            raise InputError(f"focus: expected a distance above 0, found {self.focus:g}")


class FilmRenderer:
    """Renders images of a scene on a film.

    Args:
        tracer: tracer of the scene.
        film: filter and lens.
        size: width and height in pixels.
        reach: distance of the background in scene units.
    """

    def __init__(self, tracer: Tracer, film: Film, size: tuple[int, int], reach: float) -> None:
        self._tracer, self._film, self._size = tracer, film, size
        mi = tracer.mitsuba
        with_features = mi.load_dict({"type": "aov", "aovs": _AOVS, "image": tracer.path})
        self._features = _integrator(tracer, with_features, reach)
        self._color = _integrator(tracer, None, reach)

    def paths_per_pass(self) -> int:
        """The best number of samples per pixel for one call."""
        return max(1, _SAMPLES // (self._size[0] * self._size[1]))

    def radiance(self, camera: Camera, paths: int, seed: Sequence[int], stratified: bool) -> Array:
        """Mean radiance ``(H*W, 3)`` of samples; some filters give negative values.

        Args:
            camera: the camera.
            paths: samples per pixel.
            seed: noise seed.
            stratified: whether the samples of a pixel are stratified.
        """
        return self._render(self._color, camera, "multijitter" if stratified else "independent", paths, seed)

    def frame(self, camera: Camera, before: dict[str, Array], paths: int, seed: Sequence[int]) -> dict[str, Array]:
        """Color and features of the same independent samples, by buffer names, ``(H*W, C)``.

        Normals are flipped towards the viewer for each sample, and their mean is not normalised; albedo is clamped to
        [0, 1] (Mitsuba's for rough metals is unbounded); the background has the distance ``reach``, and neither normal
        nor albedo.

        Args:
            camera: the camera.
            before: for each moving object of the tracer, the ``(4, 4)`` transform of its points to the previous frame.
            paths: samples per pixel.
            seed: noise seed.
        """
        self._features.set_moves(before)
        table = self._render(self._features, camera, "independent", paths, seed)
        found = {"color": np.maximum(table[:, :3], 0)}
        start = 3
        for name, width in _WIDTHS.items():
            if start < table.shape[1]:
                found[name] = table[:, start : start + width]
            start += width
        found["albedo"] = np.clip(found["albedo"], 0, 1)
        # A filter with negative lobes may exceed the range of its input.
        length = np.linalg.norm(found["normal"], axis=1, keepdims=True)
        found["normal"] = found["normal"] / np.maximum(length, 1)
        forward = camera.to_world[:3, 2]
        depth = (found["position"] - camera.to_world[:3, 3]) @ forward
        found["depth"] = np.maximum(depth, 0)
        return found

    def _render(self, integrator: Any, camera: Camera, sampler: str, paths: int, seed: Sequence[int]) -> Array:
        mi, (width, height) = self._tracer.mitsuba, self._size
        sensor = {
            "type": "perspective",
            "fov": camera.fov_x,
            "fov_axis": "x",
            "to_world": mi.ScalarTransform4f(camera.to_world),
            "sampler": {"type": sampler, "sample_count": paths},
            "film": {
                "type": "hdrfilm",
                "width": width,
                "height": height,
                "pixel_format": "rgb",
                "component_format": "float32",
                "rfilter": {"type": self._film.filter},
            },
        }
        if self._film.aperture > 0:
            lens = {"aperture_radius": self._film.aperture, "focus_distance": self._film.focus}
            sensor |= {"type": "thinlens", **lens}
        state = int(np.random.SeedSequence(seed).generate_state(1)[0])
        image = mi.render(self._tracer.scene, sensor=mi.load_dict(sensor), integrator=integrator, spp=paths, seed=state)
        table = np.array(image, dtype=np.float64).reshape(width * height, -1)
        # A pixel whose filter weights cancel has no mean.
        return np.where(np.isfinite(table), table, 0)


def _integrator(tracer: Tracer, with_features: Any, reach: float) -> Any:
    """The path integrator in Python, with 0/0 treated as black, and optionally with features.

    The class is defined in a function because each variant of Mitsuba has its own base class.
    """
    mi, dr = tracer.mitsuba, importlib.import_module("drjit")

    class Integrator(mi.SamplingIntegrator):  # type: ignore[misc, name-defined]
        """Color and, from the samples of `aov`, albedo, normal, position and previous position."""

        def __init__(self) -> None:
            super().__init__(mi.Properties())
            self._before: list[tuple[Any, Any]] = []

        def set_moves(self, before: dict[str, Array]) -> None:
            rows = {name: [[dr.opaque(mi.Float, float(x)) for x in row] for row in m] for name, m in before.items()}
            self._before = [(tracer.moving[name], matrix) for name, matrix in rows.items()]

        def aov_names(self) -> list[str]:
            if with_features is None:
                return []
            names = [*_WIDTHS][: None if tracer.movers else -1]
            return [f"{name}.{axis}" for name in names for axis in "XYZ"]

        def sample(
            self, scene: Any, sampler: Any, ray: Any, medium: Any = None, active: Any = True
        ) -> tuple[Any, Any, list[Any]]:
            inner = tracer.path if with_features is None else with_features
            radiance, valid, found = inner.sample(scene, sampler, ray, medium, active)
            radiance = dr.select(dr.all(dr.isfinite(radiance)), radiance, mi.Color3f(0))
            if with_features is None:
                return radiance, valid, []
            albedo, normal = mi.Color3f(*found[_ALBEDO]), mi.Normal3f(*found[_NORMAL])
            position, distance = mi.Point3f(*found[_POSITION]), mi.Float(found[_DISTANCE])
            # The albedo of a lamp's surface, or at a grazing angle, may be 0/0.
            albedo = dr.select(dr.all(dr.isfinite(albedo)), dr.maximum(albedo, 0), mi.Color3f(0))
            normal = dr.select(dr.dot(normal, ray.d) > 0, -normal, normal)
            hit = distance > 0
            background = ray.o + dr.opaque(mi.Float, reach) * ray.d
            position = dr.select(hit, position, background)
            values = [*albedo, *normal, *position]
            if tracer.movers:
                values += list(self._earlier(scene, ray, position))
            return radiance, valid, values

        def _earlier(self, scene: Any, ray: Any, position: Any) -> Any:
            surface = scene.ray_intersect(ray)
            earlier = mi.Point3f(position)
            for shape, matrix in self._before:
                moved = mi.Point3f(
                    *(m[0] * position.x + m[1] * position.y + m[2] * position.z + m[3] for m in matrix[:3])
                )
                earlier = dr.select(
                    surface.is_valid() & ((surface.shape == shape) | (surface.instance == shape)), moved, earlier
                )
            return earlier

    return Integrator()
