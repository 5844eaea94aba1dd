"""The command line: help, exit statuses, and one clear line for each error."""

import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from commands import refuses, run, silently
from pictures import edit

from mcdenoise.benchmark.sizes import synthetic_frame
from mcdenoise.cli import COMMANDS
from mcdenoise.data import open_sequence, read_exr
from mcdenoise.data.readers.bmfr import write_bmfr_frame
from mcdenoise.models import list_models
from mcdenoise.models._weights import pretrained_models


@pytest.fixture
def denoise(small_sequence: Path, weights: Path, out: Path) -> list[Any]:
    return ["denoise", small_sequence, "-o", out, "--weights", weights]


def whole_images(folder: Path) -> list[str]:
    for path in folder.iterdir():
        read_exr(path)
    return sorted(path.name for path in folder.iterdir())


LIMITS = {"commands": 13, "options": 140}


def test_help_is_complete_short_and_plain() -> None:
    """Every option has a description, none has markup of the source, and they stay few enough to be read."""
    options = 0
    for command in COMMANDS:
        text = silently(command, "--help")
        assert not re.search(r":[a-z]+:|``|\{None\}", text), command
        assert not re.search(r"--[a-z-]+ [^ ]+ +\((?:default|required)", text), command
        options += len(set(re.findall(r"^│ (?:-\w(?: \w+)?, )?(--[a-z-]+)", text, re.MULTILINE)) - {"--help"})
    assert len(COMMANDS) <= LIMITS["commands"]
    assert options <= LIMITS["options"]


def test_summary_and_version() -> None:
    text = silently("--help")
    assert all(re.search(rf"^  {command} +[A-Z].*\.$", text, re.MULTILINE) for command in COMMANDS)
    assert run()[0] == 2
    assert re.fullmatch(r"\d+\.\d+\.\d+\S*\n", silently("--version"))


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["denoise"], ": expected --out PATH, found none; see"),
        (
            ["denoise", "somewhere", "--ot", "out"],
            "expected --out PATH, found none; unrecognized options: --ot out; see",
        ),
        (["evaluate"], ": expected SEQUENCE, found none; see"),
        (["denoise", "somewhere", "-o", "out", "--threads", "many"], "--threads"),
        (["models", "--json"], "--json"),
    ],
    ids=" ".join,
)
def test_bad_usage(monkeypatch: pytest.MonkeyPatch, arguments: list[str], expected: str) -> None:
    # tyro draws lines for one encoding, and hyphens for another.
    for encoding in ("ascii", "utf-8"):
        monkeypatch.setattr(type(sys.stdout), "encoding", encoding)
        message = refuses(*arguments)
        assert expected in message
        assert message.count(f"mcdenoise {arguments[0]} --help") == 1


def test_unknown_command() -> None:
    assert "denoise" in refuses("denoize").partition("expected")[2]


@pytest.mark.parametrize(
    ("option", "value", "expected"),
    [
        ("--frames", "3-1", "expected numbers and ascending ranges"),
        ("--frames", "2-9", "expected frame 4, found frames 0 to 3"),
        ("--threads", "0", "--threads: expected 1 to 1024, found 0"),
        ("--alpha-min", "nan", "--alpha-min: expected in (0, 1], found nan"),
        ("--output-layer", "clean --layers all", "found --layers"),
        ("--device", "abacus", "device 'abacus': expected one that torch can use"),
        ("--model", "kp", "expected weights of model 'kp', found those of 'cascaded'"),
        (
            "--model",
            "wild(hue=1)",
            "argument 'hue': expected an argument of Denoiser or a setting of model 'wild' (size, ",
        ),
        ("--model", "wild_smal", "model 'wild_smal': found no model of this name; did you mean wild_small or "),
        ("--model", "joint_bilateral(sigma_color=1", "expected ')' after the settings, found none; add it"),
        ("--weights", "nothing.safetensors", "nothing.safetensors: expected a safetensors file"),
    ],
)
def test_bad_options_leave_nothing(denoise: list[Any], out: Path, option: str, value: str, expected: str) -> None:
    assert expected in refuses(*denoise, option, *value.split())
    assert not out.exists()


def test_an_output_that_cannot_be_written_is_refused_before_anything_is_printed(
    small_sequence: Path, weights: Path, tmp_path: Path
) -> None:
    file, taken = tmp_path / "file", tmp_path / "taken"
    file.touch()
    (taken / "denoise.json").mkdir(parents=True)
    for out, expected in (
        (small_sequence, "expected another folder than that of the input, found the same"),
        (file, "expected a folder that can be written to"),
        (taken, "cannot be written"),
    ):
        status, text, message = run("denoise", small_sequence, "-o", out, "--weights", weights)
        assert (status, text) == (2, "")
        assert expected in message


def test_the_users_folder_in_quotes(small_sequence: Path, weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", str(small_sequence.parent))
    silently("denoise", f"~/{small_sequence.name}", "-o", "~/a", "--weights=~/small.safetensors")
    assert (weights.parent / "a" / "denoise.json").is_file()


MINE = """
import torch
from mcdenoise.models import Accumulated, Demodulated

def blur(radius=1):
    def filtered(color, albedo):
        return torch.nn.functional.avg_pool2d(color, 2 * radius + 1, 1, radius, count_include_pad=False)
    return Demodulated(Accumulated(filtered))
"""


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    path = tmp_path / "mine.py"
    path.write_text(MINE)
    return path


def test_a_users_model(small_sequence: Path, mine: Path, out: Path) -> None:
    for name in ("blur", "blur(radius=2)"):
        silently("denoise", small_sequence, "-o", out / name, "--model", f"{mine}:{name}")
        report = json.loads((out / name / "denoise.json").read_text())
        assert report["model"] == f"mine.py:{name}"
        assert report["tolerance"] is None
    images = [read_exr(out / name / "denoised3.exr")[0] for name in ("blur", "blur(radius=2)")]
    assert not np.allclose(*images)
    file = mine.parent / "errors.json"
    assert run("evaluate", small_sequence, "--model", f"{mine}:blur", "--json", file)[0] == 0
    in_memory = json.loads(file.read_text())
    assert in_memory["images"] == "mine.py:blur"
    assert run("evaluate", small_sequence, out / "blur", "--json", file)[0] == 0
    written = json.loads(file.read_text())["protocols"]["strict"]["mean"]
    # Files have half precision.
    assert in_memory["protocols"]["strict"]["mean"]["SMAPE"] == pytest.approx(written["SMAPE"], rel=1e-3)


def test_a_missing_frame_is_reported_and_skipped(denoise: list[Any], small_sequence: Path, out: Path) -> None:
    for path in (small_sequence / "inputs").glob("*1.exr"):
        path.unlink()
    status, _, errors = run(*denoise[:-2], "--model", "wild_small")
    assert (status, len(errors.splitlines())) == (0, 1)
    assert "frames: 1 missing" in errors
    assert sorted(path.stem for path in out.glob("*.exr")) == ["denoised0", "denoised2", "denoised3"]
    report = json.loads((out / "denoise.json").read_text())
    assert report["warnings"] == [errors.partition("warning: ")[2].strip()]
    # Positions and cameras give the motion across the gap.
    assert not report["frames"]["2"]["reset"]
    assert report["frames"]["2"]["history"] > 0.5


def test_a_truncated_image_leaves_only_whole_files(denoise: list[Any], small_sequence: Path, out: Path) -> None:
    path = small_sequence / "inputs" / "world_position2.exr"
    path.write_bytes(path.read_bytes()[:-200])
    message = refuses(*denoise)
    assert str(path) in message
    assert "damaged or missing pixels" in message
    assert whole_images(out) == ["denoised0.exr", "denoised1.exr"]


def test_an_invalid_feature_leaves_only_whole_files(denoise: list[Any], small_sequence: Path, out: Path) -> None:
    edit(small_sequence / "inputs" / "shading_normal1.exr", lambda pixels: pixels.__setitem__((3, 4), np.inf))
    assert "frame 1: buffer 'normal': expected finite values" in refuses(*denoise)
    assert whole_images(out) == ["denoised0.exr"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device that is always full")
def test_a_full_standard_output_is_reported_in_one_line() -> None:
    command = [sys.executable, "-m", "mcdenoise", "--version"]
    with open("/dev/full", "w") as full:
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "standard output: cannot be written (No space left on device)" in done.stderr


@pytest.mark.skipif(sys.platform == "win32", reason="POSIX pipes")
def test_work_continues_after_a_closed_pipe(small_sequence: Path, tmp_path: Path) -> None:
    # Unbuffered, so that the first line fails already.
    options = ["--model", "joint_bilateral", "--frames", "0-1", "-o", str(tmp_path / "out")]
    command = [sys.executable, "-u", "-m", "mcdenoise", "denoise", str(small_sequence), *options]
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True)
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "out" / "denoised1.exr").exists()
    assert json.loads((tmp_path / "out" / "denoise.json").read_text())["frames"].keys() == {"0", "1"}


def test_names_that_the_standard_output_cannot_show(small_sequence: Path, tmp_path: Path) -> None:
    shot = tmp_path / "Müller, 映画"
    small_sequence.rename(shot)
    command = [sys.executable, "-m", "mcdenoise", "inspect", str(shot)]
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert "M\\xfcller, \\u6620\\u753b" in done.stdout


def test_denoise(denoise: list[Any], out: Path, tmp_path: Path) -> None:
    figures = tmp_path / "times.json"
    text = silently(*denoise, "--frames", "1,3", "--threads", "1", "--json", figures, "--keep-all")
    assert "plane: bmfr layout, 2 frames, 1 to 3, of 24x20" in text
    assert "accumulate: kept (positions and cameras)" in text
    assert "milliseconds a frame" in text
    assert sorted(path.name for path in out.iterdir()) == ["denoise.json", "denoised1.exr", "denoised3.exr"]
    written, report = json.loads(figures.read_text()), json.loads((out / "denoise.json").read_text())
    assert written == {key: report[key] for key in ("model", "milliseconds", "beside")}
    assert report["threads"] == 1
    assert report["keep_all"] is True


def test_invalid_colors_are_replaced_and_counted(denoise: list[Any], small_sequence: Path, out: Path) -> None:
    def spoil(pixels: np.ndarray[Any, Any]) -> None:
        pixels[3, 4] = np.nan
        pixels[9, 9, 1] = np.inf
        pixels[12, 0, 2] = -1
        pixels[15, 7, 0] = 3e38

    edit(small_sequence / "inputs" / "color1.exr", spoil)
    text = silently(*denoise)
    assert "replaced 4 NaN, infinite, negative or absurdly bright pixels" in text
    for number in range(4):
        assert np.isfinite(read_exr(out / f"denoised{number}.exr")[0]).all()
    frames = json.loads((out / "denoise.json").read_text())["frames"]
    assert [frames[str(number)]["replaced_pixels"] for number in range(4)] == [0, 4, 0, 0]


def test_warnings_of_the_library_are_lines_of_the_command(small_sequence: Path, out: Path) -> None:
    edit(small_sequence / "inputs" / "albedo0.exr", lambda albedo: albedo.__setitem__((0, 0), 3.0))
    command = [sys.executable, "-m", "mcdenoise", "denoise", small_sequence, "-o", out, "--model", "noisy"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0
    (line,) = [line for line in done.stderr.splitlines() if "albedo" in line]
    assert line.startswith("warning: ")
    assert ".py" not in done.stderr


def test_evaluate_takes_images_or_a_model(small_sequence: Path) -> None:
    evaluate = ["evaluate", small_sequence, small_sequence]
    assert "--protocol" in refuses(*evaluate, "--protocol", "loose")
    assert f"found both, {small_sequence} and wild" in refuses(*evaluate, "--model", "wild")
    assert f"found only the sequence {small_sequence}" in refuses(*evaluate[:2])


def test_random_weights_are_said(small_sequence: Path, out: Path, tmp_path: Path) -> None:
    own = tmp_path / "own.py"
    own.write_text(
        "import torch\n\n\nclass Net(torch.nn.Module):\n    def __init__(self):\n        super().__init__()\n"
        "        self.layer = torch.nn.Conv2d(3, 3, 1)\n\n    def forward(self, color):\n"
        "        return self.layer(color).abs()\n\n\n"
        "def trained():\n    net = Net()\n    torch.nn.init.dirac_(net.layer.weight)\n"
        "    torch.nn.init.zeros_(net.layer.bias)\n    return net\n"
    )
    for name, said in (("Net", 1), ("trained", 0)):
        for command in (
            ("denoise", small_sequence, "-o", out / name, "--model", f"{own}:{name}"),
            ("evaluate", small_sequence, "--model", f"{own}:{name}"),
        ):
            status, _, errors = run(*command)
            assert status == 0
            assert len(re.findall(r"^warning: .*random", errors, re.MULTILINE)) == said


def test_models(tmp_path: Path) -> None:
    path = tmp_path / "models.json"
    listed: dict[str, list[str]] = {}
    for option in ("--json", "--all", "--ops"):
        text = silently("models", option, *([] if option == "--json" else ["--json"]), path)
        listed[option] = [entry["name"] for entry in json.loads(path.read_text())]
        assert all(name in text for name in listed[option])
    assert sorted(listed["--json"]) == sorted(pretrained_models())
    assert sorted(listed["--all"]) == list_models()
    assert "kernel_conv" in listed["--ops"]


def test_train(denoise: list[Any], small_sequence: Path, tmp_path: Path) -> None:
    pytest.importorskip("lightning_fabric", reason="training needs the packages of mcdenoise[train]")
    model = ["--model", "cascaded", "--settings", "width=4"]
    small = [*model, "--crop", "16", "--frames", "2", "--batch", "1", "--validation-frames", "1"]
    command = ["train", small_sequence, "-o", tmp_path / "run", *small, "--steps", "2", "--checkpoint-every", "1"]
    status, text, errors = run(*command)
    assert status == 0
    weights = tmp_path / "run" / "cascaded.safetensors"
    assert text == f"{weights}\n"
    # Without a terminal, rich prints no colors.
    assert re.findall(r"^step (\d)  loss \d\.\d{4}  \d+ s  validation smape", errors, re.MULTILINE) == ["1", "2"]
    assert run(*denoise, "--weights", weights)[0] == 0


def test_generate(out: Path) -> None:
    pytest.importorskip("mitsuba", reason="rendering needs Mitsuba: pip install 'mcdenoise[render]'")
    # The scene of the first seed has moving objects, that of the second has none.
    command = ["generate", "-o", out, "--seeds", "4,6", "--frames", "2", "--size", "8x8", "--variant", "scalar_rgb"]
    command += ["--assets", "none", "--noise-seeds", "2", "--reference-spp", "2"]
    text = silently(*command)
    folders = [out / "random0004", out / "random0006"]
    assert text.split() == [str(folder / "inputs") for folder in folders]
    for folder, moves in zip(folders, (True, False), strict=True):
        found = open_sequence(folder)
        assert (len(found), found.size, found.noise_seeds) == (2, (8, 8), 2)
        for number in range(2):
            frame, again = (found.frame(number, noise_seed=k) for k in range(2))
            frame.validate()
            assert (frame.previous_position is not None) is moves
            assert not torch.equal(frame.color, again.color)
    times = {path: path.stat().st_mtime_ns for path in out.rglob("*.exr")}
    assert len(times) == 2 * 2 * 7 + 2
    assert run(*command)[:2] == (0, text)
    assert {path: path.stat().st_mtime_ns for path in out.rglob("*.exr")} == times


@pytest.mark.parametrize(
    ("option", "value", "expected"),
    [
        ("--seeds", "3-1", "--seeds: expected numbers and ascending ranges"),
        ("--frames", "0", "--frames: expected at least 1, found 0"),
        ("--size", "0x8", "expected width and height between 1 and 16384 pixels, found 0x8"),
    ],
)
def test_generate_with_bad_options(out: Path, option: str, value: str, expected: str) -> None:
    pytest.importorskip("mitsuba", reason="rendering needs Mitsuba: pip install 'mcdenoise[render]'")
    message = refuses("generate", "-o", out, "--assets", "none", "--variant", "scalar_rgb", option, value)
    assert expected in message
    assert not out.exists()


def test_a_json_that_cannot_be_written_is_rejected_before_the_work(denoise: list[Any], out: Path) -> None:
    folder = out.parent / "folder"
    folder.mkdir()
    (folder / "loop.json").symlink_to("loop.json")
    for path in (folder / "nowhere/figures.json", folder, folder / "loop.json"):
        for arguments in (denoise, ["models"]):
            status, printed, said = run(*arguments, "--json", path)
            assert (status, printed) == (2, "")
            assert said.startswith(f"mcdenoise {arguments[0]}: {path}: ")
    assert not out.exists()


@pytest.mark.parametrize("name", ["camera.json", "color0.exr"])
def test_a_json_that_would_overwrite_an_input_is_rejected(small_sequence: Path, name: str) -> None:
    path = small_sequence / "inputs" / name
    path.touch()
    before = path.read_bytes()
    assert "which is an input" in refuses("inspect", small_sequence, "--json", path)
    assert path.read_bytes() == before


def test_a_small_still_is_denoised_without_loading_the_compiler(tmp_path: Path) -> None:
    if importlib.util.find_spec("numba") is None:
        pytest.skip("needs numba: pip install 'mcdenoise[fast]'")
    # Smaller images never use compiled kernels.
    width, height = 128, 80
    write_bmfr_frame(tmp_path / "frames", 0, synthetic_frame(width, height))
    code = (
        "import sys\n"
        "from mcdenoise.cli import main\n"
        "try:\n"
        "    main(sys.argv[1:])\n"
        "finally:\n"
        "    print(sorted({'kornia', 'numba'} & set(sys.modules)))"
    )
    command = ["denoise", str(tmp_path / "frames"), "-o", str(tmp_path / "out")]
    arguments = [*command, "--model", "wild_small", "--precision", "float32"]
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True)
    assert (done.returncode, done.stdout.splitlines()[-1:]) == (0, ["[]"]), done.stderr
