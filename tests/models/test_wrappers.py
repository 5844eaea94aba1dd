"""Wrappers of any method: demodulation, exposure, another method before it, lower resolutions."""

import itertools
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from toys import Blur, Brightest, Mean, Same, Watching, frame_of, still

from mcdenoise.errors import InputError
from mcdenoise.frame import Frame, Hints, Skip
from mcdenoise.models import (
    Accumulated,
    Chain,
    Demodulated,
    Exposed,
    Needs,
    Output,
    Restored,
    Skipping,
    Tiled,
    Wrapper,
)
from mcdenoise.models._interface import prepared
from mcdenoise.models._wrapper import FromBuffers
from mcdenoise.models.recurrent import Recurrent
from mcdenoise.nn import auto_exposure
from mcdenoise.ops import demodulate, remodulate


def double(color: Tensor) -> Tensor:
    return 2 * color


class Staged(Same):
    """Twice the color, by way of half of it."""

    def forward(self, frame: Frame, state: Any = None) -> tuple[Output, Any]:
        return Output(2 * frame.color, {"half": frame.color / 2}), None


WRAPPERS: dict[str, Callable[[Any], Any]] = {
    "nothing": Wrapper,
    "demodulated": Demodulated,
    "exposed": Exposed,
    "accumulated": Accumulated,
    "restored": Restored,
    "skipping": Skipping,
    "tiled": Tiled,
    "chain": lambda inner: Chain(only=inner),
}
# Exposures divide what they have multiplied.
ROUNDING = {"rtol": 1e-5, "atol": 1e-6}


@pytest.mark.parametrize("name", WRAPPERS)
def test_a_wrapper_of_the_identity_returns_the_image(name: str) -> None:
    frame = frame_of(24, 40, batch=2)
    output, _ = WRAPPERS[name](Same())(frame)
    torch.testing.assert_close(output.image, frame.color, **ROUNDING)


@pytest.mark.parametrize(
    ("outer", "inner"), [pair for pair in itertools.product(WRAPPERS, repeat=2) if pair != ("exposed", "accumulated")]
)
def test_a_chain_of_one_method_is_that_method(outer: str, inner: str) -> None:
    """This holds also if the method's pixels depend on statistics, which are those of its own input."""
    frame = frame_of(40, 48)
    model = WRAPPERS[outer](WRAPPERS[inner](Brightest()))
    expected, _ = model(frame)
    output, _ = Chain(only=model)(frame)
    torch.testing.assert_close(output.image, expected.image, **ROUNDING)


@pytest.mark.parametrize("name", ["nothing", "demodulated", "exposed", "chain"])
def test_wrappers_pass_on_statistics_of_the_whole_image(name: str) -> None:
    frame = frame_of(64, 96)
    whole, _ = WRAPPERS[name](Brightest())(frame)
    for model in (Tiled(WRAPPERS[name](Brightest()), 32), WRAPPERS[name](Tiled(Brightest(), 32))):
        output, _ = model(frame)
        torch.testing.assert_close(output.image, whole.image, **ROUNDING)


@pytest.mark.parametrize("name", ["nothing", "demodulated", "exposed", "skipping", "chain"])
def test_a_wrapper_keeps_the_state_of_its_method(name: str) -> None:
    model, state, colors = WRAPPERS[name](Mean()), None, torch.rand(3, 1, 3, 8, 8)
    for number, color in enumerate(colors, start=1):
        # Exposed anew in each frame, a mean is that of exposed ones.
        expected = color if name == "exposed" else colors[:number].mean(0)
        output, state = model(Frame(color), state)
        if name != "exposed":
            torch.testing.assert_close(output.image, expected)
        assert state is not None


def test_needs_go_outwards() -> None:
    inner = Same()
    inner.needs = Needs(frozenset({"color", "roughness"}), frozenset({"alpha"}), trainable=True, reach=3, stride=4)
    for model in (Wrapper(inner), Exposed(inner), Skipping(inner), Tiled(inner)):
        assert model.needs == inner.needs
    assert Demodulated(inner).needs == Needs(inner.needs.buffers, frozenset({"alpha", "albedo"}), True, 3, 4)
    chain = Chain(first=Blur(), second=inner)
    assert chain.needs == Needs(frozenset({"color", "roughness"}), frozenset({"alpha", "albedo"}), True, 5, 4)
    assert Chain(first=Blur(), second=FromBuffers(double)).needs.reach is None


def test_demodulated_light_contains_no_albedo() -> None:
    watching, frame = Watching(), frame_of(9, 7, variance=torch.rand(1, 3, 9, 7))
    samples = torch.cat([frame.color, torch.ones(1, 2, 9, 7)], 1)[:, None].repeat(1, 3, 1, 1, 1)
    frame = frame.replace(current=frame.color / 2, diffuse=frame.color / 3, specular=frame.color / 4, samples=samples)
    output, _ = Demodulated(watching)(frame)
    seen = watching.frames[0]
    assert torch.equal(seen.color, demodulate(frame.color, frame.albedo))
    assert torch.equal(seen.current, demodulate(frame.color / 2, frame.albedo))
    assert torch.equal(seen.diffuse, demodulate(frame.color / 3, frame.albedo))
    # The light of a coat is not divided, nor is anything that a sample holds beside its radiance.
    assert seen.specular is frame.specular
    for sample in seen.samples.unbind(1):
        torch.testing.assert_close(sample[:, :3], seen.color)
        assert torch.equal(sample[:, 3:], torch.ones(1, 2, 9, 7))
    # Var(x / a) = Var(x) / a^2, with the divisor of the color.
    divisor = frame.color / demodulate(frame.color, frame.albedo)
    torch.testing.assert_close(seen.variance, frame.variance / divisor.square(), rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(output.image, frame.color)
    assert seen.albedo is frame.albedo


def test_every_image_of_the_result_is_remodulated() -> None:
    frame = frame_of(9, 7)
    output, _ = Demodulated(Staged())(frame)
    light = demodulate(frame.color, frame.albedo)
    torch.testing.assert_close(output.image, remodulate(2 * light, frame.albedo))
    torch.testing.assert_close(output.stages["half"], remodulate(light / 2, frame.albedo))
    output, _ = Demodulated(Staged())(frame.replace(hints=Hints(stages=False)))
    assert output.stages == {}


@pytest.mark.parametrize(
    ("albedo", "reason"),
    [(None, "no albedo"), (1.0, "albedo is one everywhere"), (0.0, "no albedo anywhere"), (5e-5, "no albedo anywhere")],
)
def test_where_there_is_nothing_to_divide_out_nothing_is_done(albedo: float | None, reason: str) -> None:
    watching = Watching()
    frame = frame_of(9, 7)
    frame = frame.replace(albedo=None if albedo is None else torch.full((1, 3, 9, 7), albedo))
    output, _ = Demodulated(watching)(frame)
    assert watching.frames[0].color is frame.color
    assert output.image is frame.color
    assert output.notes[0][:3] == ("demodulate", reason, 1)
    if albedo is not None:
        output, _ = Demodulated(watching)(frame.replace(hints=Hints(keep_all=True)))
        assert output.notes[0].skipped == 0
        torch.testing.assert_close(output.image, frame.color, rtol=0, atol=0)


def test_the_derivative_in_an_albedo_of_one_is_that_beside_it() -> None:
    slopes = []
    for number in (1.0, 1 - 1e-6):
        frame = frame_of(9, 7)
        albedo = torch.full((1, 3, 9, 7), number, requires_grad=True)
        image = Demodulated(Blur())(frame.replace(albedo=albedo))[0].image
        slopes += torch.autograd.grad((image * frame.color).sum(), albedo)
    torch.testing.assert_close(*slopes, rtol=1e-4, atol=1e-4)


def test_a_result_of_half_precision_is_remodulated_in_that_of_the_albedo() -> None:
    frame = frame_of(9, 7)
    assert Demodulated(lambda color: color.bfloat16())(frame)[0].image.dtype == torch.float32


@pytest.mark.parametrize("factor", [1e-3, 7.0, 1e3])
@pytest.mark.parametrize("curve", [torch.log1p, torch.square, lambda color: color.clamp_max(0.5)])
def test_exposed_methods_do_not_depend_on_the_unit_of_radiance(
    curve: Callable[[Tensor], Tensor], factor: float
) -> None:
    """model(s x) = s model(x), whatever the method is."""

    def method(color: Tensor) -> Output:
        return Output(curve(color), {"stage": curve(2 * color)})

    frame, model = frame_of(20, 24, batch=2), Exposed(method)
    expected, _ = model(frame)
    scaled, _ = model(frame.replace(color=factor * frame.color))
    for one, other in ((scaled.image, expected.image), (scaled.stages["stage"], expected.stages["stage"])):
        torch.testing.assert_close(one / factor, other, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(Exposed(model)(frame)[0].image, expected.image, rtol=1e-5, atol=1e-6)
    bare = FromBuffers(method)
    unlike = bare(frame.replace(color=factor * frame.color))[0].image / factor
    assert not torch.allclose(unlike, bare(frame)[0].image, rtol=0.1)


def test_a_method_that_adds_light_adds_none_to_black() -> None:
    frame, model = frame_of(20, 24, batch=2), Exposed(lambda color: Output(color + 1))
    color = frame.color.clone()
    color[1] = 0
    image = model(frame.replace(color=color))[0].image
    assert image[1].max() < 1e-18
    torch.testing.assert_close(image[0], color[0] + 1 / auto_exposure(color)[0])


@pytest.mark.parametrize("history", [Accumulated, Recurrent])
def test_a_history_in_the_exposure_of_earlier_frames_is_refused(history: type[Accumulated | Recurrent]) -> None:
    with pytest.raises(InputError, match=rf"{history.__name__}\(Exposed"):
        Exposed(Demodulated(history(double)))
    history(Exposed(double))


def test_all_radiance_is_exposed_alike_and_variance_by_the_square() -> None:
    watching = Watching()
    frame = frame_of(20, 24, variance=torch.rand(1, 3, 20, 24))
    parts = {name: frame.color / count for count, name in enumerate(("diffuse", "specular", "emission"), 3)}
    samples = torch.cat([frame.color, torch.ones(1, 2, 20, 24)], 1)[:, None]
    frame = frame.replace(
        **parts,
        samples=samples,
        current=frame.color / 2,
        skip=Skip(torch.zeros(1, 1, 20, 24, dtype=torch.bool), 3 * frame.color),
    )
    Exposed(watching)(frame)
    seen, exposure = watching.frames[0], auto_exposure(frame.color)
    # No method inside, such as another wrapper of this kind, exposes it again.
    assert torch.equal(seen.statistics["exposure"], torch.ones_like(exposure))
    torch.testing.assert_close(seen.color, frame.color * exposure)
    torch.testing.assert_close(seen.current, frame.color / 2 * exposure)
    torch.testing.assert_close(seen.variance, frame.variance * exposure.square())
    for name, part in parts.items():
        torch.testing.assert_close(seen.buffer(name), part * exposure)
    torch.testing.assert_close(seen.samples[:, 0, :3], frame.color * exposure)
    assert torch.equal(seen.samples[:, 0, 3:], torch.ones(1, 2, 20, 24))
    torch.testing.assert_close(seen.skip.image, 3 * frame.color * exposure)
    # In a large unit, the square of the exposure is infinite.
    dim = {"color": frame.color * 2.0**-70, "variance": frame.variance * 2.0**-140}
    Exposed(watching)(frame.replace(**dim))
    assert watching.frames[1].variance.isfinite().all()


def test_each_method_sees_the_image_of_the_one_before() -> None:
    frame, watching = frame_of(9, 7), Watching()
    output, state = Chain(first=double, second=Staged(), third=watching)(frame)
    assert torch.equal(output.image, 4 * frame.color)
    assert list(output.stages) == ["first", "second.half", "second"]
    assert torch.equal(output.stages["first"], 2 * frame.color)
    assert torch.equal(output.stages["second.half"], frame.color)
    assert torch.equal(output.stages["second"], 4 * frame.color)
    assert torch.equal(watching.frames[0].color, 4 * frame.color)
    assert watching.frames[0].albedo is frame.albedo
    # States are stored by name, or None if no method has one.
    assert {name: each is None for name, each in state.items()} == {"first": True, "second": True, "third": False}
    Chain(first=double, second=Staged(), third=watching)(frame, state)
    assert torch.equal(watching.states[-1]["seen"], torch.ones_like(frame.color))
    assert Chain(first=double, second=Staged())(frame)[1] is None


def test_statistics_go_down_the_chain_anew_for_each() -> None:
    """A method computes statistics of its own input; those that another found before stay beside them."""
    frame, watching = frame_of(9, 7), Watching()
    Chain(first=Brightest(), second=Exposed(watching))(frame)
    assert watching.frames[0].statistics.keys() == {"brightest", "exposure"}
    output, _ = Chain(first=double, second=Brightest())(frame)
    assert torch.equal(output.image, torch.minimum(4 * frame.color, 2 * frame.color.amax()))
    assert prepared(Chain(first=Brightest(), second=double), frame).statistics["brightest"].item() == frame.color.max()


def test_a_chain_is_tiled_if_no_later_method_depends_on_the_whole_image() -> None:
    frame = frame_of(64, 96)
    for second, divided in (
        (Blur(), True),
        (Demodulated(Blur()), True),
        (Brightest(), False),
        (Exposed(Blur()), False),
    ):
        model = Chain(first=Brightest(), second=second)
        assert (Tiled(model).halo is not None) is divided
        torch.testing.assert_close(Tiled(model, 32)(frame)[0].image, model(frame)[0].image, **ROUNDING)


def test_statistics_are_those_of_the_accumulated_image() -> None:
    watching, color = Watching(), torch.rand(2, 1, 3, 20, 24)
    model = Accumulated(Chain(first=Brightest(), second=watching), lag_threshold=math.inf)
    _, state = model(still(color[0]))
    frame = still(2 * color[1])
    model(frame.replace(statistics=Brightest().statistics(frame)), state)
    seen = color[0] / 2 + color[1]
    torch.testing.assert_close(watching.frames[-1].statistics["brightest"], seen.amax().reshape(1, 1, 1, 1))
    assert prepared(model, frame).statistics == {}


def test_pixels_are_known_of_the_last_image_only() -> None:
    frame, watching = frame_of(9, 7), Watching()
    skip = Skip(torch.rand(1, 1, 9, 7) > 0.5, torch.full_like(frame.color, 9.0))
    Chain(first=watching, second=watching)(frame.replace(skip=skip))
    assert [each.skip for each in watching.frames] == [None, skip]


def test_a_chain_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="methods:"):
        Chain()
