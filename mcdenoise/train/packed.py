"""Packed takes as shots to train on: read from their files, and kept in memory."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mcdenoise.data.shards import ERROR, Shard, find_shards, open_shard
from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.train.front import Front
from mcdenoise.train.shots import Array, Shot

# Radiance without its albedo may exceed half floats.
_LARGEST = 65504.0


@dataclass(frozen=True)
class PackedShot(Shot):
    """Consecutive frames of a packed take.

    A take is decoded and processed when it is first read, and is then kept in memory as half floats.

    Args:
        shard: the file.
        front: the wrappers that process the frames.
        buffers: names of the features to return.
        start: index of the frame with which the history begins.
        first: index of the first frame, at least ``start``.
        last: index behind the last frame.
        kept: the arrays of the frames from ``keeps`` on, shared by all parts of this shot.
        keeps: index of the first frame that is kept in memory.
    """

    shard: Shard
    front: Front
    buffers: frozenset[str]
    start: int
    first: int
    last: int
    keeps: int
    kept: dict[str, Array] = field(default_factory=dict, compare=False)

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
        if not self.kept:
            self.kept.update(self._read())
        chosen = self.cut(frames)
        found: dict[str, Array] = {}
        for name, array in self.kept.items():
            start = max(self._referenced, self.keeps) if name == "reference" else self.keeps
            found[name] = array[max(chosen.first - start, 0) : max(chosen.last - start, 0), :, rows, columns]
        return {name: array for name, array in found.items() if len(array)}

    def _read(self) -> dict[str, Array]:
        """The frames that are kept, as the front processes them."""
        processed = self.front.wrappers
        arrays: dict[str, Array] = self.shard.read(None if processed else {"color", "reference", *self.buffers})
        reference = arrays.pop("reference")[max(self.keeps - self._referenced, 0) :]
        arrays = {name: array[self.start :] for name, array in arrays.items() if name != ERROR}
        wanted = {*self.front.parts, *self.buffers}
        found = {name: array[self.keeps - self.start :] for name, array in arrays.items() if name in wanted}
        return found | (self._processed(arrays) if processed else {}) | {"reference": reference}

    def _processed(self, arrays: Mapping[str, Array]) -> dict[str, Array]:
        """What the front makes of each frame."""
        step = self.front.begin()
        found: dict[str, list[Array]] = {name: [] for name in self.front.parts}
        for t in range(len(arrays["color"])):
            images: dict[str, Any] = {
                name: torch.from_numpy(array[t : t + 1].astype(np.float32)) for name, array in arrays.items()
            }
            seen = dict(step(Frame(**images).validate()[0]).items())
            if t >= self.keeps - self.start:
                for name, kept in found.items():
                    kept.append(seen[name].clamp(max=_LARGEST).half().numpy())
        return {name: np.concatenate(kept) for name, kept in found.items()}


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


def shots_of(
    shard: Shard, front: Front, buffers: frozenset[str], frames: int, start_every: int = 0
) -> Iterator[PackedShot]:
    """A packed take as a shot with all its history, and as one that begins later.

    Args:
        shard: the take.
        front: the wrappers that process the frames.
        buffers: names of the features to return.
        frames: number of frames at the end that are wanted with the history of the others; a front without a history
            is handed all frames.
        start_every: the shorter history begins at a multiple of this, which differs from take to take; 0 for none.
    """
    last = len(shard)
    first = max(last - frames, 0) if front.accumulates else 0
    yield PackedShot(shard, front, buffers, 0, first, last, first)
    if front.accumulates and start_every and (later := range(start_every, first + 1, start_every)):
        start = later[int(shard.digest, 16) % len(later)]
        yield PackedShot(shard, front, buffers, start, first, last, first)


def describe_packed(shards: list[Shard]) -> dict[str, Any]:
    """What identifies the pixels of packed takes, and whom they are owed to."""
    digest = hashlib.sha256("".join(shard.digest for shard in shards).encode()).hexdigest()
    owed = {str(line) for shard in shards for line in shard.header.get("credits", [])}
    # Each line is a name with author and licence in parentheses.
    authors = sorted({line.partition(" (")[2].rstrip(")") for line in owed})
    return {"takes": len(shards), "sha256": digest, "credits": authors}
