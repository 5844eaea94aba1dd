"""How a shot is denoised: the settings that `mcdenoise denoise` has as options, and each shot of a film."""

from __future__ import annotations

from collections.abc import Callable
from collections.abc import Sequence as Sequential
from dataclasses import dataclass, replace
from pathlib import Path

from mcdenoise.data import Sequence, open_sequence
from mcdenoise.denoiser import AskedPrecision, Denoiser
from mcdenoise.errors import InputError
from mcdenoise.methods import Spelling, parse_method
from mcdenoise.models import DEFAULT, describe_weights

# With very many threads torch does not fail but crashes.
_MOST_THREADS = 1024


@dataclass(frozen=True)
class ShotSettings:
    """How a shot is read, denoised and written.

    Args:
        model: a name, see `mcdenoise models`, with settings if need be, such as "oidn(quality=fast)"; a weights file;
            or a model of your own, path/to/file.py:factory or package.module:factory. By default cascaded_v2, or the
            model that the weights are of.
        weights: safetensors file of your own weights for that model.
        frames: frames to denoise, such as 0-59,70; all by default.
        device: where the model runs, cpu or cuda.
        threads: CPU threads; torch's choice by default.
        precision: precision of the network's convolutions; auto takes bfloat16 where the processor has it and it is
            faster, which is measured once on each machine; int8 is for models that are calibrated for it, see
            `mcdenoise calibrate`.
        map: the layer to read a buffer from where names do not tell, such as albedo=RGBA.diff; 'motion=' reads none.
        color_without_albedo: the noisy color was divided by the albedo, which is multiplied back.
        color_with_albedo: the noisy color has the albedo in it. By default its values decide, and where they tell
            nothing, the color is taken to have it.
        output_layer: add the result as a layer of this name, and replace nothing.
        layers: layers of light to denoise with it, by the same kernels, so that they still add up: names such as
            DiffDir or Combined_*, or all.
        alpha: denoise the alpha too, by the same kernels; else it stays as it was.
        alpha_min: smallest weight of the current frame in the accumulation, in (0, 1]; the model's own by default.
        anti_lag: give up the history where the light has changed.
        full_float: write the result as 32-bit floats, even where it was stored as half floats.
        keep_all: skip nothing, whether the sequence needs it or not.
        tolerance: noise, or change, relative to the mean of a tile, below which a tile of a still shot is skipped;
            0 skips only tiles whose image stays the same.
        tile: run the network on tiles of at most so many pixels a side, a multiple of 32 from 64 on; the result is that
            of whole frames, to rounding. By default, frames are tiled where the network's features would take more than
            2 GB.
        max_memory: maximum memory of this process in GB; it decides the tiles, and whether the next frame is read
            meanwhile.
        budget_ms: take the shipped model and precision with the smallest error (or, where no error is known, the
            slowest) that need at most so many milliseconds a frame on this machine, measured once and without files.
        max_error: take the fastest model and precision whose SMAPE is at most this.
        results: folder of a finished benchmark to take errors from; those of the sequence's references by default.
        preview: write a PNG of each file to OUT/preview too, on the sRGB curve, and OUT/preview.mp4 of several frames.
        preview_fps: frames per second of that video.
        preview_exposure: exposure of the previews in stops; by default the first frame decides for all: its typical
            radiance is middle grey.
    """

    model: str | None = None
    weights: Path | None = None
    frames: str | None = None
    device: str = "cpu"
    threads: int | None = None
    precision: AskedPrecision = "auto"
    map: tuple[str, ...] = ()
    color_without_albedo: bool = False
    color_with_albedo: bool = False
    output_layer: str | None = None
    layers: tuple[str, ...] = ()
    alpha: bool = False
    alpha_min: float | None = None
    anti_lag: bool = True
    full_float: bool = False
    keep_all: bool = False
    tolerance: float | None = None
    tile: int | None = None
    max_memory: float | None = None
    budget_ms: float | None = None
    max_error: float | None = None
    results: Path | None = None
    preview: bool = False
    preview_fps: float = 24.0
    preview_exposure: float | None = None

    def check(self) -> None:
        """See that the settings agree with one another; what they say of files is seen when those are opened.

        Raises:
            InputError: they do not, or one is out of its range.
        """
        if self.threads is not None:
            check_threads(self.threads)
        if self.alpha_min is not None and not 0 < self.alpha_min <= 1:
            raise InputError(f"--alpha-min: expected in (0, 1], found {self.alpha_min}")
        if not self.preview and (self.preview_fps != 24.0 or self.preview_exposure is not None):
            raise InputError("--preview-fps, --preview-exposure: expected together with --preview")
        if self.color_with_albedo and self.color_without_albedo:
            raise InputError("--color-with-albedo, --color-without-albedo: expected one of them, found both")
        if self.is_budgeted and (self.weights is not None or self.model is not None):
            raise InputError("--budget-ms, --max-error: expected no --model or --weights: they choose it")

    @property
    def is_budgeted(self) -> bool:
        """Whether a measurement chooses the model."""
        return self.budget_ms is not None or self.max_error is not None

    def open(self, inputs: Sequential[Path]) -> Sequence:
        """Open the frames.

        Args:
            inputs: folders, files or patterns.

        Raises:
            InputError: see :func:`mcdenoise.data.open_sequence`; or the frames have not what is asked for.
        """
        self.check()
        stated = self.color_with_albedo if self.color_with_albedo or self.color_without_albedo else None
        opened = open_sequence(inputs, self.frames, mapping=self.map, color_has_albedo=stated, lights=self.layers)
        if self.output_layer is not None:
            opened.check_output_layer(self.output_layer)
        if self.alpha and "alpha" not in opened.buffers:
            raise InputError(
                f"--alpha: expected an alpha to denoise, found none in {opened.root}; leave the option out"
            )
        return opened

    def chosen(
        self, sequence: Sequence, on_step: Callable[[int, int], None] = lambda done, total: None
    ) -> tuple[ShotSettings, str]:
        """The same settings with the model that ``budget_ms`` or ``max_error`` chooses, and that in words.

        Args:
            sequence: the frames.
            on_step: called with how many models have been measured, and of how many.

        Raises:
            InputError: no model is that fast, or that good.
        """
        if not self.is_budgeted:
            return self, ""
        # Here because it brings the benchmark, which takes its time to load.
        from mcdenoise.budget import choose_model

        choice = choose_model(
            sequence,
            budget=self.budget_ms,
            max_error=self.max_error,
            results=self.results,
            device=self.device,
            on_step=on_step,
        )
        found = replace(self, model=choice.model, precision=choice.precision, budget_ms=None, max_error=None)
        return found, str(choice)

    @property
    def spelling(self) -> Spelling:
        """The model that is asked for, or that the weights are of, or the default.

        Raises:
            InputError: there is no such model, or its weights cannot be read.
        """
        if self.weights is None:
            return parse_method(self.model or DEFAULT)
        if self.model is None:
            return Spelling(str(describe_weights(self.weights)["architecture"]), self.weights)
        return replace(parse_method(self.model), weights=self.weights)

    def denoiser(self) -> Denoiser:
        """A denoiser with these settings.

        Raises:
            InputError: see :class:`mcdenoise.denoiser.Denoiser`.
        """
        # What is not asked for is not passed on: a model of another kind has no such setting.
        asked = {
            "alpha_min": self.alpha_min,
            "anti_lag": None if self.anti_lag else False,
            "tolerance": self.tolerance,
        }
        return self.spelling.denoiser(
            device=self.device,
            precision=self.precision,
            keep_all=self.keep_all,
            tile=self.tile,
            max_memory=self.max_memory,
            alpha=self.alpha,
            **{name: value for name, value in asked.items() if value is not None},
        )


def check_threads(threads: int) -> None:
    """See that torch can have so many threads.

    Raises:
        InputError: it cannot.
    """
    if not 1 <= threads <= _MOST_THREADS:
        raise InputError(f"--threads: expected 1 to {_MOST_THREADS}, found {threads}")
