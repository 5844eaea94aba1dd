"""The interface of a method: a step that takes a frame and its state, and returns images and the next state."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, TypeAlias, runtime_checkable

import torch
from torch import Tensor

from mcdenoise.frame import Frame
from mcdenoise.nn.unet import Live
from mcdenoise.ops._backend import is_transformed

# Any pytree of tensors ``(B, ...)``. ``None`` stands for a missing part, such as the state before the first frame.
State: TypeAlias = Any
# Handles numbers, in memory order, once they have been read from the device; may raise.
Tell: TypeAlias = Callable[[Sequence[float]], None]
# Takes values that a device computes, and what handles their numbers as soon as they are known.
Ask: TypeAlias = Callable[[Tensor, Tell], None]


class Note(NamedTuple):
    """What a step tells about a frame, for its report.

    Args:
        name: of the stage, such as ``reproject``; or ``history`` with the fraction of the pixels that have one, and why
            there is none.
        reason: why it was skipped, or why it was not.
        skipped: fraction of the stage that was skipped. A tensor of one number is read when the report is, so that the
            host does not wait for a GPU.
        value: the figure, a number or a tensor; of several numbers the largest counts.
        otherwise: the reason instead, if nothing was skipped after all.
        exact: whether skipping leaves the pixels unchanged; otherwise they agree up to the tolerance.
    """

    name: str
    reason: str = ""
    skipped: float | Tensor = 0.0
    value: float | Tensor | None = None
    otherwise: str | None = None
    exact: bool = True


class Output(NamedTuple):
    """Result of a method for one frame.

    Args:
        image: ``(B, 3, H, W)`` scene-linear radiance in the unit of ``frame.color``.
        stages: intermediate images by name, in order, with the shape and unit of ``image``, such as ``accumulated`` and
            ``initial``.
        layers: ``(B, 3, H, W)`` parts of the image, one for each of ``frame.layers``, filtered with the kernels of the
            color; they sum to ``image``. Empty for a method without kernels: the caller then splits the image, see
            :func:`mcdenoise.models._layers.completed`.
        alpha: ``(B, 1, H, W)`` alpha of the frame, filtered with the same kernels if ``frame.hints.alpha`` is set;
            ``None`` for a method without kernels.
        notes: what the report of the frame shall tell; a wrapper passes on those of the method inside.
    """

    image: Tensor
    stages: Mapping[str, Tensor] = {}
    layers: Mapping[str, Tensor] = {}
    alpha: Tensor | None = None
    notes: Sequence[Note] = ()

    def map(self, function: Callable[[Tensor], Tensor]) -> Output:
        """The same with a function of every image."""
        return self.lit(function)._replace(alpha=None if self.alpha is None else function(self.alpha))

    def lit(self, function: Callable[[Tensor], Tensor], *, stages: bool = True) -> Output:
        """The same with a function of all light: of the image, the layers, and the stages unless they are dropped."""
        layers = {name: function(layer) for name, layer in self.layers.items()}
        kept = {name: function(image) for name, image in self.stages.items()} if stages else {}
        return self._replace(image=function(self.image), stages=kept, layers=layers)

    def noted(self, *notes: Note) -> Output:
        """The same with these notes before its own."""
        return self._replace(notes=(*notes, *self.notes))


# The usual features of a frame.
GUIDES = frozenset({"albedo", "normal", "depth"})
# Some 64 feature channels and the images around them.
_DEFAULT = Live(0, 64 + 54)


@dataclass(frozen=True)
class Needs:
    """The requirements of a method for its frames and its host.

    Args:
        buffers: names of the required buffers, see :data:`mcdenoise.buffers.BUFFERS`.
        uses: names of optional buffers that improve the result.
        trainable: whether the method has weights to train; False for filters without weights, for third-party
            denoisers, and for networks that come with their weights.
        reach: largest distance in pixels between a pixel of the result and a buffer pixel that it depends on; ``None``
            if the result depends on the whole image, so that tiles can neither be computed separately nor skipped.
        stride: a crop of the image gives the same pixels as the whole image if it begins at a multiple of ``stride``
            pixels, such as the side of a pixel of a U-Net's coarsest level.
        live: the memory of a tile (:class:`mcdenoise.models.Tiled`), which decides how large tiles may be.
    """

    buffers: frozenset[str] = frozenset({"color"})
    uses: frozenset[str] = frozenset()
    trainable: bool = True
    reach: int | None = None
    stride: int = 1
    live: Live = _DEFAULT

    def missing(self, frame: Frame) -> list[str]:
        """Sorted names of the required buffers that a frame lacks."""
        return sorted(self.buffers - frame.buffers)


@runtime_checkable
class Model(Protocol):
    """A method: a pure function of a frame and its state.

    ``state`` is ``None`` before the first frame of a shot, and then the state that the previous call returned; its
    structure does not change after that. Some methods use values that depend on the whole image, such as an exposure or
    the brightest pixel. Such a method has a method ``statistics(frame)`` that returns these values by name, ``(B, N, 1,
    1)`` each, and reads them from ``frame.statistics``; this allows computing it in tiles.

    A method with a state may declare how fast it forgets with an attribute ``persistence``: the largest fraction of the
    kept history that remains after one more frame, in [0, 1), or ``None`` if it is unknown. See
    :func:`mcdenoise.models._wrapper.frames_remembered`.
    """

    @property
    def needs(self) -> Needs:
        """See :class:`Needs`."""
        ...

    def __call__(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """Denoise a frame.

        Args:
            frame: with valid values (:meth:`mcdenoise.frame.Frame.validate`) and all required buffers.
            state: the state that the previous frame returned.

        Returns:
            The images, and the state for the next frame.
        """
        ...


def prepared(model: Model, frame: Frame) -> Frame:
    """The frame with the model's statistics of the whole image added.

    A caller that changes the color has to prepare the frame again.
    """
    statistics = getattr(model, "statistics", None)
    return frame if statistics is None else frame.replace(statistics={**frame.statistics, **statistics(frame)})


def at_hand(device: torch.device) -> bool:
    """Whether a step may read values on its device, to skip work: a graph that is recorded, or ``vmap``, has none.

    On a CPU, reading a value costs little compared with what it saves. On any other device the host would wait for all
    queued work, so a step reads nothing there and computes everything, as a recorded graph does.
    """
    return device.type == "cpu" and not torch.compiler.is_compiling() and not is_transformed()
