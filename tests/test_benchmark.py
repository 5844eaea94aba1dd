"""Benchmarks: turns of the methods, errors, run times, failures, memory, sizes, operators, and skipping."""

from __future__ import annotations

import csv
import functools
import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

import mcdenoise.benchmark.memory
import mcdenoise.benchmark.sizes
from mcdenoise.benchmark import (
    Settings,
    Timed,
    benchmark_ops,
    choose_methods,
    make_method,
    parse_sizes,
    run_benchmark,
)
from mcdenoise.benchmark.machine import _SPIN, busy_machine
from mcdenoise.benchmark.memory import peak_memory
from mcdenoise.benchmark.operators import largest_case
from mcdenoise.benchmark.run import kept_frames
from mcdenoise.benchmark.scoring import Errors
from mcdenoise.benchmark.sizes import fit_line, measure_sizes, synthetic_frame
from mcdenoise.check.cases import OPS
from mcdenoise.cli import main
from mcdenoise.data import open_sequence, read_exr, write_exr
from mcdenoise.data.camera_matrices import read_camera_matrices, write_camera_matrices
from mcdenoise.denoiser import Denoiser
from mcdenoise.errors import InputError
from mcdenoise.evaluate import evaluate_method
from mcdenoise.frame import Frame
from mcdenoise.models import (
    Accumulated,
    Demodulated,
    Model,
    Needs,
    Output,
    compared_models,
    create_model,
    find_weights,
    list_models,
    pretrained_models,
    save_weights,
)
from mcdenoise.ops import _backend, _op, downsample, upsample
from mcdenoise.ops._op import backends_of, op, plain
from mcdenoise.results import Cell, Cost, Machine, Method, OpResults, Results, Skipped, Spread

METRICS = {"SMAPE", "relMSE", "PSNR", "SSIM", "tSMAPE", "tRMSE"}


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(autouse=True)
def _no_other_process(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Disable measuring memory in all tests except those that measure it, because starting a process takes a while."""
    if "measures_memory" not in request.fixturenames:
        monkeypatch.setattr(mcdenoise.benchmark.memory, "peak_memory", lambda *_, **__: None)


@pytest.fixture(autouse=True)
def _no_page(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write no report in all tests except the one that looks at it, because drawing its plots takes a while."""
    if "writes_page" not in request.fixturenames:
        monkeypatch.setattr("mcdenoise.cli.benchmark.write_report", lambda folder: folder / "index.html")


@pytest.fixture
def writes_page() -> None:
    """A fixture for tests that look at the report."""


@pytest.fixture
def measures_memory() -> None:
    """A fixture for tests that measure memory."""


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Run the command: exit status, stdout and stderr."""

    def call(*arguments: Any) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as stop:
            main(["benchmark", *map(str, arguments), "--threads", "1"])
        printed = capsys.readouterr()
        return int(stop.value.code or 0), printed.out, printed.err

    return call


def half() -> Model:
    """A model that returns half of the accumulated light, with all of it as the intermediate image."""
    return Demodulated(Accumulated(lambda color: Output(color / 2, {"initial": color})))


NOT_FINITE = (
    "model: expected finite radiance, found 480 NaN or infinite pixels; the frame is not kept: check the buffers for "
    "values far out of range and the network for weights that are"
)

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


@pytest.fixture(autouse=True)
def _empty_log() -> None:
    LOG.clear()
    ACTS.clear()


def own(name: str, factory: str, **settings: Any) -> Method:
    """A method defined in this file."""
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
    assert [*one_pass * 3, *"ABC" * 4] == LOG
    assert steps == [(step, 13) for step in range(1, 14)]
    for cell in results.cells:
        # The first of three frames, which has no history, does not count.
        assert {spread.count for spread in (cell.whole, cell.computing, *cell.stages.values())} == {2 * 2}
        # The run time of a method that reports no stages counts as filter.
        assert list(cell.stages) == ["read", "accumulate", "filter", "write"]
    assert [(cost.method, cost.width, cost.height) for cost in results.costs] == [(name, 16, 12) for name in "ABC"]
    assert {cost.milliseconds.count for cost in results.costs} == {2}


def test_errors_and_pictures_are_of_the_images(small_sequence: Path, out: Path) -> None:
    sequence = open_sequence(small_sequence)
    # This method has no history, but its images must be in order too.
    baselines = choose_methods("none")
    assert [method.name for method in baselines] == ["noisy", "accumulated"]
    methods = [*baselines, own("half", "half")]
    results = run_benchmark([sequence], methods, out, Settings(rounds=1, pictures=2, on_the_way=True))
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
    assert noisy.on_the_way == accumulated.on_the_way == {}
    # Twice the half is the accumulated image.
    assert ours.on_the_way["initial"] == pytest.approx(accumulated.errors, rel=1e-5)

    assert results.scenes[0].pictures == [2, 3]
    written = sorted(path.relative_to(out).as_posix() for path in out.rglob("*.exr"))
    folders = ("accumulated", "half", "noisy", "reference")
    assert written == [f"images/plane/{folder}/{number}.exr" for folder in folders for number in (2, 3)]
    frame = sequence.frame(3)
    for folder, image in (("noisy", frame.color), ("reference", frame.reference)):
        pixels, channels, _ = read_exr(out / "images" / "plane" / folder / "3.exr")
        assert channels == ["R", "G", "B"]
        np.testing.assert_allclose(pixels, image[0].permute(1, 2, 0).numpy(), rtol=1e-3, atol=1e-6)


def test_errors_alone_take_one_pass(small_sequence: Path, out: Path) -> None:
    settings = Settings(rounds=0, sizes=((16, 12),), metrics=("PSNR", "SMAPE"))
    results = run_benchmark([open_sequence(small_sequence)], [scripted("A")], out, settings)
    assert LOG == ["A!", "A", "A", "A"]
    (cell,) = results.cells
    assert set(cell.errors) == {"SMAPE", "PSNR"}
    assert (cell.whole, cell.computing, cell.stages, cell.memory, results.costs) == (None, None, {}, None, [])
    assert Results.read(out) == results


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
    failures = {(cell.scene, cell.method): cell.failure for cell in results.cells}
    assert failures == {
        (scene, method): failure
        for scene in ("plane", "plane (2)")
        for method, failure in {
            "unlucky": "RuntimeError: out of luck" if scene == "plane" else "",
            "not a number": NOT_FINITE,
            "fine": "",
            "unmakeable": f"model '{__name__}:unmakeable': the factory fails: ZeroDivisionError: division by zero",
        }.items()
    }
    for cell in results.cells:
        assert bool(cell.failure) is not bool(cell.errors)
        assert bool(cell.failure) is (cell.whole is None)
    # Images of a method before it failed are removed.
    assert sorted(path.name for path in (out / "images" / "plane").iterdir()) == ["fine", "reference"]
    assert Results.read(out) == results


def test_a_scene_that_cannot_be_read_fails_alone(small_sequence: Path, out: Path) -> None:
    damaged = small_sequence.parent / "damaged"
    shutil.copytree(small_sequence, damaged)
    path = damaged / "inputs" / "albedo2.exr"
    path.write_bytes(path.read_bytes()[:-200])
    sequences = [open_sequence(damaged), open_sequence(small_sequence)]
    results = run_benchmark(sequences, [scripted("A"), scripted("B")], out, Settings(rounds=1))
    assert [bool(cell.failure) for cell in results.cells] == [True, True, False, False]
    assert "albedo2.exr" in results.cells[0].failure
    assert results.scenes[0].pictures == []
    assert [path.name for path in (out / "images").iterdir()] == ["plane"]


def test_nothing_is_left_of_a_run_that_is_interrupted(small_sequence: Path, out: Path) -> None:
    def interrupt(frame: Frame) -> Tensor:
        raise KeyboardInterrupt

    before = sorted(out.parent.iterdir())
    with pytest.raises(KeyboardInterrupt):
        run_benchmark([open_sequence(small_sequence)], [scripted("A", interrupt)], out)
    assert sorted(out.parent.iterdir()) == before


def _spinning() -> list[str]:
    """States of the processes that keep a core busy for this test: grandchildren, since each is repeated by another."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            if folder.joinpath("cmdline").read_bytes().split(b"\0")[-2:-1] == [_SPIN.encode()]:
                state, parent = _state_and_parent(folder)
                found += [state] if _state_and_parent(Path("/proc", parent))[1] == str(os.getpid()) else []
        except OSError:
            continue
    return found


def _state_and_parent(process: Path) -> list[str]:
    return process.joinpath("stat").read_text().rpartition(")")[2].split()[:2]


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs the process table of Linux")
def test_cores_are_kept_busy_while_times_are_measured(small_sequence: Path, out: Path) -> None:
    states: list[list[str]] = []

    def count(frame: Frame) -> Tensor:
        # The first pass over both frames is not timed. Processes need a moment to start.
        expected = 0 if len(states) < 2 else 2
        deadline = time.monotonic() + 20
        while len(running := [state for state in _spinning() if state == "R"]) < expected:
            assert time.monotonic() < deadline
        states.append(running)
        return frame.color

    settings = Settings(rounds=1, busy=2, memory=False)
    results = run_benchmark([open_sequence(small_sequence, "0-1")], [scripted("A", count)], out, settings)
    assert [len(running) for running in states] == [0, 0, 2, 2]
    assert results.notes == ["measured beside 2 processes, each of which keeps a core busy"]
    assert not _spinning()


def test_a_command_runs_beside_and_begins_again(small_sequence: Path, out: Path, tmp_path: Path) -> None:
    def slowly(frame: Frame) -> Tensor:
        time.sleep(0.5)
        return frame.color

    ran = tmp_path / "ran"
    command = shlex.join([sys.executable, "-I", "-S", "-c", f"open({str(ran)!r}, 'a').write('x')"])
    settings = Settings(rounds=2, beside=command, memory=False)
    results = run_benchmark([open_sequence(small_sequence, "0-1")], [scripted("A", slowly)], out, settings)
    assert len(ran.read_text()) > 1
    assert results.notes == [f"measured beside: {command}"]


def test_a_command_that_does_not_exist_or_fails_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--beside: .*'no-such-program'"):
        busy_machine(0, "no-such-program -x").__enter__()
    failed = tmp_path / "failed"
    command = [sys.executable, "-I", "-S", "-c", f"open({str(failed)!r}, 'w'); raise SystemExit(3)"]
    machine = busy_machine(0, shlex.join(command))
    machine.__enter__()
    while not failed.exists():
        time.sleep(0.05)
    time.sleep(1)
    with pytest.raises(InputError, match="status 3"):
        machine.__exit__(None, None, None)


def test_nothing_stays_busy_when_the_benchmark_is_killed(tmp_path: Path) -> None:
    written = tmp_path / "pid"
    command = shlex.join(
        [
            sys.executable,
            "-I",
            "-S",
            "-c",
            f"import os, time; open({str(written)!r}, 'w').write(str(os.getpid())); time.sleep(60)",
        ]
    )
    code = (
        "import os, sys, time\n"
        "from mcdenoise.benchmark.machine import busy_machine\n"
        "with busy_machine(0, sys.argv[1]):\n"
        "    while not os.path.exists(sys.argv[2]) or not os.path.getsize(sys.argv[2]):\n"
        "        time.sleep(0.05)\n"
        "    os._exit(9)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, command, str(written)])
    assert done.returncode == 9
    deadline = time.monotonic() + 20
    while True:
        try:
            os.kill(int(written.read_text()), 0)
        except ProcessLookupError:
            break
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_temporal_errors_use_successive_frames_and_infinite_values_are_skipped() -> None:
    errors = Errors()
    reference = torch.full((1, 3, 16, 16), 0.25)
    for number, level in ((3, 0.25), (4, 0.5), (6, 0.75)):
        errors.add("ours", number, torch.full_like(reference, level), reference)
    means, spreads = errors.means("ours"), errors.spreads("ours")
    # |x - y| / (x + y + 0.01) of 0, 0.25 and 0.5; frame 6 has no previous frame.
    smape = [0, 0.25 / 0.76, 0.5 / 1.01]
    assert means["SMAPE"] == pytest.approx(sum(smape) / 3)
    assert spreads["SMAPE"].median == pytest.approx(smape[1])
    assert spreads["tSMAPE"].count == spreads["tRMSE"].count == 1
    # The first image equals its reference.
    assert "PSNR" not in means
    assert "PSNR" not in spreads
    assert errors.means("theirs") == {}


def test_flip_of_some_frames_only() -> None:
    pytest.importorskip("flip_evaluator")
    errors = Errors(("SMAPE", "FLIP"), flip_every=3)
    image = torch.full((1, 3, 4, 4), 0.5)
    for number in range(4):
        errors.add("ours", number, image, image)
    assert {name: spread.count for name, spread in errors.spreads("ours").items()} == {"SMAPE": 4, "FLIP": 2}


def test_a_metric_that_cannot_be_computed_is_skipped_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    errors = Errors(("SMAPE", "SSIM", "FLIP"))
    image = torch.full((1, 3, 10, 20), 0.5)
    errors.add("ours", 0, image, image)
    assert errors.means("ours") == {"SMAPE": 0}
    assert "11 x 11 pixels, found 10 x 20" in errors.skipped["SSIM"]
    assert "flip-evaluator" in errors.skipped["FLIP"]
    with pytest.raises(ValueError, match="reference:"):
        errors.add("wrong", 0, image[..., :6], image)


# The command


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    path = tmp_path / "small.safetensors"
    path.write_bytes(save_weights(create_model("cascaded_v2", width=4), "cascaded_v2", {"width": 4}, {}))
    return path


def absent(quality: str = "high") -> Model:
    try:
        import no_such_package  # type: ignore[import-not-found]
    except ImportError as error:
        raise InputError("this method needs no_such_package, which is not installed") from error
    return no_such_package.make(quality)


def test_missing_methods_are_listed_as_missing(
    small_sequence: Path, weights: Path, out: Path, run: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    out.mkdir()
    file = out.parent / "copy.json"
    models = f"{__name__}:half,{__name__}:absent(quality=fast|high),{weights}"
    status, printed, errors = run(
        small_sequence, "-o", out, "--models", models, "--rounds", 1, "--sizes", "24x20,48x40", "--json", file
    )
    assert (status, errors) == (0, "")
    results = Results.read(out)
    present = ["noisy", "accumulated", f"{__name__}:half", "small", "small, bfloat16"]
    missing = [f"{__name__}:absent(quality={quality})" for quality in ("fast", "high")]
    assert [method.name for method in results.methods] == [*present[:3], *missing, *present[3:]]
    assert [method.kind for method in results.methods[2:4]] == ["fixed", "fixed"]
    assert [method.name for method in results.methods if method.missing] == missing
    assert results.methods[4].missing == "this method needs no_such_package, which is not installed"
    assert results.methods[4].settings == {"quality": "high"}
    assert [cell.method for cell in results.cells] == present
    assert "FLIP is skipped where it cannot be computed: FLIP needs flip-evaluator" in results.notes[0]
    assert all(set(cell.errors) >= METRICS and "FLIP" not in cell.errors for cell in results.cells)
    own = results.methods[-1]
    assert own.parameters == sum(p.numel() for p in create_model("cascaded_v2", width=4).parameters())
    assert (own.model, own.weights, own.precision) == ("cascaded_v2", str(weights), "bfloat16")
    assert results.machine.threads == 1
    assert "--models=" in results.command
    assert [fit.method for fit in results.fits] == present[1:]
    assert json.loads(file.read_text()) == asdict(results)

    # The best method is printed first, and missing methods and skipped metrics below the table.
    order = [line.split("│")[2].strip() for line in printed.splitlines() if "│" in line]
    assert sorted(order) == sorted(present)
    smape = [cell.errors["SMAPE"] for name in order for cell in results.cells if cell.method == name]
    assert smape == sorted(smape)
    line = f"missing: {'; '.join(missing)}: {results.methods[4].missing}"
    assert printed.splitlines()[-3:] == [line, results.notes[0], f"report: {out / 'index.html'}"]

    # results.csv contains the same numbers.
    with (out / "results.csv").open(newline="") as text:
        rows = list(csv.DictReader(text))
    assert [row["method"] for row in rows] == [method.name for method in results.methods]
    by_method = {row["method"]: row for row in rows}
    for cell in results.cells:
        row = by_method[cell.method]
        assert (row["scene"], row["width"], row["height"], row["failure"]) == ("plane", "24", "20", "")
        assert {name: float(row[name]) for name in cell.errors} == cell.errors
        assert (float(row["ms lower"]), float(row["whole ms"])) == (cell.computing.lower, cell.whole.median)
        for stage in ("read", "accumulate", "network", "filter", "write"):
            assert row[f"{stage} ms"] == (str(cell.stages[stage].median) if stage in cell.stages else "")
        assert float(row["megapixels per second"]) == pytest.approx(24 * 20 / 1e3 / cell.computing.median)
    assert by_method[missing[0]]["failure"].startswith("missing: ")
    assert by_method[missing[0]]["SMAPE"] == ""


def overflowing() -> Any:
    return lambda color: color * torch.inf


def test_a_method_that_fails_gives_exit_status_1(small_sequence: Path, out: Path, run: Callable[..., Any]) -> None:
    models = ("--models", f"{__name__}:overflowing", "--frames", "0", "--pictures", 0)
    status, printed, errors = run(small_sequence, "-o", out, *models, "--rounds", 1, "--sizes", "none")
    assert (status, errors) == (1, "")
    *_, failed = Results.read(out).cells
    assert failed.failure == NOT_FINITE
    assert f"failed: plane, {failed.method}: {failed.failure}\n" in printed


def demanding() -> Any:
    return lambda color, roughness: color


def test_a_method_is_skipped_on_scenes_that_lack_its_buffers(
    small_sequence: Path, out: Path, run: Callable[..., Any]
) -> None:
    """One line names the missing buffers and alternative methods, and the other methods are compared."""
    for path in (small_sequence / "inputs").glob("shading_normal*"):
        path.unlink()
    models = f"svgf,asvgf,{__name__}:demanding,guided"
    status, printed, errors = run(
        *(small_sequence, "-o", out, "--models", models, "--frames", "0-1", "--rounds", 1, "--sizes", "none")
    )
    assert (status, errors) == (0, "")
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
        (("--models", "cascaded_v2,cascaded_v2"), "methods: expected different names"),
        (("--models", "cascaded_v2(width)"), "expected settings such as (setting=value), found 'width'"),
        (("--models", "cascaded_v2(hue=3)"), "argument 'hue': expected an argument of Denoiser or a setting of model"),
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
    small_sequence: Path, out: Path, run: Callable[..., Any], arguments: tuple[Any, ...], expected: str
) -> None:
    out.mkdir()
    (out / "old").touch()
    cheap = () if "--models" in arguments else ("--models", "none")
    status, _, message = run(small_sequence, "-o", out, *cheap, *arguments)
    assert status == 2
    assert expected in message
    assert message.count("\n") == 1
    assert {path.name for path in out.parent.iterdir()} == {small_sequence.name, out.name}
    assert [path.name for path in out.iterdir()] == ["old"]


def test_references_are_checked_first(small_sequence: Path, out: Path, run: Callable[..., Any]) -> None:
    other = small_sequence.parent / "other"
    shutil.copytree(small_sequence, other)
    pixels, channels, _ = read_exr(other / "inputs" / "reference2.exr")
    write_exr(other / "inputs" / "reference2.exr", pixels[1:], channels)
    status, _, message = run(small_sequence, other, "-o", out)
    assert status == 2
    assert "reference2.exr: expected 24 x 20 pixels" in message
    for path in (other / "inputs").glob("reference*.exr"):
        path.unlink()
    status, _, message = run(small_sequence, other, "-o", out, "--models", "none")
    assert status == 2
    assert f"{other}: expected references to compare with, found none" in message
    assert not out.exists()
    status, _, message = run(small_sequence)
    assert status == 2
    assert "--out: expected a folder to write to, found none" in message


# Methods


def test_the_default_methods() -> None:
    methods = choose_methods()
    names = [method.name for method in methods]
    assert names[:2] == ["noisy", "accumulated"]
    assert {method.kind for method in methods[:2]} == {"baseline"}
    assert len(set(names)) == len({method.folder for method in methods}) == len(names)
    trained = [method for method in methods if method.kind == "trainable"]
    assert {method.model for method in trained} == set(pretrained_models())
    assert {method.precision for method in trained} == {"float32", "bfloat16"}
    assert len(trained) == 2 * len(pretrained_models())
    assert {"svgf", "joint_bilateral", "oidn"} <= {method.model for method in methods if method.kind == "fixed"}
    assert {method.settings["quality"] for method in methods if method.model == "oidn"} == {"fast", "balanced", "high"}


def test_all_means_every_model() -> None:
    """Those without weights, if there are any, are listed as missing."""
    methods = choose_methods("all", precisions="float32")
    assert {method.model for method in methods} == set(list_models())
    assert len({method.name for method in methods}) == len(methods)
    without = set(list_models()) - set(pretrained_models()) - set(compared_models())
    untrained = {name for name in without if create_model(name).needs.trainable}
    assert {method.name for method in methods if method.missing} == untrained
    default = [method.name for method in choose_methods(precisions="float32")]
    assert [method.name for method in methods if method.name in default] == default


def test_some_methods_in_some_precisions() -> None:
    names = "cascaded_v2_tiny(alpha_min=0.1|0.2), cascaded_v2_micro"
    methods = choose_methods(names, precisions="bfloat16", keep_all=True, baselines=())
    base = ["cascaded_v2_tiny(alpha_min=0.1)", "cascaded_v2_tiny(alpha_min=0.2)", "cascaded_v2_micro"]
    assert [method.name for method in methods] == [
        f"{name}, bfloat16{more}" for name in base for more in ("", ", keep all")
    ]
    assert methods[0].folder == "cascaded_v2_tiny-alpha_min-0.1-bfloat16"
    denoiser = make_method(methods[3]).denoiser
    assert (denoiser.precision, denoiser.keep_all) == ("bfloat16", True)
    (accumulated,) = (part for part in denoiser.model.modules() if isinstance(part, Accumulated))
    assert accumulated.alpha_min == 0.2
    # A method that is named twice is included once.
    assert len(choose_methods("accumulated,cascaded_v2_micro,pretrained", precisions="float32")) == (
        2 + len(pretrained_models())
    )


def test_a_method_named_twice_is_measured_once_and_two_of_one_name_are_refused(tmp_path: Path) -> None:
    name = "cascaded_v2_micro"
    twice = [method.name for method in choose_methods(f"{name},pretrained", precisions="bfloat16")]
    assert twice.count(f"{name}, bfloat16") == 1
    mine = tmp_path / f"{name}.safetensors"
    mine.write_bytes(find_weights(name).read_bytes())  # type: ignore[union-attr]
    with pytest.raises(InputError, match=rf"'{name}' .*{name} and .*{name}\.safetensors"):
        choose_methods(f"{name},{mine}")


def threaded(*, threads: int = 1) -> Model:
    ACTS["threads"] = lambda frame: frame.color * threads
    return Scripted("threads")


def test_a_method_that_asks_for_threads_gets_them() -> None:
    make_method(own("threaded", "threaded"), threads=3)
    assert ACTS["threads"](Frame(color=torch.ones(1, 3, 2, 2))).max() == 3
    make_method(own("threaded", "threaded", threads=2), threads=3)
    assert ACTS["threads"](Frame(color=torch.ones(1, 3, 2, 2))).max() == 2


def test_network_and_filter_are_timed_separately_without_changing_the_image() -> None:
    torch.manual_seed(0)
    model = create_model("cascaded_v2", width=8, resolutions=1)
    for name, module in model.named_modules():
        if ".heads." in name:
            nn.init.normal_(module.weight, std=0.02)
    frame = synthetic_frame(64, 48)
    alone = [denoise(frame) for denoise in [Denoiser(model)] for _ in range(2)]
    assert not any(module._forward_hooks for module in model.modules())
    timed = Timed(Denoiser(model))
    hooked = [name for name, module in model.named_modules() if module._forward_hooks]
    # The networks are both U-Nets and their three heads, without the modules inside them and the fusions.
    parts = ["unet", "heads.0", "heads.1", "heads.2"]
    assert all(name.endswith(f".{part}") for name, part in zip(hooked, 2 * parts, strict=True))
    assert [name.count("initial") for name in hooked] == [1] * 4 + [0] * 4
    for expected in alone:
        assert torch.equal(timed(frame), expected)
        assert set(timed.stages) == {"accumulate", "network", "filter"}
        assert min(timed.stages.values()) > 0
    timed.denoiser.reset()
    assert torch.equal(timed(frame), alone[0])


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


@pytest.mark.slow
@pytest.mark.usefixtures("measures_memory")
@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="memory is not measured here")
def test_a_method_that_hangs_ends_with_the_benchmark(tmp_path: Path) -> None:
    file = tmp_path / "process"
    code = (
        "import functools, pathlib, test_benchmark as t\n"
        f"stuck = functools.partial(t.Stuck, pathlib.Path({str(file)!r}))\n"
        "t.peak_memory(stuck, t.two_frames, threads=1, device='cpu')"
    )
    benchmark = subprocess.Popen([sys.executable, "-c", code], cwd=Path(__file__).parent)
    while not (file.exists() and file.read_text()):
        assert benchmark.poll() is None
        time.sleep(0.05)
    benchmark.kill()
    benchmark.wait()
    wait_for_end(int(file.read_text()))


# Sizes


def test_a_line_is_fitted_to_the_medians() -> None:
    def cost(width: int, milliseconds: float) -> Cost:
        return Cost("ours", width, 1000, Spread(milliseconds, 0.0, 0.0, 3))

    # With equal values at both ends and four times as much between them, the fit is a constant c that minimizes the sum
    # of (1 - c / y)^2 over y = 1, 4, 1.
    bent = fit_line("ours", [cost(1000, 1.0), cost(2000, 4.0), cost(3000, 1.0)])
    level = (1 + 1 / 4 + 1) / (1 + 1 / 16 + 1)
    assert (bent.fixed, bent.per_megapixel) == pytest.approx((level, 0.0), abs=1e-9)
    assert bent.deviation == pytest.approx(1 - level / 4)
    assert fit_line("ours", [cost(100, 5.0)]) is None
    assert fit_line("theirs", [cost(100, 5.0), cost(200, 5.0)]) is None


def test_sizes() -> None:
    assert parse_sizes("1920x1080, 320X180,320x180") == [(320, 180), (1920, 1080)]
    assert parse_sizes("none") == []
    for text in ("", "1x", "x1", "1x2x3", "16385x1", "1x1,", "-1x1"):
        with pytest.raises(InputError, match="--sizes:"):
            parse_sizes(text)


def test_the_synthetic_frame_has_a_history() -> None:
    frame, replaced = synthetic_frame(40, 30).validate()
    denoiser = Denoiser(half())
    for expected in ("first frame", ""):
        denoiser(frame)
        assert (denoiser.report.reset, denoiser.report.missing) == (expected, [])
    assert replaced == 0


def test_too_large_an_image_is_not_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    def peak(make: Callable[..., Any], frames: functools.partial[Any], **_: Any) -> float:
        width, height = frames.args
        return 10 + width * height * 1e-3

    monkeypatch.setattr(mcdenoise.benchmark.memory, "peak_memory", peak)
    monkeypatch.setattr(mcdenoise.benchmark.sizes, "available_memory", lambda device: 2 * 1013 * 2**20)
    large = scripted("A")
    sizes = [(1003, 1000), (1004, 1000)]
    costs, _ = measure_sizes([large], {"A": make_method(large)}, sizes, rounds=1, threads=1, device="cpu")
    assert LOG == ["A!", "A", "A"]
    assert costs[0].failure == ""
    assert costs[1].milliseconds is None
    assert costs[1].failure == "too little memory: expected to need 1014 MiB, found 1013 MiB that may be used"


@pytest.mark.parametrize(
    ("numbers", "scored", "maximum", "expected"),
    [
        ([8, 9, 10, 11], [10], 3, [8, 9, 10]),
        ([0, 1, 2, 5, 6], [0, 6], 3, [5, 6]),
        ([0, 1, 2, 7, 8, 9, 10, 20], [1, 10, 20], 2, [9, 10]),
        ([4], [4], 4, [4]),
        ([4, 5], [], 4, []),
        ([4, 5], [4, 5], 0, []),
    ],
)
def test_pictures_are_of_successive_frames_up_to_one_with_a_reference(
    numbers: list[int], scored: list[int], maximum: int, expected: list[int]
) -> None:
    assert kept_frames(numbers, scored, maximum) == expected


# Operators


def test_ops_are_compared_with_their_equation_and_with_a_copy(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcdenoise.benchmark.operators, "_COPY_BYTES", 2**20)
    names = ("kernel_conv", "downsample", "upsample", "demodulate")
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
        assert cost.over_copy == pytest.approx(cost.milliseconds.median / cost.copy)
        if cost.backend == "numba":
            assert cost.with_derivatives is cost.over_copy_with_derivatives is None
        else:
            assert cost.with_derivatives.count == 3
            ratio = cost.with_derivatives.median / cost.copy_with_derivatives
            assert cost.over_copy_with_derivatives == pytest.approx(ratio)
    assert by_name["downsample", "bfloat16"].error > 1e-4
    # A kernel of 25 taps reads 25 values and an RGB image per pixel, and writes an RGB image.
    assert by_name["kernel_conv", "float32"].mebibytes == (25 + 3 + 3) * 33 * 20 * 4 / 2**20
    assert by_name["kernel_conv", "float16"].mebibytes == (25 + 3 + 3) * 33 * 20 * 2 / 2**20
    # Derivatives read the kernel and both images again, and write the derivatives of kernel and image.
    assert by_name["kernel_conv", "float32"].mebibytes_with_derivatives == (31 + 31 + 28) * 33 * 20 * 4 / 2**20
    # Downsampling keeps a quarter of the pixels of three channels.
    assert by_name["downsample", "float32"].mebibytes == 3 * (33 * 20 + 17 * 10) * 4 / 2**20
    assert by_name["upsample", "float32"].mebibytes == 3 * (33 * 20 + 17 * 10) * 4 / 2**20

    stored = json.loads((out / "ops.json").read_text())
    assert (stored["width"], stored["height"], stored["bandwidth"]) == (33, 20, results.bandwidth)
    with (out / "ops.csv").open(newline="") as text:
        rows = list(csv.DictReader(text))
    assert len(stored["costs"]) == len(rows) == len(results.costs)
    for row, cost in zip(rows, stored["costs"], strict=True):
        assert (row["op"], row["backend"], row["dtype"]) == (cost["op"], cost["backend"], cost["dtype"])
        machine = stored["machine"]
        assert (row["processor"], row["threads"]) == (machine["processor"], str(machine["threads"]))
        assert f"mcdenoise {machine['packages']['mcdenoise']}, torch " in row["packages"]
        assert ", commit " in row["packages"]
        if cost["failure"]:
            continue
        assert float(row["relative error"]) == cost["error"]
        assert float(row["ms"]) == cost["milliseconds"]["median"]
        assert float(row["over copy"]) == pytest.approx(float(row["ms"]) / cost["copy"])


@op("numba")
def with_backends(image: Tensor) -> Tensor:
    return plain(downsample)(image)


def test_every_backend_has_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcdenoise.benchmark.operators, "_COPY_BYTES", 2**20)
    monkeypatch.setattr(_op, "fast_form", lambda page, name: lambda image: with_backends.plain(image) * 1.5)
    assert backends_of(upsample) == ("torch",)
    (known,) = (op for op in OPS if op.function is downsample)
    results = benchmark_ops(size=(16, 12), rounds=1, ops=[replace(known, function=with_backends)])
    rows = {(cost.backend, cost.dtype): cost for cost in results.costs}
    assert len(rows) == 6
    assert rows["torch", "float32"].error < 1e-6
    assert rows["numba", "float32"].error == pytest.approx(0.5)
    monkeypatch.setattr(_backend, "_missing", lambda: "is not there")
    results = benchmark_ops(size=(16, 12), rounds=1, ops=[replace(known, function=with_backends)])
    (refused,) = (cost for cost in results.costs if (cost.backend, cost.dtype) == ("numba", "float32"))
    assert refused.failure.endswith("found 'numba', which is not there")
    assert refused.milliseconds is None


def test_the_command_for_ops(run: Callable[..., Any], out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcdenoise.benchmark.operators, "_COPY_BYTES", 2**20)
    measured: list[OpResults] = []

    def measure(**arguments: Any) -> OpResults:
        measured.append(benchmark_ops(**arguments))
        return measured[-1]

    monkeypatch.setattr("mcdenoise.cli.benchmark.benchmark_ops", measure)
    file = out.parent / "ops.json"
    status, printed, _ = run("--ops", "downsample", "--size", "16x12", "--rounds", "2", "--json", file)
    assert status == 0
    assert f"a copy moves {measured[0].bandwidth:.1f} GB/s" in printed
    assert {cost.op for cost in measured[0].costs} == {"downsample"}
    assert "--ops downsample" in measured[0].command
    assert json.loads(file.read_text()) == asdict(measured[0])
    assert not out.exists()
    assert run("--ops", "--size", "1x1")[0] == 2
    assert "op: expected one of" in run("--ops", "no-such-op")[2]


# Skipping


@pytest.mark.usefixtures("writes_page")
def test_methods_are_also_measured_without_skipping(
    run: Callable[..., tuple[int, str, str]], small_sequence: Path, out: Path
) -> None:
    # A static camera: all frames have the matrix and the position of the first.
    inputs = small_sequence / "inputs"
    matrices = read_camera_matrices(inputs / "camera_matrices.h")
    still = replace(matrices, matrices=matrices.matrices[[0, 0, 0, 0]])
    write_camera_matrices(inputs / "camera_matrices.h", still, "plane")
    for number in (1, 2, 3):
        for name in ("world_position", "depth", "shading_normal", "albedo"):
            shutil.copy(inputs / f"{name}0.exr", inputs / f"{name}{number}.exr")
    arguments = (small_sequence, "-o", out, "--models", "cascaded_v2_tiny", "--precisions", "float32")
    status, printed, _ = run(*arguments, "--keep-all", "--sizes", "none", "--rounds", "1")
    assert status == 0
    results = Results.read(out)
    assert " --keep-all " in results.command
    short, whole = (results.cell("plane", name) for name in ("cascaded_v2_tiny", "cascaded_v2_tiny, keep all"))
    assert short is not None
    assert whole is not None
    skipped = {row["stage"]: row["skipped"] for row in short.plan}
    assert skipped["reproject"] == 0.75
    assert not any(row["skipped"] for row in whole.plan)
    (row,) = (row for row in results.skipped() if row.method not in ("noisy", "accumulated"))
    assert (row.scene, row.method) == ("plane", "cascaded_v2_tiny")
    assert row.stages.startswith("reproject 75%")
    assert row.saved == pytest.approx(whole.computing.median - short.computing.median)
    assert set(row.change) == set(short.errors)
    assert row.change["SMAPE"] == short.errors["SMAPE"] - whole.errors["SMAPE"] == 0
    assert "ms saved" in printed
    assert "What methods skipped" in (out / "index.html").read_text()


def test_without_the_variant_without_skipping_savings_are_unknown() -> None:
    plan = [{"stage": "network", "kept": True, "skipped": 0.25, "reason": "", "exact": True}]
    machine = Machine("", 1, 1.0, "cpu", 1, "")
    cells = [Cell("a", "x", plan=plan), Cell("a", "y")]
    assert Results("", "", machine, 1, [], [], cells).skipped() == [Skipped("a", "x", "network 25%")]
