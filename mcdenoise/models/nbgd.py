"""The neural bilateral grid: a small network predicts three guides, and a bilateral grid for each smooths the light.

Meng, Zheng, Varshney, Singh and Zwicker 2020, "Real-Time Monte Carlo Denoising with the Neural Bilateral Grid",
Eurographics Symposium on Rendering. Where paper and public code differ, this file follows the code:

- The network of 7 layers has 29,425 parameters: a 5x5 convolution of the 10 input channels to 20; five with 5 output
  channels each, whose inputs are all channels so far, concatenated (20, 25, 30, 35 and 40); and a last one of these 45
  to 5. LeakyReLU of slope 0.2 follows the first convolution and every concatenation, a sigmoid the last. That is
  ``25 * (10 * 20 + 5 * (20 + 25 + 30 + 35 + 40) + 5 * 45)`` weights and 50 biases; 2 layers have 7,525. Channels that
  were concatenated before pass LeakyReLU again together with the new ones; the number of parameters does not show
  whether they should.
- Its input is the radiance with albedo, gamma-mapped for a display, ``max(x, 0)^(1 / 2.2)``; albedo; normal; and depth.
  The grids filter the demodulated radiance.
- Its five outputs per pixel are three guides and two weights; the weight of the third grid is one minus both, which is
  negative where they sum to more than one.

Differences, and choices where paper and code leave something open:

- image sizes: the code requires multiples of 16; here the last cells extend beyond the image,
  see :func:`mcdenoise.ops.grid_splat`;
- cells that contain only black pixels count as empty in the code, and as black here;
- the unit of radiance: typical radiance is scaled to 0.5 (:class:`mcdenoise.models.Exposed`);
- depth in [0, 1] is ``d / (d + typical depth)``; the code scales each frame's depth to that range;
- negative radiance, which negative weights allow, is clamped to 0;
- accumulation: that of Koskela et al. 2019 with alpha 0.2, on demodulated radiance, as in Meng's data;
- derivatives: the derivative of the gamma curve is unbounded at black, and is 0 below 1e-6 here. As in the code,
  derivatives in a guide above 100 are set to 0 in training: they occur where only the tail of a tent reaches a cell,
  and carry no information;
- the authors' loss is L1 of gamma-mapped images: ``loss="l1_display"`` of the trainer, ``temporal_weight=0``.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.models._interface import GUIDES, Needs, Output, State
from mcdenoise.models._layers import answered, with_carried
from mcdenoise.models._published import Network, displayed, published
from mcdenoise.models._registry import register_model
from mcdenoise.nn.unet import Live
from mcdenoise.ops import grid_slice, grid_splat

# Cell size s_s in pixels and 256 / s_r bins of the three grids, in the order of the guides.
GRIDS = ((4, 64), (8, 32), (16, 16))
_INPUTS, _FIRST, _GROWTH, _OUTPUTS, _SLOPE = 10, 20, 5, 5, 0.2
# Largest derivative in a guide, in training.
_LARGEST = 100.0
# Peak numbers per pixel of network and finest grid, always in float32; 230 were measured, including the frame.
_LIVE = Live(0, 275)


class NeuralBilateralGrid(Network):
    """The network, its three grids, and the sum of their results.

    Args:
        layers: number of convolutions, at least 2; the paper has 2 and 7.

    Raises:
        InputError: there are fewer than 2 layers.
    """

    def __init__(self, layers: int = 7) -> None:
        super().__init__()
        if layers < 2:
            raise InputError(f"layers: expected at least 2, found {layers}")
        self.first = _convolution(_INPUTS, _FIRST)
        self.dense: Sequence[nn.Conv2d] = nn.ModuleList(  # type: ignore[assignment]
            _convolution(_FIRST + number * _GROWTH, _GROWTH) for number in range(layers - 2)
        )
        self.last = _convolution(_FIRST + len(self.dense) * _GROWTH, _OUTPUTS)
        coarsest = max(cell for cell, _ in GRIDS)
        # Two pixels per convolution, plus the distance via a cell's centre to its farthest pixel.
        self.needs = Needs(uses=GUIDES, reach=2 * layers + 2 * coarsest, stride=coarsest, live=_LIVE)

    def predicted(self, frame: Frame) -> Tensor:
        """Three guides and two weights, ``(B, 5, H, W)`` in [0, 1]."""
        x = F.leaky_relu(self.first(self.input_of(frame, displayed(frame))), _SLOPE)
        for layer in self.dense:
            x = F.leaky_relu(torch.cat([x, layer(x)], 1), _SLOPE)
        return torch.sigmoid(self.last(x)).to(frame.color.dtype)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        *guides, first, second = self.predicted(frame).split(1, 1)
        if self.training:
            guides = [_limited(guide) for guide in guides]
        light = with_carried(frame)
        smooth = [_smoothed(light, *each) for each in zip(guides, GRIDS, strict=True)]
        weights = [first, second, 1 - first - second]
        image = _sum(weights, [each[:, :3] for each in smooth]).clamp_min(0)
        if light.shape[1] == 3:
            return Output(image), None
        # Layers and alpha require a mean with non-negative weights.
        weights = [weight.clamp_min(0) for weight in weights]
        total = _sum(weights, [each[:, 3:] for each in smooth]) / (weights[0] + weights[1] + weights[2])
        return answered(frame, image, total), None


def _convolution(entering: int, leaving: int) -> nn.Conv2d:
    return nn.Conv2d(entering, leaving, 5, padding=2)


def _smoothed(light: Tensor, guide: Tensor, grid: tuple[int, int]) -> Tensor:
    cell, bins = grid
    return grid_slice(*grid_splat(light, guide, cell=cell, bins=bins), guide, cell=cell)


def _limited(guide: Tensor) -> Tensor:
    """The guide unchanged, with derivatives above the limit set to 0."""
    guide = guide.view_as(guide)
    if guide.requires_grad:
        guide.register_hook(lambda gradient: torch.where(gradient.abs() > _LARGEST, 0, gradient))
    return guide


def _sum(weights: Sequence[Tensor], images: Sequence[Tensor]) -> Tensor:
    first, second, third = (weight * image for weight, image in zip(weights, images, strict=True))
    return first + second + third


nbgd = register_model(
    "nbgd", "three bilateral grids on guides that a network of 7 layers draws", kind="grid", paper="Meng et al. 2020"
)(published(NeuralBilateralGrid))
