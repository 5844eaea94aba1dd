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
from mcdenoise.models._entries import register_model
from mcdenoise.models._interface import Model, Needs, Output, State
from mcdenoise.models._layers import answered
from mcdenoise.models.accumulated import Accumulated
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.models.filtered import Features, Filtered
from mcdenoise.models.skipping import TOLERANCE, Skipping
from mcdenoise.models.tiled import Tiled
from mcdenoise.nn.oidn import OidnUNet, Size, oidn_exposure
from mcdenoise.ops import NO_ALBEDO, demodulate, remodulate
from mcdenoise.ops._constants import RECENT_ALPHA
from mcdenoise.ops._steps.transfer import MAX_RADIANCE, compress
from mcdenoise.ops._steps.wild import wild_choice, wild_input
from mcdenoise.ops._window import block_means, corner, up_to_multiple
from mcdenoise.ops.lag import THRESHOLD

# The mean of frame and history, albedo, normal as the library sees them; the frame, the accumulated radiance; the part
# of the history.
_CHANNELS = 9 + 3 + 3 + 1
# Initial logits of the network's image, of the frame, of the accumulated radiance, and of the mean.
_LOGITS = (0.0, -7.0, -7.0, -7.0)
_LITTLE = -12.0  # that of the network's image, while its weights are random
_PACE = 16.0  # factor of all logits, by which they learn faster than the layers that start with weights
# The network for the weights of the history: side of the blocks that it sees, channels, and the initial logits.
_BLOCK, _WIDTH, _TRUST = 4, 24, (1.5, 0.0)
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

    reach = (3 + 2 + 6) * _BLOCK

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

    def forward(
        self,
        alone: Tensor,
        recent: Tensor,
        color: Tensor,
        part: Tensor,
        albedo: Tensor | None,
        normal: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        """The weights ``(B, 1, H, W)`` of the accumulated radiance, and of the whole history in it.

        Args:
            alone: ``(B, 3, H, W)`` radiance of the frame, times the exposure.
            recent: ``(B, 3, H, W)`` likewise, of the recent history.
            color: ``(B, 3, H, W)`` likewise, of the whole history.
            part: ``(B, 1, H, W)`` part of the history in it.
            albedo: ``(B, 3, H, W)`` of the frame; ``None`` counts as one.
            normal: likewise; ``None`` counts as zero.
        """
        # In ONNX, bounds that are integers become tensors, which onnxscript loses if two steps clamp the same image.
        albedo = torch.ones_like(alone) if albedo is None else albedo.to(alone.dtype).clamp(0.0, 1.0)
        normal = torch.zeros_like(alone) if normal is None else normal.to(alone.dtype).clamp(-1.0, 1.0)
        images = [image.clamp_max(MAX_RADIANCE) for image in (alone, recent, color)]
        light = torch.cat([image.mean(1, keepdim=True) for image in images], 1)
        shown = torch.cat([image.mean(1, keepdim=True) for image in (*map(compress, images), albedo)], 1)
        each = torch.cat([shown, normal, _apart(shown), part, light], 1)
        each = up_to_multiple(each, _BLOCK, "replicate")
        means, apart, part, light = F.avg_pool2d(each, _BLOCK).split([7, 3, 1, 3], 1)
        # Not mean squares less squared means: in half precision nothing is left of them where a block is even.
        pixels = each[:, :7].unflatten(3, (-1, _BLOCK)).unflatten(2, (-1, _BLOCK))
        squares = (pixels - means[:, :, :, None, :, None]).square().flatten(4).flatten(2, 3)
        variances, of_normal = F.avg_pool2d(squares, _BLOCK).split([4, 3], 1)
        means, normal = means.split([4, 3], 1)
        of_normal = of_normal.sum(1, keepdim=True)
        lengths = of_normal + normal.square().sum(1, keepdim=True)
        # Means of radiance, which noise does not change.
        far = _apart(compress(block_means(light, 4)))
        far = corner(F.interpolate(far, scale_factor=4, mode="bilinear", align_corners=False), *part.shape[-2:])
        variances = torch.cat([variances, of_normal], 1)
        differences = torch.cat([apart, _apart(means), far, variances.clamp_min(_LEAST**2).sqrt()], 1)
        seen = [means[:, :3], (differences + _LEAST).log() / 2, part, (1.02 - part).log() / 2, lengths]
        logits = _PACE * self.last(self.layers(torch.cat(seen, 1))).to(alone.dtype)
        wide: Tensor = F.interpolate(logits, scale_factor=_BLOCK, mode="bilinear", align_corners=False).sigmoid()
        trust, whole = corner(wide, *alone.shape[-2:]).split(1, 1)
        return trust, whole


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
        return {"oidn_exposure": oidn_exposure(_lit(frame, frame.color))}

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        color, albedo = frame.color, frame.albedo
        exposure = (frame.statistics or self.statistics(frame))["oidn_exposure"]
        alone = color if frame.current is None else frame.current.to(color.dtype)
        history, alone = _lit(frame, color), _lit(frame, alone)
        mean, part = history, torch.zeros_like(color[:, :1])
        if frame.length is not None:
            recent = history if frame.recent is None else _lit(frame, frame.recent.to(color.dtype))
            lengths = (frame.length.clamp_max(1 / RECENT_ALPHA), frame.length)
            short, part = ((1 - 1 / length.clamp_min(1)).to(color.dtype) for length in lengths)
            if (behind := background_of(frame)) is not None:
                short, part = (torch.where(behind, 0, each) for each in (short, part))
                recent, history = (torch.where(behind, alone, image) for image in (recent, history))
            exposed = (image * exposure for image in (alone, recent, history))
            trust, whole = self.trust(*exposed, part, albedo, frame.normal)
            history, part = torch.lerp(recent, history, whole), torch.lerp(short, part, whole)
            mean = torch.lerp(alone, history, trust)
        seen, images = wild_input(mean, alone, history, albedo, frame.normal, part, exposure, self.needs.stride)
        image, logits = corner(self.unet(seen), *frame.size).split([3, len(_LOGITS)], 1)
        predicted = torch.cat([image, _PACE * logits], 1)
        image = wild_choice(predicted, images, part, exposure, _LOGITS).to(color.dtype)
        return answered(frame, image if albedo is None else demodulate(image, albedo)), None


def _apart(images: Tensor) -> Tensor:
    """How far frame, recent and whole history differ."""
    alone, recent, color, *_ = images.split(1, 1)
    return torch.cat([alone - color, recent - color, alone - recent], 1).abs()


def _lit(frame: Frame, image: Tensor) -> Tensor:
    return image if frame.albedo is None else remodulate(image, frame.albedo)


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
