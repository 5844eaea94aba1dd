"""Adapters that turn a module or function of images into a method."""

from __future__ import annotations

import inspect
from typing import Any

from torch import Tensor, nn

from mcdenoise.errors import InputError, MissingBufferError
from mcdenoise.frame import Frame
from mcdenoise.models._interface import Model, Needs, Output, State

CONTRACT = (
    "expected a model with `needs` that takes (frame, state) and returns (Output, state), or a module or function that "
    "takes tensors by the names of buffers (color, albedo, normal, depth, ...) and returns an image (B, 3, H, W)"
)


class FromBuffers(nn.Module):
    """A method without a state that wraps a function of images.

    Args:
        function: takes ``(B, C, H, W)`` tensors. The names of its parameters are the names of the buffers that it gets:
            those of :data:`mcdenoise.buffers.BUFFERS` or keys of ``Frame.extra``. A parameter with a default value is
            optional: it gets the buffer only if the frame has it. The function returns ``(B, 3, H, W)`` radiance or an
            :class:`mcdenoise.models.Output`.
        reach: see :class:`mcdenoise.models.Needs`.

    Raises:
        InputError: the function has no parameters that can be passed by name.
    """

    def __init__(self, function: Any, reach: int | None = None) -> None:
        super().__init__()
        self.function = function
        # What torch.compile makes of a module takes anything.
        call = getattr(function, "_orig_mod", function)
        call = call.forward if isinstance(call, nn.Module) else call
        required: set[str] = set()
        optional: set[str] = set()
        for parameter in inspect.signature(call).parameters.values():
            if parameter.kind in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD, parameter.POSITIONAL_ONLY):
                continue
            (required if parameter.default is parameter.empty else optional).add(parameter.name)
        if not required | optional or "frame" in required:
            raise InputError(f"model: {CONTRACT}; found {name_of_object(function)}{inspect.signature(call)}")
        trainable = isinstance(function, nn.Module) and any(True for _ in function.parameters())
        self.needs = Needs(frozenset(required), frozenset(optional), trainable, reach)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`.

        Raises:
            MissingBufferError: the frame lacks a buffer that the function takes.
        """
        if absent := self.needs.missing(frame):
            raise MissingBufferError(
                f"buffer '{absent[0]}': {name_of_object(self.function)} takes it, found only "
                f"{', '.join(sorted(frame.buffers))}; render it, or give that argument a default value"
            )
        named = {name: frame.buffer(name) for name in sorted(self.needs.buffers | self.needs.uses)}
        result = self.function(**{name: image for name, image in named.items() if image is not None})
        if isinstance(result, Output):
            return result, None
        if not isinstance(result, Tensor):
            raise InputError(f"model: {CONTRACT}; {name_of_object(self.function)} returned {type(result).__name__}")
        return Output(result), None


def as_model(thing: Any) -> Model:
    """Return a model unchanged, and wrap a module or function of images as one.

    Raises:
        InputError: the object is neither.
    """
    if isinstance(getattr(thing, "needs", None), Needs):
        model: Model = thing
        return model
    if isinstance(thing, type) or not callable(thing):
        found = f"the class {thing.__name__}" if isinstance(thing, type) else type(thing).__name__
        raise InputError(f"model: {CONTRACT}; found {found}")
    return FromBuffers(thing)


def name_of_object(thing: Any) -> str:
    """The name of a function, or of an object's class."""
    return str(getattr(thing, "__name__", type(thing).__name__))
