"""Print the paper's Tables 1 to 4 for what is there: scenes, trained networks, peers. What is not there says why.

    python examples/paper_tables/tables.py DATASET --runs RUNS
    python examples/paper_tables/tables.py DATASET --runs RUNS --tables 2 3 --split paper --markdown

DATASET is a folder with a sequence in the BMFR layout for each scene, RUNS what train_folds.py wrote. Table 1 is PSNR
and SSIM of each method on each scene, Table 2 milliseconds at 1280x720, Table 3 the order of the networks (K, P, K+P,
K+K, P+K), Table 4 bilateral weights (BWA) and temporal loss (TL) on and off. PSNR and SSIM are given by two protocols:
"strict" (sRGB curve, data range 1) and "meng2020", by which the published figures on this dataset seem to have been
made. Each network is tested on scenes it has not been trained on, and on frames accumulated as those it was trained on;
"accumulated" is that input of all of them. OIDN gets the noisy frames, and is told that features are clean.
"""

import argparse
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from statistics import mean, median, quantiles
from typing import get_args

import torch
from folds import MODEL, SCENES, VARIANTS, Split, run_folder
from torch import Tensor

from mcdenoise import Denoiser, Frame
from mcdenoise.data import open_sequence
from mcdenoise.errors import InputError
from mcdenoise.evaluate import check_references
from mcdenoise.metrics import PROTOCOLS
from mcdenoise.models import Model, Output, create_model, parts_of
from mcdenoise.models.accumulated import Accumulated
from mcdenoise.train.config import parse_settings

PROTOCOL_NAMES = ("strict", "meng2020")
# What the paper compares with and this package has not.
ABSENT = {
    "NBGD": "not in the zoo: Meng et al. 2020, neural bilateral grid",
    "ONND": "not in the zoo: the closed denoiser of OptiX 5.1, which needs an NVIDIA GPU",
    "KP": "not in the zoo: a kernel-predicting network of Bako et al. 2017",
    "MRKP": "not in the zoo: its multi-resolution form by Meng et al.",
    "WSKP": "not in the zoo: Fan et al. 2021, weight sharing",
}
Errors = dict[str, float]  # by "protocol metric"


@dataclass
class Footnotes:
    """Reasons for empty cells, each told once."""

    reasons: list[str] = field(default_factory=list)

    def empty(self, reason: str) -> str:
        """An empty cell with the number of its reason."""
        if reason not in self.reasons:
            self.reasons.append(reason)
        return f"- [{self.reasons.index(reason) + 1}]"


class Measured:
    """Errors of methods on scenes, measured when they are asked for, each once."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self._known: dict[tuple[str, str], Errors | str] = {}

    def errors(self, method: str, scene: str) -> Errors | str:
        """Mean errors over the frames of a scene, or why there are none.

        Args:
            method: a name in VARIANTS, with ", initial" for the result of the first network; ``noisy``,
                ``accumulated`` or ``OIDN``.
            scene: of the dataset.
        """
        if (method, scene) not in self._known:
            for name, found in self._measure(method.removesuffix(", initial"), scene).items():
                self._known[name, scene] = found
        return self._known[method, scene]

    def average(self, method: str) -> Errors | str:
        """Mean over the scenes; the reason of the first scene that has none."""
        found = [self.errors(method, scene) for scene in self.options.scenes]
        known = [errors for errors in found if not isinstance(errors, str)]
        if len(known) < len(found):
            return next(errors for errors in found if isinstance(errors, str))
        return {name: mean(errors[name] for errors in known) for name in known[0]}

    def _measure(self, method: str, scene: str) -> dict[str, Errors | str]:
        try:
            return dict(self._score(scene, self._denoiser(method, scene), method))
        except InputError as error:
            return dict.fromkeys((method, f"{method}, initial"), str(error))

    def _denoiser(self, method: str, scene: str) -> Denoiser:
        if method == "OIDN":
            return Denoiser("oidn", quality="high", auxiliary="clean", source="raw")
        if method not in VARIANTS:
            # Nothing but what all networks are given.
            return Denoiser(create_model(MODEL, width=4))
        run = run_folder(self.options.runs, self.options.split, VARIANTS[method], scene, self.options.scenes)
        weights = run / f"{MODEL}.safetensors"
        if not weights.exists():
            raise InputError(f"not trained: no {weights.relative_to(self.options.runs)}; run train_folds.py")
        return Denoiser(MODEL, weights=weights)

    def _score(self, scene: str, denoiser: Denoiser, method: str) -> Iterable[tuple[str, Errors]]:
        folder = self.options.dataset / scene
        if not folder.is_dir():
            raise InputError(f"no such scene in DATASET: {scene}")
        sequence = open_sequence(folder, self.options.frames)
        check_references(sequence)
        values: dict[str, dict[str, list[float]]] = {}
        for number in sequence.numbers:
            frame = sequence.frame(number)
            images = pick(denoiser.output(frame), method)
            if frame.reference is None:
                continue
            for name, image in images.items():
                for protocol in PROTOCOL_NAMES:
                    for metric in ("PSNR", "SSIM"):
                        value = PROTOCOLS[protocol].metrics[metric].function(image, frame.reference)
                        values.setdefault(name, {}).setdefault(f"{protocol} {metric}", []).append(float(value))
        return ((name, {key: mean(own) for key, own in found.items()}) for name, found in values.items())


def pick(output: Output, method: str) -> dict[str, Tensor]:
    """The images that count, by name: the result, or what a network was given; and that of the first network."""
    stages = output.stages
    images = {method: stages[method] if method in ("noisy", "accumulated") else output.image}
    return images | ({f"{method}, initial": stages["initial"]} if "initial" in stages and method in VARIANTS else {})


def cell(errors: Errors | str, notes: Footnotes) -> list[str]:
    """PSNR and SSIM by each protocol, or one empty cell for each."""
    if isinstance(errors, str):
        return [notes.empty(errors)] * len(PROTOCOL_NAMES)
    return [f"{errors[f'{name} PSNR']:.2f} / {errors[f'{name} SSIM']:.4f}" for name in PROTOCOL_NAMES]


def table_1(measured: Measured, notes: Footnotes) -> list[list[str]]:
    methods = ["noisy", "accumulated", *ABSENT, "OIDN", "P+K, initial", "P+K"]
    rows = [["method", "protocol", *measured.options.scenes, "average"]]
    for method in methods:
        if method in ABSENT:
            cells = [cell(ABSENT[method], notes)] * (len(measured.options.scenes) + 1)
        else:
            cells = [cell(measured.errors(method, scene), notes) for scene in measured.options.scenes]
            cells.append(cell(measured.average(method), notes))
        for i, protocol in enumerate(PROTOCOL_NAMES):
            rows.append([method, protocol, *(own[i] for own in cells)])
    return rows


def table_2(measured: Measured, notes: Footnotes) -> list[list[str]]:
    """The networks alone, on noise: the time does not depend on what is seen, nor on the weights."""
    rounds, size = measured.options.rounds, (720, 1280)
    torch.manual_seed(0)
    channels = {"color": 3, "albedo": 3, "normal": 3, "depth": 1}
    frame = Frame(**{name: torch.rand(1, count, *size) for name, count in channels.items()})
    models: dict[str, Model] = {}
    for name in ("K", "P", "K+P", "K+K", "P+K"):
        model = create_model(MODEL, **parse_settings("settings", VARIANTS[name].settings))
        models[name] = next(parts_of(model, Accumulated)).inner
        models[name].to(memory_format=torch.channels_last)
    absent = dict(ABSENT)
    try:
        models["OIDN"] = create_model(
            "oidn", quality="high", auxiliary="clean", source="raw", threads=torch.get_num_threads()
        )
    except InputError as error:
        absent["OIDN"] = str(error)
    calls: dict[str, Callable[[], object]] = {name: lambda model=model: model(frame) for name, model in models.items()}
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds + 1):
        for name, call in calls.items():
            start = time.perf_counter()
            with torch.no_grad():
                call()
            times[name].append((time.perf_counter() - start) * 1e3)
    rows = [["method", "milliseconds at 1280x720", "quartiles"]]
    for name, own in times.items():
        lower, _, upper = quantiles(own[1:], n=4)
        rows.append([name, f"{median(own[1:]):.1f}", f"{lower:.1f} .. {upper:.1f}"])
    return rows + [[name, notes.empty(reason), ""] for name, reason in absent.items()]


def ablation(measured: Measured, notes: Footnotes, names: Iterable[str]) -> list[list[str]]:
    rows = [["network", "parameters", *(f"{name} PSNR / SSIM" for name in PROTOCOL_NAMES)]]
    for name in names:
        model = create_model(MODEL, **parse_settings("settings", VARIANTS[name].settings))
        parameters = sum(own.numel() for own in model.parameters())
        rows.append([name, f"{parameters:,}", *cell(measured.average(name), notes)])
    return rows


def table_3(measured: Measured, notes: Footnotes) -> list[list[str]]:
    return ablation(measured, notes, ("K", "P", "K+P", "K+K", "P+K"))


def table_4(measured: Measured, notes: Footnotes) -> list[list[str]]:
    return ablation(measured, notes, ("P+K without BWA", "P+K without TL", "P+K"))


TABLES = {
    1: ("PSNR / SSIM of each method on each scene", table_1),
    2: ("Time of the networks alone", table_2),
    3: ("Order of the networks, mean over the scenes", table_3),
    4: ("Bilateral weights and temporal loss, mean over the scenes", table_4),
}


def show(rows: list[list[str]], markdown: bool) -> str:
    if markdown:
        rule = ["---"] * len(rows[0])
        return "\n".join(f"| {' | '.join(row)} |" for row in [rows[0], rule, *rows[1:]])
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("dataset", type=Path, metavar="DATASET", help="folder of the scenes' folders")
    parser.add_argument("--runs", type=Path, required=True, metavar="RUNS", help="what train_folds.py wrote")
    parser.add_argument("--tables", type=int, nargs="+", choices=TABLES, default=list(TABLES))
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), metavar="NAME", help="of the dataset; its six")
    parser.add_argument("--split", choices=get_args(Split), default="grouped", help="what is held out, see folds.py")
    parser.add_argument("--frames", metavar="NUMBERS", help="which frames to use, such as 0-15; all by default")
    parser.add_argument("--rounds", type=int, default=5, help="of Table 2")
    parser.add_argument("--threads", type=int, metavar="N", help="of the networks and of OIDN")
    parser.add_argument("--markdown", action="store_true")
    return parser.parse_args()


def main() -> None:
    options = parse()
    for name, lowest in (("rounds", 2), ("threads", 1)):
        value = getattr(options, name)
        if value is not None and value < lowest:
            raise InputError(f"--{name}: expected at least {lowest}, found {value}")
    if not options.dataset.is_dir():
        raise InputError(f"{options.dataset}: expected a folder of scenes, found none")
    if options.threads:
        torch.set_num_threads(options.threads)
    measured = Measured(options)
    for number in options.tables:
        title, make = TABLES[number]
        notes = Footnotes()
        rows = make(measured, notes)
        print(f"Table {number}. {title}; split: {options.split}.\n\n{show(rows, options.markdown)}\n")
        for i, reason in enumerate(notes.reasons, 1):
            print(f"[{i}] {reason}")
        print()


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
