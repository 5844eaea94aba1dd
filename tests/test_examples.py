"""Every example runs as in its docstring, and its claims hold."""

from __future__ import annotations

import json
import re
import runpy
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
import torch
from forked import Server
from torch import nn

from mcdenoise import Frame
from mcdenoise.data import open_sequence, read_exr
from mcdenoise.models import create_model, save_weights

EXAMPLES = Path(__file__).parents[1] / "examples"
RENDERERS = Path(__file__).parent / "data" / "renderers"
SHARED_DATA = Path(__file__).parents[2] / "shared" / "data" / "train"
# A busy machine takes several times as long as a quiet one.
SECONDS = 240


SERVER = Server()


def run(name: str, *arguments: Path | str, alone: bool = False) -> str:
    """Run an example as a separate process, and return its output; it must succeed within minutes.

    What is not ``alone`` has imported the package already, which takes longer than most examples do.
    """
    if alone or sys.platform != "linux":
        command = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS, check=False)
    else:
        with tempfile.TemporaryDirectory() as folder:
            done = SERVER.run(EXAMPLES / name, [*map(str, arguments)], Path(folder), SECONDS)
    assert done.returncode == 0, done.stderr
    return done.stdout


def real_sequence(name: str) -> Path:
    folder = SHARED_DATA / name
    if not folder.is_dir():
        pytest.skip(f"no rendered sequences beside the repository ({name})")
    return folder


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """Weights of a small cascade that hardly changes its input, for examples that need a network."""
    torch.manual_seed(0)
    model = create_model("cascaded_v2", width=8)
    for name, module in model.named_modules():
        if ".initial" in name and ".heads." in name:
            nn.init.normal_(module.weight, std=0.02)
    path = tmp_path / "small.safetensors"
    path.write_bytes(save_weights(model, "cascaded_v2", {"width": 8}, {}))
    return path


def errors(line: str) -> list[tuple[float, float]]:
    """SMAPE and PSNR of each image in one line of compose_denoiser.py."""
    return [(float(smape), float(psnr)) for smape, psnr in re.findall(r"([\d.]+)\s+([\d.]+) dB", line)]


def test_every_example_is_tested_and_says_how_to_run_it() -> None:
    here = "".join(path.read_text() for path in Path(__file__).parent.glob("test_*.py"))
    for path in sorted(EXAMPLES.glob("*.py")):
        assert f'"{path.name}"' in here
        assert f"python examples/{path.name}" in path.read_text()


def test_film_scale_measures_the_time_of_the_driver(tmp_path: Path) -> None:
    pytest.importorskip("ray", reason="films on a cluster need Ray: pip install 'mcdenoise[ray]'")
    file = tmp_path / "scale.json"
    run("film_scale.py", "--nodes", "2", "--shots", "1", "--frames", "2", "--json", file, alone=True)
    assert json.loads(file.read_text())


def test_composed_denoiser_improves_on_its_input(small_sequence: Path) -> None:
    lines = run("compose_denoiser.py", small_sequence, "--last", "2").splitlines()[1:]
    assert len(lines) == 2
    for line in lines:
        noisy, accumulated, composed = errors(line)
        assert composed[0] < accumulated[0] < noisy[0]
        assert composed[1] > accumulated[1] > noisy[1]


# Measured: 0.63, 0.75, 0.56 and 0.55 times the SMAPE of the accumulated frame, and 3.6, 1.3, 4.0 and 4.8 dB more.
@pytest.mark.parametrize(
    "name",
    ["classroom", *(pytest.param(each, marks=pytest.mark.slow) for each in ("staircase", "bathroom2", "sponza"))],
)
def test_composed_denoiser_improves_on_real_frames(name: str) -> None:
    line = run("compose_denoiser.py", real_sequence(name), "--last", "1").splitlines()[-1]
    _, accumulated, composed = errors(line)
    assert composed[0] < 0.8 * accumulated[0]
    assert composed[1] > accumulated[1] + 1


def test_composed_denoiser_is_a_method_of_every_command(small_sequence: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mcdenoise", "denoise", str(small_sequence), "-o", str(tmp_path / "out")]
    command += ["--model", f"{EXAMPLES / 'compose_denoiser.py'}:method"]
    subprocess.run(command, check=True, timeout=SECONDS, capture_output=True)
    assert json.loads((tmp_path / "out" / "denoise.json").read_text())["model"] == "compose_denoiser.py:method"


def test_a_method_composed_of_two_learns(small_sequence: Path) -> None:
    lines = run("compose_zoo.py", small_sequence, "--steps", "60", "--crop", "16").splitlines()
    assert [line.split()[0] for line in lines] == ["noisy", "accumulated", "untrained", "trained"]
    found = [float(re.search(r"SMAPE ([\d.]+)", line)[1]) for line in lines]  # type: ignore[index]
    assert found[3] < min(found[:3])


def test_denoise_sequence_writes_every_frame(small_sequence: Path, weights: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    printed = run("denoise_sequence.py", small_sequence, out, "--weights", weights, "--device", "cpu")
    assert "(first frame)" in printed.splitlines()[0]
    assert sorted(path.name for path in out.iterdir()) == [*(f"denoised{i}.exr" for i in range(4)), "last.png"]
    pixels, channels, _ = read_exr(out / "denoised3.exr")
    assert pixels.shape == (20, 24, 3)
    assert channels == ["R", "G", "B"]
    assert pixels.min() >= 0


def test_gradcheck_passes() -> None:
    lines = run("gradcheck_ops.py", "demodulate", "kernel_conv").splitlines()
    arguments = "color, albedo, normal, logits, falloff, distance_falloff"
    assert lines[0].startswith(f"passed  my_filter, example case, in {arguments}")
    assert {line.split()[1].rstrip(",") for line in lines[1:]} == {"demodulate", "kernel_conv"}
    assert all(line.startswith("passed") for line in lines)


def fitted(printed: str) -> tuple[list[float], float, float]:
    """The printed losses, and the held-out error before and after."""
    losses = [float(value) for value in re.findall(r"^step +\d+ +SMAPE ([\d.]+)$", printed, re.MULTILINE)]
    held_out = re.search(r"held-out SMAPE +before ([\d.]+) +after ([\d.]+)", printed)
    assert held_out
    return losses, float(held_out[1]), float(held_out[2])


def test_fitted_filter_is_better_on_held_out_frames(small_sequence: Path) -> None:
    losses, before, after = fitted(run("fit_filter_parameters.py", small_sequence))
    assert losses[-1] < losses[0]
    assert after < before


# Measured: 0.125 before and 0.082 after; the loss falls from 0.177 to 0.131.
@pytest.mark.slow
def test_fitted_filter_is_better_on_a_held_out_scene() -> None:
    arguments = (real_sequence("classroom"), "--held-out", real_sequence("bathroom2"), "--steps", "40")
    losses, before, after = fitted(run("fit_filter_parameters.py", *arguments))
    assert losses[-1] < 0.85 * losses[0]
    assert after < 0.8 * before


@pytest.mark.slow
def test_unseen_scenes_compares_every_image(small_sequence: Path, weights: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyoidn", reason="Open Image Denoise is in the extra mcdenoise[peers]")
    pytest.importorskip("flip_evaluator", reason="FLIP is in the extra mcdenoise[peers]")
    file = tmp_path / "scores.json"
    arguments = (small_sequence, small_sequence, "--models", weights, "--json", file, "--markdown")
    printed = run("unseen_scenes.py", *arguments, "--sweep", "joint_bilateral", "oidn")
    first_table, second_table, notes, lines = printed.strip().split("\n\n")
    header = "| scene | frames | image | SMAPE | relMSE | RMSE | PSNR | SSIM | FLIP | tSMAPE | tRMSE |"
    assert first_table.startswith(header)
    assert second_table.startswith(header)
    assert notes == "- FLIP: of one in 4 frames."
    metrics = header.split(" | ")[3:]
    metrics[-1] = metrics[-1].removesuffix(" |")
    assert [line.partition(":")[0] for line in lines.splitlines()] == [f"- {metric}" for metric in metrics] * 2

    everything = json.loads(file.read_text())
    scores = everything["scores"]
    # Two images, 20 settings of the joint bilateral filter, 36 of OIDN, and two images of the network for each scene.
    assert len(scores) == 2 * 60
    assert [score["scene"] for score in scores] == [*["plane"] * 60, *["plane (2)"] * 60]
    assert all(set(score["values"]) == set(metrics) for score in scores)
    methods = [score["method"] for score in everything["folded"]]
    plain, best = "joint_bilateral, best of 20 settings", "oidn, best of 36 settings"
    sources = ("raw", "accumulated", "demodulated", "accumulated after")
    oidn = [f"oidn(source={source}, quality={name})" for source in sources for name in ("fast", "balanced", "high")]
    assert methods == ["noisy", "accumulated", plain, *oidn, best, "small, initial", "small"] * 2
    assert len(first_table.splitlines()) == 2 + len(methods)
    assert len(second_table.splitlines()) == 2 + len(everything["summary"])
    first = {score["method"]: score["values"] for score in everything["folded"][:18]}
    mean = {score["method"]: score["values"] for score in everything["summary"]}
    for method, values in first.items():
        assert mean[method] == pytest.approx(values)
    assert mean["oidn, best of each scene"] == pytest.approx(first[best])
    assert first[plain]["SMAPE"] < first["accumulated"]["SMAPE"] < first["noisy"]["SMAPE"]
    assert first[best]["PSNR"] > first["accumulated"]["PSNR"] > first["noisy"]["PSNR"]
    assert [verdict["metric"] for verdict in everything["verdicts"]] == metrics * 2
    verdict = everything["verdicts"][0]
    assert (verdict["method"], verdict["family"]) == ("small", "joint_bilateral")
    assert verdict["value"] == pytest.approx(mean["small"]["SMAPE"])
    assert verdict["ahead"] is (verdict["value"] < verdict["single"])


def test_unseen_scenes_prints_plain_columns_too(small_sequence: Path, weights: Path) -> None:
    arguments = (small_sequence, "--models", weights, "--no-flip", "--frames", "1-3")
    lines = run("unseen_scenes.py", *arguments).splitlines()
    assert len(lines) == 5
    assert lines[0].split() == [
        "scene",
        "frames",
        "image",
        "SMAPE",
        "relMSE",
        "RMSE",
        "PSNR",
        "SSIM",
        "tSMAPE",
        "tRMSE",
    ]
    assert lines[1].split()[:3] == ["plane", "3", "noisy"]


def test_unseen_scenes_sweeps_any_settings(small_sequence: Path, weights: Path) -> None:
    models = f"{weights}(alpha_min=0.1|0.5),{weights}"
    lines = run("unseen_scenes.py", small_sequence, "--models", models, "--no-flip", "--frames", "0-2").splitlines()
    images = [line[15:].partition("  ")[0].strip() for line in lines[1:]]
    assert images[:2] == ["noisy", "accumulated"]
    assert images[2:] == ["cascaded_v2, best of 2 settings", "small, initial", "small"]


def test_unseen_scenes_prints_errors_in_one_line(small_sequence: Path) -> None:
    command = [sys.executable, str(EXAMPLES / "unseen_scenes.py"), str(small_sequence)]
    command += ["--models", "cascaded_v2,cascaded_v2"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS, check=False)
    assert done.returncode == 2
    assert done.stderr == "methods: expected different names separated by commas, found 'cascaded_v2,cascaded_v2'\n"


def test_unseen_scenes_checks_references_first(small_sequence: Path, weights: Path) -> None:
    other = small_sequence.parent / "other"
    shutil.copytree(small_sequence, other)
    for path in (other / "inputs").glob("reference*.exr"):
        path.unlink()
    command = [sys.executable, str(EXAMPLES / "unseen_scenes.py"), str(small_sequence), str(other)]
    command += ["--models", str(weights)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS, check=False)
    assert done.returncode == 2
    assert done.stderr == f"{other}: expected references to compare with, found none; render them\n"


def test_run_time_prints_a_line_for_each_method(tmp_path: Path) -> None:
    file = tmp_path / "times.json"
    models = ("accumulated", "cascaded_v2_tiny(alpha_min=0.2)", f"{EXAMPLES / 'compose_denoiser.py'}:method")
    arguments = ("--models", *models, "--size", "64x36", "--threads", "1", "--rounds", "2", "--json", file)
    lines = run("run_time.py", *arguments).splitlines()
    tiny = "cascaded_v2_tiny(alpha_min=0.2)"
    names = ["accumulated", tiny, f"{tiny}, bfloat16", "compose_denoiser.py:method"]
    assert [line[:44].strip() for line in lines[2:]] == names
    assert lines[2].endswith(" 1.00")
    written = json.loads(file.read_text())
    assert {name: len(times) for name, times in written["milliseconds"].items()} == dict.fromkeys(names, 2)
    assert written["machine"]["threads"] == 1


@pytest.mark.slow
def test_error_vs_runtime_plots_the_printed_values(small_sequence: Path, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="plots need the packages of mcdenoise[report]")
    figure = tmp_path / "figure.svg"
    arguments = (small_sequence, "-o", figure, "--models", "cascaded_v2_tiny", "--rounds", "1")
    first, *lines, last = run("error_vs_runtime.py", *arguments, "--frames", "1-2", "--threads", "1").splitlines()
    assert first.endswith("1 threads; 1 scenes")
    assert last == str(figure)
    printed = {line[:60].strip(): line[60:].strip() for line in lines}
    assert all(re.fullmatch(r"0\.\d+ in \d+\.\d ms", figures) for figures in printed.values())
    drawn = figure.read_text()
    assert drawn.startswith("<?xml")
    assert {"noisy", "accumulated", "cascaded_v2_tiny"} <= printed.keys()
    assert all(name in drawn for name in printed)


# Scenes


@pytest.mark.parametrize("folder", sorted((EXAMPLES / "scenes").iterdir()), ids=lambda folder: folder.name)
def test_a_scene_renders(folder: Path, tmp_path: Path) -> None:
    pytest.importorskip("mitsuba", reason="rendering needs Mitsuba: pip install 'mcdenoise[render]'")
    command = [sys.executable, "-m", "mcdenoise", "render", str(folder / "scene.xml"), "-o", str(tmp_path / "out")]
    command += ["--camera-path", str(folder / "camera_path.json"), "--frames", "2", "--size", "32x18"]
    command += ["--variant", "scalar_rgb", "--reference-spp", "16"]
    subprocess.run(command, check=True, timeout=SECONDS, capture_output=True)
    found = open_sequence(tmp_path / "out")
    assert len(found) == 2
    for number in range(2):
        frame = found.frame(number)
        frame.validate()
        # The scene is lit and visible.
        assert (frame.color > 0).float().mean() > 0.2
        depth = frame.with_depth().depth
        assert depth is not None
        assert depth.isfinite().float().mean() > 0.5


# The paper's tables


@pytest.fixture
def dataset(small_sequence: Path) -> Path:
    """Three scenes, two of which are versions of one."""
    for name in ("hall", "hall-glossy", "yard"):
        shutil.copytree(small_sequence, small_sequence.parent / "dataset" / name)
    return small_sequence.parent / "dataset"


def test_versions_of_a_scene_are_held_out_together() -> None:
    code = (
        "from folds import *\n"
        "scenes = ('classroom', 'living-room', 'san-miguel', 'sponza', 'sponza-glossy', 'sponza-moving-light')\n"
        "print(training_scenes('sponza-glossy', scenes, 'grouped'))\n"
        "print(training_scenes('sponza-glossy', scenes, 'paper'))\n"
        "print(*{fold_folder(Path(), 'grouped', scene, scenes) for scene in scenes if 'sponza' in scene})"
    )
    folder = EXAMPLES / "paper_tables"
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == [
        "['classroom', 'living-room', 'san-miguel']",
        "['classroom', 'living-room', 'san-miguel', 'sponza', 'sponza-moving-light']",
        "folds-grouped/without-sponza",
    ]


@pytest.mark.slow
def test_paper_tables_of_the_available_runs(dataset: Path, tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    small = ("--steps", "1", "--batch", "1", "--frames", "2", "--crop", "16", "--held-out", "hall-glossy", "yard")
    train = ("paper_tables/train_folds.py", dataset, "-o", runs, "--runs", "P+K-1", "P+K-without-TL-1", *small)
    folds = [Path(line).relative_to(runs / "folds-grouped").parts[:2] for line in run(*train).split()]
    names = ("P+K-1", "P+K-without-TL-1")
    assert folds == [(fold, name) for fold in ("without-hall", "without-yard") for name in names]
    grouped = runs / "folds-grouped"
    config = json.loads((grouped / "without-yard" / "P+K-without-TL-1" / "config.json").read_text())
    assert (config["temporal_weight"], config["steps"]) == (0, 1)
    data = json.loads((grouped / "without-hall" / "P+K-1" / "data.json").read_text())
    assert [entry["name"] for entry in data["sequences"]] == ["yard"]
    # Use the same weights as if they had been trained on random scenes.
    for seed in (1, 2, 3):
        shutil.copytree(grouped / "without-hall" / "P+K-1", runs / "ablations" / f"P+K-{seed}")

    tables = ("paper_tables/tables.py", dataset, "--runs", runs, "--markdown", "--frames", "0", "--scenes")
    scenes = ("hall", "hall-glossy", "attic")
    first = run(*tables, *scenes, "--tables", "1")
    named = {(row[0], row[1]): row[2:] for row in cells_of(first)}
    assert named["method", "protocol"] == [*scenes, "average"]
    # Scenes with equal images have equal errors, and a missing scene has none.
    assert named["noisy", "strict"][0] == named["noisy", "strict"][1]
    for method in ("noisy", "accumulated", "SVGF", "BMFR"):
        assert all(re.fullmatch(r"\d+\.\d\d / 0\.\d{4}", cell) for cell in named[method, "strict"][:2])
        assert named[method, "strict"][2] == named[method, "strict"][3]
    assert "no such scene in DATASET: attic" in first
    # A data range of 2 and a box window give higher values.
    assert named["SVGF", "meng2020"][0].split()[-1] > named["SVGF", "strict"][0].split()[-1]

    zoo = ("--recipe", EXAMPLES.parent / "recipes" / "zoo.toml", "--runs", "wskp")
    run("paper_tables/train_folds.py", dataset, "-o", runs, *zoo, *small[:-2], "yard")
    scenes = ("hall", "hall-glossy", "yard")
    left_out = run(*tables, *scenes, "--tables", "1", "--leave-one-out", "--held-out", "yard")
    named = {(row[0], row[1]): row[2:] for row in cells_of(left_out)}
    assert named["method", "protocol"] == ["yard", "average"]
    assert re.fullmatch(r"\d+\.\d\d / 0\.\d{4}", named["WSKP", "strict"][0])
    assert "not trained: no folds-grouped/without-yard/kp/kp.safetensors" in left_out

    third, fourth = run(*tables, *scenes, "--tables", "3", "4", "--held-out", "yard").split("Table 4.")
    rows = {row[0]: row[1:] for row in cells_of(third)}
    assert len({cell for cell in rows["P+K"][2].split(" .. ")}) == 1, "one training has no spread"
    assert rows["P+K"][0] == "97,001"
    assert rows["P+K"][5].startswith("-"), "not trained longer"
    assert re.fullmatch(r"\d+\.\d\d / 0\.\d{4}", rows["P+K"][8])
    assert "not trained: no ablations/K-1/cascaded.safetensors" in third
    assert "not trained: no folds-grouped/without-yard/K-1/cascaded.safetensors" in third
    # There are no claims about networks that are not trained.
    assert "P+K is ahead of K" not in third
    rows = {row[0]: row[1:] for row in cells_of(fourth)}
    assert rows["P+K without TL"][1].startswith("-")
    assert rows["P+K without TL"][6] != rows["P+K without BWA"][6]


def cells_of(text: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("|")]


# Skipping


def test_skipped_shows_five_shots_of_a_scene(small_sequence: Path) -> None:
    lines = run("skipped.py", small_sequence, "--model", "cascaded_v2_tiny", "--frames", "4", "--markdown").splitlines()
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]
    assert rows[0][:3] == ["scene", "shot", "skipped"]
    shots = {row[1]: row for row in rows[2:]}
    assert list(shots) == ["flythrough", "no albedo", "half sky", "static shot", "viewport edit"]
    assert "demodulate 100%" in shots["no albedo"][2]
    assert "reproject 75%" in shots["static shot"][2]
    for row in shots.values():
        whole, short, change = float(row[6]), float(row[7]), float(row[8])
        assert 0 < short < 1
        # The default tolerance does not change the third digit.
        assert abs(change) < 5e-4 * whole
        assert change == pytest.approx(short - whole, abs=1e-5)


@pytest.mark.slow
def test_start_up_times_whole_processes(tmp_path: Path) -> None:
    pytest.importorskip("pyoidn", reason="Open Image Denoise is in the extra mcdenoise[peers]")
    file = tmp_path / "times.json"
    arguments = ("--size", "64x48", "--rounds", "2", "--threads", "1", "--quality", "fast", "--json", file)
    lines = run("start_up.py", *arguments, alone=True).splitlines()
    assert lines[0] == "64x48, one frame, whole process, 1 threads, 2 rounds"
    times = json.loads(file.read_text())["seconds"]
    own, torch_alone = times["mcdenoise denoise, cascaded_v2_tiny, float32"], times["import torch"]
    assert list(times)[:2] == ["pyoidn, fast", "pyoidn, fast, without torch"]
    assert all(len(values) == 2 for values in times.values())
    assert min(own) > min(torch_alone) > min(times["pyoidn, fast, without torch"])
    for line, (name, values) in zip(lines[2:], times.items(), strict=True):
        assert re.fullmatch(rf"{re.escape(name)} +{sum(values) / 2:.2f} +.*", line)


@pytest.mark.slow
def test_training_speed_measures_both_precisions(small_sequence: Path, tmp_path: Path) -> None:
    pytest.importorskip("lightning_fabric", reason="training needs the packages of mcdenoise[train]")
    file = tmp_path / "times.json"
    small = ("--model", "cascaded_v2_tiny", "--batch", "1", "--frames", "2", "--crop", "16", "--threads", "1")
    lines = run("training_speed.py", small_sequence, *small, "--rounds", "2", "--json", file).splitlines()
    assert lines[0] == "cascaded_v2_tiny, 1 clips of 2 frames of 16x16, 2 rounds"
    assert ", 1 threads, mcdenoise " in lines[1]
    times = json.loads(file.read_text())["milliseconds"]
    assert list(times) == ["float32", "bfloat16"]
    for line, (precision, values) in zip(lines[3:], times.items(), strict=True):
        assert line.split()[0] == precision
        assert float(line.split()[1]) == pytest.approx(sum(values) / 2, abs=0.51)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the peak of memory as Linux tells it")
def test_large_frames_prints_the_cost_per_pixel(tmp_path: Path) -> None:
    file = tmp_path / "costs.json"
    arguments = ("--sizes", "64x48,96x64", "--model", "cascaded_v2_tiny", "--max-memory", "2", "--threads", "1")
    lines = run("large_frames.py", *arguments, "--json", file, alone=True).splitlines()
    assert lines[0] == "cascaded_v2_tiny, bfloat16, within 2 GB, 2 frames"
    costs = json.loads(file.read_text())["costs"]
    assert [cost["size"] for cost in costs] == ["64x48", "96x64"]
    for line, cost in zip(lines[3:], costs, strict=True):
        size, network, total, peak, tiles = line.split(maxsplit=4)
        assert (size, tiles) == (cost["size"], "whole frames: all within 2 GB")
        assert 0 < float(network) < float(total)
        assert 0.2 < float(peak) < 2


def test_mitsuba_denoiser_denoises_a_still_and_optimises_where_mitsuba_differentiates(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba", reason="rendering needs Mitsuba: pip install 'mcdenoise[render]'")
    small = ("--size", "32", "--samples", "2", "--steps", "4")
    first, second = run("mitsuba_denoiser.py", "-o", tmp_path / "out", *small).splitlines()
    still = re.search(r"error ([\d.]+) noisy, ([\d.]+) denoised", first)
    assert still
    # Measured at this size: 0.468 and 0.283.
    assert float(still[2]) < 0.8 * float(still[1])
    for name in ("noisy", "denoised"):
        pixels, channels, _ = read_exr(tmp_path / "out" / f"{name}.exr")
        assert pixels.shape == (32, 32, 3)
        assert channels == ["R", "G", "B"]
    found = re.search(r"error of the reflectance ([\d.]+), after 4 steps ([\d.]+)$", second)
    if found is None:
        assert "LLVM" in second
        pytest.skip("the still was denoised; " + second)
    assert float(found[2]) < float(found[1])


def test_layers_of_a_blender_shot_are_compared(tmp_path: Path) -> None:
    for path in (RENDERERS / "blender").iterdir():
        for name in (path.name, path.name.replace("shot", "reference")):
            shutil.copy(path, tmp_path / name)
    title, *lines = run("layers.py", tmp_path, "cascaded_v2_micro").splitlines()
    assert title.startswith("8 layers: ViewLayer.DiffDir, ")
    assert [line.split(" | ")[0] for line in lines[2:]] == [
        "| `cascaded_v2_micro`, color alone",
        "| with layers",
        "| every layer by itself",
    ]
    together, apart = (float(line.rstrip(" |").rpartition("|")[2]) for line in lines[3:])
    assert together < 1e-6 < apart


def test_kornia_containers() -> None:
    motions = re.search(r"motion in x \[(.*)\]", run("kornia_containers.py"))
    assert motions
    assert sorted(float(each) for each in motions[1].split(",")) == [-1.0, 1.0]


def test_a_frame_is_augmented_with_all_its_buffers() -> None:
    from kornia.augmentation import RandomHorizontalFlip

    names = runpy.run_path(str(EXAMPLES / "kornia_containers.py"))
    images = {name: torch.rand(2, channels, 5, 6) for name, channels in names["BUFFERS"].items()}
    moved = names["augment"](Frame(**images), RandomHorizontalFlip(p=1.0))
    sign = torch.tensor([-1.0, 1.0]).reshape(1, 2, 1, 1)
    for name, image in images.items():
        expected = image.flip(-1) * (sign if name == "motion" else 1)
        torch.testing.assert_close(getattr(moved, name), expected, rtol=0, atol=0)
    assert names["preview"](4)(images["color"]).shape == (2, 3, 4, 4)


@pytest.mark.slow
def test_every_part_of_the_first_run_on_a_gpu_runs_on_a_processor(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba", reason="one part renders with Mitsuba")
    run("gpu/run_all.py", "-o", tmp_path, "--device", "cpu", "--quick", alone=True)
    ends = json.loads((tmp_path / "summary.json").read_text())
    assert {each["part"] for each in ends} == {"about", "ops", "models", "training", "mitsuba_loop"}
    rows = [row for each in ends for row in json.loads((tmp_path / f"{each['part']}.json").read_text())]
    assert not [row for row in rows if "failed" in row]
    assert all(max(row["differences"]) < 1e-6 for row in rows if "differences" in row)


def test_a_part_that_fails_leaves_the_others(tmp_path: Path) -> None:
    (tmp_path / "ops.json").mkdir()
    command = [sys.executable, EXAMPLES / "gpu" / "run_all.py", "-o", tmp_path, "--device", "cpu", "--quick"]
    done = subprocess.run([*command, "--parts", "ops", "about"], capture_output=True, text=True, timeout=SECONDS)
    assert done.returncode == 1
    ends = {each["part"]: each["ended"] for each in json.loads((tmp_path / "summary.json").read_text())}
    assert ends["about"] == "done"
    assert "failed" in ends["ops"]


@pytest.mark.slow
def test_training_for_minutes_ends_with_weights_and_goes_on(small_sequence: Path, tmp_path: Path) -> None:
    recipe = tmp_path / "recipe.toml"
    recipe.write_text(
        '[train]\nmodel = "cascaded_v2_micro"\nbatch = 1\nframes = 2\ncrop = 16\nvalidation_frames = 0\n'
        '[[data]]\nseeds = "0"\n'
    )
    arguments = (small_sequence, "-o", tmp_path / "out", "--recipe", recipe, "--minutes", "0.5", "--device", "cpu")
    first, *_, weights = run("gpu/train.py", *arguments, alone=True).splitlines()
    assert int(first.split()[0]) >= 1
    assert create_model("cascaded_v2_micro", weights=Path(weights)) is not None
    assert (tmp_path / "out" / "run" / "checkpoint.pt").exists()
    # It is done already.
    assert run("gpu/train.py", *arguments, alone=True).splitlines() == [first, weights]
