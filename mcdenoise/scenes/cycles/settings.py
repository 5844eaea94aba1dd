"""The settings of a Cycles sequence, drawn at random to resemble those of Blender's users."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

_SAMPLES = (1, 2, 4, 8, 16, 32)
_SAMPLES_P = (0.5, 0.16, 0.14, 0.1, 0.08, 0.02)
# Blender's default is Blackman-Harris over 1.5 pixels; a width of 0.01 pixels puts every sample at the pixel centre.
_FILTERS = ("blackman_harris", "box", "centre")
_FILTERS_P = (0.5, 0.25, 0.25)
WIDTHS = {"blackman_harris": 1.5, "box": 1.0, "centre": 0.01}
_DEFOCUSED, _BLURRED = 0.2, 0.15
_SHUTTER = 0.5
# Stream of a seed from which settings are drawn.
_STREAM = 0x6379636C


@dataclass(frozen=True)
class CyclesSettings:
    """Settings that all frames of a sequence have in common.

    Args:
        samples: samples per pixel of the noisy colors.
        pixel_filter: ``blackman_harris``, ``box`` or ``centre``.
        aperture: blur of infinitely far points in pixels; 0 for a pinhole.
        focus: point of focus in the first image, as fractions of width and height from the top left.
        shutter: exposure time in frames; 0 for no motion blur.
    """

    samples: int
    pixel_filter: str
    aperture: float
    focus: tuple[float, float]
    shutter: float


def draw_settings(seed: int, *, view: int = 0, samples: int | None = None, moving: bool = True) -> CyclesSettings:
    """Draw the settings of a sequence; the same seed gives the same settings.

    Half of all sequences have one sample per pixel, the others up to 32. Half have Blender's default pixel filter, a
    quarter a box of one pixel, a quarter every sample at the pixel centre. A fifth have depth of field, and some motion
    blur.

    Args:
        seed: seed of the scene.
        view: selects other settings for the same scene.
        samples: samples per pixel, if they should not be drawn.
        moving: whether there is more than one frame; a still has no motion blur.

    Example:
        >>> draw_settings(3, samples=4).samples
        4
    """
    rng = np.random.default_rng(np.random.SeedSequence((seed, _STREAM), spawn_key=(view,) if view else ()))
    drawn = int(rng.choice(_SAMPLES, p=_SAMPLES_P))
    pixel_filter = str(rng.choice(_FILTERS, p=_FILTERS_P))
    defocused, blurred = (bool(rng.random() < part) for part in (_DEFOCUSED, _BLURRED))
    aperture = float(np.exp(rng.uniform(math.log(2), math.log(16))))
    focus = (float(rng.uniform(0.25, 0.75)), float(rng.uniform(0.3, 0.8)))
    return CyclesSettings(
        drawn if samples is None else samples,
        pixel_filter,
        aperture if defocused else 0.0,
        focus,
        _SHUTTER if blurred and moving else 0.0,
    )
