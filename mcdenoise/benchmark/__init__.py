"""Error against run time: the chosen methods take turns on the same frames, in the same run."""

from mcdenoise.benchmark.methods import BASELINES, COMPARED, Timed, choose_methods, make_method
from mcdenoise.benchmark.operators import benchmark_ops
from mcdenoise.benchmark.run import Settings, run_benchmark
from mcdenoise.benchmark.sizes import parse_sizes

__all__ = [
    "BASELINES",
    "COMPARED",
    "Settings",
    "Timed",
    "benchmark_ops",
    "choose_methods",
    "make_method",
    "parse_sizes",
    "run_benchmark",
]
