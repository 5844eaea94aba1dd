"""The configuration of a training run."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeAlias, get_args, get_type_hints

import msgspec
from msgspec import Meta

from mcdenoise.errors import InputError, did_you_mean
from mcdenoise.methods import parse_method
from mcdenoise.models import DEFAULT
from mcdenoise.models._precision import Precision
from mcdenoise.train.losses import Loss

Schedule = Literal["constant", "cosine"]

_WARM_UP = 200
_Count: TypeAlias = Annotated[int, Meta(ge=1)]
_Weight: TypeAlias = Annotated[float, Meta(ge=0)]
_Stops: TypeAlias = Annotated[float, Meta(ge=0, le=14)]


@dataclass(frozen=True)
class TrainConfig:
    """All settings that determine the result of a training run.

    The defaults are the paper's setting (Sec. 4.2): clips of 8 frames, 128x128 patches, batches of 8 clips, Adam with
    a learning rate of 1e-4, a temporal loss weight of 0.1.

    Args:
        model: a name in the zoo, or your own path/to/file.py:factory or package.module:factory.
        settings: arguments of the model's constructor, such as width=16,cascade=K+P.
        start_from: a model with weights, which the layers of the same names start with, such as wild or
            oidn_open(quality=fast), or a file of weights of an earlier run, such as run/wild.safetensors; all by
            default start with random weights.
        loss: loss of a clip, one of mcdenoise.train.losses.LOSSES: smape, the paper's; l1_display, that of Meng et
            al. 2020; or rae, that of Chaitanya et al. 2017, whose later frames count more.
        steps: optimiser steps.
        batch: clips in a step, of all processes together.
        frames: frames in a clip.
        crop: side of the square patches, pixels.
        learning_rate: highest learning rate of Adam.
        schedule: constant, or cosine down to 0 after a warm-up of 200 steps.
        temporal_weight: weight of the temporal loss.
        display_weight: weight of the error on a display, as a viewer sees it.
        key: each clip is scaled to this typical radiance, a middle gray such as 0.2, before its light is augmented; 0
            keeps the rendered radiance.
        gradient_norm: largest norm of a step's gradient; 0 does not limit it.
        ema: decay of an exponential moving average of the weights, such as 0.999; smaller in the first steps. The
            average is validated, and is the result of the run. 0 uses the weights themselves.
        start_every: a shot of a model that accumulates also begins at every n-th frame, to train on short histories.
        validation_frames: number of frames at the end of each sequence that are kept for validation (the paper's 4); 0
            for takes, and for a sequence with less than one clip left.
        lamps: probability that a clip gets lamps: rectangles of constant radiance, without noise, brighter than the
            rest.
        exposure: the light of a clip is scaled by up to this many stops.
        tint: each color channel of the light is scaled by up to this many stops.
        precision: bfloat16 runs convolutions in bfloat16.
        seed: seed of weights and clips.
    """

    model: str = DEFAULT
    settings: str = ""
    start_from: str = ""
    loss: Loss = "smape"
    steps: _Count = 10_000
    batch: _Count = 8
    frames: _Count = 8
    crop: _Count = 128
    learning_rate: Annotated[float, Meta(gt=0)] = 1e-4
    schedule: Schedule = "constant"
    temporal_weight: _Weight = 0.1
    display_weight: _Weight = 0.0
    key: _Weight = 0.0
    gradient_norm: _Weight = 0.0
    ema: Annotated[float, Meta(ge=0, lt=1)] = 0.0
    start_every: _Count = 4
    validation_frames: Annotated[int, Meta(ge=0)] = 4
    lamps: Annotated[float, Meta(ge=0, le=1)] = 0.0
    exposure: _Stops = 0.0
    tint: _Stops = 0.0
    precision: Precision = "float32"
    seed: Annotated[int, Meta(ge=0, lt=2**32)] = 0

    @property
    def model_settings(self) -> dict[str, Any]:
        """The arguments of the model's constructor.

        Raises:
            InputError: the settings have another form.
        """
        try:
            return parse_method(f"model({self.settings})").settings
        except InputError as error:
            raise InputError(
                f"settings: expected NAME=VALUE,... with each name once, found '{self.settings}'"
            ) from error

    def rate(self, step: int) -> float:
        """The learning rate of a step relative to the highest one."""
        return 1.0 if self.schedule == "constant" else cosine_rate(step, step / self.steps)


def cosine_rate(step: int, part: float, warm_up: int = _WARM_UP) -> float:
    """A linear start of some steps, and a cosine down to 0 over the whole run, of which a part is over."""
    return min(1.0, (step + 1) / warm_up) * 0.5 * (1 + math.cos(math.pi * min(1.0, part)))


def told(error: msgspec.ValidationError, kinds: Mapping[str, Any]) -> str:
    """The place of a wrong value, what was expected there and what was found, with the types of all keys."""
    what, _, place = str(error).replace("`", "").partition(" - at $.")
    key = place.rpartition(".")[2]
    if what.startswith("Invalid enum value ") and key in kinds:
        known = ", ".join(map(str, get_args(kinds[key])))
        what = what.replace("Invalid enum value", f"expected one of {known}, found")
    elif near := did_you_mean(what.rpartition(" ")[2], kinds) if "unknown field" in what else "":
        what = f"{what}; {near}"
    place = re.sub(r"^(\w+)\[(\d+)\]", lambda found: f"[[{found[1]}]] {int(found[2]) + 1}", place)
    return f"{f'{place}: ' if place else ''}{what[0].lower()}{what[1:]}"


def check_config(config: TrainConfig, checkpoint_every: int) -> None:
    """Check that every setting is valid.

    Raises:
        InputError: a setting is invalid; the message names it.
    """
    try:
        msgspec.convert(dataclasses.asdict(config), TrainConfig)
    except msgspec.ValidationError as error:
        name, _, what = told(error, get_type_hints(TrainConfig)).partition(": ")
        raise InputError(f"{name}: {what.partition(', found ')[0]}, found {getattr(config, name)}") from error
    # A lamp is two pixels wide, and needs more than one possible position.
    for name, low in {"frames": 2 if config.temporal_weight else 1, "crop": 3 if config.lamps else 1}.items():
        if getattr(config, name) < low:
            raise InputError(f"{name}: expected at least {low}, found {getattr(config, name)}")
    if checkpoint_every < 1:
        raise InputError(f"checkpoint_every: expected at least 1, found {checkpoint_every}")
    _ = config.model_settings
