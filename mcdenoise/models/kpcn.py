"""KPCN, the kernel-predicting convolutional network: separate networks for diffuse and for specular light.

Bako et al. 2017, "Kernel-Predicting Convolutional Networks for Denoising Monte Carlo Renderings", ACM Transactions on
Graphics (SIGGRAPH). ``PUBLISHED`` holds its sizes: nine 5x5 convolutions of 100 channels and kernels of 21x21, with the
27 input channels of the re-implementation by Gharbi et al. 2019, 2.92 million parameters per branch; training them
requires a GPU. The default is smaller and trains on a CPU.

- Diffuse light is filtered without its albedo, and specular light as ``log(1 + s)``. The result is ``albedo diffuse +
  exp(specular) - 1``, plus ``emission``, which has no noise, if the frame has it.
- **A frame with color only**: without the buffers ``diffuse`` and ``specular``, the diffuse branch filters the
  demodulated color, and there is no specular light: the specular branch is neither computed nor trained. Weights
  trained on such frames use ``split=False``, a network of one branch, because an untrained second branch would only
  blur. **The shipped weights are of this kind**, since methods are compared on color alone. Frames that train both
  branches are made by ``mcdenoise generate --renderer cycles --parts``.

Our choices where the paper and its re-implementation leave something open, and differences:

- the 27 channels: the image, albedo, normal and depth (10), the horizontal and vertical differences of the image's
  luminance, albedo, normal and depth (16), and ``log(1 + variance)`` of the image (1). The variance is estimated from
  the 7x7 neighbouring pixels of the same surface, because frames of one sample have no variance buffer, and the
  variance of several samples is that of the color and not of its parts;
- convolutions are padded with zeros, where the authors crop the border;
- taps of a kernel outside the image have the weight 0;
- typical radiance is scaled to 0.5 first (:class:`mcdenoise.models.Exposed`); otherwise the logarithm, and with it the
  result, would depend on the unit of radiance;
- depth in [0, 1]: ``d / (d + typical depth)``;
- the authors denoise single images of many samples. Here light is accumulated over frames by the rule of
  :mod:`mcdenoise.models.cascaded`, as for all compared methods; ``alpha_min=1`` denoises single images;
- the authors train each branch with its own L1 loss, and then both together; here the trainer's losses apply to the sum
  from the start.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.models._interface import GUIDES, Needs, Note, Output, State
from mcdenoise.models._layers import answered, with_carried
from mcdenoise.models._published import Network, check_odd, published
from mcdenoise.models._registry import register_model
from mcdenoise.models.svgf import BRIGHTEST
from mcdenoise.nn.inputs import unit_features_of
from mcdenoise.nn.unet import Live
from mcdenoise.ops import cross_bilateral_filter, demodulate, luminance_moments, moments_variance

PUBLISHED: Mapping[str, Any] = {"width": 100, "layers": 9, "kernel_size": 21}
CHANNELS = 27
_CONVOLUTION, _WINDOW = 5, 7  # sides, in pixels


class _Branch(nn.Sequential):
    """Convolutions with ReLU, and the logits of a kernel for each pixel."""

    def __init__(self, width: int, layers: int, kernel_size: int) -> None:
        widths = [CHANNELS] + [width] * (layers - 1) + [kernel_size**2]
        modules: list[nn.Module] = []
        for entering, leaving in itertools.pairwise(widths):
            modules += [nn.Conv2d(entering, leaving, _CONVOLUTION, padding=_CONVOLUTION // 2), nn.ReLU(inplace=True)]
        super().__init__(*modules[:-1])

    def filtered(self, image: Tensor, frame: Frame) -> Tensor:
        """Filter ``(B, 3, H, W)`` with the kernels predicted for it, and after it layers and alpha with the same."""
        return cross_bilateral_filter(with_carried(frame, image), self(_seen(image, frame)), border="renormalize")


class KpcnNetwork(Network):
    """Both branches; the diffuse one takes demodulated light.

    Args:
        width: channels of each convolution but the last, the paper's 100.
        layers: number of 5x5 convolutions of a branch, at least 2, the paper's 9.
        kernel_size: side of the kernels, odd, the paper's 21.
        split: whether there is a branch for specular light; without it only the color is used.

    Raises:
        InputError: a setting is out of its range.
    """

    def __init__(self, width: int = 24, layers: int = 5, kernel_size: int = 11, split: bool = True) -> None:
        super().__init__()
        if layers < 2:
            raise InputError(f"layers: expected at least 2, found {layers}")
        check_odd(kernel_size)
        self.diffuse = _Branch(width, layers, kernel_size)
        self.specular = _Branch(width, layers, kernel_size) if split else None
        # Convolutions, the variance estimate with the depth slope at its taps, and the kernel.
        reach = layers * (_CONVOLUTION // 2) + _WINDOW // 2 + 1 + kernel_size // 2
        # Measured at the default's sizes: 3.8 kB a pixel.
        live = Live(4 * max(width, CHANNELS) + 6 * kernel_size**2)
        parts = frozenset({"diffuse", "specular", "emission"} if split else ())
        self.needs = Needs(uses=GUIDES | parts, reach=reach, live=live)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        if frame.diffuse is None or frame.specular is None or self.specular is None:
            reason = "these weights are for color alone" if self.specular is None else "no diffuse and specular light"
            image = self.diffuse.filtered(frame.color, frame)
            return answered(frame, image).noted(Note("specular branch", reason, 1.0)), None
        of_matt = self.diffuse.filtered(frame.diffuse, frame)
        of_shiny = self.specular.filtered(torch.log1p(frame.specular), frame)
        shiny = torch.expm1(of_shiny[:, :3])
        if frame.emission is not None:
            shiny = shiny + frame.emission
        if frame.albedo is not None:
            # Demodulated multiplies the whole result by the albedo, so the specular part is divided by it here.
            shiny = demodulate(shiny, frame.albedo)
        image = of_matt[:, :3] + shiny
        if of_matt.shape[1] > 3:
            lit = image > 0
            part = torch.where(lit, shiny / torch.where(lit, image, 1), 0).mean(1, keepdim=True)
            image = torch.cat([image, torch.lerp(of_matt[:, 3:], of_shiny[:, 3:], part)], 1)
        return answered(frame, image).noted(Note("specular branch", "diffuse and specular light")), None


def _seen(image: Tensor, frame: Frame) -> Tensor:
    """The input of a branch, ``(B, 27, H, W)``."""
    moments = luminance_moments(image.clamp_max(BRIGHTEST))
    variance = moments_variance(moments, frame.normal, frame.depth, kernel_size=_WINDOW)
    features = torch.cat(unit_features_of(frame), 1)
    varying = torch.cat([moments[:, :1].to(image.dtype), features], 1)
    across, down = (varying.diff(dim=dim) for dim in (-1, -2))
    # The last pixel of a row or column has no next pixel.
    differences = [F.pad(across, (0, 1)), F.pad(down, (0, 0, 0, 1))]
    return torch.cat([image, features, *differences, torch.log1p(variance).to(image.dtype)], 1)


kpcn = register_model(
    "kpcn",
    "diffuse and specular light by networks of their own, small, with a history",
    kind="kernel",
    paper="Bako et al. 2017",
)(published(KpcnNetwork))
