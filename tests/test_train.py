"""Training: clips that keep physics intact, runs that learn, stop and go on, and data that is refused."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from mcdenoise.data import open_sequence
from mcdenoise.data.clips import Clip, ClipSampler, accumulated_shots
from mcdenoise.errors import InputError
from mcdenoise.history import History
from mcdenoise.models import describe_weights, load_weights
from mcdenoise.ops import Accumulate, remodulate

pytest.importorskip("lightning_fabric", reason="training needs the packages of mcdenoise[train]")
pytest.importorskip("tensorboard", reason="training needs the packages of mcdenoise[train]")

from mcdenoise.train import Progress, TrainConfig, train

SMALL: dict[str, Any] = {"width": 4, "crop": 16, "frames": 2, "batch": 2, "steps": 6, "validation_frames": 1}


@pytest.fixture(autouse=True, scope="module")
def _one_thread() -> Iterator[None]:
    """Networks this small are several times slower on several threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


class Stopped(Exception):
    """Somebody pulled the plug."""


def refused(action: Callable[[], object]) -> str:
    with pytest.raises(InputError) as error:
        action()
    assert "\n" not in str(error.value)
    return str(error.value)


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


def test_one_clip_is_learnt_by_heart(small_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    draw, clips, reports = ClipSampler.draw, [], []

    def draw_once(sampler: ClipSampler, batch: int) -> Clip:
        clips.append(clips[0] if clips else draw(sampler, batch))
        return clips[-1]

    monkeypatch.setattr(ClipSampler, "draw", draw_once)
    config = TrainConfig(**{**SMALL, "width": 8, "frames": 3, "batch": 1, "steps": 30}, learning_rate=1e-2)
    train(config, [small_sequence], tmp_path / "run", checkpoint_every=5, report=reports.append)
    assert [progress.step for progress in reports] == [5, 10, 15, 20, 25, 30]
    # 0.305 to 0.216 was measured.
    assert reports[-1].loss < 0.8 * reports[0].loss
    assert set(reports[-1].validation) == {"smape", "psnr"}


@pytest.mark.parametrize("schedule", ["constant", "cosine"])
def test_a_run_that_was_stopped_goes_on_as_if_it_had_not_been(
    small_sequence: Path, tmp_path: Path, schedule: str
) -> None:
    config = TrainConfig(**SMALL, schedule=schedule, gradient_norm=1.0)
    steps: list[int] = []

    def stop_at_3(progress: Progress) -> None:
        steps.append(progress.step)
        if progress.step == 3:
            raise Stopped

    whole, stopped = tmp_path / "whole", tmp_path / "stopped"
    weights = train(config, [small_sequence], whole, checkpoint_every=3)
    with pytest.raises(Stopped):
        train(config, [small_sequence], stopped, checkpoint_every=3, report=stop_at_3)
    assert not (stopped / "cascaded.safetensors").exists()
    torch.manual_seed(99)
    resumed = train(config, [small_sequence], stopped, checkpoint_every=3, report=lambda p: steps.append(p.step))
    assert steps == [3, 6]
    expected, actual = state(whole), state(stopped)
    assert len(actual) == len(expected) > 100
    assert all(torch.equal(a, b) for a, b in zip(actual, expected, strict=True))
    assert describe_weights(resumed)["sha256"] == describe_weights(weights)["sha256"]


def test_a_finished_run_is_not_run_again(small_sequence: Path, tmp_path: Path) -> None:
    config, steps = TrainConfig(**SMALL), []
    weights = train(config, [small_sequence], tmp_path / "run")
    digest = describe_weights(weights)["sha256"]
    again = train(config, [small_sequence], tmp_path / "run", report=lambda progress: steps.append(progress.step))
    assert (again, steps, describe_weights(again)["sha256"]) == (weights, [], digest)


def test_what_a_run_leaves(small_sequence: Path, tmp_path: Path) -> None:
    run = tmp_path / "deep" / "run"
    weights = train(TrainConfig(**SMALL), [small_sequence], run, checkpoint_every=2, credits="A. Painter, CC0")
    assert weights == run / "cascaded.safetensors"
    names = {path.name for path in run.iterdir() if not path.name.startswith("events.")}
    assert names == {"cascaded.safetensors", "checkpoint.pt", "config.json", "data.json", "log.jsonl"}
    assert any(path.name.startswith("events.out.tfevents") for path in run.iterdir())

    config = json.loads((run / "config.json").read_text())
    assert TrainConfig(**config) == TrainConfig(**SMALL)
    digest = hashlib.sha256()
    sequence = open_sequence(small_sequence)
    for number in sequence.numbers:
        frame = sequence.frame(number)
        assert frame.reference is not None
        digest.update(frame.color.numpy().tobytes() + frame.reference.numpy().tobytes())
    data = json.loads((run / "data.json").read_text())
    entry = {"name": "plane", "frames": 4, "size": "24x20", "validation": [3], "sha256": digest.hexdigest()}
    assert data == {"credits": "A. Painter, CC0", "initial_weights": "none", "sequences": [entry]}
    start, *log = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    assert start["first_step"] == 0
    assert set(start) == {"first_step", "commit", "threads"}
    assert [entry["step"] for entry in log] == [2, 4, 6]
    assert all(set(entry) == {"step", "loss", "seconds", "validation"} for entry in log)

    about = describe_weights(weights)
    assert (about["architecture"], about["settings"], about["steps"]) == ("cascaded", {"width": 4}, "6")
    assert (about["licence"], about["credits"]) == ("Apache-2.0", "A. Painter, CC0")
    assert json.loads(about["config"]) == config
    assert json.loads(about["data"]) == data["sequences"]
    assert json.loads(about["commits"]) == [{"first_step": 0, "commit": start["commit"]}]
    saved = torch.load(run / "checkpoint.pt", weights_only=True)["parts"][0]
    for key, tensor in load_weights(weights, "cascaded").state_dict().items():
        assert torch.equal(tensor, saved[key].half().float())


def test_bfloat16_learns_float32_weights(small_sequence: Path, tmp_path: Path) -> None:
    train(TrainConfig(**{**SMALL, "steps": 2}, precision="bf16-mixed"), [small_sequence], tmp_path / "run")
    saved = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)["parts"][0]
    assert {tensor.dtype for tensor in saved.values()} == {torch.float32}
    assert all(torch.isfinite(tensor).all() for tensor in saved.values())


def test_frames_held_back_are_not_trained_on(
    small_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shots: list[Tensor] = []

    class Spy(ClipSampler):
        def __init__(self, given: list[Tensor], frames: int, crop: int, lamps: float) -> None:
            shots.extend(given)
            super().__init__(given, frames, crop, lamps)

    monkeypatch.setattr("mcdenoise.train.ClipSampler", Spy)
    config = TrainConfig(**{**SMALL, "steps": 1, "validation_frames": 2, "start_every": 1})
    train(config, [small_sequence], tmp_path / "run")
    # Shots of 4, 3, 2 and 1 frames, each without the last two frames of the sequence.
    assert [len(shot) for shot in shots] == [2, 1, 0, 0]


# Refusals


def test_another_config_needs_another_folder(small_sequence: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    train(TrainConfig(**{**SMALL, "steps": 1}), [small_sequence], run)
    before = {path.name: path.read_bytes() for path in run.iterdir()}
    message = refused(lambda: train(TrainConfig(**{**SMALL, "steps": 2}), [small_sequence], run))
    assert f"{run / 'config.json'}: expected the same as in this run" in message
    assert {path.name: path.read_bytes() for path in run.iterdir()} == before


def test_other_data_needs_another_folder(small_sequence: Path, tmp_path: Path) -> None:
    config, run = TrainConfig(**{**SMALL, "steps": 1}), tmp_path / "run"
    train(config, [small_sequence], run)
    assert f"{run / 'data.json'}: expected the same" in refused(lambda: train(config, [small_sequence] * 2, run))


@pytest.mark.parametrize("content", [b"", b"no checkpoint", b"\x80\x02}q\x00.", None])
def test_a_damaged_checkpoint_is_refused(small_sequence: Path, tmp_path: Path, content: bytes | None) -> None:
    config, run = TrainConfig(**{**SMALL, "steps": 1}), tmp_path / "run"
    train(config, [small_sequence], run)
    checkpoint = run / "checkpoint.pt"
    checkpoint.write_bytes(checkpoint.read_bytes()[:-500] if content is None else content)
    message = refused(lambda: train(config, [small_sequence], run))
    assert message.startswith(f"{checkpoint}: expected a checkpoint of this run")
    assert "remove it" in message


def test_no_sequences(tmp_path: Path) -> None:
    assert "expected at least one sequence folder" in refused(lambda: train(TrainConfig(), [], tmp_path / "run"))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("stem", "expected"),
    [
        ("reference", "expected a reference for every frame to train on, found none for frame 0"),
        ("reference2", "expected a reference for every frame to train on, found none for frame 2"),
        ("albedo", "expected albedo, normal and depth to train on, found no albedo"),
        ("shading_normal", "expected albedo, normal and depth to train on, found no normal"),
    ],
)
def test_data_that_cannot_be_trained_on_leaves_no_run(
    small_sequence: Path, tmp_path: Path, stem: str, expected: str
) -> None:
    for path in (small_sequence / "inputs").glob(f"{stem}*.exr"):
        path.unlink()
    assert expected in refused(lambda: train(TrainConfig(**SMALL), [small_sequence], tmp_path / "run"))
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("setting", "value", "expected"),
    [
        ("model", "oidn", "model 'oidn': expected one of"),
        ("crop", 64, "expected images of at least 64 pixels, found (20, 24)"),
        ("frames", 9, "expected a sequence of at least 9 frames"),
        ("frames", 1, "frames: expected at least 2, found 1"),
        ("width", -1, "width: expected at least 0, found -1"),
        ("steps", 0, "steps: expected at least 1, found 0"),
        ("batch", 0, "batch: expected at least 1, found 0"),
        ("crop", 0, "crop: expected at least 1, found 0"),
        ("start_every", 0, "start_every: expected at least 1, found 0"),
        ("validation_frames", -1, "validation_frames: expected at least 0, found -1"),
        ("temporal_weight", float("nan"), "temporal_weight: expected at least 0, found nan"),
        ("seed", 2**64, "seed: expected 0 to 2^32 - 1, found 18446744073709551616"),
        ("learning_rate", 0.0, "learning_rate: expected a positive number, found 0.0"),
        ("alpha_min", 0.0, "alpha_min: expected in (0, 1], found 0.0"),
    ],
)
def test_settings_that_cannot_be_leave_no_run(
    small_sequence: Path, tmp_path: Path, setting: str, value: Any, expected: str
) -> None:
    config = TrainConfig(**{**SMALL, setting: value})
    assert expected in refused(lambda: train(config, [small_sequence], tmp_path / "run"))
    assert not (tmp_path / "run").exists()


def test_a_folder_or_an_accelerator_that_cannot_be(small_sequence: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    config = TrainConfig(**SMALL)
    message = refused(lambda: train(config, [small_sequence], tmp_path / "file" / "run"))
    assert "expected a folder to write the run to" in message
    for accelerator in ("abacus", "tpu"):
        message = refused(lambda a=accelerator: train(config, [small_sequence], tmp_path / "run", accelerator=a))
        assert f"accelerator '{accelerator}': expected one that works here" in message
    message = refused(lambda: train(config, [small_sequence], tmp_path / "run", checkpoint_every=0))
    assert "checkpoint_every: expected at least 1, found 0" in message
    assert not (tmp_path / "run").exists()


# Clips


def numbered_shot(length: int = 3, height: int = 6, width: int = 7) -> Tensor:
    """A shot in which every value is another whole number: channel, frame, row and column can be read off."""
    count = length * 13 * height * width
    return torch.arange(1.0, count + 1).reshape(length, 13, height, width)


def orbit(clip: Tensor) -> list[Tensor]:
    """An image stack in its eight orientations."""
    turned = [clip.rot90(k, (-2, -1)) for k in range(4)]
    return [*turned, *(t.flip(-1) for t in turned)]


def test_clips_are_the_shot_turned_and_renamed() -> None:
    torch.manual_seed(0)
    crop, frames = 4, 2
    shot = numbered_shot()
    # Infinite depths must neither vanish nor spread.
    shot[:, 9, 2, 3] = torch.inf
    windows = {
        (start, top, left): shot[start : start + frames, :, top : top + crop, left : left + crop]
        for start in range(2)
        for top in range(3)
        for left in range(4)
    }
    candidates = [
        (place, orientation, Clip.from_stack(turned[None]))
        for place, window in windows.items()
        for orientation, turned in enumerate(orbit(window))
    ]
    sampler = ClipSampler([shot], frames, crop)
    places, orientations, orders = set(), set(), set()
    for _ in range(96):
        drawn = sampler.draw(1)
        found = [(p, o, source) for p, o, source in candidates if torch.equal(source.depth, drawn.depth)]
        assert len(found) == 1
        place, orientation, source = found[0]
        # One order of the colour channels for radiance, albedo and reference.
        order = [int((source.color[0, 0, :, 0, 0] == value).nonzero()) for value in drawn.color[0, 0, :, 0, 0]]
        for name in ("color", "albedo", "reference"):
            assert torch.equal(getattr(drawn, name), getattr(source, name)[:, :, order]), name
        # Normals: the world's axes renamed and reversed, the same for all pixels and frames.
        axes = [int((source.normal[0, 0, :, 0, 0] == value.abs()).nonzero()) for value in drawn.normal[0, 0, :, 0, 0]]
        signs = drawn.normal[0, 0, :, 0, 0].sign().reshape(1, 1, 3, 1, 1)
        assert sorted(axes) == [0, 1, 2]
        assert torch.equal(drawn.normal, source.normal[:, :, axes] * signs)
        places.add(place)
        orientations.add(orientation)
        orders.add(tuple(order))
    assert orientations == set(range(8))
    assert len(orders) == 6
    assert {start for start, _, _ in places} == {0, 1}
    assert {top for _, top, _ in places} == {0, 1, 2}
    assert {left for _, _, left in places} == {0, 1, 2, 3}


def test_the_same_seed_draws_the_same_clips() -> None:
    sampler = ClipSampler([numbered_shot(), numbered_shot(4)], 2, 4)

    def draw(seed: int) -> Clip:
        torch.manual_seed(seed)
        return sampler.draw(3)

    first, again, other = draw(7), draw(7), draw(8)
    assert first.color.shape == (3, 2, 3, 4, 4)
    assert all(torch.equal(getattr(first, name), getattr(again, name)) for name in vars(first))
    assert not torch.equal(first.color, other.color)


def test_shots_start_anew_and_are_accumulated(small_sequence: Path) -> None:
    sequence = open_sequence(small_sequence)
    shots = accumulated_shots(sequence, 0.1, start_every=2)
    assert [tuple(shot.shape) for shot in shots] == [(4, 13, 20, 24), (2, 13, 20, 24)]
    for first, shot in zip((0, 2), shots, strict=True):
        clip, history = Clip.from_stack(shot[None]), History(Accumulate(0.1))
        for i, number in enumerate(sequence.numbers[first:]):
            frame = sequence.frame(number)
            assert torch.equal(clip.color[0, i], history.update(frame).color[0])
            for name in ("albedo", "normal", "depth", "reference"):
                assert torch.equal(getattr(clip, name)[0, i], getattr(frame, name)[0]), name


def test_lamps_shine_alike_in_color_and_reference() -> None:
    """A clip of nothing: whatever is in it is a lamp, noise-free, in all frames, and brighter than nothing."""
    torch.manual_seed(0)
    shot = torch.zeros(4, 13, 20, 24)
    shot[:, 0:3], shot[:, 10:13] = 0.1, 0.5
    clip = ClipSampler([shot], frames=4, crop=16, lamps=1.0).draw(20)
    radiance = remodulate(clip.color.flatten(0, 1), clip.albedo.flatten(0, 1)).unflatten(0, (20, 4))
    lit = torch.isclose(radiance, clip.reference).all(2, keepdim=True)
    assert lit.flatten(1).any(1).all()
    assert (lit == lit[:, :1]).all()
    assert 0.02 < lit.float().mean() < 0.5
    assert (radiance[~lit.expand_as(radiance)] == torch.tensor(0.1)).all()
    assert clip.reference.max() > 3
    torch.manual_seed(0)
    dark = ClipSampler([shot], frames=4, crop=16).draw(20)
    assert dark.reference.unique().tolist() == [0.5]


def test_a_run_can_start_from_weights(small_sequence: Path, tmp_path: Path) -> None:
    first = train(TrainConfig(**SMALL), [small_sequence], tmp_path / "first")
    config = TrainConfig(**{**SMALL, "steps": 1}, learning_rate=1e-12)
    second = train(config, [small_sequence], tmp_path / "second", initial_weights=first)
    before, after = (load_weights(path).state_dict() for path in (first, second))
    for key, tensor in before.items():
        torch.testing.assert_close(after[key], tensor, rtol=1e-3, atol=1e-6)
    assert describe_weights(second)["initial_weights"] == describe_weights(first)["sha256"]
    message = refused(lambda: train(config, [small_sequence], tmp_path / "second"))
    assert "data.json" in message


def test_weights_of_another_width_are_gone_on_with(small_sequence: Path, tmp_path: Path) -> None:
    """The run does not say a width; its result must, or nobody could load it."""
    first = train(TrainConfig(**{**SMALL, "steps": 1}), [small_sequence], tmp_path / "first")
    config = TrainConfig(**{**SMALL, "steps": 1, "width": 0})
    second = train(config, [small_sequence], tmp_path / "second", initial_weights=first)
    assert describe_weights(second)["settings"] == {"width": SMALL["width"]}
    load_weights(second, "cascaded")
