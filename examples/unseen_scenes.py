"""Compare every way to denoise on scenes of your choice: noisy, accumulated, a plain filter, OIDN, and the networks.

    python examples/unseen_scenes.py path/to/scene path/to/another --peers oidn --markdown
    python examples/unseen_scenes.py path/to/scene --models cascaded_v2 --weights runs/mine/cascaded.safetensors

Prints for every scene, and for the mean over the scenes, the mean over the frames with a reference of: SMAPE, relMSE
and RMSE (scene-linear, lower is better), PSNR and SSIM (as displayed, higher is better), FLIP (as displayed, lower is
better), and tSMAPE (scene-linear) and tRMSE (as displayed), the errors of the change from frame to frame, lower is
better. Where the renderer has noted the references' own noise, also what the truth would score because of it.

Peers are shown at their best: a row that stands for several settings takes, for each metric by itself, the setting that
the reference says is best. OIDN is Intel Open Image Denoise in 36 settings: fast, balanced and high; albedo and normal
taken as noisy, as clean, or denoised first; started from one sample a pixel ("raw"), from the accumulated image, from
that one divided by albedo, or from one sample a pixel with the results accumulated by the same rule ("accumulated
after"). Its high quality is the network of balanced unless albedo and normal are clean. The plain filter is kornia's
joint bilateral filter of the accumulated image, in 20 settings. --json holds every setting by itself.
"""

import argparse
import json
import sys
import time
from dataclasses import asdict
from pathlib import Path

import torch

from mcdenoise import Denoiser
from mcdenoise.data import open_sequence
from mcdenoise.data.files import write_text
from mcdenoise.data.sequences import with_unique_names
from mcdenoise.errors import InputError
from mcdenoise.evaluate import (
    METRICS,
    Score,
    check_references,
    folded,
    noise_floor,
    reference_noise,
    score_sequence,
    summary,
    verdicts,
)
from mcdenoise.history import History
from mcdenoise.models import Cascade
from mcdenoise.ops import ClampFireflies
from mcdenoise.peers import Peer, joint_bilateral_peers, oidn_peers


def table(scores: list[Score], markdown: bool) -> str:
    """One row for each scene and method; a metric that was not computed is a dash."""
    metrics = [name for name in METRICS if any(name in score.values for score in scores)]
    header = ["scene", "frames", "image", *metrics]
    rows = [
        [score.sequence, str(score.frames), score.method]
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
    parser.add_argument("--models", default="cascaded_v2", metavar="NAMES", help="names that `mcdenoise models` lists")
    parser.add_argument("--weights", type=Path, metavar="FILE", help="your own weights of the one model that is named")
    parser.add_argument(
        "--resolutions", type=int, metavar="N", help="sizes of the image that a first network denoises, not its own"
    )
    parser.add_argument(
        "--fireflies", type=float, metavar="LIMIT", help="of clamp_fireflies before the networks, not their own"
    )
    parser.add_argument(
        "--peers", choices=["oidn"], action="append", default=[], help="other denoisers; mcdenoise[peers]"
    )
    parser.add_argument(
        "--no-bilateral",
        action="store_true",
        help="leave out the plain filter: its sweep takes seconds a frame, and minutes at 1280x720",
    )
    parser.add_argument("--flip-every", type=int, default=4, metavar="N", help="FLIP of the first of N frames (4)")
    parser.add_argument("--no-flip", action="store_true", help="leave out FLIP, which needs mcdenoise[peers]")
    parser.add_argument("--frames", metavar="NUMBERS", help="which frames to use, such as 0-15")
    parser.add_argument("--threads", type=int, metavar="N", help="of the networks and of OIDN")
    parser.add_argument("--markdown", action="store_true", help="print Markdown tables")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every score to this file too")
    return parser.parse_args()


def _clamp(limit: float) -> ClampFireflies:
    try:
        return ClampFireflies(limit)
    except ValueError as error:
        raise InputError(f"--fireflies: {error}") from error


def main() -> None:
    options = parse()
    if options.threads is not None:
        if options.threads < 1:
            raise InputError(f"--threads: expected at least 1, found {options.threads}")
        torch.set_num_threads(options.threads)
    names = options.models.split(",")
    if options.weights and len(names) > 1:
        raise InputError(f"--weights: expected one model to load them into, found --models {options.models}")
    if options.resolutions is not None and options.resolutions < 1:
        raise InputError(f"--resolutions: expected at least 1, found {options.resolutions}")
    if options.flip_every < 1:
        raise InputError(f"--flip-every: expected at least 1, found {options.flip_every}")
    sequences = with_unique_names([open_sequence(path, options.frames) for path in options.sequences])
    for sequence in sequences:
        check_references(sequence)
    denoisers = {name: Denoiser(name, weights=options.weights) for name in names}
    for denoiser in denoisers.values():
        if options.resolutions and isinstance(denoiser.model, Cascade):
            denoiser.model.resolutions = options.resolutions
        if options.fireflies is not None:
            denoiser.history = History(denoiser.history.accumulate, _clamp(options.fireflies))
    peers: list[Peer] = [] if options.no_bilateral else joint_bilateral_peers()
    if "oidn" in options.peers:
        peers += oidn_peers(threads=options.threads)
    metrics = [name for name in METRICS if not (options.no_flip and name == "FLIP")]

    scores: list[Score] = []
    for sequence in sequences:
        start = time.perf_counter()
        scores += score_sequence(sequence, denoisers, peers=peers, metrics=metrics, flip_every=options.flip_every)
        print(f"{sequence.name}: {time.perf_counter() - start:.0f} s", file=sys.stderr)

    print(table(folded(scores), options.markdown))
    means = summary(scores) if len(sequences) > 1 else []
    if means:
        print(f"\n{table(means, options.markdown)}")
    noise = {sequence.name: reference_noise(sequence) for sequence in sequences}
    floors = {sequence.name: noise_floor(sequence) for sequence in sequences}
    notes = [
        f"{name}: the references' own SMAPE against the truth is about {value:.4g}; the truth would score about "
        + ", ".join(f"{metric} {floor:.4g}" for metric, floor in floors[name].items())
        + "."
        for name, value in noise.items()
        if value
    ]
    notes += dict.fromkeys(f"no {metric}: {reason}." for score in scores for metric, reason in score.left_out.items())
    if "FLIP" in metrics and options.flip_every > 1:
        notes.append(f"FLIP: of one in {options.flip_every} frames.")
    against = [verdict for name in names for verdict in verdicts(scores, name)] if "oidn" in options.peers else []
    for lines in (notes, [str(verdict) for verdict in against]):
        if lines:
            print("\n" + "\n".join(f"- {line}" if options.markdown else line for line in lines))
    if options.json:
        everything = {
            "scores": [asdict(score) for score in scores],
            "folded": [asdict(score) for score in folded(scores)],
            "summary": [asdict(score) for score in means],
            "verdicts": [asdict(v) | {"ahead": v.ahead, "won": v.won} for v in against],
            "reference_noise": noise,
            "noise_floor": floors,
            "flip_every": options.flip_every,
            "threads": torch.get_num_threads(),
        }
        write_text(options.json, json.dumps(everything, indent=2) + "\n")


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
