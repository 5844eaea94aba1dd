"""Rendering a sequence: checks settings, finds missing files, and distributes the frames.

By default all samples are at the pixel centre: features, noisy colour and reference. The expectation of the colour is
then the reference, and demodulation is consistent. Alternatively everything is sampled as Mitsuba does it, see
:class:`mcdenoise.scenes.render.film.Film`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from multiprocessing.reduction import ForkingPickler
from pathlib import Path

import numpy as np

from mcdenoise.data.camera_path import Array, Camera, check_moves
from mcdenoise.engines import Engine, LocalEngine, run_each
from mcdenoise.errors import InputError
from mcdenoise.scenes.render.features import RR_DEPTH, STRATIFIED_PATHS, SequenceTracer
from mcdenoise.scenes.render.film import Film
from mcdenoise.scenes.render.folder import BY_MITSUBA, ON_A_FILM, SequenceFolder
from mcdenoise.scenes.render.frames import FrameJob, render_frame, render_frame_task
from mcdenoise.scenes.render.halves import ReferenceState
from mcdenoise.scenes.render.loading import Scene, choose_variant

_LARGEST_SIDE = 16384


def render_sequence(
    scene: Scene,
    cameras: Sequence[Camera],
    out: Path,
    *,
    size: tuple[int, int] = (640, 360),
    frames: int | None = None,
    spp: int = 1,
    noise_seeds: int = 1,
    reference_spp: int = 512,
    noise_level: float | None = None,
    reference_frames: Collection[int] | None = None,
    moves: Mapping[str, Array] | None = None,
    seed: int = 0,
    max_depth: int = 8,
    workers: int = 1,
    variant: str | None = None,
    film: Film | None = None,
    keep_samples: bool = False,
    engine: Engine | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Render a sequence in the BMFR layout.

    Existing files are kept, so an interrupted run can be resumed, and noise seeds, frames and better references can be
    added later: a reference with fewer paths or more noise than requested is refined by further passes with other
    seeds, starting from the half floats of its file, whose rounding error (0.02 %) is far below its noise. An
    unfinished reference is saved once a minute, as the hidden ``.referenceN.exr``.

    Args:
        scene: a Mitsuba ``scene.xml``, or a Mitsuba dictionary. In a dictionary, numpy arrays may stand for transforms
            (shape ``(4, 4)``) and for bitmaps (shape ``(H, W, C)``). Its sensors and integrators are not used.
        cameras: one camera per frame.
        out: the folder of the sequence; the files go to ``out/inputs``.
        size: width and height in pixels.
        frames: number of cameras to render, from the first; all by default.
        spp: paths per pixel of the noisy colour.
        noise_seeds: number of noise seeds, that is, of independent noisy colours per frame. Those after the first are
            written to ``out/inputs/noise_seed{1,2,...}``.
        reference_spp: paths per pixel of the references, 0 for none; with ``noise_level`` the maximum.
        noise_level: a reference is finished early when its estimated SMAPE against the truth is this small; see
            :class:`mcdenoise.scenes.render.halves.ReferenceHalves`. ``camera.json`` records the noise of each frame.
        reference_frames: numbers of the frames that get a reference; all by default.
        moves: for each moving object of the scene, by id, ``(T, 4, 4)``: one world-space transform per camera, applied
            after the scene has placed the object. Frames of a scene with moves have a ``previous_position``.
        seed: every (seed, frame, noise seed) has its own, reproducible noise.
        max_depth: maximum path length, in segments.
        workers: number of processes that render frames in parallel, each with its own copy of the scene; the files do
            not depend on it. It helps with ``scalar_rgb``; the other variants use all processors anyway. A script that
            passes more than one must protect its main part by ``if __name__ == "__main__":``.
        variant: one of ``VARIANTS``; by default the one Mitsuba is already set to, else ``cuda_ad_rgb`` or
            ``llvm_ad_rgb`` where they work, else ``scalar_rgb``.
        film: filter and lens of jittered samples, as in Mitsuba's own renderer: noisy colours and references then have
            noisy features of the same samples, for every noise seed its own. By default all samples are at the pixel
            centre.
        keep_samples: also write the single paths of each noisy colour, as layers of ``samplesN.exr``; on a film with
            the features of each path.
        engine: renders the frames instead of processes of this machine, such as a
            :class:`mcdenoise.engines.RayEngine`; it is closed at the end. With it, or with workers, progress advances
            frame by frame.
        progress: called with the finished and the total number of paths per pixel, summed over all frames. A reference
            that reaches the noise level early counts as complete.

    Returns:
        The folder of the files, ``out/inputs``.

    Raises:
        InputError: Mitsuba is missing, the scene cannot be loaded, a setting is invalid, a moving object does not
            exist, a frame failed, or ``out`` cannot be written or holds a sequence with other settings.
    """
    cameras = list(cameras)
    checked_moves = check_moves(moves or {}, len(cameras))
    count = len(cameras) if frames is None else min(frames, len(cameras))
    references = wanted_references(count, reference_spp, reference_frames)
    _check_settings(size, count, noise_level)
    check_lowest(1, spp=spp, noise_seeds=noise_seeds, max_depth=max_depth, workers=workers)
    check_lowest(0, seed=seed, reference_spp=reference_spp)
    variant = choose_variant(variant)
    if workers > 1 and engine is None:
        engine = LocalEngine(workers)
    if engine is not None:
        try:
            ForkingPickler.dumps(scene)
        except Exception as error:  # a third-party object may raise anything
            raise InputError(
                f"scene dictionary: expected plain Python and numpy for more than one worker, found {error}"
            ) from error
    load = partial(SequenceTracer, scene, variant, checked_moves, cameras, size, film, max_depth)
    tracer = load()
    away = tracer.features(0)["position"] - cameras[0].to_world[:3, 3]
    scale = float(np.median(np.linalg.norm(away, axis=1)))
    folder = SequenceFolder(
        Path(out),
        scene,
        cameras[:count],
        size,
        (0.01 * scale, 2 * tracer.reach),
        checked_moves,
        BY_MITSUBA | (ON_A_FILM if film is not None else {}),
        renderer=tracer.name,
        noisy_spp=spp,
        film=None if film is None else asdict(film),
        # Omitted if unused, as in folders of versions without this setting.
        samples_kept=True if keep_samples else None,
        noise_seeds=noise_seeds,
        max_depth=max_depth,
        rr_depth=RR_DEPTH,
        seed=seed,
        reference_sampling=f"passes of {STRATIFIED_PATHS} multi-jittered paths, a smaller rest of independent ones",
        background=f"no hit: albedo and normal are 0, world_position is {tracer.reach:g} units along the ray",
        position_limit_squared=(0.02 * scale) ** 2,
    )
    job = FrameJob(
        load=load,
        moves=checked_moves,
        size=size,
        film=film,
        folder=folder.path,
        spp=spp,
        noise_seeds=noise_seeds,
        reference_spp=reference_spp,
        noise_level=noise_level,
        references=references,
        seed=seed,
        keep_samples=keep_samples,
    )

    total = count * noise_seeds * spp + len(references) * reference_spp
    left = [job.paths_left(number) for number in range(count)]
    done = total - sum(left)

    def advance(paths: int) -> None:
        nonlocal done
        done += paths
        if progress is not None:
            progress(min(done, total), total)

    advance(0)
    missing = [number for number in range(count) if left[number] or not job.has(number, 0, job.features)]
    if engine is None:
        for number in missing:
            folder.note_reference(number, render_frame(job, tracer, number, advance))
        return folder.path

    def finish(call: tuple[FrameJob, int], state: ReferenceState | None) -> None:
        advance(left[call[1]])
        folder.note_reference(call[1], state)

    failed = run_each(engine, render_frame_task, [(job, number) for number in missing], finish)
    if failed:
        (_, number), reason = failed[0]
        others = f"; {len(failed) - 1} more frames failed" if len(failed) > 1 else ""
        raise InputError(f"frame {number}: {reason}{others}; finished frames are kept")
    return folder.path


def wanted_references(count: int, reference_spp: int, numbers: Collection[int] | None) -> frozenset[int]:
    """The frames that get a reference, see :func:`render_sequence`.

    Raises:
        InputError: one of the numbers is not that of a frame.
    """
    references = frozenset(() if not reference_spp else range(count) if numbers is None else numbers)
    if outside := sorted(number for number in references if not 0 <= number < count):
        raise InputError(f"reference frames: expected numbers from 0 to {count - 1}, found {outside[0]}")
    return references


def _check_settings(size: tuple[int, int], count: int, noise_level: float | None) -> None:
    if count < 1:
        raise InputError("expected at least one camera and one frame to render, found none")
    if not all(isinstance(side, int) and 1 <= side <= _LARGEST_SIDE for side in size):
        raise InputError(
            f"size: expected width and height between 1 and {_LARGEST_SIDE} pixels, found {size[0]}x{size[1]}"
        )
    if noise_level is not None and not 0 < noise_level < 1:
        raise InputError(f"noise_level: expected more than 0 and less than 1, found {noise_level:g}")


def check_lowest(lowest: int, **settings: int) -> None:
    """Check that each setting has at least a value."""
    for name, value in settings.items():
        if value < lowest:
            raise InputError(f"{name}: expected at least {lowest}, found {value}")
