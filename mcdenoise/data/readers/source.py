"""The interface of every layout of files."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from torch import Tensor

from mcdenoise.data.exr import Image, Metadata
from mcdenoise.data.images import Window
from mcdenoise.data.readers.lights import Light
from mcdenoise.data.readers.values import Row
from mcdenoise.errors import InputError
from mcdenoise.frame import Frame


@dataclass(kw_only=True)
class Source(ABC):
    """The files of a shot.

    Args:
        numbers: frames in use, ascending.
        color_has_albedo: whether the radiance in the files includes the albedo.
        lights: layers of radiance that are denoised with the color, by name.
        window: the smallest window with the data windows of all colors, if there is one that differs from another.
        table: the source of each buffer.
        warnings: probable mistakes.
    """

    numbers: list[int]
    color_has_albedo: bool = True
    lights: Mapping[str, Light] = field(default_factory=dict)
    window: Window | None = None
    table: list[Row] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

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
    def unused(self) -> list[str]:
        """What looks like a buffer but is not used."""
        return []

    @property
    def unknown(self) -> list[str]:
        """Layers with unknown names."""
        return []

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

    def check_output_layer(self, name: str) -> None:
        """Check that a layer of this name can be added to the files.

        Raises:
            InputError: the name is invalid, or the files have such a layer already or have no layers.
        """
        (path, *_) = self.frame_files(self.numbers[0])
        raise InputError(
            f"{path}: expected files with layers to add '{name}' to, found a file a buffer; omit --output-layer: each "
            "result is a file of its own"
        )

    @abstractmethod
    def write(
        self,
        out: Path,
        number: int,
        image: Image,
        *,
        alpha: Image | None = None,
        lights: Mapping[str, Image] | None = None,
        output_layer: str | None = None,
        full_float: bool = False,
    ) -> Path:
        """Write the files of a frame with the denoised image; see :meth:`mcdenoise.data.Sequence.write`."""
