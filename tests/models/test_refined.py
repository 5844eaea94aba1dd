"""The equations of Refined; what every model promises is tested in test_models.py."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn
from toys import frame_of, refused

from mcdenoise.frame import Frame, Skip
from mcdenoise.models import Needs, Output, State, create_model, start_with
from mcdenoise.models.refined import _TAPS, Refined

SIZE = (26, 38)


class Seen(nn.Module):
    """Returns the color, and remembers the frame."""

    needs = Needs(trainable=False, reach=0)
    frame: Frame

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        self.frame = frame
        return Output(frame.color, {"stage": frame.color}, dict(frame.layers)), None


def refined(centre: float = 0, coarser: float = 0, diffuse: float = 0, history: float = 0) -> tuple[Refined, Seen]:
    """A wrapper in float64 whose network predicts these logits for every pixel."""
    seen = Seen()
    model = Refined(seen, 4).double().eval()
    for scale, head in enumerate(model.features.inner.heads):  # type: ignore[attr-defined]
        wanted = torch.zeros(head.bias.numel() // head.side**2, dtype=torch.float64)
        wanted[_TAPS // 2] = centre
        wanted[_TAPS : _TAPS + 1] = coarser
        if scale == 0:
            wanted[_TAPS + 1], wanted[_TAPS + 2] = diffuse, history
        with torch.no_grad():
            head.weight.zero_()
            head.bias.copy_(wanted.repeat_interleave(head.side**2))
    return model, seen


def given(seed: int = 0, **buffers: Tensor) -> Frame:
    return frame_of(*SIZE, seed=seed, **buffers).to(torch.float64)


EXACT = {"centre": 1e4, "coarser": -1e4}


def test_exact_features_and_diffuse_light_change_nothing() -> None:
    frame = given()
    model, seen = refined(**EXACT, diffuse=1e4, history=1e4)
    output = model(frame)[0]
    for image in (output.image, output.stages["stage"], seen.frame.color):
        torch.testing.assert_close(image, frame.color, rtol=1e-12, atol=0)
    torch.testing.assert_close(seen.frame.albedo, frame.albedo, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(seen.frame.normal, frame.normal, rtol=1e-12, atol=1e-12)


def test_the_signal_of_a_coat_over_a_texture_is_constant() -> None:
    """``(a D + S) / a`` is demodulated; with ``m = D / (D + S)``, ``(a D + S) / (1 + m (a - 1))`` is ``D + S``."""
    diffuse, coat = 3.0, 1.0
    albedo = 0.1 + 0.9 * torch.rand(1, 3, *SIZE, generator=torch.Generator().manual_seed(1))
    frame = given(albedo=albedo)
    texture = frame.albedo
    assert texture is not None
    frame = frame.replace(color=(texture * diffuse + coat) / texture)
    model, seen = refined(**EXACT, diffuse=torch.tensor(diffuse / coat).log().item())
    image = model(frame)[0].image
    torch.testing.assert_close(seen.frame.color, torch.full_like(image, diffuse + coat), rtol=1e-6, atol=0)
    torch.testing.assert_close(image, frame.color, rtol=1e-12, atol=0)


def test_a_result_has_the_filtered_texture() -> None:
    """With a uniform 3x3 kernel, diffuse light times the albedo of the frame is light times the mean of the albedo."""
    albedo = 0.2 + 0.6 * torch.rand(1, 3, *SIZE, generator=torch.Generator().manual_seed(2))
    frame = given(albedo=albedo)
    frame = frame.replace(color=torch.full_like(frame.color, 2.0))
    model, seen = refined(coarser=-1e4, diffuse=1e4)
    image = model(frame)[0].image * frame.albedo
    inside = (..., slice(1, -1), slice(1, -1))
    mean = torch.nn.functional.avg_pool2d(albedo.double(), 3, 1)
    torch.testing.assert_close(image[inside], 2 * mean, rtol=1e-9, atol=0)
    assert seen.frame.albedo is not None
    torch.testing.assert_close(seen.frame.albedo[inside], mean, rtol=1e-9, atol=0)


def test_coarser_scales_average_more_pixels() -> None:
    """Noise of a constant albedo: 3x3 pixels leave a third of its deviation, all of the coarsest scale a twelfth."""
    noise = torch.rand(1, 3, 96, 96, generator=torch.Generator().manual_seed(3))
    frame = frame_of(96, 96, albedo=0.5 + 0.4 * (noise - 0.5)).to(torch.float64)
    assert frame.albedo is not None
    found = []
    for coarser in (-1e4, 1e4):
        model, seen = refined(coarser=coarser)
        with torch.no_grad():
            model(frame)
        assert seen.frame.albedo is not None
        found.append(float(seen.frame.albedo[..., 12:-12, 12:-12].std() / frame.albedo.std()))
    assert found[0] == pytest.approx(1 / 3, rel=0.1)
    # Interpolation between coarse pixels averages a little more.
    assert 1 / 24 < found[1] < 1 / 11


@pytest.mark.parametrize(("logit", "fraction"), [(-1e4, 0.0), (0.0, 0.5), (1e4, 1.0)])
def test_the_history_is_trusted_as_far_as_predicted(logit: float, fraction: float) -> None:
    frame = given()
    current = given(seed=1).color
    model, seen = refined(**EXACT, diffuse=1e4, history=logit)
    model(frame.replace(current=current))
    torch.testing.assert_close(seen.frame.color, torch.lerp(current, frame.color, fraction), rtol=1e-9, atol=1e-12)
    assert seen.frame.current is not None
    torch.testing.assert_close(seen.frame.current, current, rtol=1e-9, atol=0)


def test_layers_keep_their_fractions_and_known_pixels_their_result() -> None:
    frame = given()
    parts = {"diffuse": 0.25 * frame.color, "glossy": 0.75 * frame.color}
    mask = torch.ones(1, 1, *SIZE, dtype=torch.bool)
    known = given(seed=2).color
    model, seen = refined(centre=1.0, diffuse=0.3)
    output = model(frame.replace(layers=parts, skip=Skip(mask, {"image": known})))[0]
    torch.testing.assert_close(output.layers["diffuse"], 0.25 * output.image, rtol=1e-12, atol=0)
    assert seen.frame.skip is not None
    scale = output.image / seen.frame.color
    torch.testing.assert_close(seen.frame.skip.images["image"] * scale, known, rtol=1e-12, atol=0)


def test_missing_features_stay_missing() -> None:
    frame = Frame(given().color)
    model, seen = refined(centre=1.0, diffuse=0.3)
    image = model(frame)[0].image
    torch.testing.assert_close(image, frame.color, rtol=1e-12, atol=0)
    assert seen.frame.buffers == {"color", "current"}


def test_derivatives_reach_color_features_and_weights() -> None:
    torch.manual_seed(0)
    model = Refined(Seen(), 4).double()
    frame = frame_of(9, 10).to(torch.float64)
    assert frame.albedo is not None
    arguments = (frame.color.requires_grad_(), frame.albedo.clamp(0.1, 0.9).requires_grad_())

    def run(color: Tensor, albedo: Tensor) -> Tensor:
        statistics = model.statistics(frame.replace(color=frame.color.detach(), albedo=frame.albedo))
        image: Tensor = model(frame.replace(color=color, albedo=albedo, statistics=statistics))[0].image
        return image

    assert torch.autograd.gradcheck(run, arguments, fast_mode=True)
    run(*arguments).sum().backward()
    assert all(weight.grad is not None for weight in model.parameters())


def test_it_starts_with_the_weights_of_the_family_before() -> None:
    model = create_model("cascaded_v3_micro")
    checksum = start_with(model, "cascaded_v2_micro")
    assert len(checksum) == 64
    before = create_model("cascaded_v2_micro", pretrained=True)
    assert isinstance(before, nn.Module)
    assert isinstance(model, nn.Module)
    mine = {key.replace("inner.", ""): value for key, value in model.state_dict().items()}
    for key, value in before.state_dict().items():
        assert torch.equal(mine[key.replace("inner.", "")], value)


@pytest.mark.parametrize(
    ("name", "found"),
    [
        ("nothing", "model 'nothing': expected one of"),
        ("guided", "expected a model with weights, found 'guided'"),
        ("cascaded_v2", "expected layer"),
    ],
)
def test_it_refuses_other_weights_to_start_with(name: str, found: str) -> None:
    message = refused(lambda: start_with(create_model("cascaded_v3_micro"), name))
    assert message.startswith("start_from: ")
    assert found in message
