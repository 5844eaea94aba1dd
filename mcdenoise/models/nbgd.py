"""The neural bilateral grid: a small network draws three guides, and a bilateral grid of each smooths the light.

Meng, Zheng, Varshney, Singh and Zwicker 2020, "Real-Time Monte Carlo Denoising with the Neural Bilateral Grid",
Eurographics Symposium on Rendering. Where the paper and its public code differ, this is what the code does:

- The network of 7 layers has 29,425 parameters: a 5x5 convolution of the 10 input channels to 20; five of 5 channels
  each, of all channels before them, which are concatenated with theirs (so of 20, 25, 30, 35 and 40); a last one of
  these 45 to 5. LeakyReLU of slope 0.2 follows the first and every concatenation, a sigmoid the last. That is
  ``25 * (10 * 20 + 5 * (20 + 25 + 30 + 35 + 40) + 5 * 45)`` weights and 50 biases; 2 layers have 7,525. What is
  concatenated passes LeakyReLU once more with the new channels; the number of parameters does not tell whether it does.
- It sees the radiance with its albedo, as a display shows it, ``max(x, 0)^(1 / 2.2)``; albedo; normal; and depth. The
  grids filter the radiance without its albedo.
- Its five numbers a pixel are three guides and two weights; the weight of the third grid is what these leave of one. It
  is negative where they sum to more.

Left open, or otherwise here:

- sizes: the code takes multiples of 16 only; here the last cells hang over the image,
  see :func:`mcdenoise.ops.grid_splat`;
- cells that hold black pixels only count as empty in the code, and here as black;
- the unit of radiance: typical radiance is brought to 0.5 (:class:`mcdenoise.models.Exposed`);
- depth in [0, 1] is ``d / (d + typical depth)``; the code stretches each frame's depth to that range;
- radiance below zero, which negative weights allow: the result is cut off at 0;
- accumulation: the published rule of Koskela et al. 2019 with alpha 0.2, on demodulated radiance, as in Meng's data;
- derivatives: that of a display's radiance has no limit at black, and is taken for 0 below 1e-6. As in the code, those
  in a guide of more than 100 are taken for 0 in training: where the tail of a tent alone reaches a cell they tell
  nothing;
- its authors' loss is L1 of what a display shows: ``loss="l1_display"`` of the trainer, ``temporal_weight=0``.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.models._interface import Model, Needs, Output, State
from mcdenoise.models._journal import timed
from mcdenoise.models._layers import answered, with_carried
from mcdenoise.models._published import NORMAL_LIMIT, POSITION_LIMIT, TenChannels, as_published, displayed
from mcdenoise.models._registry import register_model
from mcdenoise.models.exposed import Exposed
from mcdenoise.models.tiled import Tiled
from mcdenoise.ops import grid_slice, grid_splat

# s_s in pixels and 256 / s_r bins of the grids, whose guides these are in order.
GRIDS = ((4, 64), (8, 32), (16, 16))
_INPUTS, _FIRST, _GROWTH, _OUTPUTS, _SLOPE = 10, 20, 5, 5, 0.2
# Of a derivative in a guide, in training.
_LARGEST = 100.0
# Peak of the network and of the finest grid, in float32; 920 were measured, with the frame.
_BYTES_PER_PIXEL = 1100


class NeuralBilateralGrid(TenChannels):
    """The network, its three grids, and their sum.

    Args:
        layers: convolutions, 2 at least; the paper's are 2 and 7.

    Raises:
        InputError: these are less than 2.
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

    @property
    def needs(self) -> Needs:
        """Two pixels for each convolution; and from a pixel to its cells' centres, and from these to their pixels."""
        coarsest = max(cell for cell, _ in GRIDS)
        reach = 2 * (2 + len(self.dense)) + 2 * coarsest
        return Needs(uses=frozenset({"albedo", "normal", "depth"}), reach=reach, stride=coarsest)

    def bytes_per_pixel(self, *, bfloat16: bool) -> float:
        """Memory that a tile takes, see :class:`mcdenoise.models.Tiled`; grids are in float32 anyway."""
        return _BYTES_PER_PIXEL

    def predicted(self, frame: Frame) -> Tensor:
        """Three guides and two weights ``(B, 5, H, W)`` in [0, 1]."""
        x = F.leaky_relu(self.first(self.input_of(frame, displayed(frame))), _SLOPE)
        for layer in self.dense:
            x = F.leaky_relu(torch.cat([x, layer(x)], 1), _SLOPE)
        return torch.sigmoid(self.last(x)).to(frame.color.dtype)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        with timed("network", frame.color.device):
            *guides, first, second = self.predicted(frame).split(1, 1)
        with timed("filter", frame.color.device):
            if self.training:
                guides = [_limited(guide) for guide in guides]
            light = with_carried(frame)
            smooth = [_smoothed(light, *each) for each in zip(guides, GRIDS, strict=True)]
            weights = [first, second, 1 - first - second]
            image = _sum(weights, [each[:, :3] for each in smooth]).clamp_min(0)
            if light.shape[1] == 3:
                return Output(image), None
            # Layers and alpha need a mean, of no negative weights.
            weights = [weight.clamp_min(0) for weight in weights]
            total = _sum(weights, [each[:, 3:] for each in smooth]) / (weights[0] + weights[1] + weights[2])
        return answered(frame, image, total), None


def _convolution(entering: int, leaving: int) -> nn.Conv2d:
    return nn.Conv2d(entering, leaving, 5, padding=2)


def _smoothed(light: Tensor, guide: Tensor, grid: tuple[int, int]) -> Tensor:
    cell, bins = grid
    return grid_slice(*grid_splat(light, guide, cell=cell, bins=bins), guide, cell=cell)


def _limited(guide: Tensor) -> Tensor:
    """The same guide, whose derivatives of more than the largest that counts are 0."""
    guide = guide.view_as(guide)
    if guide.requires_grad:
        guide.register_hook(lambda gradient: torch.where(gradient.abs() > _LARGEST, 0, gradient))
    return guide


def _sum(weights: Sequence[Tensor], images: Sequence[Tensor]) -> Tensor:
    first, second, third = (weight * image for weight, image in zip(weights, images, strict=True))
    return first + second + third


@register_model(
    "nbgd", "three bilateral grids on guides that a network of 7 layers draws", kind="grid", paper="Meng et al. 2020"
)
def nbgd(
    layers: int = 7,
    *,
    alpha_min: float = 0.2,
    position_limit: float = POSITION_LIMIT,
    normal_limit: float = NORMAL_LIMIT,
) -> Model:
    """The neural bilateral grid on accumulated and demodulated radiance.

    Args:
        layers: see :class:`NeuralBilateralGrid`.
        alpha_min: smallest weight of the current frame in the accumulation.
        position_limit: squared distance in scene units below which two points are one, see
            :func:`mcdenoise.ops.reproject`.
        normal_limit: likewise for normals.
    """
    return as_published(Exposed(Tiled(NeuralBilateralGrid(layers))), alpha_min, position_limit, normal_limit)
