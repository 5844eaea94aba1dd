"""The family ``oidn_tuned``: Open Image Denoise's network with a memory, trained further on frames of two renderers.

Open Image Denoise's network denoises a frame by itself, is told whether its features have noise, and returns its own
image even where the input is clean. Here the same layers, which start with the library's published weights, also see
the previous result, reprojected, and predict for every pixel which of four images to trust: the network's own; the
previous result in both forms of :class:`mcdenoise.models.Recurrent`; and the noisy pixels, which are right where there
is no noise. Training on two renderers, with noisy and with exact features and 1 to 64 samples, replaces the settings.
:class:`mcdenoise.models.Restored` around it gives back the detail of nearly clean frames.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from mcdenoise.frame import Frame
from mcdenoise.models._interface import Model, Needs, Output, State
from mcdenoise.models._journal import timed
from mcdenoise.models._layers import answered
from mcdenoise.models._registry import register_model
from mcdenoise.models.recurrent import PREVIOUS, PREVIOUS_LIGHT, PREVIOUS_WEIGHT, Recurrent
from mcdenoise.models.restored import Restored
from mcdenoise.models.tiled import Tiled
from mcdenoise.nn.oidn import OidnUNet, Size, oidn_exposure
from mcdenoise.ops._steps.tuned import tuned_choice, tuned_input
from mcdenoise.ops._window import corner

# Color, albedo and normal, as in the library; the previous result in both forms, and its weight.
_CHANNELS = 9 + 3 + 3 + 1
# Initial logits of the network's image, of the previous result in both forms, and of the noisy pixels.
_LOGITS = (0.0, -2.0, -2.0, -7.0)


class TunedNetwork(nn.Module):
    """The network: ``expand(sum_i w_i x_i)`` over four images ``x_i`` on the library's scale of radiance.

    ``w = a softmax(l) / sum(a softmax(l))`` with predicted logits ``l`` and ``a = (1, v, v, 1)``, where ``v`` is the
    fraction of the previous frame that shows the same surface. So without a history the previous result has no weight.

    It has to be wrapped in :class:`mcdenoise.models.Recurrent`. A missing albedo counts as one, a missing normal as
    zero.

    Args:
        size: see :class:`mcdenoise.nn.oidn.OidnUNet`.
    """

    def __init__(self, size: Size = "base") -> None:
        super().__init__()
        self.unet = OidnUNet(_CHANNELS, size, out_channels=3 + len(_LOGITS))

    @property
    def needs(self) -> Needs:
        """Needs color; uses albedo, normal, and the previous result."""
        uses = frozenset({"albedo", "normal", PREVIOUS, PREVIOUS_LIGHT, PREVIOUS_WEIGHT})
        return Needs(uses=uses, reach=self.unet.reach, stride=self.unet.multiple)

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """The exposure of the whole image."""
        return {"oidn_exposure": oidn_exposure(frame.color)}

    def bytes_per_pixel(self, *, bfloat16: bool) -> float:
        """Peak memory per pixel of a tile, see :class:`mcdenoise.models.Tiled`."""
        return self.unet.bytes_per_pixel(bfloat16=bfloat16)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        color = frame.color
        exposure = (frame.statistics or self.statistics(frame))["oidn_exposure"]
        before, light = (frame.extra.get(name, torch.zeros_like(color)) for name in (PREVIOUS, PREVIOUS_LIGHT))
        valid = frame.extra.get(PREVIOUS_WEIGHT, torch.zeros_like(color[:, :1]))
        with timed("network", color.device):
            buffers = (color, before, light, frame.albedo, frame.normal, valid, exposure)
            seen, images = tuned_input(*buffers, self.unet.multiple)
            predicted = corner(self.unet(seen), *frame.size)
            image = tuned_choice(predicted, images, valid, exposure, _LOGITS).to(color.dtype)
        return answered(frame, image, None), None


_PRESETS: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("oidn_tuned", "the network of quality balanced", {}),
    ("oidn_tuned_small", "the network of quality fast", {"size": "small"}),
)


def _tuned(size: Size = "base", *, restore: bool = True) -> Model:
    """The network with its memory.

    Args:
        size: see :class:`mcdenoise.nn.oidn.OidnUNet`.
        restore: whether :class:`mcdenoise.models.Restored` gives back detail.
    """
    model = Recurrent(Tiled(TunedNetwork(size)))
    return Restored(model) if restore else model


for _name, _about, _settings in _PRESETS:
    register_model(
        _name,
        f"Open Image Denoise's network with a memory, trained further: {_about}",
        kind="recurrent",
        paper="after Intel Open Image Denoise 2.5",
        **_settings,
    )(_tuned)
