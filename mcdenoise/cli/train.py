"""`mcdenoise train`."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import get_type_hints

import tyro
from rich.console import Console

from mcdenoise.cli import load_command, parse
from mcdenoise.cli._options import Out
from mcdenoise.cli._output import say, warn
from mcdenoise.errors import InputError, naming
from mcdenoise.heap import keep_heap
from mcdenoise.train import Progress, Recipe, Rendering, Run, RunFolder, TrainConfig, is_first_process
from mcdenoise.train import train as run


def train(
    sequences: tyro.conf.Positional[list[Path]],
    out: Out,
    config: tyro.conf.OmitArgPrefixes[TrainConfig],
    recipe: Path | None = None,
    runs: list[str] = [],  # noqa: B006 - tyro reads it
    data: Path | None = None,
    validation: list[Path] = [],  # noqa: B006 - tyro reads it
    cache: Path | None = None,
    accelerator: str = "cpu",
    checkpoint_every: int = 500,
    credits: str = "",
) -> None:
    """Train a model on sequences with references; the same command again resumes a run that was stopped.

    Args:
        sequences: folders of sequences with references, and with the buffers that the model is better with.
        out: folder of the run: checkpoint, log, TensorBoard events, and at the end the weights.
        config: what to train.
        recipe: TOML file that says all this, and how the sequences are generated, which are rendered first.
        runs: names of the runs to train, of a recipe that has several; each has a folder of its name in the output. All
            by default.
        data: folder of the sequences that a recipe renders, which recipes may share; OUT/data by default.
        validation: folders of sequences that are used for nothing but validation.
        cache: folder of the decoded sequences, which several runs may share; OUT/cache by default.
        accelerator: cpu or cuda; for several devices or machines start the command with torchrun.
        checkpoint_every: steps between checkpoints.
        credits: authors and licences of the training scenes, stored with the weights.
    """
    keep_heap()
    console, todo = Console(stderr=True), [Run("", config, None, "")]
    if recipe is not None:
        changed = [each.name for each in dataclasses.fields(config) if getattr(config, each.name) != each.default]
        others: dict[str, object] = {"SEQUENCES": sequences, "--validation": validation, "--credits": credits}
        given = [name for name, value in others.items() if value]
        for name in [*given, *(f"--{name.replace('_', '-')}" for name in changed)]:
            raise InputError(f"{name}: expected none beside --recipe, which says what is trained, found one")
        followed = Recipe.read(recipe, options_of("generate"))
        todo, credits = followed.chosen(runs), followed.credits
        # Before anything is rendered for a run that the folder is not of.
        for each in todo:
            RunFolder(out / each.name).check(config=dataclasses.asdict(each.config))
        sequences, validation = make_data(followed, data or out / "data")
    else:
        for name, value in {"--data": data, "--runs": runs}.items():
            if value:
                raise InputError(f"{name}: expected a --recipe that says what it is, found none")

    def report(progress: Progress) -> None:
        scores = "".join(f"  validation {name} {value:.4f}" for name, value in progress.validation.items())
        line = f"step {progress.step}  loss {progress.loss:.4f}  {progress.seconds:.0f} s{scores}"
        console.print(line, soft_wrap=True)

    for one in todo:
        if one.name:
            console.print(f"{one.name}:", soft_wrap=True)
        weights = run(
            one.config,
            sequences,
            out / one.name,
            validation=validation,
            cache=cache or out / "cache",
            accelerator=accelerator,
            checkpoint_every=checkpoint_every,
            credits=credits,
            recipe=one.sha256,
            report=report,
        )
        if is_first_process():
            if recipe is not None:
                _print_errors(RunFolder(out / one.name).errors(), one.expected)
            say(weights)


def options_of(command: str) -> set[str]:
    """Names of a command's options but for its output, with those of the data classes among its arguments."""
    hints = get_type_hints(load_command(command))
    grouped = {name: kind for name, kind in hints.items() if dataclasses.is_dataclass(kind)}
    inner = {field.name for kind in grouped.values() for field in dataclasses.fields(kind)}
    return (inner | hints.keys()) - grouped.keys() - {"out", "return"}


def make_data(recipe: Recipe, data: Path) -> tuple[list[Path], list[Path]]:
    """Folders to train on and to validate on, rendered where they are not there yet.

    Args:
        recipe: says what is rendered.
        data: folder of the sequences of all recipes.

    Raises:
        InputError: they cannot be rendered.
    """
    # All are parsed before the first is rendered.
    ready = [(each, _generator(each, data)) for each in (*recipe.data, *recipe.validation)]
    made = [each.make(data, generate) for each, generate in ready]
    training, validation = made[: len(recipe.data)], made[len(recipe.data) :]
    return [path for each in training for path in each], [path for each in validation for path in each]


def _generator(rendering: Rendering, data: Path) -> Callable[[], None]:
    """`mcdenoise generate` with the options of a table, ready to be called."""
    arguments = ["--out", str(rendering.folder(data))]
    for key, value in rendering.options.items():
        name = key.replace("_", "-")
        if isinstance(value, bool):
            arguments.append(f"--{name}" if value else f"--no-{name}")
        else:
            arguments += [f"--{name}", *map(str, value if isinstance(value, list) else [value])]
    with naming(rendering.where):
        command = parse("generate", arguments)

    def generate() -> None:
        # Standard output is for the result of this command.
        with naming(rendering.where), contextlib.redirect_stdout(sys.stderr):
            if command():
                raise InputError("expected all scenes to be rendered, found some that failed; run the command again")

    return generate


def _print_errors(errors: Mapping[str, float], expected: tuple[float, float] | None) -> None:
    """Print the errors of the weights, and whether they are as the recipe expects."""
    scores = "".join(f"  {name} {value:.4f}" for name, value in errors.items())
    print(f"validation{scores or ': no frames to validate on'}")
    if expected is None:
        return
    found, (smape, tolerance) = errors.get("smape", math.nan), expected
    line = f"expected a smape of at most {smape:g} + {tolerance:g}, found {found:.4f}"
    if found <= smape + tolerance:
        print(f"{line}: met")
    else:
        warn(f"{line}: missed")
