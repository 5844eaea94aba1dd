"""Sequences to train on: which scenes are rendered, and how; a seed is a task that any machine can do."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcdenoise.scenes.cycles import Blender, render_cycles
from mcdenoise.scenes.random.takes import CLEANER, Sampling, Take, random_takes
from mcdenoise.scenes.render import render_sequence

_Progress = Callable[[int, int], None]


@dataclass(frozen=True, kw_only=True)
class Generation:
    """How the sequences of all seeds are rendered.

    Args:
        out: folder of the sequences; finished frames in it are kept.
        rendering: arguments of :func:`mcdenoise.scenes.render.render_sequence`.
        frames: of each sequence.
        wild: whether scenes are shiny, and samples drawn; see :func:`mcdenoise.scenes.random.takes.random_takes`.
        sampling: see :func:`mcdenoise.scenes.random.takes.random_takes`.
        stills: fraction of the seeds that give stills.
        cycles: whether Cycles renders them, else Mitsuba.
        cycles_spp: samples a pixel of Cycles; ``None`` draws them.
        parts: whether Cycles writes diffuse and specular light, too.
        threads: of Cycles; 0 for all processors.
    """

    out: Path
    rendering: Mapping[str, Any]
    frames: int
    wild: bool
    sampling: Sampling
    stills: float
    cycles: bool
    cycles_spp: int | None
    parts: bool
    threads: int

    def render(
        self, seed: int, blender: Blender | None = None, begin: Callable[[str], _Progress] = lambda name: _no_progress
    ) -> Iterator[Path]:
        """Render the sequences of a seed.

        Args:
            seed: of the scene.
            blender: the process that renders, for Cycles.
            begin: called with the name of each sequence; what it returns is called with the progress.

        Yields:
            The folder of each finished sequence.

        Raises:
            InputError: see :func:`mcdenoise.scenes.render.render_sequence` and
                :func:`mcdenoise.scenes.cycles.render_cycles`.
        """
        takes = random_takes(
            seed,
            self.frames,
            sampling=self.sampling,
            spp=None if self.wild else self.rendering["spp"],
            stills=self.stills,
            shiny=self.wild,
            width=max(self.rendering["size"][0], 1),
        )
        for take in takes:
            progress = begin(take.name)
            if blender is None:
                yield self._by_mitsuba(take, seed, progress)
            else:
                yield self._by_cycles(take, seed, blender, progress)

    def _by_cycles(self, take: Take, seed: int, blender: Blender, progress: _Progress) -> Path:
        return render_cycles(
            take.made,
            self.out / take.name,
            blender,
            size=self.rendering["size"],
            seed=seed,
            view=take.view,
            samples=self.cycles_spp,
            noise_seeds=self.rendering["noise_seeds"],
            reference_samples=self.rendering["reference_spp"] if self.rendering["reference_frames"] != [] else 0,
            parts=self.parts,
            threads=self.threads,
            progress=progress,
        )

    def _by_mitsuba(self, take: Take, seed: int, progress: _Progress) -> Path:
        reference_spp = max(self.rendering["reference_spp"], CLEANER * take.spp if self.wild else 0)
        return render_sequence(
            take.made.scene,
            take.made.cameras,
            self.out / take.name,
            seed=seed,
            moves=take.made.moves,
            film=take.film,
            progress=progress,
            **{**self.rendering, "spp": take.spp, "reference_spp": reference_spp},
        )


def render_seed(generation: Generation, seed: int) -> list[Path]:
    """A task: render the sequences of a seed, and name their folders.

    Raises:
        InputError: see :meth:`Generation.render`; or Blender is missing.
    """
    with ExitStack() as stack:
        blender = stack.enter_context(Blender()) if generation.cycles else None
        return list(generation.render(seed, blender))


def _no_progress(done: int, total: int) -> None:
    """Report nothing."""
