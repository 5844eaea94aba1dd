"""What a method is: a step that takes a frame and its state, and returns images and the next state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, TypeAlias, runtime_checkable

from torch import Tensor

from mcdenoise.frame import Frame

# Any pytree of tensors ``(B, ...)``; ``None`` stands for what is not there, such as the state before the first frame.
State: TypeAlias = Any


class Output(NamedTuple):
    """What a method makes of a frame.

    Args:
        image: ``(B, 3, H, W)`` scene-linear radiance in the unit of ``frame.color``.
        stages: images on the way to it by name, in order and of the same shape and unit, such as ``accumulated`` and
            ``initial``.
        layers: ``(B, 3, H, W)`` parts of the image, one for each of ``frame.layers``, filtered with its kernels; they
            sum to ``image``. Of a method without kernels none: whoever calls it splits the image, see
            :func:`mcdenoise.models._layers.completed`.
        alpha: ``(B, 1, H, W)`` the frame's, filtered with the same kernels, if ``frame.hints.alpha``; likewise.
    """

    image: Tensor
    stages: Mapping[str, Tensor] = {}
    layers: Mapping[str, Tensor] = {}
    alpha: Tensor | None = None


@dataclass(frozen=True)
class Needs:
    """What a method asks of its frames and its host.

    Args:
        buffers: names of the buffers that it cannot do without, see :data:`mcdenoise.frame.BUFFERS`.
        uses: names of those that it is better with.
        trainable: whether it has to be trained; False for filters without weights, for programs of others, and for
            networks that come with their weights.
        reach: how many pixels away its result depends on a buffer; ``None`` where that is the whole image, so that it
            is neither computed in tiles nor skipped in parts.
        stride: a rectangle of the image has the same pixels as the whole where it begins at multiples of so many
            pixels, such as the pixels of a U-Net's coarsest level.
    """

    buffers: frozenset[str] = frozenset({"color"})
    uses: frozenset[str] = frozenset()
    trainable: bool = True
    reach: int | None = None
    stride: int = 1

    def missing(self, frame: Frame) -> list[str]:
        """Names of the buffers that a frame lacks, sorted."""
        return sorted(self.buffers - frame.buffers)


@runtime_checkable
class Model(Protocol):
    """A method: a pure function of a frame and its state.

    ``state`` is ``None`` before the first frame of a shot, later what the call before has returned; its structure stays
    the same from then on. A method whose pixels depend on something of the whole image besides (its exposure, its
    brightest pixel) has a method ``statistics(frame)`` that returns this by name, ``(B, N, 1, 1)`` each, and looks for
    it in ``frame.statistics``: then it can be computed in tiles.

    A method with a state may say how fast it forgets, by an attribute ``persistence``: the largest fraction of what is
    kept of a shot that one more frame leaves, in [0, 1); ``None`` where nobody knows. See
    :func:`mcdenoise.models.frames_remembered`.
    """

    @property
    def needs(self) -> Needs:
        """See :class:`Needs`."""
        ...

    def __call__(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """Denoise a frame.

        Args:
            frame: valid values (:meth:`mcdenoise.frame.Frame.validate`), with the buffers that are needed.
            state: of the frame before.

        Returns:
            The images, and the state for the next frame.
        """
        ...


def prepared(model: Model, frame: Frame) -> Frame:
    """The frame with the model's statistics of the whole image added to its own.

    Whoever changes the color prepares the frame anew.
    """
    statistics = getattr(model, "statistics", None)
    return frame if statistics is None else frame.replace(statistics={**frame.statistics, **statistics(frame)})
