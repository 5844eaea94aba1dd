"""Plot error over run time on your scenes, for models with weights, filters, and other installed denoisers.

    python examples/error_vs_runtime.py path/to/scene path/to/another -o figure.svg
    python examples/error_vs_runtime.py path/to/scene -o figure.png --metric PSNR --frames 0-11 --threads 2

Points are means over the scenes, each at its own size; bars are quartiles, and the dashed line is the Pareto front. All
methods take turns on every frame (see `mcdenoise benchmark`, which writes a complete report). The script prints the
plotted values.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import torch

from mcdenoise.benchmark import Settings, choose_methods, run_benchmark
from mcdenoise.data import open_sequence
from mcdenoise.errors import InputError
from mcdenoise.evaluate import METRICS
from mcdenoise.report import check_packages, write_error_plot


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("sequences", type=Path, nargs="+", metavar="SEQUENCE", help="folder of frames with references")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="FILE", help="figure to write: .svg or .png")
    parser.add_argument("--metric", choices=METRICS, default="SMAPE")
    parser.add_argument("--models", metavar="NAMES", help="as for `mcdenoise benchmark`; all by default")
    parser.add_argument("--frames", metavar="NUMBERS", help="frames to use, such as 0-15")
    parser.add_argument("--rounds", type=int, default=3, help="number of times that each method denoises each frame")
    parser.add_argument("--threads", type=int, metavar="N", help="number of threads of all methods")
    return parser.parse_args()


def main() -> None:
    options = parse()
    check_packages()
    threads = options.threads or torch.get_num_threads()
    sequences = [open_sequence(path, options.frames) for path in options.sequences]
    methods = choose_methods(options.models)
    settings = Settings(rounds=options.rounds, threads=threads, pictures=0)
    with tempfile.TemporaryDirectory() as folder:
        results = run_benchmark(sequences, methods, Path(folder) / "results", settings)
    machine = results.machine
    print(f"{machine.processor}, {machine.device}, {machine.threads} threads; {len(results.scenes)} scenes")
    for row in write_error_plot(results, options.metric, options.out):
        value, time = row.errors.get(options.metric), row.milliseconds
        shown = f"{value.value:.4g} in {time.value:.1f} ms" if value and time else row.reason
        print(f"{row.method.name:<60} {shown}")
    print(options.out)


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
