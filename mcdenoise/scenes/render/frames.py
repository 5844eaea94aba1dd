"""Rendering the missing files of one frame of a sequence, here or in a worker that loads the scene itself."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mcdenoise.data.camera_path import Array
from mcdenoise.data.exr import read_exr
from mcdenoise.data.readers.bmfr import CLEAN, has_buffers, noise_seed_folder, write_buffers
from mcdenoise.data.readers.files import as_tensor
from mcdenoise.data.readers.samples import FEATURES
from mcdenoise.scenes.render.features import STRATIFIED_PATHS, SequenceTracer
from mcdenoise.scenes.render.film import Film
from mcdenoise.scenes.render.folder import reference_file, reference_state, write_reference
from mcdenoise.scenes.render.halves import ReferenceHalves, ReferenceState

# With fewer paths, rare bright ones have not been hit yet, and the noise is underestimated.
_FEWEST_PATHS_IN_A_HALF = 16
_SMALLEST_HALF = 1 / 8
_SECONDS_BETWEEN_SAVES = 60.0
# Number of samples of a reference's features, and a seed number that its passes do not use.
_CLEAN_PATHS, _CLEAN_STREAM = 16, 2**20
# The last scene that this worker has loaded, by the folder of its frames: a folder has one scene.
_loaded: dict[Path, SequenceTracer] = {}


@dataclass(frozen=True, kw_only=True)
class FrameJob:
    """Settings common to all frames, those of :func:`mcdenoise.scenes.render.render_sequence`.

    Args:
        load: makes the tracer of the scene.
        folder: ``inputs`` of the sequence.
        references: frames that get a reference.
    """

    load: Callable[[], SequenceTracer]
    moves: dict[str, Array]
    size: tuple[int, int]
    film: Film | None
    folder: Path
    spp: int
    noise_seeds: int
    reference_spp: int
    noise_level: float | None
    references: frozenset[int]
    seed: int
    keep_samples: bool

    @property
    def features(self) -> tuple[str, ...]:
        """Names of everything but colors and reference."""
        return ("albedo", "normal", "position", "depth", *(["previous_position"] if self.moves else []))

    @property
    def noisy(self) -> tuple[str, ...]:
        """Names of what every noise seed has."""
        return ("color",) if self.film is None else ("color", *self.features)

    def has(self, number: int, noise_seed: int, names: tuple[str, ...]) -> bool:
        """Whether a frame has complete buffers of a noise seed."""
        return has_buffers(noise_seed_folder(self.folder, noise_seed), number, names, self.size)

    def reference(self, number: int) -> ReferenceState:
        """What there is of the reference of a frame."""
        return reference_state(reference_file(self.folder, number), self.size) or ReferenceState(0, 0, None)

    def wants_reference(self, number: int) -> bool:
        """Whether the reference of a frame is missing or unfinished."""
        state = self.reference(number)
        reliable = state.spp >= 2 * _FEWEST_PATHS_IN_A_HALF
        return number in self.references and not self.is_good(state.spp, state.noise if reliable else None)

    def is_good(self, spp: int, noise: float | None) -> bool:
        """Whether this number of paths, or this noise, is sufficient for a reference."""
        quiet = self.noise_level is not None and noise is not None and noise <= self.noise_level
        return spp >= self.reference_spp or quiet

    def paths_left(self, number: int) -> int:
        """Number of paths per pixel that a frame lacks."""
        colors = sum(not self.has(number, noise_seed, self.noisy) for noise_seed in range(self.noise_seeds))
        reference = self.reference_spp - self.reference(number).spp if self.wants_reference(number) else 0
        return colors * self.spp + reference


def render_frame_task(job: FrameJob, number: int) -> ReferenceState | None:
    """A task: :func:`render_frame` by the scene that this worker has loaded, if it is the same."""
    if job.folder not in _loaded:
        _loaded.clear()
        _loaded[job.folder] = job.load()
    return render_frame(job, _loaded[job.folder], number, lambda paths: None)


def render_frame(
    job: FrameJob, tracer: SequenceTracer, number: int, advance: Callable[[int], None]
) -> ReferenceState | None:
    """Write the missing files of a frame. The first color is last: a frame that has it is complete.

    On a film, every noise seed has the features of its own samples.

    Args:
        job: settings common to all frames.
        tracer: tracer of the scene.
        number: frame number.
        advance: called with the number of paths per pixel after each pass.

    Returns:
        Progress of its reference; ``None`` without one.

    Raises:
        InputError: a file cannot be written.
    """
    if job.film is None and not job.has(number, 0, job.features):
        found = tracer.features(number)
        write_buffers(job.folder, number, {name: _image(found[name], job.size) for name in job.features})
    if job.wants_reference(number):
        _refine_reference(job, tracer, number, advance)
        if job.film is not None:
            clean = tracer.frame(number, _CLEAN_PATHS, (job.seed, number, 1, _CLEAN_STREAM))
            images = {name: _image(clean[name], job.size) for name in ("albedo", "normal")}
            write_buffers(job.folder / CLEAN, number, images)
    for noise_seed in reversed(range(job.noise_seeds)):
        if not job.has(number, noise_seed, job.noisy):
            _render_noisy(job, tracer, number, noise_seed, advance)
    return reference_state(reference_file(job.folder, number), job.size)


def _render_noisy(
    job: FrameJob, tracer: SequenceTracer, number: int, noise_seed: int, advance: Callable[[int], None]
) -> None:
    """Write a noisy color, and on a film its features."""
    per_pass = 1 if job.keep_samples else min(job.spp, tracer.paths_per_pass)
    total: dict[str, Any] = {}
    kept: list[torch.Tensor] = []
    for index, start in enumerate(range(0, job.spp, per_pass)):
        paths = min(per_pass, job.spp - start)
        # The stream 1 belongs to the reference.
        seed = (job.seed, number, 1 + noise_seed if noise_seed else 0, index)
        found = tracer.frame(number, paths, seed)
        for name, values in found.items():
            total[name] = total.get(name, 0) + paths * values
        if job.keep_samples:
            names = [name for name in ("color", *FEATURES) if name in found]
            kept.append(torch.cat([_image(found[name], job.size) for name in names], 1))
        advance(paths)
    # The color is written last.
    images = {name: _image(total[name] / job.spp, job.size) for name in sorted(total, key="color".__eq__)}
    folder = noise_seed_folder(job.folder, noise_seed)
    write_buffers(folder, number, ({"samples": torch.stack(kept, 1)} if kept else {}) | images)


def _refine_reference(job: FrameJob, tracer: SequenceTracer, number: int, advance: Callable[[int], None]) -> None:
    """Add passes to a reference until it is finished, and write it."""
    halves = ReferenceHalves(np.zeros((job.size[0] * job.size[1], 3)))
    for unfinished in (True, False):
        path = reference_file(job.folder, number, unfinished=unfinished)
        if (before := reference_state(path, job.size)) is not None:
            halves = ReferenceHalves(read_exr(path)[0].reshape(-1, 3).astype(np.float64), before.spp, before.passes)
            break
    advance(halves.spp - job.reference(number).spp)
    saved = time.monotonic()
    while not job.is_good(halves.spp, _reliable_noise(halves)):
        missing = job.reference_spp - halves.spp
        stratified = missing >= (STRATIFIED_PATHS if halves.passes else 2 * STRATIFIED_PATHS)
        # Estimating the noise requires two passes.
        rest = missing if halves.passes else (missing + 1) // 2
        paths = STRATIFIED_PATHS if stratified else rest
        seed = (job.seed, number, 1, halves.passes)
        halves.add(tracer.radiance(number, paths, seed, stratified=stratified), paths)
        advance(paths)
        if time.monotonic() - saved > _SECONDS_BETWEEN_SAVES:
            write_reference(job.folder, number, _image(halves.mean(), job.size), halves.state, unfinished=True)
            saved = time.monotonic()
    advance(max(0, job.reference_spp - halves.spp))
    write_reference(job.folder, number, _image(halves.mean(), job.size), halves.state)
    reference_file(job.folder, number, unfinished=True).unlink(missing_ok=True)


def _reliable_noise(halves: ReferenceHalves) -> float | None:
    fewest = max(_FEWEST_PATHS_IN_A_HALF, _SMALLEST_HALF * halves.spp)
    return halves.noise() if min(halves.paths) >= fewest else None


def _image(values: Array, size: tuple[int, int]) -> torch.Tensor:
    width, height = size
    return as_tensor(values.reshape(height, width, -1).astype(np.float32))
