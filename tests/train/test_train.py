"""Training: clips that keep physics intact, runs that learn, stop and go on, and data that is refused."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import os
import platform
import resource
import shutil
import signal
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from mcdenoise.data import open_sequence
from mcdenoise.data.exr import read_exr, write_exr
from mcdenoise.data.readers.bmfr import write_bmfr_frame
from mcdenoise.errors import InputError
from mcdenoise.metrics import smape_linear
from mcdenoise.models import DEFAULT, CoarseToFine, Demodulated, Restored, create_model, describe_weights, load_weights

pytest.importorskip("lightning_fabric", reason="training needs the packages of mcdenoise[train]")
pytest.importorskip("tensorboard", reason="training needs the packages of mcdenoise[train]")

from mcdenoise.train import Progress, RunFolder, TrainConfig, train
from mcdenoise.train.clips import Clip, ClipSampler
from mcdenoise.train.data import DataFolders, TrainingData
from mcdenoise.train.front import split

SMALL: dict[str, Any] = {"width": 4, "crop": 16, "frames": 2, "batch": 2, "steps": 6, "validation_frames": 1}
FIELDS = {field.name for field in dataclasses.fields(TrainConfig)}


@pytest.fixture(autouse=True, scope="module")
def _one_thread() -> Iterator[None]:
    """Networks this small are several times slower on several threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def finished(shared_sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run, which no test changes."""
    run = tmp_path_factory.mktemp("finished") / "deep" / "run"
    train(TrainConfig(**SMALL), [shared_sequence], run, checkpoint_every=2, credits="A. Painter, CC0")
    return run


@pytest.fixture
def again(finished: Path, shared_sequence: Path, tmp_path: Path) -> Callable[..., Path]:
    """Go on with a copy of the finished run, ``run``, with other settings, data or options."""
    run = tmp_path / "run"
    shutil.copytree(finished, run, ignore=shutil.ignore_patterns("cache", "events*"))

    def go_on(*sequences: Path, **changed: Any) -> Path:
        config = TrainConfig(**{**SMALL, **{key: changed.pop(key) for key in changed.keys() & FIELDS}})
        options = {"checkpoint_every": 2, "credits": "A. Painter, CC0", "cache": finished / "cache", **changed}
        return train(config, list(sequences) or [shared_sequence], run, **options)

    return go_on


@contextmanager
def full_disk(size: int) -> Iterator[None]:
    """The system refuses longer files, as it refuses to write to a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


class Stopped(Exception):
    """The power fails."""


def refused(action: Callable[[], object]) -> str:
    with pytest.raises(InputError) as error:
        action()
    assert "\n" not in str(error.value)
    return str(error.value)


def create_settings(**changed: Any) -> dict[str, Any]:
    """Every setting that the weights of the default model are of."""
    return {"width": 40, "kernel_width": None, "kernel_size": 5, "resolutions": 3, "half": False, **changed}


def data_of(config: TrainConfig, *folders: Path, validation: list[Path] | None = None, cache: Path) -> TrainingData:
    front, rest = split(create_model(config.model, **config.model_settings))
    return DataFolders.open(config, front, rest.needs, list(folders), validation or []).load(cache)


def state(run: Path) -> list[Tensor]:
    """Every number of a checkpoint: weights, and what the optimiser remembers."""

    def tensors(value: Any) -> list[Tensor]:
        if isinstance(value, dict):
            return [tensor for key in sorted(value, key=str) for tensor in tensors(value[key])]
        if isinstance(value, list):
            return [tensor for item in value for tensor in tensors(item)]
        return [torch.as_tensor(value)] if isinstance(value, Tensor | int | float) else []

    saved = torch.load(run / "checkpoint.pt", weights_only=True)
    return tensors([saved["step"], saved["parts"]])


# Runs


def test_one_clip_is_learnt_by_heart(shared_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    draw, clips, reports = ClipSampler.draw, [], []

    def draw_once(sampler: ClipSampler, seeds: list[int]) -> Clip:
        clips.append(clips[0] if clips else draw(sampler, seeds))
        return clips[-1]

    monkeypatch.setattr(ClipSampler, "draw", draw_once)
    config = TrainConfig(
        **{**SMALL, "width": 8, "frames": 3, "batch": 1, "steps": 30}, learning_rate=1e-2, draw_resolutions=False
    )
    train(config, [shared_sequence], tmp_path / "run", checkpoint_every=10, report=reports.append)
    assert [progress.step for progress in reports] == [10, 20, 30]
    assert reports[-1].loss < 0.8 * reports[0].loss
    assert set(reports[-1].validation) == {"smape", "psnr", "initial_smape", "initial_psnr"}


def test_a_run_that_was_stopped_goes_on_as_if_it_had_not_been(shared_sequence: Path, tmp_path: Path) -> None:
    config = TrainConfig(**SMALL, schedule="cosine", gradient_norm=1.0, ema=0.9, exposure=1.0)
    steps: list[int] = []

    def stop_at_3(progress: Progress) -> None:
        steps.append(progress.step)
        if progress.step == 3:
            raise Stopped

    whole, stopped, cache = tmp_path / "whole", tmp_path / "stopped", tmp_path / "cache"
    weights = train(config, [shared_sequence], whole, cache=cache, checkpoint_every=3)
    with pytest.raises(Stopped):
        train(config, [shared_sequence], stopped, cache=cache, checkpoint_every=3, report=stop_at_3)
    assert not (stopped / f"{DEFAULT}.safetensors").exists()
    torch.manual_seed(99)
    go_on: dict[str, Any] = {"cache": cache, "checkpoint_every": 3, "report": lambda p: steps.append(p.step)}
    resumed = train(config, [shared_sequence], stopped, **go_on)
    assert steps == [3, 6]
    expected, actual = state(whole), state(stopped)
    assert len(actual) == len(expected) > 100
    assert all(torch.equal(a, b) for a, b in zip(actual, expected, strict=True))
    digest = describe_weights(resumed)["sha256"]
    assert digest == describe_weights(weights)["sha256"]
    # A finished run is not run again.
    assert train(config, [shared_sequence], stopped, **go_on) == resumed
    assert (steps, describe_weights(resumed)["sha256"]) == ([3, 6], digest)


def test_files_of_a_finished_run(shared_sequence: Path, finished: Path) -> None:
    run, weights = finished, finished / f"{DEFAULT}.safetensors"
    names = {path.name for path in run.iterdir() if not path.name.startswith("events.")}
    assert names == {
        "cache",
        f"{DEFAULT}.safetensors",
        "checkpoint.pt",
        "config.json",
        "data.json",
        "log.jsonl",
    }
    assert any(path.name.startswith("events.out.tfevents") for path in run.iterdir())

    config = json.loads((run / "config.json").read_text())
    assert TrainConfig(**config) == TrainConfig(**SMALL)
    digest = hashlib.sha256()
    sequence = open_sequence(shared_sequence)
    for number in sequence.numbers:
        frame = sequence.frame(number)
        assert frame.reference is not None
        digest.update(frame.color.numpy().tobytes() + frame.reference.numpy().tobytes())
    data = json.loads((run / "data.json").read_text())
    entry = {"name": "plane", "frames": 4, "size": "24x20", "noise_seeds": 1, "validation": [3]}
    entry["sha256"] = digest.hexdigest()
    assert data == {"credits": "A. Painter, CC0", "initial_weights": "none", "sequences": [entry]}
    start, *log = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    assert start["first_step"] == 0
    assert set(start) == {"first_step", "commit", "threads", "processes"}
    assert [entry["step"] for entry in log] == [2, 4, 6]
    names = {"step", "loss", "gradient_norm", "learning_rate", "seconds", "validation"}
    assert all(set(entry) == names for entry in log)
    assert all(entry["gradient_norm"] > 0 and entry["learning_rate"] == 1e-4 for entry in log)

    about = describe_weights(weights)
    assert (about["architecture"], about["settings"], about["steps"]) == (DEFAULT, create_settings(width=4), "6")
    assert (about["licence"], about["credits"]) == ("Apache-2.0", "A. Painter, CC0")
    assert json.loads(about["config"]) == config
    assert json.loads(about["data"]) == data["sequences"]
    assert json.loads(about["commits"]) == [{"first_step": 0, "commit": start["commit"]}]
    saved = torch.load(run / "checkpoint.pt", weights_only=True)["parts"][0]
    for key, tensor in load_weights(weights, DEFAULT).state_dict().items():
        assert torch.equal(tensor, saved[key].half().float())


def test_bfloat16_learns_float32_weights(shared_sequence: Path, tmp_path: Path) -> None:
    train(TrainConfig(**{**SMALL, "steps": 2}, precision="bfloat16"), [shared_sequence], tmp_path / "run")
    saved = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)["parts"][0]
    assert {tensor.dtype for tensor in saved.values()} == {torch.float32}
    assert all(torch.isfinite(tensor).all() for tensor in saved.values())


def test_a_step_has_as_many_resolutions_as_are_drawn(
    shared_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[bool, int]] = []
    forward = CoarseToFine.forward

    def spy(self: CoarseToFine, *arguments: Any, **named: Any) -> Any:
        seen.append((self.training, self.resolutions))
        return forward(self, *arguments, **named)

    monkeypatch.setattr(CoarseToFine, "forward", spy)
    settings, cache = {**SMALL, "steps": 12}, tmp_path / "cache"
    train(TrainConfig(**settings), [shared_sequence], tmp_path / "drawn", cache=cache)
    drawn = [resolutions for training, resolutions in seen if training]
    assert set(drawn) == {1, 2, 3}
    assert {resolutions for training, resolutions in seen if not training} == {3}
    # The same again: a run goes on as if it had not been stopped.
    seen.clear()
    train(TrainConfig(**{**settings, "steps": 3}), [shared_sequence], tmp_path / "again", cache=cache)
    again = [resolutions for training, resolutions in seen if training]
    assert again == drawn[: len(again)]
    seen.clear()
    every = TrainConfig(**{**settings, "steps": 2}, draw_resolutions=False)
    train(every, [shared_sequence], tmp_path / "all", cache=cache)
    assert {resolutions for _, resolutions in seen} == {3}


def test_frames_held_back_are_not_trained_on(shared_sequence: Path, tmp_path: Path) -> None:
    def lengths(**changes: Any) -> tuple[list[int], list[int]]:
        config = TrainConfig(**{**SMALL, **changes})
        data = data_of(config, shared_sequence, cache=tmp_path / "cache")
        return [len(shot) for shot in data.sampler.shots], [len(shot) for _, shot in data.watched]

    # Shots of 4, 3, 2 and 1 frames, each without the last frames; none too short for a clip is kept.
    assert lengths(start_every=1, validation_frames=1) == ([3, 2], [1])
    assert lengths(start_every=1, validation_frames=2) == ([2], [2])
    assert lengths(start_every=2, validation_frames=0) == ([4, 2], [])
    # Too few frames to hold any back.
    assert lengths(frames=3, validation_frames=2) == ([4], [])


def test_every_noise_seed_of_the_noise_is_trained_on(small_sequence: Path, tmp_path: Path) -> None:
    inputs = small_sequence / "inputs"
    (inputs / "noise_seed1").mkdir()
    for number in range(4):
        shutil.copyfile(inputs / f"color{3 - number}.exr", inputs / "noise_seed1" / f"color{number}.exr")
    config = TrainConfig(**SMALL)
    data = data_of(config, small_sequence, validation=[small_sequence], cache=tmp_path / "cache")
    assert [len(shot.colors) for shot in data.sampler.shots] == [2]
    assert data.description["sequences"][0]["noise_seeds"] == 2
    # Validation is always on the first.
    assert "noise_seeds" not in data.description["validation_sequences"][0]
    assert len(data.watched[1][1].colors) == 1


def test_the_log_of_a_stopped_run_has_every_step_once(shared_sequence: Path, tmp_path: Path) -> None:
    config, log = TrainConfig(**SMALL), tmp_path / "run" / "log.jsonl"

    def stop_at_4(progress: Progress) -> None:
        if progress.step == 4:
            with log.open("a") as file:
                file.write('{"step": 5, "lo')
            raise Stopped

    with pytest.raises(Stopped):
        train(config, [shared_sequence], tmp_path / "run", checkpoint_every=2, report=stop_at_4)
    # The run is left as if the last checkpoint had been that of step 2.
    saved = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)
    saved["step"] = 2
    content = io.BytesIO()
    torch.save(saved, content)
    sealed = content.getvalue() + hashlib.sha256(content.getvalue()).digest()
    (tmp_path / "run" / "checkpoint.pt").write_bytes(sealed)
    train(config, [shared_sequence], tmp_path / "run", checkpoint_every=2)
    entries = [json.loads(line) for line in log.read_text().splitlines()]
    assert [entry.get("step", entry.get("first_step")) for entry in entries] == [0, 2, 2, 4, 6]


def test_sequences_that_are_only_watched(small_sequence: Path, tmp_path: Path) -> None:
    """They change what is reported and nothing that is learnt."""
    other = tmp_path / "other"
    shutil.copytree(small_sequence, other)
    config = TrainConfig(**{**SMALL, "steps": 2, "validation_frames": 0})
    reports: list[Progress] = []
    plain = train(config, [small_sequence], tmp_path / "plain", report=reports.append)
    watched = train(config, [small_sequence], tmp_path / "watched", validation=[other], report=reports.append)
    assert [bool(progress.validation) for progress in reports] == [False, True]
    assert describe_weights(watched)["sha256"] == describe_weights(plain)["sha256"]
    data = json.loads((tmp_path / "watched" / "data.json").read_text())
    assert [entry["name"] for entry in data["sequences"]] == ["plane"]
    assert [entry["name"] for entry in data["validation_sequences"]] == ["other"]
    # All frames of the sequence, as they are denoised when nothing is skipped, and no detail is given back.
    whole, history, errors = load_weights(watched, DEFAULT), None, []
    assert isinstance(whole, Restored)
    model = whole.inner
    assert isinstance(model, Demodulated)
    model.inner.inner = model.inner.inner.inner
    sequence = open_sequence(other)
    for number in sequence.numbers:
        frame = sequence.frame(number).validate()[0]
        with torch.no_grad():
            output, history = model(frame, history)
        errors.append(smape_linear(output.image, frame.reference).item())
    # The weights on disk are half precision.
    assert reports[1].validation["smape"] == pytest.approx(sum(errors) / 4, abs=1e-3)


def test_averaged_weights_are_what_is_validated_and_kept(shared_sequence: Path, tmp_path: Path) -> None:
    config = TrainConfig(**{**SMALL, "ema": 0.5, "learning_rate": 1e-2, "steps": 3})
    trajectory: list[dict[str, Tensor]] = []

    def remember(progress: Progress) -> None:
        saved = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)["parts"][0]
        trajectory.append({key: tensor.clone() for key, tensor in saved.items()})

    weights = train(config, [shared_sequence], tmp_path / "run", checkpoint_every=1, report=remember)
    final = load_weights(weights).state_dict()
    for key, tensor in trajectory[0].items():
        expected = tensor
        # The decay of the first steps: 2/11, 3/12, ... up to the limit.
        for count, later in enumerate(trajectory[1:], 1):
            expected = expected.lerp(later[key], 1 - min(0.5, (1 + count) / (10 + count)))
        torch.testing.assert_close(final[key], expected.half().float(), rtol=1e-3, atol=1e-6)
    assert any(not torch.equal(final[key], trajectory[-1][key].half().float()) for key in final)


def mcdenoise(*arguments: object, processes: int = 1) -> list[str]:
    """The command line, as one or several processes of their own."""
    launcher = ["torch.distributed.run", "--standalone", "--nproc-per-node", str(processes), "-m"]
    launch = launcher if processes > 1 else []
    return [sys.executable, "-m", *launch, "mcdenoise", *map(str, arguments)]


def options(config: TrainConfig) -> list[str]:
    found = []
    for field, value in dataclasses.asdict(config).items():
        name = field.replace("_", "-")
        found += [f"--{'' if value else 'no-'}{name}"] if isinstance(value, bool) else [f"--{name}", str(value)]
    return found


ONE_THREAD = {**os.environ, "OMP_NUM_THREADS": "1"}


def test_a_run_killed_while_it_saves_goes_on_from_the_checkpoint_before(
    again: Callable[..., Path], finished: Path, shared_sequence: Path, tmp_path: Path
) -> None:
    code = """
        import os, signal, sys
        from mcdenoise.cli import main
        from mcdenoise.data import files
        replace, saved = os.replace, []
        def killed(source, target):
            saved.append(os.path.basename(target))
            if saved.count("checkpoint.pt") == 2:
                os.kill(os.getpid(), signal.SIGKILL)
            replace(source, target)
        files.os.replace = killed
        main(["train", *sys.argv[1:]])
    """
    run = tmp_path / "run"
    for path in run.iterdir():
        path.unlink()
    place = [shared_sequence, "-o", run, "--cache", finished / "cache"]
    command = [sys.executable, "-c", textwrap.dedent(code), *place]
    command += ["--checkpoint-every", "2", "--credits", "A. Painter, CC0", *options(TrainConfig(**SMALL))]
    assert subprocess.run(list(map(str, command)), env=ONE_THREAD, check=False).returncode == -signal.SIGKILL
    assert not (run / f"{DEFAULT}.safetensors").exists()
    assert torch.load(run / "checkpoint.pt", weights_only=True)["step"] == 2
    (left,) = run.glob(".mcdenoise*")
    os.utime(left, (0, 0))
    weights = again()
    assert describe_weights(weights)["sha256"] == describe_weights(finished / weights.name)["sha256"]
    assert not left.exists()


@pytest.mark.slow
def test_two_processes_learn_what_one_does(shared_sequence: Path, tmp_path: Path) -> None:
    settings = {**SMALL, "batch": 4, "steps": 4, "ema": 0.9, "losses": "image=1,initial=0.5"}
    config = TrainConfig(**settings, gradient_norm=0.5, lamps=0.5, exposure=1.0)
    weights = []
    # Both with one thread a process: with more, sums are taken in another order again.
    for run, processes in ((tmp_path / "one", 1), (tmp_path / "two", 2)):
        options_of_run = ("-o", run, "--checkpoint-every", 1, *options(config))
        command = mcdenoise("train", shared_sequence, *options_of_run, processes=processes)
        result = subprocess.run(command, env=ONE_THREAD, capture_output=True, text=True, check=False)
        assert result.returncode == 0, result.stderr
        assert result.stdout.split() == [str(run / f"{DEFAULT}.safetensors")]
        weights.append(load_file(run / f"{DEFAULT}.safetensors"))
    one, two = weights
    # Adam divides each number of a gradient by its own size, so that one which is zero but for the order of its terms
    # may move a weight the other way: by at most a learning rate a step, and there are few of these.
    furthest, beyond = 2 * config.steps * config.learning_rate, 0
    for key, tensor in one.items():
        difference = (two[key].float() - tensor.float()).abs()
        # Weights are stored in half precision.
        rounding = 2e-6 + torch.finfo(torch.float16).eps * tensor.float().abs()
        assert (difference <= furthest + rounding).all()
        beyond += int((difference > rounding).sum())
    assert beyond < 0.01 * sum(tensor.numel() for tensor in one.values())
    logs = [(tmp_path / name / "log.jsonl").read_text().splitlines() for name in ("one", "two")]
    (start, *one_log), (two_start, *two_log) = ([json.loads(line) for line in log] for log in logs)
    assert (start["processes"], two_start["processes"]) == (1, 2)
    assert len(two_log) == len(one_log) == 4
    # From the second step on they drift apart: Adam divides each number of a gradient by its own size, so that one
    # which is zero but for the order of its terms moves a weight as far as any other.
    for name in ("loss", "gradient_norm"):
        assert two_log[0][name] == pytest.approx(one_log[0][name], rel=1e-6)
    assert two_log[-1]["loss"] == pytest.approx(one_log[-1]["loss"], rel=1e-5)
    assert len(list((tmp_path / "two").glob("events.*"))) == 1


# Refusals


def test_another_config_or_other_data_need_another_folder(
    again: Callable[..., Path], shared_sequence: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    # One with another cache, too, which must not be filled for nothing.
    message = refused(lambda: again(steps=2, settings="alpha_min=0.5", cache=tmp_path / "cache"))
    assert (
        f"{run / 'config.json'}: expected settings='alpha_min=0.5', steps=2 as in this run, found settings=''"
        in message
    )
    assert not (tmp_path / "cache").exists()
    assert f"{run / 'data.json'}: expected sequences=" in refused(lambda: again(shared_sequence, shared_sequence))
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before


@pytest.mark.skipif(sys.platform == "darwin", reason="has no file names but UTF-8")
def test_a_folder_whose_name_is_not_utf_8_is_refused_before_the_work(shared_sequence: Path, tmp_path: Path) -> None:
    run = tmp_path / "M\udcfcller"
    assert "whose name is UTF-8" in refused(lambda: train(TrainConfig(**SMALL), [shared_sequence], run))
    assert not run.exists()


@pytest.mark.parametrize("content", [b"", b"no checkpoint", b"\x80\x02}q\x00.", None])
def test_a_damaged_checkpoint_is_refused(again: Callable[..., Path], tmp_path: Path, content: bytes | None) -> None:
    checkpoint = tmp_path / "run" / "checkpoint.pt"
    checkpoint.write_bytes(checkpoint.read_bytes()[:-500] if content is None else content)
    message = refused(again)
    assert message.startswith(f"{checkpoint}: expected a checkpoint of this run")
    assert "remove it" in message


def test_no_flipped_bit_of_a_checkpoint_is_trained_on(finished: Path, tmp_path: Path) -> None:
    content = (finished / "checkpoint.pt").read_bytes()
    folder, parts = RunFolder(tmp_path), [torch.nn.Linear(1, 1)]
    for bit in np.random.default_rng(0).integers(8 * len(content), size=50):
        damaged = bytearray(content)
        damaged[bit // 8] ^= 1 << bit % 8
        (tmp_path / "checkpoint.pt").write_bytes(damaged)
        assert "found one that is damaged" in refused(lambda: folder.load(*parts))


def test_two_trainings_do_not_share_a_folder(shared_sequence: Path, tmp_path: Path) -> None:
    config, run, messages = TrainConfig(**{**SMALL, "steps": 2}), tmp_path / "run", []

    def again(progress: Progress) -> None:
        if not messages:
            log = (run / "log.jsonl").read_bytes()
            messages.append(refused(lambda: train(config, [shared_sequence], run, checkpoint_every=1)))
            assert (run / "log.jsonl").read_bytes() == log

    train(config, [shared_sequence], run, checkpoint_every=1, report=again)
    assert messages == [
        f"{run}: expected a folder that no other training writes to, found process {os.getpid()} of "
        f"{platform.node()} at work in it; wait for it, or choose another folder"
    ]
    # It is free again.
    (run / f"{DEFAULT}.safetensors").unlink()
    train(config, [shared_sequence], run, checkpoint_every=1)


@pytest.mark.parametrize("changed", [{"model": "cascaded_v2_tiny"}, {"ema": 0.5}], ids=["model", "average"])
def test_a_checkpoint_of_another_architecture_is_refused(
    again: Callable[..., Path], shared_sequence: Path, finished: Path, tmp_path: Path, changed: dict[str, Any]
) -> None:
    other = TrainConfig(**{**SMALL, "steps": 1, **changed})
    train(other, [shared_sequence], tmp_path / "other", cache=finished / "cache")
    shutil.copyfile(tmp_path / "other" / "checkpoint.pt", tmp_path / "run" / "checkpoint.pt")
    assert refused(again).startswith(f"{tmp_path / 'run' / 'checkpoint.pt'}: expected a checkpoint of this run")


def test_a_full_disk_keeps_the_checkpoint_before(again: Callable[..., Path], finished: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    for path in run.iterdir():
        path.unlink()
    with ExitStack() as stack:
        message = refused(lambda: again(report=lambda progress: stack.enter_context(full_disk(50_000))))
    assert message.startswith(f"{run / 'checkpoint.pt'}: cannot be written (File too large)")
    assert torch.load(run / "checkpoint.pt", weights_only=True)["step"] == 2
    assert not list(run.glob(".mcdenoise*"))
    weights = again()
    assert describe_weights(weights)["sha256"] == describe_weights(finished / weights.name)["sha256"]


def test_a_gradient_that_is_not_finite_is_not_learnt_from(
    shared_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.nn.utils.clip_grad_norm_", lambda *args, **kwargs: torch.tensor(torch.inf))
    message = refused(lambda: train(TrainConfig(**SMALL), [shared_sequence], tmp_path / "run"))
    assert "training, step 0: expected a finite gradient, found inf" in message


@pytest.mark.parametrize("stem", ["color", "reference"])
@pytest.mark.parametrize("value", [3e38, 9e15, np.nan])
def test_an_absurdly_bright_pixel_does_not_stop_a_run(
    small_sequence: Path, tmp_path: Path, value: float, stem: str
) -> None:
    """One of each 3x3 pixels, so that every clip has some, at the brightest exposure."""
    for path in (small_sequence / "inputs").glob(f"{stem}[0-9].exr"):
        image, channels, _ = read_exr(path)
        image[::3, ::3] = value
        write_exr(path, image, channels, full_float=True)
    config = TrainConfig(**{**SMALL, "steps": 3}, exposure=10.0, tint=10.0)
    weights = train(config, [small_sequence], tmp_path / "run")
    assert all(tensor.isfinite().all() for tensor in load_file(weights).values())


def test_a_batch_that_the_processes_cannot_divide_is_refused(
    shared_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    launched = {"TORCHELASTIC_RUN_ID": "none", "WORLD_SIZE": "6", "LOCAL_WORLD_SIZE": "3"}
    for name, value in launched.items():
        monkeypatch.setenv(name, value)
    message = refused(lambda: train(TrainConfig(**SMALL), [shared_sequence], tmp_path / "run"))
    assert "batch: expected a multiple of the 6 processes, found 2" in message


def test_no_sequences(tmp_path: Path) -> None:
    assert "expected at least one sequence folder" in refused(lambda: train(TrainConfig(), [], tmp_path / "run"))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("stem", "expected"),
    [
        ("reference", "expected a reference for every frame to train on, found none for frame 0"),
        ("reference2", "expected a reference for every frame to train on, found none for frame 2"),
        ("albedo", "expected albedo, normal, depth to train this model on, found no albedo"),
        ("shading_normal", "expected albedo, normal, depth to train this model on, found no normal"),
        ("*2", "expected frame 2 after frame 1, found 3"),
        ("albedo2", "expected buffer 'albedo' for every frame, found it for some"),
    ],
)
def test_data_that_cannot_be_trained_on_leaves_no_run(
    small_sequence: Path, tmp_path: Path, stem: str, expected: str
) -> None:
    broken = tmp_path / "broken"
    shutil.copytree(small_sequence, broken)
    for path in (broken / "inputs").glob(f"{stem}*.exr"):
        path.unlink()
    config = TrainConfig(**SMALL)
    assert expected in refused(lambda: train(config, [small_sequence, broken], tmp_path / "run"))
    assert expected in refused(lambda: train(config, [small_sequence], tmp_path / "run", validation=[broken]))
    assert not (tmp_path / "run").exists()


def test_frames_of_several_sizes_are_refused_and_sequences_of_several_sizes_are_not(
    small_sequence: Path, tmp_path: Path
) -> None:
    other = tmp_path / "other"
    shutil.copytree(small_sequence, other)
    for path in (other / "inputs").glob("*.exr"):
        image, channels, _ = read_exr(path)
        if path.stem.endswith("3"):
            write_exr(path, image[:17, :18], channels)
    config = TrainConfig(**{**SMALL, "steps": 1})
    message = refused(lambda: train(config, [small_sequence, other], tmp_path / "run"))
    assert "expected 24 x 20 pixels like the first color file, found 18 x 17" in message
    assert not (tmp_path / "run").exists()
    for path in (other / "inputs").glob("*.exr"):
        image, channels, _ = read_exr(path)
        write_exr(path, image[:17, :18], channels, full_float="position" in path.stem)
    assert train(config, [small_sequence, other], tmp_path / "run").exists()
    message = refused(lambda: train(TrainConfig(**{**SMALL, "crop": 19}), [small_sequence, other], tmp_path / "large"))
    assert "expected images of at least 19 pixels, found (17, 18)" in message


def test_a_frame_that_is_damaged_leaves_no_run(small_sequence: Path, tmp_path: Path) -> None:
    image, channels, _ = read_exr(small_sequence / "inputs" / "shading_normal1.exr")
    write_exr(small_sequence / "inputs" / "shading_normal1.exr", image * float("nan"), channels)
    run = tmp_path / "run"
    message = refused(lambda: train(TrainConfig(**SMALL), [small_sequence], run))
    assert f"{small_sequence}, frame 1: buffer 'normal': expected finite values" in message
    assert [path.name for path in run.iterdir()] == ["cache"]


BAD: dict[str, tuple[Any, ...]] = {
    "model": ("no_such", "noisy.py:factory", "mcdenoise.ops:demodulate"),
    "settings": ("alpha_min=0", "depth=3", "width"),
    "losses": ("image=1,image=2", "image=much"),
    "crop": (64, 0),
    "frames": (9, 1),
    "width": (-1,),
    "steps": (0,),
    "batch": (0,),
    "start_every": (0,),
    "keep_fireflies": (-1,),
    "validation_frames": (-1,),
    "temporal_weight": (float("nan"),),
    "seed": (2**64,),
    "learning_rate": (0.0,),
    "schedule": ("linear",),
    "loss": ("l2",),
    "precision": ("fp8",),
    "ema": (1.0,),
    "exposure": (-1.0,),
    "tint": (float("nan"),),
    "gloss": (1.5,),
}


@pytest.mark.parametrize(("setting", "value"), [(name, value) for name, values in BAD.items() for value in values])
def test_settings_that_cannot_be_leave_no_run(shared_sequence: Path, tmp_path: Path, setting: str, value: Any) -> None:
    message = refused(lambda: train(TrainConfig(**{**SMALL, setting: value}), [shared_sequence], tmp_path / "run"))
    # What is wrong is named, with the value.
    assert str(value).partition("=")[0].partition(":")[0] in message
    assert not (tmp_path / "run").exists()


def test_only_exact_features(small_sequence: Path, tmp_path: Path) -> None:
    """Normals of several points are shorter than one."""
    sequence = open_sequence(small_sequence)
    for number in sequence.numbers:
        frame = sequence.frame(number)
        assert frame.normal is not None
        write_bmfr_frame(tmp_path / "mixed" / "inputs", number, frame.replace(normal=0.8 * frame.normal))
    cameras = Path("inputs", "camera_matrices.h")
    shutil.copy(small_sequence / cameras, tmp_path / "mixed" / cameras)
    folders = [tmp_path / "mixed", small_sequence]
    config = TrainConfig(**SMALL, exact_features=True)
    data = data_of(config, *folders, validation=folders, cache=tmp_path / "cache")
    assert [each["name"] for each in data.description["sequences"]] == ["plane"]
    assert [each["name"] for each in data.description["validation_sequences"]] == ["plane"]
    message = refused(lambda: data_of(config, folders[0], cache=tmp_path / "cache"))
    assert "exact_features: expected a sequence with features without noise to train on, found none among 1" in message


def test_a_folder_or_an_accelerator_that_cannot_be(shared_sequence: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    config = TrainConfig(**SMALL)
    message = refused(lambda: train(config, [shared_sequence], tmp_path / "file" / "run"))
    assert f"{tmp_path / 'file' / 'run' / 'cache'}" in message
    message = refused(lambda: train(config, [shared_sequence], tmp_path / "file" / "run", cache=tmp_path / "cache"))
    assert "expected a folder to write the run to" in message
    for accelerator in ("abacus", "tpu"):
        message = refused(lambda a=accelerator: train(config, [shared_sequence], tmp_path / "run", accelerator=a))
        assert f"accelerator '{accelerator}': expected one that works here" in message
    message = refused(lambda: train(config, [shared_sequence], tmp_path / "run", checkpoint_every=0))
    assert "checkpoint_every: expected at least 1, found 0" in message
    assert not (tmp_path / "run").exists()


def test_a_run_can_start_from_weights(shared_sequence: Path, finished: Path, tmp_path: Path) -> None:
    """Without a width, the result is of that of the weights, and says so, so that it can be loaded."""
    first = finished / f"{DEFAULT}.safetensors"
    config = TrainConfig(**{**SMALL, "steps": 1, "width": 0}, learning_rate=1e-12)
    second = train(config, [shared_sequence], tmp_path / "run", cache=finished / "cache", initial_weights=first)
    before, after = (load_weights(path).state_dict() for path in (first, second))
    for key, tensor in before.items():
        torch.testing.assert_close(after[key], tensor, rtol=1e-3, atol=1e-6)
    about = describe_weights(second)
    assert about["initial_weights"] == describe_weights(first)["sha256"]
    assert about["settings"] == create_settings(width=SMALL["width"])
    assert "data.json" in refused(lambda: train(config, [shared_sequence], tmp_path / "run", cache=finished / "cache"))
