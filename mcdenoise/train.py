"""Train a denoiser of the zoo on rendered sequences."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
from torch import Tensor, nn

from mcdenoise.data import open_sequence
from mcdenoise.data.clips import Clip, ClipSampler, accumulated_shots
from mcdenoise.data.files import atomic_path
from mcdenoise.data.sequences import Sequence
from mcdenoise.errors import InputError
from mcdenoise.losses import cascade_loss
from mcdenoise.metrics import displayed, psnr_srgb, smape_linear
from mcdenoise.models import create_model, describe_weights, save_weights
from mcdenoise.ops import remodulate
from mcdenoise.run_folder import RunFolder, source_commit

if TYPE_CHECKING:
    from lightning_fabric import Fabric

Precision = Literal["32-true", "bf16-mixed"]
Schedule = Literal["constant", "cosine"]


@dataclass(frozen=True)
class TrainConfig:
    """Everything that decides what a training run computes.

    The defaults are the paper's setting (Sec. 4.2): clips of 8 frames, 128x128 patches, batches of 8 clips, Adam with
    a learning rate of 1e-4, a temporal loss weight of 0.1.

    Args:
        model: name of the model in the zoo.
        width: feature channels; 0 takes the model's own, or that of the weights it starts from.
        steps: optimiser steps.
        batch: clips in a step.
        frames: frames in a clip.
        crop: side of the square patches, pixels.
        learning_rate: of Adam, at its highest.
        schedule: ``"constant"``, or ``"cosine"`` down to 0 after a warm-up of 200 steps.
        temporal_weight: of the temporal loss.
        gradient_norm: largest norm of a step's gradient; 0 does not limit it.
        alpha_min: of the accumulation, see :func:`mcdenoise.ops.accumulate`.
        start_every: a shot also starts at every n-th frame, to train on short histories.
        validation_frames: the last frames of each sequence, kept for validation (the paper's 4); none of a sequence
            that would be left with less than one clip.
        lamps: chance that a clip gets lamps, see :class:`mcdenoise.data.clips.ClipSampler`.
        precision: ``"bf16-mixed"`` runs convolutions in bfloat16.
        seed: of weights and clips.
    """

    model: str = "cascaded"
    width: int = 0
    steps: int = 10_000
    batch: int = 8
    frames: int = 8
    crop: int = 128
    learning_rate: float = 1e-4
    schedule: Schedule = "constant"
    temporal_weight: float = 0.1
    gradient_norm: float = 0.0
    alpha_min: float = 0.1
    start_every: int = 4
    validation_frames: int = 4
    lamps: float = 0.0
    precision: Precision = "32-true"
    seed: int = 0


@dataclass(frozen=True)
class Progress:
    """What a training run reports.

    Args:
        step: optimiser steps done.
        loss: mean training loss since the last report.
        seconds: time since the run was started or resumed.
        validation: error of the final image on the validation frames, by name, where it was measured.
    """

    step: int
    loss: float
    seconds: float
    validation: dict[str, float]


_LOG_EVERY = 50
_WARM_UP = 200


def train(
    config: TrainConfig,
    sequences: list[Path],
    out: Path,
    *,
    initial_weights: Path | None = None,
    accelerator: str = "cpu",
    checkpoint_every: int = 500,
    credits: str = "",
    report: Callable[[Progress], None] = lambda progress: None,
) -> Path:
    """Train a model, from the start or from where an earlier run of the same config in ``out`` stopped.

    Every step draws its clips from its own seed, so that a run that was interrupted and resumed computes the same as
    one that was not.

    Args:
        config: what to train.
        sequences: folders of sequences with references and features.
        out: folder of the run: ``config.json``, ``data.json``, ``log.jsonl``, TensorBoard events, ``checkpoint.pt``,
            and at the end ``MODEL.safetensors``.
        initial_weights: weights to start from instead of random ones, such as those of an earlier run.
        accelerator: ``"cpu"`` or ``"cuda"``.
        checkpoint_every: steps between checkpoints and validations.
        credits: authors and licences of the training scenes, stored with the weights.
        report: called with the progress every 50 steps.

    Returns:
        Path of the weights.

    Raises:
        InputError: no data, data without references, a run of another config in ``out``, or an optional dependency is
            missing.
    """
    if not sequences:
        raise InputError("training data: expected at least one sequence folder, found none; name one or more")
    _check(config, checkpoint_every)
    fabric = _fabric(accelerator, config.precision)
    opened = [open_sequence(path) for path in sequences]
    sampler, validation = _data(config, opened)

    torch.manual_seed(config.seed)
    start: dict[str, Any] = describe_weights(initial_weights) if initial_weights else {"settings": {}, "sha256": "none"}
    settings: dict[str, Any] = {**start["settings"], **({"width": config.width} if config.width else {})}
    network = create_model(config.model, weights=initial_weights, **settings).train()
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
    scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: _rate(config, step))
    model, fabric_optimizer = fabric.setup(network, optimizer)
    validation = [clip.to(fabric.device) for clip in validation]
    # Only now, so that input that cannot be trained on leaves no trace of a run.
    run = RunFolder(out)
    data = {
        "credits": credits,
        "initial_weights": start["sha256"],
        "sequences": [_describe(config, sequence) for sequence in opened],
    }
    run.claim(config=dataclasses.asdict(config), data=data)
    first, provenance = run.load(network, optimizer, scheduler)
    weights = out / f"{config.model}.safetensors"
    if first == config.steps and weights.exists():
        return weights
    # The source tree may change while the run goes on, and between its parts.
    provenance.append({"first_step": first, "commit": source_commit()})
    run.log({**provenance[-1], "threads": torch.get_num_threads()})

    from torch.utils.tensorboard import SummaryWriter  # here because importing it takes a second

    with SummaryWriter(str(out), purge_step=first) as board:
        started, losses = time.monotonic(), []
        for step in range(first, config.steps):
            torch.manual_seed(config.seed * 1_000_003 + step)
            loss = _loss(model, sampler.draw(config.batch).to(fabric.device), config.temporal_weight)
            losses.append(loss.item())
            if not math.isfinite(losses[-1]):
                raise InputError(
                    f"training, step {step}: expected a finite loss, found {losses[-1]}; the last checkpoint is kept: "
                    "start a new run with a lower learning rate or a limit on the gradient's norm"
                )
            fabric_optimizer.zero_grad()
            fabric.backward(loss)
            if config.gradient_norm:
                fabric.clip_gradients(model, fabric_optimizer, max_norm=config.gradient_norm)
            fabric_optimizer.step()
            scheduler.step()
            done = step + 1
            save = done % checkpoint_every == 0 or done == config.steps
            if save or done % _LOG_EVERY == 0:
                scores: dict[str, float] = {}
                if save:
                    run.save(done, provenance, network, optimizer, scheduler)
                    scores = _validate(model, validation, board, done)
                progress = Progress(done, sum(losses) / len(losses), time.monotonic() - started, scores)
                losses.clear()
                run.log(dataclasses.asdict(progress))
                board.add_scalar("train/loss", progress.loss, done)
                report(progress)
    about = {
        "config": json.dumps(dataclasses.asdict(config)),
        "data": json.dumps(data["sequences"]),
        "credits": credits,
        "initial_weights": start["sha256"],
        "steps": str(config.steps),
        "commits": json.dumps(provenance),
        "licence": "Apache-2.0",
    }
    with atomic_path(weights) as temporary:
        temporary.write_bytes(save_weights(network, config.model, settings, about))
    return weights


def _fabric(accelerator: str, precision: Precision) -> Fabric:
    try:
        from lightning_fabric import Fabric
    except ImportError as error:
        raise InputError(
            f"training: expected the optional packages of mcdenoise[train], found no '{error.name}'; "
            "install them with pip install 'mcdenoise[train]'"
        ) from error
    try:
        return Fabric(accelerator=accelerator, devices=1, precision=precision)
    except (RuntimeError, ValueError, ImportError) as error:
        raise InputError(f"accelerator '{accelerator}': expected one that works here, such as cpu or cuda") from error


def _check(config: TrainConfig, checkpoint_every: int) -> None:
    lowest = {
        "width": 0,
        "steps": 1,
        "batch": 1,
        "frames": 2 if config.temporal_weight else 1,
        "crop": 1,
        "temporal_weight": 0,
        "gradient_norm": 0,
        "start_every": 1,
        "validation_frames": 0,
        "checkpoint_every": 1,
    }
    settings = {**dataclasses.asdict(config), "checkpoint_every": checkpoint_every}
    for name, low in lowest.items():
        if not settings[name] >= low:
            raise InputError(f"{name}: expected at least {low}, found {settings[name]}")
    if not 0 <= config.seed < 2**32:
        raise InputError(f"seed: expected 0 to 2^32 - 1, found {config.seed}")
    if not config.learning_rate > 0:
        raise InputError(f"learning_rate: expected a positive number, found {config.learning_rate}")
    if not 0 <= config.lamps <= 1:
        raise InputError(f"lamps: expected in [0, 1], found {config.lamps}")
    if not 0 < config.alpha_min <= 1:
        raise InputError(f"alpha_min: expected in (0, 1], found {config.alpha_min}")


def _rate(config: TrainConfig, step: int) -> float:
    """The learning rate of a step, in parts of the highest."""
    if config.schedule == "constant":
        return 1.0
    warm_up = min(1.0, (step + 1) / _WARM_UP)
    return warm_up * 0.5 * (1 + math.cos(math.pi * min(1.0, step / config.steps)))


def _held_out(config: TrainConfig, sequence: Sequence) -> list[int]:
    """Numbers of the frames that are kept for validation: the last ones, none where too few would be left."""
    enough = len(sequence) >= config.frames + config.validation_frames
    return sequence.numbers[len(sequence) - config.validation_frames :] if enough else []


def _data(config: TrainConfig, sequences: list[Sequence]) -> tuple[ClipSampler, list[Clip]]:
    """The sampler of training clips, and for each sequence the clip of its validation frames."""
    shots: list[Tensor] = []
    validation: list[Clip] = []
    for sequence in sequences:
        held = len(_held_out(config, sequence))
        for i, shot in enumerate(accumulated_shots(sequence, config.alpha_min, config.start_every)):
            shots.append(shot[: max(0, len(shot) - held)])
            if i == 0 and held:
                validation.append(Clip.from_stack(shot[None, -held:]))
    return ClipSampler(shots, config.frames, config.crop, config.lamps), validation


def _describe(config: TrainConfig, sequence: Sequence) -> dict[str, Any]:
    """What a run says of a sequence: enough to tell whether another one has the same pixels."""
    digest = hashlib.sha256()
    for number in sequence.numbers:
        frame = sequence.frame(number)
        for image in (frame.color, frame.reference):
            if image is not None:
                digest.update(image.numpy().tobytes())
    return {
        "name": sequence.name,
        "frames": len(sequence),
        "size": f"{sequence.size[1]}x{sequence.size[0]}",
        "validation": _held_out(config, sequence),
        "sha256": digest.hexdigest(),
    }


def _denoise(model: nn.Module, clip: Clip) -> tuple[Tensor, Tensor]:
    """Initial and final image of every frame, with albedo, ``(B, T, 3, H, W)``."""
    batch = clip.color.shape[:2]
    inputs = (getattr(clip, name).flatten(0, 1) for name in ("color", "albedo", "normal", "depth"))
    initial, final = model(*inputs)
    albedo = clip.albedo.flatten(0, 1)
    return remodulate(initial, albedo).unflatten(0, batch), remodulate(final, albedo).unflatten(0, batch)


def _loss(model: nn.Module, clip: Clip, temporal_weight: float) -> Tensor:
    initial, final = _denoise(model, clip)
    return cascade_loss(initial, final, clip.reference, temporal_weight=temporal_weight)


@torch.no_grad()
def _validate(model: nn.Module, clips: list[Clip], board: Any, step: int) -> dict[str, float]:
    """Mean SMAPE and display PSNR on the validation clips; pictures of one frame of each for TensorBoard."""
    if not clips:
        return {}
    model.eval()
    errors, decibels = [], []
    for i, clip in enumerate(clips):
        _, final = _denoise(model, clip)
        noisy = remodulate(clip.color.flatten(0, 1), clip.albedo.flatten(0, 1)).unflatten(0, clip.color.shape[:2])
        errors.append(smape_linear(final, clip.reference).mean().item())
        decibels.append(psnr_srgb(final, clip.reference).mean().item())
        shown = [displayed(image[0, -1]) for image in (noisy, final, clip.reference)]
        board.add_image(f"validation/{i}", torch.cat(shown, -1), step)
    model.train()
    scores = {"smape": sum(errors) / len(errors), "psnr": sum(decibels) / len(decibels)}
    for name, score in scores.items():
        board.add_scalar(f"validation/{name}", score, step)
    return scores
