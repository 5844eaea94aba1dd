"""How the renderer sampled the features of a frame, from their values."""

from __future__ import annotations

import torch

from mcdenoise.frame import Frame
from mcdenoise.ops import motion_from_position

# The medians of 14 shots at pixel centres were at most 0.0044 pixels, which half floats cause; those of 25 of Mitsuba's
# with a filter were at least 0.008 with up to 512 samples.
_NEAR = 0.0065
# Half floats change the length of a normal by at most 0.001.
_UNIT, _UNIT_FRACTION = 0.01, 0.98


def sampled_at_centres(frame: Frame) -> bool:
    """Whether the positions are seen at the pixel centres, and the normals are those of single points.

    Args:
        frame: without positions, camera or normal the answer is no.
    """
    if frame.position is None or frame.view_projection is None or frame.normal is None:
        return False
    distance = motion_from_position(frame.position, frame.view_projection).abs().amax(1)
    distance = distance[distance.isfinite()]
    # The mean of different normals is shorter than they are. The background has none.
    length = torch.linalg.vector_norm(frame.normal, dim=1)
    single = ((length - 1).abs() < _UNIT) | (length < _UNIT)
    return len(distance) > 0 and bool(distance.median() < _NEAR) and bool(single.float().mean() > _UNIT_FRACTION)
