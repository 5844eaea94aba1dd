"""Error against run time: the chosen methods take turns on the same frames, in the same run."""

from mcdenoise.benchmark.comparison import Score, folded, mean_over_scenes, scores_of
from mcdenoise.benchmark.methods import BASELINES, COMPARED, Timed, choose_methods, make_method
from mcdenoise.benchmark.operators import benchmark_ops
from mcdenoise.benchmark.run import Settings, run_benchmark
from mcdenoise.benchmark.sizes import parse_sizes

__all__ = [
    "BASELINES",
    "COMPARED",
    "Score",
    "Settings",
    "Timed",
    "benchmark_ops",
    "choose_methods",
    "folded",
    "make_method",
    "mean_over_scenes",
    "parse_sizes",
    "run_benchmark",
    "scores_of",
]
