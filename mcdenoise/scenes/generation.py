"""Sequences of the places that takes show, by Mitsuba or by Cycles; a number is a task that any machine can do."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcdenoise.data.files import write_text
from mcdenoise.scenes.assets import Assets
from mcdenoise.scenes.cycles import Blender, render_cycles
from mcdenoise.scenes.render import choose_variant, render_sequence
from mcdenoise.scenes.takes import ATTEMPTS, first_worth
from mcdenoise.scenes.takes.draw import Take, draw_take
from mcdenoise.scenes.takes.tracing import TakeTracer

# Width of the images by which it is decided what a place shows, in pixels.
_PROBED = 32


@dataclass(frozen=True, kw_only=True)
class SequencePlan:
    """How sequences are rendered.

    Args:
        out: folder of the sequences; finished frames in it are kept.
        assets: what scenes are made of.
        unseen: whether only from the tenth of the assets that is never trained on.
        frames: of each sequence.
        rendering: arguments of :func:`mcdenoise.scenes.render.render_sequence`.
        cycles: whether Cycles renders them, else Mitsuba.
        parts: whether Cycles writes diffuse and specular light, too.
        threads: of Cycles; 0 for all processors.
    """

    out: Path
    assets: Assets
    unseen: bool
    frames: int
    rendering: Mapping[str, Any]
    cycles: bool = False
    parts: bool = False
    threads: int = 0

    def render(self, number: int, progress: Callable[[int, int], None] | None = None) -> Path:
        """Render the sequence of a number.

        Args:
            number: of the place, and seed of the noise.
            progress: called with the finished and the total number of samples per pixel.

        Returns:
            The folder of its files.

        Raises:
            InputError: see :func:`mcdenoise.scenes.render.render_sequence` and
                :func:`mcdenoise.scenes.cycles.render_cycles`; or Blender is missing.
        """
        out = self.out / f"random{number:04d}"
        if self.cycles:
            # What a place shows is not decided, because that needs Mitsuba.
            take, rendering = next(self._draws(number)), self.rendering
            with Blender() as blender:
                folder = render_cycles(
                    take,
                    out,
                    blender,
                    size=rendering["size"],
                    seed=number,
                    samples=rendering["spp"],
                    noise_seeds=rendering["noise_seeds"],
                    reference_samples=rendering["reference_spp"] if rendering["reference_frames"] != [] else 0,
                    parts=self.parts,
                    threads=self.threads,
                    progress=progress,
                )
        else:
            rendering = {**self.rendering, "variant": choose_variant(self.rendering["variant"])}
            take, tracer, _ = first_worth(
                self._draws(number), lambda take: TakeTracer(take, rendering["variant"], self.threads)
            )
            tracer.release()
            folder = render_sequence(
                take.scene, take.cameras, out, moves=take.moves, seed=number, progress=progress, **rendering
            )
        if take.credits:
            write_text(out / "credits.txt", "\n".join((*take.credits, "")))
        return folder

    def _draws(self, number: int) -> Iterator[Take]:
        """Clips of the number's places, sampled once at pixel centres to see what they show."""
        width, height = (max(side, 1) for side in self.rendering["size"])
        size = (width, height) if self.cycles else (_PROBED, max(1, _PROBED * height // width))
        assets = self.assets.part(self.unseen)
        for attempt in range(ATTEMPTS):
            plain = not self.cycles
            yield draw_take(number, assets, attempt, frames=self.frames, size=size, stills=False, plain=plain)
