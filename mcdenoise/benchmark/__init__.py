"""Error against run time: every chosen denoiser on the same frames, in the same run, taking turns."""

from mcdenoise.benchmark.methods import PEERS, Candidate, Runner, choose_candidates
from mcdenoise.benchmark.operators import benchmark_ops
from mcdenoise.benchmark.run import Settings, run_benchmark
from mcdenoise.benchmark.sizes import parse_sizes

__all__ = [
    "PEERS",
    "Candidate",
    "Runner",
    "Settings",
    "benchmark_ops",
    "choose_candidates",
    "parse_sizes",
    "run_benchmark",
]
