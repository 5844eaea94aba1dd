"""Rendering a take's scene with Cycles to a training sequence in the BMFR layout.

Each noisy color has features from its own samples, as users' files do: anti-aliased, and noisy through glass, depth of
field and motion blur. They equal those that :func:`mcdenoise.data.open_sequence` reads from a Blender file, except that
normals are converted from camera space to world space.

Cycles takes depth and position from the first sample of a pixel only, and treats them as at the pixel centre, whatever
the filter: they are noisy only through lens and shutter, and an image of one sample per pixel is not filtered at all.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from mcdenoise.data.camera_path import Array, Camera, check_moves, view_projection
from mcdenoise.data.images import Image, read_channels, read_image_header
from mcdenoise.data.readers.bmfr import CLEAN, has_buffers, noise_seed_folder, write_buffers
from mcdenoise.data.readers.diffuse_specular import find_splits
from mcdenoise.data.readers.files import SKY, as_tensor, far_points
from mcdenoise.data.readers.layers import layers_of, read_files
from mcdenoise.data.readers.values import nothing_hit
from mcdenoise.errors import InputError
from mcdenoise.interruption import unfinished
from mcdenoise.scenes.cycles.process import Blender
from mcdenoise.scenes.cycles.translate import translate
from mcdenoise.scenes.render.folder import SequenceFolder, write_reference
from mcdenoise.scenes.render.halves import ReferenceState
from mcdenoise.scenes.render.loading import to_previous
from mcdenoise.scenes.render.sequence import check_lowest, wanted_references
from mcdenoise.scenes.takes.draw import Take

_PASSES = ("Combined", "Denoising Albedo", "Denoising Normal", "Depth", "Position", "IndexOB")
# The name of a pass in Blender 5.0, where it is another than in 4.5.
_RENAMED = {"IndexOB": "Object Index"}
# Light passes, by the names in Blender's Python.
_LIGHT = [
    *(f"{kind}_{part}" for kind in ("diffuse", "glossy", "transmission") for part in ("direct", "indirect", "color")),
    *("emit", "environment"),
]
# Buffers that every frame has, see `buffers_of`.
_FEATURES = ("albedo", "normal", "position", "depth")
_REFERENCE_STREAM = 1
# Minimum ratio of reference samples to noisy samples: a reference with nearly the same noise would teach nothing.
_CLEANER = 4
# Blender's default is Blackman-Harris over 1.5 pixels; a width of 0.01 pixels puts every sample at the pixel centre.
_DEFAULT_FILTER = "blackman_harris"
_WIDTHS = {_DEFAULT_FILTER: 1.5, "box": 1.0, "centre": 0.01}
# Fraction of the clips with motion blur, the exposure time in frames, and the stream of a seed that draws it.
_BLURRED, _SHUTTER, _STREAM = 0.15, 0.5, 0x6379636C
_CONVENTIONS = {
    "seeds": "numpy.random.SeedSequence((seed, frame, stream)).generate_state(1) % 2**31; stream 0 for the "
    "first noisy color, 1 for the reference, 1 + noise seed for the others",
    "parts": "diffuse and specular, where they are there, add up to color: specular is all light that is not diffuse",
    "features": "from the samples of the color beside them: Denoising Albedo clamped to 0..1, Denoising Normal in "
    "world space, Depth, Position",
}


def render_cycles(
    take: Take,
    out: Path,
    blender: Blender,
    *,
    size: tuple[int, int] = (160, 160),
    seed: int = 0,
    spp: int = 1,
    noise_seeds: int = 2,
    reference_spp: int = 128,
    reference_frames: Collection[int] | None = None,
    shutter: float | None = None,
    parts: bool = False,
    threads: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Render the scene of a take with Cycles on the CPU, with its lens, and with its pixel filter or Blender's default.

    Existing frames are kept, so an interrupted run can be resumed.

    Args:
        take: what is rendered.
        out: folder of the sequence; the files go to ``out/inputs``.
        blender: the rendering process.
        size: width and height in pixels.
        seed: seed of the noise, and of the shutter.
        spp: samples per pixel of the noisy colors.
        noise_seeds: number of noise seeds, each with its own color and features. Those after the first are written to
            ``out/inputs/noise_seed{1,2,...}``.
        reference_spp: samples per pixel of the references, but at least four times as many as of the noisy colors; 0
            for no references.
        reference_frames: numbers of the frames that get a reference; all by default.
        shutter: exposure time in frames; by default 0 for stills and most clips, and a half for some.
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
    check_lowest(1, spp=spp, noise_seeds=noise_seeds)
    check_lowest(0, reference_spp=reference_spp, threads=threads, seed=seed)
    count = len(take.cameras)
    references = wanted_references(count, reference_spp, reference_frames)
    if shutter is None:
        blurred = np.random.default_rng((seed, _STREAM)).random() < _BLURRED
        shutter = _SHUTTER if blurred and count > 1 else 0.0
    used = take.film.filter if take.film.filter in _WIDTHS else _DEFAULT_FILTER
    film = {"filter": used, "aperture": take.film.aperture, "focus": take.film.focus, "shutter": shutter}
    clean_spp = max(reference_spp, _CLEANER * spp)
    # The sky stands still in Cycles.
    moves = check_moves({name: path for name, path in take.moves.items() if name != "sky"}, count)
    # Sorted, so that Blender's index of an object identifies it.
    movers = [name for name in take.scene if name in moves]
    description = translate(take.scene, movers, seed=seed)
    scale = _extent(take)
    folder = SequenceFolder(
        out,
        take.scene,
        take.cameras,
        size,
        (1e-3 * scale, 2 * SKY * scale),
        moves,
        _CONVENTIONS,
        renderer=f"Blender {blender.version}, Cycles",
        noisy_spp=spp,
        film=film,
        noise_seeds=noise_seeds,
        seed=seed,
        position_limit_squared=(0.005 * scale) ** 2,
    )
    names = (*_FEATURES, *(["specular"] if parts else []), "color")
    seeds = {k: noise_seed_folder(folder.path, k) for k in reversed(range(noise_seeds))}
    noisy = [(n, k) for n in range(count) for k, own in seeds.items() if not has_buffers(own, n, names, size)]
    clean = sorted(references - folder.references.keys())
    total = count * noise_seeds * spp + len(references) * clean_spp
    done = total - len(noisy) * spp - len(clean) * clean_spp

    def advance(spent: int) -> None:
        nonlocal done
        done += spent
        if progress is not None:
            progress(done, total)

    advance(0)
    with tempfile.TemporaryDirectory() as place, unfinished(Path(place)):
        file = Path(place) / "shot.exr"
        if noisy or clean:
            description.save(Path(place))
            passes = ["z", "position", "object_index", *(_LIGHT if parts else [])]
            settings = _for_blender(take, film, {name: moves[name] for name in movers})
            settings |= {"size": list(size), "threads": threads, "passes": passes, "clamped": False}
            blender.ask("scene", folder=place, settings=settings)

        def shot(number: int, samples: int, stream: int, back: Mapping[int, Array]) -> dict[str, Tensor]:
            noise = int(np.random.SeedSequence((seed, number, stream)).generate_state(1)[0] % 2**31)
            blender.ask("render", frame=number, samples=samples, seed=noise, out=str(file))
            images = _read(file, parts)
            file.unlink()
            advance(samples)
            buffers = buffers_of(images, take.cameras[number], back)
            return {name: as_tensor(image) for name, image in buffers.items()}

        # Render images with few samples first: a scene that stays in Cycles keeps the sampling pattern of the largest
        # number of samples so far, and the noise of a frame must not depend on previous renderings.
        for number, noise_seed in noisy:
            back = {index + 1: to_previous(moves[name], number) for index, name in enumerate(movers)}
            found = shot(number, spp, 1 + noise_seed if noise_seed else 0, back)
            write_buffers(seeds[noise_seed], number, found)
        for number in clean:
            found = shot(number, clean_spp, _REFERENCE_STREAM, {})
            write_buffers(folder.path / CLEAN, number, {name: found[name] for name in ("albedo", "normal")})
            state = ReferenceState(clean_spp, 1, None)
            write_reference(folder.path, number, found["color"], state)
            folder.note_reference(number, state)
    return folder.path


def buffers_of(images: Mapping[str, Image], camera: Camera, back: Mapping[int, Array]) -> dict[str, Image]:
    """Buffers in the BMFR layout from the passes of a frame, the color last.

    Args:
        images: the passes by name.
        camera: camera of the frame.
        back: for each object index, the transform of its points to the previous frame.
    """
    pose, position, depth = camera.to_world, images["Position"].astype(np.float64), images["Depth"]
    known = (~nothing_hit(depth)) & np.isfinite(position).all(-1, keepdims=True)
    height, width, _ = depth.shape
    sky = ~known[..., 0]
    # Like the reader for a user's file.
    matrix = view_projection(camera, width, height, near=1, far=2)
    position[sky] = far_points(matrix, float(depth[known].max(initial=1)), sky)
    # In Blender's Denoising Normal, x points right, y up, and z into the scene.
    normal = np.nan_to_num(images["Denoising Normal"], nan=0, posinf=0, neginf=0) * (-1, 1, 1)
    buffers: dict[str, Any] = {
        "albedo": np.clip(np.nan_to_num(images["Denoising Albedo"], nan=0, posinf=1, neginf=0), 0, 1),
        "normal": np.clip(normal @ pose[:3, :3].T, -1, 1),
        "position": position,
        "depth": np.where(known, depth, np.inf),
    }
    if back:
        before = position.copy()
        index = np.rint(images["IndexOB"][..., 0])
        for number, matrix in back.items():
            own = (index == number) & known[..., 0]
            before[own] = position[own] @ matrix[:3, :3].T + matrix[:3, 3]
        buffers["previous_position"] = before
    buffers |= {name: images[name] for name in ("diffuse", "specular") if name in images}
    return {**buffers, "color": images["Combined"][..., :3]}


def _for_blender(take: Take, film: Mapping[str, Any], moves: Mapping[str, Array]) -> dict[str, Any]:
    """The film, and placements from one frame before the first to one after the last."""
    fovs = [camera.fov_x for camera in take.cameras]
    return {
        **film,
        "box": film["filter"] == "box",
        "filter_width": _WIDTHS[film["filter"]],
        "cameras": _prolonged(np.stack([camera.to_world for camera in take.cameras])).tolist(),
        "fov_x": [fovs[0], *fovs, fovs[-1]],
        "moves": {name: _prolonged(path).tolist() for name, path in moves.items()},
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
        found |= split.sums(read_files(lambda _: path, split.layers))
    for name in _PASSES:
        layer = layers.get(name) or layers.get(_RENAMED.get(name, ""))
        if layer is None:
            raise InputError(
                f"Blender's pass '{name}': expected it in the frame just rendered, found {', '.join(layers)}"
            )
        found[name] = read_channels(path, {layer.part: layer.channels[:3]})[layer.part]
    return found


def _extent(take: Take) -> float:
    """Approximate extent of the scene, metres."""
    eye = take.cameras[0].to_world[:3, 3]
    shapes = [entry for entry in take.scene.values() if isinstance(entry, Mapping) and "to_world" in entry]
    away = [float(np.linalg.norm(np.asarray(shape["to_world"])[:3, 3] - eye)) for shape in shapes]
    return float(np.median(away or [1.0]))
