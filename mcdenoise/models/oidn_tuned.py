"""The family ``oidn_tuned``: Open Image Denoise's network with a memory, trained further on frames of two renderers.

Open Image Denoise's network denoises a frame by itself, is told whether its features have noise, and returns its own
image even where the input is clean. Here the same layers, which start with the library's published weights, also see
the previous result, reprojected, and predict for every pixel which of four images to trust: the network's own; the
previous result in both forms of :class:`mcdenoise.models.Recurrent`; and the noisy pixels, which are right where there
is no noise. Training on two renderers, with noisy and with exact features and 1 to 64 samples, replaces the settings.
Since the library's own weights are better for little independent noise, the network of a frame has weights between
these and the trained ones, according to its noise. :class:`mcdenoise.models.Restored` gives back the detail of nearly
clean frames.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.func import functional_call

from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.models._entries import register_family
from mcdenoise.models._interface import Model, Needs, Output, State
from mcdenoise.models._layers import answered
from mcdenoise.models.recurrent import PREVIOUS, PREVIOUS_LIGHT, PREVIOUS_WEIGHT, Recurrent
from mcdenoise.models.restored import Restored
from mcdenoise.models.tiled import Tiled
from mcdenoise.nn.oidn import OidnUNet, Size, oidn_exposure
from mcdenoise.noise import noise_of
from mcdenoise.ops._steps.tuned import tuned_choice, tuned_input
from mcdenoise.ops._window import corner

# Color, albedo and normal, as in the library; the previous result in both forms, and its weight.
_CHANNELS = 9 + 3 + 3 + 1
# Initial logits of the network's image, of the previous result in both forms, and of the noisy pixels.
_LOGITS = (0.0, -2.0, -2.0, -7.0)
# Fraction of the weights before the training: at the most, how it falls with the level of noise, and at the least. For
# correlated noise, which those weights do not remove, it is smaller.
_MOST, _FALL, _LEAST, _SPREAD = 1.1, 2.0, 0.4, 0.6


class TunedNetwork(nn.Module):
    """The network: ``expand(sum_i w_i x_i)`` over four images ``x_i`` on the library's scale of radiance.

    ``w = a softmax(l) / sum(a softmax(l))`` with predicted logits ``l`` and ``a = (1, v, v, 1)``, where ``v`` is the
    fraction of the previous frame that shows the same surface. So without a history the previous result has no weight.

    In evaluation, the weights of its layers are ``(1 - f) trained + f start``, where ``start`` are the weights before
    the training: means of both are better on frames unlike those that were trained on (Wortsman et al. 2022, "Robust
    fine-tuning of zero-shot models", CVPR). Of a frame with noise of level n and spread s, see
    :func:`mcdenoise.noise.noise_of`, the fraction is ``f = max(clamp(1.1 - 2 n, 0.4, 1) - 0.6 s, 0)``. It is 0 if the
    training did not begin with the weights of a model (:func:`mcdenoise.models.start_with`). Each image of a batch has
    its own fraction; in a compiled or exported graph all have the mean.

    It has to be wrapped in :class:`mcdenoise.models.Recurrent`. A missing albedo counts as one, a missing normal as
    zero.

    Args:
        size: see :class:`mcdenoise.nn.oidn.OidnUNet`.
        fraction: f for all frames, in [0, 1]; ``None`` for that of the frame's noise.

    Raises:
        InputError: ``fraction`` is outside [0, 1].
    """

    kept: Tensor  # 1 if there are weights before the training, else 0

    def __init__(self, size: Size = "base", fraction: float | None = None) -> None:
        super().__init__()
        if fraction is not None and not 0 <= fraction <= 1:
            raise InputError(f"fraction: expected in [0, 1], found {fraction}")
        self.fraction = fraction
        self.unet = OidnUNet(_CHANNELS, size, out_channels=3 + len(_LOGITS))
        self.start = _with_buffers(copy.deepcopy(self.unet))
        self.register_buffer("kept", torch.zeros(()))
        uses, unet = frozenset({"albedo", "normal", PREVIOUS, PREVIOUS_LIGHT, PREVIOUS_WEIGHT}), self.unet
        self.needs = Needs(uses=uses, reach=unet.reach, stride=unet.multiple, live=unet.live)

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """The exposure of the whole image, and the fraction of the initial weights for its noise."""
        exposure = oidn_exposure(frame.color)
        fixed = 0.0 if self.training else self.fraction
        if fixed is not None:
            fraction = torch.full_like(exposure, fixed)
        else:
            level, spread = noise_of(frame.color, frame.albedo, frame.normal)
            fraction = ((_MOST - _FALL * level).clamp(_LEAST, 1.0) - _SPREAD * spread).clamp_min(0)
        return {"oidn_exposure": exposure, "start_fraction": fraction * self.kept}

    def keep_start(self) -> None:
        """Keep the present weights as those before the training, unless there are such weights already."""
        if not self.kept:
            self.start.load_state_dict(self.unet.state_dict())
            self.kept.fill_(1)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        color = frame.color
        statistics = frame.statistics or self.statistics(frame)
        exposure = statistics["oidn_exposure"]
        before, light = (frame.extra.get(name, torch.zeros_like(color)) for name in (PREVIOUS, PREVIOUS_LIGHT))
        valid = frame.extra.get(PREVIOUS_WEIGHT, torch.zeros_like(color[:, :1]))
        buffers = (color, before, light, frame.albedo, frame.normal, valid, exposure)
        seen, images = tuned_input(*buffers, self.unet.multiple)
        predicted = corner(self._predicted(seen, statistics["start_fraction"]), *frame.size)
        image = tuned_choice(predicted, images, valid, exposure, _LOGITS).to(color.dtype)
        return answered(frame, image, None), None

    def _predicted(self, seen: Tensor, fractions: Tensor) -> Tensor:
        """The result of the network for ``(B, 16, H, W)``, with weights for each image."""
        if self.training:
            return self.unet(seen)  # type: ignore[no-any-return]
        # A graph for any number of images cannot have weights for each.
        single = torch.compiler.is_compiling() or len(seen) == 1 or self.fraction is not None
        parts = [(seen, fractions.mean())] if single else zip(seen.split(1), fractions.flatten(), strict=True)
        start = list(self.start.buffers())
        found = []
        for images, fraction in parts:
            pairs = zip(self.unet.named_parameters(), start, strict=True)
            weights = {name: torch.lerp(own, other, fraction.to(own.dtype)) for (name, own), other in pairs}
            found.append(functional_call(self.unet, weights, (images,)))
        return torch.cat(found) if len(found) > 1 else found[0]


def _with_buffers(module: nn.Module) -> nn.Module:
    """A module whose parameters are buffers, which are not trained and not counted."""
    for part in module.modules():
        for name, weight in list(part.named_parameters(recurse=False)):
            delattr(part, name)
            part.register_buffer(name, weight.detach())
    return module


def _tuned(size: Size = "base", *, fraction: float | None = None, restore: bool = True) -> Model:
    """The network with its memory.

    Args:
        size: see :class:`mcdenoise.nn.oidn.OidnUNet`.
        fraction: see :class:`TunedNetwork`.
        restore: whether :class:`mcdenoise.models.Restored` gives back detail.

    Raises:
        InputError: ``fraction`` is outside [0, 1].
    """
    model: Model = Recurrent(Tiled(TunedNetwork(size, fraction)))
    return Restored(model) if restore else model


register_family(
    _tuned,
    "Open Image Denoise's network with a memory, trained further",
    {
        "oidn_tuned": ("the network of quality balanced", {}),
        "oidn_tuned_small": ("the network of quality fast", {"size": "small"}),
        "oidn_tuned_exact": ("the network of quality balanced, for features without noise", {}),
    },
    kind="recurrent",
    paper="after Intel Open Image Denoise 2.5",
)
