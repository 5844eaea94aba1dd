"""Layers, such as diffuse and glossy light, that still add up to the image after it was denoised; and alpha.

A method with kernels filters every layer with those of the color: a linear map of non-negative weights, so that what it
makes of the layers tells in which proportion they are in each pixel. The image is then split in this proportion. So the
layers sum to it whatever happened to it besides (logarithms, clamping), and none of them changes its sign.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.models._interface import Output
from mcdenoise.models._journal import ask, journal, note
from mcdenoise.nn.inputs import image_statistics, unit_features_of
from mcdenoise.ops import cross_bilateral_filter, downsample, upsample

# What is in none of the layers that were asked for; a name that nobody gives to a layer.
REST = "(rest)"
# How fast weights fall off with the squared difference of albedo, normal and depth in [0, 1], and of the logarithm of
# the exposed image; and the weight of the coarse scale in a pixel like its block. Of what was tried on a Cycles shot
# with references of every layer these were the best (docs/layers.md).
_FALLOFFS, _COARSE = (10.0, 10.0, 1000.0, 20.0), 0.75
# Of a pixel: what half floats leave of a sum that they round. Less is no layer of its own.
_ROUNDING, _SMALLEST_HALF = 2.0**-9, 2.0**-24
# Of all light: layers that are brighter than the color together by more than this are not its parts.
_MOST_EXCESS = 0.02


def carried(frame: Frame) -> Tensor | None:
    """Layers and alpha of a frame side by side ``(B, 3 L + 1, H, W)``, as far as they are asked for.

    For a method with kernels, which filters them as its color and hands the result to :func:`answered`; they need not
    be in the unit of what it filters otherwise, since only their proportions count.
    """
    images = [*frame.layers.values(), *([] if (alpha := alpha_of(frame)) is None else [alpha])]
    return torch.cat(images, 1) if images else None


def with_carried(frame: Frame) -> Tensor:
    """The color with :func:`carried` behind it, ``(B, 3 + 3 L + 1, H, W)``: what goes through the same kernels."""
    others = carried(frame)
    return frame.color if others is None else torch.cat([frame.color, others], 1)


def alpha_of(frame: Frame) -> Tensor | None:
    """The alpha of a frame if it is to be denoised."""
    return frame.alpha if frame.hints.alpha else None


def answered(frame: Frame, image: Tensor, filtered: Tensor | None = None) -> Output:
    """A method's output with what its kernels made of :func:`carried`.

    Args:
        frame: that the method was given.
        image: ``(B, 3, H, W)`` its result; or that of :func:`with_carried`, which has the next behind it.
        filtered: ``(B, 3 L + 1, H, W)``; ``None`` where nothing was carried, or there was no kernel for it.
    """
    if filtered is None and image.shape[1] > 3:
        image, filtered = image[:, :3], image[:, 3:]
    if filtered is None:
        return Output(image)
    parts = iter(filtered.split(3, 1))
    layers = {name: next(parts) for name in frame.layers}
    alpha = None if alpha_of(frame) is None else next(parts).clamp(0, 1)
    for name, found in (("layers", bool(layers)), ("alpha", alpha is not None)):
        if found:
            note(name, "filtered with the kernels of the color")
    return Output(image, layers=layers, alpha=alpha)


def completed(frame: Frame, output: Output) -> Output:
    """The output of a method with layers that sum to its image, and with an alpha, if there are any in its frame.

    A method that answers without layers has its image split by :func:`fractions`, and one without an alpha keeps the
    frame's.
    """
    alpha = output.alpha
    if alpha is None and alpha_of(frame) is not None:
        alpha = frame.alpha
        _note_once("alpha", "kept: the method has no kernels")
    if not frame.layers:
        return output._replace(alpha=alpha)
    parts = output.layers
    if not parts:
        _note_once("layers", "the image is split by their fractions: the method has no kernels")
        parts = fractions(frame, output.image)
    return output._replace(layers=split(output.image, parts), alpha=alpha)


def split(image: Tensor, parts: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """An image in parts of given proportions, which sum to it: each is ``image * part / sum of parts``.

    Where all parts are black they have the proportion that they have in the whole of the image; where all are black
    everywhere they are equal.

    Args:
        image: ``(B, 3, H, W)``.
        parts: likewise, by name; what is below zero counts as black.
    """
    positive = {name: part.to(image.dtype).clamp_min(0) for name, part in parts.items()}
    total = _sum(positive)
    means = {name: part.mean((2, 3), keepdim=True) for name, part in positive.items()}
    all_light = _sum(means)
    some, any_light = total > 0, all_light > 0
    total, all_light = torch.where(some, total, 1), torch.where(any_light, all_light, 1)
    equal = len(parts) - (REST in parts)
    shares = {
        name: torch.where(any_light, mean / all_light, 0 if name == REST and equal else 1 / max(equal, 1))
        for name, mean in means.items()
    }
    return {name: image * torch.where(some, part / total, shares[name]) for name, part in positive.items()}


def fractions(frame: Frame, image: Tensor) -> Mapping[str, Tensor]:
    """In which proportion the layers of a frame are in an image that a method without kernels made of it.

    A cross-bilateral filter of 5x5 pixels, after another one at half the resolution that stands for most of a pixel
    that is like its block; guided by the features and by the logarithm of the image itself, which has no noise.

    Args:
        frame: with layers, noisy as its color.
        image: ``(B, 3, H, W)`` what the method made of the color.

    Returns:
        ``(B, 3, H, W)`` of each layer, means of its pixels.
    """
    frame = frame.replace(statistics={**frame.statistics, **image_statistics(frame)})
    logarithm = torch.log1p(image.clamp_min(0) * frame.statistics["exposure"])
    features = zip((*unit_features_of(frame), logarithm), _FALLOFFS, strict=True)
    guide = torch.cat([feature.to(logarithm.dtype) * falloff**0.5 for feature, falloff in features], 1)
    fine = torch.cat(list(frame.layers.values()), 1)
    half = downsample(guide)
    coarse = upsample(_smoothed(downsample(fine), half), frame.size)
    alike = torch.exp(-(guide - upsample(half, frame.size)).square().sum(1, keepdim=True))
    smooth = _smoothed(torch.lerp(fine, coarse, _COARSE * alike.to(fine.dtype)), guide)
    return dict(zip(frame.layers, smooth.split(3, 1), strict=True))


def _smoothed(image: Tensor, guide: Tensor) -> Tensor:
    logits = guide.new_zeros(()).expand(len(guide), 25, *guide.shape[2:])
    scale = guide.new_ones(()).expand(len(guide), 1, *guide.shape[2:])
    return cross_bilateral_filter(image, logits, [guide], [scale], border="renormalize")


def closed(frame: Frame) -> Frame:
    """The frame with all of its color in layers: what is in none of them is one more, :data:`REST`.

    Half floats round every layer by itself. Where layers are brighter together than the color they are scaled to it,
    and everywhere if they lack no more than rounding takes.

    Raises:
        InputError: they are brighter by more than that: parts of something else.
    """
    if not frame.layers:
        return frame
    total = _sum(frame.layers)
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
    least = _ROUNDING * frame.color + (len(frame.layers) + 1) * _SMALLEST_HALF
    # Of all pixels or none: what is dim in some is a layer all the same.
    whole = (rest < 0) | ((rest <= least).all() & (total > 0))
    scale = torch.where(whole, frame.color / torch.where(whole, total, 1), 1)
    layers = {name: layer * scale for name, layer in frame.layers.items()}
    return frame.replace(layers=layers | {REST: torch.where((rest <= least).all(), 0, rest.clamp_min(0))})


def opened(output: Output) -> Output:
    """The output without :data:`REST`."""
    return output._replace(layers={name: layer for name, layer in output.layers.items() if name != REST})


def _sum(parts: Mapping[str, Tensor]) -> Tensor:
    first, *others = parts.values()
    for other in others:
        first = first + other
    return first


def _note_once(name: str, reason: str) -> None:
    """What a method has said of itself counts for more."""
    if (found := journal()) is not None and name not in found.stages:
        note(name, reason)
