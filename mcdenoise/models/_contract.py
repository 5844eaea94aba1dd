"""Checks of what a method receives and returns; the method may be a user's own."""

from __future__ import annotations

import functools
from collections.abc import Collection, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from mcdenoise.buffers import BUFFERS, MATRIX
from mcdenoise.errors import InputError, MissingBufferError, in_one_line
from mcdenoise.frame import Frame
from mcdenoise.models._interface import Ask, Model, Needs, Output, State, at_hand
from mcdenoise.models._registry import needs_of_models
from mcdenoise.models._weights import pretrained_models


def checked_step(model: Model, frame: Frame, state: State, shape: tuple[int, ...], ask: Ask) -> tuple[Output, State]:
    """Call a method, and reject a result that is not an image of the frame with a state of tensors.

    Args:
        model: any method.
        frame: with valid values.
        state: the state after the previous frame.
        shape: shape of the color of that previous frame.
        ask: what the host asks a device for values by.

    Raises:
        InputError: the result breaks the contract of :class:`mcdenoise.models.Model` or is not finite, or the method
            fails with a state that belongs to frames of another size.
    """
    try:
        found: Any = model(frame, state)
    except InputError:
        raise
    except SystemExit as error:
        raise InputError(f"model: expected an image, found that {in_one_line(error)}") from error
    except Exception as error:
        if state is None or shape == tuple(frame.color.shape):
            raise
        raise InputError(
            f"model: the state is of frames of {shape}, found one of {tuple(frame.color.shape)}, with which the model "
            f"fails; reset the denoiser: {' '.join(str(error).split())}"
        ) from error
    # An Output is a tuple of its own, and must not be mistaken for the pair (Output, state).
    if isinstance(found, Output) or not (isinstance(found, tuple) and len(found) == 2):
        raise InputError(f"model: expected a pair (Output, state), found {type(found).__name__}")
    output, after = found
    _check_image(output, frame, ask)
    _check_layers(output, frame)
    _check_state(state, after, frame)
    return output, after


def absent_buffers(model: Model, frame: Frame) -> list[str]:
    """Sorted names of the buffers that would improve a method's result and that the frame lacks.

    Raises:
        MissingBufferError: the frame lacks a required buffer.
    """
    needs = model.needs
    check_needs(needs, frame.buffers)
    missing = needs.uses - frame.buffers - {"previous_position", "position", "view_projection"}
    return sorted(missing - ({"motion"} if {"position", "view_projection"} <= frame.buffers else frozenset()))


def check_needs(needs: Needs, given: Collection[str]) -> None:
    """Check that a frame has all required buffers.

    Args:
        needs: the needs of the method.
        given: names of the frame's buffers.

    Raises:
        MissingBufferError: a buffer is missing; the message names it, and the methods that do not need it.
    """
    if needs.buffers <= set(given):
        return
    absent, found = sorted(needs.buffers - set(given)), ", ".join(sorted(given))
    if strange := [name for name in absent if name not in BUFFERS and name != MATRIX]:
        raise MissingBufferError(
            f"buffer '{strange[0]}': expected arguments with the names of buffers (color, albedo, normal, ...), "
            f"found '{strange[0]}'; rename the argument, or give frames such a buffer in `extra`"
        )
    what, it = ("buffer", "it") if len(absent) == 1 else ("buffers", "them")
    others = ", ".join(name for name, wanted in _ready().items() if wanted <= set(given))
    instead = f"a model that does without: {others}" if others else "another model, see `mcdenoise models`"
    raise MissingBufferError(
        f"{what} {', '.join(map(repr, absent))}: the model needs {it}, found only {found or 'none'}; render {it}, or "
        f"take {instead}"
    )


@functools.cache
def _ready() -> dict[str, frozenset[str]]:
    """The needs of every method that is ready to use: one with shipped weights, or one that needs no training."""
    shipped = pretrained_models()
    # A method that reads only the pixel itself does not denoise.
    return {
        name: needs.buffers
        for name, needs in needs_of_models().items()
        if needs.reach != 0 and (name in shipped or not needs.trainable)
    }


def owned(tree: Any, others: Any) -> Any:
    """Copy tensors of a tree where needed, so that each is an ordinary tensor with its own memory.

    A tensor is copied if it shares memory with ``others``, if it is an expanded view that cannot be written to element
    by element, or if it was created in inference mode, because torch allows neither in-place changes nor derivatives of
    such a tensor outside that mode.
    """
    taken = {leaf.untyped_storage().data_ptr() for leaf in pytree.tree_leaves(others) if isinstance(leaf, Tensor)}

    def own(tensor: Tensor) -> Tensor:
        expanded = any(not step and size > 1 for step, size in zip(tensor.stride(), tensor.shape, strict=True))
        sealed = tensor.is_inference() and not torch.is_inference_mode_enabled()
        if not (expanded or sealed or tensor.untyped_storage().data_ptr() in taken):
            return tensor
        return tensor.clone(memory_format=torch.contiguous_format if expanded else torch.preserve_format)

    return pytree.tree_map_only(Tensor, own, tree)


def _check_image(output: Any, frame: Frame, ask: Ask) -> None:
    image = output.image if isinstance(output, Output) else None
    if not isinstance(image, Tensor) or image.shape != frame.color.shape:
        found = type(output).__name__ if not isinstance(image, Tensor) else f"an image of {tuple(image.shape)}"
        raise InputError(f"model: expected an Output with an image of {tuple(frame.color.shape)}, found {found}")
    if not image.is_floating_point():
        raise InputError(f"model: expected a floating-point image, found {image.dtype}")
    if image.device != frame.color.device:
        raise InputError(f"model: expected an image on {frame.color.device}, found one on {image.device}")
    # One sum detects NaN and infinity fastest; only values far beyond any radiance could overflow it.
    if not at_hand(image.device) or not image.detach().sum().isfinite():
        ask((~image.detach().isfinite()).any(1).sum(), _refuse_pixels)


def _refuse_pixels(broken: Sequence[float]) -> None:
    if broken[0]:
        raise InputError(
            f"model: expected finite radiance, found {int(broken[0])} NaN or infinite pixels; the frame is not kept: "
            "check the buffers for values far out of range and the network for weights that are"
        )


def _check_layers(output: Output, frame: Frame) -> None:
    alpha = () if output.alpha is None else (("alpha", output.alpha, frame.color[:, :1].shape),)
    for name, layer, shape in (*((key, each, frame.color.shape) for key, each in output.layers.items()), *alpha):
        if not isinstance(layer, Tensor) or layer.shape != shape or not layer.is_floating_point():
            found = f"{layer.dtype} {tuple(layer.shape)}" if isinstance(layer, Tensor) else type(layer).__name__
            raise InputError(f"model: expected {name} as floating-point {tuple(shape)}, found {found}")
    if output.layers and output.layers.keys() != frame.layers.keys():
        raise InputError(
            f"model: expected the layers {', '.join(frame.layers) or 'none'}, found {', '.join(output.layers)}"
        )


def _check_state(before: State, state: State, frame: Frame) -> None:
    for leaf in pytree.tree_leaves(state):
        if leaf is not None and not isinstance(leaf, Tensor):
            raise InputError(f"model: expected a state of tensors, found {type(leaf).__name__} in it")
        if leaf is not None and leaf.device != frame.color.device:
            raise InputError(f"model: expected a state on {frame.color.device}, found {leaf.device} in it")
    if before is not None and not _alike(before, state):
        raise InputError("model: expected a state of the same structure as for the frame before, found another")


def _alike(a: State, b: State) -> bool:
    """Whether two states have the same structure; ``None`` matches anything."""
    if a is None or b is None:
        return True
    children, spec = pytree.tree_flatten(a, is_leaf=lambda x: x is not a)
    others, other = pytree.tree_flatten(b, is_leaf=lambda x: x is not b)
    if isinstance(a, Tensor) or isinstance(b, Tensor):
        return isinstance(a, Tensor) and isinstance(b, Tensor) and a.ndim == b.ndim
    return spec == other and all(_alike(*pair) for pair in zip(children, others, strict=True))
