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

import math
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
EXACT = "exact"  # everywhere 1 where all features are exact, else 0
_WINDOWS = (3, 15)  # sides of the squares over which the image before is compared with this one
_IN = 3 * 6 + 3 + len(_WINDOWS)
# Before anything was learnt: both of OIDN's images alike, more of that for clean features where they are, hardly any of
# the samples, and ten parts of the result before where nothing speaks against it.
_AT_REST = {"color": 0.0, CLEAN: 0.0, NOISY: -5.0, PREVIOUS: math.log(10)}
_FOR_EXACT = math.log(3)
# Of the logarithm of the weight of the image before, for each difference of as much as single samples differ.
_DOUBT = (4.0, 12.0)
_LEAST_NOISE = 0.02  # that single samples differ by, in parts of their mean
# Squared length of a normal that is no mean of others, and the fraction of pixels that may have shorter ones.
_UNIT, _MOST_MEANS = 0.98, 0.002
# Relative difference of inverse depths at two pixels' distance that is no rounding of half floats.
_LEAST_SLOPE, _EVEN = 4e-3, 0.1
# Largest difference of two normals that is unlike, and the fraction of pixels: measured, of scenes without such
# materials up to 0.0039, of rough glass and metal in Cycles 0.0069.
_UNLIKE, _MOST_SPECKS = 0.1, 0.0045
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
        given = frozenset({NOISY, CLEAN, EXACT})
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
        exact = torch.full_like(frame.color[:, :1], float(has_exact_features(frame)))
        extra = {**frame.extra, NOISY: frame.color, CLEAN: clean, EXACT: exact}
        return frame.replace(color=output.image, layers=output.layers, extra=extra, skip=None)


def has_exact_features(frame: Frame) -> bool:
    """Whether features are those of one ray through the center of each pixel, and so have no noise.

    The normals of hardly any pixel are shorter than one, as means of several are. And depth goes on evenly from pixel
    to pixel: along a plane its inverse is linear in the image, along what is curved nearly so, but not where rays go
    through a point of each pixel, or of a lens, that was drawn. Where one of four triples of neighbours in a row or a
    column or more have ``|a - 2 b + c| < |a - c| / 10``, rays went through the centers. Nor are there many normals
    unlike all four around them where these are alike: rough metal and glass scatter the rays, and some renderers hand
    over the features of what such a ray hits.

    Args:
        frame: any; without a normal or a depth nothing tells that, and the answer is no.
    """
    if frame.normal is None or frame.depth is None:
        return False
    squares = frame.normal.square().sum(1)
    # Nothing was hit: no normal.
    if float(((squares < _UNIT) & (squares > 0)).float().mean()) > _MOST_MEANS:
        return False
    even = told = 0
    for inverse in ((near := frame.depth.detach().reciprocal()), near.mT):
        a, b, c = inverse[..., :-2], inverse[..., 1:-1], inverse[..., 2:]
        slope = (a - c).abs()
        known = (slope > _LEAST_SLOPE * b) & (torch.minimum(a, c) > 0)
        told += int(known.sum())
        even += int((known & ((a - 2 * b + c).abs() < _EVEN * slope)).sum())
    return even > told / 4 and _specks(frame.normal) < _MOST_SPECKS


def _specks(normal: Tensor) -> float:
    """Fraction of the pixels that are unlike all of their four neighbours, of which those opposite are alike."""
    inside = normal.detach()[..., 1:-1, 1:-1]
    left, right = normal.detach()[..., 1:-1, :-2], normal.detach()[..., 1:-1, 2:]
    above, below = normal.detach()[..., :-2, 1:-1], normal.detach()[..., 2:, 1:-1]
    nearest = torch.stack([(inside - other).abs().amax(1) for other in (left, right, above, below)]).amin(0)
    around = torch.maximum((left - right).abs().amax(1), (above - below).abs().amax(1))
    count = int(((nearest > _UNLIKE) & (around < nearest / 2)).sum())
    return count / max(nearest.numel(), 1)


class TemporalNetwork(nn.Module):
    """Weighs the images of this frame, that of the frame before, and the samples.

    ``image = sum_k w_k image_k`` over OIDN's two images and the samples, with predicted weights of a softmax; and
    ``result = (image + n previous) / (1 + n)`` with ``n = same exp(p - sum_s c_s d_s)``: how much of the frame before
    shows the same surface, and whether its light is still the same. Where it is not, it shows as a difference d of the
    means over 3x3 and 15x15 pixels, in parts of the mean deviation of single samples, which says what is noise. The
    predicted logarithms are bounded, ``8 tanh(x / 8)``. The network sees all of this, images on OIDN's scale of
    radiance, and albedo and normal.

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
        uses = frozenset({"albedo", "normal", NOISY, CLEAN, EXACT, PREVIOUS, PREVIOUS_LIGHT, PREVIOUS_WEIGHT})
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
        clean, noisy = frame.extra.get(CLEAN, now), frame.extra.get(NOISY, now)
        exact = frame.extra.get(EXACT, torch.zeros_like(now[:, :1]))
        # What is textured stays sharp with an exact albedo, and gets the noise of another.
        before = torch.where(exact > 0, frame.extra.get(PREVIOUS_LIGHT, now), frame.extra.get(PREVIOUS, now))
        same = frame.extra.get(PREVIOUS_WEIGHT, torch.zeros_like(exact))
        albedo = torch.ones_like(now) if frame.albedo is None else frame.albedo
        normal = torch.zeros_like(now) if frame.normal is None else frame.normal

        mean = (now + clean) * exposure / 2
        noise = _relative(noisy * exposure, mean, torch.ones_like(same), max(_WINDOWS), inside=True) + _LEAST_NOISE
        changes = [_relative(before * exposure, mean, same, window) / noise for window in _WINDOWS]
        compressed = [compress(image * exposure) for image in (now, clean, noisy, before)]
        details = [*(change / (1 + change) for change in changes), noise / (1 + noise), exact, same]
        seen = torch.cat([*compressed, *details, albedo.clamp(0, 1), normal], 1)
        predicted = self.head(self.unet(seen)[0], frame.size).to(exposure.dtype)
        bounded = _MOST * torch.tanh(predicted / _MOST)
        parts, stays, doubts = bounded.split([3, 1, len(_WINDOWS)], 1)

        parts = torch.softmax(torch.cat([parts[:, :1], parts[:, 1:2] + _FOR_EXACT * exact, parts[:, 2:]], 1), 1)
        image = parts[:, :1] * now + parts[:, 1:2] * clean + parts[:, 2:] * noisy
        for least, doubt, change in zip(_DOUBT, doubts.split(1, 1), changes, strict=True):
            stays = stays - least * torch.exp(doubt) * change
        weight = same * torch.exp(stays)
        return answered(frame, torch.lerp(image, before, weight / (1 + weight)), None), None


def _relative(image: Tensor, other: Tensor, counted: Tensor, window: int, *, inside: bool = False) -> Tensor:
    """How far two images are apart over a window: their means, or (``inside``) their pixels; in parts of the mean."""
    both = torch.cat([(image - other).abs(), other] if inside else [image, other], 1) * counted
    means = torch.cat([both, counted], 1)
    for kernel in ((1, window), (window, 1)):
        means = F.avg_pool2d(means, kernel, 1, (kernel[0] // 2, kernel[1] // 2))
    a, b, count = means.split([3, 3, 1], 1)
    apart = (a if inside else (a - b).abs()).mean(1, keepdim=True)
    typical = (b if inside else (a + b) / 2).mean(1, keepdim=True)
    relative: Tensor = apart / (typical + 0.01 * count + 1e-6)
    return relative


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
