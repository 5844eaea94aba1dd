"""A-SVGF: SVGF that discards the history in proportion to how much the light has changed.

Schied et al. 2018, "Gradient Estimation for Real-Time Adaptive Temporal Filtering", Proceedings of the ACM on Computer
Graphics and Interactive Techniques 1(2). It differs from :class:`mcdenoise.models.svgf.Svgf` in the weight of the
current frame,

``alpha' = (1 - lambda) alpha + lambda`` with ``lambda = min(1, |Delta| / max(l))`` of
:func:`mcdenoise.ops.temporal_gradient`.

The paper's renderer projects one sample of every 3x3 stratum of the frame before forward, and shades it once more with
the random numbers that it had then. So its change ``Delta`` is free of sampling noise. Renderers write no such samples
to files; one that streams may pass them in ``frame.extra["gradient"]``, ``(B, 3, H, W)`` in the unit of the color:

- the luminance of the sample now,
- the luminance of the same sample in the frame before,
- 1 where there is a sample, and 0 elsewhere.

Both luminances are either with or without the albedo: ``lambda`` is a quotient.

Without them, the frame's luminance is compared with that of the reprojected history. This difference is noisy, so
lambda only counts its excess over two standard errors. Where nothing changes, the variance of the difference is
``variance(l) (1 + 1 / n)``. Here ``n`` is the number of frames to which the history is equivalent: its length, up to
``2 / alpha - 1`` for an exponential window. ``variance(l)``, that of a sample, is the maximum of SVGF's estimate from
the history and of the variance of the frame over 7x7 pixels, since a firefly that is not in the history is no change of
the light. Compared with the paper's samples, a change that is smaller than the noise of a neighbourhood is found later,
and so is one at sharp edges of light.

The paper leaves open the length of a history that is partly discarded. Here a history in which the current frame has
the weight ``alpha'`` counts as ``1 / alpha'`` frames, so that light that went on or off begins with a new average. The
transform of the strata (five levels of 3x3 taps, as many as in the published code) has the edge-stopping functions of
SVGF except that of the luminance, which may have changed. The published code then takes the maximum of the 5x5 strata
around a pixel; here this is omitted, because the maximum of noise is the largest noise. ``alpha`` is that of the
published code, 0.1, for light and for moments.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from mcdenoise.frame import Frame
from mcdenoise.models._history import Past, surface_before
from mcdenoise.models._published import behind
from mcdenoise.models._registry import register_model
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.models.svgf import BRIGHTEST, WINDOW, Svgf, variance_of
from mcdenoise.ops import luminance_moments, moments_variance, reproject, temporal_gradient

# Name in `frame.extra` of the samples of the frame before, shaded once more.
GRADIENT = "gradient"


class Asvgf(Svgf):
    """SVGF with temporal gradients of Schied et al. 2018: by re-shaded samples where a frame has them, else by a test.

    Args:
        alpha: smallest weight of the current frame where nothing changes, in (0, 1].

    Raises:
        InputError: the weight is out of its range.
    """

    def __init__(self, *, alpha: float = 0.1) -> None:
        super().__init__(alpha=alpha)
        self.needs = replace(self.needs, uses=self.needs.uses | {GRADIENT})

    def changed(self, frame: Frame, past: Past, motion: Tensor | None) -> Tensor:
        """Lambda: the fraction of the history to discard.

        Args:
            frame: the current frame.
            past: of the frame before.
            motion: to the frame before, see :func:`mcdenoise.ops.reproject`.

        Returns:
            ``(B, 1, H, W)`` in [0, 1].
        """
        surface = (frame.normal, frame.depth)
        shaded = frame.extra.get(GRADIENT)
        if shaded is not None:
            now, before, there = shaded.split(1, 1)
            return temporal_gradient(now, before, there, None, *surface)
        found, weight = reproject(past.image[:, -3:], motion, surface_before(frame), past.surface)
        moments, length = found[:, :2], found[:, 2:].clamp_min(1)
        current = luminance_moments(frame.color.to(moments.dtype).clamp_max(BRIGHTEST))
        spatial = moments_variance(current, *surface, kernel_size=WINDOW)
        noise = torch.maximum(variance_of(moments, length, frame), spatial)
        noise = noise * (1 + 1 / length.clamp_max(2 / self.alpha - 1))
        noise = noise.clamp_max(BRIGHTEST**2 / 100)
        return temporal_gradient(current[:, :1], moments[:, :1], weight, noise, *surface)

    def _blend(self, frame: Frame, entering: Tensor, past: Past, motion: Tensor | None) -> tuple[Tensor, Tensor]:
        """Light and moments with as much of their history as still holds, and its length."""
        both, length = super()._blend(frame, entering, past, motion)
        change = self.changed(frame, past, motion).to(both.dtype)
        # (1 - lambda) (alpha c + (1 - alpha) h) + lambda c.
        return torch.lerp(both, entering, change), 1 / (change + (1 - change) / length)


asvgf = register_model("asvgf", kind="filter", paper="Schied et al. 2018")(behind(Demodulated, Asvgf))
