"""Whether the noise of neighbouring pixels is correlated, from the values of an image."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mcdenoise.ops._steps.noise import second_differences


class _Rule(NamedTuple):
    """When second differences over one pixel and over two tell that noise is correlated.

    Args:
        spread: the ratio of both is 1 if the noise of pixels is independent; below this, it is correlated.
        noise: smallest relative difference of a noisy pixel.
        least: number of noisy pixels that the ratio requires.
        typical: difference that half of the pixels must exceed.
    """

    spread: float
    noise: float
    least: int
    typical: float


# On even surfaces, those whose features change by less than this from pixel to pixel, second differences of the shading
# are far below those of noise. There the ratio was 0.95 to 1.14 on 71 shots of Mitsuba and Cycles, and 0.31 to 0.84 on
# 36 with Gaussian, Mitchell and tent filters; many samples through a tent have a ratio of sqrt(2 / 3). A frame of 1024
# samples through a Gaussian is at the limit of `typical`.
_STEP, _ON_EVEN = 0.004, _Rule(0.89, 0.005, 1500, 0.01)
# Among all pixels, edges and textures of references had differences of up to 0.035. Independent noise had ratios of
# 0.82 to 1.14, correlated noise of 0.41 to 0.80.
_ANYWHERE = _Rule(0.78, 0.02, 4000, 0.04)
_MIDDLE = 640  # side of the central region that is examined, in pixels
_DARKEST = 0.02  # smallest albedo to divide by


def noise_is_spread(color: Tensor, albedo: Tensor | None, normal: Tensor | None = None) -> bool:
    """Whether neighbouring pixels have correlated noise, because the film's filter spreads each sample.

    Args:
        color: ``(B, 3, H, W)`` noisy radiance, finite. The answer is no for few noisy pixels.
        albedo: ``(B, 3, H, W)``, finite; ``None`` if there is none.
        normal: likewise, in any encoding. With a normal little noise suffices.
    """
    # The centre of a large image suffices.
    rows, columns = (slice(max(side - _MIDDLE, 0) // 2, (side + _MIDDLE) // 2) for side in color.shape[-2:])
    features = [each.detach()[..., rows, columns] for each in (albedo, normal) if each is not None]
    light = color.detach()[..., rows, columns].to(torch.promote_types(color.dtype, torch.float32))
    if albedo is not None:
        light = light / features[0].clamp_min(_DARKEST)
    brightness = light.mean(1)
    told = None if normal is None else _is_spread(brightness, torch.cat(features, 1), _ON_EVEN)
    return bool(_is_spread(brightness, None, _ANYWHERE)) if told is None else told


def _is_spread(brightness: Tensor, features: Tensor | None, rule: _Rule) -> bool | None:
    """Whether the larger ratio of rows and columns of ``(B, H, W)`` is below the rule's; ``None`` for few noisy pixels.

    With features ``(B, C, H, W)`` only even surfaces are examined.
    """
    if min(brightness.shape[-2:]) < 5:
        return None
    ratios = []
    for x, surface in ((brightness, features), (brightness.mT, None if features is None else features.mT)):
        near, wide = (each.cpu().numpy() for each in second_differences(x, surface, _STEP))
        # Pixels without noise are correlated by the image content.
        noisy = near + wide > rule.noise
        if int(noisy.sum()) < rule.least or _median(wide) < rule.typical:
            return None
        ratios.append(_median(near[noisy]) / _median(wide[noisy]))
    return max(ratios) < rule.spread


def _median(values: NDArray[Any]) -> float:
    """The lower of two middle elements; numpy finds it in a fifth of torch's time."""
    middle = (values.size - 1) // 2
    return float(np.partition(values, middle)[middle])
