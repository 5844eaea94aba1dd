"""Packed takes: what is written is read, and anything else is refused in one line."""

import io
import json
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damage import flipped, numbers, spliced, truncated
from refusals import refused

from mcdenoise.data.shards import Shard, open_shard, write_shard
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


# Protocol 0 of a call, written out, since no code here imports the module that makes and reads such bytes.
FAILING = b"cpytest\nfail\n(Va pickle was loaded\ntR."


def of_an_entry(g: np.random.Generator, content: bytes) -> bytes:
    """A whole zip, in which one file is damaged, or a pickle, or missing, or there twice."""
    found = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(content)) as old, zipfile.ZipFile(found, "w", zipfile.ZIP_DEFLATED) as new:
        names = old.namelist()
        damaged = names[int(g.integers(len(names)))]
        ways = (truncated, flipped, spliced, numbers, lambda g, content: FAILING)
        for name in names:
            entry = old.read(name)
            if name == damaged:
                entry = ways[int(g.integers(len(ways)))](g, entry + bytes(8))
            for _ in range(int(g.choice([0, 1, 1, 1, 1, 2])) if name == damaged else 1):
                new.writestr(name, entry)
    return found.getvalue()


def of_the_directory(g: np.random.Generator, content: bytes) -> bytes:
    start = content.rindex(b"PK\x01\x02") - 400
    return content[:start] + flipped(g, content[start:])


@pytest.mark.filterwarnings("ignore:Duplicate name", "ignore:Reading .npy")
@pytest.mark.parametrize("damage", [truncated, flipped, spliced, numbers, of_the_directory, of_an_entry])
def test_damage_is_one_short_line_or_changes_nothing(
    damage: Callable[[np.random.Generator, bytes], bytes], tmp_path: Path
) -> None:
    """No pickle is loaded, and little memory is taken."""
    path = tmp_path / "7.take.npz"
    before, content = written(path).read(), path.read_bytes()
    refusals: list[str] = []
    tracemalloc.start()
    for seed in range(25):
        path.write_bytes(damage(np.random.default_rng([seed, 91]), content))
        try:
            after = open_shard(path).read()
        except InputError as error:
            refusals.append(str(error))
        else:
            assert after.keys() == before.keys()
            assert all(np.array_equal(before[name], after[name]) for name in before)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(refusals) > 12
    for message in refusals:
        assert message.startswith(f"{path}: ")
        assert message.isprintable()
        assert len(message) < 300 + len(str(path))
    assert peak < 2**25


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
    refused(lambda: open_shard(changed).read())
