"""What a run trains on, and what it is watched on."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from mcdenoise.data import open_sequence
from mcdenoise.data.sequences import Sequence
from mcdenoise.errors import InputError
from mcdenoise.models import Needs
from mcdenoise.train.cache import Shot, features_of, open_cached
from mcdenoise.train.clips import ClipSampler, check_sizes
from mcdenoise.train.config import TrainConfig
from mcdenoise.train.front import Front

# A network that is better with these learns to do without them where they are missing, which nobody wants by mistake.
_FEATURES = ("albedo", "normal", "depth")


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
        front: what is done to the frames before they are trained on.
        features: names of the buffers without noise that are trained on.
        training: to train on, but for the frames that are held out.
        validation: used for nothing but validation.
    """

    config: TrainConfig
    front: Front
    features: frozenset[str]
    training: list[Sequence]
    validation: list[Sequence]

    @staticmethod
    def open(
        config: TrainConfig, front: Front, needs: Needs, training: list[Path], validation: list[Path]
    ) -> DataFolders:
        """Open the folders.

        Args:
            config: of the run.
            front: of the model.
            needs: of the rest of the model.
            training: folders to train on.
            validation: folders for nothing but validation.

        Raises:
            InputError: there is none to train on, a sequence has no references or not the features that the model
                needs, frames are missing between others, none is long enough, or one is smaller than the crop.
        """
        if not training:
            raise InputError("training data: expected at least one sequence folder, found none; name one or more")
        opened = [open_sequence(path) for path in (*training, *validation)]
        # What has no albedo is glossy.
        common = frozenset.intersection(*(features_of(sequence) for sequence in opened))
        front = front.of((needs.buffers | needs.uses) & common)
        used = (needs.buffers | needs.uses | ({"albedo"} if config.gloss else set())) - front.parts.keys()
        # The cache knows no single samples: methods that take them learn on their mean.
        used -= {"samples"}
        wanted = needs.buffers - front.parts.keys() | (used & set(_FEATURES))
        for sequence in opened:
            _check_trainable(sequence, wanted)
        features = used & common
        folders = DataFolders(config, front, features, opened[: len(training)], opened[len(training) :])
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
            # A clip may begin anywhere in a shot, so that further ones are of use for their shorter histories alone.
            firsts = range(0, len(sequence), config.start_every if self.front.accumulates else len(sequence))
            # A shot without room for a clip would be kept for nothing; the first one also has the checksum.
            useful = [first for first in firsts if first == 0 or length - first >= config.frames]
            cached = open_cached(
                sequence,
                cache,
                front=self.front,
                features=self.features,
                firsts=useful,
                keep_fireflies=config.keep_fireflies,
            )
            shots += [shot.cut(slice(length - first)) for first, shot in zip(useful, cached.shots, strict=True)]
            if held:
                watched.append((sequence.name, cached.shots[0].cut(slice(length, None))))
            realisations = len(cached.shots[0].colors)
            entries.append(_describe(sequence, cached.sha256, realisations=realisations, validation=held))
        description: dict[str, Any] = {"sequences": entries}
        for sequence in self.validation:
            cached = open_cached(sequence, cache, front=self.front, features=self.features, firsts=[0], realisations=1)
            watched.append((sequence.name, cached.shots[0]))
            description.setdefault("validation_sequences", []).append(_describe(sequence, cached.sha256))
        sampler = ClipSampler(
            shots,
            config.frames,
            config.crop,
            lamps=config.lamps,
            key=config.key,
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


def _check_trainable(sequence: Sequence, wanted: frozenset[str]) -> None:
    """See that a sequence has what training needs, from what is known without reading pixels."""
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
            "render it or choose other frames"
        )
