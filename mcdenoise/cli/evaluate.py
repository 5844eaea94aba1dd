"""`mcdenoise evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from mcdenoise.cli._options import Json
from mcdenoise.cli._output import frames_of, print_rows, say, warn, write_json
from mcdenoise.data import open_sequence
from mcdenoise.data.readers.files import RenderedFiles
from mcdenoise.errors import InputError
from mcdenoise.evaluate import Evaluation, evaluate_folder, evaluate_halves, evaluate_method
from mcdenoise.methods import parse_method
from mcdenoise.metrics.protocols import ProtocolName

Images = tyro.conf.Positional[Annotated[tuple[Path, ...], tyro.conf.arg(metavar="[IMAGES ...]", help_behavior_hint="")]]


def evaluate(
    sequence: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="SEQUENCE")]],
    images: Images = (),
    model: str | None = None,
    half: Path | None = None,
    protocol: ProtocolName = "strict",
    frames: str | None = None,
    json: Json = None,
) -> None:
    """Compare denoised images, or those of a model, with references: two files, two folders, or those of a sequence.

    Without references, --half tells which of several denoisers is best, from two renderings with different seeds.

    Args:
        sequence: the reference: an image, or a folder or pattern of images; or a folder of a sequence with references.
            With --half, the noisy frames that were denoised.
        images: the denoised image, or a folder with one EXR per frame, such as denoised12.exr or frame.0012.exr,
            scene-linear RGB, written by any denoiser. With --half, one for each denoiser.
        model: evaluate this model instead: a name with optional settings, a weights file, or file.py:factory, as for
            `mcdenoise denoise`; "NAME(device=cuda)" runs on a GPU.
        half: the same noisy frames, rendered with another seed, which no denoiser has seen.
        protocol: protocol of a publication, whose numbers are printed in addition to the strict ones.
        frames: frames to compare, such as 0-59,70; by default all frames that have a reference.
        json: write the printed figures to this file too.
    """
    named = ", ".join(map(str, images))
    if images and model is not None:
        raise InputError(f"expected a folder of images or --model, found both, {named} and {model}; omit one of them")
    if half is not None:
        if not images or protocol != "strict":
            found = f"--protocol {protocol}" if images else "none"
            raise InputError(f"--half: expected folders of denoised images, and the strict protocol, found {found}")
        _evaluate_halves(sequence, half, images, frames, json)
        return
    if not images and model is None:
        raise InputError(
            f"expected a folder of images or --model, found only the sequence {sequence}; name the folder after it, or "
            "add --model NAME to denoise and compare"
        )
    if len(images) > 1:
        raise InputError(f"expected one folder of images, found {named}; several are compared by --half")
    opened = open_sequence(sequence, frames)
    if images and not opened.reference_numbers:
        if isinstance(opened, RenderedFiles):
            opened = open_sequence(sequence, frames, mapping=[f"reference={opened.choice.written[0]}"])
        else:
            opened = open_sequence({"color": sequence, "reference": sequence}, frames)
        say(f"{sequence} has no references, and is taken as the reference")
    spelling = None if model is None else parse_method(model)
    total = len(opened.reference_numbers if spelling is None else opened.numbers)
    with frames_of("evaluate", total) as advance:
        if spelling is None:
            result = evaluate_folder(opened, images[0], protocol=protocol, on_frame=advance)
        else:
            denoiser = spelling.denoiser()
            warn(spelling.doubt)
            result = evaluate_method(opened, denoiser, spelling.name, protocol=protocol, on_frame=advance)
    _print_evaluation(result)
    write_json(json, result.as_json())


def _evaluate_halves(
    sequence: Path, half: Path, images: tuple[Path, ...], frames: str | None, json: Path | None
) -> None:
    first, other = (open_sequence(each, frames) for each in (sequence, half))
    with frames_of("evaluate", len(first)) as advance:
        result = evaluate_halves(first, other, {str(each): each for each in images}, advance)
    warn(*result.doubts)
    best, *others = result.ranking
    errors = {name: result.error(name) for name in (best, *others)}
    print_rows([{"image": name, "error": f"{of:.3g}", "±": f"{margin:.2g}"} for name, (of, margin) in errors.items()])
    for name in others:
        excess, margin = result.difference(name, best)
        if excess > margin:
            say(f"{best} is better than {name}: its error is lower by {excess:.3g} ± {margin:.2g}")
        else:
            say(f"{best} or {name}: {excess:.3g} ± {margin:.2g} apart, too little to tell; compare more frames")
    say(f"error: squared, relative to the brightness around; {result.frames} frames; within ± in 95 of 100 cases")
    write_json(json, result.as_json())


def _print_evaluation(result: Evaluation) -> None:
    strict = result.tables["strict"]
    for name, own in result.tables.items():
        columns = {}
        for metric in own.mean:
            columns[metric if own is strict else f"{metric} {name}"] = own, metric
            # Only these are comparable; a protocol may compute other metrics, such as SMAPE, of displayed values.
            if own is not strict and metric in ("PSNR", "SSIM") and metric in strict.mean:
                columns[f"{metric} strict"] = strict, metric
        rows = {
            str(number): {key: of.frames[number].get(each) for key, (of, each) in columns.items()}
            for number in own.frames
        }
        rows["mean"] = {key: of.mean[each] for key, (of, each) in columns.items()}
        if own is strict and result.floor:
            rows["perfect"] = {key: result.floor.get(each) for key, (_, each) in columns.items()}
        if columns:
            print_rows([{"frame": of} | {key: _figure(x) for key, x in row.items()} for of, row in rows.items()])
        say(f"{name}: {own.description}")
        for reason in dict.fromkeys(own.skipped.values()):
            without = [metric for metric, why in own.skipped.items() if why == reason]
            say(f"{name}: no {', '.join(without)}: {reason}")
    if result.warping_error:
        ours, theirs = result.warping_error
        print(f"warping error (Lai et al. 2018): {ours:.4g}; of the references {theirs:.4g}")
    if result.reference_noise is not None:
        print(
            f"perfect: estimated score of the truth, given that the SMAPE of the references themselves is about "
            f"{result.reference_noise:.4g}"
        )


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"
