"""The training loop: a run can be stopped at any time and resumes as if it had not been interrupted."""

from __future__ import annotations

import dataclasses
import json
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from mcdenoise.commit import source_commit
from mcdenoise.data.files import atomic_path, held, writing
from mcdenoise.errors import InputError
from mcdenoise.methods import parse_method
from mcdenoise.models import Model, State, create_model, describe_weights, save_weights, start_with
from mcdenoise.models._defaults import plain_defaults
from mcdenoise.models._weights import find_weights
from mcdenoise.train.clips import Clip
from mcdenoise.train.config import TrainConfig, check_config
from mcdenoise.train.data import TrainingData
from mcdenoise.train.devices import open_fabric
from mcdenoise.train.front import split
from mcdenoise.train.losses import stage_loss
from mcdenoise.train.run_folder import Provenance, RunFolder, about_weights
from mcdenoise.train.unroll import Unrolled
from mcdenoise.train.validation import validate

if TYPE_CHECKING:
    from lightning_fabric import Fabric

_LOG_EVERY = 50


@dataclass(frozen=True)
class Progress:
    """Progress report of a training run.

    Args:
        step: number of finished optimiser steps.
        loss: mean training loss since the last report.
        gradient_norm: mean norm of the gradient since the last report, before clipping.
        learning_rate: learning rate of the last step.
        seconds: time since the run was started or resumed.
        validation: errors on the validation frames by name, if they were measured.
    """

    step: int
    loss: float
    gradient_norm: float
    learning_rate: float
    seconds: float
    validation: dict[str, float]


@plain_defaults()
def train(
    config: TrainConfig,
    sequences: list[Path],
    out: Path,
    *,
    validation: list[Path] | None = None,
    cache: Path | None = None,
    accelerator: str = "cpu",
    checkpoint_every: int = 500,
    credits: str = "",
    recipe: str = "",
    report: Callable[[Progress], None] = lambda progress: None,
) -> Path:
    """Train a model from the beginning, or resume an interrupted run of the same config in ``out``.

    A step unrolls the model over clips, with gradients through its state. The front of the model, such as its
    accumulation, is computed once into the cache, see :mod:`mcdenoise.train.front`.

    Every clip of every step has its own seed. So an interrupted and resumed run gives the same result as an
    uninterrupted one, and several processes (``torchrun``) the same as one, up to the rounding of sums. Processes on
    several machines need ``sequences``, ``out`` and ``cache`` on a shared disk.

    Args:
        config: configuration of the run.
        sequences: folders of sequences with references and features.
        out: folder of the run: ``config.json``, ``data.json``, ``log.jsonl``, TensorBoard events, ``checkpoint.pt``,
            and at the end ``MODEL.safetensors`` (for ``mine.py:factory``, ``factory.safetensors``).
        validation: folders of sequences that are used for validation only.
        cache: folder of the decoded sequences, which several runs may use; ``out/cache`` by default. It may be deleted
            after the run.
        accelerator: ``"cpu"`` or ``"cuda"``.
        checkpoint_every: number of steps between checkpoints and validations.
        credits: authors and licences of the training scenes, stored with the weights.
        recipe: checksum of the recipe of the run, stored with the weights.
        report: called with the progress every 50 steps, in the first process only.

    Returns:
        Path of the weights.

    Raises:
        InputError: there are no data or no references, ``out`` holds a run of another config, a file cannot be written,
            or an optional package is missing.
    """
    check_config(config, checkpoint_every)
    fabric = open_fabric(accelerator, config.precision, config.batch)
    torch.manual_seed(config.seed)
    network, settings, start = begun(config)
    front, rest = split(network)
    run, settled = RunFolder(out), dataclasses.asdict(config)
    run.check(config=settled)
    with fabric.rank_zero_first():
        data = TrainingData.load(config, front, rest.needs, sequences, validation or [], cache or out / "cache")
    identity = {"credits": credits, "initial_weights": start["sha256"], **data.description}
    identity |= {"recipe": recipe} if recipe else {}
    first_clip = data.sampler.draw([config.seed])
    network.eval()
    has_state = _tried(config.model, rest, first_clip, fabric)
    network.train()
    # Only now, so that invalid input does not leave files of a run.
    if fabric.is_global_zero:
        run.claim(config=settled, data=identity)
    fabric.barrier()

    trainer = Trainer(config, network, fabric, has_state=has_state)
    first, provenance = run.load(*trainer.parts)
    weights = out / f"{config.model.rpartition(':')[2]}.safetensors"
    if first == config.steps and weights.exists():
        return weights
    # The source tree may change between interruptions of the run.
    provenance.append({"first_step": first, "commit": source_commit()})
    with writing(out), held(out, "training") if fabric.is_global_zero else nullcontext():
        _run(trainer, data, run, first, provenance, checkpoint_every, report)
        if fabric.is_global_zero:
            about = about_weights(settled, identity, config.steps, provenance, start["data"])
            with atomic_path(weights) as temporary:
                temporary.write_bytes(save_weights(trainer.result, config.model, settings, about))
    fabric.barrier()
    return weights


def begun(config: TrainConfig) -> tuple[Any, dict[str, Any], dict[str, Any]]:
    """The model in training mode, its settings, and ``sha256`` and ``data`` of the weights that it begins with."""
    first = parse_method(config.start_from) if config.start_from else None
    weights = None if first is None else first.weights
    file = None if first is None else weights or find_weights(first.model)
    about = describe_weights(file) if file else {}
    try:
        start = {"sha256": about["sha256"] if weights else "none", "data": list(json.loads(about.get("data", "[]")))}
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"{file}: header 'data': expected a JSON array, found other text") from error
    settings: dict[str, Any] = {**(about["settings"] if weights else {}), **config.model_settings}
    # Typed as both model and module.
    model: Any = create_model(config.model, weights=weights, **settings)
    if not isinstance(model, nn.Module) or not any(weight.requires_grad for weight in model.parameters()):
        raise InputError(f"model '{config.model}': expected one that learns, found one without weights")
    network: Any = model.train()
    if first is not None and weights is None:
        start["sha256"] = start_with(network, first.model, **first.settings)
    return network, settings, start


def _tried(name: str, model: Model, clip: Clip, fabric: Fabric) -> bool:
    """Run the model on the first frames of a clip, so that errors show before the run begins: has it a state?"""
    state: State = None
    try:
        with fabric.autocast():
            for frame in map(clip.frame, range(min(2, len(clip)))):
                output, state = model(frame, state)
            images = {"image": output.image, **output.stages}
    except InputError:
        raise
    except Exception as error:
        reason = next(iter(str(error).splitlines()), "")
        found = f"{type(error).__name__}: {reason}"
        raise InputError(f"model '{name}': fails on a frame of {', '.join(sorted(frame.buffers))}: {found}") from error
    for stage, image in images.items():
        if image.shape != frame.color.shape:
            sizes = f"of {tuple(frame.color.shape)}, found {tuple(image.shape)}"
            raise InputError(f"model '{name}': expected the stage '{stage}' {sizes}")
    if not any(image.requires_grad for image in images.values()):
        raise InputError(
            f"model '{name}': expected an image with derivatives in its weights, found one without; look for .detach()"
        )
    return state is not None


class Trainer:
    """A model with its optimizer and scheduler.

    Args:
        config: configuration of the run.
        network: network in training mode, without the front, which the clips have passed.
        fabric: devices.
        has_state: whether the model has a state.
    """

    def __init__(self, config: TrainConfig, network: Any, fabric: Fabric, *, has_state: bool) -> None:
        self.config, self.fabric = config, fabric
        self.network = network.to(memory_format=torch.channels_last)
        self.optimizer = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
        self.scheduler = torch.optim.lr_scheduler.LambdaLR(self.optimizer, config.rate)
        self.model, self.stepper = fabric.setup(Unrolled(split(network)[1], has_state=has_state), self.optimizer)
        self.average = _moving_average(network, config.ema) if config.ema else None

    @property
    def parts(self) -> list[Any]:
        """The objects whose states a checkpoint holds."""
        parts = [self.network, self.optimizer, self.scheduler]
        return [*parts, self.average] if self.average is not None else parts

    @property
    def result(self) -> Any:
        """The model to validate and to save."""
        return self.network if self.average is None else self.average.module

    def seeds(self, step: int) -> list[int]:
        """Seeds of this process's clips in a step; those of all processes together are the same as for one process."""
        share = self.config.batch // self.fabric.world_size
        clips = range(self.fabric.global_rank * share, (self.fabric.global_rank + 1) * share)
        entropies = ([self.config.seed, step, clip] for clip in clips)
        return [int(np.random.SeedSequence(entropy).generate_state(1, np.uint64)[0]) for entropy in entropies]

    def step(self, step: int, clip: Clip) -> tuple[float, float]:
        """Train on this process's clips; return loss and gradient norm of the whole batch.

        Raises:
            InputError: one of them is not finite; the weights have not been changed.
        """
        # The seeds of clips differ between processes; this one is the same in all of them.
        torch.manual_seed(self.config.seed * 1_000_003 + step)
        clip = clip.to(self.fabric.device)
        output = self.model(clip.buffers)
        loss = stage_loss(
            output,
            clip["reference"],
            loss=self.config.loss,
            temporal_weight=self.config.temporal_weight,
            display_weight=self.config.display_weight,
        )
        self.stepper.zero_grad()
        self.fabric.backward(loss)
        norm = self.fabric.clip_gradients(
            self.model, self.stepper, max_norm=self.config.gradient_norm or math.inf, error_if_nonfinite=False
        )
        mean = torch.as_tensor(self.fabric.all_reduce(loss.detach(), reduce_op="mean"))
        found = {"loss": mean.item(), "gradient": torch.as_tensor(norm).item()}
        check_finite(step, found)
        self.stepper.step()
        self.scheduler.step()
        if self.average is not None:
            self.average.update_parameters(self.network)
        return found["loss"], found["gradient"]

    def validate(self, data: TrainingData, board: Any, step: int) -> dict[str, float]:
        """Errors of the result, see :func:`mcdenoise.train.validation.validate`."""
        result = self.result
        training = result.training
        result.eval()
        scores = validate(split(result)[1], data.watched, self.fabric, board, step)
        result.train(training)
        return scores


def check_finite(step: int, found: Mapping[str, float]) -> None:
    """Check what a step found.

    Raises:
        InputError: a number is not finite; the message has its name.
    """
    for name, value in found.items():
        if not math.isfinite(value):
            raise InputError(
                f"training, step {step}: expected a finite {name}, found {value}; the last checkpoint is kept: "
                "start a new run with a lower learning rate or a limit on the gradient's norm"
            )


def _moving_average(network: nn.Module, decay: float) -> AveragedModel:
    """A moving average of the weights; shorter in the first steps, so that initial weights are forgotten soon."""

    def blend(averages: Any, current: Any, count: Any) -> None:
        warm_up = (1 + int(count)) / (10 + int(count))
        get_ema_multi_avg_fn(min(decay, warm_up))(averages, current, count)

    return AveragedModel(network, multi_avg_fn=blend)


def _run(
    trainer: Trainer,
    data: TrainingData,
    run: RunFolder,
    first: int,
    provenance: Provenance,
    checkpoint_every: int,
    report: Callable[[Progress], None],
) -> None:
    """Run all steps from ``first`` on; only the first process writes files."""
    config, fabric = trainer.config, trainer.fabric
    with _board(run.out, first, fabric.is_global_zero) as board:
        if fabric.is_global_zero:
            run.rewind(first)
            run.log({**provenance[-1], "threads": torch.get_num_threads(), "processes": fabric.world_size})
        started = time.monotonic()
        history: list[tuple[float, float]] = []
        for step in range(first, config.steps):
            rate = config.learning_rate * config.rate(step)
            history.append(trainer.step(step, data.sampler.draw(trainer.seeds(step))))
            done = step + 1
            save = done % checkpoint_every == 0 or done == config.steps
            if not (save or done % _LOG_EVERY == 0):
                continue
            loss, norm = (float(mean) for mean in np.mean(history, axis=0))
            history.clear()
            if not fabric.is_global_zero:
                continue
            scores = trainer.validate(data, board, done) if save else {}
            progress = Progress(done, loss, norm, rate, time.monotonic() - started, scores)
            run.log(dataclasses.asdict(progress))
            for name in ("loss", "gradient_norm", "learning_rate"):
                board.add_scalar(f"train/{name}", getattr(progress, name), done)
            # Written last, so that the log never lacks a step that will not be repeated.
            if save:
                run.save(done, provenance, *trainer.parts)
            report(progress)


@contextmanager
def _board(out: Path, first: int, writes: bool) -> Iterator[Any]:
    """The TensorBoard writer in the first process, ``None`` in the others."""
    if not writes:
        yield None
        return
    from torch.utils.tensorboard import SummaryWriter  # imported here because it takes a second

    before = threading.excepthook

    def hook(failed: threading.ExceptHookArgs) -> None:
        # The next write raises the errors of TensorBoard's thread.
        if not issubclass(failed.exc_type, OSError):
            before(failed)

    threading.excepthook = hook
    try:
        with SummaryWriter(str(out), purge_step=first) as board:
            yield board
    finally:
        threading.excepthook = before
