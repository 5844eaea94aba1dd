"""The joint bilateral filter on accumulated and demodulated radiance: the plain method to compare with.

Petschnigg et al. 2004, "Digital photography with flash and no-flash image pairs", Eq. 3; Eisemann and Durand 2004.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.models._interface import GUIDES, Model, Needs, Output, State
from mcdenoise.models._layers import answered, with_carried
from mcdenoise.models._published import Network
from mcdenoise.models._registry import register_model
from mcdenoise.models._void import ISLAND
from mcdenoise.models.accumulated import Accumulated
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.models.tiled import TILE, Tiled
from mcdenoise.nn.inputs import image_statistics, normalized_depth
from mcdenoise.nn.unet import Live
from mcdenoise.ops._numbers import numbers_like

# Depths in [0, 1] differ by much less than albedos and normals do: without a scale of its own, depth hardly guides.
DEPTH_SCALE = 10.0
# Charts may differ in light by a factor of a thousand, of which nothing should pass.
ISLAND_SCALE = 30.0
# kornia unfolds the windows of small images, of those that have derivatives, and on a GPU: 25x25 pixels of a 1280x720
# image would take more than 20 GB at once. So they go in tiles of at most so many values.
_UNFOLDED_VALUES = 250_000_000
_CHANNELS = 11  # of image and guide


class JointBilateral(Network):
    """``kornia.filters.joint_bilateral_blur``, guided by albedo, normal and depth, as far as the frame has them.

    A frame without any guides itself by its logarithm, of which a median of 3x3 pixels is taken: a guide with noise
    would keep the noise.

    Args:
        sigma_color: standard deviation in the guides' space, where albedos and normals have their own unit and depths
            are 10 times :func:`mcdenoise.nn.normalize_depth`, L2 distance; above 0.
        sigma_space: in pixels, above 0; the window is twice as far to every side.

    Raises:
        InputError: a setting is out of its range.
    """

    def __init__(self, sigma_color: float = 0.2, sigma_space: float = 4.0) -> None:
        super().__init__()
        for name, sigma in (("sigma_color", sigma_color), ("sigma_space", sigma_space)):
            if not 0 < sigma < math.inf:
                raise InputError(f"{name}: expected a positive number, found {sigma}")
        self.sigma_color, self.sigma_space = sigma_color, sigma_space
        self.radius = math.ceil(2 * sigma_space)
        # Its windows, unfolded, and as much again for their weights' derivatives.
        live = Live(0, 2 * _CHANNELS * (2 * self.radius + 1) ** 2)
        self.needs = Needs(uses=GUIDES, trainable=False, reach=self.radius + 1, live=live)

    @property
    def side(self) -> int:
        """Side of tiles that keep kornia's unfolded windows within memory, in pixels."""
        pixels = math.isqrt(_UNFOLDED_VALUES // (_CHANNELS * (2 * self.radius + 1) ** 2))
        return max((pixels - 2 * self.radius) // TILE, 2) * TILE

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        # All of kornia comes with it, which takes as long to import as a single frame to denoise.
        from kornia.filters import joint_bilateral_blur

        size, images = 2 * self.radius + 1, with_carried(frame)
        sigma_space = numbers_like(images, (self.sigma_space, self.sigma_space))[None]
        blurred: Tensor = joint_bilateral_blur(
            images,
            guide_of(frame),
            size,
            self.sigma_color,
            sigma_space,
            border_type="replicate",
            color_distance_type="l2",
        )
        return answered(frame, blurred), None


def guide_of(frame: Frame) -> Tensor:
    """Albedo, normal and depth in [0, 10], of those that a frame has; of none, its color's logarithm.

    That is the median of ``log1p(e x)`` in 3x3 pixels, with the exposure ``e`` of the image, so that no unit and no
    lamp matters. The number of a pixel's chart, where the frame has charts, is one more guide.
    """
    guides = [image for image in (frame.albedo, frame.normal) if image is not None]
    statistics = image_statistics(frame)
    if frame.depth is not None:
        near, typical = statistics["depth_scale"].split(1, 1)
        guides.append(DEPTH_SCALE * normalized_depth(frame.depth, near, typical))
    if not guides:
        guides.append(_median(torch.log1p(frame.color * statistics["exposure"])))
    guides += [ISLAND_SCALE * image for name, image in frame.extra.items() if name == ISLAND]
    return torch.cat(guides, 1)


def _median(image: Tensor) -> Tensor:
    from kornia.filters import median_blur

    # kornia's own border is zero.
    padded: Tensor = median_blur(F.pad(image, (1, 1, 1, 1), mode="replicate"), 3)
    return padded[..., 1:-1, 1:-1]


@register_model("joint_bilateral", kind="filter", paper="Petschnigg et al. 2004")
def joint_bilateral(sigma_color: float = 0.2, sigma_space: float = 4.0, *, alpha_min: float = 0.1) -> Model:
    """Kornia's joint bilateral filter of the accumulated and demodulated radiance.

    Args:
        sigma_color: see :class:`JointBilateral`.
        sigma_space: likewise.
        alpha_min: see :class:`mcdenoise.models.Accumulated`.
    """
    blur = JointBilateral(sigma_color, sigma_space)
    return Demodulated(Accumulated(Tiled(blur, blur.side), alpha_min=alpha_min))
