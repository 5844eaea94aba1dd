"""How many frames of a shot a method remembers."""

from __future__ import annotations

import math

from torch import nn

from mcdenoise.errors import InputError
from mcdenoise.models._interface import Model


def frames_remembered(model: Model, tolerance: float) -> int | None:
    """After how many frames what a method kept of a shot before them counts for no more than a tolerance.

    Of a history that each frame leaves the fraction ``p`` of, ``p**n`` is left after ``n`` frames. Where a method holds
    others that remember, the frames of all are added, as each remembers what the one before it remembered.

    Args:
        model: any method.
        tolerance: fraction of what was kept, in (0, 1).

    Returns:
        The number of frames, 0 for a method that keeps nothing; or ``None`` where nobody knows: what a recurrent
        network has learnt to remember, and a method of somebody else's that does not say it by ``persistence``.

    Raises:
        InputError: the tolerance is out of its range.

    Example:
        >>> from mcdenoise.models import create_model
        >>> frames_remembered(create_model("accumulated", alpha_min=0.1), 1e-3)
        66
    """
    if not 0 < tolerance < 1:
        raise InputError(f"tolerance: expected in (0, 1), found {tolerance:g}")
    parts = list(model.modules()) if isinstance(model, nn.Module) else [model]
    frames = 0
    for part in parts:
        if not hasattr(part, "persistence"):
            if hasattr(part, "needs") and type(part).__module__.partition(".")[0] != "mcdenoise":
                return None
            continue
        left: float | None = part.persistence  # type: ignore[assignment]
        if left is None:
            return None
        frames += max(1, math.ceil(math.log(tolerance) / math.log(left))) if left > 0 else 1
    return frames
