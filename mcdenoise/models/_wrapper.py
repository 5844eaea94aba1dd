"""A model that holds a model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TypeVar

from torch import Tensor, nn

from mcdenoise.frame import Frame
from mcdenoise.models._adapter import as_model
from mcdenoise.models._interface import Model, Needs, Output, State

_Wanted = TypeVar("_Wanted")


class Wrapper(nn.Module):
    """A model that holds another one and changes what goes in or comes out.

    Args:
        inner: any :class:`mcdenoise.models.Model`, or a module or function of images, see
            :class:`mcdenoise.models.FromBuffers`.
    """

    inner: Model

    def __init__(self, inner: Model) -> None:
        super().__init__()
        self.inner = as_model(inner)

    @property
    def needs(self) -> Needs:
        """Those of the model inside."""
        return self.inner.needs

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """Those of the model inside, see :class:`mcdenoise.models.Model`."""
        inner = getattr(self.inner, "statistics", None)
        return {} if inner is None else inner(frame)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        return self.inner(frame, state)


def run(model: Model, handed: list[Frame], state: State) -> tuple[Output, State]:
    """Call a model with a frame that nobody else holds, so that the model can free it: of a large one, that is much.

    Args:
        model: any.
        handed: the frame; empty afterwards.
        state: see :class:`mcdenoise.models.Model`.
    """
    # A module's own call keeps its arguments until it returns.
    step = model.forward if isinstance(model, nn.Module) else model
    found: tuple[Output, State] = step(handed.pop(), state)
    return found


def parts_of(model: Model, kind: type[_Wanted]) -> Iterator[_Wanted]:
    """The wrappers of a kind that a model wears, outermost first."""
    if isinstance(model, nn.Module):
        yield from (module for module in model.modules() if isinstance(module, kind))
