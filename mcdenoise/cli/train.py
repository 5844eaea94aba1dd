"""`mcdenoise train`."""

from __future__ import annotations

from pathlib import Path

import tyro
from rich.console import Console

from mcdenoise.cli._options import Out
from mcdenoise.heap import keep_heap
from mcdenoise.train import Progress, TrainConfig, is_first_process
from mcdenoise.train import train as run


def train(
    sequences: tyro.conf.Positional[list[Path]],
    out: Out,
    config: tyro.conf.OmitArgPrefixes[TrainConfig],
    validation: list[Path] = [],  # noqa: B006 - tyro reads it
    cache: Path | None = None,
    initial_weights: Path | None = None,
    accelerator: str = "cpu",
    checkpoint_every: int = 500,
    credits: str = "",
) -> None:
    """Train a model on sequences with references; the same command again resumes a run that was stopped.

    Args:
        sequences: folders of sequences with references, and with the buffers that the model is better with.
        out: folder of the run: checkpoint, log, TensorBoard events, and at the end the weights.
        config: what to train.
        validation: folders of sequences that are used for nothing but validation.
        cache: folder of the decoded sequences, which several runs may share; OUT/cache by default.
        initial_weights: safetensors file of weights to start from.
        accelerator: cpu or cuda; for several devices or machines start the command with torchrun.
        checkpoint_every: steps between checkpoints.
        credits: authors and licences of the training scenes, stored with the weights.
    """
    keep_heap()
    console = Console(stderr=True)

    def report(progress: Progress) -> None:
        scores = "".join(f"  validation {name} {value:.4f}" for name, value in progress.validation.items())
        line = f"step {progress.step}  loss {progress.loss:.4f}  {progress.seconds:.0f} s{scores}"
        console.print(line, soft_wrap=True)

    weights = run(
        config,
        sequences,
        out,
        validation=validation,
        cache=cache,
        initial_weights=initial_weights,
        accelerator=accelerator,
        checkpoint_every=checkpoint_every,
        credits=credits,
        report=report,
    )
    if is_first_process():
        print(weights)
