"""The way the threads of commands wait."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

SAID = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")


def policies(**own: str) -> dict[str, str]:
    environment = {name: value for name, value in os.environ.items() if name not in SAID}
    environment |= {"OMP_DISPLAY_ENV": "VERBOSE", **own}
    command = [sys.executable, "-m", "mcdenoise", "evaluate", "--help"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return dict(re.findall(r"(OMP_WAIT_POLICY|GOMP_SPINCOUNT) *= *'(\w+)'", done.stderr))


def test_the_threads_of_commands_wait_without_spinning() -> None:
    found = policies()
    if not found:
        pytest.skip("this torch has an OpenMP that does not tell its settings")
    assert found["OMP_WAIT_POLICY"] == "PASSIVE"
    assert found.get("GOMP_SPINCOUNT", "0") == "0"


def test_the_number_of_threads_is_the_users(small_sequence: Path, tmp_path: Path) -> None:
    """Also if it is larger than that of the cores."""
    environment, more = {**os.environ, "OMP_NUM_THREADS": "1"}, 2 * (os.cpu_count() or 1) + 1
    command = [sys.executable, "-m", "mcdenoise", "denoise", str(small_sequence), "--model", "wild_small"]
    for expected, options in ((1, []), (more, ["--threads", str(more)])):
        out = tmp_path / str(expected)
        done = subprocess.run([*command, "-o", str(out), *options], env=environment, capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (0, "")
        assert json.loads((out / "denoise.json").read_text())["threads"] == expected


def test_the_package_alone_imports_no_torch() -> None:
    code = """
import os, sys
import mcdenoise
from mcdenoise.cli import main
assert "torch" not in sys.modules
assert "OMP_WAIT_POLICY" not in os.environ, "the library decides nothing"
assert set(mcdenoise.__all__) <= set(dir(mcdenoise))
for name in mcdenoise.__all__:
    assert getattr(mcdenoise, name).__name__.rpartition(".")[2] == name
assert "torch" in sys.modules
"""
    environment = {name: value for name, value in os.environ.items() if name not in SAID}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)
