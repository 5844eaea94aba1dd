"""Affinity of neural features: dilated filters weighted by the similarity of learnt features, in space and in time.

Isik et al. 2021, "Interactive Monte Carlo Denoising using Affinity of Neural Features", ACM Transactions on Graphics
40(4). For each frame ``t``, where ``W`` reprojects the previous frame to the current one:

1. Each sample of a pixel is embedded separately by 1x1 layers, and the mean of the embeddings is ``e_t``.
2. A U-Net takes ``e_t`` and ``W e_bar_{t-1}``. For each pixel it predicts ``lambda``; for each filter ``k`` features
   ``f^k``, a bandwidth ``a^k`` and a weight of the centre ``c^k``; and a temporal bandwidth ``b``.
3. Exponential means are updated: ``L_bar_t = (1 - lambda) L_t + lambda W L_bar_{t-1}``, and ``e_bar_t`` in the same
   way.
4. ``L_bar_t`` passes through the filters one after the other, with 7x7 taps 1, 2 and 4 pixels apart and the weights
   ``exp(-a_p |f_p - f_q|^2)``; the centre has the weight ``c_p`` (:func:`mcdenoise.ops.affinity_filter`).
5. The last filter also has taps in the result of the previous frame, ``exp(-b_p |f_p - W f_{q, t-1}|^2)``, with the
   features of that frame's last filter.

From a public re-implementation (Luciferbobo/SSR) come three filters, 8 features, ``a`` as a square, and sigmoids for
``c`` and ``lambda``; ``b`` is a square here as well. The sources leave the following open; this is our choice:

- The embedding has three 1x1 layers of 32 channels with LeakyReLU. It takes ``log(1 + radiance)``, albedo, normal,
  depth.
- A frame without samples has one sample per pixel: its color. The samples of a pixel differ only in their radiance.
- Typical radiance is scaled to 0.5 for the network (:func:`mcdenoise.nn.auto_exposure`); the filters are linear in it.
- The U-Net has four levels of 32 channels (:class:`mcdenoise.nn.UNet`).
- The albedo is divided out before, as in most methods here.
- Where no tap shows the same surface (:func:`mcdenoise.ops.reproject`), ``lambda`` and the temporal weights are 0;
  where only some taps do, they are reduced.
- Layers and alpha are filtered and accumulated together with the radiance.

The authors' loss is SMAPE plus 0.25 times SMAPE of frame differences (``temporal_weight = 0.25`` in training), plus
``1e-5 (a^2 + b^2)``, which the trainer does not have.
"""

from __future__ import annotations

import functools

import torch
from torch import Tensor, nn

from mcdenoise.frame import MOTION, Frame
from mcdenoise.models._history import Past, reprojected
from mcdenoise.models._interface import GUIDES, Needs, Note, Output, State
from mcdenoise.models._layers import answered, with_carried
from mcdenoise.models._published import Network, behind
from mcdenoise.models._registry import register_model
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.nn.inputs import features_of, image_statistics, normalized_depth
from mcdenoise.nn.samples import describe_samples, samples_of
from mcdenoise.nn.unet import UNet
from mcdenoise.ops import affinity_filter
from mcdenoise.ops._window import accumulator_dtype

FEATURES, FILTERS, KERNEL_SIZE, LEVELS = 8, 3, 7, 4
_OF_FILTER = FEATURES + 2  # a and c
_SAMPLE = 10  # radiance 3, albedo 3, normal 3, depth 1


class Anf(Network):
    """Affinity of neural features (Isik et al. 2021), for demodulated radiance.

    Args:
        width: channels of the embedding, the paper's 32, and of the U-Net.
    """

    needs = Needs(uses=MOTION | GUIDES | {"samples", "view_projection"})
    persistence = None  # the network learns what to remember

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
        self.head = nn.Conv2d(width, FILTERS * _OF_FILTER + 2, 3, padding=1)
        with torch.no_grad():
            # Bandwidths start at about 1, because a square has no slope at 0.
            self.head.bias[FEATURES::_OF_FILTER] = 1.0  # type: ignore[index]
            self.head.bias[-1] = 1.0  # type: ignore[index]

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        frame = frame.with_depth()
        light = with_carried(frame).to(accumulator_dtype(frame.color.dtype))
        embedded = self.embedded(frame).to(light.dtype)
        sizes = [light.shape[1], light.shape[1], embedded.shape[1], FEATURES]
        found, known, notes = reprojected(frame, state, sum(sizes), "anf")
        result_before, mean_before, embedded_before, features_before = found.to(light.dtype).split(sizes, 1)

        unet_input = torch.cat([embedded, embedded_before], 1)
        predicted = self.head(self.unet(unet_input)[0]).to(light.dtype)
        *filters, last = predicted.split([_OF_FILTER] * FILTERS + [2], 1)
        stays = torch.sigmoid(last[:, :1]) * known
        mean = torch.lerp(light, mean_before, stays)
        embedded_mean = torch.lerp(embedded, embedded_before, stays)

        image, features = mean, filters[-1][:, :FEATURES]
        of_before = (result_before, features_before, last[:, 1:].square(), known)
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
        kept = Past.of(frame, torch.cat([image, mean, embedded_mean, features], 1))
        output = answered(frame, image.to(frame.color.dtype))
        return output.noted(*notes, Note("samples", describe_samples(frame))), kept

    def embedded(self, frame: Frame) -> Tensor:
        """The mean embedding of the samples of each pixel, ``(B, width, H, W)``."""
        statistics = image_statistics(frame)
        near, typical = statistics["depth_scale"].split(1, 1)
        albedo, normal, depth = features_of(frame)
        dtype = accumulator_dtype(frame.color.dtype)
        shared = torch.cat([albedo, normal, normalized_depth(depth, near, typical)], 1).to(dtype)
        radiance = samples_of(frame).to(dtype)
        lights = (torch.log1p(sample * statistics["exposure"]) for sample in radiance.unbind(1))
        # One sample after the other, so that few features are kept at a time.
        each = (self.embedding(torch.cat([light, shared], 1)) / radiance.shape[1] for light in lights)
        total: Tensor = functools.reduce(torch.add, each)
        return total


anf = register_model(
    "anf",
    "pairwise affinity of learnt features, dilated filters; sizes of a public copy",
    kind="recurrent",
    paper="Isik et al. 2021",
)(behind(Demodulated, Anf))
