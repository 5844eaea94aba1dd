"""A sweep: recipes times seeds, resumed when they are stopped, with a table of what failed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from mcdenoise.cli import main
from mcdenoise.models import describe_weights
from mcdenoise.train import Recipe

RECIPES = Path(__file__).parents[2] / "recipes"
WEIGHTS = "cascaded_v2_micro.safetensors"


def sweep(out: Path, *arguments: object) -> object:
    """Exit status of the command."""
    with pytest.raises(SystemExit) as stop:
        main(["sweep", *map(str, arguments), "-o", str(out)])
    return stop.value.code


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--workers", "0"], "--workers: expected at least 1, found 0"),
        (["--threads", "0"], "--threads: expected at least 1, found 0"),
        (["--workers", "2", "--ray", "auto"], "--workers, --ray: expected one of them, found both"),
        (["--seeds", "x"], "--seeds: expected"),
        ([RECIPES / "tiny.toml"], "expected a name of its own for each recipe, found tiny again"),
    ],
)
def test_bad_options(tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[object], message: str) -> None:
    (tmp_path / "tiny.toml").write_text((RECIPES / "tiny.toml").read_text())
    assert sweep(tmp_path / "out", tmp_path / "tiny.toml", *arguments) == 2
    printed = capsys.readouterr().err
    assert message in printed
    assert printed.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_seed_of_the_sweep_replaces_those_of_the_recipe(tmp_path: Path) -> None:
    recipe = tmp_path / "two.toml"
    recipe.write_text(
        '[train]\nmodel = "cascaded_v2_micro"\n[[data]]\nseeds = "0"\n[[run]]\nname = "a"\nseeds = [1, 2]\n'
    )
    assert [(run.name, run.config.seed) for run in Recipe.read(recipe, {"seeds"}).runs] == [("a-1", 1), ("a-2", 2)]
    (run,) = Recipe.read(recipe, {"seeds"}, seed=7).runs
    assert (run.name, run.config.seed) == ("a", 7)


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are found in /proc")
def test_killed_workers_and_a_killed_driver_lose_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("mitsuba", reason="rendering needs Mitsuba: pip install 'mcdenoise[render]'")
    pytest.importorskip("lightning_fabric", reason="training needs the packages of mcdenoise[train]")
    pytest.importorskip("tensorboard", reason="training needs the packages of mcdenoise[train]")
    tiny, long = RECIPES / "tiny.toml", tmp_path / "long.toml"
    # Long enough to be killed between two checkpoints.
    long.write_text(tiny.read_text().replace("steps = ", "steps = 1"))
    options = ["--seeds", "1-2", "--threads", "1", "--checkpoint-every", "20"]
    assert sweep(tmp_path / "quiet", tiny, long, *options) == 0
    out = tmp_path / "out"
    command = [sys.executable, "-m", "mcdenoise", "sweep", tiny, long, "-o", out, *options, "--workers", "2"]
    process = subprocess.Popen([*map(str, command)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while not (out / "long-1/checkpoint.pt").exists():
        assert process.poll() is None
        time.sleep(0.05)
    # A worker says who it is where it holds the folder of its run.
    worker = int((out / "long-1/.lock").read_text().split()[1])
    os.kill(worker, signal.SIGKILL)
    while (held := (out / "long-1/.lock").read_text().split())[1] == str(worker):
        assert process.poll() is None
        time.sleep(0.05)
    assert held[0] == "process"
    process.kill()
    process.wait()
    capsys.readouterr()
    until = time.monotonic() + 60
    while (status := sweep(out, tiny, long, *options)) == 2:
        # The workers of the killed driver end with it, in a moment.
        assert time.monotonic() < until
    assert status == 0
    assert capsys.readouterr().out.endswith(f"4 of 4 runs trained: {out}\n")
    for name in ("tiny-1", "tiny-2", "long-1", "long-2"):
        both = [describe_weights(folder / name / WEIGHTS)["sha256"] for folder in (tmp_path / "quiet", out)]
        assert both[0] == both[1], name
    assert json.loads((out / "tiny-2/config.json").read_text())["seed"] == 2


@pytest.mark.slow
def test_a_run_that_fails_is_named_and_the_others_go_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("mitsuba", reason="rendering needs Mitsuba: pip install 'mcdenoise[render]'")
    pytest.importorskip("lightning_fabric", reason="training needs the packages of mcdenoise[train]")
    out = tmp_path / "out"
    assert sweep(out, RECIPES / "tiny.toml", "--seeds", "1") == 0
    checkpoint = out / "tiny-1/checkpoint.pt"
    checkpoint.write_bytes(checkpoint.read_bytes()[:-1])
    (out / "tiny-1" / WEIGHTS).unlink()
    capsys.readouterr()
    assert sweep(out, RECIPES / "tiny.toml", "--seeds", "1-2") == 1
    printed = capsys.readouterr().out
    assert "expected a checkpoint of this run, found one that is damaged" in " ".join(printed.split())
    assert printed.endswith(f"1 of 2 runs trained: {out}\n")
    assert (out / "tiny-2" / WEIGHTS).is_file()
