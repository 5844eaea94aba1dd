"""The benchmark: on every scene, the methods take turns frame by frame."""

from __future__ import annotations

import functools
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import groupby
from pathlib import Path

import torch
from torch import Tensor

from mcdenoise.benchmark.machine import check_device, describe_machine, fix_threads
from mcdenoise.benchmark.memory import Peaks
from mcdenoise.benchmark.methods import Timed, make_method
from mcdenoise.benchmark.sizes import Size, measure_sizes
from mcdenoise.benchmark.tables import write_csv
from mcdenoise.data import Sequence, open_sequence, write_exr
from mcdenoise.data.color_space import to_rec709
from mcdenoise.data.files import make_folder, new_folder
from mcdenoise.data.images import Metadata
from mcdenoise.data.sequences import with_unique_names
from mcdenoise.errors import InputError, MissingBufferError, in_one_line, naming
from mcdenoise.evaluate import METRICS, USUAL, Scores, check_references, reference_noise
from mcdenoise.frame import Frame
from mcdenoise.models._report import Stage, summarize
from mcdenoise.models._times import Stopwatch
from mcdenoise.results import IMAGES, STAGES, Cell, Method, Results, Scene, Spread

_WHOLE, _COMPUTING = "whole", "computing"
# This method returns its input; its run time is not divided into stages.
_IDENTITY = "noisy"


@dataclass(frozen=True)
class Settings:
    """Settings of a benchmark.

    Args:
        rounds: number of timed repetitions per frame, and per image size, after warming up.
        threads: number of threads of torch, of methods that do not use torch, and of reading and writing EXRs.
        device: ``"cpu"`` or ``"cuda"``.
        sizes: widths and heights for measuring run time over pixels, see :func:`mcdenoise.benchmark.parse_sizes`.
        pictures: maximum number of frames per scene whose images are stored.
        metrics: names in :data:`mcdenoise.evaluate.METRICS`.
        memory: whether to measure the peak memory of each method, in separate processes.
        command: the command line, to be stored with the results.

    Raises:
        InputError: a number is too small, or torch cannot use the device.
    """

    rounds: int = 3
    threads: int = 1
    device: str = "cpu"
    sizes: tuple[Size, ...] = ()
    pictures: int = 4
    metrics: tuple[str, ...] = USUAL
    memory: bool = True
    command: str = ""

    def __post_init__(self) -> None:
        for name, minimum in (("rounds", 1), ("threads", 1), ("pictures", 0)):
            if getattr(self, name) < minimum:
                raise InputError(f"--{name}: expected at least {minimum}, found {getattr(self, name)}")
        check_device(self.device)


def run_benchmark(
    sequences: list[Sequence],
    methods: list[Method],
    out: Path,
    settings: Settings | None = None,
    *,
    on_step: Callable[[int, int], None] = lambda done, total: None,
) -> Results:
    """Measure the run time and the error of each method on each scene.

    The methods take turns on each frame: A B C, A B C. The first pass over the frames warms up and is not timed; its
    images are compared with the references, and some are stored. Every further round is a timed pass. Every method sees
    all frames in order, so every history is correct; the first frame of a pass has no history and counts only in a
    sequence of one frame.

    The stages are ``read``, which reads all buffers of a frame and copies them to the device, once for all methods;
    the stages of :class:`Timed`; and ``write``, which copies the image back and writes it as ``mcdenoise denoise``
    does, into the folder of the results.

    Args:
        sequences: frames with references.
        methods: see :func:`choose_methods`; missing methods are listed as such.
        out: new or empty folder for ``results.json``, ``results.csv`` and ``images/SCENE/METHOD/N.exr``, which appear
            once the benchmark is complete.
        settings: settings of the measurement; this sets torch's number of threads.
        on_step: called with the number of finished steps and the number of all steps.

    Returns:
        The content of ``results.json``. A method that fails on a scene, or that is skipped there because the scene
        lacks a buffer, has a cell with the reason; a scene whose files cannot be read fails for all methods.

    Raises:
        InputError: a sequence has no references, ``out`` exists and is no empty folder, or it cannot be written to.
    """
    settings = settings or Settings()
    for sequence in sequences:
        check_references(sequence)
    fix_threads(settings.threads)
    total = sum((settings.rounds + 1) * len(sequence) for sequence in sequences)
    total += len(settings.sizes) * (settings.rounds + 2)
    steps = iter(range(1, total + 1))
    with new_folder(out) as folder:
        results = _measure(sequences, methods, folder, settings, lambda: on_step(next(steps), total))
        results.write(folder)
        write_csv(results, folder)
    return results


def _measure(
    sequences: list[Sequence], methods: list[Method], folder: Path, settings: Settings, step: Callable[[], None]
) -> Results:
    """Measure on every scene and at every size, and write the images."""
    skipped: dict[str, str] = {}
    made = _Made(methods, settings)
    scenes: list[Scene] = []
    cells: list[Cell] = []
    for sequence in with_unique_names(sequences):
        run = _SceneRun(sequence, made, folder, settings)
        scene, own = run.measure(step)
        skipped |= run.skipped
        scenes.append(scene)
        cells += own
    costs, fits = measure_sizes(
        [method for method in made.methods if method.model != _IDENTITY],
        made.denoisers,
        list(settings.sizes),
        rounds=settings.rounds,
        peaks=made.peaks,
        device=settings.device,
        on_step=step,
    )
    notes = [f"{name} is skipped where it cannot be computed: {reason}" for name, reason in skipped.items()]
    return Results(
        command=settings.command,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        machine=describe_machine(settings.device),
        rounds=settings.rounds,
        scenes=scenes,
        methods=methods,
        cells=cells,
        costs=costs,
        fits=fits,
        notes=notes,
    )


class _Made:
    """The constructed methods, the reasons why others could not be constructed, and their peak memory."""

    def __init__(self, methods: list[Method], settings: Settings) -> None:
        self.methods = [method for method in methods if not method.missing]
        self.denoisers: dict[str, Timed] = {}
        self.failures: dict[str, str] = {}
        self.peaks = Peaks(settings.threads, settings.device)
        for method in self.methods:
            try:
                self.denoisers[method.name] = make_method(method, threads=settings.threads, device=settings.device)
            except Exception as error:  # a method may raise any exception; the other methods continue
                self.failures[method.name] = in_one_line(error)


class _SceneRun:
    """Runs all methods on one scene."""

    def __init__(self, sequence: Sequence, made: _Made, folder: Path, settings: Settings) -> None:
        self.skipped: dict[str, str] = {}
        self._scores = {method.name: Scores(skipped=self.skipped) for method in made.methods}
        self._metrics = {name: METRICS[name] for name in METRICS if name in settings.metrics}
        self._sequence, self._made, self._settings = sequence, made, settings
        self._failures = dict(made.failures)
        self._lacking: set[str] = set()
        self._folder, self._written = folder, folder / ".written.exr"
        self._watch = Stopwatch(settings.device)
        self._times: dict[str, dict[str, list[float]]] = {method.name: {} for method in made.methods}
        self._planned: dict[str, list[list[Stage]]] = {method.name: [] for method in made.methods}
        height, width = sequence.size
        self._scene = Scene(
            sequence.name,
            width,
            height,
            sequence.numbers,
            sequence.reference_numbers,
            kept_frames(sequence.numbers, sequence.reference_numbers, settings.pictures),
            reference_noise(sequence),
        )

    def measure(self, on_step: Callable[[], None]) -> tuple[Scene, list[Cell]]:
        """Measure the scene: returns it, and a cell for each method that is not missing."""
        try:
            self._warm_up(on_step)
            for _ in range(self._settings.rounds):
                self._round(on_step)
        except InputError as error:
            # A frame cannot be read, so no method has seen the whole scene.
            reason = in_one_line(error)
            self._failures, self._lacking = {method.name: reason for method in self._made.methods}, set()
            self._scene = replace(self._scene, pictures=[])
            shutil.rmtree(self._folder / IMAGES / self._scene.name, ignore_errors=True)
        self._written.unlink(missing_ok=True)
        return self._scene, [self._cell(method) for method in self._made.methods]

    def _warm_up(self, on_step: Callable[[], None]) -> None:
        """Run every method on every frame once; score its images and store some of them."""
        for number, frame, _ in self._frames(reference=True):
            kept, metadata = number in self._scene.pictures, self._sequence.metadata(number)
            # With the primaries that the frames state, so that the report can show them.
            primaries = {name: x for name, x in metadata.items() if name == "chromaticities"}
            reference = None if frame.reference is None else to_rec709(frame.reference, metadata)
            if kept and frame.reference is not None:
                self._keep("reference", number, frame.reference, primaries)
            for method, timed in self._at_work():
                image: Tensor | None = None
                with self._noted(method.name):
                    image = timed(frame)
                    self._planned[method.name].append(list(timed.denoiser.report.stages.values()))
                    if reference is not None:
                        with torch.inference_mode():
                            shown = to_rec709(image, metadata)
                            self._scores[method.name].add(self._metrics, number, shown, reference)
                if kept and image is not None and method.name not in self._failures:
                    self._keep(method.folder, number, image, primaries)
            on_step()

    def _round(self, on_step: Callable[[], None]) -> None:
        first = self._sequence.numbers[0]
        for number, frame, reading in self._frames(reference=False):
            metadata = self._sequence.metadata(number)
            for method, timed in self._at_work():
                with self._noted(method.name):
                    start = self._watch.mark()
                    image = timed(frame)
                    done = self._watch.mark()
                    computing = self._watch.between(start, done)
                    start = self._watch.mark()
                    self._write(self._written, image, metadata)
                    writing = self._watch.between(start, self._watch.mark())
                    if number == first and len(self._sequence) > 1:
                        continue
                    taken = {
                        _WHOLE: reading + computing + writing,
                        _COMPUTING: computing,
                        "read": reading,
                        **({} if method.model == _IDENTITY else timed.stages),
                        "write": writing,
                    }
                    for stage, milliseconds in taken.items():
                        self._times[method.name].setdefault(stage, []).append(milliseconds)
            on_step()

    def _frames(self, *, reference: bool) -> Iterator[tuple[int, Frame, float]]:
        """Number and buffers of each frame, and the milliseconds of reading them."""
        for timed in self._made.denoisers.values():
            # A still is a shot of one frame, which needs no history.
            timed.denoiser.reset(frames=1 if len(self._sequence) == 1 else None)
        for number in self._sequence.numbers:
            start = self._watch.mark()
            frame = self._sequence.frame(number, reference=reference).to(self._settings.device)
            reading = self._watch.between(start, self._watch.mark())
            with naming(f"{self._sequence.root}, frame {number}"):
                frame, _ = frame.validate()
            yield number, frame, reading

    def _at_work(self) -> Iterator[tuple[Method, Timed]]:
        for method in self._made.methods:
            if method.name not in self._failures:
                yield method, self._made.denoisers[method.name]

    @contextmanager
    def _noted(self, name: str) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # a method may raise any exception; the other methods continue
            self._failures[name] = in_one_line(error)
            if isinstance(error, MissingBufferError):
                self._lacking.add(name)

    def _keep(self, folder: str, number: int, image: Tensor, metadata: Metadata) -> None:
        path = self._folder / IMAGES / self._scene.name / folder / f"{number}.exr"
        make_folder(path.parent)
        self._write(path, image, metadata)

    @staticmethod
    def _write(path: Path, image: Tensor, metadata: Metadata) -> None:
        pixels = image[0].permute(1, 2, 0).cpu().numpy()
        write_exr(path, pixels, ["R", "G", "B"], metadata=metadata)

    def _cell(self, method: Method) -> Cell:
        name = method.name
        if name in self._failures:
            shutil.rmtree(self._folder / IMAGES / self._scene.name / method.folder, ignore_errors=True)
            return Cell(self._scene.name, name, failure=self._failures[name], lacking=name in self._lacking)
        errors = self._scores[name].finite
        times = {stage: Spread.of(values) for stage, values in self._times[name].items()}
        frames = functools.partial(_first_two_frames, self._sequence.root, tuple(self._sequence.numbers[:2]))
        return Cell(
            self._scene.name,
            name,
            {metric: sum(values) / len(values) for metric, values in errors.items()},
            {metric: Spread.of(values) for metric, values in errors.items()},
            whole=times[_WHOLE],
            stages={stage: times[stage] for stage in STAGES if stage in times},
            memory=self._made.peaks.of(method, self._sequence.size, frames) if self._settings.memory else None,
            computing=times[_COMPUTING],
            plan=summarize(self._planned[name]),
        )


def kept_frames(numbers: list[int], scored: list[int], maximum: int) -> list[int]:
    """Successive frames that end at one with a reference: as many as there are, and of those the last.

    Example:
        >>> kept_frames([0, 1, 2, 3, 5, 6, 7, 8, 20], [2, 7], 3)
        [5, 6, 7]
    """
    runs = [[number for _, number in run] for _, run in groupby(enumerate(numbers), lambda pair: pair[1] - pair[0])]
    ends = [run[: run.index(number) + 1] for run in runs for number in run if number in scored]
    return max(ends, key=lambda run: (min(len(run), maximum), run[-1]), default=[])[-maximum:] if maximum else []


def _first_two_frames(root: Path, numbers: tuple[int, ...]) -> list[Frame]:
    sequence = open_sequence(root, ",".join(map(str, numbers)))
    return [sequence.frame(number, reference=False).validate()[0] for number in numbers]
