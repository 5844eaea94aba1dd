"""What the kernel-predicting networks of the paper's comparison wear, and see of a frame, as `cascaded` does."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from mcdenoise.frame import Frame
from mcdenoise.models._interface import Model
from mcdenoise.models.accumulated import Accumulated
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.models.exposed import Exposed
from mcdenoise.models.tiled import Tiled
from mcdenoise.nn.inputs import features_of, image_statistics
from mcdenoise.ops._steps.network import normalized_depth

# Of the BMFR scene "classroom", squared, in scene units (its world is in metres).
POSITION_LIMIT, NORMAL_LIMIT = 0.01, 1.0


def as_published(network: Model, alpha_min: float, position_limit: float, normal_limit: float) -> Model:
    """A network on demodulated radiance that is accumulated by the published rule (Koskela et al. 2019).

    Args:
        network: without a state.
        alpha_min: smallest weight of the current frame in the accumulation.
        position_limit: squared distance in scene units below which two points are one.
        normal_limit: likewise for normals.
    """
    return Demodulated(
        Accumulated(
            Exposed(Tiled(network)),
            alpha_min=alpha_min,
            rule="bmfr",
            position_limit=position_limit,
            normal_limit=normal_limit,
            firefly_limit=float("inf"),
            specular_length=float("inf"),
            lag_threshold=float("inf"),
        )
    )


class TenChannels(nn.Module):
    """A network whose input is an image and seven channels of features in [0, 1]."""

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """The depth scale of the whole image."""
        return image_statistics(frame)

    def input_of(self, frame: Frame, image: Tensor) -> Tensor:
        """The image, albedo, ``normal / 2 + 1 / 2`` and depth, ``(B, 10, H, W)``."""
        albedo, normal, depth = features_of(frame)
        near, typical = (frame.statistics or self.statistics(frame))["depth_scale"].split(1, 1)
        return torch.cat([image, albedo, normal * 0.5 + 0.5, normalized_depth(depth, near, typical)], 1)
