"""Frames rendered side by side by several processes, each with a scene of its own."""

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
# Which an interrupted process has to end by itself, with what it is just writing.
_SECONDS_TO_END = 0.4


@dataclass(frozen=True)
class TracerSource:
    """What a process needs to trace rays: the arguments of :class:`mcdenoise.scenes.render.tracer.Tracer`."""

    scene: Scene
    variant: str
    max_depth: int
    moves: dict[str, Array]

    def tracer(self) -> Tracer:
        """Load the scene."""
        return Tracer(self.scene, self.variant, self.max_depth, self.moves)

    def check_portable(self) -> None:
        """Make sure that other processes can have it.

        Raises:
            InputError: a scene dictionary holds something that only this process knows.
        """
        try:
            ForkingPickler.dumps(self)
        except Exception as error:  # whatever an object of somebody else's refuses with
            raise InputError(
                f"scene dictionary: expected plain Python and numpy for more than one worker, found {error}"
            ) from error


class _Stopped(Exception):
    """Another frame failed or the run was interrupted: this one is given up."""


@dataclass
class _Process:
    """What a worker process keeps from frame to frame."""

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
    """Render frames as :func:`mcdenoise.scenes.render.frames.render_frame` does, several at a time.

    Args:
        source: the scene.
        job: what all frames have in common.
        numbers: which frames.
        workers: how many processes.
        advance: called with the number of paths per pixel that were traced since the last call.
        on_reference: called with the number of each finished frame that has got or refined a reference.

    Raises:
        InputError: as ``render_frame``, or a process died.
    """
    # A fresh interpreter each: Mitsuba's threads and what it holds on a GPU do not survive a fork.
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
            # One that loads a scene, or traces many paths at once, would be waited for.
            for child in set(multiprocessing.active_children()) - others:
                child.join(_SECONDS_TO_END / workers)
                child.kill()
            raise
        finally:
            stop.set()
            pool.shutdown(wait=False, cancel_futures=True)
