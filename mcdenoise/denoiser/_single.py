"""A single image, from arrays to an array."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import nn

from mcdenoise.denoiser._denoiser import AskedPrecision, Denoiser
from mcdenoise.denoiser._settings import check_settings
from mcdenoise.frame import OF_RENDERERS, Frame, Layout
from mcdenoise.models import DEFAULT, Model


def denoise(
    color: ArrayLike,
    *,
    layout: Layout = "HWC",
    albedo: ArrayLike | None = None,
    normal: ArrayLike | None = None,
    depth: ArrayLike | None = None,
    model: str | Model | nn.Module | None = None,
    device: torch.device | str = "cpu",
    precision: AskedPrecision = "auto",
    extra: Mapping[str, ArrayLike] | None = None,
    **others: Any,
) -> NDArray[np.float32]:
    """Denoise a single image: arrays in, an array out.

    The model is created in each call, and no state is kept. For the frames of a shot, which have a history, and for
    many images use a :class:`Denoiser` and :meth:`mcdenoise.Frame.from_numpy`.

    Args:
        color: ``(H, W, 3)`` in the layout ``"HWC"``, ``(3, H, W)`` in ``"CHW"``, or one channel, also ``(H, W)``, which
            is grey: scene-linear radiance of any float dtype. Pixels that are NaN, infinite, negative or above 1e16 are
            replaced, see :class:`Denoiser`.
        layout: layout of every array, including the result. It is never guessed: an array of another layout is
            rejected.
        albedo: like ``color``, in [0, 1]; this and the following buffers are optional.
        normal: like ``color``, in [-1, 1].
        depth: ``(H, W)``, or with a channel axis.
        model: see :class:`Denoiser`, also for the default.
        device: device to run on; the result is copied back from it.
        precision: see :class:`Denoiser`.
        extra: further buffers by name.
        others: further buffers of :class:`mcdenoise.Frame`, such as ``position``, see
            :meth:`mcdenoise.Frame.from_numpy`; further arguments of :class:`Denoiser`, such as ``weights``; and
            settings of the model.

    Returns:
        The denoised image, float32 whatever the dtype of ``color``, in the same layout and with as many channels,
        contiguous, in its own memory.

    Raises:
        InputError: an array has another layout, size or number of channels, holds no floats or illegal values, or the
            model lacks a buffer or has no such setting; the message names it.

    Example:
        >>> noisy, albedo = np.random.rand(24, 32, 3), np.full((24, 32, 3), 0.5)
        >>> clean = denoise(noisy, albedo=albedo, model="wild_small")
        >>> clean.shape, clean.dtype
        ((24, 32, 3), dtype('float32'))
    """
    settings = {name: value for name, value in others.items() if name not in OF_RENDERERS}
    buffers = {name: value for name, value in others.items() if name in OF_RENDERERS}
    frame = Frame.from_numpy(color, layout=layout, albedo=albedo, normal=normal, depth=depth, extra=extra, **buffers)
    check_settings(
        model or DEFAULT, settings, also={*OF_RENDERERS, *inspect.signature(denoise).parameters}, of=Denoiser
    )
    denoiser = Denoiser(model, device=device, precision=precision, **settings)
    denoiser.reset(frames=1)
    image: NDArray[np.float32] = denoiser(frame)[0].cpu().numpy()
    # Raises an error for invalid values, which a GPU reports late.
    denoiser._settle()
    return _like(image, np.shape(color), layout)


def _like(image: NDArray[np.float32], shape: tuple[int, ...], layout: Layout) -> NDArray[np.float32]:
    """An image ``(3, H, W)`` in the shape and layout of the noisy one."""
    if len(shape) == 2 or shape[-1 if layout == "HWC" else 0] == 1:
        return np.ascontiguousarray(image.mean(0).reshape(shape))
    return np.ascontiguousarray(image if layout == "CHW" else image.transpose(1, 2, 0))
