"""The guided filter on accumulated and demodulated radiance: a local linear model of the features.

He et al. 2010, "Guided image filtering"; with features as Bauszat et al. 2011, "Guided image filtering for interactive
high-quality global illumination".
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.models._interface import GUIDES, Model, Needs, Output, State
from mcdenoise.models._layers import answered, with_carried
from mcdenoise.models._published import Network
from mcdenoise.models._registry import register_model
from mcdenoise.models.accumulated import Accumulated
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.models.joint_bilateral import guide_of
from mcdenoise.models.tiled import Tiled
from mcdenoise.nn.unet import Live

# Numbers for each pixel of a tile, measured: its covariance matrix of seven guides, and the solver.
_LIVE = Live(0, 6 * 7**2)


class Guided(Network):
    """``kornia.filters.guided_blur`` with the albedo, normal and depth of the frame, as far as it has them, as guides.

    In each window the light is a linear function of the guides (He et al. 2010, Eqs. 4 to 6), and each pixel takes the
    mean of the functions of all windows in which it lies (Eq. 8), so that the light keeps the edges of the guides. A
    linear function may be negative, and is clamped to 0. Without features the light's logarithm is the guide,
    of which a median of 3x3 pixels is taken, since a guide with noise would keep the noise.

    Args:
        radius: radius of the windows in pixels, at least 1.
        eps: variance of a guide below which it has little effect, in the guides' unit squared (Eq. 5), above 0; albedos
            and normals have their own unit, depths are 10 times :func:`mcdenoise.nn.normalize_depth`.

    Raises:
        InputError: a setting is out of its range, or so small for a frame that the linear functions are undefined.
    """

    def __init__(self, radius: int = 4, eps: float = 1e-2) -> None:
        super().__init__()
        if radius < 1:
            raise InputError(f"radius: expected at least 1, found {radius}")
        if not 0 < eps < math.inf:
            raise InputError(f"eps: expected a positive number, found {eps}")
        self.radius, self.eps = radius, eps
        # A pixel sees all windows that it lies in.
        self.needs = Needs(uses=GUIDES, trainable=False, reach=2 * radius + 1, live=_LIVE)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        # All of kornia comes with it, which takes as long to import as a single frame to denoise.
        from kornia.filters import guided_blur

        guide, size = guide_of(frame), 2 * self.radius + 1
        # The linear functions of all images in one: their coefficients are of the same guides.
        images = with_carried(frame)
        try:
            blurred: Tensor = guided_blur(guide, images, size, self.eps, border_type="replicate", separable=True)
        except torch.linalg.LinAlgError as error:  # type: ignore[attr-defined]
            raise InputError(f"eps: expected more than the guides' rounding, found {self.eps:g}; take 0.01") from error
        return answered(frame, blurred.clamp_min(0)), None


@register_model("guided", kind="filter", paper="He et al. 2010")
def guided(radius: int = 4, eps: float = 1e-2, *, alpha_min: float = 0.1) -> Model:
    """Kornia's guided filter of the accumulated and demodulated radiance.

    Args:
        radius: see :class:`Guided`.
        eps: likewise.
        alpha_min: see :class:`mcdenoise.models.Accumulated`.
    """
    return Demodulated(Accumulated(Tiled(Guided(radius, eps)), alpha_min=alpha_min))
