"""Error against run time: who takes turns with whom, what is counted, and what becomes of a method that fails."""

from __future__ import annotations

import csv
import functools
import json
import os
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
import mcdenoise.benchmark.methods
import mcdenoise.benchmark.sizes
from mcdenoise.benchmark import Candidate, Settings, benchmark_ops, choose_candidates, parse_sizes, run_benchmark
from mcdenoise.benchmark.memory import peak_memory
from mcdenoise.benchmark.methods import ModelRunner, PeerRunner
from mcdenoise.benchmark.run import kept_frames
from mcdenoise.benchmark.scoring import Errors
from mcdenoise.benchmark.sizes import fit_line, measure_sizes, synthetic_frame
from mcdenoise.buffers import Frame
from mcdenoise.cli import main
from mcdenoise.data import open_sequence, read_exr, write_exr
from mcdenoise.data.camera_matrices import read_camera_matrices, write_camera_matrices
from mcdenoise.denoiser import Denoiser
from mcdenoise.errors import InputError
from mcdenoise.evaluate import score_sequence
from mcdenoise.models import Denoised, create_model, pretrained_models, save_weights
from mcdenoise.ops import _op, downsample, upsample
from mcdenoise.ops._cases import OPS, Op
from mcdenoise.ops._op import backends_of, op, plain
from mcdenoise.results import Cell, Cost, LeftOut, Machine, Method, OpResults, Results, Spread

METRICS = {"SMAPE", "relMSE", "PSNR", "SSIM", "tSMAPE", "tRMSE"}


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(autouse=True)
def _no_other_process(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Memory is measured in one test only: each process that is started takes a while."""
    if "measures_memory" not in request.fixturenames:
        monkeypatch.setattr(mcdenoise.benchmark.memory, "peak_memory", lambda *_, **__: None)


@pytest.fixture
def measures_memory() -> None:
    """Of tests that do."""


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Exit status, stdout and stderr of the command."""

    def call(*arguments: Any) -> tuple[int, str, str]:
        with pytest.raises(SystemExit) as stop:
            main(["benchmark", *map(str, arguments), "--threads", "1"])
        printed = capsys.readouterr()
        return int(stop.value.code or 0), printed.out, printed.err

    return call


class Half(nn.Module):
    def forward(self, color: Tensor, albedo: Tensor, normal: Tensor, depth: Tensor) -> Denoised:
        return Denoised(color, color / 2)


class Scripted:
    """Writes down what it is asked for; multiplies, or does what it is told to."""

    def __init__(self, name: str, log: list[str], act: Callable[[Frame], Tensor]) -> None:
        self.stages: dict[str, float] = {}
        self._name, self._log, self._act = name, log, act

    def reset(self) -> None:
        self._log.append(f"reset {self._name}")

    def __call__(self, frame: Frame) -> Tensor:
        self._log.append(self._name)
        self.stages = {"filter": 1.0}
        return self._act(frame)


def scripted(name: str, log: list[str], act: Callable[[Frame], Tensor] = lambda frame: frame.color / 2) -> Candidate:
    return Candidate(Method(name, "peer", name, name), lambda: Scripted(name, log, act))


def test_methods_take_turns_frame_by_frame(small_sequence: Path, out: Path) -> None:
    log: list[str] = []
    steps: list[tuple[int, int]] = []
    candidates = [scripted(name, log) for name in "ABC"]
    settings = Settings(rounds=2, sizes=((16, 12),))
    results = run_benchmark(
        [open_sequence(small_sequence, "0-2")], candidates, out, settings, on_step=lambda *step: steps.append(step)
    )
    one_pass = ["reset A", "reset B", "reset C", *"ABC" * 3]
    # The warm-up and two rounds over the frames; then the size: two to warm up, and two rounds.
    assert log == [*one_pass * 3, *"ABC" * 4, "reset A", "reset B", "reset C"]
    assert steps == [(step, 13) for step in range(1, 14)]
    for cell in results.cells:
        # Of three frames the first, which has no history, is not counted.
        assert {spread.count for spread in (cell.whole, cell.computing, *cell.stages.values())} == {2 * 2}
        assert list(cell.stages) == ["read", "filter", "write"]
        assert cell.stages["filter"].median == 1.0
    assert [(cost.method, cost.width, cost.height) for cost in results.costs] == [(name, 16, 12) for name in "ABC"]
    assert {cost.milliseconds.count for cost in results.costs} == {2}


def test_errors_and_pictures_are_of_the_images(small_sequence: Path, out: Path) -> None:
    sequence = open_sequence(small_sequence)
    # What has no history of its own, and yet must be in its place.
    baselines = choose_candidates("none", "none")
    assert [candidate.method.name for candidate in baselines] == ["noisy", "accumulated"]
    half = Candidate(Method("half", "model", "half", "half"), lambda: ModelRunner(Half()))
    results = run_benchmark([sequence], [*baselines, half], out, Settings(rounds=1, pictures=2))
    expected = {score.method: score for score in score_sequence(sequence, {"half": Denoiser(Half())}, metrics=METRICS)}
    for cell in results.cells:
        values = expected[cell.method].values
        assert {name: cell.errors[name] for name in METRICS} == pytest.approx(values, rel=1e-5)
        assert {name: spread.count for name, spread in cell.errors_spread.items()}.items() >= {
            ("SMAPE", 4),
            ("tSMAPE", 3),
        }
        assert (
            cell.whole.median
            > cell.computing.median
            >= sum(cell.stages[stage].lower for stage in ("accumulate", "network", "filter") if stage in cell.stages)
        )
    noisy, accumulated, own = results.cells
    assert list(noisy.stages) == ["read", "write"]
    assert list(accumulated.stages) == ["read", "accumulate", "write"]
    assert list(own.stages) == ["read", "accumulate", "network", "filter", "write"]

    assert results.scenes[0].pictures == [2, 3]
    written = sorted(path.relative_to(out).as_posix() for path in out.rglob("*.exr"))
    folders = ("accumulated", "half", "noisy", "reference")
    assert written == [f"images/plane/{folder}/{number}.exr" for folder in folders for number in (2, 3)]
    frame = sequence.frame(3)
    for folder, image in (("noisy", frame.color), ("reference", frame.reference)):
        pixels, channels, _ = read_exr(out / "images" / "plane" / folder / "3.exr")
        assert channels == ["R", "G", "B"]
        np.testing.assert_allclose(pixels, image[0].permute(1, 2, 0).numpy(), rtol=1e-3, atol=1e-6)


def test_a_method_that_fails_on_one_scene_leaves_the_rest_alone(small_sequence: Path, out: Path) -> None:
    log: list[str] = []

    def cannot_do_frame_1(frame: Frame) -> Tensor:
        if len(log) == 2:
            raise RuntimeError("out of\nluck")
        return frame.color

    def not_a_number(frame: Frame) -> Tensor:
        return frame.color * torch.nan

    candidates = [
        scripted("unlucky", log, cannot_do_frame_1),
        scripted("not a number", [], not_a_number),
        scripted("fine", []),
        Candidate(Method("unmakeable", "model", "unmakeable", "ours"), lambda: 1 / 0),
    ]
    # The same scene twice: names are unique, and a method that failed on the one is tried on the other.
    sequences = [open_sequence(small_sequence, "0-1")] * 2
    results = run_benchmark(sequences, candidates, out, Settings(rounds=1, sizes=((16, 12),)))
    assert [scene.name for scene in results.scenes] == ["plane", "plane (2)"]
    assert results.failed
    failures = {(cell.scene, cell.method): cell.failure for cell in results.cells}
    assert failures == {
        (scene, method): failure
        for scene in ("plane", "plane (2)")
        for method, failure in {
            "unlucky": "RuntimeError: out of luck" if scene == "plane" else "",
            "not a number": "ArithmeticError: frame 0 has NaN or infinite values",
            "fine": "",
            "unmakeable": "ZeroDivisionError: division by zero",
        }.items()
    }
    for cell in results.cells:
        assert bool(cell.failure) is not bool(cell.errors)
        assert bool(cell.failure) is (cell.whole is None)
    # A failed method's images, made before it failed, are not kept.
    assert sorted(path.name for path in (out / "images" / "plane").iterdir()) == ["fine", "reference"]
    assert Results.read(out) == results


def test_a_scene_that_cannot_be_read_fails_alone(small_sequence: Path, out: Path) -> None:
    damaged = small_sequence.parent / "damaged"
    shutil.copytree(small_sequence, damaged)
    path = damaged / "inputs" / "albedo2.exr"
    path.write_bytes(path.read_bytes()[:-200])
    sequences = [open_sequence(damaged), open_sequence(small_sequence)]
    results = run_benchmark(sequences, [scripted("A", []), scripted("B", [])], out, Settings(rounds=1))
    assert [bool(cell.failure) for cell in results.cells] == [True, True, False, False]
    assert "albedo2.exr" in results.cells[0].failure
    assert results.scenes[0].pictures == []
    assert [path.name for path in (out / "images").iterdir()] == ["plane"]


def test_nothing_is_left_of_a_run_that_is_interrupted(small_sequence: Path, out: Path) -> None:
    def interrupt(frame: Frame) -> Tensor:
        raise KeyboardInterrupt

    before = sorted(out.parent.iterdir())
    with pytest.raises(KeyboardInterrupt):
        run_benchmark([open_sequence(small_sequence)], [scripted("A", [], interrupt)], out)
    assert sorted(out.parent.iterdir()) == before


def test_temporal_errors_are_of_neighbours_and_what_is_not_finite_is_left_out() -> None:
    errors = Errors()
    reference = torch.full((1, 3, 16, 16), 0.25)
    for number, level in ((3, 0.25), (4, 0.5), (6, 0.75)):
        errors.add("ours", number, torch.full_like(reference, level), reference)
    means, spreads = errors.means("ours"), errors.spreads("ours")
    # |x - y| / (x + y + 0.01) of 0, 0.25 and 0.5; frame 6 has no neighbour.
    smape = [0, 0.25 / 0.76, 0.5 / 1.01]
    assert means["SMAPE"] == pytest.approx(sum(smape) / 3)
    assert spreads["SMAPE"].median == pytest.approx(smape[1])
    assert spreads["tSMAPE"].count == spreads["tRMSE"].count == 1
    # The first image equals its reference.
    assert "PSNR" not in means
    assert "PSNR" not in spreads
    assert errors.means("theirs") == {}


# The command


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    path = tmp_path / "small.safetensors"
    path.write_bytes(save_weights(create_model("cascaded", width=4), "cascaded", {"width": 4}, {}))
    return path


def test_missing_peers_are_said_to_be_missing(
    small_sequence: Path, weights: Path, out: Path, run: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    mcdenoise.benchmark.methods._oidn.cache_clear()
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    file = out.parent / "copy.json"
    status, printed, errors = run(
        small_sequence, "-o", out, "--models", weights, "--rounds", 1, "--sizes", "24x20,48x40", "--json", file
    )
    assert (status, errors) == (0, "")
    results = Results.read(out)
    present = [
        "noisy",
        "accumulated",
        "joint bilateral 0.1 1.5",
        "joint bilateral 0.2 4.0",
        "small",
        "small, bfloat16",
    ]
    missing = [
        f"OIDN {quality}, clean aux, {image}"
        for image in ("raw", "accumulated")
        for quality in ("fast", "balanced", "high")
    ]
    assert [method.name for method in results.methods] == [*present[:4], *missing, *present[4:]]
    assert [method.name for method in results.methods if method.missing] == missing
    assert "pip install 'mcdenoise[peers]'" in results.methods[4].missing
    assert [cell.method for cell in results.cells] == present
    assert "FLIP is left out where it cannot be computed: FLIP needs flip-evaluator" in results.notes[0]
    assert all(set(cell.errors) >= METRICS and "FLIP" not in cell.errors for cell in results.cells)
    own = results.methods[-1]
    assert own.parameters == sum(p.numel() for p in create_model("cascaded", width=4).parameters())
    assert results.machine.threads == 1
    assert f"--models={weights}" in results.command
    assert [fit.method for fit in results.fits] == present[1:]
    assert json.loads(file.read_text()) == asdict(results)

    # What is printed: the best first, and below what is missing and left out.
    order = [line.split("│")[2].strip() for line in printed.splitlines() if "│" in line]
    assert sorted(order) == sorted(present)
    smape = [cell.errors["SMAPE"] for name in order for cell in results.cells if cell.method == name]
    assert smape == sorted(smape)
    line = f"missing: {'; '.join(missing)}: {results.methods[4].missing}"
    assert printed.splitlines()[-3:] == [line, results.notes[0], f"report: {out / 'index.html'}"]

    # results.csv has the same numbers.
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


def test_a_model_that_fails_is_a_row_and_exit_status_1(
    small_sequence: Path, out: Path, run: Callable[..., Any]
) -> None:
    model = create_model("cascaded", width=4)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(torch.randn_like(parameter).sign() * 6e4)
    path = out.parent / "wild.safetensors"
    path.write_bytes(save_weights(model, "cascaded", {"width": 4}, {}))
    arguments = ("--models", path, "--peers", "none", "--precisions", "float32", "--rounds", 1, "--sizes", "none")
    status, printed, errors = run(small_sequence, "-o", out, *arguments)
    assert (status, errors) == (1, "")
    noisy, accumulated, wild = Results.read(out).cells
    assert noisy.errors
    assert accumulated.errors
    assert wild.failure == "ArithmeticError: frame 0 has NaN or infinite values"
    assert f"failed: plane, {wild.method}: {wild.failure}\n" in printed


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ((), "expected nothing there yet, found something"),
        (("--models", "cascade"), "model 'cascade': expected one of"),
        (("--models", "cascaded,cascaded"), "--models: expected different names"),
        (("--peers", "oidn,optix"), "--peers: expected some of oidn, bilateral, or all, or none, found 'optix'"),
        (("--precisions", "float8"), "--precisions: expected some of float32, bfloat16"),
        (("--device", "tpu"), "--device: expected cpu or cuda, found 'tpu'"),
        (("--rounds", 0), "--rounds: expected at least 1, found 0"),
        (("--pictures", -1), "--pictures: expected at least 0, found -1"),
        (("--sizes", "320"), "--sizes: expected WIDTHxHEIGHT up to 16384"),
        (("--sizes", "0x9"), "--sizes: expected WIDTHxHEIGHT up to 16384"),
        (("--frames", "7"), "expected frame 7"),
        (("--ops",), "expected the folders of sequences, or --ops, and not both"),
    ],
)
def test_bad_arguments_are_refused_before_anything_is_measured(
    small_sequence: Path, out: Path, run: Callable[..., Any], arguments: tuple[Any, ...], expected: str
) -> None:
    out.mkdir()
    (out / "old").touch()
    cheap = () if "--models" in arguments else ("--models", "none")
    status, _, message = run(small_sequence, "-o", out, "--peers", "none", *cheap, *arguments)
    assert status == 2
    assert expected in message
    assert message.count("\n") == 1
    assert {path.name for path in out.parent.iterdir()} == {small_sequence.name, out.name}
    assert [path.name for path in out.iterdir()] == ["old"]


def test_references_are_looked_at_first(small_sequence: Path, out: Path, run: Callable[..., Any]) -> None:
    other = small_sequence.parent / "other"
    shutil.copytree(small_sequence, other)
    pixels, channels, _ = read_exr(other / "inputs" / "reference2.exr")
    write_exr(other / "inputs" / "reference2.exr", pixels[1:], channels)
    status, _, message = run(small_sequence, other, "-o", out)
    assert status == 2
    assert "reference2.exr: expected 24 x 20 pixels" in message
    for path in (other / "inputs").glob("reference*.exr"):
        path.unlink()
    status, _, message = run(small_sequence, other, "-o", out, "--models", "none", "--peers", "none")
    assert status == 2
    assert f"{other}: expected references to compare with, found none" in message
    assert not out.exists()
    status, _, message = run(small_sequence)
    assert status == 2
    assert "--out: expected a folder to write to, found none" in message


# Methods


def test_every_setting_is_a_candidate() -> None:
    pytest.importorskip("pyoidn", reason="Open Image Denoise is in the extra mcdenoise[peers]")
    candidates = choose_candidates()
    methods = [candidate.method for candidate in candidates]
    names = [method.name for method in methods]
    assert (
        len(set(names)) == len({method.folder for method in methods}) == len(names) == 10 + 2 * len(pretrained_models())
    )
    assert names[4] == "OIDN fast, clean aux, raw"
    assert methods[4].folder == "oidn-fast-clean-aux-raw"
    assert not any(method.missing for method in methods)
    assert [method.family for method in methods[4:10]] == ["OIDN"] * 6
    assert "cascaded, bfloat16" in names
    assert [c.method.name for c in choose_candidates("cascaded_tiny", "none", precisions="bfloat16")[2:]] == [
        "cascaded_tiny, bfloat16"
    ]
    # The stage of each: what starts from the noisy image has no accumulation.
    frame = synthetic_frame(24, 20)
    stages = {}
    for candidate in candidates[:10]:
        runner = candidate.make()
        assert runner(frame).shape == (1, 3, 20, 24)
        stages[candidate.method.name] = list(runner.stages)
    assert stages == {
        name: ([] if name == "noisy" else ["accumulate"] if "accumulated" in name or "bilateral" in name else [])
        + (["network"] if "OIDN" in name else ["filter"] if "bilateral" in name else [])
        for name in names[:10]
    }


def test_network_and_filter_are_told_apart_without_touching_the_image() -> None:
    torch.manual_seed(0)
    model = create_model("cascaded", width=8)
    for head in [*model.first.heads, *model.second.heads]:
        nn.init.normal_(head.weight, std=0.02)
    frame = synthetic_frame(64, 48)
    alone = [denoise(frame) for denoise in [Denoiser(model)] for _ in range(2)]
    assert model.first.unet._forward_hooks == {}
    runner = ModelRunner(model)
    hooked = [name for name, module in model.named_modules() if module._forward_hooks]
    # Both U-Nets and their three heads; neither what is inside them, nor the fusions.
    parts = ["unet", "heads.0", "heads.1", "heads.2"]
    assert hooked == [f"{network}.{part}" for network in ("first", "second") for part in parts]
    for expected in alone:
        assert torch.equal(runner(frame), expected)
        assert set(runner.stages) == {"accumulate", "network", "filter"}
        assert min(runner.stages.values()) > 0
    runner.reset()
    assert torch.equal(runner(frame), alone[0])


def test_peers_start_from_the_accumulated_image_they_pay_for(small_sequence: Path) -> None:
    sequence = open_sequence(small_sequence)
    runner, denoiser = PeerRunner(accumulates=True), Denoiser(Half())
    for number in sequence.numbers:
        frame, _ = sequence.frame(number).validate()
        torch.testing.assert_close(runner(frame), denoiser.images(frame).accumulated)


class Greedy:
    """Holds 64 MiB while it works."""

    stages: dict[str, float] = {}  # noqa: RUF012

    def __init__(self) -> None:
        self.weights = torch.ones(2**22)

    def reset(self) -> None:
        """It has no past."""

    def __call__(self, frame: Frame) -> Tensor:
        return frame.color * torch.ones(3 * 2**22).mean()


def two_frames() -> list[Frame]:
    return [synthetic_frame(24, 20)] * 2


@pytest.mark.usefixtures("measures_memory")
def test_peak_memory_is_what_a_method_adds() -> None:
    peak = peak_memory(Greedy, two_frames, threads=1, device="cpu")
    if peak is None:
        pytest.skip("this system does not tell the peak of the resident set")
    # 16 MiB of weights and 48 MiB on the way; little else.
    assert 64 <= peak < 72
    assert peak_memory(lambda: Greedy(), two_frames, threads=1, device="cpu") is None
    assert peak_memory(Greedy, functools.partial(synthetic_frame, -1, -1), threads=1, device="cpu") is None


class Stuck(Greedy):
    """Writes the number of its process to a file and comes to no end."""

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

    # 3 ms, and 20 ms a megapixel.
    exact = fit_line("ours", [cost(100, 5.0), cost(1000, 23.0), cost(2000, 43.0), Cost("ours", 9000, 1000)])
    assert (exact.fixed, exact.per_megapixel) == pytest.approx((3.0, 20.0))
    assert exact.deviation == pytest.approx(0, abs=1e-9)
    # Equal at both ends and four times as much between: y = c, with the least sum of (1 - c / y)^2 over 1, 4, 1.
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
        with pytest.raises(InputError, match="--sizes: expected WIDTHxHEIGHT"):
            parse_sizes(text)


def test_the_synthetic_frame_has_a_history() -> None:
    frame, replaced = synthetic_frame(40, 30).validate()
    denoiser = Denoiser(Half())
    for expected in ("first frame", ""):
        denoiser(frame)
        assert (denoiser.report.reset, denoiser.report.missing) == (expected, [])
    assert replaced == 0


def test_too_large_an_image_is_not_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    log: list[str] = []

    def peak(make: Callable[..., Any], frames: functools.partial[Any], **_: Any) -> float:
        width, height = frames.args
        return 10 + width * height * 1e-3

    monkeypatch.setattr(mcdenoise.benchmark.memory, "peak_memory", peak)
    monkeypatch.setattr(mcdenoise.benchmark.sizes, "available_memory", lambda device: 2 * 1013 * 2**20)
    large = scripted("A", log)
    sizes = [(1003, 1000), (1004, 1000)]
    costs, _ = measure_sizes([large], {"A": large.make()}, sizes, rounds=1, threads=1, device="cpu")
    assert log == ["A"] * 3 + ["reset A"] * 2
    assert costs[0].failure == ""
    assert costs[1].milliseconds is None
    assert costs[1].failure == "too little memory: expected to need 1014 MiB, found 1013 MiB that may be used"


@pytest.mark.parametrize(
    ("numbers", "most", "expected"),
    [
        ([8, 9, 10, 11], 3, [9, 10, 11]),
        ([0, 1, 2, 5, 6], 3, [0, 1, 2]),
        ([0, 1, 5, 6], 3, [5, 6]),
        ([0, 1, 2, 7, 8, 9, 10, 20], 2, [9, 10]),
        ([4], 4, [4]),
        ([4, 5], 0, []),
    ],
)
def test_pictures_are_of_successive_frames(numbers: list[int], most: int, expected: list[int]) -> None:
    assert kept_frames(numbers, most) == expected


# Operators


def test_ops_are_compared_with_their_equation_and_with_a_copy(out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcdenoise.benchmark.operators, "_COPY_BYTES", 2**20)
    results = benchmark_ops(size=(33, 20), rounds=3, out=out, ops=OPS)
    limits = {"float32": 2e-6, "bfloat16": 2e-2, "float16": 3e-3}
    by_name = {(cost.op, cost.dtype): cost for cost in results.costs if cost.backend == "torch"}
    assert list(by_name) == [(op.name, dtype) for op in OPS for dtype in limits]
    # Another backend may not run here.
    assert not any(cost.failure for cost in by_name.values())
    for cost in (cost for cost in results.costs if not cost.failure):
        assert cost.error < limits[cost.dtype]
        assert cost.milliseconds.count == 3
        assert cost.copy == pytest.approx(cost.mebibytes * 2**20 / (results.bandwidth * 1e9) * 1e3)
        assert cost.over_copy == pytest.approx(cost.milliseconds.median / cost.copy)
        if cost.backend == "numba" and cost.op in ("accumulate", "downsample", "motion_from_position"):
            assert cost.with_derivatives is cost.over_copy_with_derivatives is None
        else:
            assert cost.with_derivatives.count == 3
            ratio = cost.with_derivatives.median / cost.copy_with_derivatives
            assert cost.over_copy_with_derivatives == pytest.approx(ratio)
    assert by_name["downsample", "bfloat16"].error > 1e-4
    # A kernel of 25 taps: 25 values and an RGB image in, an RGB image out.
    assert by_name["kernel_conv", "float32"].mebibytes == (25 + 3 + 3) * 33 * 20 * 4 / 2**20
    assert by_name["kernel_conv", "float16"].mebibytes == (25 + 3 + 3) * 33 * 20 * 2 / 2**20
    # The kernel and both images once more, and the derivatives of kernel and image.
    assert by_name["kernel_conv", "float32"].mebibytes_with_derivatives == (31 + 31 + 28) * 33 * 20 * 4 / 2**20
    # Five channels, of which a quarter of the pixels remains.
    assert by_name["downsample", "float32"].mebibytes == 5 * (33 * 20 + 17 * 10) * 4 / 2**20
    assert by_name["upsample", "float32"].mebibytes == 5 * (33 * 20 + 17 * 10) * 4 / 2**20

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


@op("numba", "triton")
def with_backends(image: Tensor) -> Tensor:
    return plain(downsample)(image)


def test_every_backend_has_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcdenoise.benchmark.operators, "_COPY_BYTES", 2**20)
    monkeypatch.setitem(_op._forms, ("numba", "with_backends"), lambda image: with_backends.plain(image) * 1.5)
    assert backends_of(upsample) == ("torch",)
    (known,) = (op for op in OPS if op.function is downsample)
    results = benchmark_ops(size=(16, 12), rounds=1, ops=[replace(known, function=with_backends)])
    rows = {(cost.backend, cost.dtype): cost for cost in results.costs}
    assert len(rows) == 9
    assert rows["torch", "float32"].error < 1e-6
    assert rows["numba", "float32"].error == pytest.approx(0.5)
    assert rows["triton", "float32"].failure.endswith("found 'triton', which runs on an NVIDIA GPU, not on cpu")
    assert rows["triton", "float32"].milliseconds is None


def test_the_command_for_ops(run: Callable[..., Any], out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mcdenoise.benchmark.operators, "_COPY_BYTES", 2**20)
    measured: list[OpResults] = []
    first: tuple[Op, ...] = OPS[:1]

    def some_ops(**arguments: Any) -> OpResults:
        measured.append(benchmark_ops(ops=first, **arguments))
        return measured[0]

    monkeypatch.setattr("mcdenoise.cli.benchmark.benchmark_ops", some_ops)
    file = out.parent / "ops.json"
    status, printed, _ = run("--ops", "--size", "16x12", "--rounds", "2", "--json", file)
    assert status == 0
    assert f"a copy moves {measured[0].bandwidth:.1f} GB/s" in printed
    assert json.loads(file.read_text()) == asdict(measured[0])
    assert not out.exists()
    assert run("--ops", "--size", "1x1")[0] == 2


# What models leave out


def test_models_are_shown_beside_themselves_with_nothing_left_out(
    run: Callable[..., tuple[int, str, str]], small_sequence: Path, out: Path
) -> None:
    # A camera at rest: the first matrix for all frames, and the first position.
    inputs = small_sequence / "inputs"
    matrices = read_camera_matrices(inputs / "camera_matrices.h")
    still = replace(matrices, matrices=matrices.matrices[[0, 0, 0, 0]])
    write_camera_matrices(inputs / "camera_matrices.h", still, "plane")
    for number in (1, 2, 3):
        for name in ("world_position", "depth", "shading_normal", "albedo"):
            shutil.copy(inputs / f"{name}0.exr", inputs / f"{name}{number}.exr")
    arguments = (small_sequence, "-o", out, "--models", "cascaded_tiny", "--precisions", "float32", "--peers", "none")
    status, printed, _ = run(*arguments, "--keep-all", "--sizes", "none", "--rounds", "1")
    assert status == 0
    results = Results.read(out)
    assert " --keep-all " in results.command
    short, whole = (results.cell("plane", name) for name in ("cascaded_tiny", "cascaded_tiny, keep all"))
    assert short is not None
    assert whole is not None
    left_out = {row["stage"]: row["left_out"] for row in short.plan}
    assert left_out["reproject"] == 0.75
    assert not any(row["left_out"] for row in whole.plan)
    (row,) = results.left_out()
    assert (row.scene, row.method) == ("plane", "cascaded_tiny")
    assert row.stages.startswith("reproject 75%")
    assert row.saved == pytest.approx(whole.computing.median - short.computing.median)
    assert set(row.change) == set(short.errors)
    assert row.change["SMAPE"] == short.errors["SMAPE"] - whole.errors["SMAPE"] == 0
    assert "ms saved" in printed
    assert "What models left out" in (out / "index.html").read_text()


def test_without_the_other_nothing_is_known_of_what_was_saved() -> None:
    plan = [{"stage": "network", "kept": True, "left_out": 0.25, "reason": "", "exact": True}]
    machine = Machine("", 1, 1.0, "cpu", 1, "")
    cells = [Cell("a", "x", plan=plan), Cell("a", "y")]
    assert Results("", "", machine, 1, [], [], cells).left_out() == [LeftOut("a", "x", "network 25%")]
