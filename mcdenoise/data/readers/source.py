"""What every layout of files tells and does."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

from torch import Tensor

from mcdenoise.data.exr import Metadata
from mcdenoise.data.images import Window
from mcdenoise.data.readers.values import Row
from mcdenoise.frame import Frame


@dataclass(kw_only=True)
class Source(ABC):
    """The files of a shot.

    Args:
        numbers: frames in use, ascending.
        color_has_albedo: whether the radiance in the files includes the albedo.
        table: the source of each buffer.
        warnings: probable mistakes.
        unused: what looks like a buffer but is not used.
    """

    numbers: list[int]
    color_has_albedo: bool = True
    table: list[Row] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    unused: list[str] = field(default_factory=list)

    @property
    @abstractmethod
    def size(self) -> tuple[int, int]:
        """Height and width in pixels, the same for every buffer and frame."""

    @property
    @abstractmethod
    def buffers(self) -> frozenset[str]:
        """Names of the buffers that every frame has."""

    @property
    @abstractmethod
    def reference_numbers(self) -> list[int]:
        """Frames in use that have a reference."""

    @property
    @abstractmethod
    def folders(self) -> set[Path]:
        """The folders of the files."""

    @property
    def noise_seeds(self) -> int:
        """Number of noisy colors of every frame."""
        return 1

    @property
    def noisy(self) -> frozenset[str]:
        """Names of the buffers that differ between noise seeds."""
        return frozenset({"color"})

    @property
    def window(self) -> Window | None:
        """The window of all frames, if the files have data windows that differ."""
        return None

    @property
    def unknown(self) -> list[str]:
        """Layers with unknown names."""
        return []

    @property
    def lights(self) -> Collection[str]:
        """Names of the layers of light."""
        return ()

    @abstractmethod
    def frame_files(self, number: int) -> list[Path]:
        """The files of one frame without those that hold only its reference, and the files that describe all frames."""

    @abstractmethod
    def metadata(self, number: int) -> Metadata:
        """Attributes of one frame's color file."""

    @abstractmethod
    def reference(self, number: int) -> Tensor:
        """Read the reference of one frame that has one."""

    @abstractmethod
    def frame(
        self, number: int, *, reference: bool = True, noise_seed: int = 0, buffers: Collection[str] | None = None
    ) -> Frame:
        """Read one frame; see :meth:`mcdenoise.data.Sequence.frame`."""
