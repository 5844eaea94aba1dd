"""The family ``pyramid``: one U-Net that weighs, splits and filters the noisy pixels themselves, scale by scale.

Every pixel of the result is a weighted mean of noisy pixels, times a bounded factor. One network predicts all weights,
and so decides what rules decide elsewhere:

- how far the history is to be trusted against the frame alone, pixel by pixel: highlights and reflections do not move
  with the surface whose history they are in;
- how much of the light is matt: what is filtered is ``color / e`` with the effective albedo ``e = m + t (1 - m)``
  between the albedo ``m`` (t = 0) and one (t = 1). Where ``color = m D + S``, of matt light and of what a coat
  reflects, ``t / (1 - t) = S / D`` makes it as smooth as D and S are, and no grain is multiplied into highlights;
- how much a pixel is worth: a firefly little, a pixel without noise much;
- on which scale a pixel's light is to be spread: each scale keeps a part of it and hands on the rest, as in Balint et
  al. 2023, "Neural Partitioning Pyramids for Denoising Monte Carlo Renderings", Sec. 4;
- how features that have noise themselves (anti-aliased, out of focus, blurred by motion) are filtered before they are
  multiplied back or guide anything, and how far the history of the albedo is to be trusted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from mcdenoise.frame import Frame
from mcdenoise.models._interface import Model, Output, State
from mcdenoise.models._layers import answered, carried
from mcdenoise.models._pyramid import Pyramid, filtered, inside
from mcdenoise.models._registry import register_model
from mcdenoise.models.accumulated import ALBEDO_HISTORY, Accumulated
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.models.skipping import TOLERANCE, Skipping
from mcdenoise.models.tiled import Tiled
from mcdenoise.nn.inputs import FEATURES, guides_of, input_of
from mcdenoise.nn.unet import UNet
from mcdenoise.ops import cross_bilateral_filter, downsample, kernel_conv
from mcdenoise.ops._steps.network import softplus
from mcdenoise.ops.demodulation import modulation
from mcdenoise.ops.lag import THRESHOLD

SCALE_UNITS = (10.0, 1000.0, 1.0)  # of the falloffs with normal, depth and distance
_COARSE_CHANNELS = 7  # logarithms of the means, with the history and of the frame, and how much its pixels differ
# What is predicted of a pixel, and what it is before anything was learnt: the history is trusted, light is matt,
# features are exact. "albedo" weighs that of the 3x3 pixels around, of the history, and of the pyramid's own making.
_PARTS = {
    "importance": (0.0,),
    "history": (2.0,),
    "albedo": (1.0, 0.0, 0.0),
    "matt": (-1.0,),
    "gain": (0.0, 0.0, 0.0),
    "features": (0.0, 0.0, 0.0, 0.0, 4.0, 0.0, 0.0, 0.0, 0.0),
}
_QUARTERS = (4, 6, 8, 12, 16)  # of the width, at each level
_MOST_GAIN = 1.0  # of the logarithm of the factor


class PyramidNetwork(Pyramid):
    """Predicts all weights of the pyramid, and filters the image with them.

    It sees demodulated radiance, and turns it into what it filters by itself.

    Args:
        widths: feature channels of each level of the U-Net, finest first.
        kernel_size: side of the kernels at every scale.
        half: whether the U-Net begins at half the resolution.
    """

    uses = frozenset({"albedo", "normal", "depth", "current", "length", ALBEDO_HISTORY})

    def __init__(self, widths: Sequence[int], kernel_size: int = 5, half: bool = False) -> None:
        unet = UNet(9 + FEATURES, widths, len(widths) + half, _COARSE_CHANNELS, half)
        super().__init__(unet, kernel_size**2, _PARTS, falloffs=len(SCALE_UNITS), spread=0.01)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        frame = frame.replace(statistics=frame.statistics or self.statistics(frame))
        exposure = frame.statistics["exposure"]
        image = frame.color * exposure
        alone = image if frame.current is None else frame.current * exposure
        albedo = torch.ones_like(image) if frame.albedo is None else modulation(frame.albedo)
        before = modulation(frame.extra[ALBEDO_HISTORY]) if ALBEDO_HISTORY in frame.extra else albedo
        seen = torch.cat([input_of(frame, image), torch.log1p(image * albedo), before], 1)
        predicted, parts = self.predict(seen, self._coarse(image, alone), image.dtype)

        # Features of the pixel, which may be of one sample, and what the samples around it say.
        features = torch.cat([albedo, *guides_of(frame)], 1)
        smooth, guides = kernel_conv(features, torch.softmax(parts["features"], 1)).split([3, 4], 1)
        matt = 1 - torch.sigmoid(parts["matt"])
        color = torch.lerp(alone, image, torch.sigmoid(parts["history"]))
        others, ratio = carried(frame), _ratio(albedo, albedo, matt)
        if others is not None:
            # Layers, which are parts of the color, and behind them an alpha, which is not.
            count = len(frame.layers)
            others = torch.cat([others[:, : 3 * count] * ratio.repeat(1, count, 1, 1), others[:, 3 * count :]], 1)
        light = [color * ratio, albedo, *([] if others is None else [others])]
        # Of the weights alone, in the last channel, the mean is what it is divided by.
        worth = inside(parts["importance"])
        weighted = torch.cat([*light, torch.ones_like(worth)], 1) * worth
        found = self._filtered(weighted, predicted, guides)
        mean = found[:, :-1] / found[:, -1:]
        near, past, wide = torch.softmax(parts["albedo"], 1).split(1, 1)
        smooth = near * smooth + past * before + wide * mean[:, 3:6]
        gain = torch.exp(_MOST_GAIN * torch.tanh(parts["gain"]))
        result = mean[:, :3] * gain / _ratio(albedo, smooth, matt) / exposure
        return answered(frame, result, None if others is None else mean[:, 6:]), None

    def _coarse(self, image: Tensor, alone: Tensor) -> list[Tensor]:
        """At each coarser scale the logarithms of mean radiances, and how much single pixels of the frame differ.

        Over a block the means of the frame and of its history have little noise, so that a highlight that has moved, or
        light that has changed, shows as their difference.
        """
        single = alone.mean(1, keepdim=True)
        moments = torch.cat([image, alone, single, single.square()], 1)
        found: list[Tensor] = []
        for _ in range(self.unet.levels + self.unet.stride - 2):
            moments = downsample(moments)
            mean, square = moments[:, 6:7], moments[:, 7:]
            spread = (square - mean.square()).clamp_min(1e-12).sqrt() / (mean + 0.01)
            found.append(torch.log1p(torch.cat([moments[:, :6], spread], 1)))
        return found[self.unet.stride - 1 :]

    def _filtered(self, light: Tensor, predicted: list[Tensor], guides: Tensor) -> Tensor:
        """All scales with kernels that fall off where the guides differ."""
        guiding = [guides]
        for _ in predicted[1:]:
            guiding.append(downsample(guiding[-1]))

        def at(light: Tensor, prediction: Tensor, scale: int) -> Tensor:
            guide = guiding[scale]
            falloffs = softplus(prediction[:, self.taps : self.taps + len(SCALE_UNITS)], SCALE_UNITS)
            return cross_bilateral_filter(
                light,
                prediction[:, : self.taps],
                [guide[:, :3], guide[:, 3:]],
                [falloffs[:, :1], falloffs[:, 1:2]],
                falloffs[:, 2:],
                border="renormalize",
            )

        return filtered(light, predicted, at)


def _ratio(albedo: Tensor, smooth: Tensor, matt: Tensor) -> Tensor:
    """Albedo over the effective albedo of what is smooth: from demodulated radiance to what is filtered."""
    return albedo / torch.lerp(torch.ones_like(smooth), smooth, matt)


def _pyramid(
    width: int = 32,
    kernel_size: int = 5,
    half: bool = False,
    *,
    alpha_min: float = 0.1,
    anti_lag: bool = True,
    tolerance: float = TOLERANCE,
) -> Model:
    """The pyramid with all that it wears.

    Args:
        width: feature channels of the finest level, a multiple of 4.
        kernel_size: side of the kernels.
        half: whether the U-Net begins at half the resolution; it has one level less then.
        alpha_min: see :class:`mcdenoise.models.Accumulated`.
        anti_lag: likewise.
        tolerance: see :class:`mcdenoise.models.Skipping`.
    """
    widths = [width * quarters // 4 for quarters in _QUARTERS[: len(_QUARTERS) - half]]
    return Demodulated(
        Accumulated(
            Skipping(Tiled(PyramidNetwork(widths, kernel_size, half)), tolerance, alpha_min),
            alpha_min=alpha_min,
            lag_threshold=THRESHOLD if anti_lag else math.inf,
            clamp_current=False,
            also=("albedo",),
        )
    )


_ABOUT = "one network weighs, splits and filters the noisy pixels at all scales"
for _name, _about, _settings in (
    ("pyramid", "width 32, 5x5 kernels", {}),
    ("pyramid_small", "width 16, 5x5 kernels", {"width": 16}),
    ("pyramid_tiny", "width 24, 3x3 kernels, half the resolution", {"width": 24, "kernel_size": 3, "half": True}),
):
    register_model(_name, f"{_ABOUT}: {_about}", **_settings)(_pyramid)
