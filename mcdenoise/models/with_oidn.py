"""A method that is given Open Image Denoise's images of each frame, in both of its ways with features."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from mcdenoise.frame import Frame
from mcdenoise.models._interface import Model, Needs, Output, State
from mcdenoise.models._wrapper import Wrapper
from mcdenoise.models.oidn import Oidn, Quality

# Open Image Denoise's images where features are taken for noisy and for clean ones, and the frame's own radiance.
OIDN, OIDN_CLEAN, NOISY = "oidn", "oidn_clean", "noisy"
EXACT = "exact"  # everywhere 1 where all features are exact, else 0
# Squared length of a normal that is no mean of others, and the fraction of pixels that may have shorter ones.
_UNIT, _MOST_MEANS = 0.98, 0.002
# Relative difference of inverse depths at two pixels' distance that is no rounding of half floats.
_LEAST_SLOPE, _EVEN = 4e-3, 0.1
# Largest difference of two normals that is unlike, and the fraction of pixels: measured, of scenes without such
# materials up to 0.0039, of rough glass and metal in Cycles 0.0069.
_UNLIKE, _MOST_SPECKS = 0.1, 0.0045


class WithOidn(Wrapper):
    """Hands a method Open Image Denoise's images of each frame.

    The method finds them in ``frame.extra``, ``(B, 3, H, W)`` each: ``oidn`` where features are taken for noisy,
    ``oidn_clean`` where they are taken for clean; ``noisy``, the radiance of the frame, which a later method of a chain
    no longer has; and ``exact`` ``(B, 1, H, W)``, see :func:`has_exact_features`. Both images are stages of their own.
    OIDN always sees the whole image.

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
        given = frozenset({OIDN, OIDN_CLEAN, NOISY, EXACT})
        return Needs(needs.buffers - given, (needs.uses - given) | self._oidn.needs.uses, needs.trainable, None)

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """None: those of the method inside may be of what is handed to it."""
        return {}

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`.

        Raises:
            InputError: a derivative in the color is asked for.
        """
        handed = self.before(frame)
        output, state = self.inner(handed, state)
        stages = {name: handed.extra[name] for name in (OIDN, OIDN_CLEAN)}
        return output._replace(stages={**stages, **output.stages}), state

    def before(self, frame: Frame) -> Frame:
        """The frame as the method inside sees it."""
        noisy = self._oidn(frame)[0].image
        # Without features there is one way only.
        clean = noisy if frame.albedo is None else self._clean(frame)[0].image
        exact = torch.full_like(frame.color[:, :1], float(has_exact_features(frame)))
        given = {OIDN: noisy, OIDN_CLEAN: clean, NOISY: frame.color, EXACT: exact}
        return frame.replace(extra={**frame.extra, **given}, skip=None)


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
