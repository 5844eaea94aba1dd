"""The description of a metric."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Metric:
    """A metric with its properties.

    Args:
        function: takes image and reference, ``(1, 3, H, W)``, or two clips, ``(1, 2, 3, H, W)``.
        higher_is_better: whether it is a similarity rather than an error.
        temporal: whether it takes pairs of consecutive frames.
    """

    function: Callable[[Tensor, Tensor], Tensor]
    higher_is_better: bool = False
    temporal: bool = False

    def better(self, value: float, other: float) -> bool:
        """Whether the first value is strictly better than the second."""
        return value > other if self.higher_is_better else value < other
