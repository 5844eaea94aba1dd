"""Compose a denoiser from operators, without a network or weights.

    python examples/compose_denoiser.py path/to/sequence

The wrapper `Demodulated` divides by the albedo, and `Accumulated` blends the frames of the shot. The remaining noise is
filtered at three scales by cross-bilateral weights over normals, albedo, depth and the color itself; a Laplacian fusion
merges each coarse result into the next finer scale, and the result is multiplied by the albedo. The script prints the
errors of the noisy, the accumulated and the composed image for the last frames that have a reference. Change SCALES,
the guides, or the order of the steps, and see the effect. A filter like this one blurs details that no guide shows,
such as the image in a mirror. Every command accepts it as a method: `mcdenoise denoise SEQUENCE -o OUT --model
examples/compose_denoiser.py:method`, and likewise `benchmark` and `evaluate`.
"""

import argparse
from pathlib import Path

import torch
from torch import Tensor

from mcdenoise import Denoiser, Frame
from mcdenoise.data import open_sequence
from mcdenoise.metrics import psnr_srgb, smape_linear
from mcdenoise.models import Accumulated, Demodulated, Needs, Output
from mcdenoise.nn import auto_exposure, normalize_depth
from mcdenoise.ops import cross_bilateral_weights, downsample, kernel_conv, laplacian_fusion, upsample

# Falloff of a neighbour's weight with the squared difference of normal, albedo, depth and color, and with the squared
# distance in pixels; one row for each scale, finest first. Coarse scales are stricter, because light that leaks across
# an edge there spreads over many pixels. fit_filter_parameters.py finds such numbers by gradient descent.
SCALES = torch.tensor([[5, 1, 2000, 0.1, 0.1], [50, 2, 6000, 0.7, 0.03], [100, 20, 6000, 2.5, 0.05]])
FUSION = torch.tensor(0.9)  # fraction of the low frequencies that comes from the coarser scale
KERNEL_SIZE = 5


def prepare(color: Tensor, frame: Frame) -> tuple[Tensor, list[Tensor]]:
    """The accumulated color without fireflies, and the guides, in units that are independent of the scene."""
    ring = color.new_full((1, KERNEL_SIZE**2, *frame.size), 1 / (KERNEL_SIZE**2 - 1))
    ring[:, KERNEL_SIZE**2 // 2] = 0
    brightness = color.mean(1, keepdim=True)
    # Clamp fireflies to eight times the mean of their neighbours; they would leave bright squares at coarse scales.
    color = color * (8 * kernel_conv(brightness, ring) / brightness.clamp_min(1e-6)).clamp_max(1)
    return color, [frame.normal, frame.albedo, normalize_depth(frame.depth), torch.log1p(color * auto_exposure(color))]


def denoise(color: Tensor, length: Tensor, guides: list[Tensor], scales: Tensor, fusion: Tensor) -> Tensor:
    """Filter demodulated, accumulated color; pixels are weighted by their history length `length`."""
    # Where the history is short, relax the falloff: a less similar neighbour is better than noise.
    falloffs = [falloff * (length / 4).clamp_max(1) for falloff in scales[0, :-1]]
    if len(scales) > 1:
        coarse_length = downsample(length)
        coarse_color = downsample(color * length) / coarse_length
        coarse = denoise(coarse_color, coarse_length, [downsample(guide) for guide in guides], scales[1:], fusion)
        # A pixel that differs from the mean of its 2x2 block, at an edge or a thin object, ignores the coarse image.
        means = [upsample(downsample(guide), guide.shape[-2:]) for guide in guides]
        parts = zip(falloffs, guides, means, strict=True)
        unlike = sum(falloff * (guide - mean).square().sum(1, keepdim=True) for falloff, guide, mean in parts)
        color = laplacian_fusion(color, coarse, fusion * torch.exp(-unlike))
    # With logits of zero, only the guides and the distance determine the kernel.
    logits = color.new_zeros(1, KERNEL_SIZE**2, *color.shape[-2:])
    distance = scales[0, -1].expand_as(length)
    weights = cross_bilateral_weights(logits, guides, falloffs, distance, border="renormalize")
    # The fusion of scales may produce negative values, which radiance cannot have.
    return (kernel_conv(color * length, weights) / kernel_conv(length, weights)).clamp_min(0)


class Composed:
    """The filter as a method that any wrapper accepts."""

    needs = Needs(frozenset({"color", "albedo", "normal", "depth", "length"}), trainable=False)

    def __call__(self, frame: Frame, state: None = None) -> tuple[Output, None]:
        """Filter the color that the wrappers pass in."""
        color, guides = prepare(frame.color, frame)
        return Output(denoise(color, frame.length, guides, SCALES, FUSION)), None


def method() -> Demodulated:
    """The filter with its wrappers."""
    return Demodulated(Accumulated(Composed()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("sequence", type=Path, help="folder with color, albedo, normals, positions and references")
    parser.add_argument("--last", type=int, default=3, metavar="N", help="score the last N frames with a reference")
    options = parser.parse_args()

    sequence, denoiser = open_sequence(options.sequence), Denoiser(method())
    if not sequence.reference_numbers:
        parser.error("expected frames with references to compare with")
    print("SMAPE / PSNR      noisy           accumulated        composed")
    for number in sequence.numbers:
        frame = sequence.frame(number)
        output = denoiser.output(frame)
        if number in sequence.reference_numbers[-options.last :]:
            images = [frame.color, output.stages["accumulated"], output.image]
            errors = [(float(smape_linear(x, frame.reference)), float(psnr_srgb(x, frame.reference))) for x in images]
            print(f"frame {number:<6}", "   ".join(f"{smape:.4f} {psnr:5.2f} dB" for smape, psnr in errors))


if __name__ == "__main__":
    main()
