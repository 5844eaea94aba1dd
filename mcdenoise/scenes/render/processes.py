"""Rendering frames in several processes, each of which loads the scene itself."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.reduction import ForkingPickler
from multiprocessing.sharedctypes import Synchronized
from multiprocessing.synchronize import Event

from mcdenoise.data.camera_path import Array
from mcdenoise.errors import InputError
from mcdenoise.interruption import deaf_children, prepare_worker, start_resource_tracker
from mcdenoise.scenes.render.folder import ReferenceState
from mcdenoise.scenes.render.frames import FrameJob, render_frame
from mcdenoise.scenes.render.tracer import Scene, Tracer

_SECONDS_BETWEEN_LOOKS = 0.2
# Time in seconds for an interrupted process to finish writing and exit.
_SECONDS_TO_END = 0.4


@dataclass(frozen=True)
class TracerSource:
    """The arguments of :class:`mcdenoise.scenes.render.tracer.Tracer`, for another process."""

    scene: Scene
    variant: str
    max_depth: int
    moves: dict[str, Array]

    def tracer(self) -> Tracer:
        """Load the scene."""
        return Tracer(self.scene, self.variant, self.max_depth, self.moves)

    def check_portable(self) -> None:
        """Check that it can be sent to other processes.

        Raises:
            InputError: a scene dictionary contains an object that cannot be sent.
        """
        try:
            ForkingPickler.dumps(self)
        except Exception as error:  # a third-party object may raise anything
            raise InputError(
                f"scene dictionary: expected plain Python and numpy for more than one worker, found {error}"
            ) from error


class _Stopped(Exception):
    """Raised to stop a frame because another frame failed or the run was interrupted."""


@dataclass
class _Process:
    """State of a worker process between frames."""

    source: TracerSource
    job: FrameJob
    paths: Synchronized[int]
    stop: Event
    tracer: Tracer | None = None


_process: _Process | None = None


def _start_process(source: TracerSource, job: FrameJob, paths: Synchronized[int], stop: Event) -> None:
    global _process
    prepare_worker()
    _process = _Process(source, job, paths, stop)


def _render_frame_in_process(number: int) -> ReferenceState | None:
    process = _process
    if process is None:
        raise RuntimeError("a worker process was not initialised")

    def advance(paths: int) -> None:
        with process.paths.get_lock():
            process.paths.value += paths
        if process.stop.is_set():
            raise _Stopped

    if process.tracer is None:
        process.tracer = process.source.tracer()
    return render_frame(process.job, process.tracer, number, advance)


def render_in_processes(
    source: TracerSource,
    job: FrameJob,
    numbers: Sequence[int],
    workers: int,
    advance: Callable[[int], None],
    on_reference: Callable[[int, ReferenceState], None],
) -> None:
    """Render several frames at a time with :func:`mcdenoise.scenes.render.frames.render_frame`.

    Args:
        source: the scene.
        job: settings common to all frames.
        numbers: frame numbers.
        workers: number of processes.
        advance: called with the number of paths per pixel traced since the last call.
        on_reference: called with the number of each finished frame whose reference was created or refined.

    Raises:
        InputError: see ``render_frame``; or a process died.
    """
    # Spawn new interpreters, because Mitsuba's threads and GPU state do not survive a fork.
    context = multiprocessing.get_context("spawn")
    start_resource_tracker()
    paths, stop = context.Value("q", 0), context.Event()
    seen = 0
    start = (source, job, paths, stop)
    if not numbers:
        return
    others = set(multiprocessing.active_children())
    with ProcessPoolExecutor(min(workers, len(numbers)), context, _start_process, start) as pool:
        try:
            with deaf_children():
                waiting: dict[Future[ReferenceState | None], int] = {
                    pool.submit(_render_frame_in_process, number): number for number in numbers
                }
            while waiting:
                finished, _ = wait(waiting, _SECONDS_BETWEEN_LOOKS, FIRST_COMPLETED)
                traced = paths.value
                if traced > seen:
                    advance(traced - seen)
                    seen = traced
                for future in finished:
                    number, state = waiting.pop(future), future.result()
                    if state is not None:
                        on_reference(number, state)
        except BrokenProcessPool as error:
            raise InputError(
                "a worker process ended without a word, perhaps for lack of memory; finished frames are kept: "
                "run again with fewer workers"
            ) from error
        except KeyboardInterrupt:
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)
            # Do not wait for a process that is loading a scene or tracing many paths.
            for child in set(multiprocessing.active_children()) - others:
                child.join(_SECONDS_TO_END / workers)
                child.kill()
            raise
        finally:
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)
