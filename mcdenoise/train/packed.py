"""Packed takes as shots to train on: read from their files, without a cache."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mcdenoise.data.shards import ERROR, Shard, find_shards, open_shard
from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.train.front import Front
from mcdenoise.train.shots import Array, Shot


@dataclass(frozen=True)
class PackedShot(Shot):
    """Consecutive frames of a packed take.

    Args:
        shard: the file.
        front: the wrappers that process the frames, from the first one that is read and within the pixels that are
            read: a take has no cache.
        buffers: names of the features to return.
        first: index of the first frame.
        last: index behind the last frame.
    """

    shard: Shard
    front: Front
    buffers: frozenset[str]
    first: int
    last: int

    @property
    def noise_seeds(self) -> int:
        """Number of noisy colors of a frame."""
        return 1

    @property
    def demodulated(self) -> bool:
        """Whether the radiance of the color is demodulated."""
        return self.front.demodulates

    def __len__(self) -> int:
        return self.last - self.first

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.shard.size

    @property
    def references(self) -> int:
        """Number of the last frames that have a reference."""
        return max(0, self.last - max(self.first, self._referenced))

    @property
    def _referenced(self) -> int:
        """Index of the first frame with a reference."""
        return len(self.shard) - self.shard.references

    def cut(self, frames: slice) -> PackedShot:
        """Select consecutive frames."""
        first, last, _ = frames.indices(len(self))
        return replace(self, first=self.first + first, last=self.first + max(first, last))

    def views(self, frames: slice, rows: slice, columns: slice, noise_seed: int) -> dict[str, Array]:
        """See :meth:`mcdenoise.train.shots.Shot.views`."""
        chosen = self.cut(frames)
        arrays: dict[str, Array] = {}
        needed = None if self.front.wrappers else {"color", "reference", *self.buffers}
        for name, array in self.shard.read(needed).items():
            start = self._referenced if name == "reference" else 0
            arrays[name] = array[max(chosen.first - start, 0) : max(chosen.last - start, 0), :, rows, columns]
        if self.front.wrappers:
            arrays |= self._processed(arrays)
        kept = {*self.front.parts, *self.buffers} | ({"reference"} if chosen.references else set())
        return {name: array for name, array in arrays.items() if name in kept}

    def _processed(self, arrays: Mapping[str, Array]) -> dict[str, Array]:
        """What the front makes of each frame."""
        images: dict[str, Any] = {
            name: torch.from_numpy(array.astype(np.float32))
            for name, array in arrays.items()
            if name not in ("reference", ERROR)
        }
        step, found = self.front.begin(), []
        for t in range(len(arrays["color"])):
            frame = Frame(**{name: image[t : t + 1] for name, image in images.items()})
            seen = dict(step(frame.validate()[0]).items())
            found.append({name: seen[name].numpy() for name in self.front.parts})
        return {name: np.concatenate([each[name] for each in found]) for name in self.front.parts}


def open_packed(paths: Iterable[Path]) -> list[Shard]:
    """The packed takes of these files and folders; the paths of anything else are left out."""
    return [open_shard(file) for path in paths for file in find_shards(path)]


def check_packed(shards: list[Shard], wanted: frozenset[str]) -> None:
    """Check that packed takes have the buffers that a model needs.

    Raises:
        InputError: one lacks a buffer.
    """
    for shard in shards:
        missing = sorted(wanted - shard.shapes.keys())
        if missing:
            raise InputError(f"{shard.path}: expected {', '.join(sorted(wanted))}, found no {missing[0]}")


def features_of_shard(shard: Shard) -> frozenset[str]:
    """Names of the features in a packed take."""
    return frozenset(shard.shapes) - {"color", "reference", ERROR}


def whole(shard: Shard, front: Front, buffers: frozenset[str]) -> PackedShot:
    """All frames of a packed take."""
    return PackedShot(shard, front, buffers, 0, len(shard))


def describe_packed(shards: list[Shard]) -> dict[str, Any]:
    """What identifies the pixels of packed takes, and whom they are owed to."""
    digest = hashlib.sha256("".join(shard.digest for shard in shards).encode()).hexdigest()
    owed = {str(line) for shard in shards for line in shard.header.get("credits", [])}
    # Each line is a name with author and licence in parentheses.
    authors = sorted({line.partition(" (")[2].rstrip(")") for line in owed})
    return {"takes": len(shards), "sha256": digest, "credits": authors}
