"""The repository holds no paths of one machine, no pickles, and weights of a modest size; its wheel stands alone."""

import ast
import re
import runpy
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from mcdenoise.benchmark.sizes import synthetic_frame
from mcdenoise.data.readers.bmfr import write_bmfr_frame

ROOT = Path(__file__).resolve().parents[1]
MACHINE_PATH = re.compile(r"(^|[^A-Za-z0-9_.])/(home|root|tmp|opt|srv|work)/[a-z]")
PICKLERS = {"cloudpickle", "dill", "joblib", "pickle", "shelve"}
PICKLED = {".bin", ".ckpt", ".npy", ".npz", ".pickle", ".pkl", ".pt", ".pth"}
WEIGHTS_LIMIT = 40e6
FILE_LIMIT = 2e6
WHEEL_LIMIT = 25e6
BUILD = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"
# Runs a command of the package in a folder, without what only extras install.
INSTALLED = """
import sys
folder, *sys.argv[1:] = sys.argv[1:]
extras = "av drjit flip_evaluator lightning_fabric matplotlib mitsuba numba onnx onnxruntime PIL pyoidn ray tensorboard"
sys.modules |= dict.fromkeys([*extras.split(), "pytorch_msssim", "zarr"])
sys.path.insert(0, folder)
import mcdenoise.cli
assert mcdenoise.__file__.startswith(folder), mcdenoise.__file__
mcdenoise.cli.main()
"""


@pytest.fixture(scope="module")
def files() -> list[Path]:
    """Every file that git tracks, or would on the next `git add`."""
    if not (ROOT / ".git").exists():
        pytest.skip("not a git checkout")
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    paths = [ROOT / name for name in listed.split("\0") if name]
    return [path for path in paths if path.is_file()]


def test_files_are_small(files: list[Path]) -> None:
    assert [path.name for path in files if path.suffix != ".safetensors" and path.stat().st_size > FILE_LIMIT] == []
    assert [path.name for path in files if path.suffix == ".whl"] == []


def test_no_mutant_is_stale() -> None:
    mutants = runpy.run_path(str(ROOT / "tests" / "mutants" / "mutants.py"))["MUTANTS"]
    assert [each.name for each in mutants if (ROOT / "mcdenoise" / each.file).read_text().count(each.right) != 1] == []


def text_of(path: Path) -> str:
    data = path.read_bytes()
    if b"\0" in data:
        return ""
    try:
        return data.decode()
    except UnicodeDecodeError:
        return ""


def test_no_file_names_a_path_of_one_machine(files: list[Path]) -> None:
    found = [
        f"{path.relative_to(ROOT)}:{number}: {line.strip()[:160]}"
        for path in files
        for number, line in enumerate(text_of(path).splitlines(), start=1)
        if MACHINE_PATH.search(line)
    ]
    assert not found, "\n".join(found)


def test_weights_are_small_and_no_pickles(files: list[Path]) -> None:
    assert not [path.name for path in files if path.suffix in PICKLED]
    weights = [path for path in files if "weights" in path.parent.parts or path.suffix == ".safetensors"]
    assert sum(path.stat().st_size for path in weights) < WEIGHTS_LIMIT


def unpicklers(source: str) -> list[str]:
    nodes = (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.stmt | ast.expr))
    return [f"{node.lineno}: {ast.unparse(node)}" for node in nodes if reads_pickles(node)]


def reads_pickles(node: ast.AST) -> bool:
    match node:
        case ast.Import(names=names):
            return any(alias.name.partition(".")[0] in PICKLERS for alias in names)
        case ast.ImportFrom(module=str(module), level=0):
            return module.partition(".")[0] in PICKLERS
        case ast.Call(func=ast.Attribute(value=ast.Name(id="torch"), attr="load"), keywords=keywords):
            return not any(keyword.arg == "weights_only" and is_true(keyword.value) for keyword in keywords)
        case ast.Call(keywords=keywords):
            return any(keyword.arg == "allow_pickle" and is_true(keyword.value) for keyword in keywords)
    return False


def is_true(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and node.value is True


def test_no_code_reads_a_pickle(files: list[Path]) -> None:
    found = [
        f"{path.relative_to(ROOT)}:{line}"
        for path in files
        if path.suffix == ".py"
        for line in unpicklers(text_of(path))
    ]
    assert not found, "\n".join(found)


def test_the_source_archive_holds_every_file(files: list[Path]) -> None:
    """A file outside of the package that MANIFEST.in does not name is missing outside of a clone, such as test data."""
    lines = [line.split() for line in (ROOT / "MANIFEST.in").read_text(encoding="utf-8").splitlines()]
    grafted = {"mcdenoise", *(name for words in lines if words[:1] == ["graft"] for name in words[1:])}
    # The build adds these by itself; the last ones belong to a clone.
    included = {name for words in lines if words[:1] == ["include"] for name in words[1:]}
    included |= {"pyproject.toml", "README.md", "LICENSE", "MANIFEST.in", ".gitignore", ".ci"}
    assert {path.relative_to(ROOT).parts[0] for path in files} <= grafted | included


@pytest.mark.slow
def test_the_wheel_alone_denoises_a_still_without_extras(tmp_path: Path) -> None:
    pytest.importorskip("setuptools", minversion="77")
    source, site = tmp_path / "source", tmp_path / "site"
    shutil.copytree(ROOT / "mcdenoise", source / "mcdenoise", ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE", "MANIFEST.in"):
        shutil.copy(ROOT / name, source)
    subprocess.run([sys.executable, "-c", BUILD, tmp_path], cwd=source, check=True, capture_output=True, timeout=250)
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.stat().st_size < WHEEL_LIMIT
    zipfile.ZipFile(wheel).extractall(site)
    write_bmfr_frame(tmp_path / "frames", 0, synthetic_frame(64, 36))
    for command in (["denoise", tmp_path / "frames/color0.exr", "-o", tmp_path / "clean.exr"], ["models"]):
        child = [sys.executable, "-P", "-c", INSTALLED, site, *command]
        done = subprocess.run(child, cwd=tmp_path, capture_output=True, text=True, timeout=250, check=False)
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "clean.exr").stat().st_size > 1000
