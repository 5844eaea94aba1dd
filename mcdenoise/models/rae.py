"""The recurrent autoencoder: a U-Net that remembers, at every resolution of its way down, what it saw before.

Chaitanya et al. 2017, "Interactive Reconstruction of Monte Carlo Image Sequences using a Recurrent Denoising
Autoencoder", ACM Transactions on Graphics 36(4). The denoiser of OptiX 5.1, "ONND" in the comparison of
doi:10.1007/s00371-023-02951-6, came of this work and is a black box: this is a re-implementation of the paper, and no
figure of it is one of OptiX.

Nothing is accumulated and nothing is warped: the memory is a hidden state at each of six resolutions,

    a = L(conv(x)),  h_t = L(conv(L(conv([a, h_{t-1}])))),  L = LeakyReLU with slope 0.1,

3x3 convolutions all of them. Encoder stages have 32, 43, 57, 76 and 101 channels, a factor of 4/3 each, and 2x2
max-pooling after them; the bottleneck has 101. A decoder stage is nearest-neighbour upsampling, the stage of the
encoder at that resolution beside it, and two convolutions with L.

The seven input channels are radiance without albedo 3, normal in view space x and y 2, depth 1, roughness 1. What is
left open, and what is taken here:

- radiance goes in and comes out as ``log(1 + x)``, typical radiance brought to 0.5 (:class:`mcdenoise.models.Exposed`);
- the last convolution has no L; below zero is black, and no pixel becomes brighter than the brightest of the input;
- its second to last has as many channels as the first stage of the encoder;
- without a camera, x and y of the normal as the renderer wrote it; depth in [0, 1] is ``d / (d + typical depth)``;
  what a frame lacks is constant: depth and roughness are 1, the normal is 0;
- any size: stages of odd height or width keep the last row and column by themselves;
- when a shot ends: at another size, and at a cut, where less than 5 % of an image shows what the frame before showed.
  What has no motion has no cuts, and whoever calls the method begins anew.

Its authors' loss is ``[train] loss = "rae"`` (:func:`mcdenoise.train.losses.rae_loss`), on clips of 7 frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mcdenoise.frame import MOTION, Frame, tells_motion
from mcdenoise.models._interface import Model, Needs, Output, State
from mcdenoise.models._journal import ask, journal
from mcdenoise.models._registry import register_model
from mcdenoise.models._state import own_state
from mcdenoise.models.accumulated import CUT_FRACTION
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.models.exposed import Exposed
from mcdenoise.models.recurrent import Before, from_before, to_be_kept
from mcdenoise.nn.inputs import features_of, normalize_depth
from mcdenoise.ops import upsample

STAGES, GROWTH, SLOPE = 5, 4 / 3, 0.1
_TYPICAL = 0.5  # exposed radiance


class Memory(NamedTuple):
    """What is kept of a shot. All of it zeros is that of no frame.

    Args:
        hidden: ``(B, C, H / s, W / s)`` of each stage, finest first, sizes rounded up; the bottleneck's last.
        before: what was seen, to tell a cut; its image is empty.
    """

    hidden: tuple[Tensor, ...]
    before: Before


class _Recurrent(nn.Module):
    """A stage with a hidden state, which is its result."""

    def __init__(self, entering: int, width: int) -> None:
        super().__init__()
        self.entry, self.first, self.second = _conv(entering, width), _conv(2 * width, width), _conv(width, width)

    def forward(self, x: Tensor, hidden: Tensor | None) -> Tensor:
        a = _leaky(self.entry(x))
        before = torch.zeros_like(a) if hidden is None else hidden.to(a.dtype)
        return _leaky(self.second(_leaky(self.first(torch.cat([a, before], 1)))))


class Rae(nn.Module):
    """The network, on exposed radiance without albedo.

    Args:
        width: channels of the first stage, the paper's 32.
    """

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
        nn.init.constant_(last, torch.log1p(torch.tensor(_TYPICAL)).item())  # type: ignore[arg-type]

    @property
    def persistence(self) -> None:
        """Nobody knows what the network has learnt to remember, see :func:`mcdenoise.models.frames_remembered`."""

    @property
    def needs(self) -> Needs:
        """Color; of use are its features, and what tells motion and with it a cut."""
        features = frozenset({"normal", "depth", "roughness", "view_projection"})
        return Needs(uses=features | MOTION)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        frame = frame.with_depth()
        color = frame.color
        memory = own_state(state, Memory, frame, channels=self.encoder[0].entry.out_channels)
        x, hidden = input_of(frame), _recalled(frame, memory)
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
        top = torch.log1p(color.amax((1, 2, 3), keepdim=True))
        image = torch.expm1(torch.minimum(x.to(color.dtype).clamp_min(0), top))
        kept = to_be_kept(frame, torch.zeros_like(color[:, :1]))
        return Output(image), None if kept is None else Memory(after, kept)


def input_of(frame: Frame) -> Tensor:
    """``(B, 7, H, W)``: logarithm of radiance, normal in view space, depth and roughness."""
    one = torch.ones_like(frame.color[:, :1])
    depth = one if frame.depth is None else normalize_depth(frame.depth)
    roughness = one if frame.roughness is None else frame.roughness
    parts = torch.log1p(frame.color), view_normal(frame), depth, roughness
    return torch.cat([part.to(one.dtype) for part in parts], 1)


def view_normal(frame: Frame) -> Tensor:
    """The normal along the image's x and y, ``(B, 2, H, W)`` in [-1, 1]; without a camera, its own x and y.

    Clip x and y are the camera's axes times a scale, and a part along the view axis where the image is a crop of a
    larger one; clip w is along the view axis, or constant if the camera has no perspective.
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


def _recalled(frame: Frame, memory: Memory | None) -> list[Tensor | None]:
    """The hidden states that this frame may see."""
    nothing: list[Tensor | None] = [None] * (STAGES + 1)
    fits = memory is not None and memory.before.image.shape == frame.color[:, :1].shape
    if memory is None or not fits:
        if (found := journal()) is not None:
            found.reset = "first frame" if memory is None else "size change"
        return nothing
    if not tells_motion(frame.buffers):
        return list(memory.hidden)
    _, weight = from_before(frame, memory.before, channels=1)
    goes_on = weight.mean((1, 2, 3), keepdim=True) >= CUT_FRACTION
    if (found := journal()) is not None and not found.reset:

        def tell(any_goes_on: Sequence[float]) -> None:
            found.reset = "" if any_goes_on[0] else "cut"

        ask(goes_on.any(), tell)
    return [torch.where(goes_on, hidden, 0) for hidden in memory.hidden]


def _conv(entering: int, leaving: int) -> nn.Conv2d:
    layer = nn.Conv2d(entering, leaving, 3, padding=1)
    nn.init.kaiming_normal_(layer.weight, a=SLOPE)
    nn.init.zeros_(layer.bias)  # type: ignore[arg-type]
    return layer


def _leaky(x: Tensor) -> Tensor:
    return F.leaky_relu(x, SLOPE)


@register_model(
    "rae",
    "a re-implementation of the recurrent autoencoder; stands for OptiX 5.1 (ONND)",
    kind="recurrent",
    paper="Chaitanya et al. 2017",
)
def rae(width: int = 32) -> Model:
    """The recurrent denoising autoencoder of Chaitanya et al. 2017, re-implemented.

    Args:
        width: channels of the first stage, the paper's 32; each further one has 4/3 of them.
    """
    return Demodulated(Exposed(Rae(width)))
