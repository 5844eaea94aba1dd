"""The equations of ``oidn_tuned``; what every model promises is tested in test_models.py."""

from __future__ import annotations

import copy
import importlib.util

import pytest
import torch
from toys import frame_of, refused

from mcdenoise.export import Step, traced
from mcdenoise.frame import Frame
from mcdenoise.models import create_model, start_with
from mcdenoise.models.oidn_tuned import _LOGITS, TunedNetwork
from mcdenoise.models.recurrent import PREVIOUS, PREVIOUS_LIGHT, PREVIOUS_WEIGHT
from mcdenoise.nn.oidn import oidn_exposure
from mcdenoise.noise import noise_of
from mcdenoise.ops._steps.transfer import compress, expand

SIZE = (26, 38)
has_oidn = pytest.mark.skipif(
    importlib.util.find_spec("pyoidn") is None, reason="Open Image Denoise is in the extra mcdenoise[oidn]"
)


def network(own: float, logits: tuple[float, ...]) -> TunedNetwork:
    """A network in float64 that predicts the same image and the same logits for every pixel."""
    made = TunedNetwork("small").double().eval()
    predicted = [own] * 3 + [a - b for a, b in zip(logits, _LOGITS, strict=True)]
    with torch.no_grad():
        made.unet.last.weight.zero_()
        made.unet.last.bias.copy_(torch.tensor(predicted, dtype=torch.float64))
    return made


def given(weight: float) -> Frame:
    """A frame with a previous result in both forms, of which this fraction shows the same surface."""
    frame = frame_of(*SIZE).to(torch.float64)
    draws = torch.Generator().manual_seed(1)
    before, light = (torch.rand(1, 3, *SIZE, generator=draws, dtype=torch.float64) for _ in range(2))
    valid = torch.full((1, 1, *SIZE), weight, dtype=torch.float64)
    return frame.replace(extra={PREVIOUS: before, PREVIOUS_LIGHT: light, PREVIOUS_WEIGHT: valid})


@pytest.mark.parametrize("weight", [0.0, 0.3, 1.0])
def test_the_image_is_the_weighted_mean_of_four_images(weight: float) -> None:
    logits, frame = (0.4, -0.2, 0.1, -0.5), given(weight)
    image = network(0.31, logits)(frame)[0].image
    exposure = oidn_exposure(frame.color)
    valid = torch.tensor([1.0, weight, weight, 1.0], dtype=torch.float64)
    parts = torch.softmax(torch.tensor(logits, dtype=torch.float64), 0) * valid
    parts /= parts.sum()
    others = [compress(each * exposure) for each in (frame.extra[PREVIOUS], frame.extra[PREVIOUS_LIGHT], frame.color)]
    expected = parts[0] * 0.31 + parts[1] * others[0] + parts[2] * others[1] + parts[3] * others[2]
    torch.testing.assert_close(image, expand(expected) / exposure, rtol=1e-12, atol=1e-12)


def test_it_returns_a_clean_input_where_it_trusts_the_pixels() -> None:
    frame = given(1.0)
    image = network(0.9, (-1e3, -1e3, -1e3, 1e3))(frame)[0].image
    # Continuous, though not to rounding, where the parts of the transfer function meet.
    torch.testing.assert_close(image, frame.color, rtol=2e-4, atol=1e-9)


def test_before_the_first_frame_there_is_nothing_to_blend_with() -> None:
    frame = given(0.0)
    model = network(0.31, (0.0, 9.0, 9.0, -1e3))
    torch.testing.assert_close(model(frame)[0].image, model(frame.replace(extra={}))[0].image, rtol=1e-12, atol=0)


def test_features_may_be_missing() -> None:
    frame = given(1.0)
    flat = frame.replace(albedo=torch.ones_like(frame.color), normal=torch.zeros_like(frame.color))
    model = TunedNetwork("small").double().eval()
    expected = model(flat)[0].image
    assert torch.equal(model(frame.replace(albedo=None, normal=None))[0].image, expected)
    assert not torch.equal(model(frame)[0].image, expected)


@has_oidn
@pytest.mark.parametrize(("name", "quality"), [("oidn_tuned", "balanced"), ("oidn_tuned_small", "fast")])
def test_it_starts_as_the_library(name: str, quality: str) -> None:
    model, library = create_model(name), create_model("oidn_open", quality=quality)
    assert len(start_with(model, "oidn_open", quality=quality)) == 64
    frame = frame_of(48, 64)
    with torch.no_grad():
        # Without giving back what both smooth.
        image, expected = model.inner(frame)[0].image, library(frame)[0].image
    # The noisy pixels have a weight of e^-7 / (1 + e^-7), on a scale from 0 to 1.
    exposure = oidn_exposure(frame.color)
    difference = (compress(image * exposure) - compress(expected * exposure)).abs().max()
    assert 0 < float(difference) < 1e-3


@has_oidn
def test_it_refuses_to_start_with_a_larger_network() -> None:
    message = refused(lambda: start_with(create_model("oidn_tuned_small"), "oidn_open"))
    assert message.startswith(
        "start_from: expected layer 'unet.encoder.1.0.weight' of 'oidn_open', (48, 32, 3, 3), found"
    )


@pytest.mark.parametrize("weight", [0.0, 0.6])
def test_derivatives(weight: float) -> None:
    torch.manual_seed(0)
    frame = given(weight)
    model = TunedNetwork("small").double().eval()
    color = frame.color[..., :16, :16].clone().requires_grad_()
    cut = frame.crop(slice(0, 16), slice(0, 16))
    statistics = model.statistics(cut)

    def run(color: torch.Tensor) -> torch.Tensor:
        return model(cut.replace(color=color, statistics=statistics))[0].image

    assert torch.autograd.gradcheck(run, (color,), fast_mode=True)
    run(color).sum().backward()
    assert all(weight.grad is not None and weight.grad.isfinite().all() for weight in model.unet.parameters())


def started() -> TunedNetwork:
    """A network in float64 that was changed after its weights were kept."""
    torch.manual_seed(0)
    model = TunedNetwork("small").double().eval()
    model.keep_start()
    with torch.no_grad():
        for weight in model.unet.parameters():
            weight += 0.02 * torch.randn_like(weight)
    return model


def test_the_weights_of_each_image_are_mixed_according_to_its_noise() -> None:
    model, frame = started(), given(0.5)
    noisy, draws = frame.color, torch.Generator().manual_seed(4)
    clean = torch.full_like(noisy, 0.5) + 1e-3 * torch.rand(noisy.shape, generator=draws, dtype=noisy.dtype)
    for color in (noisy, clean):
        level, spread = (float(each) for each in noise_of(color, frame.albedo, frame.normal))
        fraction = max(min(max(1.1 - 2 * level, 0.4), 1) - 0.6 * spread, 0)
        mixed = copy.deepcopy(model)
        with torch.no_grad():
            for weight, start in zip(mixed.unet.parameters(), model.start.buffers(), strict=True):
                weight.copy_((1 - fraction) * weight + fraction * start)
        expected = mixed.train()(frame.replace(color=color))[0].image
        torch.testing.assert_close(model(frame.replace(color=color))[0].image, expected, rtol=1e-10, atol=1e-12)
    parts = [model(frame.replace(color=color))[0].image for color in (noisy, clean)]
    both = frame.map(lambda buffer: torch.cat([buffer, buffer])).replace(color=torch.cat([noisy, clean]))
    together = model(both.replace(extra={name: torch.cat([each] * 2) for name, each in frame.extra.items()}))[0].image
    torch.testing.assert_close(together, torch.cat(parts), rtol=1e-10, atol=1e-12)
    assert not torch.allclose(model.train()(frame)[0].image, parts[0])


def test_the_fraction_follows_from_the_noise() -> None:
    model, draws = started(), torch.Generator().manual_seed(5)
    flat = torch.full((1, 3, 160, 160), 0.5, dtype=torch.float64)
    noise = torch.randn(1, 1, 160, 160, generator=draws, dtype=torch.float64)
    # Pairs of pixels in rows and in columns that share their noise.
    shared = (noise + noise.roll(1, -1)) / 2
    shared = (shared + shared.roll(1, -2)) / 2
    found = []
    for image in (flat, 1 + 0.3 * noise, (3 * noise).exp(), 1 + 0.2 * shared):
        frame = Frame(flat * image, albedo=flat, normal=flat)
        level, spread = (float(each) for each in noise_of(frame.color, frame.albedo, frame.normal))
        fraction = float(model.statistics(frame)["start_fraction"])
        assert fraction == pytest.approx(min(max(1.1 - 2 * level, 0.4), 1) - 0.6 * spread, abs=1e-12)
        found.append(fraction)
    assert found[0] == 1
    assert 0.9 < found[1] < 1
    assert found[2] == 0.4
    assert 0.3 < found[3] < 0.5
    assert float(model.train().statistics(frame)["start_fraction"]) == 0


def test_the_fraction_can_be_set() -> None:
    model, frame = started(), given(0.5)
    model.fraction = 0.0
    own = model(frame)[0].image
    torch.testing.assert_close(own, model.train()(frame)[0].image, rtol=1e-10, atol=1e-12)
    model.eval().fraction = 1.0
    start = model(frame)[0].image
    model.unet.load_state_dict(model.start.state_dict())
    torch.testing.assert_close(start, model.train()(frame)[0].image, rtol=1e-10, atol=1e-12)
    assert not torch.allclose(own, start)
    assert refused(lambda: create_model("oidn_tuned", fraction=1.5)) == "fraction: expected in [0, 1], found 1.5"


def test_a_graph_for_any_number_of_images_has_the_mean_of_their_fractions() -> None:
    model = started().float()
    step = Step(model, {"color", "albedo", "normal"})
    program = traced(step).module()
    shots = [frame_of(*SIZE, seed=seed) for seed in range(2)]
    given = [{name: frame.buffer(name) for name in step.given} for frame in shots]
    both = {name: torch.cat([each[name] for each in given]) for name in given[0]}
    fractions = [float(model.statistics(frame)["start_fraction"]) for frame in shots]
    with torch.no_grad():
        for buffers, fraction in ((given[0], fractions[0]), (both, sum(fractions) / 2)):
            image = program(buffers, {})[0]
            model.fraction = fraction
            torch.testing.assert_close(image, model(Frame(**buffers))[0].image, rtol=1e-4, atol=1e-5)
            model.fraction = None


def test_without_weights_before_the_training_nothing_is_mixed() -> None:
    torch.manual_seed(0)
    model, frame = TunedNetwork("small").double().eval(), given(0.5)
    with torch.no_grad():
        model.unet.last.bias += 0.1
    alone = model.train()(frame)[0].image
    assert torch.equal(model.eval()(frame)[0].image, alone)


def test_the_weights_before_the_training_are_kept_once() -> None:
    model = started()
    start = copy.deepcopy(model.start.state_dict())
    model.keep_start()
    assert all(torch.equal(tensor, start[name]) for name, tensor in model.start.state_dict().items())


@has_oidn
def test_weights_before_the_training_are_those_of_the_library() -> None:
    model, library = create_model("oidn_tuned_small"), create_model("oidn_open", quality="fast")
    start_with(model, "oidn_open", quality="fast")
    network = next(part for part in model.modules() if isinstance(part, TunedNetwork))
    own = library.state_dict()["inner.unet.encoder.1.0.weight"]
    assert float(network.kept) == 1
    assert torch.equal(network.start.encoder[1][0].weight, own)
    # A run that goes on with trained weights keeps those before the first.
    with torch.no_grad():
        network.unet.encoder[1][0].weight.mul_(2)
    start_with(model, "oidn_tuned_small")
    shipped = next(
        part for part in create_model("oidn_tuned_small", pretrained=True).modules() if isinstance(part, TunedNetwork)
    )
    assert torch.equal(network.start.encoder[1][0].weight, shipped.start.encoder[1][0].weight)
    assert not torch.equal(network.unet.encoder[1][0].weight, network.start.encoder[1][0].weight)
