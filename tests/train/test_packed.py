"""Shots of packed takes: the history of all frames is in those that are kept, and stills give clips, too."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mcdenoise.data.shards import Shard, open_shard, write_shard
from mcdenoise.frame import Frame
from mcdenoise.models import Accumulated, Demodulated
from mcdenoise.train.clips import ClipSampler
from mcdenoise.train.front import Front
from mcdenoise.train.packed import shots_of

SIZE = (12, 20)
FEATURES = frozenset({"albedo"})
FRONT = Front(((Demodulated, {}), (Accumulated, {"alpha_min": 0.03})))


def take(folder: Path, frames: int = 8, references: int = 3) -> Shard:
    draws = np.random.default_rng(frames)
    arrays = {name: draws.random((frames, 3, *SIZE)) for name in ("color", "albedo", "normal")}
    arrays |= {"motion": np.zeros((frames, 2, *SIZE)), "depth": np.ones((frames, 1, *SIZE))}
    arrays["reference"] = draws.random((references, 3, *SIZE))
    arrays["reference_error"] = draws.random((references, 3, *SIZE))
    path = folder / f"{frames}.take.npz"
    write_shard(path, {}, arrays)
    return open_shard(path)


def accumulated(shard: Shard, start: int) -> torch.Tensor:
    """The radiance of the last three frames with a history from this frame on."""
    step, found = FRONT.begin(), []
    arrays = {name: array for name, array in shard.read().items() if len(array) == len(shard)}
    for t in range(start, len(shard)):
        images: dict[str, Any] = {
            n: torch.from_numpy(array[t : t + 1].astype(np.float32)) for n, array in arrays.items()
        }
        found.append(step(Frame(**images).validate()[0]).color)
    return torch.cat(found[-3:])


def test_the_frames_that_are_kept_have_the_history_of_all(tmp_path: Path) -> None:
    shard = take(tmp_path)
    whole, later = shots_of(shard, FRONT, FEATURES, 3, start_every=2)
    assert [len(whole), whole.references] == [3, 3]
    second = 11 - int(later.read()["length"].max()) - 3
    assert second in (2, 4)
    for shot, start in ((whole, 0), (later, second)):
        read = shot.read()
        assert set(read) == {"color", "current", "length", "albedo", "reference"}
        torch.testing.assert_close(read["color"], accumulated(shard, start), rtol=1e-3, atol=1e-3)
        part = shot.cut(slice(1, 3)).read(rows=slice(2, 9))
        assert all(torch.equal(part[name], read[name][1:, :, 2:9]) for name in read)
    assert float(whole.read()["length"].max()) == 8


def test_without_a_history_all_frames_are_handed(tmp_path: Path) -> None:
    (shot,) = shots_of(take(tmp_path), Front(), FEATURES, 3, start_every=2)
    read = shot.read()
    assert {name: len(images) for name, images in read.items()} == {"color": 8, "albedo": 8, "reference": 3}
    assert "reference" not in shot.cut(slice(2, 4)).read()


@pytest.mark.parametrize("front", [Front(), FRONT], ids=["alone", "accumulated"])
def test_a_clip_of_a_still_has_as_many_parts_of_it(front: Front, tmp_path: Path) -> None:
    shots = [
        shot for frames, kept in ((1, 1), (8, 3)) for shot in shots_of(take(tmp_path, frames, kept), front, FEATURES, 3)
    ]
    clip = ClipSampler([shots[0]], 3, 8).draw([1, 2])
    assert clip["color"].shape == clip["reference"].shape == (2, 3, 3, 8, 8)
    assert not torch.equal(clip["color"][:, 0], clip["color"][:, 1])
    assert ClipSampler(shots, 3, 8).draw(range(6))["color"].shape == (6, 3, 3, 8, 8)
