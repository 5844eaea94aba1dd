"""Measure training steps in each precision.

    python examples/training_speed.py
    python examples/training_speed.py SEQUENCE... --model wild_small --rounds 10 --json times.json

A step is that of `mcdenoise train`: it draws clips, runs the network forward and backward, and updates the weights and
their moving average. Without a sequence the clips are random. Every round makes one step in each precision, one after
the other, so that other work of the machine affects both equally; two rounds warm up and do not count. The script
prints medians, quartiles and steps per second. As in the command, the process keeps freed memory (mcdenoise/heap.py).
"""

import argparse
import itertools
import statistics
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from numpy.typing import NDArray
from run_time import check_least, write_figures

from mcdenoise.benchmark.machine import describe_machine, fix_threads
from mcdenoise.errors import run_script
from mcdenoise.heap import keep_heap
from mcdenoise.models import DEFAULT, create_model
from mcdenoise.models._precision import Precision
from mcdenoise.train import TrainConfig
from mcdenoise.train.clips import ClipSampler
from mcdenoise.train.config import check_config
from mcdenoise.train.data import TrainingData
from mcdenoise.train.devices import open_fabric
from mcdenoise.train.front import split
from mcdenoise.train.loop import Trainer
from mcdenoise.train.shots import Shot
from mcdenoise.turns import interleaved

WARM_UP = 2


def noise(config: TrainConfig) -> ClipSampler:
    """Clips of a random shot: every buffer is uniform noise in its range."""
    generator = np.random.default_rng(config.seed)

    def uniform(channels: int) -> NDArray[np.float32]:
        return generator.random((config.frames, channels, config.crop, config.crop), np.float32)

    shot = {"color": uniform(3), "current": uniform(3), "length": np.ceil(8 * uniform(1)).clip(1)}
    shot |= {"albedo": uniform(3), "normal": 2 * uniform(3) - 1, "depth": 10 * uniform(1), "reference": uniform(3)}
    random = Shot((lambda: shot,), range(config.frames), (config.crop, config.crop), demodulated=True)
    return ClipSampler([random], config)


def clips(config: TrainConfig, sequences: list[Path]) -> ClipSampler:
    """Clips of sequences, which are decoded into a temporary folder."""
    if not sequences:
        return noise(config)
    front, rest = split(create_model(config.model))
    with tempfile.TemporaryDirectory() as cache:
        return TrainingData.load(config, front, rest.needs, sequences, [], Path(cache)).sampler


def config_of(model: str, precision: Precision, batch: int, frames: int, crop: int) -> TrainConfig:
    """The configuration of steps to measure, all of which have as much to do."""
    return TrainConfig(
        model=model,
        batch=batch,
        frames=frames,
        crop=crop,
        precision=precision,
        gradient_norm=1.0,
        ema=0.998,
        validation_frames=0,
    )


def steps(config: TrainConfig, sampler: ClipSampler, device: str = "cpu") -> Callable[[], float]:
    """A function that makes the next training step and returns its loss; all start from the same weights."""
    torch.manual_seed(config.seed)
    fabric = open_fabric(device, config.precision, config.batch)
    trainer = Trainer(config, create_model(config.model).train(), fabric, has_state=False)
    numbers = itertools.count()

    def step() -> float:
        number = next(numbers)
        return trainer.step(number, sampler.draw(trainer.seeds(number)))[0]

    return step


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("sequences", nargs="*", type=Path, metavar="SEQUENCE", help="folders with references")
    parser.add_argument("--model", default=DEFAULT)
    parser.add_argument("--batch", type=int, default=2)
    parser.add_argument("--frames", type=int, default=4)
    parser.add_argument("--crop", type=int, default=128)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every time to this file too")
    options = parser.parse_args()

    check_least(options, threads=1, rounds=2)
    fix_threads(options.threads)
    keep_heap()
    runs: dict[str, Callable[[], object]] = {}
    for precision in get_args(Precision):
        config = config_of(options.model, precision, options.batch, options.frames, options.crop)
        check_config(config, 1)
        runs[precision] = steps(config, clips(config, options.sequences))
    times = {run: own[WARM_UP:] for run, own in interleaved(runs, WARM_UP + options.rounds - 1).items()}

    machine = describe_machine("cpu")
    size = f"{options.batch} clips of {options.frames} frames of {options.crop}x{options.crop}"
    print(f"{options.model}, {size}, {options.rounds} rounds")
    print(f"{machine.processor}, {options.threads} threads, {', '.join(map(' '.join, machine.packages.items()))}")
    print(f"{'precision':<12}{'ms a step':>10}{'quartiles':>16}{'steps/s':>10}")
    for precision, values in times.items():
        low, median, high = statistics.quantiles(values, n=4)
        spread = f"{low:.0f} .. {high:.0f}"
        print(f"{precision:<12}{median:>10.0f}{spread:>16}{1e3 / median:>10.2f}")
    write_figures(options.json, milliseconds=times)


if __name__ == "__main__":
    run_script(main)
