"""Sequences of the places that takes show, by Mitsuba or by Cycles."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcdenoise.data.files import write_text
from mcdenoise.scenes.cycles import Blender, render_cycles
from mcdenoise.scenes.render import render_sequence
from mcdenoise.scenes.takes import Plan

# Width of the images by which it is decided what a place shows, in pixels.
_PROBED = 32


@dataclass(frozen=True, kw_only=True)
class SequencePlan(Plan):
    """How sequences are rendered.

    Args:
        rendering: arguments of :func:`mcdenoise.scenes.render.render_sequence`, its variant among them.
        cycles: whether Cycles renders them, which has no use for workers and variant, else Mitsuba.
        parts: whether Cycles writes diffuse and specular light, too.
    """

    rendering: Mapping[str, Any]
    cycles: bool = False
    parts: bool = False

    def render(self, number: int, progress: Callable[[int, int], None] | None = None) -> Path:
        """Render the sequence of a number."""
        out, rendering = self.out / f"random{number:04d}", dict(self.rendering, seed=number, progress=progress)
        width, height = (max(side, 1) for side in rendering["size"])
        if self.cycles:
            # What a place shows is not decided, because that needs Mitsuba.
            take = next(self.draws(number, size=(width, height), stills=False))
            del rendering["workers"], rendering["variant"]
            with Blender() as blender:
                folder = render_cycles(take, out, blender, parts=self.parts, threads=self.threads, **rendering)
        else:
            # Clips that are sampled once at pixel centres, to see what they show.
            size = _PROBED, max(1, _PROBED * height // width)
            tracer, _ = self.first_worth(number, rendering["variant"], size=size, stills=False, plain=True)
            take = tracer.take
            tracer.release()
            folder = render_sequence(take.scene, take.cameras, out, moves=take.moves, **rendering)
        if take.credits:
            write_text(out / "credits.txt", "\n".join((*take.credits, "")))
        return folder
