"""The equation of ``wild``, and the weights that it starts with; what every model promises is in test_models.py."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from toys import frame_of, has_oidn

from mcdenoise.frame import Frame
from mcdenoise.models import create_model, start_with
from mcdenoise.models.wild import _LOGITS, _PACE, Trust, WildNetwork
from mcdenoise.nn.oidn import oidn_exposure
from mcdenoise.ops import demodulate, remodulate
from mcdenoise.ops._steps.transfer import compress, expand
from mcdenoise.ops._steps.wild import wild_figures

SIZE = (32, 64)


def given(length: float) -> Frame:
    """A frame with this many frames of history."""
    frame = frame_of(*SIZE).to(torch.float64)
    alone, recent = torch.rand(2, 1, 3, *SIZE, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    length_of_all = torch.full((1, 1, *SIZE), length, dtype=torch.float64)
    if length == 1:
        alone = recent = frame.color
    return frame.replace(current=alone, recent=recent, length=length_of_all)


def network(own: float, logits: tuple[float, ...]) -> WildNetwork:
    """A network in float64 that predicts the same image and the same logits for every pixel."""
    made = WildNetwork().double().eval()
    bias = made.unet.last.bias
    assert bias is not None
    predicted = [own] * 3 + [(a - b) / _PACE for a, b in zip(logits, _LOGITS, strict=True)]
    with torch.no_grad():
        made.unet.last.weight.zero_()
        bias.zero_()[:7] = torch.tensor(predicted, dtype=torch.float64)
        made.trust.last.weight.zero_()
        # Weights of the history, and of its older frames.
        made.trust.last.bias.copy_(torch.tensor([0.7, 0.4], dtype=torch.float64).logit() / _PACE)
    return made


@pytest.mark.parametrize("length", [1.0, 3.0, 9.0, None])
def test_the_image_is_the_weighted_mean_of_four_images(length: float | None) -> None:
    logits, frame = (0.4, -0.2, 0.1, -0.5), given(length or 1)
    frame = frame if length else frame.replace(length=None, current=None, recent=None)
    image = network(0.31, logits)(frame)[0].image
    albedo, alone = frame.albedo, frame.color if frame.current is None else frame.current
    assert albedo is not None
    lit, history = (remodulate(each, albedo) for each in (alone, frame.color))
    exposure, part = oidn_exposure(history), 0.0
    if length is not None and frame.recent is not None:
        history = 0.4 * history + 0.6 * remodulate(frame.recent, albedo)
        part = 0.4 * (1 - 1 / length) + 0.6 * (1 - 1 / min(length, 4))
    images = [lit, history, torch.lerp(lit, history, 0.7)]
    weights = torch.softmax(torch.tensor(logits, dtype=torch.float64), 0) * torch.tensor(
        [1, part, part, 1], dtype=torch.float64
    )
    weights /= weights.sum()
    expected = 0.31 * weights[0] + sum(w * compress(x * exposure) for w, x in zip(weights[1:], images, strict=True))
    torch.testing.assert_close(image, demodulate(expand(expected) / exposure, albedo), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("which", [0, 1], ids=["frame", "recent"])
def test_the_weights_of_the_history_tell_late_light_from_noise(which: int) -> None:
    """The figures, not the weights, which are random: noise of single pixels, or another mean of the whole block."""
    torch.manual_seed(0)
    trust, flat = Trust().double(), torch.full((1, 3, *SIZE), 0.5, dtype=torch.float64)
    length, noise = torch.full_like(flat[:, :1], 10), 0.1 * torch.ones_like(flat)
    noise[..., ::2] *= -1

    def weight(image: torch.Tensor) -> torch.Tensor:
        images = [flat, flat, flat]
        images[which] = image
        logits: torch.Tensor = trust(wild_figures(*images, None, None, length, torch.ones_like(flat[..., :1, :1])))
        return logits

    assert weight(flat).shape == (1, 2, SIZE[0] // 4, SIZE[1] // 4)
    torch.testing.assert_close(weight(flat + noise), weight(flat - noise))
    assert not torch.allclose(weight(flat + noise), weight(flat + 0.1))


@pytest.mark.parametrize(("albedo", "alike"), [(0.0, True), (0.3, False)], ids=["sky", "fog"])
def test_a_sky_is_taken_from_the_frame_alone(albedo: float, alike: bool) -> None:
    frame = given(9)
    frame = frame.replace(depth=torch.full_like(frame.length, torch.inf), albedo=torch.full_like(frame.color, albedo))
    model = network(0.31, (-0.2, 0.4, 0.5, 0.1))
    exposed = model.statistics(frame)
    first, second = (
        model(frame.replace(color=color, statistics=exposed))[0].image for color in (frame.color, 2 * frame.color)
    )
    assert torch.equal(first, second) == alike


@has_oidn
def test_it_starts_as_the_library() -> None:
    model: Any = create_model("wild", features="clean")
    library = create_model("oidn_open", quality="balanced")
    assert len(start_with(model, "oidn_open", quality="balanced")) == 64
    frame = frame_of(48, 64)
    with torch.no_grad():
        image, expected = model.eval()(frame)[0].image, library(frame)[0].image
    exposure = oidn_exposure(frame.color)
    difference = (compress(image * exposure) - compress(expected * exposure)).abs().max()
    # The radiance has a weight of e^-7 / (1 + e^-7), on a scale from 0 to 1.
    assert float(difference) < 0.002
