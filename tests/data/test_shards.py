"""Packed takes: what is written is read, and anything else is refused in one line."""

from __future__ import annotations

import json
import shutil
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mcdenoise.data.shards import Shard, find_shards, open_shard, write_shard
from mcdenoise.errors import InputError


def written(path: Path, **changed: Any) -> Shard:
    rng = np.random.default_rng(0)
    arrays = {
        "color": rng.random((4, 3, 6, 5)) * 1e6,
        "depth": np.full((4, 1, 6, 5), np.inf),
        "reference": rng.random((3, 3, 6, 5)),
    }
    write_shard(path, {"number": 7, "credits": ["a (b)"]}, arrays | changed)
    return open_shard(path)


def test_halves_come_back_as_they_went(tmp_path: Path) -> None:
    color = np.random.default_rng(1).random((4, 3, 6, 5)).astype(np.float16)
    shard = written(tmp_path / "7.take.npz", color=color)
    assert len(shard) == 4
    assert shard.size == (6, 5)
    assert shard.references == 3
    assert shard.header["number"] == 7
    found = shard.read()
    assert np.array_equal(found["color"], color)
    assert np.isinf(found["depth"]).all()
    assert shard.read({"reference"}).keys() == {"reference"}


def test_what_is_too_bright_is_clamped(tmp_path: Path) -> None:
    found = written(tmp_path / "7.take.npz").read()["color"]
    assert np.isfinite(found).all()
    assert found.max() == np.finfo(np.float16).max


def test_the_digest_is_that_of_the_content(tmp_path: Path) -> None:
    first, again = written(tmp_path / "7.take.npz"), written(tmp_path / "8.take.npz")
    other = written(tmp_path / "9.take.npz", depth=np.ones((4, 1, 6, 5)))
    assert first.digest == again.digest != other.digest
    assert find_shards(tmp_path) == sorted(tmp_path.glob("*"))


@pytest.mark.parametrize("size", [0, 10, 0.5, 0.98])
def test_a_part_of_a_file_is_refused(tmp_path: Path, size: float) -> None:
    path = tmp_path / "7.take.npz"
    written(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(size if size > 1 else size * len(content))])
    with pytest.raises(InputError) as error:
        open_shard(path).read()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("flipped", range(40, 4000, 397))
def test_damaged_bytes_are_noticed(tmp_path: Path, flipped: int) -> None:
    path = tmp_path / "7.take.npz"
    before = written(path).read()
    content = bytearray(path.read_bytes())
    content[flipped % len(content)] ^= 0xFF
    path.write_bytes(content)
    with suppress(InputError):
        after = open_shard(path).read()
        assert all(np.array_equal(before[name], after[name]) for name in before)


@pytest.mark.parametrize(
    "shapes",
    [
        {"color": [4, 3, 6, 5]},
        {"color": [4, 3, 6, 5], "reference": [5, 3, 6, 5]},
        {"color": [4, 2, 6, 5], "reference": [3, 3, 6, 5]},
        {"color": [4, 3, 60000, 50000], "reference": [3, 3, 60000, 50000]},
        {"color": [4, 3, 6, 5], "reference": [3, 3, 6, 5], "secret": [4, 3, 6, 5]},
        {"color": [4, 3, 6, 6], "reference": [3, 3, 6, 6]},
        [],
    ],
)
def test_shapes_that_cannot_be_are_refused(tmp_path: Path, shapes: object) -> None:
    path, changed = tmp_path / "7.take.npz", tmp_path / "8.take.npz"
    shard = written(path)
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(changed, "w") as new:
        for name in old.namelist():
            about = json.dumps({**shard.header, "shapes": shapes})
            new.writestr(name, about if name == "header.json" else old.read(name))
    with pytest.raises(InputError):
        open_shard(changed).read()


def test_a_take_that_is_gone_is_refused(tmp_path: Path) -> None:
    shard = written(tmp_path / "a/7.take.npz") if (tmp_path / "a").mkdir() is None else None
    shutil.rmtree(tmp_path / "a")
    assert shard is not None
    with pytest.raises(InputError):
        shard.read()
