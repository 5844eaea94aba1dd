"""Rendering the missing files of one frame of a sequence."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np
import torch

from mcdenoise.data.camera_path import Array, Camera, PixelRays, pixel_rays
from mcdenoise.data.readers.bmfr import has_buffer, noise_seed_folder, write_buffer, write_clean_features
from mcdenoise.data.readers.samples import FEATURES
from mcdenoise.scenes.render.film import Film, FilmRenderer
from mcdenoise.scenes.render.folder import ReferenceState, read_reference, write_noisy, write_reference
from mcdenoise.scenes.render.halves import ReferenceHalves
from mcdenoise.scenes.render.tracer import STRATIFIED_PATHS, Tracer

# With fewer paths, rare bright ones have not been hit yet, and the noise is underestimated.
_FEWEST_PATHS_IN_A_HALF = 16
_SMALLEST_HALF = 1 / 8
_SECONDS_BETWEEN_SAVES = 60.0

Seed: TypeAlias = tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class FrameJob:
    """Settings common to all frames, and the state on disk; see :func:`mcdenoise.scenes.render.render_sequence`.

    Args:
        folder: ``inputs`` of the sequence.
        cameras: camera of each frame.
        moves: transforms of each moving object.
        size: width and height in pixels.
        reach: distance of the background in scene units.
        spp: paths per pixel of the noisy colours.
        noise_seeds: number of noise seeds.
        reference_spp: paths per pixel of a finished reference.
        noise_level: or its estimated noise.
        references: frames that get a reference.
        started: progress of the references on disk.
        seed: noise seed.
        film: filter and lens of jittered samples; ``None`` for samples at the pixel centre.
        keep_samples: whether the single samples of the noisy colours are also written.
    """

    folder: Path
    cameras: list[Camera]
    moves: dict[str, Array]
    size: tuple[int, int]
    reach: float
    spp: int
    noise_seeds: int
    reference_spp: int
    noise_level: float | None
    references: frozenset[int]
    started: dict[int, ReferenceState] = field(default_factory=dict)
    seed: int
    film: Film | None = None
    keep_samples: bool = False

    def is_finished(self, number: int) -> bool:
        """Whether all files of a frame exist."""
        colors = all(self.has_color(number, noise_seed) for noise_seed in range(self.noise_seeds))
        folders = {0, *(range(self.noise_seeds) if self.film is not None else ())}
        features = all(self.has_features(number, noise_seed) for noise_seed in folders)
        return colors and features and (number not in self.references or self.has_reference(number))

    def has_color(self, number: int, noise_seed: int) -> bool:
        """Whether a frame has a complete noisy colour of a noise seed."""
        return has_buffer(noise_seed_folder(self.folder, noise_seed), number, "color", self.size)

    def has_features(self, number: int, noise_seed: int = 0) -> bool:
        """Whether a frame has all features of a noise seed, that is, everything but colours and reference."""
        folder = noise_seed_folder(self.folder, noise_seed)
        names = ["albedo", "normal", "position", "depth", *(["previous_position"] if self.moves else [])]
        return all(has_buffer(folder, number, name, self.size) for name in names)

    def has_reference(self, number: int) -> bool:
        """Whether a frame has a finished reference."""
        state = self.started.get(number)
        if state is None:
            return False
        reliable = state.spp >= 2 * _FEWEST_PATHS_IN_A_HALF
        return self.is_good(state.spp, state.noise if reliable else None)

    def is_good(self, spp: int, noise: float | None) -> bool:
        """Whether this number of paths, or this noise, is sufficient for a reference."""
        quiet = self.noise_level is not None and noise is not None and noise <= self.noise_level
        return spp >= self.reference_spp or quiet

    def paths_there(self) -> int:
        """Number of paths per pixel that are already on disk, summed over all frames."""
        frames = range(len(self.cameras))
        colors = sum(self.has_color(number, k) for number in frames for k in range(self.noise_seeds))
        states = [(number, self.started[number]) for number in self.references if number in self.started]
        return colors * self.spp + sum(
            self.reference_spp if self.has_reference(number) else state.spp for number, state in states
        )


def render_frame(job: FrameJob, tracer: Tracer, number: int, advance: Callable[[int], None]) -> ReferenceState | None:
    """Write the missing files of a frame. The first colour is last: a frame that has it is complete.

    Args:
        job: settings common to all frames.
        tracer: tracer of the scene.
        number: frame number.
        advance: called with the number of paths per pixel after each pass.

    Returns:
        Progress of its reference; ``None`` if nothing was done for it.

    Raises:
        InputError: a file cannot be written, or the unfinished reference is damaged.
    """
    width, height = job.size
    tracer.place(number)
    wanted = number in job.references and not job.has_reference(number)
    if job.film is not None:
        return _render_filtered(
            job, FilmRenderer(tracer, job.film, job.size, job.reach), tracer, number, advance, wanted
        )
    rays = pixel_rays(job.cameras[number], width, height)
    if not job.has_features(number):
        for name, values in _features(job, tracer, number, rays).items():
            write_buffer(job.folder, number, name, _image(values, job.size))
    state = None
    if wanted:
        trace = partial(tracer.radiance, rays)
        state = _refine_reference(job, lambda n, seed, even: trace(n, seed, stratified=even), number, advance)
    for noise_seed in reversed(range(job.noise_seeds)):
        if not job.has_color(number, noise_seed):
            color, samples = _color(job, tracer, rays, (job.seed, number, _stream(noise_seed)), advance)
            own = {"samples": torch.stack([_image(each, job.size) for each in samples], 1)} if samples else {}
            write_noisy(job.folder, number, noise_seed, {**own, "color": _image(color, job.size)})
    return state


def _render_filtered(
    job: FrameJob,
    film: FilmRenderer,
    tracer: Tracer,
    number: int,
    advance: Callable[[int], None],
    wanted: bool,
) -> ReferenceState | None:
    """Like :func:`render_frame`, but on a film: every noise seed has the features of its own samples."""
    camera = job.cameras[number]
    state = None
    if wanted:
        state = _refine_reference(job, lambda n, seed, _: film.radiance(camera, n, seed), number, advance)
        clean = film.frame(camera, {}, _CLEAN_PATHS, (job.seed, number, 1, _CLEAN_STREAM))
        write_clean_features(job.folder, number, *(_image(clean[name], job.size) for name in ("albedo", "normal")))
    back = {name: matrix for name, matrix in _moved_back(job, number).items() if name in tracer.movers}
    for noise_seed in reversed(range(job.noise_seeds)):
        if job.has_color(number, noise_seed) and job.has_features(number, noise_seed):
            continue
        total: dict[str, Array] = {}
        per_pass = 1 if job.keep_samples else film.paths_per_pass()
        kept: list[torch.Tensor] = []
        for index, start in enumerate(range(0, job.spp, per_pass)):
            paths = min(per_pass, job.spp - start)
            seed = (job.seed, number, _stream(noise_seed), index)
            found = film.frame(camera, back, paths, seed)
            for name, values in found.items():
                total[name] = total.get(name, 0) + values * (paths / job.spp)
            if job.keep_samples:
                kept.append(torch.cat([_image(found[name], job.size) for name in ("color", *FEATURES)], 1))
            advance(paths)
        images = {name: _image(total[name], job.size) for name in sorted({*total} - {"color"})}
        images |= {"samples": torch.stack(kept, 1)} if kept else {}
        images["color"] = _image(total["color"], job.size)
        write_noisy(job.folder, number, noise_seed, images)
    return state


# Number of samples of a reference's features, and a seed number that its passes do not use.
_CLEAN_PATHS, _CLEAN_STREAM = 16, 2**20


def _stream(noise_seed: int) -> int:
    # The stream 1 belongs to the reference.
    return 1 + noise_seed if noise_seed else 0


def _features(job: FrameJob, tracer: Tracer, number: int, rays: PixelRays) -> dict[str, Array]:
    hits = tracer.features(rays)
    position = rays.origin + np.minimum(hits.distance, job.reach)[:, None] * rays.directions
    depth = (position - rays.origin) @ job.cameras[number].to_world[:3, 2]
    features = {"albedo": hits.albedo, "normal": hits.normal, "position": position, "depth": depth}
    if job.moves:
        before, back = position.copy(), _moved_back(job, number)
        for index, identity in enumerate(tracer.movers):
            hit = hits.mover == index
            before[hit] = position[hit] @ back[identity][:3, :3].T + back[identity][:3, 3]
        features["previous_position"] = before
    return features


def _moved_back(job: FrameJob, number: int) -> dict[str, Array]:
    """For each moving object, the ``(4, 4)`` transform of its points to the previous frame."""
    # The first frame has no previous one; the transform to itself is the identity.
    earlier = max(number - 1, 0)
    still = {name: np.array_equal(moved[earlier], moved[number]) for name, moved in job.moves.items()}
    return {
        name: np.eye(4) if still[name] else moved[earlier] @ np.linalg.inv(moved[number])
        for name, moved in job.moves.items()
    }


def _color(
    job: FrameJob, tracer: Tracer, rays: PixelRays, seed: tuple[int, int, int], advance: Callable[[int], None]
) -> tuple[Array, list[Array]]:
    """The mean radiance of all paths and, if they are kept, the radiance of each path."""
    per_pass = 1 if job.keep_samples else min(job.spp, tracer.paths_per_pass(rays))
    total, samples = np.zeros_like(rays.directions), []
    for number, start in enumerate(range(0, job.spp, per_pass)):
        paths = min(per_pass, job.spp - start)
        radiance = tracer.radiance(rays, paths, (*seed, number))
        total += paths * radiance
        samples += [radiance] if job.keep_samples else []
        advance(paths)
    return total / job.spp, samples


def _refine_reference(
    job: FrameJob, trace: Callable[[int, Seed, bool], Array], number: int, advance: Callable[[int], None]
) -> ReferenceState:
    """Add passes to a reference until it is finished, and write it.

    ``trace`` returns the mean radiance of a number of paths per pixel for a seed, stratified or independent.
    """
    unfinished = job.folder / f"reference{number}.partial.npz"
    before = job.started.get(number, ReferenceState(0, 0, None))
    if unfinished.is_file():
        halves = ReferenceHalves.load(unfinished, job.size)
        advance(halves.spp - before.spp)
    else:
        mean = read_reference(job.folder, number) if before.spp else np.zeros((job.size[0] * job.size[1], 3))
        halves = ReferenceHalves.start(mean, before.spp, before.passes)
    saved = time.monotonic()
    while not job.is_good(halves.spp, _reliable_noise(halves)):
        missing = job.reference_spp - halves.spp
        stratified = missing >= (STRATIFIED_PATHS if halves.passes else 2 * STRATIFIED_PATHS)
        # Estimating the noise requires two passes.
        rest = missing if halves.passes else (missing + 1) // 2
        paths = STRATIFIED_PATHS if stratified else rest
        seed = (job.seed, number, 1, halves.passes)
        halves.add(trace(paths, seed, stratified), paths)
        advance(paths)
        if time.monotonic() - saved > _SECONDS_BETWEEN_SAVES:
            halves.save(unfinished)
            saved = time.monotonic()
    advance(max(0, job.reference_spp - halves.spp))
    state = ReferenceState(halves.spp, halves.passes, halves.noise())
    write_reference(job.folder, number, _image(np.maximum(halves.mean(), 0), job.size), state)
    unfinished.unlink(missing_ok=True)
    return state


def _reliable_noise(halves: ReferenceHalves) -> float | None:
    fewest = max(_FEWEST_PATHS_IN_A_HALF, _SMALLEST_HALF * halves.spp)
    return halves.noise() if min(halves.paths) >= fewest else None


def _image(values: Array, size: tuple[int, int]) -> torch.Tensor:
    width, height = size
    return torch.from_numpy(values.reshape(height, width, -1).astype(np.float32)).permute(2, 0, 1)[None]
