"""Training and validation data."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from mcdenoise.data import Sequence, open_sequence
from mcdenoise.data.shards import Shard, find_shards
from mcdenoise.errors import InputError
from mcdenoise.models import Needs
from mcdenoise.train.cache import features_of, open_cached
from mcdenoise.train.clips import ClipSampler, check_sizes
from mcdenoise.train.config import TrainConfig
from mcdenoise.train.front import Front
from mcdenoise.train.packed import check_packed, describe_packed, features_of_shard, open_packed, shots_of
from mcdenoise.train.shots import Shot

# Networks that use these buffers would learn to work without them if they were missing, which is rarely intended.
_FEATURES = ("albedo", "normal", "depth")


@dataclass(frozen=True)
class TrainingData:
    """Sequences that are ready for training.

    Args:
        sampler: draws the training clips.
        watched: name and frames of each sequence to validate on.
        description: description of every sequence that identifies its pixels.
    """

    sampler: ClipSampler
    watched: list[tuple[str, Shot]]
    description: dict[str, Any]


@dataclass(frozen=True)
class DataFolders:
    """Sequences that have the buffers for training, as far as headers tell.

    Args:
        config: configuration of the run.
        front: the wrappers that process the frames before training.
        features: names of the buffers without noise to train on.
        training: sequences to train on, except for their validation frames.
        validation: sequences that are used for validation only.
        packed: packed takes to train on.
        packed_validation: packed takes that are used for validation only.
    """

    config: TrainConfig
    front: Front
    features: frozenset[str]
    training: list[Sequence]
    validation: list[Sequence]
    packed: list[Shard]
    packed_validation: list[Shard]

    @staticmethod
    def open(
        config: TrainConfig, front: Front, needs: Needs, training: list[Path], validation: list[Path]
    ) -> DataFolders:
        """Open the folders.

        Args:
            config: configuration of the run.
            front: front of the model.
            needs: needs of the rest of the model.
            training: folders to train on: sequences, or folders of packed takes.
            validation: folders to validate on only.

        Raises:
            InputError: there is no training folder, a sequence lacks references or features that the model needs,
                frames are missing within a sequence, no sequence is long enough, or one is smaller than the crop.
        """
        if not training:
            raise InputError("training data: expected at least one sequence folder, found none; name one or more")
        packed = [open_packed(paths) for paths in (training, validation)]
        opened = [[open_sequence(path) for path in paths if not find_shards(path)] for paths in (training, validation)]
        both, takes = [*opened[0], *opened[1]], [*packed[0], *packed[1]]
        common = frozenset.intersection(*map(features_of, both), *map(features_of_shard, takes))
        front = front.of((needs.buffers | needs.uses) & common)
        # The cache does not store single samples: methods that take samples are trained on their mean.
        used = (needs.buffers | needs.uses) - front.parts.keys() - {"samples"}
        wanted = needs.buffers - front.parts.keys() | (used & set(_FEATURES))
        for sequence in both:
            _check_trainable(sequence, wanted)
        check_packed(takes, wanted)
        features = used & common
        folders = DataFolders(config, front, features, opened[0], opened[1], packed[0], packed[1])
        lengths = [(len(s) - len(folders._held_out(s)), s.size) for s in folders.training]
        lengths += [(len(shard), shard.size) for shard in folders.packed]
        check_sizes(lengths, config.frames, config.crop)
        return folders

    def load(self, cache: Path) -> TrainingData:
        """Decode and accumulate the sequences that are not in the cache yet.

        Raises:
            InputError: a file is damaged, or the cache cannot be written.
        """
        config = self.config
        handed = self.front, self.features, config.frames
        shots: list[Shot] = [shot for each in self.packed for shot in shots_of(each, *handed, config.start_every)]
        watched: list[tuple[str, Shot]] = []
        entries: list[dict[str, Any]] = []
        for sequence in self.training:
            held = self._held_out(sequence)
            length = len(sequence) - len(held)
            # A clip may begin anywhere in a shot; further first frames only provide shorter histories.
            firsts = range(0, len(sequence), config.start_every if self.front.accumulates else len(sequence))
            # Skip a shot without room for a clip, except the first one, which carries the checksum.
            useful = [first for first in firsts if first == 0 or length - first >= config.frames]
            cached = open_cached(sequence, cache, front=self.front, features=self.features, firsts=useful)
            shots += [shot.cut(slice(length - first)) for first, shot in zip(useful, cached.shots, strict=True)]
            if held:
                watched.append((sequence.name, cached.shots[0].cut(slice(length, None))))
            about = {"noise_seeds": cached.shots[0].noise_seeds, "validation": held}
            entries.append(_describe(sequence, cached.sha256, **about))
        description: dict[str, Any] = {"sequences": entries}
        if self.packed:
            description["packed"] = describe_packed(self.packed)
        for sequence in self.validation:
            cached = open_cached(sequence, cache, front=self.front, features=self.features, firsts=[0], noise_seeds=1)
            watched.append((sequence.name, cached.shots[0]))
            description.setdefault("validation_sequences", []).append(_describe(sequence, cached.sha256))
        watched += [(each.path.name, shot) for each in self.packed_validation for shot in shots_of(each, *handed)]
        if self.packed_validation:
            description["packed_validation"] = describe_packed(self.packed_validation)
        light = {"key": config.key, "exposure": config.exposure, "tint": config.tint}
        sampler = ClipSampler(shots, config.frames, config.crop, lamps=config.lamps, **light)
        return TrainingData(sampler, watched, description)

    def _held_out(self, sequence: Sequence) -> list[int]:
        """Numbers of the last frames, kept for validation; none if too few frames would remain."""
        enough = len(sequence) >= self.config.frames + self.config.validation_frames
        return sequence.numbers[len(sequence) - self.config.validation_frames :] if enough else []


def _describe(sequence: Sequence, sha256: str, **more: Any) -> dict[str, Any]:
    size = f"{sequence.size[1]}x{sequence.size[0]}"
    return {"name": sequence.name, "frames": len(sequence), "size": size, **more, "sha256": sha256}


def _check_trainable(sequence: Sequence, wanted: frozenset[str]) -> None:
    """Check that headers of a sequence show everything that training needs."""
    missing = sorted(wanted - features_of(sequence))
    if missing:
        names = ", ".join([*(name for name in _FEATURES if name in wanted), *sorted(wanted - set(_FEATURES))])
        raise InputError(f"{sequence.root}: expected {names} to train this model on, found no {missing[0]}")
    for one, following in pairwise(sequence.numbers):
        if following != one + 1:
            raise InputError(
                f"{sequence.root}: expected frame {one + 1} after frame {one}, found {following}; a clip to train on "
                "has no gaps: render it, or keep the frames of each run in a folder of their own"
            )
    without = sorted(set(sequence.numbers) - set(sequence.reference_numbers))
    if without:
        raise InputError(
            f"{sequence.root}: expected a reference for every frame to train on, found none for frame {without[0]}; "
            "render it, or train on other sequences"
        )
