"""Compiled code that is kept from run to run: nothing foreign is used, and no run ends because of it."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

numba = pytest.importorskip("numba")

from mcdenoise.ops._numba._runtime import _Cache  # noqa: E402

KERNEL = "def twice(value):\n    return value + value\n"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def twice(tmp_path: Path, folder: Path) -> Callable[..., Any]:
    path = tmp_path / "kernels_of_this_test.py"
    path.write_text(KERNEL)
    scope: dict[str, Any] = {}
    exec(compile(KERNEL, str(path), "exec"), scope)
    return scope["twice"]


def hits(function: Callable[..., Any], value: Any) -> int:
    kernel = numba.njit(function)
    kernel._cache = _Cache(function)
    assert kernel(value) == function(value)
    return sum(kernel.stats.cache_hits.values())


def files(folder: Path, suffix: str) -> list[Path]:
    return sorted(path for path in folder.rglob(f"*{suffix}") if not path.is_dir())


def test_compiled_code_is_found_by_the_next_run(twice: Callable[..., Any]) -> None:
    assert [hits(twice, 2.0) for _ in range(3)] == [0, 1, 1]
    assert [hits(twice, 2) for _ in range(2)] == [0, 1]


@pytest.mark.parametrize("suffix", [".nbi", ".nbc"])
def test_a_damaged_file_is_written_again(twice: Callable[..., Any], folder: Path, suffix: str) -> None:
    assert hits(twice, 2.0) == 0
    for length in (0, 1, 20, 60, 1000):
        (path,) = files(folder, suffix)
        content = path.read_bytes()
        path.write_bytes(content[: min(length, len(content) - 1)])
        assert [hits(twice, 2.0) for _ in range(2)] == [0, 1]
        for old in set(files(folder, ".nbc")) - {max(files(folder, ".nbc"), key=lambda each: each.stat().st_mtime_ns)}:
            old.unlink()


@pytest.mark.skipif(os.name != "posix", reason="no owners and modes of folders")
def test_a_folder_that_everybody_may_write_is_not_used(twice: Callable[..., Any], folder: Path, tmp_path: Path) -> None:
    assert hits(twice, 2.0) == 0
    (path,) = files(folder, ".nbi")
    path.parent.chmod(0o777)
    # Whoever unpickles it makes a folder.
    path.write_bytes(f"cposix\nmkdir\n(V{tmp_path / 'opened'}\ntR.".encode())
    assert [hits(twice, 2.0) for _ in range(2)] == [0, 0]
    assert not (tmp_path / "opened").exists()
