"""The method ``oidn_temporal``: Open Image Denoise made steady, and its two ways with features in one.

The library denoises every frame by itself, in the state of the art for a still, and flickers in a film. And it has to
be told whether albedo and normal have noise, which is hardly ever true of a whole image: they are exact on a wall, and
noisy behind glass, in a blurred mirror and out of focus. Here it comes first, once for noisy and once for clean
features, and their mean is about as good as the better of them, which one had to know (Zheng et al. 2021, "Ensemble
Denoising for Monte Carlo Renderings", learn the weights). Then the result of the frame before, reprojected, is blended
in, as temporal anti-aliasing does (Karis 2014, "High-Quality Temporal Supersampling"), where its light is still the
same: where highlights, reflections or shadows have moved on, it differs from this frame by more than noise explains.

Nothing is learnt: what a network learnt of some hundred clips to do here was to trust the frame before too much.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.models._interface import Model, Needs, Output, State
from mcdenoise.models._layers import answered, completed
from mcdenoise.models._registry import register_model
from mcdenoise.models._wrapper import Wrapper
from mcdenoise.models.oidn import Oidn, Quality
from mcdenoise.models.recurrent import PREVIOUS, PREVIOUS_LIGHT, PREVIOUS_WEIGHT, Recurrent
from mcdenoise.models.tiled import Tiled
from mcdenoise.nn.oidn import oidn_exposure

# The frame's own radiance as it was before OIDN; and OIDN's image where features are taken for clean.
NOISY, CLEAN = "noisy", "clean"
EXACT = "exact"  # everywhere 1 where all features are exact, else 0
# Parts of the image for clean features for each of that for noisy ones, where they are not exact, and where they are.
_CLEAN_PARTS = (1.0, 3.0)
# Sides of the squares over which the result before is compared with this frame, and how much a difference of as much as
# single samples deviate takes from the logarithm of its weight.
_WINDOWS, _DOUBTS = (3, 15), (4.0, 12.0)
_LEAST_NOISE = 0.02  # that single samples deviate by, in parts of their mean
_LEAST_MEAN = 0.01  # of what differences are parts, where the typical radiance of the image is 0.18
# Squared length of a normal that is no mean of others, and the fraction of pixels that may have shorter ones.
_UNIT, _MOST_MEANS = 0.98, 0.002
# Relative difference of inverse depths at two pixels' distance that is no rounding of half floats.
_LEAST_SLOPE, _EVEN = 4e-3, 0.1
# Largest difference of two normals that is unlike, and the fraction of pixels: measured, of scenes without such
# materials up to 0.0039, of rough glass and metal in Cycles 0.0069.
_UNLIKE, _MOST_SPECKS = 0.1, 0.0045


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


class Steadied(nn.Module):
    """Blends images of this frame, and the result of the frame before where its light is still the same.

    ``image = (color + a clean) / (1 + a)`` with a = 1, or 3 where features are exact, and
    ``result = (image + n previous) / (1 + n)`` with ``n = history same exp(-sum_s c_s d_s / noise)``: ``same`` is how
    much of the frame before shows the same surface; d are the differences of the means over 3x3 and 15x15 pixels, and
    noise the mean deviation of single samples over 15x15, all in parts of the mean. The frame before is taken without
    its albedo and with this frame's where that is exact.

    Args:
        history: parts of the result before for each of this frame, where nothing speaks against it; above 0.

    Raises:
        InputError: ``history`` is not above 0.
    """

    def __init__(self, history: float = 10.0) -> None:
        super().__init__()
        if not 0 < history < math.inf:
            raise InputError(f"history: expected above 0, found {history}")
        self.history = history

    @property
    def needs(self) -> Needs:
        """Color; of use is what it blends."""
        uses = frozenset({NOISY, CLEAN, EXACT, PREVIOUS, PREVIOUS_LIGHT, PREVIOUS_WEIGHT})
        return Needs(uses=uses, trainable=False, reach=max(_WINDOWS) // 2)

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """The exposure of the whole image."""
        return {"oidn_exposure": oidn_exposure(frame.color)}

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        exposure = (frame.statistics or self.statistics(frame))["oidn_exposure"]
        now = frame.color
        clean, noisy = frame.extra.get(CLEAN, now), frame.extra.get(NOISY, now)
        exact = frame.extra.get(EXACT, torch.zeros_like(now[:, :1]))
        same = frame.extra.get(PREVIOUS_WEIGHT, torch.zeros_like(exact))
        # What is textured stays sharp with an exact albedo, and gets the noise of another.
        before = torch.where(exact > 0, frame.extra.get(PREVIOUS_LIGHT, now), frame.extra.get(PREVIOUS, now))
        part = torch.where(exact > 0, _CLEAN_PARTS[1], _CLEAN_PARTS[0])
        image = (now + part * clean) / (1 + part)

        # In units of the image: to multiply it with its exposure would round it once more.
        least = _LEAST_MEAN / exposure
        noise = _relative(noisy, image, torch.ones_like(same), max(_WINDOWS), least, inside=True) + _LEAST_NOISE
        n = self.history * same
        for window, doubt in zip(_WINDOWS, _DOUBTS, strict=True):
            n = n * torch.exp(-doubt * _relative(before, image, same, window, least) / noise)
        return answered(frame, torch.lerp(image, before, n / (1 + n)), None), None


def _relative(
    image: Tensor, other: Tensor, counted: Tensor, window: int, least: Tensor, *, inside: bool = False
) -> Tensor:
    """How far two images are apart over a window: their means, or (``inside``) their pixels; in parts of the mean."""
    both = torch.cat([(image - other).abs(), other] if inside else [image, other], 1) * counted
    means = torch.cat([both, counted], 1)
    for kernel in ((1, window), (window, 1)):
        means = F.avg_pool2d(means, kernel, 1, (kernel[0] // 2, kernel[1] // 2))
    a, b, count = means.split([3, 3, 1], 1)
    apart = (a if inside else (a - b).abs()).mean(1, keepdim=True)
    typical = (b if inside else (a + b) / 2).mean(1, keepdim=True)
    relative: Tensor = apart / (typical + least * (count + 1e-4))
    return relative


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


@register_model("oidn_temporal")
def oidn_temporal(*, quality: Quality = "high", threads: int | None = None, history: float = 10.0) -> Model:
    """Open Image Denoise (optional package pyoidn) for noisy and for clean features, made steady by the frame before.

    Args:
        quality: see :class:`AfterOidn`.
        threads: likewise.
        history: see :class:`Steadied`.

    Raises:
        InputError: as of :class:`AfterOidn` and :class:`Steadied`.
    """
    return AfterOidn(Recurrent(Tiled(Steadied(history))), quality=quality, threads=threads)
