"""Training: clips that keep physics intact, runs that learn, stop and go on, and data that is refused."""

import dataclasses
import hashlib
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import textwrap
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from refusals import full_disk, refused
from safetensors.torch import load_file
from torch import Tensor

from mcdenoise.data import open_sequence
from mcdenoise.data.exr import read_exr, write_exr
from mcdenoise.data.shards import write_shard
from mcdenoise.models import describe_weights, load_weights

pytest.importorskip("lightning_fabric", reason="training needs the packages of mcdenoise[train]")
pytest.importorskip("tensorboard", reason="training needs the packages of mcdenoise[train]")

from mcdenoise.train import Progress, RunFolder, TrainConfig, train
from mcdenoise.train.clips import Clip, ClipSampler
from mcdenoise.train.config import check_config

MODEL = "cascaded"
SMALL: dict[str, Any] = {"model": MODEL, "settings": "width=4", "crop": 16, "frames": 2, "batch": 2, "steps": 6}
SMALL["validation_frames"] = 1
FIELDS = {field.name for field in dataclasses.fields(TrainConfig)}


@pytest.fixture(scope="module")
def finished(shared_sequence: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
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


class Stopped(Exception):
    """The power fails."""


def create_settings(**changed: Any) -> dict[str, Any]:
    return {"width": 40, "kernel_size": 5, "cascade": "P+K", "bilateral": True, "normalize": "softmax", **changed}


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


def test_one_clip_is_learnt_by_heart(shared_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    draw, clips, reports = ClipSampler.draw, [], []

    def draw_once(sampler: ClipSampler, seeds: list[int]) -> Clip:
        clips.append(clips[0] if clips else draw(sampler, seeds))
        return clips[-1]

    monkeypatch.setattr(ClipSampler, "draw", draw_once)
    config = TrainConfig(**{**SMALL, "settings": "width=8", "frames": 3, "batch": 1, "steps": 30}, learning_rate=1e-2)
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
    assert not (stopped / f"{MODEL}.safetensors").exists()
    torch.manual_seed(99)
    go_on: dict[str, Any] = {"cache": cache, "checkpoint_every": 3, "report": lambda p: steps.append(p.step)}
    resumed = train(config, [shared_sequence], stopped, **go_on)
    assert steps == [3, 6]
    expected, actual = state(whole), state(stopped)
    assert len(actual) == len(expected) > 100
    assert all(torch.equal(a, b) for a, b in zip(actual, expected, strict=True))
    digest = describe_weights(resumed)["sha256"]
    assert digest == describe_weights(weights)["sha256"]
    assert train(config, [shared_sequence], stopped, **go_on) == resumed
    assert (steps, describe_weights(resumed)["sha256"]) == ([3, 6], digest)


def test_files_of_a_finished_run(shared_sequence: Path, finished: Path) -> None:
    run, weights = finished, finished / f"{MODEL}.safetensors"
    assert len(list(run.glob("events.out.tfevents*"))) == 1
    config = json.loads((run / "config.json").read_text())
    assert TrainConfig(**config) == TrainConfig(**SMALL)
    digest = hashlib.sha256()
    sequence = open_sequence(shared_sequence)
    for number in sequence.numbers:
        frame = sequence.frame(number)
        digest.update(frame.color.numpy().tobytes() + frame.reference.numpy().tobytes())
    data = json.loads((run / "data.json").read_text())
    entry = {"name": "plane", "frames": 4, "size": "24x20", "noise_seeds": 1, "validation": [3]}
    entry["sha256"] = digest.hexdigest()
    assert data == {"credits": "A. Painter, CC0", "initial_weights": "none", "sequences": [entry]}
    start, *log = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    assert (start["first_step"], [entry["step"] for entry in log]) == (0, [2, 4, 6])
    assert all(entry["gradient_norm"] > 0 and entry["learning_rate"] == 1e-4 for entry in log)

    about = describe_weights(weights)
    assert (about["architecture"], about["settings"], about["steps"]) == (MODEL, create_settings(width=4), "6")
    assert (about["licence"], about["credits"]) == ("Apache-2.0", "A. Painter, CC0")
    assert json.loads(about["config"]) == config
    assert json.loads(about["data"]) == data["sequences"]
    assert json.loads(about["commits"]) == [{"first_step": 0, "commit": start["commit"]}]
    saved = torch.load(run / "checkpoint.pt", weights_only=True)["parts"][0]
    for key, tensor in load_weights(weights, MODEL).state_dict().items():
        assert torch.equal(tensor, saved[key].half().float())


def take(path: Path, frames: int, references: int, without: str = "", repeated: bool = False) -> Path:
    arrays = {name: np.full((frames, 3, 16, 16), 0.5) for name in ("albedo", "normal")}
    color = np.random.default_rng(0).random((frames, 3, 16, 16))
    arrays |= {"color": color[:1].repeat(frames, 0) if repeated else color}
    arrays |= {"motion": np.zeros((frames, 2, 16, 16)), "roughness": np.ones((frames, 1, 16, 16))}
    arrays |= {name: np.full((references, 3, 16, 16), 0.5) for name in ("reference", "reference_error")}
    arrays |= {"depth": np.ones((frames, 1, 16, 16))}
    arrays.pop(without, None)
    write_shard(path, {"credits": ["chair (Ann, CC-BY 3.0)"]}, arrays)
    return path


def test_weights_name_the_authors_of_packed_takes_and_of_sequences(small_sequence: Path, tmp_path: Path) -> None:
    config = TrainConfig(**{**SMALL, "steps": 1, "validation_frames": 0})
    weights = train(config, [take(tmp_path / "0.take.npz", 2, 2)], tmp_path / "run")
    assert json.loads(describe_weights(weights)["data"])[-1]["credits"] == ["Ann, CC-BY 3.0"]
    (small_sequence / "credits.txt").write_text("sky (Bob, CC0)\n")
    weights = train(config, [small_sequence], tmp_path / "other")
    assert json.loads(describe_weights(weights)["data"])[-1]["credits"] == ["Bob, CC0"]


@pytest.mark.parametrize(
    ("other", "expected"), [((1, 1), "found 2 in some and 3 in others"), ((4, 1), "found 1 in some and 2 in others")]
)
def test_clips_of_unequally_many_references_leave_no_run(tmp_path: Path, other: tuple[int, int], expected: str) -> None:
    takes = [take(tmp_path / "0.take.npz", 4, 2), take(tmp_path / "1.take.npz", *other)]
    config = TrainConfig(**{**SMALL, "frames": 3, "validation_frames": 0})
    assert expected in refused(lambda: train(config, takes, tmp_path / "run"))
    assert not (tmp_path / "run").exists()


def test_changes_of_a_single_reference_are_not_compared(tmp_path: Path) -> None:
    takes = [take(tmp_path / "0.take.npz", 3, 1)]
    config = TrainConfig(**{**SMALL, "validation_frames": 4})
    message = refused(lambda: train(config, takes, tmp_path / "run", validation=takes))
    assert message.startswith("temporal_weight: ")


@pytest.mark.parametrize("beside", [False, True])
def test_takes_that_keep_no_frames_for_validation_are_told(tmp_path: Path, beside: bool) -> None:
    takes = [take(tmp_path / "0.take.npz", 3, 1)]
    config = TrainConfig(**{**SMALL, "steps": 1, "temporal_weight": 0.0})
    with pytest.warns(UserWarning, match="validation_frames: expected 0 for takes, found 1; name other takes") as told:
        train(config, takes, tmp_path / "run", validation=takes if beside else None)
    assert told[0].filename == __file__


@pytest.mark.parametrize(
    ("model", "missing", "expected"),
    [
        ("cascaded", "motion", r"1.take.npz: no motion, .* \(1 of 2 .*without a history"),
        ("nppd", "motion", "(1.take.npz: no motion|only some .* have motion)"),
        ("rae", "roughness", "only some sequences or takes have roughness"),
    ],
)
def test_what_a_model_is_trained_without_is_said(tmp_path: Path, model: str, missing: str, expected: str) -> None:
    takes = [take(tmp_path / "0.take.npz", 3, 2), take(tmp_path / "1.take.npz", 3, 2, missing)]
    config = TrainConfig(**{**SMALL, "model": model, "steps": 1, "validation_frames": 0})
    with pytest.warns(UserWarning, match=expected):
        train(config, takes, tmp_path / "run")


def test_frames_that_repeat_the_noise_are_told(tmp_path: Path) -> None:
    config = TrainConfig(**{**SMALL, "steps": 1, "validation_frames": 0})
    with pytest.warns(UserWarning, match="0.take.npz: 2 of 3 frames have the noise of the frame before"):
        train(config, [take(tmp_path / "0.take.npz", 3, 2, "", True)], tmp_path / "run")


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
    assert not (run / f"{MODEL}.safetensors").exists()
    assert torch.load(run / "checkpoint.pt", weights_only=True)["step"] == 2
    (left,) = run.glob(".mcdenoise*")
    os.utime(left, (0, 0))
    weights = again()
    assert describe_weights(weights)["sha256"] == describe_weights(finished / weights.name)["sha256"]
    assert not left.exists()


@pytest.mark.slow
def test_two_processes_learn_what_one_does(shared_sequence: Path, tmp_path: Path) -> None:
    settings = {**SMALL, "batch": 4, "steps": 4, "ema": 0.9}
    config = TrainConfig(**settings, gradient_norm=0.5, lamps=0.5, exposure=1.0)
    weights = []
    # Both with one thread a process: with more, sums are taken in another order again.
    for run, processes in ((tmp_path / "one", 1), (tmp_path / "two", 2)):
        options_of_run = ("-o", run, "--checkpoint-every", 1, *options(config))
        command = mcdenoise("train", shared_sequence, *options_of_run, processes=processes)
        result = subprocess.run(command, env=ONE_THREAD, capture_output=True, text=True, check=False)
        assert result.returncode == 0, result.stderr
        assert result.stdout.split() == [str(run / f"{MODEL}.safetensors")]
        weights.append(load_file(run / f"{MODEL}.safetensors"))
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


def test_another_config_or_other_data_need_another_folder(
    again: Callable[..., Path], shared_sequence: Path, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    # One with another cache, too, which must not be filled for nothing.
    message = refused(lambda: again(steps=2, settings="width=4,alpha_min=0.5", cache=tmp_path / "cache"))
    expected = "expected settings='width=4,alpha_min=0.5', steps=2 as in this run, found settings='width=4'"
    assert f"{run / 'config.json'}: {expected}" in message
    assert not (tmp_path / "cache").exists()
    assert f"{run / 'data.json'}: expected sequences=" in refused(lambda: again(shared_sequence, shared_sequence))
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before


@pytest.mark.skipif(sys.platform == "darwin", reason="has no file names but UTF-8")
def test_a_folder_whose_name_is_not_utf_8_is_refused_before_the_work(shared_sequence: Path, tmp_path: Path) -> None:
    run = tmp_path / "M\udcfcller"
    assert "whose name is UTF-8" in refused(lambda: train(TrainConfig(**SMALL), [shared_sequence], run))
    assert not run.exists()


def test_no_flipped_bit_of_a_checkpoint_is_trained_on(tmp_path: Path) -> None:
    folder, part = RunFolder(tmp_path), torch.nn.Linear(3, 2)
    folder.save(7, [], part)
    path = tmp_path / "checkpoint.pt"
    content = path.read_bytes()
    assert folder.load(part) == (7, [])
    # In the weights, of which any value would do.
    for place in (content.index(part.weight.detach().numpy().tobytes()) + 2, *range(0, len(content), 97)):
        path.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
        assert "found one that is damaged" in refused(lambda: folder.load(part))
    for damaged in (b"", b"no checkpoint", b"\x80\x02}q\x00."):
        path.write_bytes(damaged)
        assert "found one that is damaged" in refused(lambda: folder.load(part))


def test_two_trainings_do_not_share_a_folder(shared_sequence: Path, tmp_path: Path) -> None:
    config, run, messages = TrainConfig(**{**SMALL, "steps": 2}), tmp_path / "run", []

    def again(progress: Progress) -> None:
        if not messages:
            log = (run / "log.jsonl").read_bytes()
            messages.append(refused(lambda: train(config, [shared_sequence], run, checkpoint_every=1)))
            assert (run / "log.jsonl").read_bytes() == log

    train(config, [shared_sequence], run, checkpoint_every=1, report=again)
    assert messages[0].startswith(f"{run}: ")
    assert f"process {os.getpid()} of {platform.node()}" in messages[0]
    (run / f"{MODEL}.safetensors").unlink()
    train(config, [shared_sequence], run, checkpoint_every=1)


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


@pytest.mark.parametrize(("stem", "value"), [("color", 3e38), ("reference", 9e15), ("color", np.nan)])
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


@pytest.mark.parametrize(
    ("stem", "expected"),
    [
        ("reference", "expected a reference for every frame to train on, found none for frame 0"),
        ("reference2", "expected a reference for every frame to train on, found none for frame 2"),
        ("albedo", "expected albedo, normal, depth to train this model on, found no albedo"),
        ("shading_normal", "expected albedo, normal, depth to train this model on, found no normal"),
        ("*2", "expected frame 2 after frame 1, found 3"),
        ("albedo2", "expected buffer 'albedo' for every frame, found none"),
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


BAD: dict[str, tuple[Any, ...]] = {
    "settings": ("width", "width=1,width=2"),
    "crop": (0,),
    "frames": (1,),
    "steps": (0,),
    "batch": (0,),
    "start_every": (0,),
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
    "lamps": (1.5,),
}


@pytest.mark.parametrize(("setting", "value"), [(name, value) for name, values in BAD.items() for value in values])
def test_settings_that_cannot_be_are_named_with_their_value(setting: str, value: Any) -> None:
    message = refused(lambda: check_config(TrainConfig(**{**SMALL, setting: value}), 2))
    assert setting in message
    assert str(value) in message


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("model", "no_such"),
        ("model", "noisy.py:factory"),
        ("model", "mcdenoise.ops:demodulate"),
        ("settings", "alpha_min=0"),
        ("settings", "depth=3"),
        ("crop", 64),
        ("frames", 9),
    ],
)
def test_settings_of_no_model_or_data_leave_no_run(
    shared_sequence: Path, tmp_path: Path, setting: str, value: Any
) -> None:
    message = refused(lambda: train(TrainConfig(**{**SMALL, setting: value}), [shared_sequence], tmp_path / "run"))
    assert str(value).partition("=")[0].partition(":")[0] in message
    assert not (tmp_path / "run").exists()


def test_a_run_can_start_from_weights(shared_sequence: Path, finished: Path, tmp_path: Path) -> None:
    """Without a width, the result is of that of the weights, and says so, so that it can be loaded."""
    first = finished / f"{MODEL}.safetensors"
    config = TrainConfig(**{**SMALL, "steps": 1, "settings": ""}, learning_rate=1e-12, start_from=str(first))
    second = train(config, [shared_sequence], tmp_path / "run", cache=finished / "cache")
    before, after = (load_weights(path).state_dict() for path in (first, second))
    for key, tensor in before.items():
        torch.testing.assert_close(after[key], tensor, rtol=1e-3, atol=1e-6)
    about = describe_weights(second)
    assert about["initial_weights"] == describe_weights(first)["sha256"]
    # The authors of the data of both are owed credit.
    assert json.loads(about["data"]) == 2 * json.loads(describe_weights(first)["data"])
    assert about["settings"] == create_settings(width=4)
