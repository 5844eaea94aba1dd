"""Measure how much time skipping saves, and how it changes the error.

    python examples/skipped.py path/to/scene path/to/another --model wild_small
    python examples/skipped.py path/to/scene --markdown --tolerance 0.01

The script makes five shots of each scene: the original flythrough; the flythrough without albedo; the flythrough with a
sky in its upper half; a static shot of the last frame that has a reference, with new noise in every frame (one sample
per pixel); and a viewport in an editor, twice as long, that repeats one image of that frame (64 samples per pixel)
until a corner of it is changed and rendered again (one sample per pixel). Each frame is denoised twice, taking turns:
with and without skipping. The last column is the change of SMAPE.
"""

import argparse
import statistics
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from run_time import check_least
from torch import Tensor

from mcdenoise import Denoiser, Frame, InputError
from mcdenoise.data import Sequence, open_sequence
from mcdenoise.errors import run_script
from mcdenoise.metrics import smape_linear
from mcdenoise.models import DEFAULT
from mcdenoise.models._report import Stage, summarize
from mcdenoise.models.skipping import TOLERANCE

COLUMNS = ("scene", "shot", "skipped", "ms, all kept", "ms", "saved", "SMAPE, all kept", "SMAPE", "change")


def flythrough(sequence: Sequence, frames: int) -> Iterator[Frame]:
    """The first frames, unchanged."""
    yield from (sequence.frame(number) for number in sequence.numbers[:frames])


def without_albedo(sequence: Sequence, frames: int) -> Iterator[Frame]:
    """The flythrough as from a renderer that writes no albedo."""
    yield from (frame.replace(albedo=None) for frame in flythrough(sequence, frames))


def half_sky(sequence: Sequence, frames: int) -> Iterator[Frame]:
    """The flythrough with a sky in its upper half."""
    for frame in flythrough(sequence, frames):
        height, width = frame.size
        above = torch.arange(height)[:, None].expand(1, 1, height, width) < height // 2
        blue = torch.tensor([0.3, 0.5, 0.9]).reshape(1, 3, 1, 1) * torch.linspace(1, 2, height)[:, None]
        values = {"color": blue, "reference": blue, "albedo": 0, "normal": 0, "depth": torch.inf}
        buffers = {name: torch.where(above, values[name], value) for name, value in frame.items() if name in values}
        yield frame.replace(**buffers)


def noisy(reference: Tensor, spp: int) -> Tensor:
    """Add noise like that of this number of samples per pixel."""
    rate = torch.full_like(reference[:, :1], float(spp))
    return reference * torch.distributions.Gamma(rate, rate).sample()


def at_rest(sequence: Sequence) -> Frame:
    """The last frame with a reference, without motion."""
    frame = sequence.frame(sequence.reference_numbers[-1])
    return frame.replace(motion=torch.zeros_like(frame.color[:, :2]))


def static_shot(sequence: Sequence, frames: int) -> Iterator[Frame]:
    """A static shot at one sample per pixel."""
    frame = at_rest(sequence)
    for _ in range(frames):
        yield frame.replace(color=noisy(frame.reference, 1))


def viewport_edit(sequence: Sequence, frames: int) -> Iterator[Frame]:
    """A repeated image, of which one corner becomes darker in the last third of the shot."""
    frame = at_rest(sequence)
    frame = frame.replace(color=noisy(frame.reference, 64))
    height, width = frame.size
    corner = (..., slice(height // 5), slice(width // 5))
    edited: dict[str, Tensor] = {name: value.clone() for name, value in frame.items()}
    for name in {"albedo", "reference"} & edited.keys():
        edited[name][corner] *= 0.5
    for number in range(2 * frames):
        if number >= frames + frames // 3:
            edited["color"] = frame.color.clone()
            edited["color"][corner] = noisy(edited["reference"][corner], 1)
        yield frame if number < frames + frames // 3 else Frame(**edited)


SHOTS: dict[str, Callable[[Sequence, int], Iterator[Frame]]] = {
    "flythrough": flythrough,
    "no albedo": without_albedo,
    "half sky": half_sky,
    "static shot": static_shot,
    "viewport edit": viewport_edit,
}


def measure(name: str, shot: str, frames: Iterator[Frame], denoisers: tuple[Denoiser, Denoiser]) -> list[str]:
    """Measure a row of the table; the first frame warms up and is not timed."""
    times: tuple[list[float], list[float]] = ([], [])
    errors: tuple[list[float], list[float]] = ([], [])
    planned: list[list[Stage]] = []
    for denoiser in denoisers:
        denoiser.reset()
    for number, frame in enumerate(frames):
        for denoiser, own_times, own_errors in zip(denoisers, times, errors, strict=True):
            image = denoiser(frame)
            if number > 0:
                own_times.append(sum(denoiser.report.milliseconds.values()))
            if frame.reference is not None:
                own_errors.append(float(smape_linear(image, frame.reference)))
        planned.append(list(denoisers[1].report.stages.values()))
    skipped = ", ".join(f"{row['stage']} {row['skipped']:.0%}" for row in summarize(planned) if row["skipped"])
    whole, short = (statistics.mean(own) for own in times)
    before, after = (statistics.mean(own) for own in errors)
    figures = (f"{whole:.1f}", f"{short:.1f}", f"{1 - short / whole:.0%}", f"{before:.5f}", f"{after:.5f}")
    return [name, shot, skipped or "nothing", *figures, f"{after - before:+.1e}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("sequences", type=Path, nargs="+", metavar="SEQUENCE", help="folder of frames with references")
    parser.add_argument("--model", default=DEFAULT)
    parser.add_argument("--precision", choices=("float32", "bfloat16"), default="float32")
    parser.add_argument("--tolerance", type=float, default=TOLERANCE)
    parser.add_argument("--frames", type=int, default=12, metavar="N", help="frames of each shot")
    parser.add_argument("--threads", type=int, metavar="N")
    parser.add_argument("--markdown", action="store_true", help="print a table in Markdown")
    options = parser.parse_args()
    check_least(options, frames=2)
    if options.threads:
        torch.set_num_threads(options.threads)
    whole = Denoiser(options.model, precision=options.precision, keep_all=True)
    short = Denoiser(options.model, precision=options.precision, tolerance=options.tolerance)
    rows = []
    for path in options.sequences:
        sequence = open_sequence(path)
        referenced = set(sequence.reference_numbers) & set(sequence.numbers[: options.frames])
        if not referenced:
            raise InputError(f"{path}: expected references among the first {options.frames} frames, found none")
        for shot, make in SHOTS.items():
            torch.manual_seed(0)
            rows.append(measure(sequence.name, shot, make(sequence, options.frames), (whole, short)))
    if options.markdown:
        print(*(f"| {' | '.join(row)} |" for row in (COLUMNS, ["---"] * len(COLUMNS), *rows)), sep="\n")
        return
    widths = [max(len(row[i]) for row in (COLUMNS, *rows)) for i in range(len(COLUMNS))]
    for row in (COLUMNS, *rows):
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


if __name__ == "__main__":
    run_script(main)
