"""The recurrent autoencoder: a U-Net with a hidden state at every resolution of its encoder.

Chaitanya et al. 2017, "Interactive Reconstruction of Monte Carlo Image Sequences using a Recurrent Denoising
Autoencoder", ACM Transactions on Graphics 36(4). The closed-source denoiser of OptiX 5.1, "ONND" in the comparison of
doi:10.1007/s00371-023-02951-6, is based on this work. This file re-implements the paper, and its results are not those
of OptiX.

There is no accumulation and no reprojection: the memory is a hidden state at each of six resolutions,

    a = L(conv(x)),  h_t = L(conv(L(conv([a, h_{t-1}])))),  L = LeakyReLU with slope 0.1,

with 3x3 convolutions throughout. Encoder stages have 32, 43, 57, 76 and 101 channels, a factor of 4/3 each, followed by
2x2 max-pooling; the bottleneck has 101. A decoder stage upsamples by nearest neighbours, concatenates the encoder stage
of that resolution, and has two convolutions with L.

The seven input channels are demodulated radiance 3, x and y of the view-space normal 2, depth 1, roughness 1. The paper
leaves the following open; these are our choices:

- radiance is input and output as ``log(1 + x)``, with typical radiance scaled to 0.5
  (:class:`mcdenoise.models.Exposed`);
- the last convolution has no L; negative results are clamped to 0, and no pixel is brighter than the brightest input;
- the second to last convolution has as many channels as the first stage of the encoder;
- without a camera, x and y of the normal are used as written by the renderer; depth in [0, 1] is
  ``d / (d + typical depth)``; a missing buffer is constant: 1 for depth and roughness, 0 for the normal;
- any image size: at odd heights or widths the last row or column is pooled alone;
- a shot ends when the size changes, and at a cut: when less than 5 % of an image shows what the previous frame showed.
  Without motion no cut is detected, and the caller has to reset the state.

The authors' loss is ``[train] loss = "rae"`` (:func:`mcdenoise.train.losses.rae_loss`), on clips of 7 frames.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mcdenoise.frame import MOTION, Frame, tells_motion
from mcdenoise.models._history import Past, reprojected
from mcdenoise.models._interface import Needs, Note, Output, State
from mcdenoise.models._published import behind
from mcdenoise.models._registry import register_model
from mcdenoise.models._state import own_state
from mcdenoise.models.accumulated import CUT_FRACTION
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.models.exposed import Exposed
from mcdenoise.models.tiled import MIRRORED, with_border, without_border
from mcdenoise.nn.inputs import features_of, normalize_depth
from mcdenoise.ops import upsample
from mcdenoise.ops._window import accumulator_dtype

STAGES, GROWTH, SLOPE = 5, 4 / 3, 0.1
_TYPICAL = 0.5  # exposed radiance


class Memory(NamedTuple):
    """State of a shot. Zeros are the state before the first frame.

    Args:
        hidden: ``(B, C, h, w)`` of each stage with its border, finest first, bottleneck last.
        before: the previous surface, for detecting a cut; its image has no channels.
    """

    hidden: tuple[Tensor, ...]
    before: Past


class _Recurrent(nn.Module):
    """A stage whose result is also its hidden state."""

    def __init__(self, entering: int, width: int) -> None:
        super().__init__()
        self.entry, self.first, self.second = _conv(entering, width), _conv(2 * width, width), _conv(width, width)

    def forward(self, x: Tensor, hidden: Tensor | None) -> Tensor:
        a = _leaky(self.entry(x))
        before = torch.zeros_like(a) if hidden is None else hidden.to(a.dtype)
        return _leaky(self.second(_leaky(self.first(torch.cat([a, before], 1)))))


class Rae(nn.Module):
    """The recurrent denoising autoencoder of Chaitanya et al. 2017, re-implemented, for exposed, demodulated radiance.

    Args:
        width: channels of the first stage, the paper's 32; each further stage has 4/3 of the previous one's.
    """

    # Motion is for detecting cuts.
    needs = Needs(uses=MOTION | {"normal", "depth", "roughness", "view_projection"})
    persistence = None  # the network learns what to remember

    def __init__(self, width: int = 32) -> None:
        super().__init__()
        widths = [round(width * GROWTH**stage) for stage in range(STAGES)]
        entering = [7, *widths[:-1]]
        self.encoder: Sequence[_Recurrent] = nn.ModuleList(  # type: ignore[assignment]
            map(_Recurrent, entering, widths)
        )
        self.bottleneck = _Recurrent(widths[-1], widths[-1])
        inside, leaving = [*widths[-2::-1], width], [*widths[-2::-1], 3]
        coarser = [widths[-1], *leaving[:-1]]
        self.decoder: Sequence[nn.ModuleList] = nn.ModuleList(  # type: ignore[assignment]
            nn.ModuleList([_conv(coarse + skip, middle), _conv(middle, out)])
            for coarse, skip, middle, out in zip(coarser, widths[::-1], inside, leaving, strict=True)
        )
        last = self.decoder[-1][-1].bias
        nn.init.constant_(last, math.log1p(_TYPICAL))  # type: ignore[arg-type]

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        frame = frame.with_depth()
        color = frame.color
        memory = own_state(state, Memory, frame, channels=self.encoder[0].entry.out_channels)
        # As in Tiled, there is a mirror image around the image, except in training.
        border = 0 if self.training else MIRRORED
        x, (hidden, notes) = with_border(input_of(frame), border), _recalled(frame, memory)
        found: list[Tensor] = []
        for stage, before in zip(self.encoder, hidden, strict=False):
            x = stage(x, before)
            found.append(x)
            x = F.max_pool2d(x, 2, ceil_mode=True)
        x = self.bottleneck(x, hidden[-1])
        after = (*found, x)
        for first, second in self.decoder:
            skip = found.pop()
            x = torch.cat([upsample(x, (skip.shape[-2], skip.shape[-1])), skip], 1)
            x = second(_leaky(first(x)))
            x = _leaky(x) if found else x
        maximum = torch.log1p(color.amax((1, 2, 3), keepdim=True))
        x = without_border(x, border)
        image = torch.expm1(torch.minimum(x.to(color.dtype).clamp_min(0), maximum))
        kept = Past.of(frame, torch.zeros_like(color[:, :1]))
        return Output(image, notes=notes), None if kept is None else Memory(after, kept)


def input_of(frame: Frame) -> Tensor:
    """``(B, 7, H, W)``: logarithm of radiance, normal in view space, depth and roughness."""
    one = torch.ones_like(frame.color[:, :1])
    depth = one if frame.depth is None else normalize_depth(frame.depth)
    roughness = one if frame.roughness is None else frame.roughness
    parts = torch.log1p(frame.color), view_normal(frame), depth, roughness
    return torch.cat([part.to(accumulator_dtype(one.dtype)) for part in parts], 1)


def view_normal(frame: Frame) -> Tensor:
    """The normal along the image's x and y axes, ``(B, 2, H, W)`` in [-1, 1]; without a camera its own x and y.

    Clip x and y are the camera's axes times a scale, plus a component along the view axis if the image is a crop of a
    larger one; clip w is along the view axis, or constant for an orthographic camera.
    """
    _, normal, _ = features_of(frame)
    if frame.view_projection is None:
        return normal[:, :2]
    matrix = frame.view_projection.to(torch.promote_types(normal.dtype, torch.float32))
    ahead = F.normalize(matrix[:, :3, 3], dim=1)
    found = []
    for column in range(2):
        axis = matrix[:, :3, column]
        axis = F.normalize(axis - (axis * ahead).sum(1, keepdim=True) * ahead, dim=1)
        found.append((normal * axis[..., None, None].to(normal.dtype)).sum(1, keepdim=True))
    return torch.cat(found, 1)


def _recalled(frame: Frame, memory: Memory | None) -> tuple[list[Tensor | None], tuple[Note, ...]]:
    """The hidden states of the previous frame, ``None`` at the beginning of a shot; and notes about them."""
    nothing: list[Tensor | None] = [None] * (STAGES + 1)
    fits = memory is not None and memory.before.image.shape == frame.color[:, :1].shape
    if memory is None or not fits:
        return nothing, (Note("history", "first frame" if memory is None else "size change"),)
    if not tells_motion(frame.buffers):
        return list(memory.hidden), ()
    _, weight, notes = reprojected(frame, memory.before, 1, "rae")
    goes_on = weight.mean((1, 2, 3), keepdim=True) >= CUT_FRACTION
    if not notes[0].reason:
        notes = (*notes, Note("history", "cut", (~goes_on.any()).float(), weight.mean(), otherwise=""))
    return [torch.where(goes_on, hidden, 0) for hidden in memory.hidden], notes


def _conv(entering: int, leaving: int) -> nn.Conv2d:
    layer = nn.Conv2d(entering, leaving, 3, padding=1)
    nn.init.kaiming_normal_(layer.weight, a=SLOPE)
    nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
    return layer


def _leaky(x: Tensor) -> Tensor:
    return F.leaky_relu(x, SLOPE)


rae = register_model(
    "rae",
    "a re-implementation of the recurrent autoencoder; stands for OptiX 5.1 (ONND)",
    kind="recurrent",
    paper="Chaitanya et al. 2017",
)(behind(lambda network: Demodulated(Exposed(network)), Rae))
