"""SBMC: every sample is splatted over its neighbours with its own kernel.

Gharbi et al. 2019, "Sample-based Monte Carlo Denoising using a Kernel-Splatting Network", ACM Transactions on Graphics
(SIGGRAPH). ``PUBLISHED`` holds the sizes of their code: embeddings of 128 channels by chains of three 1x1 convolutions,
three rounds of embedding and U-Net (three levels with three convolutions each, on the mean over the samples), and
kernels of 21x21; training it requires a GPU. The default is smaller and trains on a CPU.

Splatting lets a sample decide which pixels receive its light, so that a firefly is suppressed where it occurs. Each
pixel is the mean of the light that it receives, with exponential weights (:func:`mcdenoise.ops.softmax_splat`, one
sample after the other).

The first three channels of ``samples`` ``(B, S, C, H, W)`` are radiance. **In a frame without samples, the color is the
only sample of a pixel.** Differences from the paper:

- features are those of the pixel, not of each sample; random numbers and path probabilities are not used;
- light is accumulated over frames by the rule of :mod:`mcdenoise.models.cascaded`, demodulated, as for all compared
  methods. Samples belong to the current frame, so the accumulated color is one more sample, marked by one over the
  history length. The authors denoise single images with albedo, as :class:`SbmcNetwork` without its wrappers does;
- typical radiance is scaled to 0.5 first (:class:`mcdenoise.models.Exposed`); otherwise the logarithm in the input, and
  with it the result, would depend on the unit of radiance;
- convolutions are padded with zeros and nothing is cropped; the authors crop the result by a kernel's radius;
- the losses are those of the trainer.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from mcdenoise.frame import Frame
from mcdenoise.models._interface import GUIDES, Needs, Note, Output, State
from mcdenoise.models._layers import answered, carried
from mcdenoise.models._published import Network, check_odd, published
from mcdenoise.models._registry import register_model
from mcdenoise.nn.samples import (
    CHANNELS,
    PLANNED,
    LeakyUNet,
    SampleEmbedding,
    chain,
    describe_samples,
    samples_input,
    samples_of,
    with_context,
)
from mcdenoise.nn.unet import Live
from mcdenoise.ops import softmax_splat

PUBLISHED: Mapping[str, Any] = {"width": 128, "rounds": 3, "convolutions": 3, "kernel_size": 21}


class SbmcNetwork(Network):
    """Predicts a kernel for every sample, and splats the samples with these kernels.

    Args:
        width: channels of the embedding of a sample, and of the U-Nets' finest level.
        rounds: number of rounds of embedding and U-Net.
        convolutions: number of convolutions in each block of the U-Nets.
        kernel_size: side of the kernels, odd.

    Raises:
        InputError: a setting is out of its range.
    """

    def __init__(self, width: int = 16, rounds: int = 3, convolutions: int = 2, kernel_size: int = 11) -> None:
        super().__init__()
        check_odd(kernel_size)
        self.embedding = SampleEmbedding(CHANNELS, width, rounds, convolutions)
        self.kernel = chain([2 * width, width, width, kernel_size**2], linear=True)
        reach = rounds * LeakyUNet.reach(convolutions) + kernel_size // 2
        # Measured at the default's sizes, with eight samples and the history: 8.2 kB a pixel.
        live = Live(width * (8 * PLANNED + 8) + 6 * kernel_size**2)
        # The history's length marks the accumulated sample.
        uses = GUIDES | {"samples", "length"}
        self.needs = Needs(uses=uses, reach=reach, stride=LeakyUNet.multiple, live=live)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        light, others = samples_of(frame), carried(frame)
        known = with_context(*self.embedding(samples_input(frame, light)))
        mean, total = light[:, 0], None
        for sample, seen in zip(light.unbind(1), known.unbind(1), strict=True):
            together = sample if others is None else torch.cat([sample, others.to(sample.dtype)], 1)
            splat, weight = softmax_splat(together, self.kernel(seen).to(together.dtype))
            if total is None:
                mean, total = splat, weight
            else:
                # A running mean over the samples so far, weighted so that no exponential overflows.
                mean = torch.lerp(mean, splat, torch.sigmoid(weight - total).to(mean.dtype))
                total = torch.logaddexp(total, weight)
        return answered(frame, mean).noted(Note("samples", describe_samples(frame))), None


sbmc = register_model(
    "sbmc",
    "splats every sample with a kernel of its own, small, with a history",
    kind="kernel",
    paper="Gharbi et al. 2019",
)(published(SbmcNetwork))
