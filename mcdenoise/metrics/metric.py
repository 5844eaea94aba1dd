"""Description of a metric, for code that computes and compares several, and checks of its arguments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from mcdenoise.errors import InputError


@dataclass(frozen=True)
class Metric:
    """A metric that compares an image with its reference.

    Args:
        function: takes image and reference, ``(1, 3, H, W)``, or two clips, ``(1, 2, 3, H, W)``.
        higher_is_better: whether it is a similarity instead of an error.
        temporal: whether it takes pairs of successive frames.
    """

    function: Callable[[Tensor, Tensor], Tensor]
    higher_is_better: bool = False
    temporal: bool = False

    def better(self, value: float, other: float) -> bool:
        """Whether the first value is strictly better than the other."""
        return value > other if self.higher_is_better else value < other


class UncomputableError(InputError):
    """A metric cannot be computed for these images, or with this installation; the message gives the reason."""


def check_images(image: Tensor, reference: Tensor) -> None:
    """Raise ``ValueError`` for different shapes, ``TypeError`` for integers, which would overflow, and for complex."""
    for name, tensor in (("image", image), ("reference", reference)):
        if not tensor.is_floating_point():
            raise TypeError(f"{name}: expected a floating-point dtype, found {tensor.dtype}")
    if image.shape != reference.shape or image.ndim < 3:
        raise ValueError(
            f"reference: expected the shape of image and (..., C, H, W), found {tuple(reference.shape)} "
            f"for {tuple(image.shape)}"
        )


def check_clip(clip: Tensor, reference: Tensor) -> None:
    """As :func:`check_images`, of at least two frames."""
    check_images(clip, reference)
    if clip.ndim < 4 or clip.shape[-4] < 2:
        raise ValueError(f"clip: expected (..., T, C, H, W) with at least 2 frames, found {tuple(clip.shape)}")
