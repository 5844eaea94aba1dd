"""The frames of a shot, whatever the layout of its files."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping
from collections.abc import Sequence as Sequential
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from mcdenoise.data.images import Image, Metadata, Window
from mcdenoise.data.readers.lights import Light
from mcdenoise.data.readers.values import Row
from mcdenoise.errors import InputError
from mcdenoise.frame import Frame

# Files may contain any values, also infinite ones, which are checked when a frame is used: suppress numpy's warnings.
any_values = np.errstate(over="ignore", invalid="ignore", divide="ignore")


class Denoised(NamedTuple):
    """What is written of a frame, see :meth:`Sequence.write`."""

    image: Image
    alpha: Image | None
    lights: Mapping[str, Image]
    output_layer: str | None
    full_float: bool


@dataclass(kw_only=True, eq=False, repr=False)
class Sequence(ABC):
    """The frames of one shot.

    Args:
        root: the folder, file or pattern that was passed.
        name: the name of the scene's folder, or of its only file.
        layout: the detected layout: ``"bmfr"``, ``"noisebase"``, ``"oidn"``, or ``"files"`` for all other renderers.
        numbers: frame numbers, ascending.
        color_has_albedo: whether the color in the files includes the albedo. The color of frames always does.
        lights: the layers of light that every frame has in ``layers``, by name.
        window: the smallest window with the data windows of all colors, if the files have data windows that differ;
            each is written in its own.
        table: the source of each buffer.
        warnings: probable mistakes, one line each.
    """

    numbers: list[int]
    root: Path = Path()
    name: str = ""
    layout: str = ""
    color_has_albedo: bool = True
    lights: Mapping[str, Light] = field(default_factory=dict)
    window: Window | None = None
    table: list[Row] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    @abstractmethod
    def size(self) -> tuple[int, int]:
        """Height and width in pixels, the same for every buffer and frame."""

    @property
    @abstractmethod
    def buffers(self) -> frozenset[str]:
        """Names of the buffers that every frame of the sequence has."""

    @property
    @abstractmethod
    def reference_numbers(self) -> list[int]:
        """Frames that have a reference; possibly only some."""

    @property
    @abstractmethod
    def folders(self) -> set[Path]:
        """The folders of the input files; results have the same names, so they may not be written there."""

    @property
    def noise_seeds(self) -> int:
        """Number of noisy colors per frame, with different noise seeds; usually 1."""
        return 1

    @property
    def noisy(self) -> frozenset[str]:
        """Names of the buffers that differ between noise seeds: the color, and features that have noise."""
        return frozenset({"color"})

    @property
    def unused(self) -> list[str]:
        """Files and layers that look like buffers but are not used."""
        return []

    @property
    def unknown(self) -> list[str]:
        """Layers with unknown names."""
        return []

    def files(self, number: int) -> list[Path]:
        """The files of a frame, sorted and without duplicates, including camera files.

        Raises:
            InputError: the frame does not exist.
        """
        self._check(number)
        return sorted(set(self._files(number)))

    def part(self, numbers: Sequential[int]) -> Self:
        """Select some frames, ascending; how the values are read does not change."""
        for number in numbers:
            self._check(number)
        return replace(self, numbers=list(numbers))

    @any_values
    def frame(
        self,
        number: int,
        reference: bool = True,
        noise_seed: int = 0,
        buffers: Collection[str] | None = None,
    ) -> Frame:
        """Read one frame: a batch of 1, float32, on the CPU; values are not validated.

        ``color`` is radiance including albedo, whatever the files hold. ``depth`` is read from a depth file, or
        computed as clip w of the position; it is ``inf`` where nothing was hit. ``view_projection`` includes the pixel
        offset of the files: ``u W - 0.5, v H - 0.5`` is the pixel index. If the frame before this one was not selected,
        the frame has neither ``motion`` nor ``previous_position``; its history is found through positions and cameras,
        or not at all.

        Args:
            number: one of ``numbers``.
            reference: whether to read the reference, if there is one.
            noise_seed: index of the noise seed, from 0 to ``noise_seeds - 1``: it selects the ``noisy`` buffers; the
                others are the same for all seeds.
            buffers: names of the buffers in use. Parts of the light and samples (``LIGHT_PARTS``), which are slow to
                read, are skipped if they are not among them. All by default.

        Raises:
            InputError: the frame or the noise seed does not exist, or a file is damaged.
        """
        self._check(number)
        if not 0 <= noise_seed < self.noise_seeds:
            raise InputError(
                f"{self.root}: expected a noise seed from 0 to {self.noise_seeds - 1}, "
                f"found {noise_seed}; render more of them"
            )
        frame = self._frame(number, reference, noise_seed, buffers)
        if self.numbers.index(number) == 0 or number - 1 in self.numbers:
            return frame
        # They refer to a frame that was not selected, not to the previous one of this sequence.
        return frame.replace(motion=None, previous_position=None)

    def metadata(self, number: int) -> Metadata:
        """Attributes of the color file of one frame: texts, numbers and tuples of numbers.

        Raises:
            InputError: the frame does not exist, or its file is damaged.
        """
        self._check(number)
        return self._metadata(number)

    def check_output_layer(self, name: str) -> None:
        """Check that a layer of this name can be added.

        Raises:
            InputError: the name is invalid, or the files have such a layer already or have no layers.
        """
        raise InputError(
            f"{self._files(self.numbers[0])[0]}: expected files with layers to add '{name}' to, found a file a buffer; "
            "omit --output-layer: each result is a file of its own"
        )

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
        """Write the denoised image of one frame to a file with the name of the color file.

        Everything else is copied unchanged: layers, parts, attributes, windows, compression, pixel types. In the BMFR
        layout, where each file is a buffer, the file is ``denoisedN`` for the color ``colorN``; for Noisebase, an EXR
        of R, G, B.

        Args:
            out: folder to write to. It must exist.
            number: one of ``numbers``.
            image: ``(H, W, 3)`` radiance.
            alpha: ``(H, W, 1)`` coverage; by default that of the file is kept.
            lights: ``(H, W, 3)`` radiance of layers of light, by the names in ``frame.layers``.
            output_layer: name of a layer to add; then nothing is replaced.
            full_float: store the written channels as 32-bit floats, whatever they were before.

        Returns:
            The path of the file.

        Raises:
            InputError: the file cannot be written.
        """
        self._check(number)
        if output_layer is not None:
            self.check_output_layer(output_layer)
        return self._write(out, number, Denoised(image, alpha, lights or {}, output_layer, full_float))

    def _check(self, number: int) -> None:
        if number not in self.numbers:
            raise InputError(f"{self.root}: expected a frame of the sequence ({summary(self.numbers)}), found {number}")

    @abstractmethod
    def _files(self, number: int) -> list[Path]:
        """The files of one frame without those that hold only its reference, and the files that describe all frames."""

    def _metadata(self, number: int) -> Metadata:
        # Arrays have no attributes.
        return {}

    @abstractmethod
    def _frame(self, number: int, reference: bool, noise_seed: int, buffers: Collection[str] | None) -> Frame: ...

    @abstractmethod
    def _write(self, out: Path, number: int, result: Denoised) -> Path: ...


def summary(numbers: Sequential[int]) -> str:
    """Frame numbers in words."""
    return f"{numbers[0]} to {numbers[-1]}"
