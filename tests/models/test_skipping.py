"""Work that a scene does not need is skipped, and the pixels stay the same, or as near as was requested."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.utils import _pytree as pytree
from toys import Blur, Mean, Same, Shot, Watching, cascade, report_of, small

from mcdenoise import Denoiser, Frame
from mcdenoise.models import Accumulated, Demodulated, Output, Skipping, Tiled
from mcdenoise.models._noise_free import noise_free
from mcdenoise.models._report import FrameReport, Stage, summarize
from mcdenoise.models._wrapper import parts_of

HEIGHT, WIDTH = 160, 224
NORMAL = torch.tensor([0.0, 0.6, 0.8]).reshape(1, 3, 1, 1)


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
    """Return the frame with a clear sky at the top."""
    above = torch.arange(frame.size[0])[:, None].expand(1, 1, *frame.size) < rows
    blue = torch.tensor([0.2, 0.4, 0.9]).reshape(1, 3, 1, 1) * torch.linspace(1, 2, frame.size[0])[:, None]
    return frame.replace(
        color=torch.where(above, blue, frame.color),
        albedo=torch.where(above, 0, frame.albedo),
        normal=torch.where(above, 0, frame.normal),
        depth=torch.where(above, torch.inf, frame.depth),
    )


def stage(denoiser: Denoiser, name: str) -> Stage:
    return denoiser.report.stages[name]


def pair(model: nn.Module | None = None, tolerance: float = 1e-3) -> tuple[Denoiser, Denoiser]:
    """A denoiser that skips what it can, and one that skips nothing."""
    model = cascade() if model is None else model
    for skipping in parts_of(model, Skipping):
        skipping.tolerance = tolerance
    return Denoiser(model), Denoiser(model, keep_all=True)


SHOTS: dict[str, tuple[Callable[[int], Frame], dict[str, float]]] = {
    "at rest": (wall, {"reproject": 1}),
    "at rest, by its motion": (lambda n: wall(n, motion=torch.zeros(1, 2, HEIGHT, WIDTH)), {"reproject": 1}),
    "moving": (lambda n: wall(n, motion=torch.full((1, 2, HEIGHT, WIDTH), 0.3)), {"reproject": 0, "accumulate": 0}),
    "single frames": (lambda n: wall(n, position=None), {"accumulate": 1, "reproject": 1}),
    "white": (lambda n: wall(n, albedo=torch.ones(1, 3, HEIGHT, WIDTH)), {"demodulate": 1}),
    "mirrors": (lambda n: wall(n, albedo=torch.zeros(1, 3, HEIGHT, WIDTH)), {"demodulate": 1}),
    "without albedo": (lambda n: wall(n, albedo=None), {"demodulate": 1}),
    "without normal": (lambda n: wall(n, normal=None), {"network": 0}),
    "flat": (lambda n: wall(n, depth=torch.full((1, 1, HEIGHT, WIDTH), 2.0)), {"network": 0}),
    "half sky": (lambda n: sky(wall(n), 90), {"noise-free pixels": 90 / HEIGHT}),
    "all sky": (lambda n: sky(wall(n), HEIGHT), {"network": 1, "demodulate": 1}),
}


@pytest.mark.parametrize(
    ("precision", "shot"), [*(("float32", shot) for shot in SHOTS), ("bfloat16", "at rest"), ("bfloat16", "half sky")]
)
def test_exact_skipping_changes_no_pixel(precision: Any, shot: str) -> None:
    make, expected = SHOTS[shot]
    model = cascade(tolerance=0)
    short, whole = Denoiser(model, precision=precision), Denoiser(model, precision=precision, keep_all=True)
    for number in range(3):
        a, b = short.output(make(number)), whole.output(make(number))
        assert list(a.stages) == list(b.stages) == ["noisy", "accumulated", "initial"]
        for name in a.stages:
            assert torch.equal(a.stages[name], b.stages[name]), name
        assert torch.equal(a.image, b.image)
    skipped = {name: one.skipped for name, one in short.report.stages.items()}
    assert {name: skipped[name] for name in expected} == pytest.approx(expected)
    assert all(one.exact for one in short.report.stages.values() if one.skipped)
    assert whole.report.reset == short.report.reset
    # Copied by both; nothing else is skipped but what there is nothing for.
    names = {name for name, one in whole.report.stages.items() if one.skipped}
    assert whole.report.stages["network"].skipped == 0
    absent = {"accumulate", "reproject", "remember"} if shot == "single frames" else set()
    absent |= {"demodulate"} if shot == "without albedo" else set()
    assert names <= {"noise-free pixels"} | absent


def test_a_method_of_unknown_reach_runs_and_known_pixels_are_kept() -> None:
    class Half(nn.Module):
        calls = 0

        def forward(self, color: Tensor) -> Tensor:
            self.calls += 1
            return color / 2

    model = Half()
    short, whole = pair(Skipping(model))
    frames = sky(wall(0), 90), sky(wall(0), HEIGHT)
    images = [(short(frame), whole(frame)) for frame in frames]
    assert all(torch.equal(a, b) for a, b in images)
    torch.testing.assert_close(images[0][0][..., 90:, :], frames[0].color[..., 90:, :] / 2)
    assert torch.equal(images[0][0][..., :90, :], frames[0].color[..., :90, :])
    assert torch.equal(images[1][0], frames[1].color)
    assert model.calls == 4


def test_one_frame_and_the_last_one_are_not_remembered() -> None:
    denoiser = Denoiser(cascade())
    for frames, kept in ((1, [False]), (3, [True, True, False]), (None, [True, True, True])):
        denoiser.reset(frames=frames)
        for number, keeps in enumerate(kept):
            denoiser(wall(number))
            assert (stage(denoiser, "remember").skipped == 0) is keeps
            assert (denoiser._state is not None) is keeps


def test_noise_fog_and_detail_are_left_to_the_network() -> None:
    frame = sky(wall(0), 90)
    for strength in (0.05, 1.0):
        noisy = frame.color * (1 + strength * (draw(7) - 0.5))
        assert noise_free(frame.replace(color=noisy)) is None
    speck = frame.color.clone()
    speck[..., 40, 100] *= 2
    free = noise_free(frame.replace(color=speck))
    assert not free[..., 32:48, 92:112].any()
    assert free[..., :16, :].all()


def test_an_emitter_is_copied_and_a_mirror_that_shows_noise_is_not() -> None:
    frame = wall(0)
    assert noise_free(frame) is None
    albedo, color = frame.albedo.clone(), frame.color.clone()
    albedo[..., 20:60, 20:60] = 0
    albedo[..., 100:140, 20:60] = 0
    color[..., 20:60, 20:60] = 12.0
    free = noise_free(frame.replace(albedo=albedo, color=color))
    assert free[..., 20:60, 20:60].all()
    assert free.sum() == 40 * 40
    # A black hole may only have met no light yet.
    color[..., 20:60, 20:60] = 0
    assert noise_free(frame.replace(albedo=albedo, color=color)) is None


def test_a_few_pixels_prove_nothing() -> None:
    frame = wall(0)
    depth = frame.depth.clone()
    depth[..., 50:58, 60:68] = torch.inf
    color = torch.where(depth == torch.inf, 0.5, frame.color)
    assert noise_free(frame.replace(depth=depth, color=color)) is None


def relative(a: Tensor, b: Tensor) -> float:
    return float((a - b).square().mean().sqrt() / b.mean())


def test_noise_is_estimated_as_it_is() -> None:
    alpha_min = 0.05
    for count in (12, 60):
        shot = Shot(alpha_min=alpha_min)
        for number in range(count):
            seen = shot.update(wall(number).replace(albedo=None, color=0.9 + 0.2 * draw(number)))
        actual = relative(seen.color, torch.ones(1))
        for tolerance, passes in ((actual * 0.7, False), (actual * 1.5, True)):
            passed = Skipping(Same(), tolerance, alpha_min)._converged(*seen[:3], None)
            assert passed.numel() == 35
            assert bool(passed.all() if passes else passed.any()) is passes


def edited(number: int, moved: bool) -> Frame:
    """A viewport: the same, almost clean image again and again, until a box is put into the corner."""
    frame = wall(0, 0.2)
    if not moved:
        return frame
    albedo, color = frame.albedo.clone(), frame.color.clone()
    albedo[..., 10:30, 20:50] = 0.9
    color[..., 10:30, 20:50] = 0.45 + 0.1 * number / 30
    return frame.replace(albedo=albedo, color=color)


def test_only_edited_parts_are_computed_again() -> None:
    short, whole = pair(small("wild_small"), tolerance=1e-3)
    fractions, errors = [], []
    for number in range(20):
        frame = edited(number, number >= 17)
        image, expected = short(frame), whole(frame)
        errors.append(relative(image, expected))
        fractions.append(stage(short, "unchanged tiles").skipped)
    # A frame that is repeated has the noise it has; its fraction of the average still changes at first.
    assert set(fractions[:15]) == {0}
    assert fractions[15:17] == [1, 1]
    # The box lies in the first two of 5 x 7 tiles; four more on each side see it.
    assert fractions[17:] == [pytest.approx(1 - 5 * 6 / 35)] * 3
    assert errors[:15] == [0] * 15
    assert max(errors) < 1e-3


def test_everything_is_computed_again_where_a_feature_comes_or_goes() -> None:
    denoiser = Denoiser(small("wild_small"))
    frame = wall(0, 0.2, (64, 96))
    for _ in range(17):
        denoiser(frame)
    assert stage(denoiser, "unchanged tiles").skipped == 1
    for other in (frame.replace(normal=None), frame):
        denoiser(other)
        assert stage(denoiser, "unchanged tiles").skipped == 0


def test_a_tile_does_not_switch_to_and_fro() -> None:
    """The noise of every tile hovers about the tolerance: it leaves once, and comes back never."""
    noise, frames, alpha_min = 0.02, 60, 0.1
    # This is the deviation of uniform noise in the exponential window.
    expected = noise / 12**0.5 * (alpha_min / (2 - alpha_min)) ** 0.5
    changes = {}
    for name, hysteresis in (("with", 2.0), ("without", 1.0)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("mcdenoise.models.skipping._NOISE_HYSTERESIS", hysteresis)
            shot, skipping, states = Shot(alpha_min=alpha_min), Skipping(Same(), expected, alpha_min), [None]
            for number in range(frames):
                seen = shot.update(wall(number).replace(albedo=None, color=1 + noise * (draw(number) - 0.5)))
                states.append(skipping._converged(*seen[:3], states[-1]))
            states = states[1:]
        changes[name] = sum((a != b).sum() for a, b in pairwise(states))
    assert changes["without"] > 100
    # Each of the 35 tiles at most once.
    assert changes["with"] <= 35
    assert states[-1].numel() == 35


def test_a_cut_and_a_moving_camera_compute_everything_again() -> None:
    denoiser = Denoiser(cascade())
    for number in range(12):
        denoiser(wall(number, 0.003))
    assert stage(denoiser, "converged tiles").skipped == 1
    assert stage(denoiser, "network").skipped == 1
    denoiser(wall(0, 0.0, motion=torch.full((1, 2, HEIGHT, WIDTH), 0.5)))
    assert stage(denoiser, "network").skipped == 0
    for number in range(12):
        denoiser(wall(number, 0.003))
    assert stage(denoiser, "network").skipped == 1
    cut = wall(0, 0.0)
    denoiser(cut.replace(normal=-cut.normal))
    assert denoiser.report.reset == "cut"
    assert stage(denoiser, "network").skipped == 0


def shot_of(model: Any, frames: list[Frame], **hints: bool) -> tuple[list[Output], FrameReport]:
    """Images of a shot, and what was reported of its last frame."""
    state, outputs = None, []
    for frame in frames:
        output, state = model(frame.replace(hints=frame.hints._replace(**hints)), state)
        outputs.append(output)
    return outputs, report_of(outputs[-1])


def test_only_tiles_with_noise_are_computed() -> None:
    frame, toy = sky(wall(0), 90), Blur()
    model = Skipping(Tiled(toy))
    expected, _ = Blur()(frame)
    [output], report = shot_of(model, [frame])
    assert torch.equal(output.image[..., 90:, :], expected.image[..., 90:, :])
    assert torch.equal(output.image[..., :90, :], frame.color[..., :90, :])
    # It reads the rows from 64, a multiple of 32, and the two rows above them.
    assert toy.pixels == (HEIGHT - 64 + 2) * WIDTH
    assert report.stages["network"].skipped == pytest.approx(64 / HEIGHT)
    assert report.stages["noise-free pixels"] == Stage(
        "noise-free pixels", pytest.approx(90 / HEIGHT), "background and emitters are copied"
    )
    toy.pixels = 0
    frame = sky(wall(0), HEIGHT)
    [output], report = shot_of(model, [frame])
    assert torch.equal(output.image, frame.color)
    assert (toy.pixels, report.stages["network"].skipped) == (0, 1)


def test_a_batch_needs_what_any_of_its_images_needs() -> None:
    upper, lower = sky(wall(0), 96), sky(wall(1), HEIGHT)
    toy = Blur()
    both = Frame(**{name: torch.cat([value, getattr(lower, name)]) for name, value in upper.items()})
    [output], _ = shot_of(Skipping(Tiled(toy)), [both])
    assert toy.pixels == (HEIGHT - 96 + 2) * WIDTH
    for index, frame in enumerate((upper, lower)):
        [alone], _ = shot_of(Skipping(Tiled(Blur())), [frame])
        torch.testing.assert_close(output.image[index], alone.image[0], rtol=1e-6, atol=1e-7)


def test_reused_and_passed_tiles_of_a_toy_are_not_computed() -> None:
    toy = Blur()
    model = Accumulated(Skipping(Tiled(toy)))
    # One tile in which a lamp flickers, the rest has next to no noise: passed through once that is known.
    frames = []
    for number in range(12):
        color = 1 + 0.002 * (draw(number) - 0.5)
        color[..., 130:140, 200:210] = 1 + draw(number)[..., :10, :10]
        frames.append(wall(0).replace(color=color, albedo=None))
    outputs, report = shot_of(model, frames)
    assert report.stages["converged tiles"].skipped == pytest.approx(34 / 35)
    assert not report.stages["converged tiles"].exact
    last = outputs[-1]
    assert torch.equal(last.image[..., :128, :], last.stages["accumulated"][..., :128, :])
    assert not torch.equal(last.image[..., 128:, 192:], last.stages["accumulated"][..., 128:, 192:])
    # The tile, and the two pixels around it that it looks at where the image goes on.
    counts = toy.pixels
    toy.pixels = 0
    shot_of(model, frames[:-1])
    assert counts - toy.pixels == 34 * 34
    # A renderer at rest repeats its frame: its noise cannot be told, but nothing changes any more.
    toy.pixels, repeated = 0, [wall(0).replace(albedo=None)] * 20
    outputs, report = shot_of(model, repeated)
    assert report.stages["unchanged tiles"].skipped == 1
    assert report.stages["network"].skipped == 1
    assert toy.pixels == 15 * HEIGHT * WIDTH
    assert torch.equal(outputs[-1].image, outputs[14].image)


def test_a_recurrent_method_keeps_its_state_beside_skipped_pixels() -> None:
    """Where there is no state, it is as it is without; at a cut it begins anew, and so does the stored image."""
    frames = [wall(number) for number in range(10)]
    frames.append(frames[-1].replace(normal=-frames[-1].normal))
    outputs, report = shot_of(Accumulated(Skipping(Mean()), alpha_min=1.0), frames)
    assert report.reset == "cut"
    expected, _ = shot_of(Accumulated(Mean(), alpha_min=1.0), frames)
    for output, other in zip(outputs, expected, strict=True):
        torch.testing.assert_close(output.image, other.image)
    watching = Watching()
    shot_of(Accumulated(Skipping(watching)), frames)
    assert [state is None for state in watching.states] == [True, *[False] * 9, True]


def test_the_state_has_a_batch() -> None:
    """Splitting a batch splits its state."""
    frames = [wall(number, 0.003) for number in range(12)]
    both = [
        Frame(**{name: value.repeat(2, *[1] * (value.dim() - 1)) for name, value in frame.items()}) for frame in frames
    ]
    model, state = Demodulated(Accumulated(Skipping(Tiled(Blur())))), None
    for frame in both:
        _, state = model(frame, state)
    leaves = [leaf for leaf in pytree.tree_leaves(state) if leaf is not None]
    assert len(leaves) > 6
    assert {len(leaf) for leaf in leaves} == {2}
    taken = pytree.tree_map_only(Tensor, lambda leaf: leaf[1:], state)
    expected, _ = model(both[-1], state)
    alone, _ = model(frames[-1], taken)
    torch.testing.assert_close(alone.image, expected.image[1:])


@pytest.mark.slow
def test_deciding_costs_less_than_a_hundredth_of_the_saved_time() -> None:
    size = (720, 1280)
    short, whole = (Denoiser("wild", keep_all=keep_all) for keep_all in (False, True))
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


def test_a_summary_counts_fractions_and_tells_why() -> None:
    frames = [
        [Stage("reproject", 0, "positions"), Stage("network", 0.5, "half")],
        [Stage("reproject", 1, "still"), Stage("network", 0.25, "quarter"), Stage("tiles", 0.5, "noise", exact=False)],
        [Stage("reproject", 1, "still"), Stage("network", 0.5, "half")],
    ]
    assert summarize(frames) == [
        {"stage": "reproject", "kept": True, "skipped": pytest.approx(2 / 3), "reason": "still", "exact": True},
        {"stage": "network", "kept": True, "skipped": pytest.approx(1.25 / 3), "reason": "half", "exact": True},
        {"stage": "tiles", "kept": True, "skipped": pytest.approx(0.5 / 3), "reason": "noise", "exact": False},
    ]
