"""What a run trains on, and what it is watched on."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcdenoise.data import open_sequence
from mcdenoise.data.cache import Shot, check_trainable, open_cached
from mcdenoise.data.clips import ClipSampler, check_sizes
from mcdenoise.data.sequences import Sequence
from mcdenoise.errors import InputError
from mcdenoise.train.config import TrainConfig


@dataclass(frozen=True)
class TrainingData:
    """Sequences, ready to be trained on.

    Args:
        sampler: draws the training clips.
        watched: name and frames of what is validated on.
        description: of every sequence, enough to tell whether another one has the same pixels.
    """

    sampler: ClipSampler
    watched: list[tuple[str, Shot]]
    description: dict[str, Any]


@dataclass(frozen=True)
class DataFolders:
    """Sequences that have what training needs, as far as can be told without reading pixels.

    Args:
        config: of the run.
        training: to train on, but for the frames that are held out.
        validation: used for nothing but validation.
    """

    config: TrainConfig
    training: list[Sequence]
    validation: list[Sequence]

    @staticmethod
    def open(config: TrainConfig, training: list[Path], validation: list[Path]) -> DataFolders:
        """Open the folders.

        Raises:
            InputError: there is none to train on, a sequence has no references or features, none is long enough, or
                one is smaller than the crop.
        """
        if not training:
            raise InputError("training data: expected at least one sequence folder, found none; name one or more")
        folders = DataFolders(config, [open_sequence(p) for p in training], [open_sequence(p) for p in validation])
        for sequence in (*folders.training, *folders.validation):
            check_trainable(sequence)
        lengths = [(len(s) - len(folders._held_out(s)), s.size) for s in folders.training]
        check_sizes(lengths, config.frames, config.crop)
        return folders

    def load(self, cache: Path) -> TrainingData:
        """Decode and accumulate what is not in the cache yet.

        Raises:
            InputError: a file is damaged, or the cache cannot be written.
        """
        config = self.config
        shots: list[Shot] = []
        watched: list[tuple[str, Shot]] = []
        entries: list[dict[str, Any]] = []
        for sequence in self.training:
            held = self._held_out(sequence)
            length = len(sequence) - len(held)
            firsts = range(0, len(sequence), config.start_every)
            # A shot without room for a clip would be kept for nothing; the first one also has the checksum.
            useful = [first for first in firsts if first == 0 or length - first >= config.frames]
            cached = open_cached(
                sequence, cache, alpha_min=config.alpha_min, firsts=useful, keep_fireflies=config.keep_fireflies
            )
            shots += [shot.until(length - first) for first, shot in zip(useful, cached.shots, strict=True)]
            if held:
                watched.append((sequence.name, cached.shots[0].last(len(held))))
            realisations = len(cached.shots[0].colors)
            entries.append(_describe(sequence, cached.sha256, realisations=realisations, validation=held))
        description: dict[str, Any] = {"sequences": entries}
        for sequence in self.validation:
            cached = open_cached(sequence, cache, alpha_min=config.alpha_min, firsts=[0], realisations=1)
            watched.append((sequence.name, cached.shots[0]))
            description.setdefault("validation_sequences", []).append(_describe(sequence, cached.sha256))
        sampler = ClipSampler(
            shots,
            config.frames,
            config.crop,
            lamps=config.lamps,
            exposure=config.exposure,
            tint=config.tint,
            gloss=config.gloss,
        )
        return TrainingData(sampler, watched, description)

    def _held_out(self, sequence: Sequence) -> list[int]:
        """Numbers of the frames that are kept for validation: the last ones, none where too few would be left."""
        enough = len(sequence) >= self.config.frames + self.config.validation_frames
        return sequence.numbers[len(sequence) - self.config.validation_frames :] if enough else []


def _describe(sequence: Sequence, sha256: str, **more: Any) -> dict[str, Any]:
    size = f"{sequence.size[1]}x{sequence.size[0]}"
    return {"name": sequence.name, "frames": len(sequence), "size": size, **more, "sha256": sha256}
