"""Run times of methods over image sizes, on synthetic frames, with an estimate of the memory that they need."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping

import numpy as np
import torch

from mcdenoise.benchmark.machine import available_memory
from mcdenoise.benchmark.memory import Peaks
from mcdenoise.benchmark.methods import Timed
from mcdenoise.errors import InputError, in_one_line
from mcdenoise.frame import Frame
from mcdenoise.models._times import Stopwatch
from mcdenoise.results import Cost, Fit, Method, Spread

Size = tuple[int, int]

SIZES = "320x180,640x360,960x540,1280x720,1920x1080"

_LARGEST_SIDE = 16384
# Images of up to this many pixels are tried without an estimate of their memory.
_SMALL = 1_000_000
# Fraction of the free memory that a method may use; the rest is for the histories of the other methods and for errors
# of the estimate.
_USABLE_FRACTION = 0.5


def parse_sizes(text: str) -> list[Size]:
    """Parse a list of sizes.

    Args:
        text: widths and heights in pixels, such as ``"320x180,1280x720"``, or ``"none"``.

    Returns:
        Distinct widths and heights, from few to many pixels.

    Raises:
        InputError: the text is not of this form, or a side is longer than 16384 pixels.

    Example:
        >>> parse_sizes("1280x720,320x180")
        [(320, 180), (1280, 720)]
    """
    sizes = set()
    for part in [] if text == "none" else text.lower().split(","):
        sides = [int(side) if side.strip().isdecimal() else 0 for side in part.split("x")]
        if len(sides) != 2 or not all(1 <= side <= _LARGEST_SIDE for side in sides):
            raise InputError(
                f"--sizes: expected WIDTHxHEIGHT up to {_LARGEST_SIDE}, separated by commas, or none, found '{text}'"
            )
        sizes.add((sides[0], sides[1]))
    return sorted(sizes, key=lambda size: size[0] * size[1])


def synthetic_frame(width: int, height: int) -> Frame:
    """A noisily lit wall that moves by a third of a pixel, with every buffer that a method can use.

    Run times depend on the number of pixels only, provided that reprojection finds the history, as it does here.
    """
    generator = torch.Generator().manual_seed(0)
    albedo = torch.rand(1, 3, height, width, generator=generator)
    light = -torch.log(torch.rand(1, 3, height, width, generator=generator).clamp_min(1e-6))
    rows, columns = torch.meshgrid(torch.arange(height) / height, torch.arange(width) / height, indexing="ij")
    facing = torch.tensor([0.0, 0.0, -1.0]).reshape(1, 3, 1, 1)
    return Frame(
        color=albedo * light,
        albedo=albedo,
        normal=facing.repeat(1, 1, height, width),
        depth=torch.ones(1, 1, height, width),
        position=torch.stack([columns, -rows, torch.ones_like(rows)])[None],
        motion=torch.full((1, 2, height, width), 1 / 3),
    )


def measure_sizes(
    methods: list[Method],
    made: Mapping[str, Timed],
    sizes: list[Size],
    *,
    rounds: int,
    peaks: Peaks,
    device: str,
    on_step: Callable[[], None],
) -> tuple[list[Cost], list[Fit]]:
    """Time every method on synthetic frames of every size, taking turns: A B C, A B C.

    The first two frames, of which the second has a history, warm up and are not timed. A method is skipped at a size
    where it would need more than half of the free memory: four times what it needs at half of the width and height.

    Args:
        methods: methods to time.
        made: the denoisers of the methods that could be constructed, by name.
        sizes: widths and heights, ascending.
        rounds: number of timed frames per method and size.
        peaks: measures memory.
        device: ``"cpu"`` or ``"cuda"``.
        on_step: called ``rounds + 2`` times for each size.

    Returns:
        Milliseconds without reading and writing files, by size and method; and a fitted line for each method that was
        timed at two sizes or more.
    """
    methods = [method for method in methods if method.name in made]
    costs: list[Cost] = []
    for width, height in sizes:
        times: dict[str, list[float]] = {}
        for method in methods:
            # What came before may have been a still, whose denoiser expects no further frame.
            made[method.name].denoiser.reset()
        lacks = {method.name: _lack(peaks, method, width, height, device) for method in methods}
        failures = {name: reason for name, reason in lacks.items() if reason}
        frame = synthetic_frame(width, height).to(device)
        watch = Stopwatch(device)
        for turn in range(rounds + 2):
            for name in (method.name for method in methods):
                if name in failures:
                    continue
                try:
                    start = watch.mark()
                    made[name](frame)
                    taken = watch.between(start, watch.mark())
                except Exception as error:  # a method may raise any exception; the other methods continue
                    failures[name] = in_one_line(error)
                    continue
                if turn >= 2:
                    times.setdefault(name, []).append(taken)
            on_step()
        for name in (method.name for method in methods):
            failed = failures.get(name, "")
            costs.append(Cost(name, width, height, None if failed else Spread.of(times[name]), failed))
    fits = [fit_line(method.name, costs) for method in methods]
    return costs, [fit for fit in fits if fit is not None]


def fit_line(method: str, costs: list[Cost]) -> Fit | None:
    """Fit a line to a method's medians by least squares of relative deviations; ``None`` for fewer than two sizes.

    Example:
        >>> costs = [Cost("a", 1000, h, Spread(5 + 2 * h, 0, 0, 1)) for h in (1, 4, 9)]
        >>> fit = fit_line("a", costs)
        >>> round(fit.fixed, 6), round(fit.per_megapixel, 6), round(fit.deviation, 6)
        (5.0, 2000.0, 0.0)
    """
    points = [
        (cost.width * cost.height / 1e6, cost.milliseconds.median)
        for cost in costs
        if cost.method == method and cost.milliseconds is not None
    ]
    if len({pixels for pixels, _ in points}) < 2:
        return None
    megapixels, milliseconds = np.array(points).T
    # Without these weights the largest image would dominate the fit.
    per_megapixel, fixed = np.polyfit(megapixels, milliseconds, 1, w=1 / milliseconds)
    deviation = np.abs(fixed + per_megapixel * megapixels - milliseconds) / milliseconds
    return Fit(method, float(fixed), float(per_megapixel), float(deviation.max()))


def _lack(peaks: Peaks, method: Method, width: int, height: int, device: str) -> str:
    """Why there is too little memory for an image; ``""`` if there is enough, or if it cannot be estimated."""
    if width * height <= _SMALL:
        return ""
    half = max(width // 2, 1), max(height // 2, 1)
    peak, available = peaks.of(method, half, functools.partial(_two_frames, *half)), available_memory(device)
    if peak is None or available is None:
        return ""
    needed, usable = 4 * peak, _USABLE_FRACTION * available / 2**20
    if needed <= usable:
        return ""
    return f"too little memory: expected to need {needed:.0f} MiB, found {usable:.0f} MiB that may be used"


def _two_frames(width: int, height: int) -> list[Frame]:
    return [synthetic_frame(width, height)] * 2
