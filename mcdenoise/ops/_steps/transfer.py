"""Open Image Denoise's transfer function, from radiance to the scale on which its networks work, and their input."""

from __future__ import annotations

import torch
from torch import Tensor

from mcdenoise.ops._constants import MAX_RADIANCE, PU_BRIGHT, PU_DARK, PU_JOINTS, PU_MIDDLE, PU_WHITE
from mcdenoise.ops._op import op


@op("numba")
def compress(radiance: Tensor) -> Tensor:
    """Map radiance to a perceptually uniform scale from 0 to 1.

    Args:
        radiance: any shape; exposed, see :func:`mcdenoise.nn.oidn.oidn_exposure`. Values are clamped to [0, 65504].

    Returns:
        The same shape, in [0, 1]. Its derivative is finite, also at 0.

    Source: Aydin et al. 2008, "Extending Quality Metrics to Full Luminance Range Images", as fitted in Open Image
    Denoise: ``a y`` up to y0, ``b y^c + d`` up to y1, ``e log(y + f) + g`` above, over its value at 65504.
    """
    (b, c, d), (e, f, g), (y0, y1, _, _) = PU_MIDDLE, PU_BRIGHT, PU_JOINTS
    y = radiance.clamp(0.0, MAX_RADIANCE)
    power = b * y.clamp_min(y0).pow(c) + d
    return torch.where(y <= y0, PU_DARK * y, torch.where(y <= y1, power, e * torch.log(y + f) + g)) / PU_WHITE


@op("numba")
def expand(compressed: Tensor) -> Tensor:
    """The inverse of :func:`compress`; negative values count as 0.

    Args:
        compressed: any shape.

    Returns:
        The same shape; not negative, and without an upper limit.
    """
    (b, c, d), (e, f, g), (_, _, x0, x1) = PU_MIDDLE, PU_BRIGHT, PU_JOINTS
    x = compressed.clamp_min(0) * PU_WHITE
    # Clamp the input of each branch, so that branches that are not selected do not overflow.
    power = ((x.clamp_min(x0) - d) / b).pow(1 / c)
    bright = torch.exp((x.clamp_min(x1) - g) / e) - f
    return torch.where(x <= x0, x / PU_DARK, torch.where(x <= x1, power, bright))


def seen_by_oidn(color: Tensor, albedo: Tensor | None = None, normal: Tensor | None = None) -> Tensor:
    """The network's input.

    Args:
        color: ``(B, 3, H, W)`` radiance on the scale of :func:`compress`.
        albedo: ``(B, 3, H, W)`` in [0, 1].
        normal: ``(B, 3, H, W)`` in [-1, 1], in world or camera space.

    Returns:
        ``(B, 9, H, W)``, in [0, 1]; without a feature 3 channels fewer.
    """
    images = [color]
    images += [] if albedo is None else [albedo.clamp(0.0, 1.0)]
    images += [] if normal is None else [normal.clamp(-1.0, 1.0) * 0.5 + 0.5]
    return torch.cat(images, 1)
