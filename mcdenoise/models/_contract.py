"""What a host asks of a method that may be anybody's: a pair of an image of the frame and a state of tensors."""

from __future__ import annotations

import functools
from collections.abc import Collection, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from mcdenoise.errors import InputError, MissingBufferError
from mcdenoise.frame import Frame
from mcdenoise.models._interface import Model, Needs, Output, State
from mcdenoise.models._journal import ask
from mcdenoise.models._reads import at_hand
from mcdenoise.models._registry import build_model, find_model, list_models
from mcdenoise.models._weights import pretrained_models


def checked_step(model: Model, frame: Frame, state: State, shape: tuple[int, ...]) -> tuple[Output, State]:
    """Call a method, and refuse what is no image of the frame, or no state.

    Args:
        model: any method.
        frame: valid.
        state: of the frame before.
        shape: of that frame's color.

    Raises:
        InputError: the result breaks the contract of :class:`mcdenoise.models.Model`, is not finite, or the method
            fails with a state that is of frames of another size.
    """
    try:
        found: Any = model(frame, state)
    except InputError:
        raise
    except Exception as error:
        if state is None or shape == tuple(frame.color.shape):
            raise
        raise InputError(
            f"model: the state is of frames of {shape}, found one of {tuple(frame.color.shape)}, with which the model "
            f"fails; reset the denoiser: {' '.join(str(error).split())}"
        ) from error
    # An Output is a pair, too.
    if isinstance(found, Output) or not (isinstance(found, tuple) and len(found) == 2):
        raise InputError(f"model: expected a pair (Output, state), found {type(found).__name__}")
    output, after = found
    _check_image(output, frame)
    _check_layers(output, frame)
    _check_state(state, after, frame)
    return output, after


def absent_buffers(model: Model, frame: Frame) -> list[str]:
    """Buffers that a method is better with and the frame has not, sorted.

    Raises:
        MissingBufferError: the frame lacks one that the method needs.
    """
    needs = model.needs
    check_needs(needs, frame.buffers)
    missing = needs.uses - frame.buffers - {"previous_position", "position", "view_projection"}
    return sorted(missing - ({"motion"} if {"position", "view_projection"} <= frame.buffers else frozenset()))


def check_needs(needs: Needs, given: Collection[str]) -> None:
    """See that a frame has what a method cannot do without.

    Args:
        needs: of the method.
        given: names of the buffers of the frame.

    Raises:
        MissingBufferError: it has not; the message says what is missing, and which methods would do.
    """
    if needs.buffers <= set(given):
        return
    absent, found = sorted(needs.buffers - set(given)), ", ".join(sorted(given))
    what, it = ("buffer", "it") if len(absent) == 1 else ("buffers", "them")
    others = ", ".join(name for name, wanted in _ready().items() if wanted <= set(given))
    instead = f"a model that does without: {others}" if others else "another model, see `mcdenoise models`"
    raise MissingBufferError(
        f"{what} {', '.join(map(repr, absent))}: the model needs {it}, found only {found or 'none'}; render {it}, or "
        f"take {instead}"
    )


@functools.cache
def _ready() -> dict[str, frozenset[str]]:
    """What each method needs that can be had at once: with weights, or without any to be trained."""
    found = {}
    shipped = pretrained_models()
    # Networks are drawn at random, which must not show in what the caller draws.
    with torch.random.fork_rng(devices=[]):
        for name in list_models():
            try:
                needs = build_model(name).needs if find_model(name).installed else None
            except Exception:  # whatever another package's model fails with: it is not offered
                continue
            # What reaches no other pixel does not denoise.
            if needs is not None and needs.reach != 0 and (name in shipped or not needs.trainable):
                found[name] = needs.buffers
    return found


def owned(tree: Any, others: Any) -> Any:
    """A tree of ordinary tensors, each with memory of its own.

    Copied is what shares memory with others, what could not be written to element by element, and what was made in
    inference mode, of which torch lets nothing be changed or differentiated outside that mode.
    """
    taken = {leaf.untyped_storage().data_ptr() for leaf in pytree.tree_leaves(others) if isinstance(leaf, Tensor)}

    def own(tensor: Tensor) -> Tensor:
        expanded = any(not step and size > 1 for step, size in zip(tensor.stride(), tensor.shape, strict=True))
        sealed = tensor.is_inference() and not torch.is_inference_mode_enabled()
        if not (expanded or sealed or tensor.untyped_storage().data_ptr() in taken):
            return tensor
        return tensor.clone(memory_format=torch.contiguous_format if expanded else torch.preserve_format)

    return pytree.tree_map_only(Tensor, own, tree)


def _check_image(output: Any, frame: Frame) -> None:
    image = output.image if isinstance(output, Output) else None
    if not isinstance(image, Tensor) or image.shape != frame.color.shape:
        found = type(output).__name__ if not isinstance(image, Tensor) else f"an image of {tuple(image.shape)}"
        raise InputError(f"model: expected an Output with an image of {tuple(frame.color.shape)}, found {found}")
    if not image.is_floating_point():
        raise InputError(f"model: expected a floating-point image, found {image.dtype}")
    if image.device != frame.color.device:
        raise InputError(f"model: expected an image on {frame.color.device}, found one on {image.device}")
    # A sum is the fastest way to see either, and only what is far beyond all radiance overflows it.
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
    """Whether two states have the same structure; what is not there is like anything."""
    if a is None or b is None:
        return True
    children, spec = pytree.tree_flatten(a, is_leaf=lambda x: x is not a)
    others, other = pytree.tree_flatten(b, is_leaf=lambda x: x is not b)
    if isinstance(a, Tensor) or isinstance(b, Tensor):
        return isinstance(a, Tensor) and isinstance(b, Tensor) and a.ndim == b.ndim
    return spec == other and all(_alike(*pair) for pair in zip(children, others, strict=True))
