"""Packed takes as shots to train on: read from their files, and kept in memory."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterable, Iterator, Mapping
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


def shots_of(shard: Shard, front: Front, buffers: frozenset[str], frames: int, start_every: int = 0) -> Iterator[Shot]:
    """A packed take as a shot with all its history, and as one that begins later.

    A take is decoded and processed when it is first read, and is then kept in memory as half floats.

    Args:
        shard: the take.
        front: the wrappers that process the frames.
        buffers: names of the features to return.
        frames: number of frames at the end that are wanted with the history of the others; a front without a history
            is handed all frames.
        start_every: the shorter history begins at a multiple of this, which differs from take to take; 0 for none.
    """
    first = max(len(shard) - frames, 0) if front.accumulates else 0
    starts = [0]
    if front.accumulates and start_every and (later := range(start_every, first + 1, start_every)):
        starts.append(later[int(shard.digest, 16) % len(later)])
    for start in starts:
        read = functools.cache(functools.partial(_read, shard, front, buffers, start, first))
        referenced = max(len(shard) - shard.references - first, 0)
        yield Shot((read,), range(len(shard) - first), shard.size, referenced, front.demodulates)


def _read(shard: Shard, front: Front, buffers: frozenset[str], start: int, first: int) -> dict[str, Array]:
    """The frames from ``first`` on, as the front processes them with a history that begins at ``start``."""
    arrays: dict[str, Array] = shard.read(None if front.wrappers else {"color", "reference", *buffers})
    kept = len(shard) - first
    found = {name: array[-kept:] for name, array in arrays.items() if name in {*front.parts, *buffers, "reference"}}
    if not front.wrappers:
        return found
    step, processed = front.begin(), {name: list[Array]() for name in front.parts}
    for t in range(start, len(shard)):
        seen = dict(step(frame_of(arrays, t)).items())
        if t >= first:
            for name, own in processed.items():
                own.append(seen[name].clamp(max=_LARGEST).half().numpy())
    return found | {name: np.concatenate(own) for name, own in processed.items()}


def frame_of(arrays: Mapping[str, Array], t: int) -> Frame:
    """Frame ``t`` of the arrays of a take, without its reference."""
    images: dict[str, Any] = {
        name: torch.from_numpy(array[t : t + 1].astype(np.float32))
        for name, array in arrays.items()
        if name not in ("reference", ERROR)
    }
    return Frame(**images).validate()[0]


def describe_packed(shards: list[Shard]) -> dict[str, Any]:
    """What identifies the pixels of packed takes, and whom they are owed to."""
    digest = hashlib.sha256("".join(shard.digest for shard in shards).encode()).hexdigest()
    owed = {str(line) for shard in shards for line in shard.header.get("credits", [])}
    # Each line is a name with author and licence in parentheses.
    authors = sorted({line.partition(" (")[2].rstrip(")") for line in owed})
    return {"takes": len(shards), "sha256": digest, "credits": authors}
