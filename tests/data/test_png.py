"""Pictures: what is written is read, and no file that is not whole."""

from pathlib import Path

import numpy as np
import pytest
from refusals import refused

from mcdenoise.data.png import read_png, write_png


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (90, 160)])
def test_written_files_are_read(tmp_path: Path, size: tuple[int, int]) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (*size, 3), dtype=np.uint8)
    write_png(tmp_path / "a.png", picture.transpose(1, 0, 2))
    assert (read_png(tmp_path / "a.png").transpose(1, 0, 2) == picture).all()


def test_files_that_are_no_pictures(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    assert "a.png:" in refused(read_png, path)
    write_png(path, np.random.default_rng(0).integers(0, 256, (30, 30, 3), dtype=np.uint8))
    whole = path.read_bytes()
    for length in (0, 20, len(whole) // 2, len(whole) - 20):
        path.write_bytes(whole[:length])
        assert "a.png:" in refused(read_png, path)
    nowhere = tmp_path / "missing" / "a.png"
    assert "a.png: cannot be written" in refused(write_png, nowhere, np.zeros((2, 2, 3), np.uint8))
