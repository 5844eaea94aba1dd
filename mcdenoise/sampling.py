"""How the renderer sampled a frame, from its values, and which model suits that."""

from __future__ import annotations

import torch

from mcdenoise.frame import Frame
from mcdenoise.models import DEFAULT, FILTERED
from mcdenoise.noise import noise_of
from mcdenoise.ops import motion_from_position

# The medians of 14 shots at pixel centres were at most 0.0044 pixels, which half floats cause; those of 25 of Mitsuba's
# with a filter were at least 0.008 with up to 512 samples.
_NEAR = 0.0065
# Half floats change the length of a normal by at most 0.001.
_UNIT, _UNIT_FRACTION = 0.01, 0.98
# Level of noise (:func:`mcdenoise.noise.noise_of`) of frames with some four samples a pixel. On eight shots at pixel
# centres, whose noise was reduced step by step, cascaded_v2 was better above 0.1 to 0.17 (on sponza always).
_MANY_SAMPLES = 0.15


def suitable_model(frame: Frame | None, *, cascade: bool = False) -> tuple[str, str]:
    """The name of the model that suits a frame, and the reason in words.

    ``cascaded_v2`` was trained on features sampled at the pixel centres and one sample a pixel, and is best there.
    Files of a renderer have features through a pixel filter, for which the others were trained.

    Args:
        frame: ``None`` for one that is known to have features through a filter.
        cascade: whether a cascade is required, for the settings of its history, or for kernels to filter layers with.
    """
    reason = "features may be noisy, or filtered over pixels"
    if frame is not None and sampled_at_centres(frame):
        if cascade or float(noise_of(frame.color, frame.albedo, frame.normal).level.amax()) > _MANY_SAMPLES:
            return DEFAULT, "features are sampled at the pixel centres"
        reason = "there is little noise"
    model = "cascaded_v3" if cascade else FILTERED
    return model, f"{reason}; oidn_temporal has a smaller error, but takes longer"


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
