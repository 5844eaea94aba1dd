"""What a metric is to those who compute and compare many of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Metric:
    """How to compare an image with its reference.

    Args:
        function: of image and reference, ``(1, 3, H, W)``, or of two clips, ``(1, 2, 3, H, W)``.
        higher_is_better: whether it is a similarity; else it is an error.
        temporal: whether it takes pairs of successive frames.
    """

    function: Callable[[Tensor, Tensor], Tensor]
    higher_is_better: bool = False
    temporal: bool = False

    def better(self, value: float, other: float) -> bool:
        """Whether the first value is better than the other; equal ones are not."""
        return value > other if self.higher_is_better else value < other
