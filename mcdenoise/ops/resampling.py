"""Resample an image at moved places without blurring it."""

from __future__ import annotations

from functools import reduce

import torch
from torch import Tensor

from mcdenoise.ops._constants import CUBIC
from mcdenoise.ops._op import op
from mcdenoise.ops.temporal import places_before


@op("numba", previous="B C H W", motion="B 2 H W")
def resample(previous: Tensor, motion: Tensor) -> Tensor:
    """Fetch the previous frame at the previous place of each pixel by limited bicubic interpolation.

    At ``q = p + motion[p]``, with the 16 pixels ``q_k`` around it, ``value = sum_k k(x_k - q_x) k(y_k - q_y)
    previous[q_k]``, limited to the range of the four nearest of them. ``k`` is Keys' kernel with ``a = -0.75``, that of
    ``torch.nn.functional.grid_sample``: ``(a + 2) |d|^3 - (a + 3) |d|^2 + 1`` up to a distance of 1, and
    ``a |d|^3 - 5 a |d|^2 + 8 a |d| - 4 a`` from there to 2. Bilinear interpolation blurs a history a little in every
    frame; this sharpens some frequencies by a few per cent. Its limit stops that, and dark rings around bright pixels.

    It tests no surfaces: take it where :func:`reproject` keeps all four taps. The twelve others may show another
    surface, but cannot move the value out of the range of the four.

    Args:
        previous: ``(B, C, H, W)`` anything of the previous frame, finite. Outside, its edge is repeated.
        motion: ``(B, 2, H, W)`` pixels, ``previous position = current position + motion``.

    Returns:
        ``(B, C, H, W)`` in the dtype of ``previous``; 0 where the motion is not finite. A place in the image is known
        to eps times its size.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: shapes disagree.

    Differentiable in ``previous`` and, between the pixel centres and inside the image, in ``motion``, to any order. At
    the limit, the derivative is that of the pixel that limits.

    Source: Keys 1981, "Cubic Convolution Interpolation for Digital Image Processing", IEEE Transactions on Acoustics,
    Speech, and Signal Processing 29; for histories Yang et al. 2020, "A Survey of Temporal Antialiasing Techniques",
    Computer Graphics Forum 39, Sec. 6.1.

    Example:
        >>> previous = torch.tensor([[[[0.0, 0.0, 1.0, 1.0, 0.0]]]])
        >>> motion = torch.tensor([0.25, 0.0]).reshape(1, 2, 1, 1).expand(1, 2, 1, 5)
        >>> resample(previous, motion).flatten().tolist()
        [0.0, 0.2265625, 1.0, 0.7734375, 0.0]
    """
    height, width = previous.shape[-2:]
    dtype = torch.promote_types(previous.dtype, torch.float32)
    known, base, fraction = places_before(motion, dtype)
    x0, y0 = base.split(1, 1)
    # Far outside, all pixels around a place repeat the edge.
    across, down = (_kernel(each) for each in fraction.clamp(0, 1).split(1, 1))

    source = previous.to(dtype).flatten(2)
    value, nearest = torch.zeros_like(previous, dtype=dtype), []
    for j in range(4):
        y = (y0 + j - 1).clamp(0, height - 1) * width
        for i in range(4):
            index = (y + (x0 + i - 1).clamp(0, width - 1)).flatten(2)
            tap = source.gather(2, index.expand(-1, source.shape[1], -1)).reshape(value.shape)
            value = value + across[i] * down[j] * tap
            nearest += [tap] if i in (1, 2) and j in (1, 2) else []
    least, most = (reduce(limit, nearest) for limit in (torch.minimum, torch.maximum))
    value = torch.minimum(torch.maximum(value, least), most)
    return torch.where(known, value, 0).to(previous.dtype)


def _kernel(t: Tensor) -> list[Tensor]:
    """Weights of the four pixels around a place, at a fraction ``t`` behind the second of them."""
    back = 1 - t
    outer = [CUBIC * near * far * far for near, far in ((t, back), (back, t))]
    inner = [((CUBIC + 2) * d - (CUBIC + 3)) * d * d + 1 for d in (t, back)]
    return [outer[0], *inner, outer[1]]
