"""Print the paper's Tables 1 to 4 for the available scenes, trained networks and peers, with reasons for missing cells.

    python examples/paper_tables/tables.py DATASET
    python examples/paper_tables/tables.py DATASET --runs RUNS --tables 3 4 --markdown

DATASET is a folder with a sequence in the BMFR layout for each scene.

Table 1 lists PSNR and SSIM of each method on each scene; Table 2 the milliseconds of networks and filters at 1280x720;
Table 3 compares the orders of the networks (K, P, K+P, K+K, P+K); Table 4 compares networks with and without bilateral
weights (BWA) and temporal loss (TL). Below each table, the script lists which of the paper's claims hold here. PSNR and
SSIM are computed by three protocols: "strict" (sRGB curve, data range 1), and those of the code of two other papers,
"meng2020" and "fan2021", which the published figures on this dataset seem to follow.

The networks are those in RUNS; in Table 1 missing ones are replaced by the shipped ones:

    mcdenoise train --recipe recipes/zoo.toml -o RUNS/zoo               Table 1, trained on random scenes
    mcdenoise train --recipe recipes/ablations.toml -o RUNS/ablations   Tables 3 and 4, likewise, three seeds of each
    python examples/paper_tables/train_folds.py DATASET -o RUNS         Tables 3 and 4, leaving one scene out
    python examples/paper_tables/train_folds.py DATASET -o RUNS --recipe recipes/zoo.toml
                                                                        Table 1 with --leave-one-out

All networks of a table have the same training settings, and their input is accumulated by the same rule with alpha 0.2:
"accumulated". OIDN denoises the noisy frames, with features declared as clean.
"""

import argparse
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import product
from pathlib import Path
from statistics import mean, median, quantiles
from typing import Any, get_args

import torch
from folds import FILTERS, KEPT, ORDERS, OTHERS, OWN, PARTS, RIVALS, Split, fold_folder, scenes_of
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

from mcdenoise import Denoiser, Frame
from mcdenoise.data import open_sequence
from mcdenoise.errors import InputError, run_script
from mcdenoise.evaluate import check_references
from mcdenoise.metrics import PROTOCOLS, smape_linear
from mcdenoise.models import Output, create_model, describe_weights
from mcdenoise.models._published import as_published
from mcdenoise.models._weights import compared_models
from mcdenoise.models._wrapper import parts_of
from mcdenoise.models.accumulated import Accumulated
from mcdenoise.turns import interleaved

PROTOCOL_NAMES = ("strict", "meng2020", "fan2021")
SMAPE = "linear SMAPE"
SAME_INPUT = "joint bilateral of the accumulated image"
# Open Image Denoise as it is best, and at its fastest.
PEERS = {
    name: {"quality": quality, "auxiliary": "clean", "source": "raw"}
    for name, quality in {"OIDN": "high", "OIDN, fast": "fast"}.items()
}
SEEDS = (1, 2, 3)
KINDS = ("random scenes", "leave one out")
Errors = dict[str, float]  # by "protocol metric", and SMAPE of linear radiance


@dataclass
class Table:
    """Rows of cells, the distinct reasons of empty cells, and the claims that were checked."""

    rows: list[list[str]]
    reasons: list[str] = field(default_factory=list)
    claims: list[str] = field(default_factory=list)

    def cells(self, errors: Errors | str) -> list[str]:
        """PSNR and SSIM by each protocol, or empty cells with the number of the reason."""
        if isinstance(errors, str):
            if errors not in self.reasons:
                self.reasons.append(errors)
            return [f"- [{self.reasons.index(errors) + 1}]"] * len(PROTOCOL_NAMES)
        cells = [f"{errors[f'{name} PSNR']:.2f} / {errors[f'{name} SSIM']:.4f}" for name in PROTOCOL_NAMES]
        cells[0] += f" / {errors[SMAPE]:.4f}"
        return cells

    def claim(self, text: str, better: Sequence[Errors | str], worse: Sequence[Errors | str]) -> None:
        """Add whether the first is better than the second in strict PSNR, and in SMAPE, in the mean over scenes."""
        pairs = [
            (a, b) for a, b in zip(better, worse, strict=True) if not isinstance(a, str) and not isinstance(b, str)
        ]
        if not pairs or len(pairs) < len(better):
            return
        gains = {
            "dB PSNR": [a["strict PSNR"] - b["strict PSNR"] for a, b in pairs],
            "SMAPE": [b[SMAPE] - a[SMAPE] for a, b in pairs],
        }
        said = [
            f"{'holds' if mean(own) > 0 else 'does not hold'} in {unit} ({mean(own):+.3f}, p = {chance(own):.3f})"
            for unit, own in gains.items()
        ]
        self.claims.append(f"{text}: {'; '.join(said)}")


def chance(gains: Sequence[float]) -> float:
    """Probability of a mean at least as far from 0 if each scene's gain could as well have the other sign.

    The exact paired test of Fisher; with six scenes it is at least 2 / 64.
    """
    signed = [abs(sum(each)) for each in product(*((gain, -gain) for gain in gains))]
    return sum(each >= abs(sum(gains)) - 1e-12 for each in signed) / len(signed)


class Measured:
    """Errors of networks on scenes, measured on the first request."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options = options
        self._known: dict[tuple[str, str], dict[str, Errors]] = {}

    def errors(self, scene: str, model: str, weights: Path | None = None, *, image: str = "") -> Errors | str:
        """Mean errors over the frames of a scene, or the reason why there are none.

        Args:
            scene: a scene of the dataset.
            model: name of a model.
            weights: weights of the model; by default the shipped ones.
            image: name of a stage to score instead of the result.
        """
        key = (scene, f"{model} {weights}")
        try:
            if key not in self._known:
                self._known[key] = self._score(scene, self._denoiser(model, weights))
            return self._known[key].get(image, f"{model} has no stage {image}")
        except InputError as error:
            return str(error)

    def average(self, found: Iterable[Errors | str]) -> Errors | str:
        """The mean, or the first reason why there is none."""
        every = list(found)
        for each in every:
            if isinstance(each, str):
                return each
        known = [each for each in every if not isinstance(each, str)]
        return {name: mean(errors[name] for errors in known) for name in known[0]}

    def _denoiser(self, model: str, weights: Path | None) -> Denoiser:
        if model in PEERS:
            return Denoiser("oidn", **PEERS[model])
        if model == "accumulated":
            # Only its accumulated image is used, which is the input of all networks.
            return Denoiser(create_model("cascaded", width=4))
        if model == SAME_INPUT:
            (accumulated,) = parts_of(create_model("joint_bilateral"), Accumulated)
            return Denoiser(as_published(accumulated.inner))
        if weights is None or weights.exists():
            return Denoiser(model, weights=weights, precision="float32")
        raise InputError(f"not trained: no {weights.relative_to(self.options.runs)}")

    def _score(self, scene: str, denoiser: Denoiser) -> dict[str, Errors]:
        folder = self.options.dataset / scene
        if not folder.is_dir():
            raise InputError(f"no such scene in DATASET: {scene}")
        sequence = open_sequence(folder, self.options.frames)
        check_references(sequence)
        values: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
        for number in sequence.numbers:
            frame = sequence.frame(number)
            output = denoiser.output(frame)
            if frame.reference is None:
                continue
            for name, image in images_of(output).items():
                for protocol in PROTOCOL_NAMES:
                    for metric in ("PSNR", "SSIM"):
                        value = PROTOCOLS[protocol].metrics[metric].function(image, frame.reference)
                        values[name][f"{protocol} {metric}"].append(float(value))
                values[name][SMAPE].append(float(smape_linear(image, frame.reference).mean()))
        return {name: {key: mean(own) for key, own in found.items()} for name, found in values.items()}


def images_of(output: Output) -> dict[str, Tensor]:
    """The result, under an empty name, and the stages that tables show."""
    shown = {name: output.stages[name] for name in ("noisy", "accumulated", "initial") if name in output.stages}
    return {"": output.image, **shown}


def weights_of(run: Path, model: str) -> Path:
    """The weights of a run."""
    return run / f"{model}.safetensors"


def table_1(measured: Measured) -> Table:
    options = measured.options
    scenes = options.held_out if options.leave_one_out else options.scenes
    found = Table([["method", "protocol", *scenes, "average"]])

    def weights(model: str, scene: str) -> Path | None:
        if model not in (*RIVALS.values(), *OWN.values(), *OTHERS.values()):
            return None
        if options.leave_one_out:
            return weights_of(fold_folder(options.runs, options.split, scene, options.scenes) / model, model)
        own = weights_of(options.runs / "zoo" / model, model)
        return own if own.exists() or model not in compared_models() else None

    def of(model: str, image: str = "") -> list[Errors | str]:
        return [measured.errors(scene, model, weights(model, scene), image=image) for scene in scenes]

    every = {"noisy": of("accumulated", "noisy"), "accumulated": of("accumulated", "accumulated")}
    every |= {name: of(model) for name, model in RIVALS.items()}
    every |= {"P+K, initial": of("cascaded", "initial"), "P+K": of("cascaded")}
    every |= {name: of(model) for name, model in {**OTHERS, **FILTERS, **KEPT}.items()}
    every |= {name: of(name) for name in (SAME_INPUT, *PEERS)}
    averages = {name: measured.average(errors) for name, errors in every.items()}
    for name, errors in every.items():
        cells = [found.cells(each) for each in [*errors, averages[name]]]
        found.rows += [[name, protocol, *(own[i] for own in cells)] for i, protocol in enumerate(PROTOCOL_NAMES)]
    for name in (*RIVALS, *OTHERS, "SVGF", SAME_INPUT, *PEERS):
        found.claim(f"P+K is ahead of {name}", every["P+K"], every[name])
    found.claim("the final image is ahead of the initial one", every["P+K"], every["P+K, initial"])
    return found


def table_2(measured: Measured) -> Table:
    """Time the networks and filters without accumulation; a random frame suffices, as only its size matters."""
    rounds, size = measured.options.rounds, (720, 1280)
    torch.manual_seed(0)
    channels = {"color": 3, "albedo": 3, "normal": 3, "depth": 1}
    frame = Frame(**{name: torch.rand(1, count, *size) for name, count in channels.items()})
    found = Table([["method", "milliseconds at 1280x720", "quartiles", "convolutions", "rest"]])
    models: dict[str, Any] = {}
    for name, (model, settings) in _timed().items():
        try:
            made: Any = create_model(model, **settings)
        except InputError as error:
            found.reasons.append(f"{name}: {error}")
            continue
        models[name] = next((part.inner for part in parts_of(made, Accumulated)), made)
        if isinstance(made, torch.nn.Module):
            made.eval().to(memory_format=torch.channels_last)
    with torch.inference_mode():
        times = interleaved({name: partial(model, frame) for name, model in models.items()}, rounds)
        for name, model in models.items():
            lower, _, upper = quantiles(times[name][1:], n=4)
            middle = median(times[name][1:])
            part = _convolutions(model, frame)
            parts = ["-", "-"] if name in PEERS else [f"{part * middle:.0f}", f"{(1 - part) * middle:.0f}"]
            found.rows.append([name, f"{middle:.0f}", f"{lower:.0f} .. {upper:.0f}", *parts])
    return found


def _timed() -> dict[str, tuple[str, dict[str, Any]]]:
    zoo: dict[str, tuple[str, dict[str, Any]]] = {
        name: (model, {}) for name, model in {**RIVALS, **OTHERS, **FILTERS}.items() if name != "BMFR"
    }
    orders = {name: ("cascaded", {"cascade": name, "width": 40 if "+" in name else 64}) for name in ORDERS}
    peers = {name: ("oidn", {**settings, "threads": torch.get_num_threads()}) for name, settings in PEERS.items()}
    return {**orders, **zoo, **peers}


def _convolutions(model: Any, frame: Frame) -> float:
    """The fraction of the run time of one frame that convolutions take."""
    with profile(activities=[ProfilerActivity.CPU]) as seen:
        model(frame)
    events = seen.key_averages()
    whole = sum(event.self_cpu_time_total for event in events)
    return sum(event.self_cpu_time_total for event in events if "convolution" in event.key) / whole if whole else 0.0


def ablation(measured: Measured, variants: dict[str, str]) -> tuple[Table, dict[str, list[Errors | str]]]:
    """Rows of variants, trained on random scenes with three seeds, and with one scene held out."""
    options = measured.options
    columns = [f"{kind}, {name} PSNR / SSIM" for kind in KINDS for name in PROTOCOL_NAMES]
    found = Table([["network", "parameters", columns[0], "seeds, PSNR", *columns[1:]]])
    scenes: dict[str, list[Errors | str]] = {}
    for name, run in variants.items():
        seeds = [list(_seed(measured, options.runs / "ablations" / f"{run}-{seed}")) for seed in SEEDS]
        folds = [
            measured.errors(scene, "cascaded", weights_of(fold / f"{run}-{SEEDS[0]}", "cascaded"))
            for scene in options.held_out
            for fold in [fold_folder(options.runs, options.split, scene, (*options.scenes, scene))]
        ]
        means = [measured.average(own) for own in seeds]
        scenes[name] = [measured.average(own) for own in zip(*seeds, strict=True)]
        each = sorted(own["strict PSNR"] for own in means if not isinstance(own, str))
        spread = f"{each[0]:.2f} .. {each[-1]:.2f}" if len(each) == len(SEEDS) else "-"
        strict, *others = [
            cell for errors in (measured.average(means), measured.average(folds)) for cell in found.cells(errors)
        ]
        found.rows.append([name, _parameters(options.runs, run), strict, spread, *others])
    return found, scenes


def _seed(measured: Measured, run: Path) -> Iterator[Errors | str]:
    for scene in measured.options.scenes:
        yield measured.errors(scene, "cascaded", weights_of(run, "cascaded"))


def _parameters(runs: Path, run: str) -> str:
    weights = weights_of(runs / "ablations" / f"{run}-{SEEDS[0]}", "cascaded")
    if not weights.exists():
        return "-"
    model: Any = create_model("cascaded", **describe_weights(weights)["settings"])
    return f"{sum(own.numel() for own in model.parameters()):,}"


def table_3(measured: Measured) -> Table:
    found, scenes = ablation(measured, {name: name for name in ORDERS})
    for name in ORDERS[:-1]:
        found.claim(f"P+K is ahead of {name}", scenes["P+K"], scenes[name])
    found.claim("P is ahead of K", scenes["P"], scenes["K"])
    return found


def table_4(measured: Measured) -> Table:
    found, scenes = ablation(measured, PARTS)
    found.claim("bilateral weights help", scenes["P+K"], scenes["P+K without BWA"])
    found.claim("the temporal loss helps", scenes["P+K"], scenes["P+K without TL"])
    return found


TABLES: dict[int, tuple[str, Callable[[Measured], Table]]] = {
    1: ("PSNR / SSIM of each method on each scene", table_1),
    2: ("Time of networks and filters, without accumulation", table_2),
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
    parser.add_argument("--runs", type=Path, default=Path("runs"), metavar="RUNS", help="folder of the training runs")
    parser.add_argument("--tables", type=int, nargs="+", choices=TABLES, default=list(TABLES))
    parser.add_argument("--scenes", nargs="+", metavar="NAME", help="scenes of the dataset; all by default")
    parser.add_argument("--held-out", nargs="+", metavar="NAME", help="scenes with a fold; all by default")
    parser.add_argument("--leave-one-out", action="store_true", help="Table 1 of networks trained without the scene")
    parser.add_argument("--split", choices=get_args(Split), default="grouped", help="split of the folds, see folds.py")
    parser.add_argument("--frames", metavar="NUMBERS", help="frames to use, such as 0-15; all by default")
    parser.add_argument("--rounds", type=int, default=5, help="timed repetitions for Table 2")
    parser.add_argument("--threads", type=int, metavar="N", help="threads of the networks and of OIDN")
    parser.add_argument("--markdown", action="store_true")
    return parser.parse_args()


def main() -> None:
    options = parse()
    for name, minimum in (("rounds", 2), ("threads", 1)):
        value = getattr(options, name)
        if value is not None and value < minimum:
            raise InputError(f"--{name}: expected at least {minimum}, found {value}")
    if not options.dataset.is_dir():
        raise InputError(f"{options.dataset}: expected a folder of scenes, found none")
    options.scenes = options.scenes or scenes_of(options.dataset)
    options.held_out = options.held_out or options.scenes
    if options.threads:
        torch.set_num_threads(options.threads)
    measured = Measured(options)
    for number in options.tables:
        title, make = TABLES[number]
        found = make(measured)
        print(f"Table {number}. {title}.\n\n{show(found.rows, options.markdown)}\n")
        for i, reason in enumerate(found.reasons, 1):
            print(f"[{i}] {reason}")
        for claim in found.claims:
            print(f"- {claim}")
        print(flush=True)


if __name__ == "__main__":
    run_script(main)
