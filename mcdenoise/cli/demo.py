"""`mcdenoise demo`."""

from __future__ import annotations

from pathlib import Path

from mcdenoise.benchmark.tables import scene_rows
from mcdenoise.cli._options import Out
from mcdenoise.cli._output import print_rows, print_times, progress_bar, say
from mcdenoise.demo import FRAMES, run_demo
from mcdenoise.heap import keep_heap
from mcdenoise.models import DEFAULT


def demo(out: Out = Path("demo"), model: str = DEFAULT) -> None:
    """Render 10 frames of a small scene at one sample per pixel, denoise them, and print errors and run times.

    Then compare the error and the run time of several models, filters and installed denoisers in a report.

    Args:
        out: folder to write to; frames that an earlier run rendered there are reused.
        model: a name with optional settings, a weights file, or file.py:factory, as for `mcdenoise denoise`.
    """
    keep_heap()
    with progress_bar() as progress:
        rendering = progress.add_task("render", total=None)
        denoising = progress.add_task("denoise", total=FRAMES)
        comparing = progress.add_task("compare", total=None)
        results, report = run_demo(
            out,
            model=model,
            on_render=lambda done, total: progress.update(rendering, completed=done, total=total),
            on_frame=lambda: progress.advance(denoising),
            on_compare=lambda done, total: progress.update(comparing, completed=done, total=total),
        )
    print_rows(scene_rows(results))
    print_times(report.milliseconds)
    for what, path in {"clean frames": "denoised", "picture": "demo.png", "report": "report/index.html"}.items():
        say(f"{what}: {out / path}")
