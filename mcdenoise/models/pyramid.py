"""The family ``pyramid``: one U-Net weighs, splits and filters the noisy pixels themselves, scale by scale.

Every pixel of the result is a weighted mean of noisy pixels, times a bounded factor. One network predicts all weights,
and so makes the decisions for which other methods have fixed rules:

- how far to trust the history against the current frame, for each pixel: highlights and reflections do not move with
  the surface whose history they are in;
- how diffuse the light is: the filtered signal is ``color / e`` with the effective albedo ``e = m + t (1 - m)``,
  between the albedo ``m`` (t = 0) and one (t = 1). For ``color = m D + S``, with diffuse light D and coat reflection S,
  ``t / (1 - t) = S / D`` makes the signal as smooth as D and S, so that no texture is multiplied into highlights;
- the weight of a pixel: low for a firefly, high for a pixel without noise;
- the scale at which a pixel's light is filtered: each scale keeps a part of it and passes on the rest, as in Balint et
  al. 2023, "Neural Partitioning Pyramids for Denoising Monte Carlo Renderings", Sec. 4;
- how noisy features (anti-aliased, out of focus, motion-blurred) are filtered before they are multiplied back or used
  as guides, and how far to trust the history of the albedo.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from mcdenoise.frame import Frame
from mcdenoise.models._interface import Model, Needs, Output, State
from mcdenoise.models._layers import answered, carried
from mcdenoise.models._registry import register_model
from mcdenoise.models.accumulated import ALBEDO_HISTORY, Accumulated
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.models.skipping import TOLERANCE, Skipping
from mcdenoise.models.tiled import Tiled
from mcdenoise.nn.inputs import FEATURES, features_of, guides_of, image_statistics, input_of
from mcdenoise.nn.unet import Head, UNet
from mcdenoise.ops import cross_bilateral_filter, downsample, kernel_conv, upsample
from mcdenoise.ops._backend import one_backend
from mcdenoise.ops._steps.network import softplus
from mcdenoise.ops.demodulation import modulation
from mcdenoise.ops.lag import THRESHOLD

SCALE_UNITS = (10.0, 1000.0, 1.0)  # units of the falloffs with normal, depth and distance
_USES = frozenset({"albedo", "normal", "depth", "current", "length", ALBEDO_HISTORY})
_COARSE_CHANNELS = 7  # logarithms of the means, with and without history, and the deviation of the pixels
_FEATURE_TAPS = 9  # taps of the feature filter
# "albedo" has weights of the filtered 3x3 neighbourhood, of the history, and of the albedo that the pyramid filters.
_PARTS = {"importance": 1, "history": 1, "albedo": 3, "matt": 1, "gain": 3, "features": _FEATURE_TAPS}
# Initial predictions: the history is trusted, light is diffuse, features are exact.
_AT_REST = {"history": 2.0, "matt": -1.0}
_QUARTERS = (4, 6, 8, 12, 16)  # width of each level in quarters of the finest one
_LEAST = 1e-3  # smallest fraction that a scale keeps or passes on, and smallest weight of a pixel
_MOST_GAIN = 1.0  # largest logarithm of the factor


class PyramidNetwork(nn.Module):
    """Predicts all weights of the pyramid, and filters the image with them.

    It takes demodulated radiance and converts it to the signal that it filters.

    Args:
        widths: feature channels of each level of the U-Net, finest first.
        kernel_size: side of the kernels at every scale.
        half: whether the U-Net begins at half the resolution.
    """

    def __init__(self, widths: Sequence[int], kernel_size: int = 5, half: bool = False) -> None:
        super().__init__()
        scales = len(widths) + half
        self.unet = UNet(9 + FEATURES, widths, scales, _COARSE_CHANNELS, half)
        self.taps = kernel_size**2
        # Channels per scale: kernel, its three falloffs, the kept fraction, and the fraction taken from the coarser
        # scale.
        self.channels = [self.taps + 5] * (scales - 1) + [self.taps + 3]
        extra = [sum(_PARTS.values())] + [0] * (scales - 1)
        self.heads = nn.ModuleList(
            Head(self.unet, scale, own + more)
            for scale, (own, more) in enumerate(zip(self.channels, extra, strict=True))
        )
        for head in self.heads:
            nn.init.normal_(head.weight, std=0.01)  # type: ignore[arg-type]
            nn.init.zeros_(head.bias)  # type: ignore[arg-type]
        at_rest = {name: torch.full((count,), _AT_REST.get(name, 0.0)) for name, count in _PARTS.items()}
        at_rest["features"][_FEATURE_TAPS // 2] = 4.0
        at_rest["albedo"][0] = 1.0  # of the pixels around
        rest = torch.cat(list(at_rest.values()))
        with torch.no_grad():
            # A head at half the resolution predicts each channel for 2x2 pixels.
            self.heads[0].bias[self.channels[0] * self.heads[0].side ** 2 :] = rest.repeat_interleave(  # type: ignore
                self.heads[0].side ** 2  # type: ignore
            )

    @property
    def needs(self) -> Needs:
        """The reach of the U-Net plus, at each scale, the radius of the filter."""
        radius = math.isqrt(self.taps) // 2
        behind = sum((radius + 1) << scale for scale in range(self.unet.scales))
        ways = (self.unet.reach(scale) + max(1 << scale, self.unet.stride) for scale in range(self.unet.scales))
        return Needs(uses=_USES, reach=max(ways) + behind, stride=self.unet.multiple)

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """Exposure and depth scale of the whole image."""
        return image_statistics(frame)

    def bytes_per_pixel(self, *, bfloat16: bool) -> float:
        """Peak memory per pixel of a tile, see :class:`mcdenoise.models.Tiled`."""
        return self.unet.bytes_per_pixel(bfloat16=bfloat16)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        frame = frame.replace(statistics=frame.statistics or self.statistics(frame))
        exposure = frame.statistics["exposure"]
        image = frame.color * exposure
        albedo = modulation(features_of(frame)[0]) if frame.albedo is not None else torch.ones_like(image)
        before = modulation(frame.extra[ALBEDO_HISTORY]) if ALBEDO_HISTORY in frame.extra else albedo
        seen = torch.cat([input_of(frame, image), torch.log1p(image * albedo), before], 1)
        levels = self.unet(seen, self._coarse(frame, exposure))
        sizes = _sizes(frame.size, len(levels))
        predicted = [
            head(level, size).to(torch.promote_types(image.dtype, torch.float32))
            for head, level, size in zip(self.heads, levels, sizes, strict=True)
        ]
        counts = list(_PARTS.values())
        parts = dict(zip(_PARTS, predicted[0][:, self.channels[0] :].split(counts, 1), strict=True))
        predicted[0] = predicted[0][:, : self.channels[0]]

        # The features of the pixel, which may be of one sample, and their mean over the neighbourhood.
        features = torch.cat([albedo, *guides_of(frame)], 1)
        smooth, guides = kernel_conv(features, torch.softmax(parts["features"], 1)).split([3, 4], 1)
        matt = 1 - torch.sigmoid(parts["matt"])
        alone = image if frame.current is None else frame.current * exposure
        color = torch.lerp(alone, image, torch.sigmoid(parts["history"]))
        layers, ratio = carried(frame), _ratio(albedo, albedo, matt)
        if layers is not None:
            layers = torch.cat(
                [layers[:, : 3 * (count := len(frame.layers))] * ratio.repeat(1, count, 1, 1), layers[:, 3 * count :]],
                1,
            )
        light = [color * ratio, albedo, *([] if layers is None else [layers])]
        # The last channel holds the filtered weights, by which the others are divided.
        worth = _inside(parts["importance"])
        weighted = torch.cat([*light, torch.ones_like(worth)], 1) * worth
        filtered = self._filtered(weighted, predicted, guides)
        mean = filtered[:, :-1] / filtered[:, -1:]
        near, history, wide = torch.softmax(parts["albedo"], 1).split(1, 1)
        smooth = near * smooth + history * before + wide * mean[:, 3:6]
        gain = torch.exp(_MOST_GAIN * torch.tanh(parts["gain"]))
        result = mean[:, :3] * gain / _ratio(albedo, smooth, matt)
        return answered(frame, result / exposure, None if layers is None else mean[:, 6:]), None

    def _coarse(self, frame: Frame, exposure: Tensor) -> list[Tensor]:
        """Logarithms of mean radiances at each coarser scale, and the deviation of single pixels of the frame.

        The mean of the frame and that of the history over a block have little noise, so their difference shows a moved
        highlight or a change of light.
        """
        color = frame.color * exposure
        alone = color if frame.current is None else frame.current * exposure
        single = alone.mean(1, keepdim=True)
        moments = torch.cat([color, alone, single, single.square()], 1)
        found: list[Tensor] = []
        for _ in range(self.unet.levels + self.unet.stride - 2):
            moments = downsample(moments)
            mean, square = moments[:, 6:7], moments[:, 7:]
            spread = (square - mean.square()).clamp_min(1e-12).sqrt() / (mean + 0.01)
            found.append(torch.log1p(torch.cat([moments[:, :6], spread], 1)))
        return found[self.unet.stride - 1 :]

    def _filtered(self, light: Tensor, predicted: list[Tensor], guides: Tensor) -> Tensor:
        """Down: each scale keeps a part. Up: this part is filtered together with the result of the coarser scales."""
        kept: list[Tensor] = []
        for prediction in predicted[:-1]:
            keep = _inside(prediction[:, -2:-1])
            kept.append(keep * light)
            light = downsample(light - kept[-1])
        guiding = [guides]
        for _ in kept:
            guiding.append(downsample(guiding[-1]))
        # All scales share the statistics of the whole image, so that a tile is filtered as in the whole image.
        with one_backend(light):
            for scale in reversed(range(len(predicted))):
                prediction, guide = predicted[scale], guiding[scale]
                if scale < len(kept):
                    size = (guide.shape[-2], guide.shape[-1])
                    light = kept[scale] + torch.sigmoid(prediction[:, -1:]) * upsample(light, size)
                falloffs = softplus(prediction[:, self.taps : self.taps + 3], SCALE_UNITS)
                light = cross_bilateral_filter(
                    light,
                    prediction[:, : self.taps],
                    [guide[:, :3], guide[:, 3:]],
                    [falloffs[:, :1], falloffs[:, 1:2]],
                    falloffs[:, 2:],
                    border="renormalize",
                )
        return light


def _ratio(albedo: Tensor, smooth: Tensor, matt: Tensor) -> Tensor:
    """Albedo over effective albedo: converts demodulated radiance to the filtered signal."""
    return albedo / torch.lerp(torch.ones_like(smooth), smooth, matt)


def _inside(logit: Tensor) -> Tensor:
    """Map a logit to [_LEAST, 1 - _LEAST], so that no light is lost completely and no mean is 0 / 0."""
    return _LEAST + (1 - 2 * _LEAST) * torch.sigmoid(logit)


def widths_of(width: int, levels: int = len(_QUARTERS)) -> list[int]:
    """Feature channels of each level, finest first; for a width of 32 they are 32, 48, 64, 96 and 128.

    Args:
        width: channels of the finest level, a multiple of 4.
        levels: number of levels.
    """
    return [width * quarters // 4 for quarters in _QUARTERS[:levels]]


def _sizes(size: tuple[int, int], scales: int) -> list[tuple[int, int]]:
    return [(-(-size[0] // side), -(-size[1] // side)) for side in (1 << scale for scale in range(scales))]


def _pyramid(
    width: int = 32,
    kernel_size: int = 5,
    half: bool = False,
    *,
    alpha_min: float = 0.1,
    anti_lag: bool = True,
    tolerance: float = TOLERANCE,
) -> Model:
    """The pyramid with all its wrappers.

    Args:
        width: feature channels of the finest level, a multiple of 4.
        kernel_size: side of the kernels.
        half: whether the U-Net begins at half the resolution; it then has one level fewer.
        alpha_min: see :class:`mcdenoise.models.Accumulated`.
        anti_lag: see :class:`mcdenoise.models.Accumulated`.
        tolerance: see :class:`mcdenoise.models.Skipping`.
    """
    widths = widths_of(width, len(_QUARTERS) - half)
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
_PRESETS: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("pyramid", "width 32, 5x5 kernels", {}),
    ("pyramid_small", "width 16, 5x5 kernels", {"width": 16}),
    ("pyramid_tiny", "width 24, 3x3 kernels, half the resolution", {"width": 24, "kernel_size": 3, "half": True}),
)
for _name, _about, _settings in _PRESETS:
    register_model(_name, f"{_ABOUT}: {_about}", kind="kernel", paper="after Balint et al. 2023", **_settings)(_pyramid)
