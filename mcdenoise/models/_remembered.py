"""How many frames of history influence a method's result."""

from __future__ import annotations

import math

from torch import nn

from mcdenoise.models._interface import Model


def frames_remembered(model: Model, tolerance: float) -> int | None:
    """The number of frames after which earlier history has a weight below a tolerance.

    If each frame keeps the fraction ``p`` of the history, ``p**n`` remains after ``n`` frames. If a method contains
    other methods with a history, their frames are added, because each history holds results of the one before it.

    Args:
        model: any method.
        tolerance: remaining weight of the history, in (0, 1).

    Returns:
        The number of frames, 0 for a method without a history; or ``None`` if it is unknown, as for a recurrent
        network or for a user's method without ``persistence``.

    Example:
        >>> from mcdenoise.models import create_model
        >>> frames_remembered(create_model("accumulated", alpha_min=0.1), 1e-3)
        66
    """
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
