"""Choosing a model that meets a time budget or an error limit on this machine."""

from __future__ import annotations

import functools
import platform
import statistics
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path

import torch

from mcdenoise.benchmark.sizes import synthetic_frame
from mcdenoise.data import Sequence
from mcdenoise.denoiser import Denoiser
from mcdenoise.errors import InputError
from mcdenoise.folder import denoised_frames
from mcdenoise.metrics import smape_linear
from mcdenoise.models._precision import PRECISIONS, Precision
from mcdenoise.models._weights import pretrained_models
from mcdenoise.results import Results
from mcdenoise.user_cache import measured_once

_ROUNDS = 3
_TRIED = "only models with weights of this package are tried, so that oidn_temporal needs --model"
# Number of frames with a reference on which errors are measured, and of frames before the first of them.
_SCORED = 4
_HISTORY = 8


@dataclass(frozen=True)
class Choice:
    """A candidate model.

    Args:
        model: name of the model.
        precision: precision of its convolutions.
        milliseconds: run time per frame in memory on this machine, with nothing skipped.
        error: SMAPE of scene-linear radiance; ``None`` if it is unknown.
    """

    model: str
    precision: Precision
    milliseconds: float
    error: float | None = None

    @property
    def name(self) -> str:
        """Name in a benchmark."""
        return self.model if self.precision == "float32" else f"{self.model}, {self.precision}"

    def __str__(self) -> str:
        error = "" if self.error is None else f", SMAPE {self.error:.4g}"
        return f"{self.name}: {self.milliseconds:.1f} ms a frame{error}"


def choose_model(
    sequence: Sequence,
    *,
    budget: float | None = None,
    max_error: float | None = None,
    results: Path | None = None,
    device: str = "cpu",
    on_step: Callable[[int, int], None] = lambda done, total: None,
) -> Choice:
    """Choose the fastest shipped model and precision with an error of at most ``max_error``, if that is given.

    With a budget alone, choose the smallest error among the models within the budget. If no errors are known, choose
    the slowest of these models, which usually has the best quality.

    Args:
        sequence: the sequence to denoise.
        budget: milliseconds per frame, without reading and writing files; above 0.
        max_error: SMAPE of scene-linear radiance; above 0.
        results: folder of a finished benchmark, whose errors (mean over its scenes) are used; without it errors are
            measured on the last frames of the sequence that have a reference.
        device: device to run on.
        on_step: called with the number of measured models and the number of all models.

    Raises:
        InputError: no model meets the limits, or ``max_error`` is given and no errors are known.
    """
    if results is None and max_error is not None and not sequence.reference_numbers:
        raise InputError(
            f"--max-error: expected references in {sequence.root}, or --results of a finished benchmark, found neither"
        )
    choices = _timed(sequence.size, device, on_step)
    affordable = [choice for choice in choices if budget is None or choice.milliseconds <= budget]
    if not affordable:
        raise InputError(
            f"--budget-ms: expected a model that takes at most {budget:g} ms, found at best {choices[0]}; {_TRIED}"
        )
    error_of = _errors(sequence, results, device)
    scored: list[Choice] = []
    for choice in affordable:
        scored.append(replace(choice, error=error_of(choice)))
        if max_error is not None and scored[-1].error is not None and scored[-1].error <= max_error:
            return scored[-1]
    known = [choice for choice in scored if choice.error is not None]
    if max_error is None:
        return min(known or scored, key=lambda choice: (choice.error or 0.0, -choice.milliseconds))
    within = "" if budget is None else f" in {budget:g} ms"
    found = f"at best {min(known, key=lambda choice: choice.error or 0.0)}" if known else "no error of any"
    raise InputError(
        f"--max-error: expected a model with SMAPE of at most {max_error:g}{within}, found {found}; {_TRIED}"
    )


def _timed(size: tuple[int, int], device: str, on_step: Callable[[int, int], None]) -> list[Choice]:
    """All shipped models in all precisions, fastest first."""
    height, width = size
    machine = f"{platform.node()}, {platform.machine()}, {device}, {torch.get_num_threads()} threads"
    place = f"{machine}, mcdenoise {version('mcdenoise')}, torch {torch.__version__}, {width}x{height}"
    choices = [Choice(model, precision, 0.0) for model in pretrained_models() for precision in PRECISIONS]
    measured = []
    for done, choice in enumerate(choices, start=1):
        measure = functools.partial(_measure, choice, size, device)
        milliseconds = measured_once("run_times.json", f"{place}, {choice.name}", measure)
        measured.append(replace(choice, milliseconds=milliseconds))
        on_step(done, len(choices))
    return sorted(measured, key=lambda choice: choice.milliseconds)


def _measure(choice: Choice, size: tuple[int, int], device: str) -> float:
    denoiser = Denoiser(choice.model, precision=choice.precision, device=device, keep_all=True)
    frame = synthetic_frame(size[1], size[0]).to(device)
    times = []
    for _ in range(_ROUNDS + 2):
        denoiser(frame)
        times.append(sum(denoiser.report.milliseconds.values()))
    return statistics.median(times[2:])


def _errors(sequence: Sequence, results: Path | None, device: str) -> Callable[[Choice], float | None]:
    """What tells the error of a choice; ``None`` if it is unknown."""
    if results is None:
        return lambda choice: _error(choice, sequence, device) if sequence.reference_numbers else None
    found: dict[str, list[float]] = {}
    for cell in Results.read(results).cells:
        if "SMAPE" in cell.errors:
            found.setdefault(cell.method, []).append(cell.errors["SMAPE"])
    return lambda choice: statistics.mean(found[choice.name]) if choice.name in found else None


def _error(choice: Choice, sequence: Sequence, device: str) -> float:
    """Error on the last frames that have a reference, with a history."""
    scored = sequence.reference_numbers[-_SCORED:]
    numbers = [number for number in sequence.numbers if scored[0] - _HISTORY <= number <= scored[-1]]
    denoiser = Denoiser(choice.model, precision=choice.precision, device=device)
    frames = denoised_frames(sequence.part(numbers), denoiser)
    pairs = [(output.image.cpu(), frame.reference) for number, frame, output in frames if number in scored]
    return statistics.mean(float(smape_linear(image, truth)) for image, truth in pairs if truth is not None)
