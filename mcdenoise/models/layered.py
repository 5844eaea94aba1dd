"""Layer embeddings: samples are divided between two layers, which are filtered separately and composited.

Munkberg and Hasselgren 2020, "Neural Denoising with Layer Embeddings", Computer Graphics Forum (EGSR). No public code
was found to compare with; this is an independent re-implementation.

- A network predicts soft weights that assign each sample to the layers and sum to one, so that a firefly, or a surface
  seen through glass, need not be averaged with the rest of its pixel.
- Each layer is filtered with its own kernels, so the cost hardly grows with the number of samples.
- The filtered layers are composited front to back, ``sum_l a_l prod_{j < l} (1 - a_j) F_l``, with predicted alpha; the
  last layer has alpha one.

Our choices:

- the samples are embedded by one round of SBMC's embedding (:class:`mcdenoise.nn.samples.SampleEmbedding`): a chain of
  three 1x1 convolutions on each sample, and a U-Net for the context of its pixel;
- a layer's embedding is the weighted mean of its samples' embeddings; a second U-Net takes both layers, followed by a
  1x1 convolution that predicts the logits of each layer's kernel, and its alpha;
- a layer holds ``C_l = mean_s w_sl x_s`` and its coverage ``A_l = mean_s w_sl``; both are filtered with the same kernel
  (a softmax of the logits, gathered), and ``F_l`` is their quotient: the mean light of the layer. Weights are at
  least 1e-3, so that no layer is empty;
- sizes: width 16 and kernels of 11x11 by default.

As for all compared methods, light is accumulated over frames by the rule of :mod:`mcdenoise.models.cascaded`,
demodulated, and scaled to a typical radiance of 0.5; the paper denoises single frames. The accumulated color is one
sample in addition to ``frame.samples``. **Without samples, the color is the only sample of a pixel**, and its light is
in both layers in proportion to its weights.
"""

from __future__ import annotations

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
    of_each,
    samples_input,
    samples_of,
    with_context,
)
from mcdenoise.nn.unet import Live
from mcdenoise.ops import cross_bilateral_filter

LAYERS = 2
# Smallest weight of a sample in a layer.
_LEAST = 1e-3


class LayeredNetwork(Network):
    """Predicts the layer weights of each sample, and the kernels and alpha of the layers.

    Args:
        width: channels of the embeddings of samples and layers, and of the U-Nets' finest level.
        convolutions: number of convolutions in each block of the U-Nets.

    Raises:
        InputError: a setting is out of its range.
    """

    def __init__(self, width: int = 16, convolutions: int = 2, kernel_size: int = 11) -> None:
        super().__init__()
        check_odd(kernel_size)
        self.taps = kernel_size**2
        self.embedding = SampleEmbedding(CHANNELS, width, 1, convolutions)
        self.partition = chain([2 * width, width, LAYERS], linear=True)
        self.unet = LeakyUNet((LAYERS + 1) * width, width, convolutions)
        self.head = chain([width, LAYERS * self.taps + 1], linear=True)
        reach = 2 * LeakyUNet.reach(convolutions) + kernel_size // 2
        # Measured at the default's sizes, with eight samples and the history: 6.4 kB a pixel.
        live = Live(width * (6 * PLANNED + 12) + 2 * LAYERS * self.taps)
        # The history's length marks the accumulated sample.
        uses = GUIDES | {"samples", "length"}
        self.needs = Needs(uses=uses, reach=reach, stride=LeakyUNet.multiple, live=live)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        light, others = samples_of(frame), carried(frame)
        embedded, context = self.embedding(samples_input(frame, light))
        logits = of_each(self.partition, with_context(embedded, context)).to(light.dtype)
        weights = _LEAST + (1 - LAYERS * _LEAST) * torch.softmax(logits, 2)
        layers = weights.split(1, 2)
        embeddings = [(embedded * weight.to(embedded.dtype)).mean(1) for weight in layers]
        predicted = self.head(self.unet(torch.cat([*embeddings, context], 1))).to(light.dtype)
        *kernels, alpha = predicted.split([self.taps] * LAYERS + [1], 1)
        means = []
        for kernel, weight in zip(kernels, layers, strict=True):
            coverage = weight.mean(1)
            held = [(light * weight).mean(1), coverage]
            held = held if others is None else [*held, others.to(light.dtype) * coverage]
            found = cross_bilateral_filter(torch.cat(held, 1), kernel, border="renormalize")
            means.append(torch.cat([found[:, :3], found[:, 4:]], 1) / found[:, 3:4])
        (front, back), alpha = means, torch.sigmoid(alpha)
        image = alpha * front + (1 - alpha) * back
        return answered(frame, image).noted(Note("samples", describe_samples(frame))), None


layered = register_model(
    "layered",
    "filters samples in two layers, re-implemented, small, with a history",
    kind="kernel",
    paper="Munkberg and Hasselgren 2020",
)(published(LayeredNetwork))
