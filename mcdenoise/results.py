"""What a benchmark found out, as it is stored in ``results.json`` and shown by the report."""

from __future__ import annotations

import functools
import json
import reprlib
import types
from dataclasses import MISSING, asdict, dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np

from mcdenoise.data.files import write_text
from mcdenoise.errors import InputError
from mcdenoise.models import Precision
from mcdenoise.reading import read_text

FILE = "results.json"
OPS_FILE = "ops.json"
IMAGES = "images"
VERSION = 2
STAGES = ("read", "accumulate", "network", "filter", "write")
# Ends the name of a method that skips nothing, beside the same method that does.
KEEP_ALL = ", keep all"
# Beyond any figure that is measured; what is squared is finite still, and what is drawn.
_LARGEST = 1e100
Kind = Literal["trainable", "fixed", "baseline"]


@dataclass(frozen=True)
class Spread:
    """Median and quartiles of repeated measurements.

    Args:
        median: half of them are below.
        lower: first quartile.
        upper: third quartile.
        count: how many there were.
    """

    median: float
    lower: float
    upper: float
    count: int

    @classmethod
    def of(cls, values: list[float]) -> Spread:
        """Of at least one value.

        Example:
            >>> Spread.of([1.0, 2.0, 3.0, 4.0, 100.0])
            Spread(median=3.0, lower=2.0, upper=4.0, count=5)
        """
        lower, median, upper = np.quantile(values, [0.25, 0.5, 0.75]).tolist()
        return cls(median, lower, upper, len(values))


@dataclass(frozen=True)
class Machine:
    """Where it was measured.

    Args:
        processor: model of the CPU.
        cores: logical cores that the process may use.
        memory: gibibytes.
        device: ``cpu``, or the name of the GPU.
        threads: of torch and of every method.
        system: operating system and its version.
        packages: versions by name, those that were measured.
    """

    processor: str
    cores: int
    memory: float
    device: str
    threads: int
    system: str
    packages: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Scene:
    """One sequence that was denoised.

    Args:
        name: unique among the scenes.
        width: pixels.
        height: pixels.
        frames: numbers of the frames that were denoised and timed.
        scored: numbers of those that have a reference.
        pictures: numbers of those whose images are kept, as ``images/SCENE/METHOD/N.exr`` and, for the reference,
            ``images/SCENE/reference/N.exr``; methods are ordered as in :attr:`Results.methods`.
        reference_noise: the references' own SMAPE against the truth, where the renderer has stored it.
    """

    name: str
    width: int
    height: int
    frames: list[int]
    scored: list[int]
    pictures: list[int] = field(default_factory=list)
    reference_noise: float | None = None


@dataclass(frozen=True)
class Method:
    """One way to get an image: a model with settings, as :class:`mcdenoise.denoiser.Denoiser` takes it.

    Args:
        name: unique, such as ``cascaded_v2`` or ``oidn(quality=fast)``.
        kind: a model that learns, one that does not, or a baseline (``noisy`` does nothing, ``accumulated`` only
            accumulates).
        folder: name of its folder in ``images/SCENE``.
        model: its name, or ``path/to/file.py:factory``; what is of one model is coloured alike.
        settings: for the model's constructor.
        weights: path of the weights file; empty for the shipped weights, or none.
        precision: of convolutions.
        keep_all: whether nothing is skipped.
        parameters: number of weights of a network, where that is known.
        missing: why it could not be run at all, such as a package that is not installed; else ``""``.
    """

    name: str
    kind: Kind
    folder: str
    model: str
    settings: dict[str, Any] = field(default_factory=dict)
    weights: str = ""
    precision: Precision = "float32"
    keep_all: bool = False
    parameters: int | None = None
    missing: str = ""


@dataclass(frozen=True)
class Cell:
    """One method on one scene.

    Args:
        scene: name.
        method: name.
        errors: mean over the scored frames, by name in :data:`mcdenoise.evaluate.METRICS`.
        errors_spread: median and quartiles over the scored frames, by the same names.
        whole: milliseconds a frame, from reading to writing.
        stages: milliseconds a frame of each stage that a method has, by name in :data:`STAGES`.
        memory: peak memory in mebibytes that making the method and denoising two frames added, in a process of its own
            (on a GPU: there), where it could be measured; of the first scene of this size.
        failure: why the method failed on this scene; nothing else is known then.
        computing: milliseconds a frame of what happens in memory, without reading and writing files; measured around
            all of it, so that the stages may add up to a little less.
        plan: what was skipped of the scene and why, see :func:`mcdenoise.models.summarize`.
        on_the_way: errors of the images on the way to the result, by stage, where they were asked for.
        lacking: whether the failure is that the scene has not what the method needs, which is the fault of neither.
    """

    scene: str
    method: str
    errors: dict[str, float] = field(default_factory=dict)
    errors_spread: dict[str, Spread] = field(default_factory=dict)
    whole: Spread | None = None
    stages: dict[str, Spread] = field(default_factory=dict)
    memory: float | None = None
    failure: str = ""
    computing: Spread | None = None
    plan: list[dict[str, Any]] = field(default_factory=list)
    on_the_way: dict[str, dict[str, float]] = field(default_factory=dict)
    lacking: bool = False

    @property
    def reason(self) -> str:
        """Why nothing else is known; empty if more is."""
        return self.failure and f"{'skipped' if self.lacking else 'failed'}: {self.failure}"


@dataclass(frozen=True)
class Skipped:
    """What a method skipped of a scene, and what that brought.

    Args:
        scene: name.
        method: name.
        stages: what was skipped, and how much of it.
        saved: milliseconds a frame less than the same method that skips nothing, without files; ``None`` where that was
            not measured.
        change: by name of a metric, by how much the error differs from that of the other.
    """

    scene: str
    method: str
    stages: str
    saved: float | None = None
    change: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Cost:
    """What one method costs at one size of image.

    Args:
        method: name.
        width: pixels.
        height: pixels.
        milliseconds: a frame, without files; ``None`` where it failed.
        failure: why, such as too little memory.
    """

    method: str
    width: int
    height: int
    milliseconds: Spread | None = None
    failure: str = ""


@dataclass(frozen=True)
class Fit:
    """How cost grows with the number of pixels: ``milliseconds = fixed + per_megapixel * megapixels``.

    The line through the medians with the least squares of relative deviations: each size counts the same.

    Args:
        method: name.
        fixed: milliseconds.
        per_megapixel: milliseconds.
        deviation: largest relative deviation of a measured median from the line.
    """

    method: str
    fixed: float
    per_megapixel: float
    deviation: float


@dataclass(frozen=True)
class Results:
    """Everything one run of the benchmark found out.

    Args:
        command: the command line that measured it.
        created: UTC time in ISO format.
        machine: where.
        rounds: how often each frame was denoised by each method, without the warm-up.
        scenes: in the order in which they were named.
        methods: in the order in which they are shown.
        cells: of each scene and each method that is not missing.
        costs: by method and size.
        fits: by method.
        version: of this format.
        notes: what to know about the run as a whole, such as a metric that was not computed, and why.
    """

    command: str
    created: str
    machine: Machine
    rounds: int
    scenes: list[Scene]
    methods: list[Method]
    cells: list[Cell]
    costs: list[Cost] = field(default_factory=list)
    fits: list[Fit] = field(default_factory=list)
    version: int = VERSION
    notes: list[str] = field(default_factory=list)

    @property
    def failed(self) -> bool:
        """Whether a method failed on a scene that has what it needs."""
        return any(one.failure and not one.lacking for one in self.cells)

    def cell(self, scene: str, method: str) -> Cell | None:
        """What is known of a method on a scene."""
        return next((one for one in self.cells if (one.scene, one.method) == (scene, method)), None)

    def skipped(self) -> list[Skipped]:
        """What each method skipped of each scene, where it did."""
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
        """How many pixels a method denoises, without reading and writing files."""
        scene = next(one for one in self.scenes if one.name == cell.scene)
        return scene.width * scene.height / 1e3 / cell.computing.median if cell.computing else None

    def write(self, folder: Path) -> None:
        """Write ``results.json``.

        Raises:
            InputError: it cannot be written.
            ValueError: a number is NaN or infinite, which is no JSON.
        """
        _write(folder / FILE, self)

    @classmethod
    def read(cls, folder: Path) -> Results:
        """Read ``results.json`` of a folder.

        Raises:
            InputError: the file is missing, damaged, or of another version.
        """
        path = folder / FILE
        expected = f"{path}: expected the results of `mcdenoise benchmark`, found"
        try:
            data = json.loads(read_text(path), parse_constant=_refuse)
            if isinstance(data, dict) and data.get("version") != VERSION:
                raise InputError(f"{path}: expected version {VERSION} of the format, found {data.get('version')!r}")
            results: Results = _made(cls, data, "it")
            _check(results)
        except FileNotFoundError as error:
            raise InputError(f"{expected} no such file") from error
        except OSError as error:
            raise InputError(f"{expected} none that can be read ({error.strerror})") from error
        except InputError:
            raise
        except RecursionError as error:
            raise InputError(f"{expected} damage: objects within objects without end") from error
        except ValueError as error:
            raise InputError(f"{expected} damage: {error}") from error
        return results


@dataclass(frozen=True)
class OpCost:
    """What one op costs in one backend and dtype, and how exact it is.

    Args:
        op: name in :mod:`mcdenoise.ops`.
        backend: ``torch`` for plain torch.
        dtype: such as ``float32``.
        case: of the op's cases, the one that was enlarged.
        milliseconds: of one call; ``None`` where it failed.
        error: largest relative error over the op's ordinary cases, against its equation in float64 on the same inputs;
            ``None`` where it failed.
        mebibytes: inputs and outputs together, each once: what must move at least.
        copy: milliseconds that a copy takes which moves as much.
        with_derivatives: milliseconds of one call and of its derivatives in all floating-point inputs; ``None`` where
            it has none.
        mebibytes_with_derivatives: what must move at least: with the inputs read once more, the results' derivatives
            read and those of the inputs written.
        copy_with_derivatives: milliseconds that a copy takes which moves as much.
        failure: why there is no result.
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
        """How many times as long as that copy it takes; 1 is as fast as memory is."""
        return self.milliseconds.median / self.copy if self.milliseconds and self.copy else None

    @property
    def over_copy_with_derivatives(self) -> float | None:
        """Likewise with the derivatives."""
        both = self.with_derivatives, self.copy_with_derivatives
        return both[0].median / both[1] if both[0] and both[1] else None


@dataclass(frozen=True)
class OpResults:
    """What ``mcdenoise benchmark --ops`` found out.

    Args:
        command: the command line that measured it.
        created: UTC time in ISO format.
        machine: where.
        width: pixels.
        height: pixels.
        rounds: calls of each, without the warm-up.
        bandwidth: of a copy in the same run, gigabytes (1e9) a second, read and written.
        costs: by op, backend and dtype.
        version: of this format.
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

    def write(self, folder: Path) -> None:
        """Write ``ops.json``.

        Raises:
            InputError: it cannot be written.
            ValueError: a number is NaN or infinite, which is no JSON.
        """
        _write(folder / OPS_FILE, self)


def _write(path: Path, results: Results | OpResults) -> None:
    write_text(path, json.dumps(asdict(results), indent=1, allow_nan=False) + "\n")


def _refuse(name: str) -> float:
    raise ValueError(f"{name}, which is no number")


def _made(kind: Any, value: Any, where: str) -> Any:
    """A value as the type that a field is annotated with, to any depth.

    Raises:
        ValueError: it is of another.
    """
    if isinstance(kind, types.UnionType):
        return None if value is None else _made(get_args(kind)[0], value, where)
    if is_dataclass(kind):
        return _made_of_fields(kind, value, where)
    holder, inner = get_origin(kind), get_args(kind)
    if holder is list and isinstance(value, list):
        return [_made(inner[0], one, f"{where}[{index}]") for index, one in enumerate(value)]
    if holder is dict and isinstance(value, dict):
        return {key: _made(inner[1], one, f"{where}.{key}") for key, one in value.items()}
    if holder is Literal and isinstance(value, str) and value in inner:
        return value
    # Whole numbers may be written where others are meant, but for true and false, which Python counts among them.
    if kind is float and type(value) in (int, float) and abs(value) <= _LARGEST:
        return float(value)
    # Beyond that they cannot be counted with.
    if kind is int and type(value) is int and abs(value) < 2**53:
        return value
    if kind is Any or (kind in (str, bool) and type(value) is kind):
        return value
    known = f"one of {', '.join(inner)}" if holder is Literal else getattr(kind, "__name__", str(kind))
    raise ValueError(f"{where} is {reprlib.repr(value)} in place of {known}")


# It takes longer than all else, and there are hundreds of cells.
_hints = functools.cache(get_type_hints)


def _made_of_fields(kind: Any, value: Any, where: str) -> Any:
    if not isinstance(value, dict):
        raise ValueError(f"{where} is {reprlib.repr(value)} in place of an object")
    hints = _hints(kind)
    if unknown := sorted(value.keys() - hints.keys()):
        raise ValueError(f"{where} has {reprlib.repr(unknown[0])}, which is unknown")
    needed = {one.name for one in fields(kind) if one.default is MISSING and one.default_factory is MISSING}
    if lacking := sorted(needed - value.keys()):
        raise ValueError(f"{where} has no '{lacking[0]}'")
    return kind(**{key: _made(hints[key], one, f"{where}.{key}") for key, one in value.items()})


def _check(results: Results) -> None:
    """See that what the parts say of one another is true, and that figures are such as are measured.

    Raises:
        ValueError: something is not.
    """

    def check(holds: bool, what: str) -> None:
        if not holds:
            raise ValueError(what)

    scenes, methods = [one.name for one in results.scenes], [one.name for one in results.methods]
    for kind, names in (("scenes", scenes), ("methods", methods)):
        check(bool(names), f"there are no {kind}")
        check(len(set(names)) == len(names), f"two {kind} have one name")
    for part in (*(scene.name for scene in results.scenes), *(method.folder for method in results.methods)):
        # Pictures are looked for in folders of these names.
        plain = part not in ("", ".", "..") and not {"/", "\\", "\0"} & set(part) and part.isprintable()
        check(plain and len(part.encode(errors="replace")) <= 255, f"{reprlib.repr(part)} is no name of a folder")
    for scene in results.scenes:
        check(min(scene.width, scene.height) > 0, f"{scene.name} has {scene.width} x {scene.height} pixels")
        for numbers in (scene.frames, scene.scored, scene.pictures):
            check(min(numbers, default=0) >= 0, f"{scene.name} has frame {min(numbers, default=0)}")
    for cell in results.cells:
        where = f"{reprlib.repr(cell.method)} on {reprlib.repr(cell.scene)}"
        check(cell.scene in scenes and cell.method in methods, f"{where} is of no scene or method")
        check(cell.memory is None or cell.memory >= 0, f"{where} takes {cell.memory} mebibytes")
        for spread in (cell.whole, cell.computing):
            _check_time(spread, where)
        for spread in cell.stages.values():
            _check_time(spread, where)
        for row in cell.plan:
            stage, skipped = row.get("stage"), row.get("skipped")
            true = isinstance(stage, str) and isinstance(skipped, int | float) and 0 <= skipped <= 1
            check(true, f"{where} has the plan {reprlib.repr(row)}")
    for cost in results.costs:
        check(cost.method in methods, f"a cost is of {reprlib.repr(cost.method)}, which is no method")
        check(min(cost.width, cost.height) > 0, f"a cost is of {cost.width} x {cost.height} pixels")
        _check_time(cost.milliseconds, reprlib.repr(cost.method))
    for fit in results.fits:
        check(fit.method in methods, f"a fit is of {reprlib.repr(fit.method)}, which is no method")


def _check_time(spread: Spread | None, where: str) -> None:
    if spread is not None and not (0 <= spread.lower <= spread.median <= spread.upper and spread.count > 0):
        raise ValueError(f"{where} takes {spread}")
