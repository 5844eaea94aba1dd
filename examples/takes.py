"""Compare methods with Open Image Denoise on packed takes whose references have been cleaned.

    mcdenoise generate --takes --unseen --seeds 900000-900015 -o unseen
    python examples/takes.py unseen --clean clean --models oidn_temporal wild

A reference of a take has 264 samples a pixel; its noise is up to two thirds of the error of a good method, which hides
what methods differ by; without ``clean``, errors contain it. So ``clean`` gets copies with clean references first
(:func:`mcdenoise.train.clean_references`). Errors are of the frames with references, the last three of a shot of 16.
Open Image Denoise has its best setting of each take: features as noisy, as exact, or denoised first.
"""

import argparse
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import fmean, geometric_mean
from typing import TypeAlias

import torch
from torch import Tensor

from mcdenoise import Denoiser
from mcdenoise.data.files import write_json
from mcdenoise.data.shards import find_shards, open_shard
from mcdenoise.errors import run_script
from mcdenoise.frame import Frame
from mcdenoise.methods import parse_method
from mcdenoise.metrics import psnr_srgb, smape_linear, temporal_rmse_srgb, temporal_smape_linear
from mcdenoise.nn.oidn import oidn_exposure
from mcdenoise.train import clean_references
from mcdenoise.train.footage import frame_of

# Errors by take, method and metric.
Rows: TypeAlias = dict[str, dict[str, dict[str, float]]]
OIDN = ("oidn(auxiliary=noisy)", "oidn(auxiliary=clean)", "oidn(auxiliary=prefiltered)")
# Those that the documentation compares, with their labels there.
METHODS = {
    "oidn(quality=fast,auxiliary=noisy)": "OIDN fast",
    "oidn(quality=balanced,auxiliary=noisy)": "OIDN balanced",
    "oidn(auxiliary=prefiltered)": "OIDN high, features denoised first",
    "oidn_temporal": "`oidn_temporal`",
    "wild_small": "`wild_small`",
    "wild": "`wild`",
    "wild_large": "`wild_large`",
}
# Those whose run time is measured: these two denoise noisy features first, and take others as they are.
NOISY = {name: f"{name}(features=noisy)" for name in ("wild", "wild_large")}
TIMED = {**METHODS, **{spelt: f"`{name}`, noisy features" for name, spelt in NOISY.items()}}


def errors(denoiser: Denoiser, frames: Sequence[Frame], reference: Tensor) -> dict[str, float]:
    """Errors of a method on the last frames, which have references."""
    denoiser.reset()
    images = [denoiser(frame) for frame in frames]
    scale = oidn_exposure(reference[-1:])
    image, reference = torch.cat(images[-len(reference) :]).clamp_min(0) * scale, reference * scale
    found = {"smape": smape_linear(image, reference).mean(), "psnr": psnr_srgb(image, reference).mean()}
    found["light"] = image.mean() / reference.mean()
    if len(reference) > 1:
        clips = image[None], reference[None]
        found |= {"tsmape": temporal_smape_linear(*clips).mean(), "trmse": temporal_rmse_srgb(*clips).mean()}
    return {name: round(value.item(), 5) for name, value in found.items()}


def rows_of(rows: Rows, *, moving: bool) -> list[dict[str, dict[str, float]]]:
    """The rows of shots, or of stills, which have no error of change."""
    return [row for row in rows.values() if ("tsmape" in row[OIDN[0]]) == moving]


def ratios(rows: Rows, name: str, key: str, *, moving: bool) -> list[float]:
    """A method's errors of shots, or of stills, over those of Open Image Denoise's best setting of each take."""
    return [row[name][key] / min(row[each][key] for each in OIDN) for row in rows_of(rows, moving=moving)]


def table(rows: Rows, models: list[str], moving: bool) -> Iterable[str]:
    """Lines of a table: each method beside Open Image Denoise's best setting of each take."""
    kept = rows_of(rows, moving=moving)
    if not kept:
        return
    columns = ["SMAPE over OIDN's", "worst", "PSNR beside OIDN's", "light"]
    columns += ["tSMAPE over OIDN's", "tRMSE over OIDN's"] if moving else []
    yield " | ".join([f"| {len(kept)} {'shots' if moving else 'stills'}", *columns]) + " |"
    yield "|---" + "|--:" * len(columns) + "|"
    for name in models:
        found = ratios(rows, name, "smape", moving=moving)
        ahead = [row[name]["psnr"] - max(row[each]["psnr"] for each in OIDN) for row in kept]
        light = fmean(row[name]["light"] for row in kept)
        cells = [f"{geometric_mean(found):.3f}", f"{max(found):.3f}", f"{fmean(ahead):+.2f} dB", f"{light:.3f}"]
        temporal = ("tsmape", "trmse") if moving else ()
        cells += [f"{geometric_mean(ratios(rows, name, key, moving=True)):.3f}" for key in temporal]
        yield " | ".join([f"| {name}", *cells]) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("takes", nargs="+", type=Path, metavar="TAKES")
    parser.add_argument("--clean", type=Path, metavar="FOLDER", help="for copies with clean references")
    parser.add_argument("--models", nargs="+", default=[*METHODS], metavar="NAME")
    parser.add_argument("--json", type=Path, metavar="FILE", help="all errors; takes in it are not measured again")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()

    torch.set_num_threads(options.threads)
    models = list(dict.fromkeys([*OIDN, *options.models]))
    denoisers = {name: parse_method(name).denoiser(precision="float32") for name in models}
    rows = json.loads(options.json.read_text()) if options.json and options.json.exists() else {}
    for path in (path for folder in options.takes for path in find_shards(folder)):
        shard = open_shard(clean_references(path, options.clean) if options.clean else path)
        row = rows.setdefault(path.name.partition(".")[0], {})
        if missing := denoisers.keys() - row.keys():
            arrays = shard.read()
            frames = [frame_of(arrays, t) for t in range(len(shard))]
            reference = torch.from_numpy(arrays["reference"]).float()
            row |= {name: errors(denoisers[name], frames, reference) for name in sorted(missing)}
        if options.json:
            write_json(options.json, rows)
        print(path.name, {name: row[name]["smape"] for name in models}, flush=True)
    for moving in (True, False):
        print(*table(rows, models, moving), sep="\n")


if __name__ == "__main__":
    run_script(main)
