"""Void pixels, which hold no light: filled before a method sees a frame, and as they were after it; and straight light.

Around the charts of a lightmap, and behind everything of a transparent film, pixels are black because nothing is there.
A filter would take that for darkness, and a network for an edge. So void pixels show the mirror image of what is beside
them, in every buffer, and get their own values back at the end.

A color is multiplied by its alpha, so the two are one pair: where one is blurred and the other is not, their ratio, the
color of the surface at a rim, is wrong. So where alpha is wanted too, a method sees light divided by alpha.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.frame import Frame
from mcdenoise.models._alpha import noise_of_alpha, without_noise
from mcdenoise.models._interface import Output, at_hand
from mcdenoise.models.exposed import scaled

# Where more than this fraction of the light is in pixels of alpha 0 (a glow), alpha does not say where light can be.
_GLOW = 1e-3
# Smallest alpha to divide by.
_LEAST = 1e-3
# Side of the window of pixels that are partly covered in which alpha is no edge.
_RAMP = 5
# Name of the buffer with the number of each pixel's chart. No renderer uses this name.
ISLAND = "(island)"
# Buffers that are not filled: they are no picture, or are not denoised.
_KEPT = frozenset({"alpha", "mask", "reference", "length", "view_projection"})


class Void(NamedTuple):
    """What :func:`with_void` needs to give void pixels their values back.

    Args:
        mask: ``(B, 1, H, W)`` bool: void pixels; ``None`` if there is none.
        divided: ``(B, 1, 1, 1)`` bool: whether the light was divided by alpha; ``None`` if none was.
    """

    mask: Tensor | None = None
    divided: Tensor | None = None


def without_void(frame: Frame) -> tuple[Frame, Void]:
    """Fill the void pixels of a frame, and divide its light by alpha if that is to be denoised.

    Pixels are void where ``mask`` is 0; where alpha and color are 0; or, in a frame without mask, alpha, motion and
    camera, where the depth is infinite and the color 0. Alpha and depth only count if no more than a thousandth of the
    light is where they say that nothing is. In a frame with motion or camera, a few pixels are no void: the only path
    of a pixel may miss hair that covers half of it.

    In a frame without motion and camera, in which no pixel is partly covered, connected pixels that are not void are a
    chart. The numbers of charts are a buffer of their own, :data:`ISLAND`, for methods that compare features.

    Args:
        frame: as a renderer wrote it, its values unchecked.

    Returns:
        The frame without a mask, and what :func:`with_void` needs.
    """
    color, alpha, depth, known = frame.color, frame.alpha, frame.depth, at_hand(frame.color.device)
    void = None if frame.mask is None else frame.mask <= 0
    chart = known and frame.motion is None and frame.view_projection is None
    # Not on a GPU, where nearly every frame would be filled without need.
    nothing = None if alpha is None else alpha <= 0
    if chart and alpha is None and void is None and depth is not None:
        nothing = depth.isposinf()
    frame, divided = frame.replace(mask=None), None
    if nothing is not None:
        covers = _covers(color, nothing)
        empty = nothing & (color == 0).all(1, keepdim=True) & covers
        # Where alpha is wanted, too, such pixels are filled, and weighed by it at the end.
        if not chart and not frame.hints.alpha and not (known and not empty.any()):
            inside = F.max_pool2d((~empty).to(color.dtype), 3, 1, 1) <= 0
            empty = empty & (F.max_pool2d(inside.to(color.dtype), 5, 1, 2) > 0)
        void = empty if void is None else void | empty
        if alpha is not None and frame.hints.alpha:
            divided = covers
            frame = _divided(frame, torch.where(covers, alpha.clamp(_LEAST, 1.0), 1))
    if void is None or (known and not void.any()):
        return frame, Void(None, divided)
    source = _mirrored(void)

    def fill(image: Tensor) -> Tensor:
        flat = image.flatten(1, -3).flatten(2)
        return flat.gather(2, source.expand(-1, flat.shape[1], -1)).reshape(image.shape)

    if chart and (alpha is None or not ((alpha > 0) & (alpha < 1)).any()):
        frame = frame.replace(extra={**frame.extra, ISLAND: _islands(~void).to(color.dtype)})
    kept = {name: image for name, image in frame.items() if name in _KEPT}
    return frame.replace(**dict.fromkeys(kept)).map(fill).replace(**kept), Void(void, divided)


def with_void(output: Output, frame: Frame, void: Void) -> Output:
    """The output with the light in the unit of the given frame, and with its void pixels as they were.

    An alpha that was filtered is used inside of wide ramps; at an edge it is the frame's own, without its noise: the
    light that guided the filter is that of the surface, and does not tell where the surface ends. An alpha without
    noise stays.

    Args:
        output: of the frame without void.
        frame: as it was given.
        void: result of :func:`without_void`.
    """
    alpha, mask = frame.alpha, void.mask
    if alpha is not None and output.alpha is not None:
        after = _alpha(alpha, output.alpha)
        if frame.mask is not None:
            after = torch.where(frame.mask <= 0, alpha, after)
        output = output._replace(alpha=after)
        if void.divided is not None:
            # A glow where no surface is keeps its light.
            surface = (alpha > 0) if mask is None else (alpha > 0) | mask
            multiplier = torch.where(surface, after, alpha).clamp(_LEAST, 1.0)
            multiplier = torch.where(void.divided, multiplier, 1)
            shape = output.image.shape
            output = output.lit(lambda image: image * multiplier if image.shape == shape else image)
            # A pixel that only noise left empty has the light of the surface.
            mask = None if mask is None else mask & ((after <= 0) | (alpha > 0))
    if mask is None:
        return output

    def given(image: Tensor) -> Tensor:
        return torch.where(torch.isfinite(image), image, 0).clamp_min(0).to(output.image.dtype)

    layers = {
        name: torch.where(mask, given(frame.layers[name]) if name in frame.layers else 0, layer)
        for name, layer in output.layers.items()
    }
    return output._replace(image=torch.where(mask, given(frame.color), output.image), layers=layers)


def _alpha(alpha: Tensor, filtered: Tensor) -> Tensor:
    """The alpha of the output: that of the frame, and that of the method within ramps, without noise."""
    noise = noise_of_alpha(alpha)
    if at_hand(alpha.device) and not noise.any():
        return alpha
    own = without_noise(alpha, noise)
    if filtered is not alpha:
        filtered = without_noise(filtered.to(alpha.dtype), noise_of_alpha(filtered.to(alpha.dtype)))
        partly = ((alpha <= 0) | (alpha >= 1)).to(alpha.dtype)
        edge = F.max_pool2d(partly, _RAMP, 1, _RAMP // 2) > 0
        own = torch.where(edge | (noise <= 0), own, filtered)
    return own


def _covers(color: Tensor, nothing: Tensor) -> Tensor:
    """``(B, 1, 1, 1)``: whether (almost) no light is where nothing is."""
    light = torch.where(torch.isfinite(color), color, 0).abs().sum(1, keepdim=True)
    outside, everywhere = (each.sum((2, 3), keepdim=True) for each in (torch.where(nothing, light, 0), light))
    return outside <= _GLOW * everywhere


def _divided(frame: Frame, alpha: Tensor) -> Frame:
    """The frame with straight light: not multiplied by its alpha."""
    changes: dict[str, Any] = {}
    for name in ("albedo", "specular_albedo"):
        if (albedo := frame.buffer(name)) is not None:
            # A renderer's albedo is a mean over the pixel too.
            changes[name] = torch.where(alpha < 1, (albedo / alpha).clamp_max(1), albedo)
    return scaled(frame, 1 / alpha).replace(**changes)


def _mirrored(void: Tensor) -> Tensor:
    """``(B, 1, H W)``: for each pixel the one whose values it takes.

    That of a void pixel is its mirror image at the nearest pixel that is not, in its row or column. A second round is
    for pixels whose row and column are void.
    """
    batch, _, height, width = void.shape
    source = torch.arange(height * width, device=void.device).expand(batch, -1)
    known = ~void[:, 0]
    for _ in range(2):
        nearest = torch.full_like(known, height + width, dtype=torch.int64)
        found = source.reshape(batch, height, width)
        whole = found
        for axis in (1, 2):
            size = known.shape[axis]
            place = torch.arange(size, device=void.device).reshape([-1, 1] if axis == 1 else [1, -1])
            for sign in (1, -1):
                # The last known place before each, or the next one after it, and the same distance beyond.
                far = torch.where(known, sign * place, -2 * size)
                last = far.cummax(axis).values if sign == 1 else far.flip(axis).cummax(axis).values.flip(axis)
                last = sign * last
                distance = (place - last).abs()
                beyond = (2 * last + sign - place).clamp(0, size - 1)
                there = known.gather(axis, beyond)
                moved = whole.gather(axis, torch.where(there, beyond, last.clamp(0, size - 1)))
                closer = (distance < nearest) & (last >= 0) & (last < size)
                nearest, found = torch.where(closer, distance, nearest), torch.where(closer, moved, found)
        source = torch.where(known, whole, found).flatten(1)
        known = known | (nearest < height + width)
    return source[:, None]


def _islands(known: Tensor) -> Tensor:
    """The number of the group of connected pixels, of those that are known, in which each is; 0 for the others."""
    pixels = known[0].numel()
    # Integers are exact, and floats can be pooled.
    number = torch.arange(1, pixels + 1, dtype=torch.float64, device=known.device).reshape(known[:1].shape) * known
    while True:
        largest = (F.max_pool2d(number, 3, 1, 1) * known).flatten(1)
        # The pixel with that number may have seen a larger one: so a long group needs few rounds.
        after = largest.gather(1, (largest.long() - 1).clamp_min(0)).reshape(known.shape) * known
        if torch.equal(after, number):
            _, place = torch.unique(number, return_inverse=True)
            return torch.as_tensor(place).reshape(known.shape)
        number = after
