"""Train the runs of a recipe on a dataset, holding out one scene at a time.

    python examples/paper_tables/train_folds.py DATASET -o RUNS
    python examples/paper_tables/train_folds.py DATASET -o RUNS --runs P+K-1 K-1 --held-out sponza --steps 10000

DATASET is a folder with a sequence in the BMFR layout for each scene. The recipe defines the models and their training,
except for the data, which here are the scenes that are not held out. The recipe's settings suit two cores; the paper's
are 100 epochs of batches of 8 clips of 8 frames of 128x128, with Adam at 1e-4 (Sec. 4.2), which takes days on a GPU.
The options below change the settings of all runs. Every run can be interrupted, and the same command resumes it. Folds
with equal training scenes are trained once.
"""

import argparse
import dataclasses
import sys
from pathlib import Path
from typing import get_args

from folds import RECIPES, Split, fold_folder, scenes_of, training_scenes

from mcdenoise.cli.train import options_of
from mcdenoise.errors import InputError, run_script
from mcdenoise.train import Progress, Recipe, train

_BUDGET = ("steps", "batch", "frames", "crop", "learning_rate")


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("dataset", type=Path, metavar="DATASET", help="folder of the scenes' folders")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="RUNS", help="folder of the runs")
    parser.add_argument("--recipe", type=Path, default=RECIPES / "ablations.toml", help="recipe of the runs")
    parser.add_argument("--runs", nargs="+", default=[], metavar="NAME", help="runs of the recipe; all by default")
    parser.add_argument("--scenes", nargs="+", metavar="NAME", help="scenes of the dataset; all by default")
    parser.add_argument("--held-out", nargs="+", metavar="NAME", help="scenes to hold out; all by default")
    parser.add_argument("--split", choices=get_args(Split), default="grouped", help="held-out scenes, see folds.py")
    parser.add_argument("--steps", type=int, help="optimizer steps of each run")
    parser.add_argument("--batch", type=int, help="clips per step")
    parser.add_argument("--frames", type=int, help="frames per clip")
    parser.add_argument("--crop", type=int, help="side of the patches in pixels")
    parser.add_argument("--learning-rate", type=float)
    parser.add_argument("--accelerator", default="cpu", help="cpu or cuda")
    return parser.parse_args()


def main() -> None:
    options = parse()
    if not options.dataset.is_dir():
        raise InputError(f"{options.dataset}: expected a folder of scenes, found none")
    scenes = options.scenes or scenes_of(options.dataset)
    held_out = options.held_out or scenes
    if unknown := set(held_out) - set(scenes):
        raise InputError(f"--held-out: expected scenes ({', '.join(scenes)}), found {', '.join(sorted(unknown))}")
    budget = {name: value for name in _BUDGET if (value := getattr(options, name)) is not None}
    runs = Recipe.read(options.recipe, options_of("generate")).chosen(options.runs)
    folds = {
        fold_folder(options.out, options.split, scene, scenes): training
        for scene in held_out
        if (training := training_scenes(scene, scenes, options.split))
    }
    for fold, training in folds.items():
        for run in runs:

            def report(progress: Progress, folder: Path = fold / run.name) -> None:
                print(f"{folder}: step {progress.step}, loss {progress.loss:.4f}", file=sys.stderr)

            print(
                train(
                    dataclasses.replace(run.config, **budget),
                    [options.dataset / scene for scene in training],
                    fold / run.name,
                    cache=options.out / "cache",
                    accelerator=options.accelerator,
                    report=report,
                )
            )


if __name__ == "__main__":
    run_script(main)
