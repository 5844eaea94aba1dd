"""Whether the noise of neighbouring pixels is correlated, from the values of an image."""

from __future__ import annotations

from torch import Tensor

# Ratio of second differences over one pixel and over two, without albedo: 1 if the noise of pixels is independent
# (measured on 132 shots of Mitsuba and Cycles: 0.82 to 1.14), less if samples are spread over several pixels (0.41 to
# 0.80 on 34 with Gaussian, Mitchell and tent filters). Smallest relative difference of noisy pixels, which half of the
# pixels must exceed: edges and textures of references had up to 0.035.
_SPREAD, _NOISE, _LEAST_NOISY, _TYPICAL_NOISE = 0.78, 0.02, 4000, 0.04
_MIDDLE = 640  # side of the central region that is examined, in pixels
_DARKEST = 0.02  # smallest albedo to divide by


def noise_is_spread(color: Tensor, albedo: Tensor | None) -> bool:
    """Whether neighbouring pixels have correlated noise, because the film's filter spreads each sample.

    Args:
        color: ``(B, 3, H, W)`` noisy radiance, finite. The answer is no for few noisy pixels.
        albedo: ``(B, 3, H, W)``, finite; ``None`` if there is none.
    """
    # The centre of a large image suffices.
    rows, columns = (slice(max(side - _MIDDLE, 0) // 2, (side + _MIDDLE) // 2) for side in color.shape[-2:])
    light = color.detach()[..., rows, columns]
    if albedo is not None:
        light = light / albedo.detach()[..., rows, columns].clamp_min(_DARKEST)
    ratios = []
    for x in ((brightness := light.mean(1)), brightness.mT):
        two, one, here, other, far = (x[..., i : x.shape[-1] - 4 + i] for i in range(5))
        mean = (two + one + 2 * here + other + far).clamp_min(1e-9)
        near, wide = (one - 2 * here + other).abs() / mean, (two - 2 * here + far).abs() / mean
        # Pixels without noise are correlated by the image content.
        noisy = near + wide > _NOISE
        if int(noisy.sum()) < _LEAST_NOISY or float(wide.median()) < _TYPICAL_NOISE:
            return False
        ratios.append(float(near[noisy].median() / wide[noisy].median()))
    return max(ratios) < _SPREAD
