"""Measure the cost per pixel of whole processes in frames of any size, within a memory limit.

    python examples/large_frames.py
    python examples/large_frames.py --sizes 1280x720,3840x2160 --model wild_small --max-memory 2 --json costs.json

The script writes a synthetic sequence of each size (color, albedo, normal, depth and position, without cameras, so that
frames have no history) and denoises it with `mcdenoise denoise --max-memory`, which chooses the tiles. For each size it
prints the tiles, the nanoseconds per pixel of the network and of all stages except reading and writing, as medians over
the frames after the first, and the peak memory of the process. 7680x4320 takes minutes and a gigabyte of disk.
"""

import argparse
import json
import tempfile
from pathlib import Path

import torch
from run_time import check_least, write_figures

from mcdenoise.benchmark import parse_sizes
from mcdenoise.benchmark.machine import describe_machine
from mcdenoise.benchmark.memory import output_and_peak
from mcdenoise.benchmark.sizes import synthetic_frame
from mcdenoise.data.readers.bmfr import write_bmfr_frame
from mcdenoise.errors import InputError, run_script
from mcdenoise.models import DEFAULT


def measure(width: int, height: int, options: argparse.Namespace, folder: Path) -> dict[str, object]:
    """Measure the cost of denoising frames of a size in a separate process."""
    frame = synthetic_frame(width, height).replace(motion=None)
    for number in range(options.frames):
        write_bmfr_frame(folder / "wall" / "inputs", number, frame)
    del frame
    settings = ("--model", options.model, "--precision", options.precision, "--threads", options.threads)
    limit = ("--max-memory", options.max_memory)
    try:
        _, peak = output_and_peak("denoise", folder / "wall", "-o", folder / "out", *settings, *limit)
    except InputError as error:
        raise InputError(f"{width}x{height}: {error}") from error
    report = json.loads((folder / "out" / "denoise.json").read_text())
    stages = {name: spent * 1e6 / (width * height) for name, spent in report["milliseconds"].items()}
    del stages["waiting"]
    return {
        "size": f"{width}x{height}",
        "network": stages["network"],
        "total": sum(stages.values()),
        "stages": stages,
        "peak": peak,
        "tiles": report["tiles"],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--sizes", default="1280x720,1920x1080,3840x2160,7680x4320", metavar="WxH,...")
    parser.add_argument("--model", default=DEFAULT)
    parser.add_argument("--precision", default="bfloat16", choices=["float32", "bfloat16"])
    parser.add_argument("--max-memory", type=float, default=4.0, metavar="GB")
    parser.add_argument("--frames", type=int, default=2, help="frames of each size; the first warms up")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every figure to this file too")
    options = parser.parse_args()

    check_least(options, threads=1, frames=2)
    torch.set_num_threads(options.threads)
    machine = describe_machine("cpu")
    print(f"{options.model}, {options.precision}, within {options.max_memory:g} GB, {options.frames} frames")
    print(f"{machine.processor}, {options.threads} threads, torch {machine.packages['torch']}")
    print(f"{'size':<12}{'network, ns a pixel':>20}{'total':>8}{'peak, GB':>10}  tiles")
    costs = []
    for width, height in parse_sizes(options.sizes):
        with tempfile.TemporaryDirectory() as folder:
            cost = measure(width, height, options, Path(folder))
        costs.append(cost)
        print("{size:<12}{network:>20.0f}{total:>8.0f}{peak:>10.2f}  {tiles}".format(**cost), flush=True)
    write_figures(options.json, costs=costs)


if __name__ == "__main__":
    run_script(main)
