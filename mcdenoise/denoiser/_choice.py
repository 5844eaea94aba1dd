"""Which model suits a frame."""

from __future__ import annotations

from mcdenoise.frame import Frame
from mcdenoise.models import DEFAULT
from mcdenoise.noise import noise_of
from mcdenoise.sampling import has_exact_features

# For features through a pixel filter, with noise, or of unknown origin.
FILTERED = "oidn_tuned"
# For features without noise, in stills and where the color has little.
EXACT = "oidn_tuned_exact"
# Level of noise of frames with some eight samples a pixel; training/README.md has the errors of both models.
_MANY_SAMPLES = 0.1


def suitable_model(frame: Frame | None, *, still: bool = False, cascade: bool = False) -> tuple[str, str]:
    """The name of the model that suits a frame, and the reason in words.

    ``cascaded_v2`` was trained on features without noise and one sample a pixel, and is best with a history;
    ``oidn_tuned_exact`` was trained on features without noise and 1 to 64 samples. Files of a renderer have features
    through a pixel filter, for which the others were trained.

    Args:
        frame: ``None`` for one that is known to have features through a filter.
        still: whether it is the only frame of its shot.
        cascade: whether a cascade is required, for the settings of its history.
    """
    exact = frame is not None and has_exact_features(frame)
    if cascade:
        return DEFAULT if exact else "cascaded_v3", "of the usual models, only cascades have settings of the history"
    name, reason = FILTERED, "features may be noisy, or filtered over pixels"
    if frame is not None and exact:
        if not still and float(noise_of(frame.color, frame.albedo, frame.normal).level.amax()) > _MANY_SAMPLES:
            return DEFAULT, "features have no noise, and the color of a sequence has much"
        name, reason = EXACT, f"features have no noise, and the color {'is of a still' if still else 'has little'}"
    return name, f"{reason}; oidn_temporal usually has a smaller error, but takes longer"
