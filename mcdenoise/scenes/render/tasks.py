"""Frames rendered by the workers of an engine, each of which loads the scene itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.reduction import ForkingPickler
from pathlib import Path

from mcdenoise.data.camera_path import Array
from mcdenoise.engines import Engine, Job, Task, run_jobs
from mcdenoise.errors import InputError
from mcdenoise.scenes.render.folder import ReferenceState
from mcdenoise.scenes.render.frames import FrameJob, render_frame
from mcdenoise.scenes.render.loading import Scene
from mcdenoise.scenes.render.tracer import Tracer

# The last scene that this worker has loaded, by the folder of its frames: a folder has one scene.
_loaded: dict[Path, Tracer] = {}


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


def render_on_engine(
    source: TracerSource,
    job: FrameJob,
    numbers: Sequence[int],
    engine: Engine,
    on_frame: Callable[[int, ReferenceState | None], None],
) -> None:
    """Render frames as :func:`mcdenoise.scenes.render.frames.render_frame` does; a frame is a task.

    Args:
        source: the scene.
        job: what all frames have in common.
        numbers: of the frames.
        engine: runs the tasks, and is closed at the end.
        on_frame: called with the number of each finished frame, and with how far its reference has come.

    Raises:
        InputError: frames failed; the message names the first of them, and all others are finished.
    """
    failed: list[str] = []

    def one(number: int) -> Job:
        [(state, reason)] = yield [Task(render_frame_task, (source, job, number))]
        if reason is None:
            on_frame(number, state)
        else:
            failed.append(f"frame {number}: {reason}")

    run_jobs(engine, map(one, numbers))
    if failed:
        others = f"; {len(failed) - 1} more frames failed" if len(failed) > 1 else ""
        raise InputError(f"{failed[0]}{others}; finished frames are kept")


def render_frame_task(source: TracerSource, job: FrameJob, number: int) -> ReferenceState | None:
    """A task: render a frame, by the scene that this worker has loaded, if it is the same."""
    if job.folder not in _loaded:
        _loaded.clear()
        _loaded[job.folder] = source.tracer()
    return render_frame(job, _loaded[job.folder], number, lambda paths: None)
