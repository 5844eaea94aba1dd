"""Benchmarks: turns of the methods, errors, run times, failures, memory, sizes, operators, and skipping."""

import csv
import functools
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from commands import refuses, silently
from refusals import refused
from torch import Tensor, nn
from toys import small

import mcdenoise.benchmark.memory
import mcdenoise.benchmark.sizes
import mcdenoise.evaluate
from mcdenoise.benchmark import Settings, Timed, benchmark_ops, choose_methods, make_method, run_benchmark
from mcdenoise.benchmark.memory import peak_memory
from mcdenoise.benchmark.operators import largest_case
from mcdenoise.benchmark.sizes import synthetic_frame
from mcdenoise.check.cases import OPS
from mcdenoise.data import open_sequence, read_exr, write_exr
from mcdenoise.data.camera_matrices import read_camera_matrices, write_camera_matrices
from mcdenoise.denoiser import Denoiser
from mcdenoise.errors import InputError
from mcdenoise.evaluate import Scores, evaluate_method
from mcdenoise.frame import Frame
from mcdenoise.models import Accumulated, Demodulated, Model, Needs, Output
from mcdenoise.models._weights import find_weights
from mcdenoise.results import Cell, Method, Results

METRICS = {"SMAPE", "relMSE", "PSNR", "SSIM", "tSMAPE", "tRMSE"}


@pytest.fixture(autouse=True)
def _what_takes_a_while(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw no report, and start no process that measures memory, except for tests marked by that fixture."""
    LOG.clear()
    ACTS.clear()
    if "measures_memory" not in request.fixturenames:
        monkeypatch.setattr(mcdenoise.benchmark.memory, "peak_memory", lambda *_, **__: None)
    monkeypatch.setattr("mcdenoise.cli.benchmark.write_report", lambda folder: folder / "index.html")


@pytest.fixture
def measures_memory() -> None:
    """A fixture for tests that measure memory."""


def run(*arguments: Any) -> str:
    return silently("benchmark", *arguments, "--threads", 1)


def half() -> Model:
    return Demodulated(Accumulated(lambda color: color / 2))


# Functions of scripted methods by name, and the log of their calls.
ACTS: dict[str, Callable[[Frame], Tensor]] = {}
LOG: list[str] = []


class Scripted:
    """A method that logs its calls, marks the first of a shot, and applies its function to the frame."""

    needs = Needs(trainable=False)

    def __init__(self, act: str) -> None:
        self._name = act

    def __call__(self, frame: Frame, state: Tensor | None = None) -> tuple[Output, Tensor]:
        LOG.append(self._name + ("" if state is not None else "!"))
        return Output(ACTS[self._name](frame)), torch.zeros(1)


def unmakeable() -> Model:
    return 1 / 0  # type: ignore[return-value]


def own(name: str, factory: str, **settings: Any) -> Method:
    return Method(name, "fixed", name.replace(" ", "-"), f"{__name__}:{factory}", settings)


def scripted(name: str, act: Callable[[Frame], Tensor] = lambda frame: frame.color / 2) -> Method:
    ACTS[name] = act
    return own(name, "Scripted", act=name)


def test_methods_take_turns_frame_by_frame(small_sequence: Path, out: Path) -> None:
    steps: list[tuple[int, int]] = []
    methods = [scripted(name) for name in "ABC"]
    settings = Settings(rounds=2, sizes=((16, 12),))
    results = run_benchmark(
        [open_sequence(small_sequence, "0-2")], methods, out, settings, on_step=lambda *step: steps.append(step)
    )
    one_pass = ["A!", "B!", "C!", *"ABC" * 2]
    # The warm-up and two rounds over the frames; then two warm-up calls and two rounds of the size.
    assert [*one_pass * 4, *"ABC"] == LOG
    assert steps == [(step, 13) for step in range(1, 14)]
    for cell in results.cells:
        # The first of three frames, which has no history, does not count.
        assert {spread.count for spread in (cell.whole, cell.computing, *cell.stages.values())} == {2 * 2}
        # The run time of a method that reports no stages counts as filter.
        assert list(cell.stages) == ["read", "accumulate", "filter", "write"]
    assert [(cost.method, cost.width, cost.height) for cost in results.costs] == [(name, 16, 12) for name in "ABC"]
    assert {cost.milliseconds.count for cost in results.costs} == {2}


def test_sizes_have_a_history_after_a_still(small_sequence: Path, out: Path) -> None:
    alone: list[bool] = []

    def look(frame: Frame) -> Tensor:
        alone.append(frame.hints.alone)
        return frame.color / 2

    run_benchmark(
        [open_sequence(small_sequence, "2")], [scripted("A", look)], out, Settings(rounds=1, sizes=((16, 12),))
    )
    assert alone == [True] * 2 + [False] * 3


def test_errors_and_pictures_are_of_the_images(small_sequence: Path, out: Path) -> None:
    sequence = open_sequence(small_sequence)
    # This method has no history, but its images must be in order too.
    baselines = choose_methods("none")
    assert [method.name for method in baselines] == ["noisy", "accumulated"]
    methods = [*baselines, own("half", "half")]
    results = run_benchmark([sequence], methods, out, Settings(rounds=1, pictures=2))
    for cell, method in zip(results.cells, methods, strict=True):
        denoiser = make_method(method).denoiser
        strict = evaluate_method(sequence, denoiser, method.name).tables["strict"]
        assert {name: cell.errors[name] for name in METRICS} == pytest.approx(
            {name: strict.mean[name] for name in METRICS}, rel=1e-5
        )
        assert {name: spread.count for name, spread in cell.errors_spread.items()}.items() >= {
            ("SMAPE", 4),
            ("tSMAPE", 3),
        }
        assert cell.whole.median > cell.computing.median
        in_memory = [cell.stages[stage].lower for stage in cell.stages if stage not in ("read", "write")]
        assert cell.computing.median >= sum(in_memory)
    noisy, accumulated, ours = results.cells
    assert list(noisy.stages) == ["read", "write"]
    assert list(accumulated.stages) == list(ours.stages) == ["read", "accumulate", "filter", "write"]
    assert results.scenes[0].pictures == [2, 3]
    written = sorted(path.relative_to(out).as_posix() for path in out.rglob("*.exr"))
    folders = ("accumulated", "half", "noisy", "reference")
    assert written == [f"images/plane/{folder}/{number}.exr" for folder in folders for number in (2, 3)]
    frame = sequence.frame(3)
    for folder, image in (("noisy", frame.color), ("reference", frame.reference)):
        pixels, channels, _ = read_exr(out / "images" / "plane" / folder / "3.exr")
        assert channels == ["R", "G", "B"]
        np.testing.assert_allclose(pixels, image[0].permute(1, 2, 0).numpy(), rtol=1e-3, atol=1e-6)


def test_errors_are_those_of_evaluate_in_other_primaries(small_sequence: Path, out: Path) -> None:
    acescg = (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)
    for path in (small_sequence / "inputs").glob("color*.exr"):
        pixels, channels, _ = read_exr(path)
        write_exr(path, pixels, channels, metadata={"chromaticities": acescg})
    sequence = open_sequence(small_sequence)
    results = run_benchmark([sequence], choose_methods("none"), out, Settings(rounds=1))
    strict = evaluate_method(sequence, Denoiser("noisy"), "noisy").tables["strict"].mean
    errors = results.cell("plane", "noisy").errors
    assert {name: errors[name] for name in METRICS} == pytest.approx({name: strict[name] for name in METRICS}, rel=1e-5)


def test_a_method_that_fails_on_one_scene_leaves_the_rest_alone(small_sequence: Path, out: Path) -> None:
    def cannot_do_frame_1(frame: Frame) -> Tensor:
        if LOG.count("unlucky") == 1 and LOG.count("unlucky!") == 1:
            raise RuntimeError("out of\nluck")
        return frame.color

    methods = [
        scripted("unlucky", cannot_do_frame_1),
        scripted("not a number", lambda frame: frame.color * torch.nan),
        scripted("fine"),
        own("unmakeable", "unmakeable"),
    ]
    # With the same scene twice, names are unique, and a method that failed on one is run on the other.
    sequences = [open_sequence(small_sequence, "0-1")] * 2
    results = run_benchmark(sequences, methods, out, Settings(rounds=1, sizes=((16, 12),)))
    assert [scene.name for scene in results.scenes] == ["plane", "plane (2)"]
    assert results.failed
    failures = {(cell.scene, cell.method): cell.failure.partition(";")[0] for cell in results.cells}
    assert failures == {
        (scene, method): failure
        for scene in ("plane", "plane (2)")
        for method, failure in {
            "unlucky": "RuntimeError: out of luck" if scene == "plane" else "",
            "not a number": "model: expected finite radiance, found 480 NaN or infinite pixels",
            "fine": "",
            "unmakeable": f"model '{__name__}:unmakeable': the factory fails: ZeroDivisionError: division by zero",
        }.items()
    }
    for cell in results.cells:
        assert bool(cell.failure) is not bool(cell.errors)
        assert bool(cell.failure) is (cell.whole is None)
    assert sorted(path.name for path in (out / "images" / "plane").iterdir()) == ["fine", "reference"]
    assert Results.read(out) == results


def test_nothing_is_left_of_a_run_that_is_interrupted(small_sequence: Path, out: Path) -> None:
    def interrupt(frame: Frame) -> Tensor:
        raise KeyboardInterrupt

    before = sorted(out.parent.iterdir())
    with pytest.raises(KeyboardInterrupt):
        run_benchmark([open_sequence(small_sequence)], [scripted("A", interrupt)], out)
    assert sorted(out.parent.iterdir()) == before


def test_temporal_errors_use_successive_frames_and_infinite_values_are_skipped() -> None:
    errors = Scores()
    metrics = {name: mcdenoise.evaluate.METRICS[name] for name in METRICS}
    reference = torch.full((1, 3, 16, 16), 0.25)
    for number, level in ((3, 0.25), (4, 0.5), (6, 0.75)):
        errors.add(metrics, number, torch.full_like(reference, level), reference)
    # |x - y| / (x + y + 0.01) of 0, 0.25 and 0.5; frame 6 has no previous frame.
    smape = [0, 0.25 / 0.76, 0.5 / 1.01]
    assert errors.finite["SMAPE"] == pytest.approx(smape)
    assert len(errors.finite["tSMAPE"]) == len(errors.finite["tRMSE"]) == 1
    # The first image equals its reference.
    assert "PSNR" not in errors.finite


def test_a_metric_that_cannot_be_computed_is_skipped_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    errors = Scores()
    metrics = {name: mcdenoise.evaluate.METRICS[name] for name in ("SMAPE", "SSIM", "FLIP")}
    image = torch.full((1, 3, 10, 20), 0.5)
    errors.add(metrics, 0, image, image)
    assert errors.finite == {"SMAPE": [0]}
    assert "11 x 11 pixels, found 10 x 20" in errors.skipped["SSIM"]
    assert "flip-evaluator" in errors.skipped["FLIP"]
    with pytest.raises(ValueError, match="reference:"):
        errors.add(metrics, 0, image[..., :6], image)


def absent(quality: str = "high") -> Model:
    try:
        import no_such_package  # type: ignore[import-not-found]
    except ImportError as error:
        raise InputError("this method needs no_such_package, which is not installed") from error
    return no_such_package.make(quality)


def test_missing_methods_are_listed_as_missing(
    small_sequence: Path, weights: Path, out: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    out.mkdir()
    file = out.parent / "copy.json"
    models = f"{__name__}:half,{__name__}:absent(quality=fast|high),{weights}"
    printed = run(
        small_sequence, "-o", out, "--models", models, "--rounds", 1, "--sizes", "24x20,48x40", "--json", file
    )
    results = Results.read(out)
    present = ["noisy", "accumulated", f"{__name__}:half", "small", "small, bfloat16"]
    missing = [f"{__name__}:absent(quality={quality})" for quality in ("fast", "high")]
    assert [method.name for method in results.methods] == [*present[:3], *missing, *present[3:]]
    assert [method.name for method in results.methods if method.missing] == missing
    assert results.methods[4].missing == "this method needs no_such_package, which is not installed"
    assert results.methods[4].settings == {"quality": "high"}
    assert [cell.method for cell in results.cells] == present
    assert "FLIP is skipped where it cannot be computed: FLIP needs flip-evaluator" in results.notes[0]
    assert all(set(cell.errors) >= METRICS and "FLIP" not in cell.errors for cell in results.cells)
    own = results.methods[-1]
    assert own.parameters == sum(parameter.numel() for parameter in small("cascaded").parameters())
    assert (own.model, own.weights, own.precision) == ("cascaded", str(weights), "bfloat16")
    assert [fit.method for fit in results.fits] == present[1:]
    assert json.loads(file.read_text()) == asdict(results)

    # The best method is printed first, and missing methods and skipped metrics below the table.
    order = [line.split("│")[2].strip() for line in printed.splitlines() if "│" in line]
    assert sorted(order) == sorted(present)
    smape = [cell.errors["SMAPE"] for name in order for cell in results.cells if cell.method == name]
    assert smape == sorted(smape)
    line = f"missing: {'; '.join(missing)}: {results.methods[4].missing}"
    assert printed.splitlines()[-3:] == [line, results.notes[0], f"report: {out / 'index.html'}"]

    with (out / "results.csv").open(newline="") as text:
        rows = list(csv.DictReader(text))
    assert [row["method"] for row in rows] == [method.name for method in results.methods]
    by_method = {row["method"]: row for row in rows}
    for cell in results.cells:
        row = by_method[cell.method]
        assert (row["scene"], row["width"], row["height"], row["failure"]) == ("plane", "24", "20", "")
        assert {name: float(row[name]) for name in cell.errors} == cell.errors
        assert (float(row["ms lower"]), float(row["whole ms"])) == (cell.computing.lower, cell.whole.median)
    assert by_method[missing[0]]["failure"].startswith("missing: ")


def demanding() -> Any:
    return lambda color, roughness: color


def test_a_method_is_skipped_on_scenes_that_lack_its_buffers(small_sequence: Path, out: Path) -> None:
    """One line names the missing buffers and alternative methods, and the other methods are compared."""
    for path in (small_sequence / "inputs").glob("shading_normal*"):
        path.unlink()
    models = f"svgf,asvgf,{__name__}:demanding,guided"
    printed = run(*(small_sequence, "-o", out, "--models", models, "--frames", "0-1", "--rounds", 1, "--sizes", "none"))
    results = Results.read(out)
    assert not results.failed
    lacking = {cell.method: cell.failure for cell in results.cells if cell.lacking}
    assert list(lacking) == ["svgf", "asvgf", f"{__name__}:demanding"]
    assert lacking["svgf"] == lacking["asvgf"]
    assert lacking["svgf"].startswith("buffer 'normal': the model needs it, found only albedo, color, depth, position")
    assert "or take a model that does without: accumulated, " in lacking["svgf"]
    assert [cell.method for cell in results.cells if cell.errors] == ["noisy", "accumulated", "guided"]
    for method, failure in lacking.items():
        assert f"skipped: plane, {method}: {failure}\n" in printed
    assert not (out / "images" / "plane" / "svgf").exists()
    # Any other error is a failure.
    assert Results.read(out).cells[2].reason == f"skipped: {lacking['svgf']}"
    assert Cell("plane", "svgf", failure="out of luck").reason == "failed: out of luck"


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ((), "expected a new or an empty folder, found files in it; choose another folder, or remove what is there"),
        (("--models", "cascade"), "model 'cascade': found no model of this name; did you mean cascaded"),
        (("--models", "wild,wild"), "methods: expected different names"),
        (("--models", "wild(size)"), "expected settings such as (setting=value), found 'size'"),
        (("--models", "wild(hue=3)"), "argument 'hue': expected an argument of Denoiser or a setting of model"),
        (("--models", "nowhere.py:make"), "nowhere.py: expected a Python file with a factory of a model"),
        (("--precisions", "float8"), "--precisions: expected some of float32, bfloat16"),
        (("--device", "tpu"), "--device: expected cpu or cuda, found 'tpu'"),
        (("--rounds", 0), "--rounds: expected at least 1, found 0"),
        (("--pictures", -1), "--pictures: expected at least 0, found -1"),
        (("--sizes", "320"), "--sizes: expected WIDTHxHEIGHT up to 16384"),
        (("--sizes", "0x9"), "--sizes: expected WIDTHxHEIGHT up to 16384"),
        (("--frames", "7"), "expected frame 7"),
        (("--ops",), "op: expected one of"),
    ],
)
def test_bad_arguments_are_rejected_before_measuring(
    small_sequence: Path, out: Path, arguments: tuple[Any, ...], expected: str
) -> None:
    out.mkdir()
    (out / "old").touch()
    cheap = () if "--models" in arguments else ("--models", "none")
    assert expected in refuses("benchmark", small_sequence, "-o", out, *cheap, *arguments)
    assert {path.name for path in out.parent.iterdir()} == {small_sequence.name, out.name}
    assert [path.name for path in out.iterdir()] == ["old"]


def test_some_methods_in_some_precisions() -> None:
    names = "wild(alpha_min=0.1|0.2), wild_small"
    methods = choose_methods(names, precisions="bfloat16", keep_all=True, baselines=())
    base = ["wild(alpha_min=0.1)", "wild(alpha_min=0.2)", "wild_small"]
    assert [method.name for method in methods] == [
        f"{name}, bfloat16{more}" for name in base for more in ("", ", keep all")
    ]
    assert methods[0].folder == "wild-alpha_min-0.1-bfloat16"
    denoiser = make_method(methods[3]).denoiser
    assert (denoiser.precision, denoiser.keep_all) == ("bfloat16", True)
    (accumulated,) = (part for part in denoiser.model.modules() if isinstance(part, Accumulated))
    assert accumulated.alpha_min == 0.2


def test_a_method_named_twice_is_measured_once_and_two_of_one_name_are_refused(tmp_path: Path) -> None:
    name = "wild_small"
    twice = [method.name for method in choose_methods(f"{name},pretrained", precisions="bfloat16")]
    assert twice.count(f"{name}, bfloat16") == 1
    mine = tmp_path / f"{name}.safetensors"
    mine.write_bytes(find_weights(name).read_bytes())  # type: ignore[union-attr]
    assert re.search(rf"'{name}' .*{name} and .*{name}\.safetensors", refused(choose_methods, f"{name},{mine}"))


def test_a_users_convolution_counts_as_network_and_other_code_as_filter() -> None:
    class Own(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.inside = nn.ModuleDict({"convolution": nn.Conv2d(3, 3, 3, padding=1)})

        def forward(self, color: Tensor) -> Tensor:
            time.sleep(0.02)
            return self.inside["convolution"](color).abs()

    frame = synthetic_frame(24, 20)
    timed = Timed(Denoiser(Own()))
    timed(frame)
    assert timed.stages["filter"] > 20
    assert 0 < timed.stages["network"] < 20
    timed = Timed(Denoiser(lambda color: time.sleep(0.02) or color))
    timed(frame)
    assert set(timed.stages) == {"accumulate", "filter"}
    assert timed.stages["filter"] > 20


class Greedy:
    """Allocates 64 MiB while it runs."""

    def __init__(self) -> None:
        self.weights = torch.ones(2**22)

    def __call__(self, frame: Frame) -> Tensor:
        return frame.color * torch.ones(3 * 2**22).mean()


def two_frames() -> list[Frame]:
    return [synthetic_frame(24, 20)] * 2


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="threads are counted as Linux lists them")
def test_what_the_fork_server_imports_computes_nothing() -> None:
    """The threads of OpenMP would be missing in the processes that it forks, which then wait for them."""
    count = "len(os.listdir('/proc/self/task'))"
    code = f"import os, torch, numpy; before = {count}; import mcdenoise.benchmark.run; print({count} - before)"
    environment = os.environ | {"OMP_NUM_THREADS": "4"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout == "0\n"


@pytest.mark.usefixtures("measures_memory")
def test_peak_memory_is_that_of_the_method() -> None:
    peak = peak_memory(Greedy, two_frames, threads=1, device="cpu")
    if peak is None:
        pytest.skip("this system does not tell the peak of the resident set")
    # 16 MiB of weights, 48 MiB of temporary memory, and little else.
    assert 64 <= peak < 72
    assert peak_memory(lambda: Greedy(), two_frames, threads=1, device="cpu") is None
    assert peak_memory(Greedy, functools.partial(synthetic_frame, -1, -1), threads=1, device="cpu") is None


class Stuck(Greedy):
    """Writes the id of its process to a file, and never ends."""

    def __init__(self, file: Path) -> None:
        file.write_text(str(os.getpid()))
        time.sleep(600)


def wait_for_end(process: int) -> None:
    while Path(f"/proc/{process}").exists():
        time.sleep(0.05)


@pytest.mark.usefixtures("measures_memory")
@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="memory is not measured here")
def test_a_method_that_hangs_is_given_up(tmp_path: Path) -> None:
    stuck = functools.partial(Stuck, tmp_path / "process")
    assert peak_memory(stuck, two_frames, threads=1, device="cpu", seconds=10) is None
    wait_for_end(int((tmp_path / "process").read_text()))


def test_ops_are_compared_with_their_equation_and_with_a_copy(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcdenoise.benchmark.operators, "_COPY_BYTES", 2**20)
    names = ("kernel_conv", "downsample")
    # The equation, a loop over pixels, takes long.
    ops = [replace(each, cases=(largest_case(each),)) for each in OPS if each.name in names]
    results = benchmark_ops(size=(33, 20), rounds=3, out=out, ops=ops)
    limits = {"float32": 2e-6, "bfloat16": 2e-2, "float16": 3e-3}
    by_name = {(cost.op, cost.dtype): cost for cost in results.costs if cost.backend == "torch"}
    assert list(by_name) == [(op.name, dtype) for op in ops for dtype in limits]
    # Another backend may not run here.
    assert not any(cost.failure for cost in by_name.values())
    for cost in (cost for cost in results.costs if not cost.failure):
        assert cost.error < limits[cost.dtype]
        assert cost.milliseconds.count == 3
        assert cost.copy == pytest.approx(cost.mebibytes * 2**20 / (results.bandwidth * 1e9) * 1e3)
        assert (cost.with_derivatives is None) is (cost.backend == "numba")
    assert by_name["downsample", "bfloat16"].error > 1e-4
    # A kernel of 25 taps reads 25 values and an RGB image per pixel, and writes an RGB image.
    assert by_name["kernel_conv", "float32"].mebibytes == (25 + 3 + 3) * 33 * 20 * 4 / 2**20
    # Derivatives read the kernel and both images again, and write the derivatives of kernel and image.
    assert by_name["kernel_conv", "float32"].mebibytes_with_derivatives == (31 + 31 + 28) * 33 * 20 * 4 / 2**20
    # Downsampling keeps a quarter of the pixels of three channels.
    assert by_name["downsample", "float32"].mebibytes == 3 * (33 * 20 + 17 * 10) * 4 / 2**20

    stored = json.loads((out / "ops.json").read_text())
    assert (stored["width"], stored["height"], stored["bandwidth"]) == (33, 20, results.bandwidth)
    with (out / "ops.csv").open(newline="") as text:
        rows = list(csv.DictReader(text))
    assert len(stored["costs"]) == len(rows) == len(results.costs)
    for row, cost in zip(rows, stored["costs"], strict=True):
        assert (row["op"], row["backend"], row["dtype"]) == (cost["op"], cost["backend"], cost["dtype"])
        if not cost["failure"]:
            assert float(row["ms"]) == cost["milliseconds"]["median"]


def test_the_command_for_ops(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcdenoise.benchmark.operators, "_COPY_BYTES", 2**20)
    file = out.parent / "ops.json"
    printed = run("--ops", "downsample", "--sizes", "16x12", "--rounds", "2", "--json", file)
    written = json.loads(file.read_text())
    assert f"a copy moves {written['bandwidth']:.1f} GB/s" in printed
    assert {cost["op"] for cost in written["costs"]} == {"downsample"}
    assert not out.exists()
    refuses("benchmark", "--ops", "--sizes", "1x1")


def test_methods_are_also_measured_without_skipping(small_sequence: Path, out: Path) -> None:
    # A static camera: all frames have the matrix and the position of the first.
    inputs = small_sequence / "inputs"
    matrices = read_camera_matrices(inputs / "camera_matrices.h")
    still = replace(matrices, matrices=matrices.matrices[[0, 0, 0, 0]])
    write_camera_matrices(inputs / "camera_matrices.h", still, "plane")
    for number in (1, 2, 3):
        for name in ("world_position", "depth", "shading_normal", "albedo"):
            shutil.copy(inputs / f"{name}0.exr", inputs / f"{name}{number}.exr")
    arguments = (small_sequence, "-o", out, "--models", "wild", "--precisions", "float32")
    printed = run(*arguments, "--keep-all", "--sizes", "none", "--rounds", "1")
    results = Results.read(out)
    assert results.command.endswith(" --keep-all")
    short, whole = (results.cell("plane", name) for name in ("wild", "wild, keep all"))
    skipped = {row["stage"]: row["skipped"] for row in short.plan}
    assert skipped["reproject"] == 0.75
    assert not any(row["skipped"] for row in whole.plan)
    (row,) = (row for row in results.skipped() if row.method not in ("noisy", "accumulated"))
    assert (row.scene, row.method) == ("plane", "wild")
    assert row.stages.startswith("reproject 75%")
    assert row.saved == pytest.approx(whole.computing.median - short.computing.median)
    assert set(row.change) == set(short.errors)
    assert row.change["SMAPE"] == short.errors["SMAPE"] - whole.errors["SMAPE"] == 0
    assert "ms saved" in printed
