"""Train a run of a recipe for a given number of minutes, however fast the machine is.

    python examples/gpu/train.py TAKES... -o OUT --recipe recipes/wild.toml --run base --minutes 8

TAKES are folders of packed takes, or of sequences. Some steps are timed first, in OUT/pace; then as many as the minutes
allow run with the recipe's schedule, in OUT/run, which ends with the weights, the checkpoint with the optimiser, and
the log. The same command again goes on with an interrupted run.
"""

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path

from mcdenoise.cli.train import options_of
from mcdenoise.data.files import write_json
from mcdenoise.errors import InputError
from mcdenoise.train import TrainConfig, train
from mcdenoise.train.loop import Progress
from mcdenoise.train.recipe import Recipe

# The first report of a run includes what is compiled and loaded once.
PACE, REPORTED = 150, 50
# Of the minutes, for the last checkpoint and what differs from step to step.
RESERVE = 0.95


def pace(config: TrainConfig, sequences: list[Path], out: Path, cache: Path, device: str) -> float:
    """Seconds of a training step."""
    seconds: list[float] = []

    def report(progress: Progress) -> None:
        seconds.append(progress.seconds)

    trial = replace(config, steps=PACE)
    train(trial, sequences, out, cache=cache, accelerator=device, checkpoint_every=PACE, report=report)
    return (seconds[-1] - seconds[0]) / (PACE - REPORTED)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("takes", nargs="+", type=Path, metavar="TAKES")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="OUT")
    parser.add_argument("--recipe", type=Path, required=True, metavar="FILE.toml")
    parser.add_argument("--run", default="", metavar="NAME", help="of the recipe; not needed where it has only one")
    parser.add_argument("--minutes", type=float, default=8.0, help="from the start of this script")
    parser.add_argument("--validation", nargs="*", type=Path, default=[], metavar="TAKES")
    parser.add_argument("--initial-weights", type=Path, metavar="FILE")
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"))
    options = parser.parse_args()

    start = time.monotonic()
    recipe = Recipe.read(options.recipe, options_of("generate"))
    (run,) = recipe.chosen([options.run] if options.run else [recipe.runs[0].name])
    cache, plan = options.out / "cache", options.out / "plan.json"
    if not plan.exists():
        seconds = pace(run.config, options.takes, options.out / "pace", cache, options.device)
        left = 60 * options.minutes * RESERVE - (time.monotonic() - start)
        write_json(plan, {"seconds a step": seconds, "steps": max(1, int(left / seconds))})
    config = replace(run.config, steps=json.loads(plan.read_text())["steps"])
    print(f"{config.steps} steps", flush=True)
    weights = train(
        config,
        options.takes,
        options.out / "run",
        validation=options.validation,
        cache=cache,
        initial_weights=options.initial_weights,
        accelerator=options.device,
        credits=recipe.credits,
        recipe=run.sha256,
        report=lambda progress: print(f"step {progress.step}, loss {progress.loss:.4f}", flush=True),
    )
    print(weights)


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
