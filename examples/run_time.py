"""Measure the run time of methods on one frame without accumulation, that is of their image filters alone.

    python examples/run_time.py
    python examples/run_time.py --models wild "oidn(quality=fast)" mine.py:make --size 1920x1080 --rounds 9

Every round runs each method once, one after the other, so that other work of the machine affects all of them equally;
the first round warms up and does not count. The script prints the median and the quartiles, and the ratio to the first
method, by default Open Image Denoise's fastest network. The input is random, because the time depends only on the
number of pixels. The time of Open Image Denoise includes copies to its layout and back, 10 to 20 ms at 1280x720 on one
core. As in the commands of the package, the process keeps freed memory (mcdenoise/heap.py), unless --no-heap is given.
"""

import argparse
import re
import statistics
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from takes import TIMED

from mcdenoise import Frame, create_model
from mcdenoise.benchmark.machine import describe_machine
from mcdenoise.data.files import write_json
from mcdenoise.errors import InputError, run_script
from mcdenoise.heap import keep_heap
from mcdenoise.methods import parse_method
from mcdenoise.models import Accumulated, Skipping
from mcdenoise.models._precision import PRECISIONS, Precision, computing_in
from mcdenoise.models._weights import pretrained_models
from mcdenoise.models._wrapper import parts_of
from mcdenoise.models.filtered import Filtered
from mcdenoise.turns import interleaved


def calls_of(spelt: str, frame: Frame, threads: int) -> dict[str, Callable[[], object]]:
    """Calls of a method on this frame; for trainable models, one in every precision."""
    spelling = parse_method(spelt)
    settings = {"threads": threads, **spelling.settings} if spelling.takes("threads") else spelling.settings
    # Random weights take the same time as trained ones.
    pretrained = spelling.weights is None and spelling.model in pretrained_models()
    model = create_model(spelling.model, pretrained=pretrained, weights=spelling.weights, **settings)
    if isinstance(model, torch.nn.Module):
        model.to(memory_format=torch.channels_last)
    filtered = model if isinstance(model, Filtered) and model.features == "noisy" else None
    for accumulated in parts_of(model, Accumulated):
        model = accumulated.inner.inner if isinstance(accumulated.inner, Skipping) else accumulated.inner
    if filtered is not None:
        filtered.inner, model = model, filtered

    cpu = torch.device("cpu")

    def call(precision: Precision) -> object:
        with torch.no_grad(), computing_in(precision, cpu):
            return model(frame)

    precisions = PRECISIONS if model.needs.trainable else ("float32",)
    names = {precision: "" if precision == "float32" else f", {precision}" for precision in precisions}
    return {f"{spelling.name}{mark}": partial(call, precision) for precision, mark in names.items()}


def check_least(options: argparse.Namespace, **least: int) -> None:
    """Check that options are at least so large."""
    for name, minimum in least.items():
        if (value := getattr(options, name)) is not None and value < minimum:
            raise InputError(f"--{name}: expected at least {minimum}, found {value}")


def size_of(text: str) -> tuple[int, int]:
    """Width and height."""
    if not (match := re.fullmatch(r"([1-9][0-9]{0,4})x([1-9][0-9]{0,4})", text)):
        raise InputError(f"--size: expected WIDTHxHEIGHT such as 1280x720, found '{text}'")
    return int(match[1]), int(match[2])


def write_figures(path: Path | None, **figures: object) -> None:
    """Write figures and the machine that they were measured on to the file of ``--json``, if it is given."""
    if path is not None:
        write_json(path, {"machine": vars(describe_machine("cpu")), **figures})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--models", nargs="+", default=[*TIMED], metavar="MODEL")
    parser.add_argument("--size", default="1280x720", metavar="WxH")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--no-heap", action="store_true", help="return freed memory to the system at once")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every time to this file too")
    options = parser.parse_args()

    check_least(options, threads=1, rounds=2)
    width, height = size_of(options.size)
    torch.set_num_threads(options.threads)
    if not options.no_heap:
        keep_heap()
    torch.manual_seed(0)
    normal = torch.nn.functional.normalize(torch.randn(1, 3, height, width))
    color, albedo, depth = (torch.rand(1, channels, height, width) for channels in (3, 3, 1))
    # The history lengths that the accumulation would pass on for a first frame.
    length = torch.ones(1, 1, height, width)
    frame = Frame(color=color, albedo=albedo, normal=normal, depth=depth, current=color, length=length)
    calls: dict[str, Callable[[], object]] = {}
    for spelt in options.models:
        calls |= calls_of(spelt, frame, options.threads)

    times = {name: later for name, (_, *later) in interleaved(calls, options.rounds).items()}
    unit = statistics.median(next(iter(times.values())))
    print(f"{options.size}, {options.threads} threads, {options.rounds} rounds, torch {torch.__version__}")
    print(f"{'milliseconds':<44}{'median':>8}{'quartiles':>16}{'/ first':>13}")
    for name, values in times.items():
        low, median, high = statistics.quantiles(values, n=4)
        print(f"{name:<44}{median:>8.0f}{f'{low:.0f} .. {high:.0f}':>16}{median / unit:>13.2f}")
    write_figures(options.json, milliseconds=times)


if __name__ == "__main__":
    run_script(main)
