"""Files and folders that are whole under their final names, whatever happens while they are written."""

import json
import os
import signal
import stat
import sys
import time
import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from mcdenoise.data import files
from mcdenoise.data.files import atomic_path, held, new_folder, write_json, write_text
from mcdenoise.errors import InputError

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="POSIX signals and locks")


def stuck(how: Callable[[Path], AbstractContextManager[Path]], path: Path) -> int:
    ready, told = os.pipe()
    with warnings.catch_warnings():
        # It runs nothing of the threads that torch has started.
        warnings.simplefilter("ignore", DeprecationWarning)
        child = os.fork()
    if not child:
        with how(path) as temporary:
            (temporary / "half" if temporary.is_dir() else temporary).write_text("half of it")
            os.write(told, b"!")
            time.sleep(600)
    assert os.read(ready, 1)
    os.close(ready)
    os.close(told)
    return child


def end(process: int) -> None:
    os.kill(process, signal.SIGKILL)
    os.waitpid(process, 0)


@pytest.mark.parametrize("how", [atomic_path, new_folder])
def test_only_leftovers_of_a_killed_process_are_removed_by_the_next(
    tmp_path: Path, how: Callable[[Path], AbstractContextManager[Path]]
) -> None:
    others = [".mcdenoise", ".mcdenoise-mine", ".file.tmp", "file.tmp"]
    for name in others:
        (tmp_path / name).write_text("somebody's")
    (tmp_path / ".mcdenoise-link.tmp").symlink_to(tmp_path / "file.tmp")
    os.mkfifo(tmp_path / ".mcdenoise-pipe.tmp")
    killed, alive = stuck(how, tmp_path / "killed"), stuck(how, tmp_path / "alive")
    try:
        end(killed)
        hidden = {path for path in tmp_path.iterdir() if len(path.name) > 25}
        assert len(hidden) == 2
        # An hour passes.
        for path in tmp_path.iterdir():
            os.utime(path, (time.time() - 3600,) * 2)
        files._swept.clear()
        write_text(tmp_path / "whole.txt", "text")
        left = {path.name for path in tmp_path.iterdir()} - {".mcdenoise-link.tmp", *others, "whole.txt"}
        # The remaining file is that of the process that still writes.
        assert len(left) == 1
        assert left < {path.name for path in hidden}
        assert (tmp_path / "file.tmp").read_text() == "somebody's"
    finally:
        end(alive)


def test_a_new_folder_may_be_an_empty_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "link").symlink_to("empty")
    monkeypatch.chdir(tmp_path / "empty")
    with pytest.raises(InputError, match="cannot be written"), new_folder(Path()) as folder:
        (folder / "half" / "of it").touch()
    assert os.listdir() == []
    with new_folder(tmp_path / "link") as folder:
        (folder / "images").mkdir()
        (folder / "images" / "one").touch()
        assert [path.name for path in tmp_path.glob("*/images")] == []
    # The folder is still the working folder, and the link still a link.
    assert [path.as_posix() for path in Path().rglob("*")] == ["images", "images/one"]
    assert (tmp_path / "link").is_symlink()
    for path, found in ((tmp_path / "link", "files in it"), (tmp_path / "link" / "images" / "one", "a file")):
        with pytest.raises(InputError, match=f"a new or an empty folder, found {found}"), new_folder(path):
            pass


def test_a_file_has_the_permissions_of_one_that_is_written_plainly(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        write_text(tmp_path / "ours", "text")
        (tmp_path / "plain").write_text("text")
    finally:
        os.umask(before)
    ours, plain = (stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("ours", "plain"))
    assert ours == plain == 0o640


def test_json_has_no_nan(tmp_path: Path) -> None:
    content = {"a": [float("nan"), (float("inf"), 1.5)], "b": {"c": -float("inf")}, "d": "NaN"}
    write_json(tmp_path / "x.json", content)

    def refuse(token: str) -> None:
        raise AssertionError(token)

    read = json.loads((tmp_path / "x.json").read_text(), parse_constant=refuse)
    assert read == {"a": [None, [None, 1.5]], "b": {"c": None}, "d": "NaN"}


def test_the_lock_of_a_killed_process_is_taken_over_and_removed(tmp_path: Path) -> None:
    (tmp_path / ".lock").write_text("process 1 of another machine at work in it")
    with held(tmp_path, "training"):
        assert str(os.getpid()) in (tmp_path / ".lock").read_text()
        with pytest.raises(InputError, match="no other training"), held(tmp_path, "training"):
            pass
    assert not list(tmp_path.iterdir())
    with held(tmp_path, "training"):
        assert (tmp_path / ".lock").exists()
