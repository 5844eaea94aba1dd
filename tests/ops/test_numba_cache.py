"""Compiled code that is kept from run to run: nothing damaged or foreign is used, and no run ends because of it."""

from __future__ import annotations

import json
import os
import pickle
import random
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

numba = pytest.importorskip("numba")

from mcdenoise.ops._numba._cache import VerifiedCache  # noqa: E402

KERNEL = "def twice(value):\n    return value + value\n\n\ndef thrice(value):\n    return 3 * value\n"
# One op needs six functions, which are compiled quickly.
OP = """
import json, sys
import numba.core.dispatcher as dispatcher
import torch
from mcdenoise.ops._numba.network import softplus

made = softplus(torch.ones(1, 1, 1, 1, dtype=torch.float64), [1.0]).item()
pages = [vars(page) for name, page in sys.modules.items() if name.startswith("mcdenoise.ops._numba.")]
kernels = {one for page in pages for one in page.values() if isinstance(one, dispatcher.Dispatcher)}
names = "cache_hits", "cache_misses"
hits, misses = (sum(sum(getattr(one.stats, name).values()) for one in kernels) for name in names)
print(json.dumps([made, hits, misses]))
"""
EXPECTED = 1.3132616875182228  # log(1 + e)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def kernels(tmp_path: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Callable[..., Any]]:
    """Functions of a file, to be compiled."""
    path = tmp_path / "kernels_of_this_test.py"
    path.write_text(KERNEL)
    scope: dict[str, Any] = {}
    exec(compile(KERNEL, str(path), "exec"), scope)
    return {name: scope[name] for name in ("twice", "thrice")}


def kept(function: Callable[..., Any]) -> Any:
    kernel = numba.njit(function)
    kernel._cache = VerifiedCache(function)
    return kernel


def hits(function: Callable[..., Any], value: Any) -> int:
    """Return how often code was found, by a kernel that is as good as one of a new process."""
    kernel = kept(function)
    assert kernel(value) == function(value)
    return sum(kernel.stats.cache_hits.values())


def files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if not path.is_dir() or path.suffix)


def cut_or_flipped(content: bytes) -> Iterator[bytes]:
    """Cut off at any place, zeroed from any place, longer, and with single bits flipped."""
    draw = random.Random(0)
    yield from (b"", content + b"\0", content * 2, bytes(len(content)), content[32:])
    for _ in range(100):
        length = draw.randrange(len(content))
        yield content[:length]
        yield content[:length] + bytes(len(content) - length)
    for place in (*range(8 * 40), *(draw.randrange(8 * len(content)) for _ in range(300))):
        flipped = bytearray(content)
        flipped[place // 8] ^= 1 << place % 8
        yield bytes(flipped)


class Foreign:
    """Whoever unpickles it makes a folder."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.mark),)


def test_compiled_code_is_found_by_the_next_run(kernels: dict[str, Callable[..., Any]], folder: Path) -> None:
    assert [hits(kernels["twice"], 2.0) for _ in range(3)] == [0, 1, 1]
    assert [hits(kernels["twice"], 2) for _ in range(2)] == [0, 1]
    assert hits(kernels["thrice"], 2) == 0
    assert len(files(folder)) == 3
    kept(kernels["twice"])._cache.flush()
    assert len(files(folder)) == 1


def test_the_half_written_file_of_a_killed_process_is_removed_later(
    kernels: dict[str, Callable[..., Any]], folder: Path
) -> None:
    hits(kernels["twice"], 2.0)
    (whole,) = (path for path in files(folder) if path.suffix == ".nbc")
    content = whole.read_bytes()
    fresh, old = (whole.with_name(f"{whole.name}.tmp.{name}") for name in ("fresh", "old"))
    for path in (fresh, old):
        path.write_bytes(content[:100])
    os.utime(old, (time.time() - 7200,) * 2)
    whole.unlink()
    assert [hits(kernels["twice"], 2.0) for _ in range(2)] == [0, 1]
    # This one may be of a process that is at work.
    assert fresh.exists()
    assert not old.exists()


def test_nothing_of_a_damaged_file_is_used(
    kernels: dict[str, Callable[..., Any]], folder: Path, tmp_path: Path
) -> None:
    kernel = kept(kernels["twice"])
    kernel(2.0)
    (path,) = files(folder)
    content = path.read_bytes()
    sig, context = kernel.signatures[0], kernel.targetctx
    load = VerifiedCache(kernels["twice"]).load_overload
    assert load(sig, context) is not None
    bomb = pickle.dumps(Foreign(tmp_path / "opened"))
    for damaged in (*cut_or_flipped(content), bomb, content[:32] + bomb):
        path.write_bytes(damaged)
        assert load(sig, context) is None
    assert not (tmp_path / "opened").exists()
    path.write_bytes(content)
    assert load(sig, context) is not None
    # The file holds the compiled code of another function, under this one's name.
    kept(kernels["thrice"])(2.0)
    other = next(each for each in files(folder) if each != path)
    path.write_bytes(other.read_bytes())
    assert load(sig, context) is None


def test_a_damaged_file_is_written_again(kernels: dict[str, Callable[..., Any]], folder: Path) -> None:
    assert hits(kernels["twice"], 2.0) == 0
    (path,) = files(folder)
    content = path.read_bytes()
    for damaged in (b"", content[:1000], content[:-1] + bytes([content[-1] ^ 1])):
        path.write_bytes(damaged)
        assert [hits(kernels["twice"], 2.0) for _ in range(2)] == [0, 1]


@pytest.mark.timeout(60)
@pytest.mark.parametrize("what", ["folder", "pipe", "device", "link to nothing", "large", "file for a folder"])
def test_a_folder_or_pipe_in_place_of_a_file_is_not_waited_for(
    kernels: dict[str, Callable[..., Any]], folder: Path, what: str
) -> None:
    hits(kernels["twice"], 2.0)
    (path,) = files(folder)
    path.unlink()
    if what == "folder":
        path.mkdir()
    elif what == "pipe":
        os.mkfifo(path)
    elif what == "device":
        path.symlink_to("/dev/zero")
    elif what == "link to nothing":
        path.symlink_to(path.with_name("nothing"))
    elif what == "large":
        path.touch()
        os.truncate(path, 1 << 40)
    else:
        path.parent.rmdir()
        path.parent.touch()
    # Compiled; and kept, but for where a folder is in the way. Where no folder can be made, that is beside the kernel.
    found = [hits(kernels["twice"], 2.0) for _ in range(2)]
    assert found == [0, 0 if what == "folder" else 1]


def run(folder: Path, before: str = "") -> list[float]:
    command = [sys.executable, "-W", "error", "-c", before + OP]
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert (done.returncode, done.stderr) == (0, "")
    made, hits, misses = json.loads(done.stdout)
    assert made == pytest.approx(EXPECTED, rel=1e-12)
    return [hits, misses]


@pytest.mark.slow
def test_an_op_runs_whatever_happens_to_its_cache(tmp_path: Path) -> None:
    # Every write beyond 4 KB fails, as on a full disk.
    full = "import resource, signal; resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))\n"
    full += "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
    hits, compiled = run(tmp_path, full)
    assert hits == 0
    assert compiled > 0
    # Neither a partial file nor a temporary one.
    assert files(tmp_path) == []
    assert run(tmp_path) == [0, compiled]
    draw = random.Random(1)
    for path in files(tmp_path):
        content = bytearray(path.read_bytes())
        content[draw.randrange(len(content))] ^= 16
        path.write_bytes(content)
    assert run(tmp_path) == [0, compiled]
