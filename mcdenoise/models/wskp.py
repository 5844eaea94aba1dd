"""Kernel prediction with shared weights: all kernels of all pixels are decoded from a few importance maps.

Fan et al. 2021, "Real-time Monte Carlo denoising with weight sharing kernel prediction network". This is the network of
the public code for the BMFR data: six 5x5 convolutions of 14 channels without biases, LeakyReLU 0.1 between them, and
12 output channels: six importance maps for kernels of sides 3, 5, 7, 9, 11, 13 at one scale, and six blending weights,
which are normalized by a softmax.

Fan's paper describes a U-Net that predicts at several scales instead; neither its sizes nor its weights are public.

Each convolution is trained as the sum of a 5x5, a 3x3 and a 1x1 convolution and, except for the first and last, the
identity (RepVGG, Ding et al. 2021). These are merged into one 5x5 kernel before it is applied, also in training: result
and derivatives are the same. The merged network has 27,300 parameters.

The public code exponentiates the maps directly; :func:`mcdenoise.ops.importance_filter` computes the same without
overflow. The network takes the radiance with albedo to the power of 1 / 2.2, and filters demodulated radiance. As for
`mrkp`, typical radiance is scaled to 0.5 first, and depth is ``d / (d + typical depth)``, where the code scales each
frame's depth to its minimum and maximum. The authors train with SMAPE in linear radiance with albedo, epsilon 0.01.
"""

from __future__ import annotations

import itertools
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
from mcdenoise.ops import importance_filter

SIDES = (3, 5, 7, 9, 11, 13)
_SLOPE = 0.1


class Reparameterized(nn.Module):
    """A 5x5 convolution without bias that is the sum of branches.

    Args:
        in_channels: number of input channels.
        out_channels: number of output channels.
        identity: whether the identity is one of the branches.
    """

    def __init__(self, in_channels: int, out_channels: int, identity: bool) -> None:
        super().__init__()
        self.branches: Sequence[nn.Conv2d] = nn.ModuleList(  # type: ignore[assignment]
            nn.Conv2d(in_channels, out_channels, side, padding=side // 2, bias=False) for side in (5, 3, 1)
        )
        self.identity = identity

    def merged(self) -> Tensor:
        """The kernel ``(out_channels, in_channels, 5, 5)`` that equals the sum of all branches."""
        five, three, one = (branch.weight for branch in self.branches)
        kernel = five + F.pad(three, (1,) * 4) + F.pad(one, (2,) * 4)
        if self.identity:
            same = torch.eye(len(five), dtype=five.dtype, device=five.device)
            kernel = kernel + F.pad(same[:, :, None, None], (2,) * 4)
        return kernel

    def forward(self, x: Tensor) -> Tensor:
        """Apply the merged kernel; the result is ``(B, out_channels, H, W)``."""
        return F.conv2d(x, self.merged(), padding=2)


class WskpNetwork(Network):
    """Predicts importance maps and blending weights, and filters with them.

    Args:
        width: channels between the convolutions, 14.
        layers: number of convolutions, 6; the public code also has 3.
    """

    def __init__(self, width: int = 14, layers: int = 6) -> None:
        super().__init__()
        if layers < 2:
            raise InputError(f"layers: expected at least 2, found {layers}")
        channels = [10, *[width] * (layers - 1), 2 * len(SIDES)]
        self.layers: Sequence[Reparameterized] = nn.ModuleList(  # type: ignore[assignment]
            Reparameterized(entering, leaving, 0 < i < layers - 1)
            for i, (entering, leaving) in enumerate(itertools.pairwise(channels))
        )
        self.needs = Needs(uses=GUIDES, reach=2 * layers + max(SIDES) // 2)

    def maps(self, frame: Frame) -> tuple[Tensor, Tensor]:
        """Importance ``(B, 6, H, W)`` and blending weights ``(B, 6, H, W)`` of sum 1."""
        x = self.input_of(frame, displayed(frame))
        for layer in self.layers[:-1]:
            x = F.leaky_relu(layer(x), _SLOPE)
        importance, blend = self.layers[-1](x).chunk(2, 1)
        return importance, torch.softmax(blend, 1)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        image = with_carried(frame)
        out = torch.zeros_like(image)
        importance, blend = self.maps(frame)
        for side, m, weight in zip(SIDES, importance.split(1, 1), blend.to(image.dtype).split(1, 1), strict=True):
            out = torch.addcmul(out, weight, importance_filter(image, m, kernel_size=side))
        return answered(frame, out), None


wskp = register_model(
    "wskp", "kernels of shared weights, 3x3 to 13x13, as in its public code", kind="kernel", paper="Fan et al. 2021"
)(published(WskpNetwork))
