"""Films where little can be relied on: no home, no cache, hostile names."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from commands import refuses, run, succeeds
from shots import pixels, write_shot

import mcdenoise

pytestmark = pytest.mark.usefixtures("inline")

PACKAGE = Path(mcdenoise.__file__).parent
NAMES = ["with space", "line\nbreak", "🎬 ünï", "[a]", "%s", "--ray", "\x1b[2J"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "environment",
    [{}, {"HOME": "/proc/none", "NUMBA_CACHE_DIR": "/dev/null", "LC_ALL": "C"}],
    ids=["no home", "a home that is nowhere, a cache that is a file, the C locale"],
)
def test_environments_without_much(environment: dict[str, str], tmp_path: Path) -> None:
    write_shot(tmp_path / "renders/ünï", 3)
    command = [sys.executable, "-m", "mcdenoise", "film", "renders/*", "-o", "out", "--model", "accumulated"]
    path = ":".join([str(PACKAGE.parent), os.environ.get("PYTHONPATH", "")]).strip(":")
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": path, **environment}
    ended = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    assert "Traceback" not in ended.stderr
    assert len(pixels(tmp_path / "out/ünï")) == 3
    assert json.loads((tmp_path / "out/film.json").read_text())["complete"]


def test_shots_of_hostile_names(tmp_path: Path) -> None:
    shots = {name: write_shot(tmp_path / "renders" / name, 2, seed=i) for i, name in enumerate(NAMES)}
    out = tmp_path / "out"
    printed = succeeds(f"film {tmp_path}/renders/* -o {out} --model accumulated")
    assert printed.count("\n") == len(NAMES) + 1
    assert all(line.isprintable() for line in printed.splitlines())
    assert {path.name for path in out.iterdir() if len(pixels(path)) == 2} == set(shots)
    about = json.loads((out / "film.json").read_text())
    assert {each["name"]: each["complete"] for each in about["shots"]} == dict.fromkeys(NAMES, True)
    assert (out / "film.html").is_file()


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="other systems have no such names")
def test_an_input_that_is_not_unicode_fails_alone(tmp_path: Path) -> None:
    good, bad = write_shot(tmp_path / "renders/a/good", 2), tmp_path / os.fsdecode(b"renders/M\xfcller/bad")
    bad.parent.mkdir()
    shutil.copytree(good, bad)
    out = tmp_path / "out"
    # The first part of the pattern is a part of the name.
    refuses(f"film {tmp_path}/renders/*/[bg]*d -o {out} --model accumulated")
    status, printed, _ = run("film", f"{bad.parent}/*", "-o", out, "--model", "accumulated")
    assert status == 1
    assert "expected a name in UTF-8" in " ".join(printed.split())
    assert all(line.isprintable() for line in printed.splitlines())
    assert not pixels(out / "bad")
