"""Second differences of neighbouring pixels, which tell noise from the shading of a surface."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

from mcdenoise.ops._constants import LEAST_SUM
from mcdenoise.ops._op import op

__all__ = ["second_differences"]


@op("numba")
def second_differences(image: Tensor, features: Tensor | None, step: float) -> tuple[Tensor, Tensor]:
    """Relative second differences along rows, over one pixel and over two, where the features are even.

    Of five neighbours a to e of a row, with the mean ``m = max(a + b + 2 c + d + e, 1e-9)``, they are
    ``|b - 2 c + d| / m`` and ``|a - 2 c + e| / m``.

    Args:
        image: ``(B, H, W)``, at least 5 pixels wide.
        features: ``(B, C, H, W)``; runs of five pixels in which a feature changes by ``step`` or more between
            neighbours are skipped. ``None`` skips none.
        step: see ``features``.

    Returns:
        Two tensors of one axis, with an element for each run of five pixels that is not skipped.
    """
    a, b, c, d, e = (image[..., i : image.shape[-1] - 4 + i] for i in range(5))
    mean = (a + b + 2 * c + d + e).clamp_min(LEAST_SUM)
    near, wide = (b - 2 * c + d).abs() / mean, (a - 2 * c + e).abs() / mean
    if features is None:
        return near.flatten(), wide.flatten()
    steps = (features[..., 1:] - features[..., :-1]).abs().amax(1)
    even = F.max_pool2d(steps, (1, 4), 1) < step
    return near[even], wide[even]
