"""Denoised layers, such as diffuse and glossy light, that add up to the denoised image; and denoised alpha.

A method with kernels filters every layer with the kernels of the color. The filter is linear with non-negative weights,
so the filtered layers tell in which proportion they contribute to each pixel. The image is then split in these
proportions. The layers therefore sum to the image even if the method also took logarithms or clamped, and no layer
changes its sign.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.models._interface import Ask, Note, Output
from mcdenoise.nn.inputs import image_statistics, unit_features_of
from mcdenoise.ops import cross_bilateral_filter, downsample, upsample

# Name of the remainder: the part of the color that is in none of the given layers. No renderer uses this name.
REST = "(rest)"
# Falloffs of the weights with the squared differences of albedo, normal, depth in [0, 1] and the logarithm of the
# exposed image; and the weight of the coarse scale in a pixel that resembles its block. These values were the best of
# those tried on a Cycles shot with a reference for every layer (docs/layers.md).
_FALLOFFS, _COARSE = (10.0, 10.0, 1000.0, 20.0), 0.75
# Relative rounding error of a sum of half-precision layers. A smaller remainder is no layer of its own.
_ROUNDING, _SMALLEST_HALF = 2.0**-9, 2.0**-24
# What is darker than this fraction of the light of the image, or than this number, is black: it is what a filter with
# tiny weights leaves of its distant neighbours, and a derivative that is divided by it would overflow.
_BLACK, _LEAST = 1e-20, 1e-37
# Layers that are together brighter than the color by more than this fraction of all light are not its parts.
_MOST_EXCESS = 0.02


def carried(frame: Frame) -> Tensor | None:
    """Layers and alpha of a frame, concatenated ``(B, 3 L + 1, H, W)``, as far as they are requested.

    A method with kernels filters them like its color and passes the result to :func:`answered`. They need not be in the
    unit of the filtered color, since only their proportions count.
    """
    images = [*frame.layers.values(), *([] if (alpha := alpha_of(frame)) is None else [alpha])]
    return torch.cat(images, 1) if images else None


def with_carried(frame: Frame, image: Tensor | None = None) -> Tensor:
    """The color with :func:`carried` concatenated, ``(B, 3 + 3 L + 1, H, W)``: all channels that share the kernels.

    Args:
        frame: with layers and alpha, as far as they are requested.
        image: ``(B, 3, H, W)`` that takes the place of the color.
    """
    image, others = frame.color if image is None else image, carried(frame)
    return image if others is None else torch.cat([image, others.to(image.dtype)], 1)


def alpha_of(frame: Frame) -> Tensor | None:
    """The alpha of a frame if it should be denoised, else ``None``."""
    return frame.alpha if frame.hints.alpha else None


def answered(frame: Frame, image: Tensor, filtered: Tensor | None = None) -> Output:
    """Build a method's output from its image and the filtered :func:`carried` channels.

    Args:
        frame: the method's input.
        image: ``(B, 3, H, W)`` its result, or the filtered :func:`with_carried` with all its channels.
        filtered: ``(B, 3 L + 1, H, W)``; ``None`` if there were none or the method has no kernels.
    """
    if filtered is None and image.shape[1] > 3:
        image, filtered = image[:, :3], image[:, 3:]
    if filtered is None:
        return Output(image)
    parts = iter(filtered.split(3, 1))
    layers = {name: next(parts) for name in frame.layers}
    alpha = None if alpha_of(frame) is None else next(parts).clamp(0, 1)
    found = {"layers": bool(layers), "alpha": alpha is not None}
    notes = [Note(name, "filtered with the kernels of the color") for name, there in found.items() if there]
    return Output(image, layers=layers, alpha=alpha, notes=notes)


def completed(frame: Frame, output: Output) -> Output:
    """Add layers that sum to the image, and an alpha, to an output of a frame that has them.

    If the method returned no layers, the image is split by :func:`fractions`; if it returned no alpha, the frame's
    alpha is kept; the host removes its noise.
    """
    alpha = output.alpha
    if alpha is None and alpha_of(frame) is not None:
        alpha = frame.alpha
        output = _noted_once(output, Note("alpha", "the method has no kernels: filtered by its own noise"))
    if not frame.layers:
        return output._replace(alpha=alpha)
    parts = output.layers
    if not parts:
        output = _noted_once(output, Note("layers", "the image is split by their fractions: the method has no kernels"))
        parts = fractions(frame, output.image)
    return output._replace(layers=split(output.image, parts), alpha=alpha)


def split(image: Tensor, parts: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Split an image into parts of given proportions, which sum to it: ``image * part / sum of parts``.

    In a pixel where all parts are black, the proportions of the whole image are used; if all parts are black
    everywhere, they are equal.

    Args:
        image: ``(B, 3, H, W)``.
        parts: ``(B, 3, H, W)`` each, by name; negative values count as 0.
    """
    positive = {name: part.to(image.dtype).clamp_min(0) for name, part in parts.items()}
    total = functools.reduce(torch.add, positive.values())
    means = {name: part.mean((2, 3), keepdim=True) for name, part in positive.items()}
    all_light = functools.reduce(torch.add, means.values())
    some, any_light = total > (_BLACK * all_light).clamp_min(_LEAST), all_light > 0
    total, all_light = torch.where(some, total, 1), torch.where(any_light, all_light, 1)
    equal = len(parts) - (REST in parts)
    proportions = {
        name: torch.where(any_light, mean / all_light, 0 if name == REST and equal else 1 / max(equal, 1))
        for name, mean in means.items()
    }
    return {name: image * torch.where(some, part / total, proportions[name]) for name, part in positive.items()}


def fractions(frame: Frame, image: Tensor) -> Mapping[str, Tensor]:
    """Estimate the proportions of a frame's layers in an image from a method without kernels.

    A cross-bilateral filter of 5x5 pixels smooths the layers, after a filter at half the resolution that dominates in
    pixels that resemble their block. Guides are the features and the logarithm of the denoised image, which has no
    noise.

    Args:
        frame: with layers, as noisy as its color.
        image: ``(B, 3, H, W)`` the method's result for the color.

    Returns:
        ``(B, 3, H, W)`` for each layer: weighted means of its pixels.
    """
    logarithm = torch.log1p(image.clamp_min(0) * image_statistics(frame)["exposure"])
    features = zip((*unit_features_of(frame), logarithm), _FALLOFFS, strict=True)
    guide = torch.cat([feature.to(logarithm.dtype) * falloff**0.5 for feature, falloff in features], 1)
    fine = torch.cat(list(frame.layers.values()), 1)
    half = downsample(guide)
    coarse = upsample(_smoothed(downsample(fine), half), frame.size)
    alike = torch.exp(-(guide - upsample(half, frame.size)).square().sum(1, keepdim=True))
    smooth = _smoothed(torch.lerp(fine, coarse, _COARSE * alike.to(fine.dtype)), guide)
    return dict(zip(frame.layers, smooth.split(3, 1), strict=True))


def _smoothed(image: Tensor, guide: Tensor) -> Tensor:
    logits = guide.new_zeros(()).expand(guide.shape[0], 25, *guide.shape[2:])
    scale = guide.new_ones(()).expand(guide.shape[0], 1, *guide.shape[2:])
    return cross_bilateral_filter(image, logits, [guide], [scale], border="renormalize")


def closed(frame: Frame, ask: Ask) -> Frame:
    """The frame with layers that sum to its color: the remainder is added as the layer :data:`REST`.

    Half precision rounds every layer separately. Where the layers are together brighter than the color, they are scaled
    to it; so they are everywhere if the remainder is within the rounding error.

    Args:
        frame: with valid values.
        ask: what the host asks a device for values by.

    Raises:
        InputError: the layers are brighter than the color by more than that, so they are not its parts.
    """
    if not frame.layers:
        return frame
    total = functools.reduce(torch.add, frame.layers.values())
    excess = (total - frame.color).clamp_min(0).mean() / total.mean().clamp_min(1e-30)
    names = ", ".join(frame.layers)

    def refuse(excess: Sequence[float]) -> None:
        if excess[0] > _MOST_EXCESS:
            raise InputError(
                f"layers: expected parts of the color, found {names} brighter than it together, by {excess[0]:.0%} of "
                "their light; give only layers that are a part of it"
            )

    ask(excess, refuse)
    rest = frame.color - total
    # A whole image of such small numbers is in a large unit, and was not rounded to them.
    small = _ROUNDING * frame.color.mean((1, 2, 3), keepdim=True)
    least = _ROUNDING * frame.color + small.clamp_max((len(frame.layers) + 1) * _SMALLEST_HALF)
    # Decide for the whole image: a layer that is dim in some pixels is a layer all the same.
    whole = (rest < 0) | ((rest <= least).all() & (total > 0))
    scale = torch.where(whole, frame.color / torch.where(whole, total, 1), 1)
    layers = {name: layer * scale for name, layer in frame.layers.items()}
    return frame.replace(layers=layers | {REST: torch.where((rest <= least).all(), 0, rest.clamp_min(0))})


def opened(output: Output) -> Output:
    """The output without :data:`REST`."""
    return output._replace(layers={name: layer for name, layer in output.layers.items() if name != REST})


def _noted_once(output: Output, note: Note) -> Output:
    """The output with a note, unless the method has one of this name itself."""
    return output if any(each.name == note.name for each in output.notes) else output.noted(note)
