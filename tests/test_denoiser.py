"""Streaming frames through a denoiser, and whole sequences to files."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from refusals import refused
from torch import Tensor, nn
from torch.utils import _pytree as pytree
from toys import Mean, Same, small

from mcdenoise import Denoiser, Frame, create_model
from mcdenoise.data import open_sequence
from mcdenoise.models import Accumulated, Chain, Demodulated, Output
from mcdenoise.models._wrapper import parts_of


@pytest.fixture
def frames(small_sequence: Path) -> list[Frame]:
    sequence = open_sequence(small_sequence)
    return [sequence.frame(number) for number in sequence.numbers]


class Keep(nn.Module):
    def forward(
        self, color: Tensor, albedo: Tensor | None = None, normal: Tensor | None = None, depth: Tensor | None = None
    ) -> Output:
        self.seen = {"color": color, "albedo": albedo, "normal": normal, "depth": depth}
        return Output(color, {"initial": color * 2})


def test_missing_features_are_told() -> None:
    network = Keep()
    denoiser = Denoiser(network)
    denoiser(Frame(color=torch.rand(1, 3, 9, 7)))
    assert denoiser.report.missing == ["albedo", "depth", "normal"]
    assert [network.seen[name] for name in ("albedo", "normal", "depth")] == [None] * 3
    denoiser(Frame(color=torch.rand(1, 3, 9, 7), normal=torch.zeros(1, 3, 9, 7)))
    assert denoiser.report.missing == ["albedo", "depth"]
    # Motion is one missing buffer, whichever buffers could provide it.
    denoiser = Denoiser(small("cascaded"))
    denoiser(Frame(color=torch.rand(1, 3, 9, 7)))
    assert denoiser.report.missing == ["albedo", "depth", "motion", "normal"]
    assert "\nmissing: albedo, depth, motion, normal\n" in str(denoiser.report)
    position, camera = torch.rand(1, 3, 9, 7), torch.eye(4)[None]
    denoiser(Frame(color=torch.rand(1, 3, 9, 7), position=position, view_projection=camera))
    assert denoiser.report.missing == ["albedo", "normal"]


@pytest.mark.parametrize("name", ["albedo", "normal", "depth", "position", "motion"])
def test_an_invalid_feature_is_refused_and_leaves_the_history_unchanged(frames: list[Frame], name: str) -> None:
    denoiser = Denoiser(small("cascaded"))
    denoiser(frames[0])
    given = getattr(frames[1], name)
    broken = torch.zeros_like(frames[1].color[:, :2]) if given is None else given.clone()
    broken[0, 0, 2, 3] = float("nan")
    message = refused(lambda: denoiser(frames[1].replace(**{name: broken})))
    assert f"buffer '{name}'" in message
    assert "row 2, column 3" in message
    after = denoiser(frames[1])
    denoiser.reset()
    denoiser(frames[0])
    assert torch.equal(denoiser(frames[1]), after)


def test_a_network_that_hands_out_bfloat16_still_gives_float32() -> None:
    class Copy(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.conv = nn.Conv2d(3, 3, 1)

        def forward(self, color: Tensor) -> Tensor:
            image = self.conv(color)
            self.seen = image.dtype
            return image.square()

    for buffers in ({}, {"albedo": torch.rand(1, 3, 9, 7)}):
        network = Copy()
        for model in (network, Demodulated(Accumulated(Chain(initial=network, final=network)))):
            output = Denoiser(model, precision="bfloat16").output(Frame(color=torch.rand(1, 3, 9, 7), **buffers))
            assert network.seen == torch.bfloat16
            assert output.image.dtype == torch.float32
            if buffers:
                assert {image.dtype for image in output.stages.values()} == {torch.float32}


@pytest.mark.parametrize("name", ["svgf", "mrkp"])
def test_light_with_and_without_its_albedo_have_no_common_history(frames: list[Frame], name: str) -> None:
    denoiser = Denoiser(name)
    for frame in (*frames[:2], frames[2].replace(albedo=None), frames[3]):
        image, alone = denoiser(frame), Denoiser(name)(frame)
        assert torch.equal(image, alone) is (frame is not frames[1])


def test_images_and_states_share_no_memory() -> None:
    """A method's state may hold the frame and the image themselves."""

    class Last(Same):
        def forward(self, frame: Frame, state: Any = None) -> tuple[Output, Any]:
            image, before = (frame.color, frame.color) if state is None else state
            return Output(image, {"albedo": frame.albedo, "before": before}), (frame.color, image)

    colors = torch.rand(4, 1, 3, 9, 7)
    place, albedo = colors[0].clone(), torch.rand(1, 3, 9, 7)
    same = albedo.clone()
    denoiser, expected = Denoiser(Last()), [colors[0], colors[0], colors[1], colors[2]]
    for color, image, before in zip(colors, expected, [colors[0], *expected], strict=False):
        place.copy_(color)
        output = denoiser.output(Frame(color=place, albedo=albedo))
        assert torch.equal(output.image, image)
        assert torch.equal(output.stages["before"], before)
        assert torch.equal(output.stages["albedo"], same)
        assert torch.equal(place, color)
        for one in (output.image, *output.stages.values()):
            one.fill_(7.0)


def test_a_method_that_raises_in_mid_frame_leaves_the_state_as_it_was(frames: list[Frame]) -> None:
    fails = False

    class Failing(Mean):
        def forward(self, frame: Frame, state: Any = None) -> tuple[Output, Any]:
            result = super().forward(frame, state)
            if fails:
                raise RuntimeError("out of memory")
            return result

    denoiser, expected = Denoiser(Failing()), Denoiser(Mean())
    for frame in frames:
        fails = True
        with pytest.raises(RuntimeError, match="out of memory"):
            denoiser(frame)
        fails = False
        assert torch.equal(denoiser(frame), expected(frame))


BAD: dict[str, tuple[Callable[[Frame, Any], Any], str]] = {
    "shape": (lambda frame, state: (Output(frame.color[..., 1:]), None), "found an image of (1, 3, 9, 6)"),
    "channels": (lambda frame, state: (Output(frame.color[:, :1]), None), "found an image of (1, 1, 9, 7)"),
    "no image": (lambda frame, state: (Output(None), None), "found Output"),
    "integers": (lambda frame, state: (Output(frame.color.long()), None), "found torch.int64"),
    "elsewhere": (lambda frame, state: (Output(frame.color.to("meta")), None), "on cpu, found one on meta"),
    "no output": (lambda frame, state: (frame.color, None), "found Tensor"),
    "nan": (lambda frame, state: (Output(frame.color * torch.nan), None), "NaN or infinite pixels"),
    "infinite": (lambda frame, state: (Output(frame.color / 0), None), "NaN or infinite pixels"),
    "state of text": (lambda frame, state: (Output(frame.color), "state"), "found str"),
    "state of numbers": (lambda frame, state: (Output(frame.color), {"count": 1}), "found int"),
    "state elsewhere": (
        lambda frame, state: (Output(frame.color), {**state, "total": frame.color.to("meta")}),
        "expected a state on cpu, found meta",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_a_result_that_is_none_is_refused_in_one_line_and_not_kept(name: str) -> None:
    step, expected = BAD[name]
    broken = False

    class Breaking(Mean):
        def forward(self, frame: Frame, state: Any = None) -> tuple[Output, Any]:
            return step(frame, state) if broken else super().forward(frame, state)

    denoiser, color = Denoiser(Breaking()), torch.rand(2, 1, 3, 9, 7) + 1
    denoiser(Frame(color=color[0]))
    broken = True
    assert expected in refused(lambda: denoiser(Frame(color=color[1])))
    broken = False
    torch.testing.assert_close(denoiser(Frame(color=color[1])), color.mean(0))


@pytest.mark.parametrize(
    ("first", "second", "same"),
    [
        ({"a": 4}, {"a": 4}, True),
        ({"a": 4}, {"a": 3}, False),
        ({"a": 4}, {"b": 4}, False),
        ((4, 4), (4,), False),
        ((4, None), (4, 4), True),
        ({"a": (4, None)}, {"a": (4, {"b": 3})}, True),
        ({"a": (4, {"b": 3})}, {"a": (4, {"b": 4})}, False),
    ],
)
def test_a_state_keeps_its_structure(first: Any, second: Any, same: bool) -> None:
    """Numbers of axes stand for tensors; what is not there may come and go."""

    class Changing(Same):
        def forward(self, frame: Frame, state: Any = None) -> tuple[Output, Any]:
            shape = second if self.second else first
            return Output(frame.color), pytree.tree_map(lambda n: None if n is None else torch.rand([1] * n), shape)

    model = Changing()
    denoiser, frame = Denoiser(model), Frame(color=torch.rand(1, 3, 9, 7))
    model.second = False
    denoiser(frame)
    model.second = True
    if same:
        assert torch.equal(denoiser(frame), frame.color)
    else:
        assert "expected a state of the same structure as for the frame before" in refused(lambda: denoiser(frame))


def test_settings_are_those_of_the_model(weights: Path) -> None:
    denoiser = Denoiser("wild_small", alpha_min=0.3, anti_lag=False)
    accumulated = next(parts_of(denoiser.model, Accumulated))
    assert (accumulated.alpha_min, accumulated.lag_threshold) == (0.3, float("inf"))
    for make in (lambda: Denoiser("cascaded", width=9), lambda: Denoiser("cascaded", weights=weights, width=9)):
        message = refused(make)
        assert "but alpha_min beside its weights, found width=9; the weights fix width" in message
    assert refused(lambda: Denoiser(Keep(), width=8)) == "width: expected a model's name, found a model"
    assert refused(lambda: Denoiser(Keep(), weights=weights)) == "weights: expected a model's name, found a model"


def test_derivatives_go_through_the_state_and_leave_the_images_as_they_are(frames: list[Frame]) -> None:
    model = small("cascaded")
    color = frames[0].color.clone().requires_grad_()
    ordinary, differentiable = Denoiser(model), Denoiser(model, differentiable=True)
    shot = [frames[0].replace(color=color), *frames[1:]]
    for frame in shot:
        expected, image = ordinary(frame), differentiable(frame)
        assert not expected.requires_grad
        # One step or two of a convolution with its ReLU sum in orders of their own.
        torch.testing.assert_close(image.detach(), expected, rtol=1e-4, atol=1e-5)
    (gradient,) = torch.autograd.grad(image.sum(), color)
    assert torch.isfinite(gradient).all()
    assert gradient.abs().sum() > 0
    assert all(parameter.grad is None for parameter in model.parameters())


def test_a_model_of_ones_own_is_timed_under_its_name_in_any_wrapper(frames: list[Frame]) -> None:
    class Slow(nn.Module):
        def forward(self, color: Tensor) -> Tensor:
            time.sleep(0.03)
            return color

    class SlowStep(Mean):
        def forward(self, frame: Frame, state: Any = None) -> tuple[Output, Any]:
            time.sleep(0.03)
            return super().forward(frame, state)

    for model, name in ((Slow(), "Slow"), (SlowStep(), "SlowStep")):
        for wrapped in (model, Demodulated(model), Chain(first=create_model("noisy"), second=Slow())):
            denoiser = Denoiser(wrapped)
            start = time.perf_counter()
            denoiser(frames[0])
            whole = (time.perf_counter() - start) * 1e3
            times = denoiser.report.milliseconds
            # A sleep is never shorter than it was asked for, and nothing is counted twice.
            assert times["Slow" if isinstance(wrapped, Chain) else name] >= 30
            assert sum(times.values()) <= whole
