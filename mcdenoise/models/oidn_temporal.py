"""The method ``oidn_temporal``: Open Image Denoise made steady, and repaired where it lacks what the samples say.

OIDN denoises every frame by itself, in the state of the art for a still, and flickers in a film. Here it comes first.
Behind it are two histories, of its images and of the noisy ones, and a small network that decides for every pixel

- how far the history of OIDN's images is to be trusted against its image of this frame;
- how much of what the samples say otherwise is put back: the difference of the noisy radiance and OIDN's, filtered
  with predicted kernels at several scales. Where there is hardly any noise (many samples, lamps, mirrors) that is the
  pixel itself, elsewhere the mean over a neighbourhood, in which noise cancels out and a bias of OIDN's does not. It
  combines as Back et al. 2020, "Deep Combiner for Independent and Correlated Pixel Estimates", do, with light split
  into scales as in Balint et al. 2023, "Neural Partitioning Pyramids for Denoising Monte Carlo Renderings", Sec. 4;
- a bounded factor.

Untrained it gives OIDN's images, accumulated half and half with their history.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from mcdenoise.frame import Frame
from mcdenoise.models._interface import Model, Needs, Output, State
from mcdenoise.models._journal import timed
from mcdenoise.models._layers import answered, carried, completed
from mcdenoise.models._pyramid import Pyramid, filtered, inside
from mcdenoise.models._registry import register_model
from mcdenoise.models._wrapper import Wrapper
from mcdenoise.models.accumulated import Accumulated
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.models.oidn import Auxiliary, Oidn, Quality
from mcdenoise.models.tiled import Tiled
from mcdenoise.nn.inputs import FEATURES, input_of
from mcdenoise.nn.unet import UNet
from mcdenoise.ops import demodulate, downsample, kernel_conv
from mcdenoise.ops._rows import by_rows

# The frame's own radiance without albedo, as it was before OIDN, and the same without a history.
NOISY, NOISY_CURRENT = "noisy", "noisy_current"
_TAPS = 9
_COARSE_CHANNELS = 4  # how the noisy means differ from OIDN's, and how much single pixels do
# What is predicted of a pixel, and what it is before anything was learnt: half and half; hardly anything is put back.
_PARTS = {"importance": (2.0,), "history": (0.0,), "noisy history": (2.0,), "repair": (-4.0,), "gain": (0.0,)}
# Squared length of a normal that is no mean of others, and the fraction of pixels that may have shorter ones.
_UNIT, _MOST_MEANS = 0.98, 0.002
# Relative difference of inverse depths at two pixels' distance that is no rounding of half floats.
_LEAST_SLOPE, _EVEN = 4e-3, 0.1
# Largest difference of two normals that is unlike, and the fraction of pixels: measured, of scenes without such
# materials up to 0.0039, of rough glass and metal in Cycles 0.0069.
_UNLIKE, _MOST_SPECKS = 0.1, 0.0045
_THIRDS = (3, 4, 6, 8)  # of the width, at each level
_MOST_GAIN = 0.25  # of the logarithm of the factor


class AfterOidn(Wrapper):
    """A method on Open Image Denoise's image of each frame, which it sees as ``color``.

    The noisy radiance without albedo is there as ``noisy`` and ``noisy_current`` in ``frame.extra``: an
    :class:`mcdenoise.models.Accumulated` may accumulate one of them. OIDN always sees the whole image. Its image is the
    stage ``oidn``. It has no kernels, so that layers are those of the noisy frame in its proportions, see
    :func:`mcdenoise.models._layers.completed`, and alpha stays noisy.

    Args:
        inner: any method.
        quality: see :class:`mcdenoise.models.oidn.Oidn`.
        auxiliary: likewise; by default the features of a frame are taken as clean where :func:`has_exact_features`
            says so, and as noisy elsewhere.
        threads: likewise.

    Raises:
        InputError: as of :class:`mcdenoise.models.oidn.Oidn`.
    """

    def __init__(
        self,
        inner: Model,
        *,
        quality: Quality = "high",
        auxiliary: Auxiliary | None = None,
        threads: int | None = None,
    ) -> None:
        super().__init__(inner)
        self.quality, self.auxiliary, self.threads = quality, auxiliary, threads
        self._oidn = Oidn(quality, auxiliary or "noisy", threads=threads)

    @property
    def needs(self) -> Needs:
        """As those inside but for what is handed to it; albedo and normal are of use."""
        needs = self.inner.needs
        given = frozenset({NOISY, NOISY_CURRENT})
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
        return output._replace(stages={"oidn": handed.color, **output.stages}), state

    def before(self, frame: Frame) -> Frame:
        """The frame as the method inside sees it."""
        if self.auxiliary is None:
            self._oidn.auxiliary = "clean" if has_exact_features(frame) else "noisy"
        output = completed(frame, self._oidn(frame)[0])
        with timed("accumulate", frame.color.device):
            light = frame.color if frame.albedo is None else by_rows(demodulate, frame.color, frame.albedo)
        extra = {**frame.extra, NOISY: light, NOISY_CURRENT: light}
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


class RepairNetwork(Pyramid):
    """Weighs OIDN's image, its history and the noisy radiance, and filters what they differ by.

    Args:
        widths: feature channels of each level of the U-Net, which begins at half the resolution.
    """

    uses = frozenset({"albedo", "normal", "depth", "current", "length", NOISY, NOISY_CURRENT})

    def __init__(self, widths: Sequence[int]) -> None:
        unet = UNet(6 + 3 + FEATURES, widths, len(widths) + 1, _COARSE_CHANNELS, half=True)
        super().__init__(unet, _TAPS, _PARTS)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        frame = frame.replace(statistics=frame.statistics or self.statistics(frame))
        exposure = frame.statistics["exposure"]
        current = frame.color if frame.current is None else frame.current
        noisy = frame.extra.get(NOISY, current)
        given = (frame.color, current, noisy, frame.extra.get(NOISY_CURRENT, noisy))
        before, now, noisy_before, noisy_now = (image * exposure for image in given)
        seen = torch.cat([input_of(frame, before), torch.log1p(noisy_before), torch.log1p(noisy_now)], 1)
        predicted, parts = self.predict(seen, self._coarse(noisy_before, noisy_now, now), before.dtype)

        base = torch.lerp(now, before, torch.sigmoid(parts["history"]))
        lacking = torch.lerp(noisy_now, noisy_before, torch.sigmoid(parts["noisy history"])) - base
        worth, others = inside(parts["importance"]), carried(frame)
        # Of the weights alone, in the last channel, the mean is what the others are divided by.
        weighted = [image * worth for image in (lacking, *([] if others is None else [others]))] + [worth]
        found = filtered(torch.cat(weighted, 1), predicted, _smoothed)
        mean = found[:, :-1] / found[:, -1:]
        gain = torch.exp(_MOST_GAIN * torch.tanh(parts["gain"]))
        image = (base + torch.sigmoid(parts["repair"]) * mean[:, :3]).clamp_min(0) * gain / exposure
        return answered(frame, image, None if others is None else mean[:, 3:]), None

    def _coarse(self, noisy_before: Tensor, noisy_now: Tensor, now: Tensor) -> list[Tensor]:
        """At each coarser scale how far the noisy mean is from OIDN's, relatively, and how much single pixels are."""
        alone = (noisy_now - now).mean(1, keepdim=True)
        moments = torch.cat([noisy_before - now, now.mean(1, keepdim=True), alone, alone.square()], 1)
        found: list[Tensor] = []
        for _ in range(self.unet.levels):
            moments = downsample(moments)
            mean = moments[:, 3:4] + 0.01
            spread = (moments[:, 5:6] - moments[:, 4:5].square()).clamp_min(1e-12).sqrt() / mean
            found.append(torch.cat([torch.asinh(moments[:, :3] / mean), torch.log1p(spread)], 1))
        return found[1:]


def _smoothed(light: Tensor, prediction: Tensor, scale: int) -> Tensor:
    # What is outside the image weighs nothing: the weights themselves are filtered, too.
    return kernel_conv(light, torch.softmax(prediction[:, :_TAPS], 1), border="zeros")


@register_model("oidn_temporal")
def oidn_temporal(
    width: int = 24,
    *,
    quality: Quality = "high",
    auxiliary: Auxiliary | None = None,
    threads: int | None = None,
    alpha_min: float = 0.1,
) -> Model:
    """Open Image Denoise (optional package pyoidn), a history behind it, and a network that repairs both.

    Args:
        width: feature channels of the finest level of the network, a multiple of 3.
        quality: see :class:`AfterOidn`.
        auxiliary: likewise.
        threads: likewise.
        alpha_min: see :class:`mcdenoise.models.Accumulated`.

    Raises:
        InputError: as of :class:`AfterOidn`.
    """
    # What OIDN has made has no fireflies and no noise to tell a change of light from: the network sees both images.
    history = Accumulated(
        Tiled(RepairNetwork([width * thirds // 3 for thirds in _THIRDS])),
        alpha_min=alpha_min,
        firefly_limit=math.inf,
        lag_threshold=math.inf,
        also=(NOISY,),
    )
    return AfterOidn(Demodulated(history), quality=quality, auxiliary=auxiliary, threads=threads)
