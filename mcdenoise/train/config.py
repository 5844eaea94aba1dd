"""The configuration of a training run."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass
from typing import Any, Literal, get_args

from mcdenoise.errors import InputError
from mcdenoise.models import DEFAULT, Precision
from mcdenoise.train.losses import Loss

Schedule = Literal["constant", "cosine"]

_WARM_UP = 200


@dataclass(frozen=True)
class TrainConfig:
    """All settings that determine the result of a training run.

    The defaults are the paper's setting (Sec. 4.2): clips of 8 frames, 128x128 patches, batches of 8 clips, Adam with
    a learning rate of 1e-4, a temporal loss weight of 0.1.

    Args:
        model: a name in the zoo, or your own path/to/file.py:factory or package.module:factory.
        settings: arguments of the model's constructor, such as width=16,cascade=K+P.
        width: feature channels, the same as in the settings; 0 takes the model's default, or that of the initial
            weights.
        start_from: a model with weights, which the layers of the same names start with, such as cascaded_v2 or
            oidn_open(quality=fast); all by default start with random weights.
        losses: weights of the result and of intermediate stages in the loss, such as image=1,initial=0.5; by default 1
            for the result and for the stage initial, if the model has one.
        loss: loss of a clip, one of mcdenoise.train.losses.LOSSES: smape, the paper's; l1_display, that of Meng et
            al. 2020; rae, that of Chaitanya et al. 2017, whose later frames count more; or oidn, that of Open Image
            Denoise.
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
        draw_resolutions: in each step, draw how many of its resolutions a multi-resolution model uses. If all were used
            in every step, the low frequencies of a larger one would never be trained and drift, since those of the
            smaller one replace them.
        start_every: a shot of a model that accumulates also begins at every n-th frame, to train on short histories.
        keep_fireflies: every n-th noise seed keeps its fireflies as if they were caustics, see
            Accumulated; 0 for none.
        validation_frames: number of frames at the end of each sequence that are kept for validation (the paper's 4); 0
            for a sequence with less than one clip left.
        lamps: probability that a clip gets lamps: rectangles of constant radiance, without noise, brighter than the
            rest.
        exposure: the light of a clip is scaled by up to this many stops.
        tint: each color channel of the light is scaled by up to this many stops.
        gloss: probability that surfaces without albedo (mirrors, glass, lamps) are darkened by up to six stops.
        exact_features: train and validate on sequences with exact features only, see
            has_exact_features; the others are skipped.
        precision: bfloat16 runs convolutions in bfloat16.
        seed: seed of weights and clips.
    """

    model: str = DEFAULT
    settings: str = ""
    width: int = 0
    start_from: str = ""
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
    exact_features: bool = False
    precision: Precision = "float32"
    seed: int = 0

    @property
    def model_settings(self) -> dict[str, Any]:
        """The arguments of the model's constructor.

        Raises:
            InputError: the settings have another form.
        """
        return parse_settings("settings", self.settings) | ({"width": self.width} if self.width else {})

    @property
    def loss_weights(self) -> dict[str, float]:
        """The requested weights of the loss by stage.

        Raises:
            InputError: a weight is not a number.
        """
        found = parse_settings("losses", self.losses)
        for stage, weight in found.items():
            if isinstance(weight, bool) or not isinstance(weight, int | float):
                raise InputError(f"losses: expected weights such as image=1,initial=0.5, found {stage}={weight}")
        return found

    def rate(self, step: int) -> float:
        """The learning rate of a step relative to the highest one."""
        if self.schedule == "constant":
            return 1.0
        warm_up = min(1.0, (step + 1) / _WARM_UP)
        return warm_up * 0.5 * (1 + math.cos(math.pi * min(1.0, step / self.steps)))


def check_config(config: TrainConfig, checkpoint_every: int) -> None:
    """Check that every setting is valid.

    Raises:
        InputError: a setting is invalid; the message names it.
    """
    lowest = {
        "width": 0,
        "steps": 1,
        "batch": 1,
        "frames": 2 if config.temporal_weight else 1,
        # A lamp is two pixels wide, and needs more than one possible position.
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
    choices = {"loss": get_args(Loss), "schedule": get_args(Schedule), "precision": get_args(Precision)}
    for name, known in choices.items():
        if settings[name] not in known:
            raise InputError(f"{name}: expected one of {', '.join(known)}, found '{settings[name]}'")
    for name in ("exposure", "tint"):
        if not 0 <= settings[name] <= 14:
            raise InputError(f"{name}: expected 0 to 14 stops, found {settings[name]}")
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
    """Parse settings such as ``width=16,cascade=K+P,bilateral=false``: numbers, true, false, none, or strings.

    Args:
        name: name of the option, for the message.
        text: settings separated by commas; may be empty.

    Raises:
        InputError: a part is not a setting, or a setting is given twice.

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
