"""Description of a metric, for code that computes and compares several, and checks of its arguments."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

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

    def rank(self, value: float) -> float:
        """A key to sort values by, the best first."""
        return -value if self.higher_is_better else value

    def better(self, value: float, other: float) -> bool:
        """Whether the first value is strictly better than the other."""
        return self.rank(value) < self.rank(other)


class UncomputableError(InputError):
    """A metric cannot be computed for these images, or with this installation; the message gives the reason."""


def package_of(metric: str, package: str, module: str) -> Any:
    """Import the package of a metric; without it, an ``UncomputableError`` says how to install it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise UncomputableError(
            f"{metric} needs {package}, which is not installed; pip install 'mcdenoise[peers]', or skip {metric}"
        ) from error


def check_window(window: str, image: Tensor, side: int) -> None:
    """Raise ``UncomputableError`` for an image that is smaller than a metric's window."""
    height, width = image.shape[-2:]
    if min(height, width) < side:
        raise UncomputableError(f"{window}: expected at least {side} x {side} pixels, found {height} x {width}")


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
