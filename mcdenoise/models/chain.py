"""A chain of methods: each one takes the image of the previous one, and the same features."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn

from mcdenoise.frame import Frame
from mcdenoise.models._interface import Model, Needs, Note, Output, State, prepared
from mcdenoise.models._layers import completed
from mcdenoise.models._state import own_parts
from mcdenoise.models._wrapper import Wrapper, as_model
from mcdenoise.models.exposed import Exposed


class Chain(nn.Module):
    """Runs methods one after another, such as ``Chain(initial=P, final=K)`` for the paper's Eqs. 1 and 3.

    The output of each method but the last is a stage under its name. Statistics of the whole image that one method has
    computed are available to the next one, which computes only those that depend on its own input. The denoised layers
    are passed on in the same way, also by a method without kernels (:func:`mcdenoise.models._layers.completed`).

    Args:
        methods: the methods by name, in order.
    """

    def __init__(self, **methods: Model) -> None:
        super().__init__()
        if not methods:
            raise ValueError("methods: expected one at least, found none")
        self._names = tuple(methods)
        for name, method in methods.items():
            setattr(self, name, as_model(method))

    @property
    def needs(self) -> Needs:
        """The union of all needs; the reach is the sum of all reaches.

        The reach is the whole image if a method after the first uses statistics: these depend on the image of the
        methods before it, of which a tile holds only a part.
        """
        first, *later = (getattr(self, name) for name in self._names)
        every = [method.needs for method in (first, *later)]
        reaches = [needs.reach for needs in every] + ([None] if any(map(_has_statistics, later)) else [])
        return Needs(
            frozenset().union(*(needs.buffers for needs in every)),
            frozenset().union(*(needs.uses for needs in every)),
            any(needs.trainable for needs in every),
            None if None in reaches else sum(reach for reach in reaches if reach is not None),
            max(needs.stride for needs in every),
        )

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        """The statistics of the first method."""
        return prepared(getattr(self, self._names[0]), frame).statistics

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        states: dict[str, Any] = own_parts(state, self._names)
        stages: dict[str, Tensor] = {}
        notes: list[Note] = []
        last, skip = self._names[-1], frame.skip
        for name in self._names:
            method: Model = getattr(self, name)
            # In a tile, the first method has been given the statistics of the whole image.
            frame = frame if name == self._names[0] and frame.statistics else prepared(method, frame)
            # Only of the last image something is known; it is computed from all pixels of the one before.
            output, states[name] = method(frame.replace(skip=skip if name == last else None), states[name])
            output = completed(frame, output)
            image = output.image
            notes += output.notes
            stages |= {f"{name}.{stage}": each for stage, each in output.stages.items()}
            if name != last:
                stages[name] = image
            alpha = frame.alpha if output.alpha is None else output.alpha
            frame = frame.replace(color=image, layers=output.layers, alpha=alpha)
        state = states if any(each is not None for each in states.values()) else None
        return output._replace(stages=stages, notes=notes), state


def _has_statistics(model: Model) -> bool:
    """Whether a model uses statistics of the whole image; most wrappers only forward those of the inner model."""
    parts = model.modules() if isinstance(model, nn.Module) else [model]
    passing = (Wrapper, Chain)
    return any(
        hasattr(part, "statistics") and (isinstance(part, Exposed) or not isinstance(part, passing)) for part in parts
    )
