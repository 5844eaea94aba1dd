"""Frames rendered by the workers of an engine, each with a scene of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from mcdenoise.engines import Engine, Task, run_tasks
from mcdenoise.errors import InputError
from mcdenoise.scenes.render.folder import ReferenceState
from mcdenoise.scenes.render.frames import FrameJob, render_frame
from mcdenoise.scenes.render.processes import TracerSource
from mcdenoise.scenes.render.tracer import Tracer

# The last scene that this worker has loaded, by the folder of its frames: a folder has one scene.
_loaded: dict[Path, Tracer] = {}


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
    tasks = {f"frame {number}": number for number in numbers}
    failed = run_tasks(
        engine,
        [Task(name, render_frame_task, (source, job, number)) for name, number in tasks.items()],
        lambda task, state: on_frame(tasks[task.name], state),
    )
    if failed:
        name, reason = next(iter(failed.items()))
        others = f"; {len(failed) - 1} more frames failed" if len(failed) > 1 else ""
        raise InputError(f"{name}: {reason}{others}; finished frames are kept")


def render_frame_task(source: TracerSource, job: FrameJob, number: int) -> ReferenceState | None:
    """A task: render a frame, by the scene that this worker has loaded, if it is the same."""
    if job.folder not in _loaded:
        _loaded.clear()
        _loaded[job.folder] = source.tracer()
    return render_frame(job, _loaded[job.folder], number, lambda paths: None)
