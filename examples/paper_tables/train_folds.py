"""Train the networks of the paper's tables, leaving one scene out at a time.

    python examples/paper_tables/train_folds.py DATASET -o RUNS
    python examples/paper_tables/train_folds.py DATASET -o RUNS --variants "P+K" "P+K without TL" --steps 20000

DATASET is a folder with a sequence in the BMFR layout for each scene. Batches of 8 clips of 8 frames of 128x128 and
Adam at 1e-4 are the paper's (Sec. 4.2); its 100 epochs are of a number of patches that it does not tell, so that the
10,000 steps here are a choice of ours. They take days on a GPU and are out of reach without one; any run can be
stopped, and the same command resumes it. Folds whose training scenes are the same are trained once. Networks are
trained and tested with the same accumulation, that of the model `cascaded`: the published rule, and at least 0.2 of
the current frame.
"""

import argparse
import sys
from pathlib import Path
from typing import get_args

from folds import MODEL, SCENES, VARIANTS, Split, run_folder, training_scenes

from mcdenoise.errors import InputError
from mcdenoise.train import Progress, TrainConfig, train


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("dataset", type=Path, metavar="DATASET", help="folder of the scenes' folders")
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="RUNS", help="folder of the runs")
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), metavar="NAME", help="of the dataset; its six")
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS), metavar="NAME")
    parser.add_argument("--split", choices=get_args(Split), default="grouped", help="what is held out, see folds.py")
    parser.add_argument("--steps", type=int, default=10_000, help="optimiser steps of each run")
    parser.add_argument("--batch", type=int, default=8, help="clips in a step")
    parser.add_argument("--frames", type=int, default=8, help="frames in a clip")
    parser.add_argument("--crop", type=int, default=128, help="side of the patches, pixels")
    parser.add_argument("--width", type=int, default=0, help="feature channels; the model's own by default")
    parser.add_argument("--learning-rate", type=float, default=1e-4)
    parser.add_argument("--accelerator", default="cpu", help="cpu or cuda")
    return parser.parse_args()


def main() -> None:
    options = parse()
    for name in options.variants:
        variant = VARIANTS[name]
        config = TrainConfig(
            model=MODEL,
            settings=variant.settings,
            width=options.width,
            steps=options.steps,
            batch=options.batch,
            frames=options.frames,
            crop=options.crop,
            learning_rate=options.learning_rate,
            **({} if variant.temporal_loss else {"temporal_weight": 0.0}),
        )
        for run, scenes in dict(
            (run_folder(options.out, options.split, variant, held_out, options.scenes), training)
            for held_out in options.scenes
            if (training := training_scenes(held_out, options.scenes, options.split))
        ).items():

            def report(progress: Progress, run: Path = run) -> None:
                print(f"{run}: step {progress.step}, loss {progress.loss:.4f}", file=sys.stderr)

            folders = [options.dataset / scene for scene in scenes]
            cache = options.out / "cache"
            print(train(config, folders, run, cache=cache, accelerator=options.accelerator, report=report))


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
