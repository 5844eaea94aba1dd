"""Base of wrappers: models that contain a model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, ClassVar, TypeVar

from torch import Tensor, nn

from mcdenoise.frame import Frame
from mcdenoise.models._adapter import FromBuffers, as_model, name_of_object
from mcdenoise.models._interface import Model, Needs, Output, State

_Wanted = TypeVar("_Wanted")


class Wrapper(nn.Module):
    """Contains another model, and changes its input or output.

    Args:
        inner: any :class:`mcdenoise.models.Model`, or a module or function of images, see
            :class:`mcdenoise.models._adapter.FromBuffers`.
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
