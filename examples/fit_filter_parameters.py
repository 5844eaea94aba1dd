"""Fit a filter's parameters by gradient descent through the operators.

    python examples/fit_filter_parameters.py path/to/sequence --held-out path/to/another/sequence

The filter is that of compose_denoiser.py: at each of three scales, the falloffs of a neighbour's weight with the
differences of normal, albedo, depth, color and distance, and the weight of the coarse scales in the fusion. These 16
numbers start at 1 (the weight at 0.5) and follow the gradient of the error against references. Prints the loss, the
fitted numbers, and the error before and after on frames that were not used for fitting: those of another sequence, or
by default the last quarter of all frames.
"""

import argparse
from pathlib import Path

import torch
from compose_denoiser import denoise, prepare
from torch import Tensor

from mcdenoise.data import open_sequence
from mcdenoise.metrics import smape_linear
from mcdenoise.models import Accumulated, Demodulated, Output
from mcdenoise.ops import remodulate

NAMES = ("normal", "albedo", "depth", "color", "distance")
REPORT_EVERY = 20


def samples(folder: Path) -> list[dict]:
    """Accumulated frames with references, as arguments of the filter and the expected result."""
    sequence, found, state = open_sequence(folder), [], None

    def note(color: Tensor, length: Tensor) -> Output:
        light.update(color=color, length=length)
        return Output(color)

    accumulated = Demodulated(Accumulated(note))
    for number in sequence.numbers:
        frame, _ = sequence.frame(number).validate()
        light: dict[str, Tensor] = {}
        _, state = accumulated(frame, state)
        if frame.reference is not None:
            color, guides = prepare(light["color"], frame)
            found.append(
                {"inputs": (color, light["length"], guides), "albedo": frame.albedo, "target": frame.reference}
            )
    return found


def error(sample: dict, log_scales: Tensor, fusion_logit: Tensor) -> Tensor:
    # Logarithms and a logit keep the scales positive and the weight between 0 and 1.
    filtered = denoise(*sample["inputs"], log_scales.exp(), fusion_logit.sigmoid())
    return smape_linear(remodulate(filtered, sample["albedo"]), sample["target"]).mean()


@torch.no_grad()
def mean_error(frames: list[dict], *parameters: Tensor) -> float:
    return sum(float(error(sample, *parameters)) for sample in frames) / len(frames)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("sequences", type=Path, nargs="+", help="folders of frames with references to fit to")
    parser.add_argument("--held-out", type=Path, help="another sequence to test on")
    parser.add_argument("--steps", type=int, default=80)
    options = parser.parse_args()

    torch.manual_seed(0)
    frames = [sample for folder in options.sequences for sample in samples(folder)]
    quarter = max(1, len(frames) // 4)
    held_out = samples(options.held_out) if options.held_out else frames[-quarter:]
    train = frames if options.held_out else frames[:-quarter]
    if not (train and held_out):
        parser.error("expected at least two frames with references")

    parameters = [torch.zeros(3, len(NAMES), requires_grad=True), torch.zeros((), requires_grad=True)]
    before = mean_error(held_out, *parameters)
    optimizer = torch.optim.Adam(parameters, lr=0.2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, options.steps)
    for step in range(options.steps + 1):
        if step % REPORT_EVERY == 0:
            print(f"step {step:3}   SMAPE {mean_error(train, *parameters):.4f}")
        sample = train[int(torch.randint(len(train), ()))]
        optimizer.zero_grad()
        error(sample, *parameters).backward()
        optimizer.step()
        schedule.step()

    log_scales, fusion_logit = parameters
    print("\nscale  " + "".join(f"{name:>10}" for name in NAMES))
    for scale, row in enumerate(log_scales.exp().tolist()):
        print(f"1/{2**scale:<5}" + "".join(f"{value:10.3g}" for value in row))
    print(f"weight of the coarse scales: {fusion_logit.sigmoid().item():.2f}\n")
    print(f"held-out SMAPE   before {before:.4f}   after {mean_error(held_out, *parameters):.4f}")


if __name__ == "__main__":
    main()
