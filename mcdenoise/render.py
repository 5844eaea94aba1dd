"""Mitsuba 3: a scene and a camera path in, a noisy sequence with features and references out, in the BMFR layout.

Everything is sampled at the pixel centre: features, noisy colour and reference, so that the expectation of the colour
is the reference, and dividing by the albedo is consistent. Mitsuba's own renderer always jitters inside the pixel;
therefore the rays are built here, and Mitsuba traces them. Mitsuba is optional and imported on first use.
"""

from __future__ import annotations

import functools
import hashlib
import importlib
import json
import math
import subprocess
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from mcdenoise.buffers import Frame
from mcdenoise.data.bmfr import write_bmfr_frame
from mcdenoise.data.camera_matrices import CameraMatrices, write_camera_matrices
from mcdenoise.data.camera_path import Array, Camera, PixelRays, load_camera_path, pixel_rays, view_projection
from mcdenoise.data.files import write_text
from mcdenoise.errors import InputError

Scene: TypeAlias = str | Path | Mapping[str, Any]

__all__ = ["VARIANTS", "Camera", "Scene", "load_camera_path", "render_sequence", "view_projection"]

VARIANTS = ("scalar_rgb", "llvm_ad_rgb", "cuda_ad_rgb")
_FRAME_FILES = ("color", "albedo", "shading_normal", "world_position", "depth")
_RR_DEPTH = 5
_LARGEST_SIDE = 16384
_SEE_THROUGH_LAYERS = 8
_WAVEFRONT = 2**20  # paths traced at once: enough to fill the vector units, small enough for a laptop's memory


def render_sequence(
    scene: Scene,
    cameras: Sequence[Camera],
    out: Path,
    *,
    size: tuple[int, int] = (640, 360),
    frames: int | None = None,
    spp: int = 1,
    reference_spp: int = 512,
    reference_frames: Collection[int] | None = None,
    seed: int = 0,
    max_depth: int = 8,
    variant: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Render a sequence in the BMFR layout; frames that are already there are kept, so a stopped run can be resumed.

    Args:
        scene: a Mitsuba ``scene.xml``, or a Mitsuba dictionary. In a dictionary, numpy arrays may stand for transforms
            (shape ``(4, 4)``) and for bitmaps (shape ``(H, W, C)``). Its sensors and integrators are not used.
        cameras: one camera per frame.
        out: the folder of the sequence; the files go to ``out/inputs``.
        size: width and height in pixels.
        frames: render the first so many cameras; all by default.
        spp: paths per pixel of the noisy colour.
        reference_spp: paths per pixel of the references.
        reference_frames: numbers of the frames that get a reference; all by default.
        seed: every (seed, frame) has its own noise, and always the same.
        max_depth: longest path, in segments.
        variant: one of ``VARIANTS``; by default the one Mitsuba is already set to, else ``llvm_ad_rgb`` where it works,
            else ``scalar_rgb``.
        progress: called with the finished and the total number of paths per pixel, summed over all frames.

    Returns:
        The folder with the files, ``out/inputs``.

    Raises:
        InputError: Mitsuba is missing, the scene cannot be loaded, a setting is unusable, or ``out`` cannot be written
            or holds a sequence with other settings.
    """
    width, height = size
    cameras = list(cameras)[:frames]
    references = set(range(len(cameras)) if reference_frames is None else reference_frames)
    _check_settings(size, frames, len(cameras), references, spp, reference_spp, seed, max_depth)
    tracer = _Tracer(scene, _choose_variant(variant), max_depth)
    reach = tracer.reach(cameras[0])
    distance = tracer.features(pixel_rays(cameras[0], width, height))[0]
    scale = float(np.median(np.minimum(distance, reach)))
    near, far = 0.01 * scale, 2 * reach
    matrices = np.stack([view_projection(camera, width, height, near, far) for camera in cameras])
    settings: dict[str, Any] = {
        "scene": _scene_name(scene),
        "scene_sha256": _scene_digest(scene),
        "renderer": tracer.name,
        "frames": len(cameras),
        "width": width,
        "height": height,
        "fov_x_degrees": cameras[0].fov_x,
        "near": near,
        "far": far,
        "noisy_spp": spp,
        "reference_spp": {str(number): reference_spp for number in sorted(references)},
        "max_depth": max_depth,
        "rr_depth": _RR_DEPTH,
        "seed": seed,
        **_CONVENTIONS,
        "background": f"no hit: albedo and normal are 0, world_position is {reach:g} units along the ray",
        "position_limit_squared": (0.02 * scale) ** 2,
        "normal_limit_squared": 1.0,
        "pixel_offsets": [[0.5, 0.5]] * len(cameras),
        "camera_matrices": matrices.tolist(),
        "world_to_clip": matrices.transpose(0, 2, 1).tolist(),
        "camera_to_world": [camera.to_world.tolist() for camera in cameras],
    }
    folder = _prepare_folder(Path(out), settings)

    done, total = 0, len(cameras) * spp + len(references) * reference_spp

    def advance(paths: int) -> None:
        nonlocal done
        done += paths
        if progress is not None:
            progress(done, total)

    for number, camera in enumerate(cameras):
        names = _FRAME_FILES + (("reference",) if number in references else ())
        if all((folder / f"{name}{number}.exr").is_file() for name in names):
            advance(spp + (reference_spp if number in references else 0))
            continue
        rays = pixel_rays(camera, width, height)
        distance, normal, albedo = tracer.features(rays)
        position = rays.origin + np.minimum(distance, reach)[:, None] * rays.directions
        depth = (position - rays.origin) @ camera.to_world[:3, 2]
        color = tracer.radiance(rays, spp, (seed, number, 0), advance)
        reference = None
        if number in references:
            reference = tracer.radiance(rays, reference_spp, (seed, number, 1), advance)
        buffers = {
            "color": color,
            "albedo": albedo,
            "normal": normal,
            "depth": depth,
            "position": position,
            "reference": reference,
        }
        images = {name: _image(value, width, height) for name, value in buffers.items() if value is not None}
        write_bmfr_frame(folder, number, Frame(**images))
    return folder


class _Tracer:
    """Traces given rays through a scene, one by one in the scalar variant, all at once in the others."""

    def __init__(self, scene: Scene, variant: str, max_depth: int) -> None:
        self._mi = mi = _import_mitsuba()
        try:
            mi.set_variant(variant)
        except ImportError as error:
            raise InputError(f"Mitsuba variant '{variant}' does not run here: {_first_line(error)}") from error
        self._dr = importlib.import_module("drjit")
        self._scalar = variant.startswith("scalar")
        self.name = f"mitsuba {mi.__version__} ({variant}, drjit {self._dr.__version__}), path integrator"
        self._scene = _load_scene(mi, scene)
        self._integrator = mi.load_dict({"type": "path", "max_depth": max_depth, "rr_depth": _RR_DEPTH})
        self._sampler = mi.load_dict({"type": "independent"})
        self._context = mi.BSDFContext()

    def reach(self, camera: Camera) -> float:
        """A distance from the camera that lies behind everything in the scene: where the background is put."""
        box = self._scene.bbox()
        if not box.valid():
            return 1.0
        low, high = np.array(box.min, dtype=np.float64), np.array(box.max, dtype=np.float64)
        return float(np.linalg.norm(high - low) + np.linalg.norm((low + high) / 2 - camera.to_world[:3, 3]))

    def features(self, rays: PixelRays) -> tuple[Array, Array, Array]:
        """Distance ``(N,)`` (``inf`` without a hit), normal ``(N, 3)`` and albedo ``(N, 3)`` of what the rays hit."""
        if self._scalar:
            found = [self._hit(ray) for ray in self._scalar_rays(rays)]
            table = np.array([(distance, *normal, *albedo) for distance, normal, albedo in found], dtype=np.float64)
        else:
            distance, normal, albedo = self._hit(self._wavefront(rays, 1))
            columns = (distance, *normal, *albedo)
            count = len(rays.directions)  # a constant column has one entry
            table = np.stack([np.broadcast_to(np.array(c, dtype=np.float64), count) for c in columns], axis=1)
        # A few BSDFs only approximate their albedo, by a value that can exceed 1.
        return table[:, 0], table[:, 1:4], np.clip(np.nan_to_num(table[:, 4:7]), 0, 1)

    def radiance(self, rays: PixelRays, spp: int, seed: tuple[int, ...], advance: Callable[[int], None]) -> Array:
        """Mean radiance ``(N, 3)`` of ``spp`` paths per ray; ``advance`` hears of each finished pass."""
        mi = self._mi
        count = len(rays.directions)
        paths_per_pass = min(spp, 8 if self._scalar else max(1, _WAVEFRONT // count))
        one_by_one = self._scalar_rays(rays) if self._scalar else []
        total = np.zeros((count, 3))
        done = 0
        for number in range(math.ceil(spp / paths_per_pass)):
            paths = min(paths_per_pass, spp - done)
            # Hashed: with sums of seed, frame and pass, two frames could share their noise.
            state = int(np.random.SeedSequence((*seed, number)).generate_state(1)[0])
            self._sampler.seed(self._runtime_value(mi.UInt32, state), 1 if self._scalar else count * paths)
            if self._scalar:
                samples = self._scalar_radiance(one_by_one, paths)
            else:
                radiance = self._integrator.sample(self._scene, self._sampler, self._wavefront(rays, paths))[0]
                samples = np.stack([np.array(channel) for channel in radiance], axis=1)
            # A path that ran into 0/0 counts as black: one of them would spoil a whole reference pixel.
            samples = np.where(np.isfinite(samples).all(axis=1, keepdims=True), samples, 0)
            total += samples.reshape(paths, count, 3).sum(axis=0, dtype=np.float64)
            done += paths
            advance(paths)
        return total / spp

    def _scalar_rays(self, rays: PixelRays) -> list[Any]:
        origin = self._mi.Point3f(*rays.origin.tolist())
        return [
            self._mi.RayDifferential3f(self._mi.Ray3f(origin, self._mi.Vector3f(*direction)))
            for direction in rays.directions.tolist()
        ]

    def _scalar_radiance(self, rays: list[Any], paths: int) -> NDArray[np.float32]:
        sample, scene, sampler = self._integrator.sample, self._scene, self._sampler
        values: list[float] = []
        for _ in range(paths):
            for ray in rays:
                values.extend(sample(scene, sampler, ray)[0])
        return np.array(values, dtype=np.float32).reshape(-1, 3)

    def _wavefront(self, rays: PixelRays, copies: int) -> Any:
        mi = self._mi
        columns = np.tile(rays.directions.astype(np.float32), (copies, 1)).T
        direction = mi.Vector3f(*(mi.Float(np.ascontiguousarray(column)) for column in columns))
        origin = mi.Point3f(*(self._runtime_value(mi.Float, value) for value in rays.origin.tolist()))
        return mi.RayDifferential3f(mi.Ray3f(origin, direction))

    def _runtime_value(self, kind: Any, value: float) -> Any:
        # A number known to the compiler would become part of the kernel: seconds of compilation for each frame.
        return value if self._scalar else self._dr.opaque(kind, value)

    def _hit(self, ray: Any) -> tuple[Any, Any, Any]:
        """Distance, normal and albedo of the first surface that is not see-through; the same code for all variants."""
        mi, dr = self._mi, self._dr
        hit = self._scene.ray_intersect(ray)
        for _ in range(_SEE_THROUGH_LAYERS):
            if not dr.any(hit.is_valid()):
                break
            transmission = hit.bsdf(ray).eval_null_transmission(hit, hit.is_valid())
            through = hit.is_valid() & (sum(transmission) > 1.5)  # opacity below a half, on average over RGB
            if not dr.any(through):
                break
            behind = self._scene.ray_intersect(hit.spawn_ray(ray.d), through)
            hit = dr.select(through, behind, hit)
        valid = hit.is_valid()
        black = mi.Color3f(0)
        if not dr.any(valid):  # a scalar ray that hit nothing has no BSDF to ask
            return dr.select(valid, mi.Float(0), mi.Float(dr.inf)), black, black
        normal = hit.sh_frame.n
        normal = dr.select(valid, dr.select(dr.dot(normal, ray.d) > 0, -normal, normal), mi.Normal3f(0))
        bsdf = hit.bsdf(ray)
        diffuse = valid & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse)
        # select instead of ~diffuse, which is no boolean for a Python bool.
        glossy = valid & dr.select(diffuse, False, mi.has_flag(bsdf.flags(), mi.BSDFFlags.GlossyReflection))
        albedo = dr.select(diffuse, bsdf.eval_diffuse_reflectance(hit, diffuse), black)
        if dr.any(glossy):
            albedo = dr.select(glossy, self._directional_albedo(bsdf, hit, glossy), albedo)
        return dr.select(valid, dr.dot(hit.p - ray.o, ray.d), dr.inf), normal, albedo

    def _directional_albedo(self, bsdf: Any, hit: Any, active: Any) -> Any:
        """What a rough metal reflects of a white world towards the viewer: a fixed 4x4 grid of samples, so no noise."""
        total = self._mi.Color3f(0)
        grid = [(i + 0.5) / 4 for i in range(4)]
        for x in grid:
            for y in grid:
                total += bsdf.sample(self._context, hit, 0.5, self._mi.Point2f(x, y), active)[1]
        return total / 16


_CONVENTIONS: dict[str, Any] = {
    "color_includes_albedo": True,
    "reference_includes_albedo": True,
    "noisy_seed": "numpy.random.SeedSequence((seed, frame, 0, pass)).generate_state(1)",
    "reference_seed": "numpy.random.SeedSequence((seed, frame, 1, pass)).generate_state(1)",
    "pixel_sampling": "colour, features and reference all at the pixel centre (no jitter, box filter)",
    "colour_space": "linear RGB, sRGB primaries",
    "shading_normal": "world space, turned to the side the camera sees",
    "depth": "linear view depth (along the viewing axis), scene units",
    "albedo": "Mitsuba eval_diffuse_reflectance where the BSDF has a diffuse lobe; directional albedo for rough "
    "conductors; 0 for mirrors, glass, background",
    "alpha_masks": "features look through surfaces whose opacity is below 0.5",
    "conventions": {
        "camera_matrices": "clip = [x,y,z,1] @ M (row vectors; M is the transpose of world_to_clip); "
        "u=(clip.x/clip.w+1)/2 left to right, v=(clip.y/clip.w+1)/2 top to bottom; clip.z/clip.w in [0,1]",
        "pixel": "index = (u*width - ox, v*height - (1-oy)), pixel_offsets = (ox, oy)",
        "reprojection": "frame i uses camera_matrices[i-1]",
        "camera_to_world": "column vectors; camera frame +x left, +y up, +z forward (Mitsuba)",
    },
}
# Frames rendered with different values of these do not belong into one folder.
_IDENTITY = (
    "scene",
    "scene_sha256",
    "renderer",
    "width",
    "height",
    "near",
    "far",
    "noisy_spp",
    "max_depth",
    "rr_depth",
    "seed",
)


def _prepare_folder(out: Path, settings: dict[str, Any]) -> Path:
    """Create ``out/inputs`` with its camera files, or make sure that what is there was rendered with these settings."""
    folder = out / "inputs"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be created ({error.strerror}); choose another output folder") from error
    described = folder / "camera.json"
    if described.is_file():
        _check_resumable(described, settings)
    write_text(described, json.dumps(settings, indent=1) + "\n")
    matrices = CameraMatrices(
        np.array(settings["camera_matrices"]),
        np.array(settings["pixel_offsets"]),
        settings["position_limit_squared"],
        settings["normal_limit_squared"],
    )
    write_camera_matrices(folder / "camera_matrices.h", matrices, _CONVENTIONS["conventions"]["camera_matrices"])
    return folder


def _check_resumable(described: Path, settings: dict[str, Any]) -> None:
    advice = "choose another output folder, or delete this one"
    try:
        before = json.loads(described.read_text(encoding="utf-8"))
        spp_before, poses_before = dict(before["reference_spp"]), list(before["camera_to_world"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{described}: cannot be read, so the run cannot be resumed; {advice}") from error
    for key in _IDENTITY:
        if before.get(key) != settings[key]:
            raise InputError(f"{described}: rendered with {key} {before.get(key)}, now {settings[key]}; {advice}")
    for number, pose in enumerate(settings["camera_to_world"][: len(poses_before)]):
        if pose != poses_before[number]:
            raise InputError(f"{described}: frame {number} was rendered from another camera; {advice}")
    for number, spp in settings["reference_spp"].items():
        if spp_before.get(number, spp) != spp:
            raise InputError(f"{described}: reference {number} has {spp_before[number]} paths, now {spp}; {advice}")
    # Rendering fewer frames or references than before must not make the file forget the others.
    settings["reference_spp"] = {**spp_before, **settings["reference_spp"]}
    if len(poses_before) > settings["frames"]:
        for key in ("frames", "camera_matrices", "world_to_clip", "camera_to_world", "pixel_offsets"):
            settings[key] = before[key]


def _import_mitsuba() -> Any:
    try:
        return importlib.import_module("mitsuba")
    except ImportError as error:
        raise InputError(
            "rendering needs Mitsuba 3, which is not installed; pip install 'mcdenoise[render]'"
        ) from error


def _choose_variant(variant: str | None) -> str:
    if variant is None:
        current = _import_mitsuba().variant()
        variant = current if current in VARIANTS else ("llvm_ad_rgb" if _llvm_works() else "scalar_rgb")
    if variant not in VARIANTS:
        raise InputError(f"Mitsuba variant: expected one of {', '.join(VARIANTS)}, found '{variant}'")
    return variant


@functools.cache
def _llvm_works() -> bool:
    """Whether the LLVM variant can render here. An LLVM too old for the CPU aborts the process, so a child tries it."""
    trial = (
        "import mitsuba as mi; mi.set_variant('llvm_ad_rgb'); mi.render(mi.load_dict(mi.cornell_box()), spp=1).numpy()"
    )
    try:
        return (
            subprocess.run([sys.executable, "-c", trial], capture_output=True, timeout=60, check=False).returncode == 0
        )
    except (OSError, subprocess.TimeoutExpired):
        return False


def _load_scene(mi: Any, scene: Scene) -> Any:
    if not isinstance(scene, Mapping):
        scene = Path(scene)
        if not scene.is_file():
            raise InputError(f"{scene}: expected a Mitsuba scene, found no such file; check the path")
    try:
        loaded = mi.load_dict(_to_mitsuba(mi, scene)) if isinstance(scene, Mapping) else mi.load_file(str(scene))
    except (RuntimeError, TypeError, ValueError) as error:
        where = "scene dictionary" if isinstance(scene, Mapping) else scene
        raise InputError(f"{where}: Mitsuba cannot load it: {_first_line(error)}") from error
    if not isinstance(loaded, mi.Scene):
        raise InputError(
            f"expected a Mitsuba scene, found a {type(loaded).__name__}; its outermost type must be 'scene'"
        )
    return loaded


def _to_mitsuba(mi: Any, value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _to_mitsuba(mi, item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        if value.shape == (4, 4):
            return mi.ScalarTransform4f(value)
        return mi.Bitmap(np.ascontiguousarray(value, dtype=np.float32))
    return value


def _scene_name(scene: Scene) -> str:
    if isinstance(scene, Mapping):
        return "in memory"
    path = Path(scene).resolve()
    return path.parent.name if path.stem == "scene" else path.stem


def _scene_digest(scene: Scene) -> str:
    """Tells one description of a scene from another; of the files that an XML names, only the names count."""
    digest = hashlib.sha256()

    def feed(value: Any) -> None:
        if isinstance(value, Mapping):
            for key, item in value.items():
                digest.update(f"{key}:".encode())
                feed(item)
        elif isinstance(value, np.ndarray):
            digest.update(str(value.shape).encode() + value.tobytes())
        else:
            digest.update(f"{value!r};".encode())

    feed(scene if isinstance(scene, Mapping) else Path(scene).read_bytes())
    return digest.hexdigest()


def _image(values: Array, width: int, height: int) -> torch.Tensor:
    return torch.from_numpy(values.reshape(height, width, -1).astype(np.float32)).permute(2, 0, 1)[None]


def _check_settings(
    size: tuple[int, int],
    frames: int | None,
    count: int,
    references: set[int],
    spp: int,
    reference_spp: int,
    seed: int,
    max_depth: int,
) -> None:
    if count < 1 or (frames is not None and frames < 1):
        raise InputError("expected at least one camera and one frame to render, found none")
    if not all(isinstance(side, int) and 1 <= side <= _LARGEST_SIDE for side in size):
        raise InputError(
            f"size: expected width and height between 1 and {_LARGEST_SIDE} pixels, found {size[0]}x{size[1]}"
        )
    outside = sorted(number for number in references if not 0 <= number < count)
    if outside:
        raise InputError(f"reference frames: expected numbers from 0 to {count - 1}, found {outside[0]}")
    for name, value, lowest in (
        ("spp", spp, 1),
        ("reference_spp", reference_spp, 1),
        ("seed", seed, 0),
        ("max_depth", max_depth, 1),
    ):
        if value < lowest:
            raise InputError(f"{name}: expected at least {lowest}, found {value}")


def _first_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__
