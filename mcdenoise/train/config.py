"""What decides what a training run computes."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass
from typing import Any, Literal, get_args

from mcdenoise.errors import InputError
from mcdenoise.models import DEFAULT, FloatPrecision
from mcdenoise.train.losses import Loss

Schedule = Literal["constant", "cosine"]

_WARM_UP = 200


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides what a training run computes.

    The defaults are the paper's setting (Sec. 4.2): clips of 8 frames, 128x128 patches, batches of 8 clips, Adam with
    a learning rate of 1e-4, a temporal loss weight of 0.1.

    Args:
        model: a name of the zoo, or path/to/file.py:factory or package.module:factory of your own.
        settings: of the model's constructor, such as width=16,cascade=K+P.
        width: feature channels, as in the settings; 0 takes the model's own, or that of the weights it starts from.
        losses: weights of the result and of stages on the way to it in the loss, such as image=1,initial=0.5; 1 for the
            result and for the stage initial, where the model has one, by default.
        loss: of a clip, see :data:`mcdenoise.train.losses.LOSSES`: smape, the paper's; l1_display, that of Meng et al.
            2020; or rae, that of Chaitanya et al. 2017, whose later frames count more.
        steps: optimiser steps.
        batch: clips in a step, of all processes together.
        frames: frames in a clip.
        crop: side of the square patches, pixels.
        learning_rate: of Adam, at its highest.
        schedule: constant, or cosine down to 0 after a warm-up of 200 steps.
        temporal_weight: of the temporal loss.
        display_weight: of the error on a display, see :func:`mcdenoise.train.losses.display_error`.
        key: each clip is brought to this typical radiance, a middle gray such as 0.2, before its light is scaled; 0
            leaves it as it was rendered.
        gradient_norm: largest norm of a step's gradient; 0 does not limit it.
        ema: decay of an exponential moving average of the weights, such as 0.999, below it in the first steps; the
            average is what is validated and what the run ends with. 0 takes the weights themselves.
        draw_resolutions: a model of several resolutions has, in each step, from one to all of them. With all in every
            step, the low frequencies of a larger one are never learnt from, since those of the smaller one take their
            place, and drift.
        start_every: a shot of a model that accumulates also starts at every n-th frame, to train on short histories.
        keep_fireflies: every n-th realisation of the noise keeps its fireflies as if they were caustics, see
            :class:`mcdenoise.models.Accumulated`; 0 for none.
        validation_frames: the last frames of each sequence, kept for validation (the paper's 4); none of a sequence
            that would be left with less than one clip.
        lamps: chance that a clip gets lamps: rectangles of constant radiance, without noise, brighter than the rest.
        exposure: the light of a clip is scaled by up to so many stops.
        tint: each colour channel of the light is scaled by up to so many stops.
        gloss: chance that what has no albedo in a clip (mirrors, glass, lamps) is darker, by up to six stops.
        precision: bfloat16 runs convolutions in bfloat16.
        seed: of weights and clips.
    """

    model: str = DEFAULT
    settings: str = ""
    width: int = 0
    losses: str = ""
    loss: Loss = "smape"
    steps: int = 10_000
    batch: int = 8
    frames: int = 8
    crop: int = 128
    learning_rate: float = 1e-4
    schedule: Schedule = "constant"
    temporal_weight: float = 0.1
    display_weight: float = 0.0
    key: float = 0.0
    gradient_norm: float = 0.0
    ema: float = 0.0
    draw_resolutions: bool = True
    start_every: int = 4
    keep_fireflies: int = 0
    validation_frames: int = 4
    lamps: float = 0.0
    exposure: float = 0.0
    tint: float = 0.0
    gloss: float = 0.0
    precision: FloatPrecision = "float32"
    seed: int = 0

    @property
    def model_settings(self) -> dict[str, Any]:
        """What the model's constructor is given.

        Raises:
            InputError: the settings are something else.
        """
        return parse_settings("settings", self.settings) | ({"width": self.width} if self.width else {})

    @property
    def loss_weights(self) -> dict[str, float]:
        """The weights of the loss by stage, as far as they are asked for.

        Raises:
            InputError: one is no number.
        """
        found = parse_settings("losses", self.losses)
        for stage, weight in found.items():
            if isinstance(weight, bool) or not isinstance(weight, int | float):
                raise InputError(f"losses: expected weights such as image=1,initial=0.5, found {stage}={weight}")
        return found

    def rate(self, step: int) -> float:
        """The learning rate of a step, in parts of the highest."""
        if self.schedule == "constant":
            return 1.0
        warm_up = min(1.0, (step + 1) / _WARM_UP)
        return warm_up * 0.5 * (1 + math.cos(math.pi * min(1.0, step / self.steps)))


def check_config(config: TrainConfig, checkpoint_every: int) -> None:
    """See that every setting is one that can be trained with.

    Raises:
        InputError: one is not; names it.
    """
    lowest = {
        "width": 0,
        "steps": 1,
        "batch": 1,
        "frames": 2 if config.temporal_weight else 1,
        # A lamp is two pixels wide and has room to hang in more than one place.
        "crop": 3 if config.lamps else 1,
        "temporal_weight": 0,
        "display_weight": 0,
        "key": 0,
        "gradient_norm": 0,
        "start_every": 1,
        "keep_fireflies": 0,
        "validation_frames": 0,
        "checkpoint_every": 1,
    }
    settings = {**dataclasses.asdict(config), "checkpoint_every": checkpoint_every}
    for name, low in lowest.items():
        if not settings[name] >= low:
            raise InputError(f"{name}: expected at least {low}, found {settings[name]}")
    choices = {"loss": get_args(Loss), "schedule": get_args(Schedule), "precision": get_args(FloatPrecision)}
    for name, known in choices.items():
        if settings[name] not in known:
            raise InputError(f"{name}: expected one of {', '.join(known)}, found '{settings[name]}'")
    for name in ("exposure", "tint"):
        if not 0 <= settings[name] <= 10:
            raise InputError(f"{name}: expected 0 to 10 stops, found {settings[name]}")
    if not 0 <= config.seed < 2**32:
        raise InputError(f"seed: expected 0 to 2^32 - 1, found {config.seed}")
    if not config.learning_rate > 0:
        raise InputError(f"learning_rate: expected a positive number, found {config.learning_rate}")
    if not 0 <= config.ema < 1:
        raise InputError(f"ema: expected in [0, 1), found {config.ema}")
    for name in ("lamps", "gloss"):
        if not 0 <= settings[name] <= 1:
            raise InputError(f"{name}: expected in [0, 1], found {settings[name]}")
    _ = config.model_settings, config.loss_weights


def parse_settings(name: str, text: str) -> dict[str, Any]:
    """Read settings such as ``width=16,cascade=K+P,bilateral=false``: numbers, true, false, none, or else texts.

    Args:
        name: what they are, for the message.
        text: separated by commas; empty for none.

    Raises:
        InputError: a part is no setting, or one is there twice.

    Example:
        >>> parse_settings("settings", "width=16, cascade=K+P, alpha_min=0.2, bilateral=false")
        {'width': 16, 'cascade': 'K+P', 'alpha_min': 0.2, 'bilateral': False}
    """
    found: dict[str, Any] = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        key, equals, value = (each.strip() for each in part.partition("="))
        if not (key and equals) or key in found:
            raise InputError(f"{name}: expected NAME=VALUE,... with each name once, found '{text}'")
        try:
            found[key] = json.loads({"none": "null"}.get(value.lower(), value.lower()))
        except ValueError:
            found[key] = value
    return found
