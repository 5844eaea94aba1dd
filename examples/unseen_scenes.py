"""Compare methods on scenes of your choice: noisy, accumulated, filters, other denoisers, and networks.

    python examples/unseen_scenes.py path/to/scene path/to/another --sweep oidn joint_bilateral --markdown
    python examples/unseen_scenes.py path/to/scene --models runs/mine/wild.safetensors,mine.py:make

For every scene, and for the mean over the scenes, the script prints means over the frames with a reference: SMAPE,
relMSE and RMSE (scene-linear, lower is better); PSNR and SSIM (as displayed, higher is better); FLIP (as displayed,
lower is better); and the errors of the change from frame to frame, tSMAPE (scene-linear) and tRMSE (as displayed),
lower is better. If the renderer has recorded the noise of the references, it also prints the resulting score of the
truth.

Models with --sweep are shown at their best: a row for several settings has, for each metric separately, the value of
the best setting, chosen by means of the reference. `oidn`, Intel Open Image Denoise, has 36 settings: fast, balanced
and high quality; albedo and normal treated as noisy, as clean, or denoised first; and as input one sample per pixel
("raw"), the accumulated image, the accumulated image divided by albedo, or one sample per pixel with the results
accumulated by the same rule ("accumulated after"). `joint_bilateral`, kornia's filter of the accumulated image, has 20.
The file of --json has every setting separately. For a sweep of your own, use for example --models
"wild(alpha_min=0.05|0.1|0.2)".
"""

import argparse
import json
import tempfile
from dataclasses import asdict
from pathlib import Path

import torch

from mcdenoise.benchmark import (
    Score,
    Settings,
    choose_methods,
    folded,
    mean_over_scenes,
    run_benchmark,
    scores_of,
)
from mcdenoise.benchmark.tables import remarks
from mcdenoise.data import open_sequence
from mcdenoise.data.files import write_text
from mcdenoise.data.sequences import with_unique_names
from mcdenoise.errors import run_script
from mcdenoise.evaluate import USUAL, noise_floor
from mcdenoise.models import DEFAULT

SWEEPS = {
    "oidn": "oidn(source=raw|accumulated|demodulated|accumulated after, quality=fast|balanced|high, "
    "auxiliary=noisy|clean|prefiltered)",
    # On nine 1-spp sequences, extending the sweep by a step on every side lowers the best SMAPE of only one, by 0.8 %.
    "joint_bilateral": "joint_bilateral(sigma_color=0.05|0.1|0.2|0.3|0.5, sigma_space=1.5|2.5|4.0|6.0)",
}
# Settings whose values have rows of their own in the tables.
BY = ("source", "quality")


def table(scores: list[Score], markdown: bool) -> str:
    """One row for each scene and method; a metric that was not computed is a dash."""
    metrics = [name for name in USUAL if any(name in score.values for score in scores)]
    header = ["scene", "frames", "image", *metrics]
    rows = [
        [score.scene, str(score.frames), score.method]
        + [f"{score.values[name]:.4g}" if name in score.values else "-" for name in metrics]
        for score in scores
    ]
    if markdown:
        rule = ["---", "--:", "---", *("--:" for _ in metrics)]
        return "\n".join(f"| {' | '.join(row)} |" for row in [header, rule, *rows])
    widths = [max(len(row[column]) for row in [header, *rows]) for column in range(len(header))]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)) for row in [header, *rows])


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("sequences", type=Path, nargs="+", metavar="SEQUENCE", help="folder of frames with references")
    parser.add_argument("--models", default=DEFAULT, metavar="NAMES", help="as for `mcdenoise benchmark`")
    parser.add_argument("--sweep", choices=SWEEPS, nargs="+", default=[], help="models to show in all their settings")
    parser.add_argument("--flip-every", type=int, default=4, metavar="N", help="FLIP of every N-th frame (4)")
    parser.add_argument("--no-flip", action="store_true", help="skip FLIP, which needs mcdenoise[peers]")
    parser.add_argument("--frames", metavar="NUMBERS", help="frames to use, such as 0-15")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads(), metavar="N")
    parser.add_argument("--markdown", action="store_true", help="print Markdown tables")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every score to this file too")
    return parser.parse_args()


def main() -> None:
    options = parse()
    metrics = tuple(name for name in USUAL if not (options.no_flip and name == "FLIP"))
    settings = Settings(
        rounds=0, threads=options.threads, pictures=0, metrics=metrics, flip_every=options.flip_every, on_the_way=True
    )
    sequences = with_unique_names([open_sequence(path, options.frames) for path in options.sequences])
    spelt = ",".join([*(SWEEPS[name] for name in options.sweep), options.models])
    methods = choose_methods(spelt, precisions="float32")
    with tempfile.TemporaryDirectory() as folder:
        results = run_benchmark(sequences, methods, Path(folder) / "results", settings)
    scores = scores_of(results)

    print(table(folded(scores, BY), options.markdown))
    means = folded(mean_over_scenes(scores), BY) if len(sequences) > 1 else []
    if means:
        print(f"\n{table(means, options.markdown)}")
    floors = {sequence.name: noise_floor(sequence) for sequence in sequences}
    notes = [
        f"{scene.name}: the references' own SMAPE against the truth is about {scene.reference_noise:.4g}; the truth "
        f"would score about {', '.join(f'{metric} {floor:.4g}' for metric, floor in floors[scene.name].items())}."
        for scene in results.scenes
        if scene.reference_noise
    ]
    notes += [f"{line}." for line in remarks(results)]
    if "FLIP" in metrics and options.flip_every > 1:
        notes.append(f"FLIP: of one in {options.flip_every} frames.")
    if notes:
        print("\n" + "\n".join(f"- {line}" if options.markdown else line for line in notes))
    if options.json:
        everything = {
            "scores": [asdict(score) for score in scores],
            "folded": [asdict(score) for score in folded(scores, BY)],
            "summary": [asdict(score) for score in means],
            "reference_noise": {scene.name: scene.reference_noise for scene in results.scenes},
            "noise_floor": floors,
            "flip_every": options.flip_every,
            "threads": options.threads,
        }
        write_text(options.json, json.dumps(everything, indent=2) + "\n")


if __name__ == "__main__":
    run_script(main)
