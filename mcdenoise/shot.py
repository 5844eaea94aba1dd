"""The settings for denoising a shot: the options of `mcdenoise denoise`, and of each shot of a film."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from collections.abc import Sequence as Sequential
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from mcdenoise.data import Sequence, open_sequence
from mcdenoise.denoiser import AskedPrecision, Denoiser
from mcdenoise.errors import InputError
from mcdenoise.methods import Spelling, parse_method
from mcdenoise.models import DEFAULT
from mcdenoise.models._weights import model_of

if TYPE_CHECKING:
    from mcdenoise.preview import Preview

# With very many threads torch crashes instead of raising an error.
_MOST_THREADS = 1024


@dataclass(frozen=True)
class ShotSettings:
    """The settings for reading, denoising and writing a shot.

    Args:
        model: a name from `mcdenoise models`, optionally with settings, such as "oidn(quality=fast)"; a weights file;
            or your own model, path/to/file.py:factory or package.module:factory. The default is the model that the
            weights are for, or else wild.
        weights: safetensors file of your own weights for that model.
        frames: frames to denoise, such as 0-59,70; all by default.
        device: where the model runs, cpu or cuda.
        threads: CPU threads; torch's choice by default.
        precision: precision of the network's convolutions; auto chooses bfloat16 if the processor supports it and it is
            faster, which is measured once per machine.
        map: the layer to read a buffer from if names do not tell, such as albedo=RGBA.diff; 'motion=' reads none.
        color_without_albedo: the noisy color was divided by the albedo, and has to be multiplied by it.
        color_with_albedo: the noisy color includes the albedo. By default this is determined from the values; if they
            do not tell, the color is assumed to include it.
        input_linear: the numbers of TIFF and PNG files are linear radiance. By default the files say so (ICC profile,
            gamma, color space), or else 8 and 16 bits are sRGB. The result is written as it was read.
        output_layer: add the result as a layer of this name, and replace nothing.
        layers: layers of light to denoise with the same kernels as the color, so that they still add up: names or
            patterns, separated by spaces, such as DiffDir DiffInd or Combined_*; or all, those that add up to it.
        alpha: also denoise the alpha, so that the color stays a pair with it; otherwise it is not changed, unless the
            color is not multiplied by it, as in a PNG.
        wrap: the frames are panoramas of 360 degrees, whose left and right borders are one; cameras are not used.
        alpha_min: smallest weight of the current frame in the accumulation, in (0, 1]; the model's own by default.
        anti_lag: discard history where the light has changed.
        full_float: write the result as 32-bit floats, even where it was stored as half floats.
        keep_all: skip nothing, even if the sequence does not need it.
        tolerance: noise or change relative to the mean of a tile, below which a tile of a still shot is skipped; 0
            skips only tiles whose image does not change.
        tile: largest side of a tile in pixels, a multiple of 32 that is at least 64; the result is that of whole
            frames, up to rounding. By default, frames are tiled if the network's features would take more than 2 GB.
        max_memory: maximum memory of this process in GB; it determines the size of tiles, and whether the next frame is
            read ahead.
        budget_ms: choose the shipped model and precision with the smallest error (or, if no errors are known, the
            slowest) that need at most this many milliseconds per frame on this machine, measured once and without
            files.
        max_error: choose the fastest model and precision whose SMAPE is at most this.
        results: folder of a finished benchmark to take errors from; by default they are measured on the sequence's
            references.
        preview: also write a PNG of each file to OUT/preview, on the sRGB curve, and OUT/preview.mp4 of several frames.
        preview_fps: frames per second of that video.
        preview_exposure: exposure of the previews in stops; by default the typical radiance of the first frame becomes
            middle grey.
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
    input_linear: bool = False
    output_layer: str | None = None
    layers: tuple[str, ...] = ()
    alpha: bool = False
    wrap: bool = False
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
        """Check that the settings agree with one another; those that depend on files are checked when these are opened.

        Raises:
            InputError: settings contradict one another, or one is out of its range.
        """
        if self.threads is not None:
            check_threads(self.threads)
        if self.alpha_min is not None and not 0 < self.alpha_min <= 1:
            raise InputError(f"--alpha-min: expected in (0, 1], found {self.alpha_min}")
        if not self.preview and (self.preview_fps != 24.0 or self.preview_exposure is not None):
            raise InputError("--preview-fps, --preview-exposure: expected together with --preview")
        if self.preview:
            # A single frame gets no video, so that the usual rate is not looked at.
            self.preview_in(Path(), video=self.preview_fps != 24.0)
        for name, limit in (("budget-ms", self.budget_ms), ("max-error", self.max_error)):
            if limit is not None and not 0 < limit < math.inf:
                raise InputError(f"--{name}: expected a number above 0, found {limit:g}")
        if self.color_with_albedo and self.color_without_albedo:
            raise InputError("--color-with-albedo, --color-without-albedo: expected one of them, found both")
        if self.output_layer is not None and (self.alpha or self.layers):
            found = "--alpha" if self.alpha else "--layers"
            raise InputError(f"--output-layer: expected no option that replaces layers, found {found}; omit one")
        if self.is_budgeted and (self.weights is not None or self.model is not None):
            raise InputError("--budget-ms, --max-error: expected no --model or --weights: they choose it")

    def preview_in(self, folder: Path, *, video: bool) -> Preview:
        """The preview that these settings ask for, see :class:`mcdenoise.preview.Preview`."""
        # Imported here because it loads kornia, which denoising does not need.
        from mcdenoise.preview import Preview

        return Preview(folder, video=video, frames_per_second=self.preview_fps, exposure=self.preview_exposure)

    @property
    def is_budgeted(self) -> bool:
        """Whether a measurement chooses the model."""
        return self.budget_ms is not None or self.max_error is not None

    def open(self, inputs: Sequential[Path] | Mapping[str, Path]) -> Sequence:
        """Open the frames.

        Args:
            inputs: folders, files or patterns; or the file of each buffer of one frame.

        Raises:
            InputError: see :func:`mcdenoise.data.open_sequence`; or the frames lack a requested buffer.
        """
        self.check()
        if self.layers and not inputs:
            raise InputError("input: expected a folder, a file or a pattern, found nothing; name it before --layers")
        stated = self.color_with_albedo if self.color_with_albedo or self.color_without_albedo else None
        opened = open_sequence(
            inputs,
            self.frames,
            mapping=self.map,
            color_has_albedo=stated,
            lights=self.layers,
            color_space="linear" if self.input_linear else "auto",
        )
        if self.output_layer is not None:
            opened.check_output_layer(self.output_layer)
        if self.alpha and "alpha" not in opened.buffers:
            raise InputError(f"--alpha: expected an alpha to denoise, found none in {opened.root}; omit the option")
        return opened

    def chosen(
        self, sequence: Sequence, on_step: Callable[[int, int], None] = lambda done, total: None
    ) -> tuple[ShotSettings, str]:
        """Choose the model that meets the limits, if there are any; return the settings with it, and a description.

        Args:
            sequence: the frames.
            on_step: with ``budget_ms`` or ``max_error``, called with the number of measured models, and that of all.

        Raises:
            InputError: no model meets the limits.
        """
        if not self.is_budgeted:
            return self, ""
        # Imported here because it loads the benchmark, which takes time.
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
        """The requested model, or the model that the weights are for, or the default.

        Raises:
            InputError: the model is unknown, or its weights cannot be read.
        """
        if self.weights is None:
            return parse_method(self.model or DEFAULT)
        if self.model is None:
            return Spelling(model_of(self.weights), self.weights)
        return replace(parse_method(self.model), weights=self.weights)

    def denoiser(self) -> Denoiser:
        """A denoiser with these settings.

        Raises:
            InputError: see :class:`mcdenoise.denoiser.Denoiser`.
        """
        # Pass only the given settings, because other models do not have all of them.
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
            wrap=self.wrap,
            **{name: value for name, value in asked.items() if value is not None},
        )


def check_threads(threads: int) -> None:
    """Check that torch supports this number of threads.

    Raises:
        InputError: it does not.
    """
    if not 1 <= threads <= _MOST_THREADS:
        raise InputError(f"--threads: expected 1 to {_MOST_THREADS}, found {threads}")
