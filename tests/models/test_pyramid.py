"""The pyramid's own equations; what every model promises is tested in test_models.py."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from mcdenoise.frame import Frame
from mcdenoise.models import Accumulated, Output, create_model
from mcdenoise.models.accumulated import ALBEDO_HISTORY
from mcdenoise.models.pyramid import _PARTS, PyramidNetwork, _inside, _ratio

SIZE = (21, 34)


def frame_of(color: Tensor, **buffers: Tensor) -> Frame:
    normal = torch.zeros_like(color)
    normal[:, 2] = 1
    depth = torch.ones_like(color[:, :1])
    return Frame(color=color, normal=normal, depth=depth, **buffers)


def network(seed: int = 0, half: bool = False) -> PyramidNetwork:
    """A network that predicts anything, in float64."""
    torch.manual_seed(seed)
    net = PyramidNetwork((4, 6, 8), 3, half).double()
    with torch.no_grad():
        for head in net.heads:
            head.weight.normal_()  # type: ignore[operator]
    return net


@pytest.mark.parametrize("half", [False, True])
def test_pixels_are_weighted_means_times_a_bounded_factor(half: bool) -> None:
    """Without an albedo, pixels of an image between 1 and 2 become 1 / e to 2 e, whatever the network predicts."""
    color = 1 + torch.rand(1, 3, *SIZE, dtype=torch.float64)
    image = network(half=half)(frame_of(color))[0].image
    assert image.min() >= 1 / torch.e
    assert image.max() <= 2 * torch.e
    assert image.std() > 0.01


def test_no_light_of_another_color_appears() -> None:
    """Each channel is filtered by itself: one that is black stays black."""
    color = torch.rand(1, 3, *SIZE, dtype=torch.float64)
    color[:, 1] = 0
    image = network()(frame_of(color))[0].image
    assert image[:, 1].abs().max() == 0
    assert image[:, 0].min() > 0


def test_the_effective_albedo_of_a_coat_takes_its_grain_away() -> None:
    """``m D + S`` over ``m + t (1 - m)`` is ``D / (1 - t)`` everywhere if ``t / (1 - t) = S / D``."""
    albedo = torch.rand(1, 3, *SIZE, dtype=torch.float64) * 0.9 + 0.05
    matt, coat = 2.0, 3.0
    demodulated = (albedo * matt + coat) / albedo
    t = torch.tensor(coat / (matt + coat), dtype=torch.float64)
    filtered = demodulated * _ratio(albedo, albedo, 1 - t)
    torch.testing.assert_close(filtered, torch.full_like(filtered, matt / (1 - t)), rtol=1e-14, atol=0)


def test_the_ratio_of_albedos_leaves_matt_light_alone() -> None:
    albedo = torch.rand(1, 3, *SIZE, dtype=torch.float64) + 0.05
    ones = torch.ones((), dtype=torch.float64)
    assert torch.equal(_ratio(albedo, albedo, ones), torch.ones_like(albedo))
    assert torch.equal(_ratio(albedo, albedo, 0 * ones), albedo)


def test_weights_are_never_zero_or_one() -> None:
    worth = _inside(torch.tensor([-1e30, 0.0, 1e30]))
    assert worth.tolist() == pytest.approx([1e-3, 0.5, 1 - 1e-3], rel=1e-6)


def test_the_network_chooses_between_history_and_frame() -> None:
    """Heads whose weights are zero predict their biases: with that of the history far up or down, one is not seen."""
    net = network()
    with torch.no_grad():
        for head in net.heads:
            head.weight.zero_()  # type: ignore[operator]
    bias = net.heads[0].bias
    color, current = (torch.rand(1, 3, *SIZE, dtype=torch.float64) for _ in range(2))
    place = net.channels[0] + 1
    for logit, seen in ((1000.0, color), (-1000.0, current)):
        with torch.no_grad():
            bias[place] = logit  # type: ignore[index,operator]
        statistics = net.statistics(frame_of(seen))
        chosen = net(frame_of(color, current=current).replace(statistics=statistics))[0].image
        alone = net(frame_of(seen).replace(statistics=statistics))[0].image
        torch.testing.assert_close(chosen, alone, rtol=1e-12, atol=0)


def test_layers_are_filtered_with_the_weights_of_the_color() -> None:
    """Two layers that are fixed parts of the color stay these parts."""
    color = torch.rand(1, 3, *SIZE) + 0.1
    albedo = torch.rand(1, 3, *SIZE) * 0.9 + 0.05
    layers = {"diffuse": 0.25 * color, "glossy": 0.75 * color}
    torch.manual_seed(0)
    model = create_model("pyramid", width=4)
    frame = frame_of(color, albedo=albedo).replace(layers=layers)
    output = model(frame)[0]
    torch.testing.assert_close(output.layers["diffuse"], 0.25 * output.image, rtol=1e-5, atol=0)
    torch.testing.assert_close(output.layers["diffuse"] + output.layers["glossy"], output.image, rtol=1e-5, atol=0)


def test_radiance_of_any_unit_gives_the_same_picture() -> None:
    color = torch.rand(1, 3, *SIZE, dtype=torch.float64)
    net = network()
    once, more = (net(frame_of(color * unit))[0].image / unit for unit in (1.0, 1024.0))
    torch.testing.assert_close(once, more, rtol=1e-10, atol=0)


@pytest.mark.parametrize("level", [0.0, 1e-30, 1e30])
def test_gradients_are_finite_at_any_level(level: float) -> None:
    torch.manual_seed(0)
    net = PyramidNetwork((4, 6, 8), 3)
    color = (torch.rand(1, 3, *SIZE) * level).requires_grad_()
    (net(frame_of(color))[0].image / max(level, 1)).sum().backward()
    assert all(torch.isfinite(parameter.grad).all() for parameter in net.parameters() if parameter.grad is not None)
    assert color.grad is not None
    assert torch.isfinite(color.grad).all()


def test_the_albedo_of_what_is_multiplied_back_may_be_that_of_the_history() -> None:
    """The surface is matt and the albedo's logit far up: the texture is that of the history."""
    net = network()
    with torch.no_grad():
        for head in net.heads:
            head.weight.zero_()  # type: ignore[operator]
        # The logits of the history (the second of three) and of light that is not matt are set.
        for place, logit in ((3, 1000.0), (sum(list(_PARTS.values())[:3]), -1000.0)):
            net.heads[0].bias[net.channels[0] + place] = logit  # type: ignore[index,operator]
    noisy, history = (torch.rand(1, 3, *SIZE, dtype=torch.float64) * 0.9 + 0.05 for _ in range(2))
    light = torch.ones_like(noisy)
    frame = frame_of(light, albedo=noisy).replace(extra={ALBEDO_HISTORY: history})
    # The frame's radiance is without albedo; what is done afterwards multiplies that of the frame.
    torch.testing.assert_close(net(frame)[0].image * noisy, history, rtol=1e-10, atol=0)


def test_an_albedo_has_a_history_of_its_own() -> None:
    """For a still frame, it is the mean of three frames, as the radiance is."""

    class Seen:
        needs = PyramidNetwork((4, 6, 8), 3).needs

        def __call__(self, frame: Frame, state: None = None) -> tuple[Output, None]:
            self.frame = frame
            return Output(frame.color), None

    seen, state = Seen(), None
    model = Accumulated(seen, lag_threshold=math.inf, firefly_limit=math.inf, also=("albedo",))
    albedos = [torch.rand(1, 3, *SIZE) for _ in range(3)]
    motion = torch.zeros(1, 2, *SIZE)
    for albedo in albedos:
        _, state = model(frame_of(torch.ones(1, 3, *SIZE), albedo=albedo, motion=motion), state)
    expected = sum(albedos) / 3
    torch.testing.assert_close(seen.frame.extra[ALBEDO_HISTORY], expected)
    assert torch.equal(seen.frame.albedo, albedos[-1])  # type: ignore[arg-type]
