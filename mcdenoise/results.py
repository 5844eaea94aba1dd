"""The results of a benchmark, as stored in ``results.json`` and shown by the report."""

from __future__ import annotations

import json
import reprlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import msgspec
import numpy as np
from msgspec import Meta

from mcdenoise.data.files import write_text
from mcdenoise.models._precision import Precision
from mcdenoise.reading import expecting, read_text

FILE = "results.json"
IMAGES = "images"
VERSION: Literal[2] = 2
STAGES = ("read", "accumulate", "network", "filter", "write")
# Suffix of a method's name if it skips nothing, for comparing it with the same method that does.
KEEP_ALL = ", keep all"
# Larger than any measured value; its square is still finite, and it can be plotted.
Number = Annotated[float, Meta(ge=-1e100, le=1e100)]
Amount = Annotated[float, Meta(ge=0, le=1e100)]
# Whole numbers up to those that a float represents.
Count = Annotated[int, Meta(ge=0, lt=2**53)]
Positive = Annotated[int, Meta(ge=1, lt=2**53)]
Kind = Literal["trainable", "fixed", "baseline"]


@dataclass(frozen=True)
class Spread:
    """Median and quartiles of repeated measurements.

    Args:
        median: median of the measurements.
        lower: first quartile.
        upper: third quartile.
        count: number of measurements.
    """

    median: Number
    lower: Number
    upper: Number
    count: Count

    @classmethod
    def of(cls, values: list[float]) -> Spread:
        """Compute the spread of at least one value.

        Example:
            >>> Spread.of([1.0, 2.0, 3.0, 4.0, 100.0])
            Spread(median=3.0, lower=2.0, upper=4.0, count=5)
        """
        lower, median, upper = np.quantile(values, [0.25, 0.5, 0.75]).tolist()
        return cls(median, lower, upper, len(values))


@dataclass(frozen=True)
class Machine:
    """The machine of a measurement.

    Args:
        processor: model of the CPU.
        cores: logical cores that the process may use.
        memory: gibibytes.
        device: ``cpu``, or the name of the GPU.
        threads: number of threads of torch and of every method.
        system: operating system and its version.
        packages: versions of the measured packages by name.
    """

    processor: str
    cores: Count
    memory: Amount
    device: str
    threads: Count
    system: str
    packages: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Scene:
    """A sequence of the benchmark.

    Args:
        name: unique among the scenes.
        width: in pixels.
        height: in pixels.
        frames: numbers of the frames that were denoised and timed.
        scored: numbers of the frames that have a reference.
        pictures: numbers of the frames whose images are kept, as ``images/SCENE/METHOD/N.exr`` and, for the reference,
            ``images/SCENE/reference/N.exr``; methods are ordered as in :attr:`Results.methods`.
        reference_noise: SMAPE of the references against the truth, if the renderer has stored it.
    """

    name: str
    width: Positive
    height: Positive
    frames: list[Count]
    scored: list[Count]
    pictures: list[Count] = field(default_factory=list)
    reference_noise: Amount | None = None


@dataclass(frozen=True)
class Method:
    """A method of the benchmark: a model with settings, as passed to :class:`mcdenoise.denoiser.Denoiser`.

    Args:
        name: unique, such as ``wild`` or ``oidn(quality=fast)``.
        kind: a trained model, another model, or a baseline (``noisy`` does nothing, ``accumulated`` only accumulates).
        folder: name of its folder in ``images/SCENE``.
        model: name of the model, or ``path/to/file.py:factory``; methods of one model have the same colour in plots.
        settings: arguments of the model's constructor.
        weights: path of the weights file; empty for the shipped weights, or none.
        precision: precision of convolutions.
        keep_all: whether nothing is skipped.
        parameters: number of weights of a network, if it is known.
        missing: why the method could not run at all, such as a package that is not installed; else ``""``.
    """

    name: str
    kind: Kind
    folder: str
    model: str
    settings: dict[str, Any] = field(default_factory=dict)
    weights: str = ""
    precision: Precision = "float32"
    keep_all: bool = False
    parameters: Count | None = None
    missing: str = ""


@dataclass(frozen=True)
class Cell:
    """The measurements of one method on one scene.

    Args:
        scene: name of the scene.
        method: name of the method.
        errors: mean over the scored frames, by name in :data:`mcdenoise.evaluate.METRICS`.
        errors_spread: median and quartiles over the scored frames, by the same names.
        whole: milliseconds per frame, from reading to writing.
        stages: milliseconds per frame of each stage of the method, by name in :data:`STAGES`.
        memory: peak memory in mebibytes for creating the method and denoising two frames in a separate process (on a
            GPU: of the device), if it could be measured; for the first scene of this size.
        failure: why the method failed on this scene; then all other values are unknown.
        computing: milliseconds per frame in memory, without reading and writing files; measured as a whole, so that the
            stages may add up to slightly less.
        plan: the skipped stages and the reasons.
        lacking: whether the method failed because the scene lacks buffers that it needs; then the run has not failed.
    """

    scene: str
    method: str
    errors: dict[str, Number] = field(default_factory=dict)
    errors_spread: dict[str, Spread] = field(default_factory=dict)
    whole: Spread | None = None
    stages: dict[str, Spread] = field(default_factory=dict)
    memory: Amount | None = None
    failure: str = ""
    computing: Spread | None = None
    plan: list[dict[str, Any]] = field(default_factory=list)
    lacking: bool = False

    @property
    def reason(self) -> str:
        """The reason if there are no measurements; empty otherwise."""
        return self.failure and f"{'skipped' if self.lacking else 'failed'}: {self.failure}"


@dataclass(frozen=True)
class Skipped:
    """The stages that a method skipped on a scene, and the effect.

    Args:
        scene: name of the scene.
        method: name of the method.
        stages: the skipped stages, and the skipped fraction of each.
        saved: milliseconds per frame saved against the same method that skips nothing, without files; ``None`` if that
            was not measured.
        change: difference of the error from that of the same method that skips nothing, by metric.
    """

    scene: str
    method: str
    stages: str
    saved: float | None = None
    change: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Cost:
    """The cost of one method at one image size.

    Args:
        method: name of the method.
        width: in pixels.
        height: in pixels.
        milliseconds: per frame, without files; ``None`` if the method failed.
        failure: why it failed, such as insufficient memory.
    """

    method: str
    width: Positive
    height: Positive
    milliseconds: Spread | None = None
    failure: str = ""


@dataclass(frozen=True)
class Fit:
    """How cost grows with the number of pixels: ``milliseconds = fixed + per_megapixel * megapixels``.

    The line is fitted to the medians by least squares of relative deviations, so that all sizes have the same weight.

    Args:
        method: name.
        fixed: milliseconds.
        per_megapixel: milliseconds.
        deviation: largest relative deviation of a measured median from the line.
    """

    method: str
    fixed: Number
    per_megapixel: Number
    deviation: Amount


@dataclass(frozen=True)
class _Stored:
    """A run whose results are a file in its folder."""

    file: ClassVar[str]

    def write(self, folder: Path) -> None:
        """Write the file of this kind of results, ``results.json`` or ``ops.json``.

        Raises:
            InputError: the file cannot be written.
            ValueError: a number is NaN or infinite, which JSON does not allow.
        """
        write_text(folder / self.file, json.dumps(asdict(self), indent=1, allow_nan=False) + "\n")


@dataclass(frozen=True)
class Results(_Stored):
    """The results of one run of the benchmark.

    Args:
        command: the command line of the run.
        created: UTC time in ISO format.
        machine: the machine of the run.
        rounds: number of times that each method denoised each frame, without the warm-up.
        scenes: in the order in which they were named.
        methods: in the order in which they are shown.
        cells: one for each scene and each method that is not missing.
        costs: by method and size.
        fits: by method.
        version: version of this format.
        notes: remarks on the run as a whole, such as a metric that was not computed, and why.
    """

    command: str
    created: str
    machine: Machine
    rounds: Count
    scenes: list[Scene]
    methods: list[Method]
    cells: list[Cell]
    costs: list[Cost] = field(default_factory=list)
    fits: list[Fit] = field(default_factory=list)
    version: Literal[2] = VERSION
    notes: list[str] = field(default_factory=list)
    file = FILE

    @property
    def failed(self) -> bool:
        """Whether a method failed on a scene that has all buffers that it needs."""
        return any(one.failure and not one.lacking for one in self.cells)

    def cell(self, scene: str, method: str) -> Cell | None:
        """The measurements of a method on a scene."""
        return next((one for one in self.cells if (one.scene, one.method) == (scene, method)), None)

    def skipped(self) -> list[Skipped]:
        """One entry for each scene and method that skipped anything."""
        rows = []
        for cell in self.cells:
            fractions = {row["stage"]: row["skipped"] for row in cell.plan if row["skipped"] > 0}
            if cell.method.endswith(KEEP_ALL) or not fractions:
                continue
            whole = self.cell(cell.scene, cell.method + KEEP_ALL)
            row = Skipped(cell.scene, cell.method, ", ".join(f"{name} {part:.0%}" for name, part in fractions.items()))
            if whole is not None and whole.computing is not None and cell.computing is not None:
                saved = whole.computing.median - cell.computing.median
                change = {
                    name: value - whole.errors[name] for name, value in cell.errors.items() if name in whole.errors
                }
                row = replace(row, saved=saved, change=change)
            rows.append(row)
        return rows

    def megapixels_per_second(self, cell: Cell) -> float | None:
        """Megapixels per second that a method denoises, without reading and writing files."""
        scene = next(one for one in self.scenes if one.name == cell.scene)
        return scene.width * scene.height / 1e3 / cell.computing.median if cell.computing else None

    @classmethod
    def read(cls, folder: Path) -> Results:
        """Read ``results.json`` from a folder.

        Raises:
            InputError: the file is missing, damaged, or of another version of the format.
        """
        path = folder / FILE
        with expecting(path, "the results of `mcdenoise benchmark` in this version of the format"):
            results = msgspec.json.decode(read_text(path), type=cls)
            if fault := next(_faults(results), ""):
                raise ValueError(fault)
        return results


@dataclass(frozen=True)
class OpCost:
    """Cost and accuracy of one operator with one backend and dtype.

    Args:
        op: name in :mod:`mcdenoise.ops`.
        backend: ``torch`` for the reference in torch, or another backend.
        dtype: such as ``float32``.
        case: name of the enlarged test case of the operator.
        milliseconds: per call; ``None`` if it failed.
        error: largest relative error over the operator's ordinary cases, against its equation in float64 on the same
            inputs; ``None`` if it failed.
        mebibytes: size of inputs and outputs together: the minimum memory traffic.
        copy: milliseconds for copying as much memory.
        with_derivatives: milliseconds per call and its derivatives with respect to all floating-point inputs; ``None``
            if it has no derivatives.
        mebibytes_with_derivatives: minimum memory traffic with derivatives: inputs are read again, gradients of the
            outputs are read, and gradients of the inputs are written.
        copy_with_derivatives: milliseconds for copying as much memory.
        failure: why there are no measurements.
    """

    op: str
    backend: str
    dtype: str
    case: str
    milliseconds: Spread | None = None
    error: float | None = None
    mebibytes: float | None = None
    copy: float | None = None
    with_derivatives: Spread | None = None
    mebibytes_with_derivatives: float | None = None
    copy_with_derivatives: float | None = None
    failure: str = ""

    @property
    def over_copy(self) -> float | None:
        """Run time relative to the copy; 1 is the speed of memory."""
        return self.milliseconds.median / self.copy if self.milliseconds and self.copy else None

    @property
    def over_copy_with_derivatives(self) -> float | None:
        """The same with derivatives."""
        both = self.with_derivatives, self.copy_with_derivatives
        return both[0].median / both[1] if both[0] and both[1] else None


@dataclass(frozen=True)
class OpResults(_Stored):
    """The results of ``mcdenoise benchmark --ops``.

    Args:
        command: the command line of the run.
        created: UTC time in ISO format.
        machine: the machine of the run.
        width: in pixels.
        height: in pixels.
        rounds: number of calls, without the warm-up.
        bandwidth: of a copy in the same run, gigabytes (1e9) per second, read and written.
        costs: by operator, backend and dtype.
        version: version of this format.
    """

    command: str
    created: str
    machine: Machine
    width: int
    height: int
    rounds: int
    bandwidth: float
    costs: list[OpCost]
    version: int = VERSION
    file = "ops.json"


def _faults(results: Results) -> Iterator[str]:
    """What is inconsistent in results whose types are right."""
    scenes, methods = [one.name for one in results.scenes], [one.name for one in results.methods]
    for kind, names in (("scenes", scenes), ("methods", methods)):
        if len(set(names)) != len(names) or not names:
            yield f"{kind} without names of their own: {reprlib.repr(names)}"
    # Images are read from folders of these names.
    for part in (*scenes, *(method.folder for method in results.methods)):
        plain = part not in ("", ".", "..") and not {"/", "\\", "\0"} & set(part) and part.isprintable()
        if not plain or len(part.encode(errors="replace")) > 255:
            yield f"{reprlib.repr(part)}, which is no name of a folder"
    for cell in results.cells:
        if cell.scene not in scenes:
            yield f"measurements of {reprlib.repr(cell.scene)}, which is no scene"
        for row in cell.plan:
            stage, skipped = row.get("stage"), row.get("skipped")
            if not (isinstance(stage, str) and isinstance(skipped, int | float) and 0 <= skipped <= 1):
                yield f"the plan {reprlib.repr(row)}"
    measured: list[Cell | Cost | Fit] = [*results.cells, *results.costs, *results.fits]
    for one in measured:
        if one.method not in methods:
            yield f"measurements of {reprlib.repr(one.method)}, which is no method"
    cells = ((cell.whole, cell.computing, *cell.stages.values()) for cell in results.cells)
    for times in (*cells, (cost.milliseconds for cost in results.costs)):
        for time in times:
            if time is not None and not (0 <= time.lower <= time.median <= time.upper and time.count > 0):
                yield f"a time of {time}"
