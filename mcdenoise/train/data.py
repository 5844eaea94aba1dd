"""Training and validation data."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Iterable, Iterator
from collections.abc import Sequence as Sequential
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcdenoise.data import Sequence, open_sequence
from mcdenoise.data.shards import Shard, find_shards, open_shard
from mcdenoise.errors import InputError, level_of_caller
from mcdenoise.frame import MOTION, tells_motion
from mcdenoise.models import Needs
from mcdenoise.reading import read_text
from mcdenoise.train.clips import ClipSampler, check_sizes
from mcdenoise.train.config import TrainConfig
from mcdenoise.train.footage import (
    FEATURES,
    Source,
    check_trainable,
    features_of,
    place_of,
    references_of,
    shots_of,
)
from mcdenoise.train.front import Front
from mcdenoise.train.shots import Shot


@dataclass(frozen=True)
class TrainingData:
    """Frames that are ready for training.

    Args:
        sampler: draws the training clips.
        watched: name and frames of each sequence to validate on.
        description: description of all frames that identifies their pixels.
    """

    sampler: ClipSampler
    watched: list[tuple[str, Shot]]
    description: dict[str, Any]

    @staticmethod
    def load(
        config: TrainConfig, front: Front, needs: Needs, training: list[Path], validation: list[Path], cache: Path
    ) -> TrainingData:
        """Open the folders, and decode and process the sequences that are not in the cache yet.

        Args:
            config: configuration of the run.
            front: front of the model.
            needs: needs of the rest of the model.
            training: folders to train on: sequences, or folders of packed takes.
            validation: folders to validate on only.
            cache: folder of the decoded sequences.

        Raises:
            InputError: there is no training folder, a sequence lacks references or features that the model needs,
                frames are missing within a sequence, no sequence is long enough, one is smaller than the crop, clips
                would have different numbers of references, a file is damaged, or the cache cannot be written.
        """
        if not training:
            raise InputError("training data: expected at least one sequence folder, found none; name one or more")
        takes, watched_takes = open_takes(training), open_takes(validation)
        sequences, watched_sequences = (
            [open_sequence(path) for path in paths if not find_shards(path)] for paths in (training, validation)
        )
        sources: list[Source] = [*sequences, *watched_sequences, *takes, *watched_takes]
        common = frozenset.intersection(*map(features_of, sources))
        front = front.of((needs.buffers | needs.uses) & common)
        # Single samples are not kept: methods that take samples are trained on their mean.
        used = (needs.buffers | needs.uses) - front.parts.keys() - {"samples"}
        for source in sources:
            check_trainable(source, needs.buffers - front.parts.keys() | (used & set(FEATURES)))
        # Beside folders to validate on, the default is no wish.
        wished = not validation or config.validation_frames != TrainConfig.validation_frames
        for doubt in _doubts(sources, used, config.validation_frames * wished, accumulates=front.accumulates):
            warnings.warn(doubt, stacklevel=level_of_caller())
        # The last frames of a sequence are kept for validation, unless too few would remain.
        least, held = config.frames + config.validation_frames, [0] * len(takes)
        held += [config.validation_frames if len(sequence) >= least else 0 for sequence in sequences]
        both: list[tuple[Source, int]] = list(zip([*takes, *sequences], held, strict=True))
        sizes = [(len(source) - kept, references_of(source) - kept, source.size) for source, kept in both]
        if check_sizes(sizes, config.frames, config.crop) == 1 and config.temporal_weight:
            raise InputError(
                f"temporal_weight: expected 0 for takes with one reference each, found {config.temporal_weight}"
            )

        handed = front, used & common, config.frames, cache
        shots: list[Shot] = []
        watched: list[tuple[str, Shot]] = []
        description: dict[str, Any] = {"sequences": []}
        for source, kept in both:
            whole, digest = shots_of(source, *handed, start_every=config.start_every, held=kept)
            shots += [shot.cut(slice(len(shot) - kept)) for shot in whole]
            if isinstance(source, Sequence):
                watched += [(source.name, whole[0].cut(slice(-kept, None)))] if kept else []
                own = {"noise_seeds": source.noise_seeds, "validation": source.numbers[len(source) - kept :]}
                description["sequences"].append(_describe(source, digest, **own))
        others: list[Source] = [*watched_sequences, *watched_takes]
        for source in others:
            (shot, *_), digest = shots_of(source, *handed, noise_seeds=1)
            watched.append((source.name if isinstance(source, Sequence) else source.path.name, shot))
            if isinstance(source, Sequence):
                description.setdefault("validation_sequences", []).append(_describe(source, digest))
        for name, shards in {"packed": takes, "packed_validation": watched_takes}.items():
            description |= {name: describe_takes(shards)} if shards else {}
        return TrainingData(ClipSampler(shots, config), watched, description)


def _doubts(sources: list[Source], used: frozenset[str], kept: int, *, accumulates: bool) -> Iterator[str]:
    """What a model is trained without although it would use it, and what it is not validated on, in words."""
    if kept and any(isinstance(source, Shard) for source in sources):
        yield f"validation_frames: expected 0 for takes, found {kept}; name other takes to validate on"
    found = [features_of(source) for source in sources]
    still = [source for source, own in zip(sources, found, strict=True) if len(source) > 1 and not tells_motion(own)]
    if still and (accumulates or used & MOTION):
        yield (
            f"{place_of(still[0])}: no motion, and no positions with cameras ({len(still)} of {len(sources)} sequences "
            "and takes): the model is trained on such frames without a history"
        )
    common, every = frozenset.intersection(*found), frozenset().union(*found)
    # Motion tells what the positions are for.
    if lost := sorted(used & every - common - (MOTION if "motion" in common else frozenset())):
        yield f"training data: only some sequences or takes have {', '.join(lost)}; the model is trained without"


def open_takes(paths: Sequential[Path]) -> list[Shard]:
    """The packed takes of these files and folders; the paths of anything else are left out."""
    return [open_shard(file) for path in paths for file in find_shards(path)]


def describe_takes(takes: Sequential[Shard]) -> dict[str, Any]:
    """What identifies the pixels of packed takes, and whom they are owed to."""
    digest = hashlib.sha256("".join(take.digest for take in takes).encode()).hexdigest()
    owed = (str(line) for take in takes for line in take.header.get("credits", []))
    return {"takes": len(takes), "sha256": digest, "credits": _authors(owed)}


def _authors(owed: Iterable[str]) -> list[str]:
    """Authors and licences, which each line has in parentheses after a name."""
    return sorted({line.partition(" (")[2].rstrip(")") for line in owed})


def _describe(sequence: Sequence, sha256: str, **more: Any) -> dict[str, Any]:
    size, owed = f"{sequence.size[1]}x{sequence.size[0]}", sequence.root / "credits.txt"
    if owed.is_file():
        more["credits"] = _authors(read_text(owed).splitlines())
    return {"name": sequence.name, "frames": len(sequence), "size": size, **more, "sha256": sha256}
