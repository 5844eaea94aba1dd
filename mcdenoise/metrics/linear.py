"""Errors of scene-linear radiance, without a tone curve or clamping."""

from __future__ import annotations

from torch import Tensor

from mcdenoise.metrics.metric import check_images


def smape_linear(image: Tensor, reference: Tensor, *, epsilon: float = 1e-2) -> Tensor:
    """Symmetric mean absolute percentage error of scene-linear radiance: ``mean(|x - y| / (|x| + |y| + epsilon))``.

    Args:
        image: ``(..., C, H, W)`` scene-linear radiance.
        reference: of the same shape.
        epsilon: small constant in the unit of the radiance.

    Returns:
        ``(...)`` in [0, 1], lower is better.

    Raises:
        ValueError: the shapes differ.

    Source: Eq. 9 of the paper, doi:10.1007/s00371-023-02951-6.

    Example:
        >>> import torch
        >>> smape_linear(torch.ones(1, 3, 2, 2), torch.full((1, 3, 2, 2), 3.0), epsilon=0.0).tolist()
        [0.5]
    """
    check_images(image, reference)
    return ((image - reference).abs() / (image.abs() + reference.abs() + epsilon)).mean((-3, -2, -1))


def relmse_linear(image: Tensor, reference: Tensor, *, epsilon: float = 1e-2) -> Tensor:
    """Relative mean squared error of scene-linear radiance: ``mean((x - y)^2 / (mean_rgb(y)^2 + epsilon))``.

    Args:
        image: ``(..., C, H, W)`` scene-linear radiance.
        reference: of the same shape.
        epsilon: small constant in the unit of the squared radiance.

    Returns:
        ``(...)``, lower is better.

    Raises:
        ValueError: the shapes differ.

    Source: Rousselle et al. 2011.
    """
    check_images(image, reference)
    scale = reference.mean(-3, keepdim=True).square() + epsilon
    return ((image - reference).square() / scale).mean((-3, -2, -1))


def rmse_linear(image: Tensor, reference: Tensor) -> Tensor:
    """Root mean squared error of scene-linear radiance: ``sqrt(mean((x - y)^2))``. A few bright pixels may dominate it.

    Args:
        image: ``(..., C, H, W)`` scene-linear radiance.
        reference: of the same shape.

    Returns:
        ``(...)`` in the unit of the radiance, lower is better. The gradient is undefined where it is 0.

    Raises:
        ValueError: the shapes differ.

    Example:
        >>> import torch
        >>> rmse_linear(torch.ones(1, 3, 2, 2), torch.full((1, 3, 2, 2), 3.0)).tolist()
        [2.0]
    """
    check_images(image, reference)
    return mse(image, reference).sqrt()


def mse(image: Tensor, reference: Tensor) -> Tensor:
    """Mean squared error, ``(...)``, of images ``(..., C, H, W)`` of equal shapes."""
    return (image - reference).square().mean((-3, -2, -1))
