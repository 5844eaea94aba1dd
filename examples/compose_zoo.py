"""Put the head of one method on the backbone of another, train it for a minute, and measure its error.

    python examples/compose_zoo.py path/to/sequence

The U-Net is that of `mrkp`, and the importance maps are those of `wskp`: six per pixel, for windows of 3 to 13 pixels,
with weights that blend the six filtered images. The script trains on all but the last frames of the sequence, and
prints the errors on these before and after, beside those of the noisy and the accumulated image. Every command accepts
the method as `examples/compose_zoo.py:method`; for example, `mcdenoise train SEQUENCES -o RUN --model
examples/compose_zoo.py:method` trains it for longer.
"""

import argparse
import tempfile
from pathlib import Path

import torch
from torch import nn

from mcdenoise import Denoiser, Frame
from mcdenoise.data import open_sequence
from mcdenoise.metrics import psnr_srgb, smape_linear
from mcdenoise.models import Accumulated, Demodulated, Exposed, Needs, Output, answered, load_weights, with_carried
from mcdenoise.models.mrkp import Backbone
from mcdenoise.models.wskp import SIDES
from mcdenoise.nn import normalize_depth
from mcdenoise.ops import importance_filter
from mcdenoise.train import TrainConfig, train

HELD_OUT = 4  # frames at the end that are not trained on


class Composed(nn.Module):
    """Predicts importance maps, and weights for blending their results, by one convolution on the U-Net's features."""

    needs = Needs(frozenset({"albedo", "normal", "depth"}))

    def __init__(self, width: int) -> None:
        super().__init__()
        self.backbone = Backbone(10, width)
        self.head = nn.Conv2d(self.backbone.out_channels, 2 * len(SIDES), 3, padding=1)

    def forward(self, frame: Frame, state: None = None) -> tuple[Output, None]:
        """Filter the image with windows of every size, and blend the results."""
        seen = torch.log1p(frame.color), frame.albedo, frame.normal, normalize_depth(frame.depth)
        maps, blend = self.head(self.backbone(torch.cat(seen, 1))[0]).float().chunk(2, 1)
        light, weights = with_carried(frame), torch.softmax(blend, 1).split(1, 1)
        parts = zip(SIDES, maps.split(1, 1), weights, strict=True)
        return answered(frame, sum(w * importance_filter(light, m, kernel_size=k) for k, m, w in parts)), None


def method(width: int = 16):
    """The network in wrappers for demodulation, accumulation and exposure."""
    return Demodulated(Accumulated(Exposed(Composed(width))))


def report(name: str, denoiser: Denoiser, sequence) -> None:
    """Print the error on the frames that were held out."""
    errors = []
    for number in sequence.numbers:
        frame = sequence.frame(number)
        image = denoiser(frame.replace(reference=None))
        if number in sequence.numbers[-HELD_OUT:] and frame.reference is not None:
            errors.append((smape_linear(image, frame.reference).mean(), psnr_srgb(image, frame.reference).mean()))
    smape, psnr = torch.tensor(errors).mean(0).tolist()
    print(f"{name:12} SMAPE {smape:.4f}  {psnr:.2f} dB")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sequence", type=Path, help="folder with references")
    parser.add_argument("--steps", type=int, default=150, help="training steps")
    parser.add_argument("--crop", type=int, default=96, help="side of the training crops, in pixels")
    arguments = parser.parse_args()
    shot, name = open_sequence(arguments.sequence), f"{__file__}:method"
    for baseline in ("noisy", "accumulated", name):
        report(baseline.replace(name, "untrained"), Denoiser(baseline), shot)
    size = {"batch": 4, "frames": 2, "crop": arguments.crop, "validation_frames": HELD_OUT}
    config = TrainConfig(name, steps=arguments.steps, learning_rate=2e-3, **size)
    with tempfile.TemporaryDirectory() as folder:
        weights = train(config, [arguments.sequence], Path(folder) / "run")
        report("trained", Denoiser(load_weights(weights, name)), shot)
