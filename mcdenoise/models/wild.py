"""The family ``wild``: one network for sequences and stills, that sees all light which the history holds.

The layers are those of Open Image Denoise, and can start with the weights that it was published with. In the place of
the library's noisy image they see the accumulated radiance, which holds the samples of all frames that showed the same
surface; beside it the frame, how long the history is, and on request the previous result. Each pixel of the result is a
weighted mean of the network's own image and of these: the history is right where it is long, the frame where it has
many samples, so the error falls with every sample.

Without training the library's result of the accumulated radiance is worse than that of the frame wherever the history
is late or blurred: such noise looks like texture. A few minutes of training change that, at a low rate: five times the
rate destroys what the library's weights know.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, TypeAlias

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.models._entries import register_family
from mcdenoise.models._interface import Model, Needs, Output, State
from mcdenoise.models._layers import answered
from mcdenoise.models.accumulated import Accumulated
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.models.recurrent import PREVIOUS, PREVIOUS_WEIGHT, Recurrent
from mcdenoise.models.tiled import Tiled
from mcdenoise.nn.oidn import OidnUNet, Size, oidn_exposure
from mcdenoise.ops import demodulate, remodulate
from mcdenoise.ops._steps.tuned import tuned_choice, tuned_input
from mcdenoise.ops._window import corner

History: TypeAlias = Literal["accumulated", "previous", "both"]

# Accumulated radiance, albedo and normal as the library sees them; the frame, the previous result; the history.
_CHANNELS = 9 + 3 + 3 + 1
# Initial logits of the network's image, of the frame, of the previous result, and of the accumulated radiance.
_LOGITS = (0.0, -4.0, -4.0, -4.0)
_LITTLE = -8.0  # that of the network's image, while its weights are random


class WildNetwork(nn.Module):
    """The network: ``expand(sum_i w_i x_i)`` over four images ``x_i`` on the library's scale of radiance.

    They are the image that the network predicts, the frame, the previous result and the accumulated radiance:
    ``w = a softmax(l) / sum(a softmax(l))`` with predicted logits ``l`` and ``a = (1, h, h, 1)``, where ``h`` is the
    part of the history in the accumulated radiance, ``1 - 1 / length``, or the weight of the previous result if none is
    accumulated. So without a history only the network's image and the radiance have a weight. Radiance is taken and
    returned without its albedo, as :class:`mcdenoise.models.Demodulated` divides it out; the network works on the
    products. A missing albedo counts as one, a missing normal as zero.

    Args:
        size: see :class:`mcdenoise.nn.oidn.OidnUNet`.
        stem: side of the blocks of pixels that the layers see as one, 1 or more. The layers see the mean of a block, as
            if it was a pixel of a smaller image, and how its pixels differ from the last one.
        previous: whether the previous result is seen, of :class:`mcdenoise.models.Recurrent`.

    Raises:
        InputError: ``stem`` is below 1.
    """

    def __init__(self, size: Size = "small", stem: int = 1, *, previous: bool = False) -> None:
        super().__init__()
        if stem < 1:
            raise InputError(f"stem: expected at least 1, found {stem}")
        self.stem, self.previous, blocks = stem, previous, stem * stem
        self.unet = OidnUNet(_CHANNELS * blocks, size, out_channels=(3 + len(_LOGITS)) * blocks)
        # With random weights, the result first is the radiance that was given; other weights come with their own.
        last = self.unet.last
        assert last.bias is not None
        with torch.no_grad():
            last.weight.mul_(0.1)
            last.bias.zero_()[3].fill_(_LITTLE)
        uses, unet = {"current", "length", "albedo", "normal", *((PREVIOUS, PREVIOUS_WEIGHT) * previous)}, self.unet
        self.needs = Needs(uses=frozenset(uses), reach=stem * unet.reach, stride=stem * unet.multiple, live=unet.live)

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """The exposure of the whole image."""
        return {"oidn_exposure": oidn_exposure(_lit(frame, frame.color))}

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        color, albedo = frame.color, frame.albedo
        exposure = (frame.statistics or self.statistics(frame))["oidn_exposure"]
        alone = color if frame.current is None else frame.current
        before, part = alone, torch.zeros_like(color[:, :1])
        if self.previous and PREVIOUS in frame.extra:
            # Where there is none, the accumulated radiance is as good.
            part = frame.extra[PREVIOUS_WEIGHT]
            before = torch.lerp(color, frame.extra[PREVIOUS], part)
        part = (part if frame.length is None else 1 - 1 / frame.length.clamp_min(1)).to(color.dtype)
        color, alone, before = (_lit(frame, image.to(color.dtype)) for image in (color, alone, before))
        seen, images = tuned_input(color, alone, before, albedo, frame.normal, part, exposure, self.needs.stride)
        predicted = corner(self._predicted(seen), *frame.size)
        image = tuned_choice(predicted, images, part, exposure, _LOGITS).to(color.dtype)
        return answered(frame, image if albedo is None else demodulate(image, albedo)), None

    def _predicted(self, seen: Tensor) -> Tensor:
        """Image and logits for ``(B, 16, H, W)``."""
        if self.stem == 1:
            return self.unet(seen)  # type: ignore[no-any-return]
        # The first channels are those that the library's weights are for.
        mean = F.avg_pool2d(seen, self.stem)
        pixels = F.pixel_unshuffle(seen, self.stem).unflatten(1, (_CHANNELS, -1))
        rest = (pixels[:, :, :-1] - pixels[:, :, -1:]).transpose(1, 2).flatten(1, 2)
        shared, own = self.unet(torch.cat([mean, rest], 1)).split([3 + len(_LOGITS), rest.shape[1] // _CHANNELS * 7], 1)
        own = own.unflatten(1, (-1, shared.shape[1])).transpose(1, 2)
        blocks = shared[:, :, None] + torch.cat([own, torch.zeros_like(own[:, :, :1])], 2)
        return F.pixel_shuffle(blocks.flatten(1, 2), self.stem)


def _lit(frame: Frame, image: Tensor) -> Tensor:
    return image if frame.albedo is None else remodulate(image, frame.albedo)


def _wild(size: Size = "small", stem: int = 1, *, history: History = "accumulated", alpha_min: float = 0.03) -> Model:
    """The network behind its history.

    Args:
        size: see :class:`WildNetwork`.
        stem: see :class:`WildNetwork`.
        history: what the network sees of earlier frames: the accumulated radiance, the previous result, or both.
        alpha_min: smallest weight of a frame in the accumulated radiance, see :class:`mcdenoise.models.Accumulated`.

    Raises:
        InputError: a setting is out of its range.
    """
    if history not in ("accumulated", "previous", "both"):
        raise InputError(f"history: expected accumulated, previous or both, found '{history}'")
    model: Model = Tiled(WildNetwork(size, stem, previous=history != "accumulated"))
    model = model if history == "accumulated" else Recurrent(model)
    return Demodulated(model if history == "previous" else Accumulated(model, alpha_min=alpha_min))


register_family(
    _wild,
    "one network for sequences and stills, that sees the accumulated radiance",
    {
        "wild": ("at full resolution", {}),
        "wild_small": ("at half resolution", {"stem": 2}),
        "wild_large": ("at full resolution, with twice the multiplications", {"size": "base"}),
    },
    kind="recurrent",
    paper="after Intel Open Image Denoise 2.5",
)
