"""The command line: parses, calls, prints."""

# No postponed annotations here: tyro evaluates them, and those of a command's own imports are not global.

import contextlib
import functools
import io
import itertools
import json as jsonlib
import math
import shlex
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeRemainingColumn
from rich.table import Table

from mcdenoise.errors import InputError
from mcdenoise.heap import keep_heap

if TYPE_CHECKING:
    from mcdenoise.evaluate import Evaluation

Out = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
Json = Path | None

# With very many threads torch does not fail but crashes.
_MOST_THREADS = 1024

_SUMMARY = """usage: mcdenoise COMMAND [OPTIONS]

Interactive Monte Carlo denoising you can open up.

commands:
{commands}

`mcdenoise COMMAND --help` says everything about a command."""


def main(arguments: list[str] | None = None) -> None:
    """Run a command; exit status 0, 1 where a check failed, 2 for bad usage or bad input."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_summary())
        sys.exit(0 if arguments else 2)
    if arguments[0] == "--version":
        from importlib.metadata import version

        print(version("mcdenoise"))
        return
    name, rest = arguments[0], arguments[1:]
    keep_heap()
    if name not in COMMANDS:
        print(f"mcdenoise: unknown command '{name}'; expected one of {', '.join(COMMANDS)}", file=sys.stderr)
        sys.exit(2)
    try:
        status = _parse(COMMANDS[name](), rest, f"mcdenoise {name}")()
    except InputError as error:
        print(f"mcdenoise {name}: {' '.join(str(error).split())}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print(f"mcdenoise {name}: interrupted; finished files are kept", file=sys.stderr)
        sys.exit(130)
    sys.exit(status or 0)


def _parse(command: Callable[..., int | None], arguments: list[str], prog: str) -> Callable[[], int | None]:
    """A command with its arguments, ready to be called."""

    @functools.wraps(command)
    def bind(*args: Any, **kwargs: Any) -> Callable[[], int | None]:
        return functools.partial(command, *args, **kwargs)

    messages = io.StringIO()
    try:
        with contextlib.redirect_stderr(messages):
            return tyro.cli(bind, args=arguments, prog=prog)
    except SystemExit as stop:
        if not stop.code:
            raise
        # tyro frames its messages: a title, what is wrong, a rule, and more help.
        lines = [line.strip("│╭╮╰╯ ") for line in messages.getvalue().splitlines()]
        wrong = itertools.takewhile(lambda line: line.strip("─"), lines[1:])
        raise InputError(f"{' '.join(wrong).rstrip('.')}; see `{prog} --help`") from stop


def _summary() -> str:
    lines = [f"  {name:<10} {(make.__doc__ or '').splitlines()[0]}" for name, make in COMMANDS.items()]
    return _SUMMARY.format(commands="\n".join(lines))


# Each command is made by a function of its own, so that only the chosen one pays for its imports.


def _demo() -> Callable[..., int | None]:
    """Render a short animation at one sample a pixel, denoise it, and show the result."""
    from mcdenoise.demo import FRAMES, run_demo

    def demo(out: Out = Path("demo"), model: str = "cascaded", json: Json = None) -> None:
        """Render 16 frames of a small scene at one sample a pixel, denoise them, print errors and times.

        Ends with a report of error against run time: all models, and what other denoisers are installed.

        Args:
            out: folder to write to; what an earlier run rendered there is used again.
            model: name of a model with shipped weights.
            json: write the printed figures to this file too.
        """
        with _progress() as progress:
            rendering = progress.add_task("render", total=None)
            denoising = progress.add_task("denoise", total=FRAMES)
            comparing = progress.add_task("compare", total=None)
            result = run_demo(
                out,
                model=model,
                on_render=lambda done, total: progress.update(rendering, completed=done, total=total),
                on_frame=lambda: progress.advance(denoising),
                on_compare=lambda done, total: progress.update(comparing, completed=done, total=total),
            )
        scores = [asdict(score) for score in result.scores]
        _print_scores(scores)
        _print_times(result.report.milliseconds)
        print(f"clean frames: {result.denoised}\npicture: {result.picture}\nreport: {result.page}")
        _write_json(json, {"scores": scores, "milliseconds": result.report.milliseconds})

    return demo


def _denoise() -> Callable[..., int | None]:
    """Denoise a folder of frames."""
    import torch

    from mcdenoise.budget import choose_model
    from mcdenoise.data import open_sequence
    from mcdenoise.denoise import denoise_sequence
    from mcdenoise.denoiser import Denoiser, Precision
    from mcdenoise.plan import TOLERANCE, Plan

    def denoise(
        sequence: tyro.conf.Positional[Path],
        out: Out,
        model: str = "cascaded",
        weights: Path | None = None,
        frames: str | None = None,
        device: str = "cpu",
        threads: int | None = None,
        precision: Precision = "float32",
        alpha_min: float = 0.1,
        anti_lag: bool = False,
        full_float: bool = False,
        keep_all: bool = False,
        tolerance: float = TOLERANCE,
        budget_ms: float | None = None,
        max_error: float | None = None,
        results: Path | None = None,
        json: Json = None,
    ) -> None:
        """Denoise a folder of frames: writes OUT/denoisedN.exr and OUT/denoise.json.

        Args:
            sequence: folder of a sequence in a known layout.
            out: folder to write to.
            model: name of a model, see `mcdenoise models`.
            weights: safetensors file of your own weights for that model.
            frames: which frames, such as 0-59,70; all by default.
            device: cpu or cuda.
            threads: CPU threads; torch's choice by default.
            precision: of the network's convolutions; bfloat16 is faster on processors that have it.
            alpha_min: smallest weight of the current frame in the accumulation, in (0, 1].
            anti_lag: give up the accumulated past where the light has changed.
            full_float: write 32-bit instead of half floats.
            keep_all: leave nothing out, whether the sequence needs it or not.
            tolerance: noise, or change, relative to its mean, below which a tile of a still shot is not denoised again;
                0 leaves out only what makes no difference.
            budget_ms: take the shipped model and precision with the least error (or, where no error is known, the
                slowest) that needs no more milliseconds a frame on this machine, measured once and without files.
            max_error: take the fastest one with an SMAPE that is no larger.
            results: folder of a finished benchmark to take errors from; those of the sequence's references by default.
            json: write the run times to this file too.
        """
        if threads is not None:
            if not 1 <= threads <= _MOST_THREADS:
                raise InputError(f"--threads: expected 1 to {_MOST_THREADS}, found {threads}")
            torch.set_num_threads(threads)
        if not 0 < alpha_min <= 1:
            raise InputError(f"--alpha-min: expected in (0, 1], found {alpha_min}")
        opened = open_sequence(sequence, frames)
        if budget_ms is not None or max_error is not None:
            if weights is not None:
                raise InputError("--budget-ms, --max-error: expected no --weights, which are of one model")
            with _progress() as progress:
                task = progress.add_task("measure models", total=None)
                choice = choose_model(
                    opened,
                    budget=budget_ms,
                    max_error=max_error,
                    results=results,
                    device=device,
                    on_step=lambda done, total: progress.update(task, completed=done, total=total),
                )
            print(f"picked {choice}")
            model, precision = choice.model, choice.precision
        plan = Plan(keep_all=keep_all, tolerance=tolerance)
        denoiser = Denoiser(
            model,
            weights=weights,
            device=device,
            alpha_min=alpha_min,
            anti_lag=anti_lag,
            precision=precision,
            plan=plan,
        )
        height, width = opened.size
        print(f"{opened.name}: {opened.layout} layout, {len(opened)} frames of {width}x{height}")
        with _progress() as progress:
            task = progress.add_task("denoise", total=len(opened))
            report = denoise_sequence(
                opened,
                out,
                denoiser,
                str(weights or model),
                half=not full_float,
                on_frame=lambda frame, images: progress.advance(task),
            )
        for row in report.plan:
            print(f"  {row['stage']}: {_kept(row)} ({row['reason']}){'' if row['exact'] else ', up to the tolerance'}")
        if report.replaced_pixels:
            print(f"replaced {report.replaced_pixels} NaN, infinite or negative pixels of the noisy color")
        _print_times(report.milliseconds)
        _write_json(json, {"model": report.model, "milliseconds": report.milliseconds})

    return denoise


@dataclass(frozen=True)
class RenderOptions:
    """How a sequence is rendered, whatever the scene.

    Args:
        spp: samples a pixel of the noisy color.
        realisations: noisy colors of each frame, with independent noise.
        reference_spp: samples a pixel of the references; 0 renders none. With --noise-level the most.
        noise_level: refine each reference until its estimated SMAPE is this small, such as 0.02.
        reference_frames: which frames get a reference, such as 8-11; all by default.
        size: WIDTHxHEIGHT in pixels.
        workers: processes that render frames side by side; of use with scalar_rgb.
        variant: Mitsuba variant, such as scalar_rgb or llvm_ad_rgb; the fastest that works by default.
    """

    spp: int = 1
    realisations: int = 1
    reference_spp: int = 512
    noise_level: float | None = None
    reference_frames: str | None = None
    size: str = "640x360"
    workers: int = 1
    variant: str | None = None

    def arguments(self) -> dict[str, Any]:
        """Those of :func:`mcdenoise.render.render_sequence`."""
        from mcdenoise.data.sequences import parse_frames

        if self.reference_spp < 0:
            raise InputError(f"--reference-spp: expected at least 0, found {self.reference_spp}")
        frames = self.reference_frames
        referenced = None if frames is None else parse_frames(frames, name="--reference-frames")
        return {
            "spp": self.spp,
            "realisations": self.realisations,
            "reference_spp": max(self.reference_spp, 1),
            "noise_level": self.noise_level,
            "reference_frames": referenced if self.reference_spp > 0 else [],
            "size": _size(self.size),
            "workers": self.workers,
            "variant": self.variant,
        }


def _render() -> Callable[..., int | None]:
    """Render a Mitsuba 3 scene along a camera path to a noisy sequence with references."""
    from mcdenoise.render import load_shot, render_sequence

    def render(
        scene: tyro.conf.Positional[Path],
        camera_path: Path,
        out: Out,
        rendering: tyro.conf.OmitArgPrefixes[RenderOptions],
        frames: int | None = None,
        every: int = 1,
        seed: int = 0,
    ) -> None:
        """Render a Mitsuba 3 scene along a camera path to a sequence in the BMFR layout.

        The same command again resumes a run that was stopped; with more samples or less noise it refines references.

        Args:
            scene: Mitsuba 3 scene.xml.
            camera_path: JSON with 'fov' in degrees, and a list 'to_world' of 4x4 camera-to-world matrices or a list
                'frames' of cameras with 'position' and 'look_at'; or a folder of Tungsten scenes, one per frame.
                Objects of the scene move with 'objects': for each id a list of 4x4 matrices, one per frame.
            out: folder of the sequence; finished frames in it are kept.
            rendering: samples, references, size and processors.
            frames: render the first so many cameras; all by default.
            every: take only every n-th camera of the path.
            seed: of the noise.
        """
        if every < 1:
            raise InputError(f"--every: expected at least 1, found {every}")
        arguments = rendering.arguments()
        shot = load_shot(camera_path)
        with _progress() as progress:
            task = progress.add_task("render", total=None)
            written = render_sequence(
                scene,
                shot.cameras[::every],
                out,
                frames=frames,
                moves={name: path[::every] for name, path in shot.moves.items()},
                seed=seed,
                progress=lambda done, total: progress.update(task, completed=done, total=total),
                **arguments,
            )
        print(written)

    return render


def _generate() -> Callable[..., int | None]:
    """Render random scenes to train on."""
    from mcdenoise.data.sequences import parse_frames
    from mcdenoise.random_scene import random_scene
    from mcdenoise.render import render_sequence

    def generate(
        out: Out,
        rendering: tyro.conf.OmitArgPrefixes[RenderOptions] = RenderOptions(
            realisations=3, reference_spp=64, size="160x160"
        ),
        seeds: str = "0-15",
        frames: int = 12,
        zoom: float = 1.0,
        noise_seed: int | None = None,
    ) -> None:
        """Render random rooms, courts and still lifes to sequences to train on: OUT/random0000, OUT/random0001, ...

        The same seed is the same scene and noise anywhere. The same command again resumes a run that was stopped.

        Args:
            out: folder of the sequences; finished frames in it are kept.
            rendering: samples, references, size and processors.
            seeds: which scenes, such as 0-99,200.
            frames: frames of each sequence.
            zoom: render the middle of an image that is so many times as wide and high.
            noise_seed: of the noise of all scenes; by default each has the noise of its own seed.
        """
        if frames < 1:
            raise InputError(f"--frames: expected at least 1, found {frames}")
        if not 0 < zoom < math.inf:
            raise InputError(f"--zoom: expected a positive number, found {zoom:g}")
        chosen, arguments = parse_frames(seeds, name="--seeds"), rendering.arguments()
        with _progress() as progress:
            whole = progress.add_task("scenes", total=len(chosen))
            for seed in chosen:
                made = random_scene(seed, frames, zoom)
                task = progress.add_task(f"random{seed:04d}", total=None)

                def show(done: int, total: int, task: TaskID = task) -> None:
                    progress.update(task, completed=done, total=total)

                written = render_sequence(
                    made.scene,
                    made.cameras,
                    out / f"random{seed:04d}",
                    seed=seed if noise_seed is None else noise_seed,
                    moves=made.moves,
                    progress=show,
                    **arguments,
                )
                progress.remove_task(task)
                progress.advance(whole)
                print(written, flush=True)

    return generate


def _train() -> Callable[..., int | None]:
    """Train a model on sequences with references."""
    from mcdenoise.train import Progress as Report
    from mcdenoise.train import TrainConfig, is_first_process
    from mcdenoise.train import train as run

    def train(
        sequences: tyro.conf.Positional[list[Path]],
        out: Out,
        config: tyro.conf.OmitArgPrefixes[TrainConfig],
        validation: list[Path] = [],  # noqa: B006 - tyro reads it
        cache: Path | None = None,
        initial_weights: Path | None = None,
        accelerator: str = "cpu",
        checkpoint_every: int = 500,
        credits: str = "",
    ) -> None:
        """Train a model on sequences with references; the same command again resumes a run that was stopped.

        Args:
            sequences: folders of sequences with references, albedo, normal and depth.
            out: folder of the run: checkpoint, log, TensorBoard events, and at the end the weights.
            config: what to train.
            validation: folders of sequences that are used for nothing but validation.
            cache: folder of the decoded sequences, which several runs may share; OUT/cache by default.
            initial_weights: safetensors file of weights to start from.
            accelerator: cpu or cuda; for several devices or machines start the command with torchrun.
            checkpoint_every: steps between checkpoints.
            credits: authors and licences of the training scenes, stored with the weights.
        """
        console = Console(stderr=True)

        def report(progress: Report) -> None:
            scores = "".join(f"  validation {name} {value:.4f}" for name, value in progress.validation.items())
            line = f"step {progress.step}  loss {progress.loss:.4f}  {progress.seconds:.0f} s{scores}"
            console.print(line, soft_wrap=True)

        weights = run(
            config,
            sequences,
            out,
            validation=validation,
            cache=cache,
            initial_weights=initial_weights,
            accelerator=accelerator,
            checkpoint_every=checkpoint_every,
            credits=credits,
            report=report,
        )
        if is_first_process():
            print(weights)

    return train


def _evaluate() -> Callable[..., int | None]:
    """Compare a folder of denoised images with references."""
    from mcdenoise.data import open_sequence
    from mcdenoise.evaluate import evaluate_folder
    from mcdenoise.metrics.protocols import ProtocolName

    def evaluate(
        sequence: tyro.conf.Positional[Path],
        images: tyro.conf.Positional[Path],
        protocol: ProtocolName = "strict",
        frames: str | None = None,
        json: Json = None,
    ) -> None:
        """Compare a folder of denoised images, ours or not, with the references of a sequence.

        Args:
            sequence: folder of a sequence with references.
            images: folder of one EXR a frame, such as denoised12.exr or frame.0012.exr, scene-linear RGB.
            protocol: how a publication computed its numbers; they are printed beside the strict ones.
            frames: which frames, such as 0-59,70; all that have a reference by default.
            json: write the printed figures to this file too.
        """
        opened = open_sequence(sequence, frames)
        with _progress() as progress:
            task = progress.add_task("evaluate", total=len(opened.reference_numbers))
            result = evaluate_folder(opened, images, protocol=protocol, on_frame=lambda number: progress.advance(task))
        _print_evaluation(result)
        _write_json(json, result.as_json())

    return evaluate


def _benchmark() -> Callable[..., int | None]:
    """Measure error against run time of models and other denoisers."""
    import torch

    from mcdenoise.benchmark import Settings, benchmark_ops, choose_candidates, parse_sizes, run_benchmark
    from mcdenoise.benchmark.sizes import SIZES
    from mcdenoise.benchmark.tables import left_out_rows, op_rows, remarks, scene_rows
    from mcdenoise.data import open_sequence
    from mcdenoise.report import check_packages, write_report

    def benchmark(
        sequences: tyro.conf.Positional[list[Path]] = [],  # noqa: B006 - tyro reads it
        out: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = None,
        models: str | None = None,
        peers: str = "all",
        precisions: str = "float32,bfloat16",
        frames: str | None = None,
        rounds: int | None = None,
        threads: int | None = None,
        device: str = "cpu",
        sizes: str = SIZES,
        pictures: int = 4,
        keep_all: bool = False,
        ops: bool = False,
        size: str = "1280x720",
        json: Json = None,
    ) -> int:
        """Measure error against run time: models, other denoisers and doing nothing, on the same frames, taking turns.

        Writes OUT/index.html, the report, with its plots, results.json, results.csv and images; OUT must not exist.
        Exit status 1 if a method failed on a scene. With --ops, measures the operators instead: time, error, and how
        near they come to a copy.

        Args:
            sequences: folders of sequences with references.
            out: folder to make; needed except with --ops.
            models: names separated by commas, or safetensors files; by default all with shipped weights; or none.
            peers: oidn, bilateral, or all, or none. Doing nothing and accumulation alone are always there.
            precisions: of the models' convolutions: float32, bfloat16, or both.
            frames: which frames of each sequence, such as 0-59,70; all by default.
            rounds: how often each method denoises each frame, and each size; 3 by default, 5 with --ops.
            threads: CPU threads of all methods; torch's choice by default.
            device: cpu or cuda.
            sizes: of images of which only the cost is measured, such as 1280x720,3840x2160, or none.
            pictures: of how many frames of each scene images are kept.
            keep_all: measure each model a second time, leaving nothing out, to see what leaving out saves and costs.
            ops: measure the operators.
            size: of the images with --ops, WIDTHxHEIGHT.
            json: write what is in results.json, or ops.json, to this file too.
        """
        threads = torch.get_num_threads() if threads is None else threads
        if not 1 <= threads <= _MOST_THREADS:
            raise InputError(f"--threads: expected 1 to {_MOST_THREADS}, found {threads}")
        if ops == bool(sequences):
            raise InputError(
                "expected the folders of sequences, or --ops, and not both; see `mcdenoise benchmark --help`"
            )
        rounds = rounds if rounds is not None else 5 if ops else 3
        if ops:
            with _progress() as progress:
                task = progress.add_task("ops", total=None)
                costs = benchmark_ops(
                    size=_size(size),
                    rounds=rounds,
                    threads=threads,
                    device=device,
                    out=out,
                    command=_command(
                        "benchmark", "--ops", out=out, size=size, rounds=rounds, threads=threads, device=device
                    ),
                    on_step=lambda done, total: progress.update(task, completed=done, total=total),
                )
            _print_rows(op_rows(costs))
            print(f"a copy moves {costs.bandwidth:.1f} GB/s, read and written")
            _write_json(json, asdict(costs))
            return 0
        if out is None:
            raise InputError("--out: expected a folder to write to, found none; give one with -o")
        settings = Settings(
            rounds=rounds,
            threads=threads,
            device=device,
            sizes=tuple(parse_sizes(sizes)),
            pictures=pictures,
            command=_command(
                "benchmark",
                *sequences,
                *(["--keep-all"] if keep_all else []),
                out=out,
                models=models,
                peers=peers,
                precisions=precisions,
                frames=frames,
                rounds=rounds,
                threads=threads,
                device=device,
                sizes=sizes,
                pictures=pictures,
            ),
        )
        check_packages()
        opened = [open_sequence(sequence, frames) for sequence in sequences]
        candidates = choose_candidates(
            models, peers, precisions=precisions, threads=threads, device=device, keep_all=keep_all
        )
        with _progress() as progress:
            task = progress.add_task("benchmark", total=None)
            results = run_benchmark(
                opened,
                candidates,
                out,
                settings,
                on_step=lambda done, total: progress.update(task, completed=done, total=total),
            )
        _print_rows(scene_rows(results))
        _print_rows(left_out_rows(results))
        for line in [*remarks(results), f"report: {write_report(out)}"]:
            print(line)
        _write_json(json, asdict(results))
        return 1 if results.failed else 0

    return benchmark


def _report() -> Callable[..., int | None]:
    """Write the page and the plots of a finished benchmark."""
    from mcdenoise.report import write_report

    def report(folder: tyro.conf.Positional[Path]) -> None:
        """Write FOLDER/index.html and FOLDER/plots/ from the results and pictures of a finished benchmark.

        Args:
            folder: what `mcdenoise benchmark` wrote: results.json and images/.
        """
        print(write_report(folder))

    return report


def _gradcheck() -> Callable[..., int | None]:
    """Check first and second derivatives of the operators in float64."""
    from mcdenoise.gradcheck import check_case, select

    def gradcheck(ops: tyro.conf.Positional[list[str]] = [], json: Json = None) -> int:  # noqa: B006 - tyro reads it
        """Check first and second derivatives of the operators against finite differences, in float64, slow mode.

        Args:
            ops: names of operators; all by default.
            json: write the results to this file too.
        """
        table = Table("op", "case", "inputs", "result", "seconds")
        with _progress() as progress:
            results = [
                check_case(op, case) for op, case in progress.track(select(ops or None), description="gradcheck")
            ]
        for result in results:
            outcome = "ok" if result.passed else f"FAILED {result.message}"
            table.add_row(result.op, result.case, ", ".join(result.inputs), outcome, f"{result.seconds:.2f}")
        _show(table)
        _write_json(json, [asdict(result) for result in results])
        failed = sum(not result.passed for result in results)
        print(f"{len(results)} checks, {failed} failed")
        return 1 if failed else 0

    return gradcheck


def _stability() -> Callable[..., int | None]:
    """Check operators, models and the denoiser on stiff and extreme inputs, in every precision."""
    from mcdenoise.stability import FRAMES, Check, LongRun, as_json, parse_dtypes, stages

    def stability(
        ops: tyro.conf.Positional[list[str]] = [],  # noqa: B006 - tyro reads it
        models: list[str] = [],  # noqa: B006
        dtypes: list[str] = ["float32", "bfloat16", "float16"],  # noqa: B006
        frames: int = FRAMES,
        json: Json = None,
    ) -> int:
        """Check operators, models and the denoiser on ordinary, stiff and extreme inputs, and over thousands of frames.

        Errors are in units of the dtype's epsilon times the condition number of the case; bounds come from analysis.

        Args:
            ops: names of operators; all by default.
            models: names of models with shipped weights; all by default, none where operators are named.
            dtypes: precisions to try.
            frames: length of the long runs.
            json: write every check to this file too, and the errors of the long runs over time.
        """
        if frames < 1:
            raise InputError(f"--frames: expected at least 1, found {frames}")
        chosen = stages(ops or None, models or None, parse_dtypes(dtypes), frames)
        checks: list[Check] = []
        runs: list[LongRun] = []
        with _progress() as progress:
            for stage in progress.track(chosen, description="stability"):
                for result in stage.run():
                    checks.append(result) if isinstance(result, Check) else runs.append(result)
        _print_checks(checks)
        _print_long_runs(runs)
        _write_json(json, as_json(checks, runs))
        failed = sum(not check.passed for check in checks) + sum(not run.passed for run in runs)
        print(f"{len(checks) + len(runs)} checks, {failed} failed")
        return 1 if failed else 0

    return stability


def _models() -> Callable[..., int | None]:
    """List the models with their size and cost."""
    from mcdenoise.models import overview

    def models(json: Json = None) -> None:
        """List the models with parameters, operations per pixel, and whether weights are shipped.

        Args:
            json: write the list to this file too.
        """
        entries = overview()
        table = Table("model", "parameters", "kMAC per pixel", "weights", "what")
        for entry in entries:
            shipped = "shipped" if entry.pretrained else "-"
            table.add_row(
                entry.name, f"{entry.parameters:,}", f"{entry.kmacs_per_pixel:.1f}", shipped, entry.description
            )
        _show(table)
        _write_json(json, [asdict(entry) for entry in entries])

    return models


def _ops() -> Callable[..., int | None]:
    """List the operators with their error against the equations written out."""
    from mcdenoise.ops_overview import overview

    def ops(json: Json = None) -> None:
        """List the operators: what they do, what they are differentiable in, and their error in each precision.

        Args:
            json: write the list to this file too.
        """
        entries = overview()
        table = Table("op", "what", "differentiable in", "cases", "float32", "bfloat16", "float16")
        for entry in entries:
            errors = (f"{entry.errors[name]:.0e}" for name in ("float32", "bfloat16", "float16"))
            table.add_row(entry.name, entry.summary, ", ".join(entry.differentiable), str(entry.cases), *errors)
        _show(table)
        _write_json(json, [asdict(entry) for entry in entries])

    return ops


COMMANDS: dict[str, Callable[[], Callable[..., int | None]]] = {
    "demo": _demo,
    "denoise": _denoise,
    "render": _render,
    "generate": _generate,
    "train": _train,
    "evaluate": _evaluate,
    "benchmark": _benchmark,
    "report": _report,
    "gradcheck": _gradcheck,
    "stability": _stability,
    "models": _models,
    "ops": _ops,
}


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise InputError(f"--size: expected WIDTHxHEIGHT such as 1280x720, found '{text}'")
    return int(width), int(height)


def _command(*arguments: object, **options: object) -> str:
    """A command line with every choice in it, also those that were made by default."""
    chosen = [f"--{name}={value}" for name, value in options.items() if value is not None]
    return shlex.join(["mcdenoise", *map(str, arguments), *chosen])


def _progress() -> Progress:
    """A progress bar on stderr; silent when that is no terminal."""
    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeRemainingColumn(),
    )
    return Progress(*columns, console=console, disable=not console.is_terminal)


def _kept(row: dict[str, Any]) -> str:
    share = row["left_out"]
    return "kept" if share == 0 else "left out" if share == 1 else f"{share:.1%} left out"


def _show(table: Table) -> None:
    # A pipe has no width: never fold what a script may read.
    console = Console()
    Console(width=None if console.is_terminal else 200).print(table)


def _print_rows(rows: list[dict[str, str]]) -> None:
    if rows:
        table = Table(*rows[0])
        for row in rows:
            table.add_row(*row.values())
        _show(table)


def _print_scores(rows: list[dict[str, Any]]) -> None:
    table = Table("image", *rows[0]["values"], "frames")
    for row in rows:
        table.add_row(row["method"], *(f"{value:.4g}" for value in row["values"].values()), str(row["frames"]))
    _show(table)


def _print_checks(checks: list[Any]) -> None:
    """One row for each subject, dtype and backend: error and bound of what was nearest to its bound."""
    from mcdenoise.stability import summarize

    if not checks:
        return
    rows: dict[tuple[str, str, str], list[Any]] = {}
    for summary in summarize(checks):
        rows.setdefault((summary.subject, summary.dtype, summary.backend), []).append(summary)
    table = Table("what", "dtype", "backend", "checks", "condition", "forward", "gradient", "holds", "result")
    for key, summaries in rows.items():
        found = {summary.what: summary for summary in summaries}
        errors = []
        for what in ("forward", "gradient"):
            worst = found[what].worst if what in found else None
            errors.append(f"{worst.error:.2g} of {worst.allowed:.2g}" if worst and worst.allowed else "-")
        holds = ", ".join(what for what, summary in found.items() if not summary.failed)
        failed = [check for summary in summaries for check in summary.failed]
        result = "ok"
        if failed:
            result = f"{len(failed)} FAILED: {failed[0].what}, {failed[0].case}: {failed[0].message}"
        elif list(found) == ["runs"]:
            holds, result = "-", f"not run: {found['runs'].worst.message}"
        condition = max(summary.condition for summary in summaries)
        table.add_row(*key, str(sum(s.checks for s in summaries)), f"{condition:.1g}", *errors, holds, result)
    _show(table)


def _print_long_runs(runs: list[Any]) -> None:
    if not runs:
        return
    table = Table("long run", "dtype", "error after frames", "at most", "ghost", "result")
    for run in runs:
        over_time = ", ".join(f"{number}: {error:.1g}" for number, error in zip(run.frames, run.errors, strict=True))
        ghost = "-" if run.ghost is None else f"{run.ghost} frames"
        allowed = f"{run.allowed:.2g}" if run.allowed else "-"
        table.add_row(run.name, run.dtype, over_time or "-", allowed, ghost, "ok" if run.passed else run.message)
    _show(table)


def _print_evaluation(result: "Evaluation") -> None:
    strict = result.tables["strict"]
    for name, own in result.tables.items():
        columns = []
        for metric in own.mean:
            columns.append((metric, own, "" if own is strict else name))
            # Only these are the same quantity; a protocol's SMAPE may be one of displayed values.
            if own is not strict and metric in ("PSNR", "SSIM") and metric in strict.mean:
                columns.append((metric, strict, "strict"))
        table = Table("frame", *(f"{metric} {of}".strip() for metric, _, of in columns))
        for number in own.frames:
            table.add_row(str(number), *(_figure(of.frames[number].get(metric)) for metric, of, _ in columns))
        table.add_section()
        table.add_row("mean", *(_figure(of.mean[metric]) for metric, of, _ in columns))
        if own is strict and result.floor:
            table.add_row("perfect", *(_figure(result.floor.get(metric)) for metric, _, _ in columns))
        if columns:
            _show(table)
        print(f"{name}: {own.description}")
        for reason in dict.fromkeys(own.left_out.values()):
            without = [metric for metric, why in own.left_out.items() if why == reason]
            print(f"{name}: no {', '.join(without)}: {reason}")
    if result.warping_error:
        ours, theirs = result.warping_error
        print(f"warping error (Lai et al. 2018): {ours:.4g}; of the references {theirs:.4g}")
    if result.reference_noise is not None:
        print(
            f"perfect: estimate of what the truth would score, since the references' own SMAPE against it is about "
            f"{result.reference_noise:.4g}"
        )


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _print_times(milliseconds: dict[str, float]) -> None:
    stages = ", ".join(f"{stage} {value:.1f}" for stage, value in milliseconds.items())
    print(f"milliseconds a frame (median): {stages}; together {sum(milliseconds.values()):.1f}")


def _write_json(path: Path | None, content: Any) -> None:
    if path is not None:
        from mcdenoise.data.files import write_text

        write_text(path, jsonlib.dumps(content, indent=2) + "\n")
