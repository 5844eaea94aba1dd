"""Compare every way to denoise on scenes of your choice: noisy, accumulated, a plain filter, and the network.

    python examples/unseen_scenes.py path/to/scene path/to/another --markdown
    python examples/unseen_scenes.py path/to/scene --weights runs/mine/cascaded.safetensors --json scores.json

Prints SMAPE (scene-linear, lower is better) and PSNR (as displayed, in dB, higher is better), each the mean over the
frames with a reference, for every scene and for the mean over the scenes. The plain filter is kornia's joint bilateral
filter of the same accumulated input, with the best setting of a sweep chosen by the reference: it is flattered.
"""

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from mcdenoise import Denoiser
from mcdenoise.data import open_sequence
from mcdenoise.evaluate import METRICS, Score, score_sequence


def mean_over_scenes(scores: list[Score]) -> list[Score]:
    """Every scene counts the same, however many frames it has."""
    means = []
    for method in dict.fromkeys(score.method for score in scores):
        own = [score for score in scores if score.method == method]
        values = {name: sum(score.values[name] for score in own) / len(own) for name in METRICS}
        means.append(Score(f"mean of {len(own)}", method, sum(score.frames for score in own), values))
    return means


def table(scores: list[Score], markdown: bool) -> str:
    """One row for each scene and method."""
    header = ["scene", "frames", "image", *METRICS]
    rows = [
        [score.sequence, str(score.frames), score.method, *(f"{value:.4g}" for value in score.values.values())]
        for score in scores
    ]
    if markdown:
        rule = ["---", "--:", "---", *("--:" for _ in METRICS)]
        return "\n".join(f"| {' | '.join(row)} |" for row in [header, rule, *rows])
    widths = [max(len(row[column]) for row in [header, *rows]) for column in range(len(header))]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) for row in [header, *rows])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("sequences", type=Path, nargs="+", metavar="SEQUENCE", help="folder of frames with references")
    parser.add_argument("--model", default="cascaded", help="a name that `mcdenoise models` lists")
    parser.add_argument("--weights", type=Path, help="weights of your own training; by default the shipped ones")
    parser.add_argument("--markdown", action="store_true", help="print a Markdown table")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the scores to this file too")
    options = parser.parse_args()

    denoiser = Denoiser(options.model, weights=options.weights)
    scores = [score for path in options.sequences for score in score_sequence(open_sequence(path), denoiser)]
    if len(options.sequences) > 1:
        scores += mean_over_scenes(scores)
    print(table(scores, options.markdown))
    if options.json:
        options.json.write_text(json.dumps([asdict(score) for score in scores], indent=2) + "\n")


if __name__ == "__main__":
    main()
