"""Pictures: what is written is read, and no file that is not whole."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mcdenoise.data.png import read_png, write_png
from mcdenoise.errors import InputError


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (90, 160)])
def test_written_files_are_read(tmp_path: Path, size: tuple[int, int]) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (*size, 3), dtype=np.uint8)
    write_png(tmp_path / "a.png", picture.transpose(1, 0, 2))
    assert (read_png(tmp_path / "a.png").transpose(1, 0, 2) == picture).all()


def test_files_that_are_no_pictures(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    with pytest.raises(InputError, match=r"a\.png:"):
        read_png(path)
    write_png(path, np.random.default_rng(0).integers(0, 256, (30, 30, 3), dtype=np.uint8))
    whole = path.read_bytes()
    for length in (0, 20, len(whole) // 2, len(whole) - 20):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"a\.png:") as error:
            read_png(path)
        assert "\n" not in str(error.value)
    with pytest.raises(InputError, match=r"a\.png: cannot be written"):
        write_png(tmp_path / "missing" / "a.png", np.zeros((2, 2, 3), np.uint8))


_FULL_DISK = """
import resource, sys
from pathlib import Path
import numpy as np
from mcdenoise.data.png import write_png
from mcdenoise.errors import InputError
path, size = Path(sys.argv[1]), int(sys.argv[2])
picture = np.random.default_rng(0).integers(0, 256, (size, size, 3), dtype=np.uint8)
write_png(path, picture)
before = path.read_bytes()
unlimited = resource.getrlimit(resource.RLIMIT_FSIZE)
for room in [*range(0, len(before), max(len(before) // 20, 1)), len(before) - 1]:
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, unlimited[1]))
    try:
        write_png(path, picture)
        message = "no error"
    except InputError as error:
        message = str(error)
    resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)
    assert "cannot be written" in message and "\\n" not in message, (room, message)
    assert list(path.parent.iterdir()) == [path], room
    assert path.read_bytes() == before, room
print("done")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="limits the file size through the POSIX resource limit")
@pytest.mark.parametrize("size", [8, 100])
def test_full_disk_is_told_and_the_old_file_stays(tmp_path: Path, size: int) -> None:
    command = [sys.executable, "-c", _FULL_DISK, str(tmp_path / "a.png"), str(size)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout) == (0, "done\n"), result.stderr
