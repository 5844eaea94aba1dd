"""The family ``wild``: one network for sequences and stills, that sees all light which the history holds.

The layers are those of Open Image Denoise, and can start with the weights that it was published with. In the place of
the library's noisy image they see a mean of the frame and of the accumulated radiance, which holds the samples of all
frames that showed the same surface, or only of the last four. A small network weighs them: a longer history has less
noise, but is late or blurred where light changes and where pixels move by fractions. Beside it the layers see the
frame, the accumulated radiance, and how long the history is. Each pixel of the result is a weighted mean of the
network's own image and of these, so the error falls with every sample. Noisy features are denoised before all this, but
for the small size.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mcdenoise.frame import Frame
from mcdenoise.models._interface import Model, Needs, Output, State
from mcdenoise.models._layers import answered
from mcdenoise.models._registry import register_model
from mcdenoise.models.accumulated import Accumulated
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.models.filtered import Features, Filtered
from mcdenoise.models.skipping import TOLERANCE, Skipping
from mcdenoise.models.tiled import Tiled
from mcdenoise.nn._cpu import channels_last
from mcdenoise.nn.oidn import OidnUNet, Size, oidn_exposure
from mcdenoise.ops import NO_ALBEDO, remodulate
from mcdenoise.ops._constants import BLOCK
from mcdenoise.ops._steps.transfer import compress
from mcdenoise.ops._steps.wild import differences, wild_choice, wild_figures, wild_input
from mcdenoise.ops._window import block_means, corner, parts_of
from mcdenoise.ops.lag import THRESHOLD

# The mean of frame and history, albedo, normal as the library sees them; the frame, the accumulated radiance; the part
# of the history.
_CHANNELS = 9 + 3 + 3 + 1
# Initial logits of the network's image, of the frame, of the accumulated radiance, and of the mean.
_LOGITS = (0.0, -7.0, -7.0, -7.0)
_LITTLE = -12.0  # that of the network's image, while its weights are random
_PACE = 16.0  # factor of all logits, by which they learn faster than the layers that start with weights
# The network for the weights of the history: channels, and the initial logits.
_WIDTH, _TRUST = 24, (1.5, 0.0)
_FIGURES = 20
_LEAST = 3e-3  # smallest difference that matters, on the library's scale


class Trust(nn.Module):
    """The weights of the accumulated radiance beside the frame, and of all its frames beside the recent ones.

    It sees blocks of 4x4 pixels. A long history has less noise; but it is late where light or reflections move, blurred
    where pixels move by fractions, and noise that neighbours share stays in it. Of the frame, the recent and the whole
    history it sees the means, the standard deviations, and for each two of them the mean absolute difference and the
    differences of the means of 4x4 and of 16x16 pixels: a difference of single pixels is noise, one of means is late
    light. And the part of the history, the standard deviations of albedo and normal, and how many pixels show a surface
    at all: a background has no noise, and radiance through a pixel filter, divided by an albedo without one, is wrong
    where the albedo changes.
    """

    reach = (3 + 2 + 6) * BLOCK

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for entering in (_FIGURES, _WIDTH, _WIDTH):
            layers += [nn.Conv2d(entering, _WIDTH, 3, padding=1, padding_mode="replicate"), nn.ReLU()]
        self.layers, self.last = nn.Sequential(*layers), nn.Conv2d(_WIDTH, len(_TRUST), 1)
        assert self.last.bias is not None
        with torch.no_grad():
            self.last.weight.mul_(0.1 / _PACE)
            self.last.bias.copy_(torch.tensor(_TRUST) / _PACE)

    def forward(self, figures: Tensor) -> Tensor:
        """The logits ``(B, 2, H, W)`` of the weights of the accumulated radiance, and of the whole history in it.

        Args:
            figures: ``(B, 19, H, W)`` of blocks, see :func:`mcdenoise.ops._steps.wild.wild_figures`.
        """
        means, normal, apart, part, light, variances = figures.split([4, 3, 3, 1, 3, 5], 1)
        lengths = variances[:, 4:] + normal.square().sum(1, keepdim=True)
        # Means of radiance, which noise does not change.
        far = differences(compress(block_means(light, 4)))
        far = corner(F.interpolate(far, scale_factor=4, mode="bilinear", align_corners=False), *part.shape[-2:])
        each = torch.cat([apart, differences(means), far, variances.clamp_min(_LEAST**2).sqrt()], 1)
        seen = [means[:, :3], (each + _LEAST).log() / 2, part, (1.02 - part).log() / 2, lengths]
        logits: Tensor = _PACE * self.last(self.layers(channels_last(torch.cat(seen, 1), figures.dtype)))
        return logits.to(figures.dtype)


class WildNetwork(nn.Module):
    """The network: ``expand(sum_i w_i x_i)`` over four images ``x_i`` on the library's scale of radiance.

    They are the image that the network predicts, the frame, the accumulated radiance (a mean of the recent and of the
    whole history), and the mean of the last two, see :class:`Trust`: ``w = a softmax(l) / sum(a softmax(l))`` with
    predicted logits ``l`` and ``a = (1, h, h, 1)``, where ``h`` is the part of the history in the accumulated radiance,
    ``1 - 1 / length``. So without a history only the network's image and the radiance have a weight; a background has
    none. Radiance is taken and returned without its albedo, as :class:`mcdenoise.models.Demodulated` divides it out;
    the network works on the products. A missing albedo counts as one, a missing normal as zero.

    Args:
        size: see :class:`mcdenoise.nn.oidn.OidnUNet`.
    """

    def __init__(self, size: Size = "base") -> None:
        super().__init__()
        self.unet = OidnUNet(_CHANNELS, size, out_channels=3 + len(_LOGITS))
        self.trust = Trust()
        # With random weights, the result first is the radiance that was given; other weights come with their own.
        last = self.unet.last
        assert last.bias is not None
        with torch.no_grad():
            last.weight.mul_(0.1)
            last.weight[3:].div_(_PACE)
            last.bias.zero_()[3].fill_(_LITTLE / _PACE)
        uses, unet = frozenset({"current", "recent", "length", "albedo", "normal", "depth"}), self.unet
        self.needs = Needs(uses=uses, reach=unet.reach + Trust.reach, stride=unet.multiple, live=unet.live)

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """The exposure of the whole image."""
        color = frame.color if frame.albedo is None else remodulate(frame.color, frame.albedo)
        return {"oidn_exposure": oidn_exposure(color)}

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        color, albedo, normal = frame.color, frame.albedo, frame.normal
        exposure = (frame.statistics or self.statistics(frame))["oidn_exposure"]
        alone, recent = (color if image is None else image.to(color.dtype) for image in (frame.current, frame.recent))
        buffers = (alone, recent, color, albedo, normal)
        if frame.length is None:
            length = color.new_ones(1, 1, 1, 1).expand_as(color[:, :1])
            logits = color.new_zeros(len(color), 2, *(parts_of(side, BLOCK) for side in frame.size))
        else:
            behind, length = background_of(frame), frame.length.to(color.dtype)
            length = length if behind is None else torch.where(behind, 1, length)
            logits = self.trust(wild_figures(*buffers, length, exposure))
        seen, images, part = wild_input(*buffers, length, logits, exposure, self.needs.stride)
        predicted = corner(self.unet(seen), *frame.size)
        image = wild_choice(predicted, images, part, albedo, exposure, _LOGITS, _PACE)
        return answered(frame, image.to(color.dtype)), None


def background_of(frame: Frame) -> Tensor | None:
    """Where nothing is seen, not even fog, which has an albedo: what is there has no noise, and a history blurs it."""
    if frame.depth is None:
        return None
    nothing = frame.depth == torch.inf
    return nothing if frame.albedo is None else nothing & (frame.albedo.amax(1, keepdim=True) < NO_ALBEDO)


def _wild(
    size: Size = "base",
    *,
    alpha_min: float = 0.03,
    anti_lag: bool = True,
    tolerance: float = TOLERANCE,
    features: Features | None = None,
) -> Model:
    """The network behind its history.

    Args:
        size: see :class:`WildNetwork`.
        alpha_min: smallest weight of a frame in the accumulated radiance, see :class:`mcdenoise.models.Accumulated`.
        anti_lag: whether the history is shortened where the light has changed, see :func:`mcdenoise.ops.history_lag`.
        tolerance: see :class:`mcdenoise.models.Skipping`.
        features: whether albedo and normal are noisy and to be denoised first, see
            :class:`mcdenoise.models.filtered.Filtered`; by default "auto", but "clean" for the small network, because
            the filters take almost twice as long as it does.

    Raises:
        InputError: a setting is out of its range.
    """
    model = Skipping(Tiled(WildNetwork(size)), tolerance, alpha_min)
    threshold = THRESHOLD if anti_lag else math.inf
    # Clamped fireflies are light that the network would have to guess: stills had a tenth more error.
    made = Demodulated(Accumulated(model, alpha_min=alpha_min, firefly_limit=math.inf, lag_threshold=threshold))
    if features is None:
        features = "clean" if size == "small" else "auto"
    return made if features == "clean" else Filtered(made, features)


for _name, _size, _cost in (
    ("wild", "base", "125 thousand multiplications a pixel, and 240 to denoise noisy features"),
    ("wild_small", "small", "62 thousand"),
    ("wild_large", "large", "312 thousand, and as many for features as wild"),
):
    register_model(
        _name,
        f"one network for sequences and stills, that sees the accumulated radiance: with {_cost}",
        kind="recurrent",
        paper="after Intel Open Image Denoise 2.5",
        size=_size,
    )(_wild)
