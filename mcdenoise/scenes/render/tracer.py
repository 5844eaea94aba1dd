"""A small interface to Mitsuba 3: it traces given rays, and returns hits and radiance.

Mitsuba's own renderer always jitters samples inside the pixel. Therefore the rays are generated here and traced by
Mitsuba; :mod:`mcdenoise.scenes.render.film` uses Mitsuba's own renderer. Mitsuba is optional and imported on first use.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mcdenoise.data.camera_path import Array, Camera, PixelRays
from mcdenoise.errors import InputError
from mcdenoise.scenes.render.loading import LLVM, Scene, first_line, import_mitsuba, load_scene

RR_DEPTH = 5
_SEE_THROUGH_LAYERS = 8
_WAVEFRONT = 2**20  # paths traced at once: enough to fill the vector units, small enough for a laptop's memory
_SCALAR_PASS = 8
STRATIFIED_PATHS = 16
_MOST_NAMES = 20


class Hits(NamedTuple):
    """The first hits of N rays.

    Args:
        distance: ``(N,)`` along the ray, ``inf`` without a hit.
        normal: ``(N, 3)`` unit shading normal, flipped towards the ray's origin; 0 without a hit.
        albedo: ``(N, 3)`` in [0, 1].
        mover: ``(N,)`` index of the hit object in :attr:`Tracer.movers`, -1 for static objects.
    """

    distance: Array
    normal: Array
    albedo: Array
    mover: NDArray[np.int64]


class Tracer:
    """Traces given rays through a scene, one by one in the scalar variant, all at once in the others.

    Args:
        scene: see :func:`mcdenoise.scenes.render.render_sequence`.
        variant: one of ``VARIANTS``.
        max_depth: longest path, in segments.
        moves: see :class:`mcdenoise.data.camera_path.CameraPath`.
        merge: whether meshes that do not move may become one.

    ``mitsuba`` is its module, ``scene`` and ``path`` are its scene and integrator, ``moving`` the moving shapes by id,
    and ``movers`` the list of these ids.

    Raises:
        InputError: Mitsuba is missing, the variant does not work here, the scene cannot be loaded, or a moving object
            does not exist.
    """

    def __init__(
        self,
        scene: Scene,
        variant: str,
        max_depth: int,
        moves: Mapping[str, Array] | None = None,
        *,
        merge: bool = True,
    ) -> None:
        self.mitsuba = mi = import_mitsuba()
        try:
            mi.set_variant(variant)
        except ImportError as error:
            advice = f"; {LLVM}" if variant.startswith("llvm") else ""
            raise InputError(f"Mitsuba variant '{variant}' does not run here: {first_line(error)}{advice}") from error
        self._dr = importlib.import_module("drjit")
        # On a single core, parallel loading of a scene whose parts refer to each other deadlocks.
        self._dr.set_thread_count(max(2, self._dr.thread_count()))
        self._scalar = variant.startswith("scalar")
        self.name = f"mitsuba {mi.__version__} ({variant}, drjit {self._dr.__version__}), path integrator"
        # Merged meshes could not move separately.
        self.scene = load_scene(mi, scene, merge=merge and not moves)
        self.path = mi.load_dict({"type": "path", "max_depth": max_depth, "rr_depth": RR_DEPTH})
        self._independent = mi.load_dict({"type": "independent"})
        self._stratified = mi.load_dict({"type": "multijitter", "sample_count": STRATIFIED_PATHS})
        self._context = mi.BSDFContext()
        self._last_rays: tuple[PixelRays, list[Any]] | None = None
        self._moves = dict(moves or {})
        self._parameters: Any = mi.traverse(self.scene) if moves else {}
        shapes = {shape.id(): shape for shape in self.scene.shapes()}
        self._at_rest = {identity: self._placement(identity, shapes) for identity in self._moves}
        self.moving = {identity: shapes[identity] for identity in self._moves if identity in shapes}
        self.movers = list(self.moving)
        self._boxes = {identity: _box(shape) for identity, shape in self.moving.items()}

    def place(self, frame: int) -> None:
        """Put every moving object to its place in a frame.

        Raises:
            InputError: Mitsuba cannot apply the transform to an object.
        """
        for identity, placement in self._at_rest.items():
            matrix = self._moves[identity][frame]
            for key, (kind, value) in placement.items():
                self._parameters[f"{identity}.{key}"] = kind(*_transformed(key, value, matrix))
        if self._at_rest:
            try:
                self._parameters.update()
            except RuntimeError as error:
                raise InputError(f"frame {frame}: Mitsuba cannot move the objects: {first_line(error)}") from error

    def reach(self, cameras: Sequence[Camera]) -> float:
        """A distance from each camera that is behind everything in the scene: the distance of the background."""
        box = self.scene.bbox()
        if not box.valid():
            return 1.0
        corners = [np.array(box.min, dtype=np.float64), np.array(box.max, dtype=np.float64)]
        for identity, moved in self._boxes.items():
            for matrix in self._moves[identity]:
                corners.extend(moved @ matrix[:3, :3].T + matrix[:3, 3])
        low, high = np.min(corners, axis=0), np.max(corners, axis=0)
        diagonal = float(np.linalg.norm(high - low))
        away = [float(np.linalg.norm((low + high) / 2 - camera.to_world[:3, 3])) for camera in cameras]
        # Rounded up, so that it does not depend on the number of frames unless the camera travels far.
        return max(diagonal + away[0], diagonal / 2 + max(away))

    def features(self, rays: PixelRays) -> Hits:
        """The first hits of the rays, ignoring transparent surfaces."""
        if self._scalar:
            found = [self._hit(ray) for ray in self._scalar_rays(rays)]
            table = np.array([(d, *normal, *albedo, mover) for d, normal, albedo, mover in found], dtype=np.float64)
        else:
            distance, normal, albedo, mover = self._hit(self._wavefront(rays, 1))
            columns = (distance, *normal, *albedo, mover)
            self._dr.eval(*columns)  # evaluate all together, because each evaluation traces the rays
            count = len(rays.directions)  # a constant column has one entry
            table = np.stack([np.broadcast_to(np.array(c, dtype=np.float64), count) for c in columns], axis=1)
        # A few BSDFs return an approximate albedo that can exceed 1.
        clean = np.clip(np.nan_to_num(table[:, 4:7]), 0, 1)
        return Hits(table[:, 0], table[:, 1:4], clean, table[:, 7].astype(np.int64))

    def paths_per_pass(self, rays: PixelRays) -> int:
        """The best number of independent paths per ray for one call of :meth:`radiance`."""
        return _SCALAR_PASS if self._scalar else max(1, _WAVEFRONT // len(rays.directions))

    def radiance(self, rays: PixelRays, paths: int, seed: Sequence[int], stratified: bool = False) -> Array:
        """Mean radiance ``(N, 3)`` of independent paths; another seed gives independent noise.

        Args:
            rays: N rays.
            paths: paths per ray; with ``stratified`` it must be ``STRATIFIED_PATHS``.
            seed: noise seed.
            stratified: stratify the paths of each ray (correlated multi-jittered sampling) instead of sampling
                independently. The expectation is the same, and the error usually smaller.
        """
        count = len(rays.directions)
        # Hash the seed: with a sum of seed, frame and pass, two frames could have the same noise.
        state = int(np.random.SeedSequence(seed).generate_state(1)[0])
        sampler = self._stratified if stratified else self._independent
        if self._scalar:
            return self._scalar_radiance(self._scalar_rays(rays), paths, sampler, state, stratified)
        copies = max(n for n in range(1, paths + 1) if paths % n == 0 and (n == 1 or n * count <= _WAVEFRONT))
        # A stratified sampler requires the copies of a ray to be adjacent.
        wavefront = self._wavefront(rays, copies, interleaved=not stratified)
        if stratified:
            sampler.set_samples_per_wavefront(copies)
        sampler.seed(self._dr.opaque(self.mitsuba.UInt32, state), count * copies)
        total = np.zeros((count, 3))
        for _ in range(paths // copies):
            radiance = self.path.sample(self.scene, sampler, wavefront)[0]
            # Evaluate all channels together, because each evaluation traces the paths; and the sampler's state with
            # them, because evaluating it in the next pass would trace these paths again.
            sampler.schedule_state()
            self._dr.eval(radiance)
            samples = _finite(np.stack([np.array(channel) for channel in radiance], axis=1))
            shape = (count, copies, 3) if stratified else (copies, count, 3)
            total += samples.reshape(shape).sum(axis=1 if stratified else 0, dtype=np.float64)
            sampler.advance()
        return total / paths

    def _placement(self, identity: str, shapes: Mapping[str, Any]) -> dict[str, tuple[Any, Array]]:
        """The parameters to change when an object moves, with their types and initial values."""
        things = {emitter.id() for emitter in self.scene.emitters()}.union(shapes)
        kinds = ("to_world", "vertex_positions", "position")
        movable = {
            name: [kind for kind in kinds if f"{name}.{kind}" in self._parameters][:1] for name in sorted(things)
        }
        if not movable.get(identity):
            names = [name for name, keys in movable.items() if keys]
            more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
            raise InputError(
                f"object '{identity}': expected the id of a shape or a light that can move "
                f"({', '.join(names[:_MOST_NAMES])}{more}), found no such thing in the scene"
            )
        keys = movable[identity]
        if keys == ["vertex_positions"] and f"{identity}.vertex_normals" in self._parameters:
            keys.append("vertex_normals")
        placement = {}
        for key in keys:
            value = self._parameters[f"{identity}.{key}"]
            numbers = np.array(value.matrix if key == "to_world" else value, dtype=np.float64)
            placement[key] = (type(value), numbers.reshape(4, 4) if key == "to_world" else numbers.reshape(-1, 3))
        return placement

    def _scalar_rays(self, rays: PixelRays) -> list[Any]:
        # Cached for the next pass, because creating them takes as long as tracing them once.
        if self._last_rays is None or self._last_rays[0] is not rays:
            mi, origin = self.mitsuba, self.mitsuba.Point3f(*rays.origin.tolist())
            ways = rays.directions.tolist()
            made = [mi.RayDifferential3f(mi.Ray3f(origin, mi.Vector3f(*way))) for way in ways]
            self._last_rays = (rays, made)
        return self._last_rays[1]

    def _scalar_radiance(self, rays: list[Any], paths: int, sampler: Any, state: int, stratified: bool) -> Array:
        values: list[float] = []

        def trace(ray: Any) -> None:
            values.extend(self.path.sample(self.scene, sampler, ray)[0])

        if stratified:
            for index, ray in enumerate(rays):
                sampler.seed((state + index) % 2**32, 1)
                for _ in range(paths):
                    trace(ray)
                    sampler.advance()
        else:
            sampler.seed(state, 1)
            for _ in range(paths):
                for ray in rays:
                    trace(ray)
        shape = (len(rays), paths, 3) if stratified else (paths, len(rays), 3)
        samples = _finite(np.array(values, dtype=np.float32).reshape(shape))
        return np.asarray(samples.sum(axis=1 if stratified else 0, dtype=np.float64) / paths)

    def _wavefront(self, rays: PixelRays, copies: int, interleaved: bool = True) -> Any:
        mi = self.mitsuba
        directions = rays.directions.astype(np.float32)
        columns = (np.tile(directions, (copies, 1)) if interleaved else np.repeat(directions, copies, axis=0)).T
        direction = mi.Vector3f(*(mi.Float(_aligned(column)) for column in columns))
        # Opaque to the compiler: constants would become part of the kernel, which is compiled for seconds per frame.
        origin = mi.Point3f(*(self._dr.opaque(mi.Float, value) for value in rays.origin.tolist()))
        return mi.RayDifferential3f(mi.Ray3f(origin, direction))

    def _hit(self, ray: Any) -> tuple[Any, Any, Any, Any]:
        """Distance, normal, albedo and moving object of the first opaque surface, the same in all variants."""
        mi, dr = self.mitsuba, self._dr
        hit = self.scene.ray_intersect(ray)
        for _ in range(_SEE_THROUGH_LAYERS):
            if not dr.any(hit.is_valid()):
                break
            transmission = hit.bsdf(ray).eval_null_transmission(hit, hit.is_valid())
            through = hit.is_valid() & (sum(transmission) > 1.5)  # opacity below a half, on average over RGB
            if not dr.any(through):
                break
            behind = self.scene.ray_intersect(hit.spawn_ray(ray.d), through)
            hit = dr.select(through, behind, hit)
        valid = hit.is_valid()
        black = mi.Color3f(0)
        if not dr.any(valid):  # a scalar ray without a hit has no BSDF
            return dr.select(valid, mi.Float(0), mi.Float(dr.inf)), black, black, mi.Float(-1)
        normal = hit.sh_frame.n
        normal = dr.select(valid, dr.select(dr.dot(normal, ray.d) > 0, -normal, normal), mi.Normal3f(0))
        bsdf = hit.bsdf(ray)
        diffuse = valid & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse)
        # Use select instead of ~diffuse, which is not a logical negation for a Python bool.
        glossy = valid & dr.select(diffuse, False, mi.has_flag(bsdf.flags(), mi.BSDFFlags.GlossyReflection))
        albedo = dr.select(diffuse, bsdf.eval_diffuse_reflectance(hit, diffuse), black)
        if dr.any(glossy):
            albedo = dr.select(glossy, self._directional_albedo(bsdf, hit, glossy), albedo)
        mover = mi.Float(-1)
        for index, shape in enumerate(self.moving.values()):
            found = valid & ((hit.shape == shape) | (hit.instance == shape))
            mover = dr.select(found, mi.Float(index), mover)
        return dr.select(valid, dr.dot(hit.p - ray.o, ray.d), dr.inf), normal, albedo, mover

    def _directional_albedo(self, bsdf: Any, hit: Any, active: Any) -> Any:
        """Directional albedo of a rough metal towards the viewer, by a fixed 4x4 grid of samples, so without noise."""
        mi, dr = self.mitsuba, self._dr
        # Evaluate the inputs first; otherwise each sample would trace the rays again.
        dr.eval(hit, active)
        total = mi.Color3f(0)
        grid = [(i + 0.5) / 4 for i in range(4)]
        for x in grid:
            for y in grid:
                # Evaluate one sample at a time with opaque inputs: one small kernel, used 16 times.
                point = mi.Point2f(dr.opaque(mi.Float, x), dr.opaque(mi.Float, y))
                total += bsdf.sample(self._context, hit, 0.5, point, active)[1]
                dr.eval(total)
        return total / 16


def _aligned(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """A copy at an address divisible by 64: drjit compiles the alignment of borrowed memory into the kernel."""
    room = np.empty(values.nbytes + 64, np.uint8)
    start = -room.ctypes.data % 64
    copy = room[start : start + values.nbytes].view(np.float32)
    copy[:] = values
    return copy


def _finite(samples: NDArray[np.float32]) -> NDArray[np.float32]:
    """Replace NaN samples (0/0) by black, because a single one would spoil a whole reference pixel."""
    return np.where(np.isfinite(samples).all(axis=-1, keepdims=True), samples, np.float32(0))


def _box(shape: Any) -> Array:
    """Corners ``(8, 3)`` of a shape's bounding box."""
    box = shape.bbox()
    ends = np.array([box.min, box.max], dtype=np.float64)
    return np.array([[ends[x, 0], ends[y, 1], ends[z, 2]] for x in (0, 1) for y in (0, 1) for z in (0, 1)])


def _transformed(key: str, value: Array, matrix: Array) -> tuple[Any, ...]:
    """Constructor arguments of a parameter: its initial value with a transform applied."""
    linear, offset = matrix[:3, :3], matrix[:3, 3]
    if key == "to_world":
        return (matrix @ value,)
    if key == "position":
        return tuple((linear @ value[0] + offset).tolist())
    if key == "vertex_normals":
        normals = value @ np.linalg.inv(linear)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return ((normals / np.where(length > 0, length, 1)).astype(np.float32).ravel(),)
    return ((value @ linear.T + offset).astype(np.float32).ravel(),)
