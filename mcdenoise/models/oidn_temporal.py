"""The method ``oidn_temporal``: Open Image Denoise made steady, and the best of its two ways with features.

The library denoises every frame by itself, in the state of the art for a still, and flickers in a film. And it has to
be told whether albedo and normal have noise, which is never true of a whole image: they are exact on a wall, and noisy
behind glass, in a blurred mirror and out of focus. Here it comes first, once for noisy and once for clean features, and
a small network decides for every pixel how much of four images is shown: these two; the result of the frame before,
reprojected, which has the noise of many frames; and the samples themselves, where they have hardly any noise (many of
them, lamps, mirrors) and OIDN only takes away.

Weighing the images of several denoisers pixel by pixel is what Zheng et al. 2021, "Ensemble Denoising for Monte Carlo
Renderings", do; blending with the reprojected result what Chaitanya et al. 2017 and Balint et al. 2023, "Neural
Partitioning Pyramids for Denoising Monte Carlo Renderings", Sec. 5, learn.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mcdenoise.frame import Frame
from mcdenoise.models._interface import Model, Needs, Output, State
from mcdenoise.models._layers import answered, completed
from mcdenoise.models._registry import register_model
from mcdenoise.models._wrapper import Wrapper
from mcdenoise.models.oidn import Oidn, Quality
from mcdenoise.models.recurrent import PREVIOUS, PREVIOUS_LIGHT, PREVIOUS_WEIGHT, Recurrent
from mcdenoise.models.tiled import Tiled
from mcdenoise.nn.oidn import compress, oidn_exposure
from mcdenoise.nn.unet import Head, UNet

# The frame's own radiance as it was before OIDN; and OIDN's image where features are taken for clean.
NOISY, CLEAN = "noisy", "clean"
_WINDOWS = (3, 15)  # sides of the squares over which the image before is compared with this one
_IN = 3 * 7 + 1 + len(_WINDOWS)
# Before anything was learnt: both of OIDN's images and the one before are shown alike, and hardly any of the samples.
_AT_REST = {"color": 0.0, CLEAN: 0.0, PREVIOUS: -1.0, PREVIOUS_LIGHT: -1.0, NOISY: -5.0}
_BEFORE = (PREVIOUS, PREVIOUS_LIGHT)
# Of the logarithm of the weight of the image before, for each difference of as much as the images' mean.
_DOUBT = (10.0, 20.0)
_MOST = 8.0  # of the logarithm of a weight
_THIRDS = (3, 4, 6, 8)  # of the width, at each level


class AfterOidn(Wrapper):
    """A method on Open Image Denoise's images of each frame.

    It sees that of noisy features as ``color``, and in ``frame.extra`` that of clean ones as ``clean`` and the noisy
    radiance as ``noisy``. OIDN always sees the whole image. Its images are the stages ``oidn`` and ``oidn_clean``. It
    has no kernels, so that layers are those of the noisy frame in its proportions, see
    :func:`mcdenoise.models._layers.completed`, and alpha stays noisy.

    Args:
        inner: any method.
        quality: see :class:`mcdenoise.models.oidn.Oidn`.
        threads: likewise.

    Raises:
        InputError: as of :class:`mcdenoise.models.oidn.Oidn`.
    """

    def __init__(self, inner: Model, *, quality: Quality = "high", threads: int | None = None) -> None:
        super().__init__(inner)
        self.quality, self.threads = quality, threads
        self._oidn, self._clean = (Oidn(quality, auxiliary, threads=threads) for auxiliary in ("noisy", "clean"))

    @property
    def needs(self) -> Needs:
        """As those inside but for what is handed to it; albedo and normal are of use."""
        needs = self.inner.needs
        given = frozenset({NOISY, CLEAN})
        uses = (needs.uses - given) | self._oidn.needs.uses
        return Needs(needs.buffers - given, uses, needs.trainable, None)

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """None: those of the method inside are of OIDN's image."""
        return {}

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`.

        Raises:
            InputError: a derivative in the color is asked for.
        """
        handed = self.before(frame)
        output, state = self.inner(handed, state)
        stages = {"oidn": handed.color, "oidn_clean": handed.extra[CLEAN], **output.stages}
        return output._replace(stages=stages), state

    def before(self, frame: Frame) -> Frame:
        """The frame as the method inside sees it."""
        output = completed(frame, self._oidn(frame)[0])
        # Without features there is one way only.
        clean = output.image if frame.albedo is None else self._clean(frame)[0].image
        extra = {**frame.extra, NOISY: frame.color, CLEAN: clean}
        return frame.replace(color=output.image, layers=output.layers, extra=extra, skip=None)


class TemporalNetwork(nn.Module):
    """Weighs the images of this frame, that of the frame before, and the samples.

    ``image = sum_k w_k image_k / sum_k w_k`` with ``w_k = exp(8 tanh(p_k / 8))``. That of the frame before is
    multiplied with how much of it shows the same surface, and with ``exp(-sum_s c_s d_s)``: light that has moved on,
    which surfaces say nothing of, shows as a difference d of the images' means over 3x3 and 15x15 pixels; how much it
    counts is predicted, too. The network sees all of this, images on OIDN's scale of radiance, and albedo and normal.

    Args:
        widths: feature channels of each level of the U-Net, which begins at half the resolution.
    """

    def __init__(self, widths: Sequence[int]) -> None:
        super().__init__()
        self.unet = UNet(_IN, widths, 1, half=True)
        self.head = Head(self.unet, 0, len(_AT_REST) + len(_WINDOWS))
        nn.init.zeros_(self.head.weight)
        with torch.no_grad():
            # Each channel is predicted for two by two pixels.
            at_rest = torch.tensor([*_AT_REST.values(), *(0.0 for _ in _WINDOWS)])
            self.head.bias.copy_(at_rest.repeat_interleave(self.head.side**2))  # type: ignore[union-attr]

    @property
    def needs(self) -> Needs:
        """What the U-Net sees; albedo and normal are of use, the samples, and the image of the frame before."""
        uses = frozenset({"albedo", "normal", NOISY, CLEAN, PREVIOUS, PREVIOUS_LIGHT, PREVIOUS_WEIGHT})
        return Needs(
            uses=uses, reach=self.unet.reach(0) + self.unet.stride + max(_WINDOWS) // 2, stride=self.unet.multiple
        )

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """The exposure of the whole image."""
        return {"oidn_exposure": oidn_exposure(frame.color)}

    def bytes_per_pixel(self, *, bfloat16: bool) -> float:
        """Memory that a tile takes, see :class:`mcdenoise.models.Tiled`."""
        return self.unet.bytes_per_pixel(bfloat16=bfloat16)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        exposure = (frame.statistics or self.statistics(frame))["oidn_exposure"]
        now = frame.color
        images = {name: frame.extra.get(name, torch.zeros_like(now) if name in _BEFORE else now) for name in _AT_REST}
        same = frame.extra.get(PREVIOUS_WEIGHT, torch.zeros_like(now[:, :1]))
        albedo = torch.ones_like(now) if frame.albedo is None else frame.albedo
        normal = torch.zeros_like(now) if frame.normal is None else frame.normal
        means = (now + images[CLEAN]) * exposure / 2, images[PREVIOUS_LIGHT] * exposure
        differences = [_difference(*means, same, window) for window in _WINDOWS]
        seen = [
            *(compress(image * exposure) for image in images.values()),
            *differences,
            same,
            albedo.clamp(0, 1),
            normal,
        ]
        predicted = self.head(self.unet(torch.cat(seen, 1))[0], frame.size).to(exposure.dtype)
        found = torch.exp(_MOST * torch.tanh(predicted / _MOST)).split(1, 1)
        weights, doubts = dict(zip(images, found, strict=False)), found[len(images) :]
        holds = same
        for least, doubt, difference in zip(_DOUBT, doubts, differences, strict=True):
            holds = holds * torch.exp(-least * doubt * difference)
        weights |= {name: weights[name] * holds for name in _BEFORE}
        total = sum(weights[name] * image for name, image in images.items())
        return answered(frame, total / sum(weights.values()), None), None


def _difference(now: Tensor, before: Tensor, same: Tensor, window: int) -> Tensor:
    """How far the means of two images over a window are apart, in parts of their mean, where both show the same."""
    means = torch.cat([now * same, before * same, same], 1)
    for kernel in ((1, window), (window, 1)):
        means = F.avg_pool2d(means, kernel, 1, (kernel[0] // 2, kernel[1] // 2))
    a, b, count = means.split([3, 3, 1], 1)
    difference: Tensor = (a - b).abs().mean(1, keepdim=True) / ((a + b).mean(1, keepdim=True) / 2 + 0.01 * count + 1e-6)
    return difference


@register_model("oidn_temporal")
def oidn_temporal(width: int = 24, *, quality: Quality = "high", threads: int | None = None) -> Model:
    """Open Image Denoise (optional package pyoidn) made steady, and the best of its two ways with features.

    Args:
        width: feature channels of the finest level of the network, a multiple of 3.
        quality: see :class:`AfterOidn`.
        threads: likewise.

    Raises:
        InputError: as of :class:`AfterOidn`.
    """
    network = TemporalNetwork([width * thirds // 3 for thirds in _THIRDS])
    return AfterOidn(Recurrent(Tiled(network)), quality=quality, threads=threads)
