"""Filter an image with weights from a map of importance: means over a window, without a tensor of kernels."""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.ops._check import check_kernel_size
from mcdenoise.ops._module import module_of
from mcdenoise.ops._op import op
from mcdenoise.ops._window import accumulator_dtype


def _check_size(kernel_size: int) -> None:
    check_kernel_size(kernel_size, 3)


@op("numba", check=_check_size, image="B C H W", importance="B 1 H W")
def importance_filter(image: Tensor, importance: Tensor, *, kernel_size: int) -> Tensor:
    """Average over a window with weights that one map of importance gives to all pixels: softmax of the map over it.

    ``out[p] = sum_q exp(m[q]) image[q] / sum_q exp(m[q])`` over the ``q`` of the ``K x K`` window around ``p`` that are
    inside the image, with the importance ``m``: the quotient of two box filters. A constant added to ``m`` cancels.

    No exponential overflows and no window loses all its weights, whatever the map: a window is put together of pairs of
    disjoint windows, of which each has its largest importance ``M``, its sum of ``exp(m - M)``, which is at least 1,
    and its mean. Windows of 2, 4, 8, ... pixels along one axis, then along the other, give any size: the cost grows
    with ``log K``, and no tensor has ``K * K`` channels.

    Args:
        image: ``(B, C, H, W)``, any unit and range.
        importance: ``(B, 1, H, W)`` ``m``, the logarithm of each pixel's weight, finite, up to 1e30.
        kernel_size: odd ``K``, at least 3.

    Returns:
        ``(B, C, H, W)`` in the dtype of ``image``. Half precision is computed in float32. Between the smallest and the
            largest pixel of the window, to rounding.

    Raises:
        TypeError: an argument is no floating-point tensor.
        ValueError: shapes disagree, or ``K`` is not odd and at least 3.

    Differentiable in ``image`` and ``importance``, to any order.

    Source: Fan et al. 2021, "Real-time Monte Carlo denoising with weight sharing kernel prediction network",
    where a kernel is decoded from the importance of the pixels under it; the public code exponentiates the map itself,
    which overflows. The pairs are those of the online softmax, Milakov and Gimelshein 2018.

    Example:
        >>> image = torch.arange(5.0).reshape(1, 1, 1, 5)
        >>> importance_filter(image, torch.zeros(1, 1, 1, 5), kernel_size=3).flatten().tolist()
        [0.5, 1.0, 2.0, 3.0, 3.5]
        >>> importance_filter(image, 1e4 * image, kernel_size=3).flatten().tolist()
        [1.0, 2.0, 3.0, 4.0, 4.0]
    """
    if image.numel() == 0:
        return image
    dtype = torch.promote_types(accumulator_dtype(image.dtype), accumulator_dtype(importance.dtype))
    logarithm = importance.to(dtype)
    maximum = logarithm.detach()
    window = _Window(maximum, torch.exp(logarithm - maximum), image.to(dtype))
    for axis in (-1, -2):
        window = _along(window, axis, kernel_size)
    return window.mean.to(image.dtype)


ImportanceFilter = module_of(importance_filter, _check_size)


class _Window(NamedTuple):
    """The sums over the window at each pixel.

    Args:
        maximum: ``(B, 1, H, W)`` largest importance ``M``, without a derivative: the result does not depend on it.
        weight: ``(B, 1, H, W)`` sum of ``exp(m - M)``.
        mean: ``(B, C, H, W)`` weighted mean of the image.
    """

    maximum: Tensor
    weight: Tensor
    mean: Tensor

    def part(self, axis: int, start: int, length: int) -> _Window:
        """The windows of ``length`` pixels along an axis, from pixel ``start`` on."""
        return _Window(*(each.narrow(axis, start, length) for each in self))

    def joined(self, other: _Window) -> _Window:
        """The union with another window that has no pixel in common with it."""
        maximum = torch.maximum(self.maximum, other.maximum)
        own, others = self.weight * torch.exp(self.maximum - maximum), other.weight * torch.exp(other.maximum - maximum)
        weight = own + others
        # The difference of the means would lose digits: the one with hardly any weight may be a lamp. A sum that is
        # divided at the end could overflow where the mean does not.
        mean = torch.addcmul(own / weight * self.mean, others / weight, other.mean)
        return _Window(maximum, weight, mean)


def _along(window: _Window, axis: int, kernel_size: int) -> _Window:
    """Windows of as many pixels along an axis, of those inside the image, by the binary digits of the number."""
    length, radius = window.maximum.shape[axis], kernel_size // 2
    margin = (radius, radius) if axis == -1 else (0, 0, radius, radius)
    # Pixels outside the image have the smallest importance, which is finite: two such windows must not give 0 / 0.
    worthless = torch.finfo(window.maximum.dtype).min
    maximum, weight = F.pad(window.maximum, margin, value=worthless), F.pad(window.weight, margin, value=1.0)
    level = _Window(maximum, weight, F.pad(window.mean, margin))
    # The number is odd: the windows of one pixel are the first.
    found, covered, size = level.part(axis, 0, length), 1, 1
    while 2 * size <= kernel_size:
        available = level.maximum.shape[axis] - size
        level = level.part(axis, 0, available).joined(level.part(axis, size, available))
        size *= 2
        if kernel_size & size:
            found = found.joined(level.part(axis, covered, length))
            covered += size
    return found
