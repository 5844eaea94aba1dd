"""What networks do between their convolutions, each step in one pass over the image.

Not part of the ops that users compose: each is a few of those, or of torch's, in a row, as its plain form says.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.ops._backend import Backend, choose_backend
from mcdenoise.ops._window import accumulator_dtype
from mcdenoise.ops.fusion import laplacian_fusion, upsample

_FORMS: tuple[Backend, ...] = ("torch", "numba")


def stacked(images: Tensor, features: Tensor, *, backend: Backend | None = None) -> Tensor:
    """``torch.cat([images, features], 1)`` as a convolution takes it: channels-last, in the precision of autocast.

    Args:
        images: ``(B, C, H, W)``, any unit and range.
        features: ``(B, F, H, W)`` of the same dtype.
        backend: see :func:`mcdenoise.ops._backend.choose_backend`.

    Returns:
        ``(B, C + F, H, W)``. The plain form leaves layout and precision to the convolution.
    """
    chosen = choose_backend(backend, images, features, differentiable=False, forms=_FORMS)
    device = images.device.type
    dtype = torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else images.dtype
    if chosen == "torch" or torch.float16 in (images.dtype, features.dtype, dtype):
        return torch.cat([images, features], 1)
    from mcdenoise.ops._fast import fused as fast

    result: Tensor = fast.stacked(images, features, dtype)
    return result


def gated_fusion(
    fine: Tensor,
    coarse: Tensor,
    weight: Tensor,
    bias: Tensor,
    *,
    residual: Tensor | None = None,
    top: Tensor | None = None,
    backend: Backend | None = None,
) -> Tensor:
    """Fuse two scales with an ``alpha`` that a convolution of both predicts.

    ``laplacian_fusion(i, coarse, sigmoid(conv3x3([i, upsample(coarse)])))`` with ``i = fine + residual``.

    Args:
        fine: ``(B, C, H, W)``, any unit; logarithms of radiance if there is a ``top``.
        coarse: ``(B, C, ceil(H / 2), ceil(W / 2))`` of the same unit and dtype.
        weight: ``(1, 2 C, 3, 3)``.
        bias: ``(1,)``.
        residual: ``(B, C, H, W)`` to be added to ``fine``, any dtype; none by default.
        top: ``(B, 1, 1, 1)`` largest logarithm of the radiance of the result, which is then handed out as radiance:
            ``expm1`` of what is brought to the range from 0 to ``top``.
        backend: see :func:`mcdenoise.ops._backend.choose_backend`.

    Returns:
        ``(B, C, H, W)``, at least float32. The fast form computes ``alpha`` in the dtype of the result, also under
        autocast.
    """
    given = (fine, coarse, weight, bias, residual, top)
    chosen = choose_backend(backend, *given, differentiable=False, forms=_FORMS)
    if chosen != "torch":
        from mcdenoise.ops._fast import fused as fast

        result: Tensor = fast.gated_fusion(*given)
        return result
    if residual is not None:
        fine = residual.to(accumulator_dtype(residual.dtype)) + fine
    both = torch.cat([fine, upsample(coarse, (fine.shape[-2], fine.shape[-1]))], 1)
    alpha = torch.sigmoid(F.conv2d(both, weight, bias, padding=1))
    fused = laplacian_fusion(fine, coarse, alpha.to(fine.dtype))
    return fused if top is None else torch.expm1(torch.minimum(fused.clamp_min(0), top))


def softplus(x: Tensor, *, backend: Backend | None = None) -> Tensor:
    """``F.softplus`` as contiguous planes of at least float32.

    Args:
        x: ``(B, C, H, W)`` of any layout, such as some channels of a network's prediction.
        backend: see :func:`mcdenoise.ops._backend.choose_backend`.
    """
    if choose_backend(backend, x, differentiable=False, forms=_FORMS) == "torch":
        return F.softplus(x.to(accumulator_dtype(x.dtype)).contiguous())
    from mcdenoise.ops._fast import fused as fast

    result: Tensor = fast.softplus(x)
    return result
