"""Layers that add up: parts of the color are denoised with its kernels, and still sum to the image. And alpha."""

from collections.abc import Mapping
from typing import Any

import pytest
import torch
from refusals import refused
from torch import Tensor, nn
from toys import Same, cascade, frame_of, one_of_each, small, still, whole_frame

from mcdenoise import Denoiser, Frame
from mcdenoise.models import Accumulated, Chain, Demodulated, Exposed, Output, Skipping, Tiled, list_models
from mcdenoise.models._layers import REST, closed, fractions, split
from mcdenoise.models._report import FrameReport
from mcdenoise.models.joint_bilateral import JointBilateral
from mcdenoise.models.noisy import Noisy

OIDN = ("oidn", "oidn_open", "oidn_temporal")
MODELS = one_of_each(list_models())
# For the other methods the library decides on derivatives, or there are none.
DIFFERENTIABLE = [name for name in MODELS if name not in OIDN]
# The history of these is of images, or of hidden features, alone: no layer of a frame reaches the next frame's layers.
HISTORY_OF_IMAGES = ("rae",)
NAMES = ("diffuse", "glossy", "emission")
SIZE = (24, 40)


def shot(model: Any, frames: int = 3, size: tuple[int, int] = SIZE, dtype: torch.dtype = torch.float32) -> list[Frame]:
    """Frames of a wall that moves, in three layers: other parts of each pixel, and one black in half the image."""
    found = []
    for seed in range(frames):
        frame = whole_frame(model, *size, seed=seed).to(dtype)
        drawn = torch.rand(3, *frame.color.shape, generator=torch.Generator().manual_seed(50 + seed)).to(dtype)
        drawn[2, ..., : size[1] // 2] = 0
        # A path tracer finds a layer in some pixels only.
        drawn[1] *= drawn[1] > 0.5
        parts = frame.color * drawn / drawn.sum(0).clamp_min(1e-3)
        alpha = torch.rand(1, 1, *size, generator=torch.Generator().manual_seed(seed)).to(dtype)
        color = parts.sum(0)
        found.append(frame.replace(color=color, layers=dict(zip(NAMES, parts, strict=True)), alpha=alpha))
    return found


def with_layers(frame: Frame, **layers: Tensor) -> Frame:
    return frame.replace(layers=layers)


def assert_sum(image: Tensor, layers: Mapping[str, Tensor]) -> None:
    """``image * (part / total)`` rounds twice, and ``total`` once for each part but the first; the rest is one more."""
    unit = torch.finfo(image.dtype).eps / 2
    error = (torch.stack(list(layers.values())).double().sum(0) - image.double()).abs()
    # Second-order terms are far below one unit more; what is below the smallest normal number has no relative error.
    allowed = (len(layers) + 1 + 2 + 1) * unit * image.double().abs() + torch.finfo(image.dtype).tiny
    assert (error <= allowed).all(), float((error / allowed).max())


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize("name", MODELS)
def test_layers_sum_to_the_image(name: str, precision: Any) -> None:
    denoiser = Denoiser(small(name), precision=precision)
    plain = Denoiser(small(name), precision=precision)
    for frame in shot(denoiser.model):
        output = denoiser.output(frame)
        assert tuple(output.layers) == NAMES
        assert_sum(output.image, output.layers)
        for layer in output.layers.values():
            assert (layer >= 0).all()
        assert "layers" in denoiser.report.stages
        assert not plain.report.stages or "layers" not in plain.report.stages
        # The image is not changed by its layers; kornia's filters sum in another order for more channels.
        torch.testing.assert_close(output.image, plain(frame), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", DIFFERENTIABLE)
def test_layers_sum_to_the_image_in_float64_and_have_derivatives(name: str) -> None:
    model = small(name)
    model = model.double() if isinstance(model, nn.Module) else model
    denoiser = Denoiser(model, differentiable=True)
    first, second = shot(denoiser.model, 2, dtype=torch.float64)
    part = first.layers["glossy"].requires_grad_()
    for frame in (first, second):
        output = denoiser.output(frame)
        assert output.image.dtype == torch.float64
        assert_sum(output.image.detach(), {key: layer.detach() for key, layer in output.layers.items()})
        glossy = output.layers["glossy"].sum()
        if name == "noisy" and frame is second:
            assert not glossy.requires_grad
            continue
        (gradient,) = torch.autograd.grad(glossy, part, retain_graph=True, materialize_grads=True)
        assert torch.isfinite(gradient).all()
        # The second frame's by way of the history; of those the history is of images, or of hidden features, alone.
        assert bool(gradient.any()) is not (name in HISTORY_OF_IMAGES and frame is second)


@pytest.mark.parametrize("leak", [1e-21, 1e-30, 1e-40])
def test_what_a_filter_leaves_of_distant_light_has_derivatives(leak: float) -> None:
    part = torch.tensor([1.0, leak]).repeat(1, 3, 1, 1).requires_grad_()
    layers = split(torch.ones_like(part), {"diffuse": part, "glossy": 3 * part.detach()})
    assert torch.equal(layers["diffuse"], torch.full_like(part, 0.25))
    (slope,) = torch.autograd.grad(layers["diffuse"].square().sum(), part)
    assert torch.isfinite(slope).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_layers_of_tiles_are_those_of_the_image(name: str) -> None:
    whole = Denoiser(small(name))
    if not isinstance(whole.model, nn.Module) or not any(isinstance(part, Tiled) for part in whole.model.modules()):
        pytest.skip("it is not divided")
    tiled = Denoiser(small(name), tile=64)
    for frame in shot(whole.model, 2, (70, 150)):
        expected, found = whole.output(frame), tiled.output(frame)
        assert_sum(found.image, found.layers)
        for key, layer in expected.layers.items():
            # Convolutions of another size sum in another order; logarithms and kernels pass that on.
            torch.testing.assert_close(found.layers[key], layer, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("name", MODELS)
def test_a_layer_that_is_all_is_the_image_and_one_that_is_black_stays_black(name: str) -> None:
    denoiser = Denoiser(small(name))
    for frame in shot(denoiser.model):
        output = denoiser.output(with_layers(frame, all=frame.color, none=torch.zeros_like(frame.color)))
        assert torch.equal(output.layers["all"], output.image)
        assert not output.layers["none"].any()


@pytest.mark.parametrize("name", sorted(set(MODELS) - {"guided", "cascaded", "bmfr"}))
def test_layers_are_denoised_by_a_linear_map(name: str) -> None:
    """Joined before or after, and scaled before or after.

    What the guided filter and block regression lead below zero is cut off, and so is that of a ``cascaded`` without
    training.
    """
    one, other = Denoiser(small(name)), Denoiser(small(name))
    for frame in shot(one.model):
        diffuse, glossy, emission = frame.layers.values()
        parts = one.output(frame).layers
        joined = other.output(with_layers(frame, both=diffuse + glossy, some=emission / 4)).layers
        torch.testing.assert_close(joined["both"], parts["diffuse"] + parts["glossy"], rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(joined["some"], parts["emission"] / 4, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", MODELS)
def test_alpha_is_filtered_with_every_method(name: str) -> None:
    denoiser = Denoiser(small(name), alpha=True)
    kept = Denoiser(small(name))
    for frame in shot(denoiser.model):
        output = denoiser.output(frame)
        assert kept.output(frame).alpha is None
        assert output.alpha.shape == frame.alpha.shape
        assert output.alpha.min() >= 0
        assert output.alpha.max() <= 1
        assert_sum(output.image, output.layers)
    assert output.alpha.std() < 0.9 * frame.alpha.std()


@pytest.mark.parametrize("value", [0.0, 0.7, 1.0])
@pytest.mark.parametrize("name", MODELS)
def test_an_alpha_that_is_the_same_everywhere_stays(name: str, value: float) -> None:
    denoiser = Denoiser(small(name), alpha=True)
    for frame in shot(denoiser.model):
        output = denoiser.output(frame.replace(alpha=torch.full_like(frame.color[:, :1], value)))
        # A mean of up to 17x17 taps, each with a weight that is rounded.
        allowed = 17**2 * torch.finfo(torch.float32).eps / 2 * value
        assert (output.alpha - value).abs().max() <= allowed


def test_stages_are_asked_for_by_themselves() -> None:
    denoiser = Denoiser(cascade())
    frame = shot(denoiser.model, 1)[0]
    assert denoiser.output(frame, stages=False).stages.keys() <= {"accumulated", "initial"}
    denoiser.reset()
    assert next(iter(denoiser.output(frame).stages)) == "noisy"


def test_layers_that_are_no_parts_are_refused() -> None:
    denoiser = Denoiser(Same())
    frame = frame_of(9, 7)
    given = frame.replace(layers={"a": frame.color, "b": frame.color / 10})
    message = refused(lambda: denoiser.output(given))
    assert "expected parts of the color, found a, b brighter than it together, by 9% of their light" in message
    # A call looks at no layer.
    denoiser(given)


def test_layers_that_half_floats_rounded_sum_to_the_color() -> None:
    frame = frame_of(30, 40)
    parts = torch.rand(3, *frame.color.shape)
    layers = {str(i): part.half().float() for i, part in enumerate(frame.color * parts / parts.sum(0))}
    complete = closed(frame.replace(color=frame.color.half().float(), layers=layers), FrameReport().ask)
    assert not complete.layers[REST].any()
    total = torch.stack(list(complete.layers.values())).double().sum(0)
    torch.testing.assert_close(total, complete.color.double(), rtol=8 * 2.0**-24, atol=0)
    # A remainder of more than rounding is a layer of its own.
    dim = closed(frame.replace(layers={"most": 0.99 * frame.color}), FrameReport().ask)
    torch.testing.assert_close(dim.layers[REST], 0.01 * frame.color, rtol=1e-4, atol=1e-6)


def test_the_unit_of_light_does_not_change_its_parts() -> None:
    """Not even where all of it is less than the smallest half float."""
    color = frame_of(*SIZE).color * 2.0**-40
    layers = closed(Frame(color, layers={"diffuse": color / 2}), FrameReport().ask).layers
    assert all(torch.equal(layers[name], color / 2) for name in ("diffuse", REST))
    # Nor where a method without kernels is inside one whose exposure it has, so that the image is split there.
    (given,), model = shot(Noisy(), 1), Exposed(Chain(first=Same(), last=Noisy()))
    brighter = given.replace(color=1024 * given.color, layers={n: 1024 * each for n, each in given.layers.items()})
    parts, others = (model(frame)[0].layers for frame in (given, brighter))
    for name, part in parts.items():
        torch.testing.assert_close(others[name], 1024 * part, rtol=1e-5, atol=1e-6)


def test_other_layers_than_before_are_refused_within_a_shot() -> None:
    denoiser = Denoiser(Demodulated(Accumulated(Noisy())))
    frames = shot(denoiser.model, 2)
    denoiser.output(frames[0])
    message = refused(lambda: denoiser.output(with_layers(frames[1], glossy=frames[1].layers["glossy"])))
    assert message.startswith("layers: expected those of the frame before, diffuse, glossy, emission, found glossy;")
    assert "found none" in refused(lambda: denoiser(frames[1]))
    # Refused, a frame leaves no trace.
    assert_sum((output := denoiser.output(frames[1])).image, output.layers)
    denoiser.reset()
    denoiser(frames[1])


def test_a_pixel_that_is_unusable_in_a_layer_is_replaced_in_all() -> None:
    color = torch.rand(1, 3, 5, 6) + 0.1
    parts = {"a": 0.25 * color, "b": 0.75 * color}
    parts["a"][0, 1, 2, 3] = torch.nan
    parts["b"][0, 0, 0, 0] = -1
    frame, replaced = Frame(color, layers=parts).validate()
    assert replaced == 2
    torch.testing.assert_close(frame.layers["a"] + frame.layers["b"], frame.color)
    torch.testing.assert_close(frame.layers["a"], 0.25 * frame.color)
    around = torch.ones(5, 6, dtype=torch.bool)
    # Where the color is valid, a negative part of it is what it has beyond the others.
    around[2, 3] = False
    assert torch.equal(frame.color[..., around], color[..., around])
    torch.testing.assert_close(
        frame.color[0, :, 2, 3], color[0, :, 1:4, 2:5].flatten(1)[:, [0, 1, 2, 3, 5, 6, 7, 8]].mean(1)
    )


def test_a_layer_that_is_no_radiance_is_refused() -> None:
    color = torch.rand(1, 3, 5, 6)
    assert refused(lambda: Frame(color, layers={"normal": color - 2}).validate()).startswith(
        "layer 'normal': expected rad"
    )
    assert refused(lambda: Frame(color, layers={"a": color[..., 1:]})).startswith(
        "layer 'a': expected shape (1, 3, 5, 6)"
    )
    assert refused(lambda: Frame(color, layers={"a": color.int()})).startswith("layer 'a': expected a floating-point")


@torch.no_grad()
def test_histories_of_layers_have_the_weights_of_the_color_s() -> None:
    """The layer of a still pixel is the mean of the frames, and where a firefly is clamped so is its layer."""
    model = Accumulated(Noisy(), lag_threshold=float("inf"))
    state, glossy = None, []
    for seed in range(4):
        color = 0.5 + torch.rand(1, 3, 20, 24, generator=torch.Generator().manual_seed(seed))
        # Once: light that stays is no firefly.
        color[..., 10, 12] *= 1000 if seed == 2 else 1
        part = color * torch.rand(1, 3, 20, 24, generator=torch.Generator().manual_seed(9 + seed))
        output, state = model(still(color, layers={"glossy": part, "rest": color - part}), state)
        glossy.append(part)
        torch.testing.assert_close(output.layers["glossy"] + output.layers["rest"], output.image)
    expected = torch.stack(glossy).mean(0)
    elsewhere = torch.ones(20, 24, dtype=torch.bool)
    elsewhere[10, 12] = False
    torch.testing.assert_close(output.layers["glossy"][..., elsewhere], expected[..., elsewhere])
    assert (output.layers["glossy"][..., 10, 12] < 0.1 * expected[..., 10, 12]).all()


def test_a_light_that_goes_out_goes_out_of_its_layer() -> None:
    """The test for lag discards a layer's history where it discards that of the color."""
    denoiser = Denoiser("accumulated")
    steady, lamp = torch.full((1, 3, 32, 40), 0.2), torch.ones(1, 3, 32, 40)
    for number in range(20):
        noise = 0.9 + 0.2 * torch.rand(1, 3, 32, 40, generator=torch.Generator().manual_seed(number))
        layers = {"steady": noise * steady, "lamp": noise * lamp * (number < 16)}
        output = denoiser.output(still(layers["steady"] + layers["lamp"], layers=layers))
    # An exponential window of four frames, of which none saw the lamp; a long one would leave two thirds of it.
    assert output.layers["lamp"].mean() < 0.25
    assert_sum(output.image, output.layers)


def test_a_method_without_kernels_is_split_by_filtered_proportions() -> None:
    """Noisy layers of a constant proportion on either side of an edge of the features."""
    height, width = 24, 40
    right = (torch.arange(width) >= 20).expand(1, 3, height, width)
    share = torch.where(right, 0.8, 0.3)
    noise = torch.rand(2, 1, 3, height, width) * 2
    layers = {"a": share * noise[0], "b": (1 - share) * noise[1]}
    frame = Frame(layers["a"] + layers["b"], albedo=right.float(), layers=layers)
    clean = torch.ones_like(frame.color)
    parts = split(clean, fractions(frame, clean))
    error = (parts["a"] - share).abs()
    # Uniform noise in [0, 2] of both parts, over some 80 pixels; unfiltered it is 0.15.
    assert error.mean() < 0.04
    assert error[..., 18:22].mean() < 0.05
    torch.testing.assert_close(parts["a"] + parts["b"], clean)
    denoiser = Denoiser(Layered())
    output = denoiser.output(frame)
    torch.testing.assert_close(output.layers["a"], parts["a"])
    assert denoiser.report.stages["layers"].reason.endswith("the method has no kernels")


class Layered(Same):
    def __init__(self, **layers: Any) -> None:
        super().__init__()
        self.layers = layers

    def forward(self, frame: Frame, state: Any = None) -> tuple[Output, Any]:
        return Output(torch.ones_like(frame.color), layers=self.layers), None


def test_layers_of_a_method_of_your_own() -> None:
    """They are proportions: any unit, and nothing below zero."""
    frame = frame_of(4, 5)
    frame = frame.replace(layers={"a": frame.color / 2})
    black = torch.zeros_like(frame.color)
    output = Denoiser(Layered(**{"a": black + 3, REST: black + 1})).output(frame)
    assert torch.equal(output.layers["a"], black + 0.75)
    output = Denoiser(Layered(**{"a": black - 3, REST: black + 1})).output(frame)
    assert torch.equal(output.layers["a"], black)
    assert "expected the layers a, " in refused(lambda: Denoiser(Layered(b=black)).output(frame))
    assert "expected a as floating-point (1, 3, 4, 5), found" in refused(
        lambda: Denoiser(Layered(**{"a": black[:, :1], REST: black})).output(frame)
    )


def test_where_all_parts_are_black_they_have_their_proportion_of_the_whole() -> None:
    image = torch.rand(1, 3, 4, 5)
    parts = {"a": torch.ones(1, 3, 4, 5), "b": torch.full((1, 3, 4, 5), 3.0)}
    for part in parts.values():
        part[..., 2] = 0
    found = split(image, parts)
    torch.testing.assert_close(found["b"], 0.75 * image)
    nothing = torch.zeros_like(image)
    assert torch.equal(split(image, {"a": nothing, "b": nothing})["a"], image / 2)


@torch.no_grad()
def test_layers_pass_through_every_wrapper() -> None:
    """Scaled and back, without albedo and with it again, in tiles."""
    blur = JointBilateral(sigma_space=1.0)
    frames = shot(blur, 1, (64, 96))[0]
    bare = blur(frames)[0]
    for wrapped in (Exposed(blur), Tiled(blur, 32), Skipping(blur), Accumulated(blur, firefly_limit=float("inf"))):
        output, _ = wrapped(frames)
        for name, layer in output.layers.items():
            torch.testing.assert_close(layer, bare.layers[name], rtol=1e-4, atol=1e-5)
    output, _ = Demodulated(blur)(frames)
    torch.testing.assert_close(sum(output.layers.values(), torch.zeros(())), output.image, rtol=1e-5, atol=1e-6)


def test_where_layers_are_asked_for_no_tile_is_passed_through_or_used_again() -> None:
    denoiser = Denoiser(cascade())
    color = torch.full((1, 3, 40, 304), 0.5)
    for number in range(12):
        part = torch.rand(color.shape, generator=torch.Generator().manual_seed(number)) * color
        output = denoiser.output(still(color, layers={"part": part}))
        assert_sum(output.image, {**output.layers, "rest": output.image - output.layers["part"]})
    stages = denoiser.report.stages
    for name in ("converged tiles", "unchanged tiles"):
        assert (stages[name].skipped, stages[name].reason) == (0, "layers or alpha are asked for")
