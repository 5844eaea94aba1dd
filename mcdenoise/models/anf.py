"""Affinity of neural features: dilated filters whose weights are how alike learnt features are, in space and in time.

Isik et al. 2021, "Interactive Monte Carlo Denoising using Affinity of Neural Features", ACM Transactions on Graphics
40(4). For each frame ``t``, with ``W`` what was there in the frame before, at the places of this one:

1. Each sample of a pixel is embedded by itself, in layers of 1x1, and the mean of the embeddings is ``e_t``.
2. A U-Net sees ``e_t`` and ``W e_bar_{t-1}`` and predicts, for each pixel, ``lambda``; for each filter ``k`` features
   ``f^k``, a bandwidth ``a^k`` and a weight of the centre ``c^k``; and a bandwidth in time ``b``.
3. Exponential means: ``L_bar_t = (1 - lambda) L_t + lambda W L_bar_{t-1}``, and likewise ``e_bar_t`` of ``e_t``.
4. ``L_bar_t`` goes through filters one after the other, with 7x7 taps 1, 2 and 4 pixels apart and weights
   ``exp(-a_p |f_p - f_q|^2)``, ``c_p`` of the pixel itself (:func:`mcdenoise.ops.affinity_filter`).
5. The last of them also has taps in the result of the frame before, ``exp(-b_p |f_p - W f_{q, t-1}|^2)`` with the
   features of its last filter.

From a public re-implementation (Luciferbobo/SSR) come three filters, 8 features, ``a`` as a square, ``c`` and
``lambda`` as sigmoids; ``b`` is a square here as well. What is left open, and what is taken here:

- the embedding: three layers of 1x1 and 32 channels with LeakyReLU, of ``log(1 + radiance)``, albedo, normal and depth;
- a frame without samples has one a pixel, its color; those of a frame differ in nothing but their radiance;
- typical radiance is brought to 0.5 for the network (:func:`mcdenoise.nn.auto_exposure`); the filters are linear in it;
- the U-Net: four levels of 32 channels (:class:`mcdenoise.nn.UNet`);
- the albedo is divided out before, as of most methods here;
- where nothing shows the same surface (:func:`mcdenoise.ops.reproject`), ``lambda`` and the weights in time are 0;
  where only some of the taps do, less;
- layers and alpha are filtered, and accumulated, with the radiance.

Its authors' loss is SMAPE with 0.25 times that of frame differences (``temporal_weight = 0.25`` in training), and
``1e-5 (a^2 + b^2)``, which is not in the trainer.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from mcdenoise.frame import MOTION, Frame
from mcdenoise.models._interface import Model, Needs, Output, State
from mcdenoise.models._journal import note, timed
from mcdenoise.models._layers import answered, with_carried
from mcdenoise.models._registry import register_model
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.models.recurrent import from_before, to_be_kept
from mcdenoise.nn.inputs import features_of, image_statistics
from mcdenoise.nn.samples import samples_of, told_of
from mcdenoise.nn.unet import Head, UNet
from mcdenoise.ops import affinity_filter
from mcdenoise.ops._steps.network import normalized_depth

FEATURES, FILTERS, KERNEL_SIZE, LEVELS = 8, 3, 7, 4
_OF_FILTER = FEATURES + 2  # a and c
_SAMPLE = 10  # radiance 3, albedo 3, normal 3, depth 1


class Anf(nn.Module):
    """The method, on radiance without albedo.

    Args:
        width: channels of the embedding, the paper's 32, and of the U-Net.
    """

    def __init__(self, width: int = 32) -> None:
        super().__init__()
        self.embedding = nn.Sequential(
            nn.Conv2d(_SAMPLE, width, 1),
            nn.LeakyReLU(),
            nn.Conv2d(width, width, 1),
            nn.LeakyReLU(),
            nn.Conv2d(width, width, 1),
            nn.LeakyReLU(),
        )
        self.unet = UNet(2 * width, [width] * LEVELS, scales=1)
        self.head = Head(self.unet, 0, FILTERS * _OF_FILTER + 2)
        with torch.no_grad():
            # Bandwidths begin at about 1: a square has no slope at 0.
            self.head.bias[FEATURES::_OF_FILTER] = 1.0  # type: ignore[index]
            self.head.bias[-1] = 1.0  # type: ignore[index]

    @property
    def persistence(self) -> None:
        """Nobody knows what the network has learnt to remember, see :func:`mcdenoise.models.frames_remembered`."""

    @property
    def needs(self) -> Needs:
        """Color; of use are features, samples, and what tells motion."""
        return Needs(uses=MOTION | {"albedo", "normal", "depth", "samples", "view_projection"})

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """Exposure and depth scale of the whole image."""
        return image_statistics(frame)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        frame = frame.with_depth()
        light = with_carried(frame).to(frame.color.dtype)
        embedded = self.embedded(frame).to(light.dtype)
        sizes = [light.shape[1], light.shape[1], embedded.shape[1], FEATURES]
        with timed("accumulate", light.device):
            found, known = from_before(frame, state, channels=sum(sizes), keeper="anf")
            result_before, mean_before, embedded_before, features_before = found.split(sizes, 1)

        unet_input = torch.cat([embedded, embedded_before], 1)
        predicted = self.head(self.unet(unet_input)[0], frame.size).to(light.dtype)
        *filters, last = predicted.split([_OF_FILTER] * FILTERS + [2], 1)
        stays = torch.sigmoid(last[:, :1]) * known
        mean = torch.lerp(light, mean_before, stays)
        embedded_mean = torch.lerp(embedded, embedded_before, stays)

        image, features = mean, filters[-1][:, :FEATURES]
        of_before = (result_before, features_before, last[:, 1:].square(), known)
        with timed("filter", light.device):
            for k, each in enumerate(filters):
                own, root, logit = each.split([FEATURES, 1, 1], 1)
                image = affinity_filter(
                    image,
                    own,
                    root.square(),
                    torch.sigmoid(logit),
                    *(of_before if k == FILTERS - 1 else ()),
                    kernel_size=KERNEL_SIZE,
                    dilation=1 << k,
                )
        kept = to_be_kept(frame, torch.cat([image, mean, embedded_mean, features], 1))
        return answered(frame, image), kept

    def embedded(self, frame: Frame) -> Tensor:
        """The mean embedding of the samples of each pixel, ``(B, width, H, W)``."""
        statistics = frame.statistics or self.statistics(frame)
        near, typical = statistics["depth_scale"].split(1, 1)
        albedo, normal, depth = features_of(frame)
        shared = torch.cat([albedo, normal, normalized_depth(depth, near, typical)], 1).to(frame.color.dtype)
        radiance = samples_of(frame).to(frame.color.dtype)
        note("samples", told_of(frame))
        total: Tensor | None = None
        count = radiance.shape[1]
        for sample in range(count):
            light = torch.log1p(radiance[:, sample] * statistics["exposure"])
            one = self.embedding(torch.cat([light, shared], 1)) / count
            total = one if total is None else total + one
        assert total is not None
        return total


@register_model(
    "anf",
    "pairwise affinity of learnt features, dilated filters; sizes of a public copy",
    kind="recurrent",
    paper="Isik et al. 2021",
)
def anf(width: int = 32) -> Model:
    """Affinity of neural features, of Isik et al. 2021.

    Args:
        width: channels of the embedding, the paper's 32, and of the U-Net.
    """
    return Demodulated(Anf(width))
