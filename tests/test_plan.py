"""What a scene does not need is left out, and the pixels stay the same, or as near as was asked for."""

from __future__ import annotations

import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from mcdenoise import Denoiser, Frame, InputError, create_model
from mcdenoise.cli import main
from mcdenoise.data import open_sequence
from mcdenoise.denoise import denoise_sequence
from mcdenoise.history import History
from mcdenoise.models import Denoised
from mcdenoise.ops import Accumulate
from mcdenoise.plan import Plan, Stage, noise_free, summarize
from mcdenoise.plan.tiles import Tiles

HEIGHT, WIDTH = 160, 224
NORMAL = torch.tensor([0.0, 0.6, 0.8]).reshape(1, 3, 1, 1)


def small_model() -> nn.Module:
    """A small cascade with random weights, also in the heads that start at zero."""
    torch.manual_seed(0)
    model = create_model("cascaded", width=8)
    for head in model.first.heads:
        nn.init.normal_(head.weight, std=0.02)
    return model


def draw(seed: int, channels: int = 3, size: tuple[int, int] = (HEIGHT, WIDTH)) -> Tensor:
    return torch.rand(1, channels, *size, generator=torch.Generator().manual_seed(seed))


def wall(seed: int, noise: float = 1.0, size: tuple[int, int] = (HEIGHT, WIDTH), **buffers: Any) -> Frame:
    """A wall of tiles, seen by a camera at rest, in noisy light."""
    height, width = size
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    albedo = torch.where((rows // 16 + columns // 16) % 2 == 0, 0.7, 0.3).expand(1, 3, -1, -1)
    light = 1 + 0.5 * torch.sin(columns / 40) + noise * (draw(seed, size=size) - 0.5)
    position = torch.stack([columns / width - 0.5, rows / width - 0.5, torch.ones_like(rows)])[None] * 4
    defaults = {
        "albedo": albedo,
        "normal": NORMAL.repeat(1, 1, height, width),
        "depth": position[:, 2:] + 0.1 * draw(1000, 1, size),
        "position": position,
        "view_projection": torch.eye(4)[None],
    }
    return Frame(color=albedo * light, **(defaults | buffers))


def sky(frame: Frame, rows: int) -> Frame:
    """With a clear sky at the top."""
    assert frame.albedo is not None
    assert frame.normal is not None
    assert frame.depth is not None
    above = torch.arange(frame.size[0])[:, None].expand(1, 1, *frame.size) < rows
    blue = torch.tensor([0.2, 0.4, 0.9]).reshape(1, 3, 1, 1) * torch.linspace(1, 2, frame.size[0])[:, None]
    return frame.replace(
        color=torch.where(above, blue, frame.color),
        albedo=torch.where(above, 0, frame.albedo),
        normal=torch.where(above, 0, frame.normal),
        depth=torch.where(above, torch.inf, frame.depth),
    )


def stage(denoiser: Denoiser, name: str) -> Stage:
    return next(one for one in denoiser.report.stages if one.name == name)


def pair(model: nn.Module | None = None, **settings: Any) -> tuple[Denoiser, Denoiser]:
    """A denoiser that leaves out what it can, and one that leaves out nothing."""
    model = small_model() if model is None else model
    return Denoiser(model, plan=Plan(**settings)), Denoiser(model, plan=Plan(keep_all=True))


# Exactly


SHOTS: dict[str, tuple[Callable[[int], Frame], dict[str, float]]] = {
    "at rest": (wall, {"reproject": 1, "normal weights": 1}),
    "at rest, by its motion": (lambda n: wall(n, motion=torch.zeros(1, 2, HEIGHT, WIDTH)), {"reproject": 1}),
    "moving": (lambda n: wall(n, motion=torch.full((1, 2, HEIGHT, WIDTH), 0.3)), {"reproject": 0, "accumulate": 0}),
    "single frames": (lambda n: wall(n, position=None), {"accumulate": 1, "reproject": 1}),
    "white": (lambda n: wall(n, albedo=torch.ones(1, 3, HEIGHT, WIDTH)), {"demodulate": 1}),
    "mirrors": (lambda n: wall(n, albedo=torch.zeros(1, 3, HEIGHT, WIDTH)), {"demodulate": 1}),
    "without albedo": (lambda n: wall(n, albedo=None), {"demodulate": 1}),
    "without normal": (lambda n: wall(n, normal=None), {"normal weights": 1, "depth weights": 0}),
    "flat": (lambda n: wall(n, depth=torch.full((1, 1, HEIGHT, WIDTH), 2.0)), {"depth weights": 1}),
    "half sky": (lambda n: sky(wall(n), 90), {"normal weights": 0, "noise-free pixels": 90 / HEIGHT}),
    "all sky": (lambda n: sky(wall(n), HEIGHT), {"network": 1, "demodulate": 1}),
}


@pytest.mark.parametrize("shot", SHOTS)
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_what_is_left_out_exactly_changes_no_pixel(shot: str, precision: Any) -> None:
    make, expected = SHOTS[shot]
    model = small_model()
    plans = Plan(tolerance=0), Plan(keep_all=True)
    short, whole = (Denoiser(model, precision=precision, plan=plan) for plan in plans)
    for number in range(3):
        a, b = short.images(make(number)), whole.images(make(number))
        for name in ("noisy", "accumulated", "initial", "denoised"):
            assert torch.equal(getattr(a, name), getattr(b, name)), name
    left_out = {one.name: one.left_out for one in short.report.stages}
    assert {name: left_out[name] for name in expected} == pytest.approx(expected)
    assert all(one.exact for one in short.report.stages)
    assert whole.report.reset == short.report.reset
    # Copied by both; nothing else is left out.
    names = {one.name for one in whole.report.stages if one.left_out}
    assert names <= {"noise-free pixels", "accumulate"}


def test_the_network_runs_on_what_is_not_sky() -> None:
    size = (320, 224)
    short, whole = pair()
    frame = sky(wall(0, size=size), 200)
    image, expected = short(frame), whole(frame)
    # Convolutions choose the order of their sums by the size of the image and the number of threads.
    torch.testing.assert_close(image, expected, rtol=1e-5, atol=1e-5 * float(expected.mean()))
    # Down from row 192, a multiple of 32, and 64 rows above it that the network looks at.
    assert stage(short, "network").left_out == pytest.approx(192 / 320)
    assert stage(whole, "network").left_out == 0
    assert torch.equal(short(frame)[..., :200, :], frame.color[..., :200, :])


def test_a_network_of_your_own_runs_unless_everything_is_known() -> None:
    class Half(nn.Module):
        calls = 0

        def forward(self, color: Tensor, albedo: Tensor, normal: Tensor, depth: Tensor) -> Denoised:
            self.calls += 1
            return Denoised(color / 2, color / 2)

    model = Half()
    short, whole = pair(model)
    frames = sky(wall(0), 90), sky(wall(0), HEIGHT)
    images = [(short(frame), whole(frame)) for frame in frames]
    assert all(torch.equal(a, b) for a, b in images)
    assert model.calls == 3
    torch.testing.assert_close(images[0][0][..., 90:, :], frames[0].color[..., 90:, :] / 2)
    assert torch.equal(images[0][0][..., :90, :], frames[0].color[..., :90, :])


def test_one_frame_and_the_last_one_are_not_remembered() -> None:
    denoiser = Denoiser(small_model())
    for frames, kept in ((1, [False]), (3, [True, True, False]), (None, [True, True, True])):
        denoiser.reset(frames=frames)
        for number, keeps in enumerate(kept):
            denoiser(wall(number))
            assert (stage(denoiser, "remember").left_out == 0) is keeps
            assert (denoiser.history._state is not None) is keeps


# What has no noise


def found(frame: Frame) -> Tensor | None:
    return noise_free(frame.inspect())


def test_a_clear_sky_has_no_noise_and_is_copied() -> None:
    frame = sky(wall(0), 90)
    free = found(frame)
    assert free is not None
    assert torch.equal(free, frame.depth == torch.inf)


def test_noise_fog_and_detail_are_left_to_the_network() -> None:
    frame = sky(wall(0), 90)
    for strength in (0.05, 1.0):
        noisy = frame.color * (1 + strength * (draw(7) - 0.5))
        assert found(frame.replace(color=noisy)) is None
    speck = frame.color.clone()
    speck[..., 40, 100] *= 2
    free = found(frame.replace(color=speck))
    assert free is not None
    assert not free[..., 32:48, 92:112].any()
    assert free[..., :16, :].all()


def test_an_emitter_is_copied_and_a_mirror_that_shows_noise_is_not() -> None:
    frame = wall(0)
    assert frame.albedo is not None
    assert found(frame) is None
    albedo, color = frame.albedo.clone(), frame.color.clone()
    albedo[..., 20:60, 20:60] = 0
    albedo[..., 100:140, 20:60] = 0
    color[..., 20:60, 20:60] = 12.0
    free = found(frame.replace(albedo=albedo, color=color))
    assert free is not None
    assert free[..., 20:60, 20:60].all()
    assert free.sum() == 40 * 40
    # A black hole may only have met no light yet.
    color[..., 20:60, 20:60] = 0
    assert found(frame.replace(albedo=albedo, color=color)) is None


def test_a_few_pixels_prove_nothing() -> None:
    frame = wall(0)
    assert frame.depth is not None
    depth = frame.depth.clone()
    depth[..., 50:58, 60:68] = torch.inf
    color = torch.where(depth == torch.inf, 0.5, frame.color)
    assert found(frame.replace(depth=depth, color=color)) is None


# Up to a tolerance


def relative(a: Tensor, b: Tensor) -> float:
    return float((a - b).square().mean().sqrt() / b.mean())


def test_a_tile_without_noise_is_passed_through() -> None:
    short, whole = pair(tolerance=1e-3)
    for number in range(12):
        # Noise in the left part only.
        quiet, loud = wall(number, 0.003), wall(number, 1.0)
        right = torch.arange(WIDTH) >= 96
        frame = quiet.replace(color=torch.where(right, quiet.color, loud.color))
        images, expected = short.images(frame), whole.images(frame)
    tiles = stage(short, "converged tiles")
    assert (tiles.left_out, tiles.exact) == (pytest.approx(128 / WIDTH), False)
    assert torch.equal(images.denoised[..., 96:], images.accumulated[..., 96:])
    assert not torch.equal(images.denoised[..., :96], images.accumulated[..., :96])
    # What is passed through is a better image for the second network, at its border too.
    assert relative(images.denoised[..., :64], expected.denoised[..., :64]) < 0.02


def test_noise_is_estimated_as_it_is() -> None:
    alpha_min = 0.05
    for count in (12, 60):
        history = History(Accumulate(alpha_min))
        for number in range(count):
            truth = wall(number).replace(albedo=None)
            past = history.update(truth.replace(color=0.9 + 0.2 * draw(number)))
        actual = relative(past.color, torch.ones(1))
        for tolerance, passes in ((actual * 0.7, False), (actual * 1.5, True)):
            passed, _ = Tiles(tolerance, alpha_min).decide(truth, past.color, past.current, past.length)
            assert bool(passed.all() if passes else passed.any()) is passes


def edited(number: int, moved: bool) -> Frame:
    """A viewport: the same, almost clean image again and again, until a box is put into the corner."""
    frame = wall(0, 0.2)
    if not moved:
        return frame
    assert frame.albedo is not None
    albedo, color = frame.albedo.clone(), frame.color.clone()
    albedo[..., 10:30, 20:50] = 0.9
    color[..., 10:30, 20:50] = 0.45 + 0.1 * number / 30
    return frame.replace(albedo=albedo, color=color)


def test_only_what_an_edit_changes_is_computed_again() -> None:
    short, whole = pair(tolerance=1e-3)
    shares, errors = [], []
    for number in range(20):
        frame = edited(number, number >= 17)
        image, expected = short(frame), whole(frame)
        errors.append(relative(image, expected))
        shares.append({one.name: one.left_out for one in short.report.stages}.get("unchanged tiles", 0.0))
    # A frame that is repeated has the noise it has; its share in the average still changes at first.
    assert set(shares[:15]) == {0}
    assert shares[15:17] == [1, 1]
    # The box lies in the first two of 5 x 7 tiles; four more on each side see it.
    assert shares[17:] == [pytest.approx(1 - 5 * 6 / 35)] * 3
    assert errors[:15] == [0] * 15
    assert 0 < max(errors) < 1e-3


def test_a_tile_does_not_switch_to_and_fro() -> None:
    """The noise of every tile hovers about the tolerance: it leaves once, and comes back never."""
    noise, frames, alpha_min = 0.02, 60, 0.1
    # Of uniform noise, in the exponential window.
    expected = noise / 12**0.5 * (alpha_min / (2 - alpha_min)) ** 0.5
    changes = {}
    for name, hysteresis in (("with", 2.0), ("without", 1.0)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("mcdenoise.plan.tiles._NOISE_HYSTERESIS", hysteresis)
            history, tiles, states = History(Accumulate(alpha_min)), Tiles(expected, alpha_min), []
            for number in range(frames):
                frame = wall(number).replace(albedo=None, color=1 + noise * (draw(number) - 0.5))
                past = history.update(frame)
                states.append(tiles.decide(frame, past.color, past.current, past.length).passed[..., ::32, ::32])
        changes[name] = sum((a != b).sum() for a, b in pairwise(states))
    assert changes["without"] > 100
    # Each of the 35 tiles at most once.
    assert changes["with"] <= 35
    assert states[-1].numel() == 35


def test_a_cut_and_a_moving_camera_compute_everything_again() -> None:
    denoiser = Denoiser(small_model())
    for number in range(12):
        denoiser(wall(number, 0.003))
    assert stage(denoiser, "converged tiles").left_out == 1
    assert stage(denoiser, "network").left_out == 1
    denoiser(wall(0, 0.0, motion=torch.full((1, 2, HEIGHT, WIDTH), 0.5)))
    assert stage(denoiser, "network").left_out == 0
    for number in range(12):
        denoiser(wall(number, 0.003))
    assert stage(denoiser, "network").left_out == 1
    cut = wall(0, 0.0)
    assert cut.normal is not None
    denoiser(cut.replace(normal=-cut.normal))
    assert denoiser.report.reset == "cut"
    assert stage(denoiser, "network").left_out == 0


@pytest.mark.parametrize("tolerance", [-1.0, float("nan"), float("inf")])
def test_a_tolerance_that_is_none_is_refused(tolerance: float) -> None:
    with pytest.raises(InputError, match="tolerance: expected a finite number of at least 0"):
        Plan(tolerance=tolerance)


# The cost of deciding


@pytest.mark.slow
def test_deciding_costs_less_than_a_hundredth_of_what_it_saves() -> None:
    size = (720, 1280)
    short, whole = (Denoiser("cascaded", plan=plan) for plan in (Plan(), Plan(keep_all=True)))
    frame = sky(wall(0, size=size), 400)
    costs, saved = [], []
    for _ in range(3):
        short.reset()
        whole.reset()
        short(frame)
        whole(frame)
        costs.append(short.report.milliseconds["plan"])
        saved.append(whole.report.milliseconds["network"] - short.report.milliseconds["network"])
    assert min(costs) < 0.01 * sorted(saved)[1]


def test_deciding_on_an_ordinary_frame_takes_next_to_nothing() -> None:
    denoiser = Denoiser(small_model())
    frame = wall(0, motion=torch.full((1, 2, HEIGHT, WIDTH), 0.3), normal=draw(3) - 0.5)
    times = []
    for _ in range(5):
        denoiser(frame)
        times.append(denoiser.report.milliseconds)
    assert min(one["plan"] for one in times) < 0.1 * min(one["network"] for one in times)


# Whole sequences


def test_a_summary_counts_shares_and_tells_why() -> None:
    frames = [
        [Stage("reproject", 0, "positions"), Stage("network", 0.5, "half")],
        [Stage("reproject", 1, "still"), Stage("network", 0.25, "quarter"), Stage("tiles", 0.5, "noise", exact=False)],
        [Stage("reproject", 1, "still"), Stage("network", 0.5, "half")],
    ]
    assert summarize(frames) == [
        {"stage": "reproject", "kept": True, "left_out": pytest.approx(2 / 3), "reason": "still", "exact": True},
        {"stage": "network", "kept": True, "left_out": pytest.approx(1.25 / 3), "reason": "half", "exact": True},
        {"stage": "tiles", "kept": True, "left_out": pytest.approx(0.5 / 3), "reason": "noise", "exact": False},
    ]


def test_the_command_line_prints_and_writes_the_plan(
    small_sequence: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plans = {}
    for name, options in (("short", ["--tolerance", "0.01"]), ("whole", ["--keep-all"])):
        out = tmp_path / name
        command = ["denoise", str(small_sequence), "-o", str(out), "--model", "cascaded_tiny", "--frames", "2"]
        with pytest.raises(SystemExit) as stop:
            main([*command, *options])
        assert stop.value.code == 0
        plans[name] = json.loads((out / "denoise.json").read_text())
        printed = capsys.readouterr().out
        if name == "short":
            assert "  remember: left out (one frame)\n" in printed
        assert "  demodulate: kept (albedo)\n" in printed
    assert (plans["short"]["tolerance"], plans["short"]["keep_all"], plans["whole"]["keep_all"]) == (0.01, False, True)
    kept = {name: {row["stage"]: row["kept"] for row in plan["plan"]} for name, plan in plans.items()}
    assert (kept["short"]["remember"], kept["whole"]["remember"]) == (False, True)
    images = [(tmp_path / name / "denoised2.exr").read_bytes() for name in plans]
    assert images[0] == images[1]


def test_a_sequence_and_its_frames_one_by_one_are_the_same(small_sequence: Path, tmp_path: Path) -> None:
    sequence = open_sequence(small_sequence)
    report = denoise_sequence(sequence, tmp_path / "out", Denoiser(small_model()), "small")
    assert [row["stage"] for row in report.plan][:2] == ["read", "accumulate"]
    assert {row["stage"]: row["left_out"] for row in report.plan}["remember"] == pytest.approx(1 / 4)
