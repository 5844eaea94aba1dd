"""Rendering a random scene with Cycles to a training sequence in the BMFR layout.

Each noisy color has features from its own samples, as users' files do: anti-aliased, and noisy through glass, depth of
field and motion blur. They equal those that :func:`mcdenoise.data.open_sequence` reads from a Blender file, except that
normals are converted from camera space to world space.

Cycles takes depth and position from the first sample of a pixel only, and treats them as at the pixel centre, whatever
the filter: they are noisy only through lens and shutter, and an image of one sample per pixel is not filtered at all.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mcdenoise.data.camera_matrices import CameraMatrices, write_camera_matrices
from mcdenoise.data.camera_path import Array, Camera, check_moves, pixel_rays, view_projection
from mcdenoise.data.exr import Image
from mcdenoise.data.files import write_json
from mcdenoise.data.images import read_channels, read_image_header
from mcdenoise.data.readers.bmfr import has_buffer, noise_seed_folder, write_buffer, write_clean_features
from mcdenoise.data.readers.diffuse_specular import find_splits
from mcdenoise.data.readers.layers import layers_of, read_layers
from mcdenoise.data.readers.values import nothing_hit
from mcdenoise.errors import InputError
from mcdenoise.reading import read_text
from mcdenoise.scenes.cycles.process import Blender
from mcdenoise.scenes.cycles.settings import WIDTHS, CyclesSettings, draw_settings
from mcdenoise.scenes.cycles.translate import translate
from mcdenoise.scenes.random import RandomScene
from mcdenoise.scenes.random.takes import CLEANER
from mcdenoise.scenes.render.folder import ReferenceState, write_reference
from mcdenoise.scenes.render.tracer import scene_digest

# Names of the passes in Blender 4.5 and, if they differ, in 5.0.
_PASSES = {
    "Combined": ("Combined",),
    "Denoising Albedo": ("Denoising Albedo",),
    "Denoising Normal": ("Denoising Normal",),
    "Depth": ("Depth",),
    "Position": ("Position",),
    "IndexOB": ("IndexOB", "Object Index"),
}
# Light passes, by the names in Blender's Python.
_LIGHT = [
    *(f"{kind}_{part}" for kind in ("diffuse", "glossy", "transmission") for part in ("direct", "indirect", "color")),
    *("emit", "environment"),
]
# Distance of the sky relative to everything else; the reader uses the same value.
_SKY = 1000.0
_REFERENCE_STREAM = 1
_CONVENTIONS: dict[str, Any] = {
    "color_includes_albedo": True,
    "reference_includes_albedo": True,
    "seeds": "numpy.random.SeedSequence((seed, frame, stream)).generate_state(1) % 2**31, of a view but the first "
    "with spawn_key=(view,); stream 0 for the first noisy color, 1 for the reference, 1 + noise seed for the others",
    "parts": "diffuse and specular, where they are there, add up to color: specular is all light that is not diffuse",
    "features": "from the samples of the color beside them: Denoising Albedo clamped to 0..1, Denoising Normal in "
    "world space, Depth, Position",
    "conventions": {
        "camera_matrices": "clip = [x,y,z,1] @ M (row vectors; M is the transpose of world_to_clip); "
        "u=(clip.x/clip.w+1)/2 left to right, v=(clip.y/clip.w+1)/2 top to bottom; clip.z/clip.w in [0,1]",
        "camera_to_world": "column vectors; camera frame +x left, +y up, +z forward (Mitsuba)",
    },
}
_IDENTITY = ("scene_sha256", "renderer", "frames", "width", "height", "seed", "view", "camera_to_world", "settings")


def render_cycles(
    made: RandomScene,
    out: Path,
    blender: Blender,
    *,
    size: tuple[int, int] = (160, 160),
    seed: int = 0,
    view: int = 0,
    samples: int | None = None,
    noise_seeds: int = 2,
    reference_samples: int = 128,
    settings: CyclesSettings | None = None,
    parts: bool = False,
    threads: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Render a random scene with Cycles on the CPU.

    Existing frames are kept, so an interrupted run can be resumed.

    Args:
        made: the scene, its cameras and its moving objects.
        out: folder of the sequence; the files go to ``out/inputs``.
        blender: the rendering process.
        size: width and height in pixels.
        seed: seed of the noise, and of the random settings.
        view: selects other noise and settings, for another take of the same scene.
        samples: samples per pixel of the noisy colors; random by default, see :func:`draw_settings`.
        noise_seeds: number of noise seeds, each with its own color and features. Those after the first are written to
            ``out/inputs/noise_seed{1,2,...}``.
        reference_samples: samples per pixel of the references, but at least four times as many as of the noisy colors;
            0 for no references.
        settings: filter, lens and shutter; random by default.
        parts: also write the diffuse and the specular light of the noisy colors, see
            :mod:`mcdenoise.data.readers.diffuse_specular`.
        threads: number of CPU threads; all by default. The images do not depend on it.
        progress: called with the finished and the total number of samples per pixel, summed over all frames.

    Returns:
        The folder of the files, ``out/inputs``.

    Raises:
        InputError: a setting is invalid, Cycles does not support a part of the scene, Blender failed, or ``out`` cannot
            be written or holds a sequence with other settings.
    """
    lowest = {"noise_seeds": (noise_seeds, 1), "reference_samples": (reference_samples, 0), "threads": (threads, 0)}
    lowest |= {"seed": (seed, 0), "view": (view, 0), "samples": (1 if samples is None else samples, 1)}
    for name, (value, least) in lowest.items():
        if value < least:
            raise InputError(f"{name}: expected at least {least}, found {value}")
    count = len(made.cameras)
    chosen = settings or draw_settings(seed, view=view, samples=samples, moving=count > 1)
    clean_samples = max(reference_samples, CLEANER * chosen.samples) if reference_samples else 0
    moves = check_moves(made.moves, count)
    # Sorted, so that Blender's index of an object identifies it.
    movers = [name for name in made.scene if name in moves]
    description = translate(made.scene, movers, seed=seed)
    folder = _Folder(out / "inputs", made, size, chosen, (seed, view), blender.version)
    last = "specular" if parts else "color"
    noisy = [(n, k) for n in range(count) for k in reversed(range(noise_seeds)) if not folder.has(last, n, k)]
    clean = [n for n in range(count) if clean_samples and not folder.has_reference(n)]
    total = count * (noise_seeds * chosen.samples + clean_samples)
    done = total - len(noisy) * chosen.samples - len(clean) * clean_samples

    def advance(spent: int) -> None:
        nonlocal done
        done += spent
        if progress is not None:
            progress(done, total)

    advance(0)
    with tempfile.TemporaryDirectory() as place:
        file = Path(place) / "shot.exr"
        if noisy or clean:
            description.save(Path(place))
            blender.ask("scene", folder=place, settings=_for_blender(made, moves, movers, chosen, size, threads, parts))

        def shot(number: int, samples: int, stream: int) -> dict[str, Image]:
            sequence = np.random.SeedSequence((seed, number, stream), spawn_key=(view,) if view else ())
            noise = int(sequence.generate_state(1)[0] % 2**31)
            blender.ask("render", frame=number, samples=samples, seed=noise, out=str(file))
            images = _read(file, parts)
            file.unlink()
            advance(samples)
            return images

        # Render images with few samples first: a scene that stays in Cycles keeps the sampling pattern of the largest
        # number of samples so far, and the noise of a frame must not depend on previous renderings.
        for number, noise_seed in noisy:
            back = {index + 1: _back(moves[name], number) for index, name in enumerate(movers)}
            seen = _View(made.cameras[number], size, back)
            images = shot(number, chosen.samples, 1 + noise_seed if noise_seed else 0)
            folder.write(number, noise_seed, seen.buffers(images))
        for number in clean:
            images = shot(number, clean_samples, _REFERENCE_STREAM)
            buffers = _View(made.cameras[number], size, {}).buffers(images)
            write_clean_features(folder.path, number, _tensor(buffers["albedo"]), _tensor(buffers["normal"]))
            state = ReferenceState(clean_samples, 1, None)
            write_reference(folder.path, number, _tensor(buffers["color"]), state)
    return folder.path


# Buffers that every frame has, as `_View` returns them.
_FEATURES = ("albedo", "normal", "position", "depth")


class _Folder:
    """The folder ``inputs`` of a sequence, with its description."""

    def __init__(
        self,
        path: Path,
        made: RandomScene,
        size: tuple[int, int],
        chosen: CyclesSettings,
        seed: tuple[int, int],
        version: str,
    ) -> None:
        self.path, self.size = path, size
        width, height = size
        scale = _extent(made)
        matrices = np.stack(
            [view_projection(each, width, height, 1e-3 * scale, 2 * _SKY * scale) for each in made.cameras]
        )
        content: dict[str, Any] = {
            **_CONVENTIONS,
            "scene": "in memory",
            "scene_sha256": scene_digest(made.scene),
            "renderer": f"Blender {version}, Cycles",
            "frames": len(made.cameras),
            "width": width,
            "height": height,
            "fov_x_degrees": made.cameras[0].fov_x,
            "seed": seed[0],
            "view": seed[1],
            "noisy_spp": chosen.samples,
            "settings": {**vars(chosen), "focus": list(chosen.focus)},
            "position_limit_squared": (0.005 * scale) ** 2,
            "normal_limit_squared": 1.0,
            "pixel_offsets": [[0.5, 0.5]] * len(made.cameras),
            "camera_matrices": matrices.tolist(),
            "camera_to_world": [camera.to_world.tolist() for camera in made.cameras],
            "moves": {name: np.asarray(path).tolist() for name, path in made.moves.items()},
        }
        described = path / "camera.json"
        if described.is_file():
            self._check(described, content)
            return
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{path}: cannot be created ({error.strerror}); choose another output folder") from error
        cameras = CameraMatrices(
            matrices,
            np.array(content["pixel_offsets"]),
            content["position_limit_squared"],
            content["normal_limit_squared"],
        )
        write_camera_matrices(path / "camera_matrices.h", cameras, _CONVENTIONS["conventions"]["camera_matrices"])
        write_json(described, content)

    def _check(self, described: Path, content: Mapping[str, Any]) -> None:
        try:
            before = json.loads(read_text(described))
            # Descriptions without a view are from before there were several, and stand for the first one.
            changed = [key for key in _IDENTITY if {"view": 0, **before}[key] != content[key]]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{described}: cannot be read, so the run cannot be resumed; choose another output folder"
            ) from error
        if changed:
            raise InputError(
                f"{described}: rendered with another '{changed[0]}'; choose another output folder, or delete this one"
            )

    def has(self, name: str, number: int, noise_seed: int) -> bool:
        """Whether a frame has a buffer and the color of a noise seed, which is written last."""
        place = noise_seed_folder(self.path, noise_seed)
        return all(has_buffer(place, number, each, self.size) for each in (*_FEATURES, name, "color"))

    def has_reference(self, number: int) -> bool:
        """Whether a frame has a reference."""
        return has_buffer(self.path, number, "reference", self.size)

    def write(self, number: int, noise_seed: int, buffers: Mapping[str, Image]) -> None:
        """Write a noisy color and its features, the color last."""
        place = noise_seed_folder(self.path, noise_seed)
        try:
            place.mkdir(exist_ok=True)
        except OSError as error:
            raise InputError(f"{place}: cannot be created ({error.strerror}); choose another output folder") from error
        for name, image in buffers.items():
            write_buffer(place, number, name, _tensor(image))


class _View:
    """Conversion of one frame's passes to buffers.

    Args:
        camera: camera of the frame.
        size: width and height in pixels.
        back: for each object index, the transform of its points to the previous frame.
    """

    def __init__(self, camera: Camera, size: tuple[int, int], back: Mapping[int, Array]) -> None:
        self._camera, self._size, self._back = camera, size, back

    def buffers(self, images: Mapping[str, Image]) -> dict[str, Image]:
        """Buffers in the BMFR layout, the color last."""
        width, height = self._size
        pose, position, depth = self._camera.to_world, images["Position"], images["Depth"]
        known = (~nothing_hit(depth)) & np.isfinite(position).all(-1, keepdims=True)
        # Like the reader for a user's file: put the sky far behind everything, so that it can be reprojected.
        rays = pixel_rays(self._camera, width, height)
        axis = (rays.directions @ pose[:3, 2]).reshape(height, width, 1)
        far = _SKY * float(depth[known].max(initial=1))
        sky = rays.origin + far / axis * rays.directions.reshape(height, width, 3)
        position = np.where(known, position, sky)
        # In Blender's Denoising Normal, x points right, y up, and z into the scene.
        normal = np.nan_to_num(images["Denoising Normal"], nan=0, posinf=0, neginf=0) * (-1, 1, 1)
        buffers: dict[str, Any] = {
            "albedo": np.clip(np.nan_to_num(images["Denoising Albedo"], nan=0, posinf=1, neginf=0), 0, 1),
            "normal": np.clip(normal @ pose[:3, :3].T, -1, 1),
            "position": position,
            "depth": np.where(known, depth, np.inf),
        }
        if self._back:
            before = position.copy()
            index = np.rint(images["IndexOB"][..., 0])
            for number, back in self._back.items():
                own = (index == number) & known[..., 0]
                before[own] = position[own] @ back[:3, :3].T + back[:3, 3]
            buffers["previous_position"] = before
        buffers |= {name: images[name] for name in ("diffuse", "specular") if name in images}
        return {**buffers, "color": images["Combined"][..., :3]}


def _back(move: Array, number: int) -> Array:
    """Transform of an object from a frame to the previous one; the identity for the first frame."""
    return np.asarray(move[max(number - 1, 0)] @ np.linalg.inv(move[number]))


def _for_blender(
    made: RandomScene,
    moves: Mapping[str, Array],
    movers: list[str],
    chosen: CyclesSettings,
    size: tuple[int, int],
    threads: int,
    parts: bool,
) -> dict[str, Any]:
    fovs = [camera.fov_x for camera in made.cameras]
    return {
        "size": list(size),
        "threads": threads,
        "passes": _LIGHT if parts else [],
        "box": chosen.pixel_filter == "box",
        "filter_width": WIDTHS[chosen.pixel_filter],
        "aperture": chosen.aperture,
        "focus": list(chosen.focus),
        "shutter": chosen.shutter,
        "cameras": _prolonged(np.stack([camera.to_world for camera in made.cameras])).tolist(),
        "fov_x": [fovs[0], *fovs, fovs[-1]],
        "moves": {name: _prolonged(moves[name]).tolist() for name in movers},
    }


def _prolonged(poses: Array) -> Array:
    """Extrapolate rigid transforms by one before the first and one after the last."""
    if len(poses) == 1:
        return np.repeat(poses, 3, 0)
    first = poses[0] @ np.linalg.inv(poses[1]) @ poses[0]
    last = poses[-1] @ np.linalg.inv(poses[-2]) @ poses[-1]
    return np.concatenate([first[None], poses, last[None]])


def _read(path: Path, with_parts: bool) -> dict[str, Image]:
    parts = read_image_header(path).parts
    listed = layers_of(0, "", parts)
    layers = {layer.title: layer for layer in listed}
    found: dict[str, Image] = {}
    for split in find_splits(listed, layers["Combined"], {})[:1] if with_parts else []:
        found |= split.sums(read_layers(path, split.layers))
    for name, names in _PASSES.items():
        layer = next((layers[each] for each in names if each in layers), None)
        if layer is None and len(layers) == 1:
            (layer,) = layers.values()
        if layer is None:
            raise InputError(
                f"Blender's pass '{name}': expected it in the frame just rendered, found {', '.join(layers)}"
            )
        pixels = read_channels(path, {layer.part: layer.channels})[layer.part]
        found[name] = pixels if pixels.shape[-1] < 3 else pixels[..., :3]
    return found


def _extent(made: RandomScene) -> float:
    """Approximate extent of the scene, metres."""
    eye = made.cameras[0].to_world[:3, 3]
    shapes = [entry for entry in made.scene.values() if isinstance(entry, Mapping) and "to_world" in entry]
    away = [float(np.linalg.norm(np.asarray(shape["to_world"])[:3, 3] - eye)) for shape in shapes]
    return float(np.median(away or [1.0]))


def _tensor(image: Image | Array) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(image, dtype=np.float32)).permute(2, 0, 1)[None]
