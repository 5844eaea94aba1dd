"""Checks that images and clips match."""

from __future__ import annotations

from torch import Tensor

from mcdenoise.errors import InputError


class UncomputableError(InputError):
    """A metric cannot be computed for these images or in this installation; the message states the reason."""


def check_images(image: Tensor, reference: Tensor) -> None:
    """Raise ``ValueError`` for different shapes, ``TypeError`` for integers, which wrap around, and complex numbers."""
    for name, tensor in (("image", image), ("reference", reference)):
        if not tensor.is_floating_point():
            raise TypeError(f"{name}: expected a floating-point dtype, found {tensor.dtype}")
    if image.shape != reference.shape or image.ndim < 3:
        raise ValueError(
            f"reference: expected the shape of image and (..., C, H, W), found {tuple(reference.shape)} "
            f"for {tuple(image.shape)}"
        )


def check_clip(clip: Tensor, reference: Tensor) -> None:
    check_images(clip, reference)
    if clip.ndim < 4 or clip.shape[-4] < 2:
        raise ValueError(f"clip: expected (..., T, C, H, W) with at least 2 frames, found {tuple(clip.shape)}")
