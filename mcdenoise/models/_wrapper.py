"""Models that contain a model or a function: adapters of images, and the base of wrappers; and what is inside them."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, ClassVar, TypeVar

from torch import Tensor, nn

from mcdenoise.errors import InputError, MissingBufferError
from mcdenoise.frame import Frame
from mcdenoise.models._interface import Model, Needs, Output, State

_Wanted = TypeVar("_Wanted")
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


class Wrapper(nn.Module):
    """Contains another model, and changes its input or output.

    Args:
        inner: any :class:`mcdenoise.models.Model`, or a module or function of images, see
            :class:`FromBuffers`.
    """

    inner: Model
    # Under which name the report has the run time of what a wrapper does itself.
    stage: ClassVar[str] = "network"
    # Buffers that it uses itself, those that it makes for the method inside, and whether it looks at the whole image.
    takes: ClassVar[frozenset[str]] = frozenset()
    gives: ClassVar[frozenset[str]] = frozenset()
    whole: ClassVar[bool] = False

    def __init__(self, inner: Model) -> None:
        super().__init__()
        self.inner = as_model(inner)

    @property
    def needs(self) -> Needs:
        """The needs of the inner model, but for the buffers made here, and what the wrapper uses itself."""
        needs = self.inner.needs
        uses, reach = (needs.uses - self.gives) | self.takes, None if self.whole else needs.reach
        return replace(needs, buffers=needs.buffers - self.gives, uses=uses, reach=reach)

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """The statistics of the inner model, see :class:`mcdenoise.models.Model`."""
        inner = getattr(self.inner, "statistics", None)
        return {} if inner is None else inner(frame)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        return self.inner(frame, state)


def name_of(model: Model) -> str:
    """The name of the class or function that is inside all wrappers of a model."""
    inner: Any = model
    while isinstance(inner, Wrapper):
        inner = inner.inner
    return name_of_object(inner.function if isinstance(inner, FromBuffers) else inner)


def parts_of(model: Model, kind: type[_Wanted]) -> Iterator[_Wanted]:
    """The wrappers of a type around and inside a model, outermost first."""
    if isinstance(model, nn.Module):
        yield from (module for module in model.modules() if isinstance(module, kind))


def frames_remembered(model: Model, tolerance: float) -> int | None:
    """The number of frames after which earlier history has a weight below a tolerance.

    If each frame keeps the fraction ``p`` of the history, ``p**n`` remains after ``n`` frames. If a method contains
    other methods with a history, their frames are added, because each history holds results of the one before it.

    Args:
        model: any method.
        tolerance: remaining weight of the history, in (0, 1).

    Returns:
        The number of frames, 0 for a method without a history; or ``None`` if it is unknown, as for a recurrent
        network or for a user's method without ``persistence``.

    Example:
        >>> from mcdenoise.models import create_model
        >>> frames_remembered(create_model("accumulated", alpha_min=0.1), 1e-3)
        66
    """
    parts = list(model.modules()) if isinstance(model, nn.Module) else [model]
    frames = 0
    for part in parts:
        if not hasattr(part, "persistence"):
            if hasattr(part, "needs") and type(part).__module__.partition(".")[0] != "mcdenoise":
                return None
            continue
        left: float | None = part.persistence  # type: ignore[assignment]
        if left is None:
            return None
        frames += max(1, math.ceil(math.log(tolerance) / math.log(left))) if left > 0 else 1
    return frames
