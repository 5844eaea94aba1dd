"""Open Image Denoise's images corrected: what the network sees and weighs; its equations are in test_pyramid.py."""

from __future__ import annotations

import importlib.util

import pytest
import torch
from toys import frame_of, refused, whole_frame

from mcdenoise.models import create_model
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.models.pyramid import PyramidNetwork
from mcdenoise.models.with_oidn import CENTRED, NOISY, OIDN, OIDN_ALBEDO, OIDN_CLEAN, WithOidn
from mcdenoise.train.clips import LIGHT
from mcdenoise.train.front import split

HEIGHT, WIDTH = 21, 34
has_oidn = pytest.mark.skipif(
    importlib.util.find_spec("pyoidn") is None, reason="Open Image Denoise is in the extra mcdenoise[oidn]"
)


def weighing(*logits: float) -> PyramidNetwork:
    """A network whose weights of the images, its own first, are the softmax of these everywhere."""
    torch.manual_seed(0)
    net = PyramidNetwork((4, 6, 8), 3, others=(OIDN, OIDN_CLEAN)).double()
    with torch.no_grad():
        head = net.heads[0]
        first = net.channels[0]
        head.weight[first : first + 3].zero_()  # type: ignore[index]
        head.bias[first : first + 3] = torch.tensor(logits)  # type: ignore[index]
    return net


def test_the_result_is_a_weighted_mean_of_its_own_image_and_the_others() -> None:
    frame = frame_of(HEIGHT, WIDTH).to(torch.float64)
    others = torch.rand(2, 1, 3, HEIGHT, WIDTH, dtype=torch.float64)
    frame = frame.replace(extra={OIDN: others[0], OIDN_CLEAN: others[1]})
    own = Demodulated(weighing(60, 0, 0))(frame)[0].image
    image = Demodulated(weighing(0.3, -0.2, 1))(frame)[0].image
    weights = torch.softmax(torch.tensor([0.3, -0.2, 1.0], dtype=torch.float64), 0)
    # Weights of float32, as the heads' biases were given.
    torch.testing.assert_close(
        image, weights[0] * own + weights[1] * others[0] + weights[2] * others[1], rtol=1e-6, atol=0
    )


@pytest.mark.parametrize(("logits", "name"), [((0, 60, 0), OIDN), ((0, 0, 60), OIDN_CLEAN)])
def test_where_another_image_weighs_all_it_is_the_result_at_any_exposure(
    logits: tuple[float, float, float], name: str
) -> None:
    for factor in (1e-3, 1.0, 1e4):
        frame = frame_of(HEIGHT, WIDTH).to(torch.float64)
        given = {each: torch.rand(1, 3, HEIGHT, WIDTH, dtype=torch.float64) * factor for each in (OIDN, OIDN_CLEAN)}
        image = Demodulated(weighing(*logits))(frame.replace(color=frame.color * factor, extra=given))[0].image
        torch.testing.assert_close(image, given[name], rtol=1e-12, atol=0)


def test_an_image_that_is_not_there_is_the_noisy_one() -> None:
    frame = frame_of(HEIGHT, WIDTH).to(torch.float64)
    image = Demodulated(weighing(0, 60, 0))(frame)[0].image
    torch.testing.assert_close(image, frame.color, rtol=1e-12, atol=0)


@has_oidn
def test_training_begins_behind_oidn() -> None:
    """Its images are computed into the cache. They are light, and clips scale them as such."""
    front, rest = split(create_model("oidn_pyramid", threads=1))
    assert [kind for kind, _ in front.wrappers] == [WithOidn]
    assert (front.accumulates, front.demodulates) == (False, False)
    assert front.parts == {"color": 3, OIDN: 3, OIDN_CLEAN: 3, OIDN_ALBEDO: 3, NOISY: 3, CENTRED: 1}
    assert front.parts.keys() - {OIDN_ALBEDO, CENTRED} <= LIGHT
    frame = frame_of(24, 40)
    seen = front.begin()(frame)
    model = create_model("oidn_pyramid", threads=1)
    output, _ = model(frame)
    for name in (OIDN, OIDN_CLEAN):
        assert torch.equal(seen.extra[name], output.stages[name])
    rest.load_state_dict(model.inner.state_dict())
    assert torch.equal(rest(seen)[0].image, output.image)


@has_oidn
def test_a_first_frame_is_the_network_s_image_and_the_next_is_steadied() -> None:
    model = create_model("oidn_pyramid", threads=1)
    output, state = model(whole_frame(model, 24, 40, seed=0))
    assert torch.equal(output.image, output.stages["corrected"])
    output, _ = model(whole_frame(model, 24, 40, seed=1), state)
    assert not torch.equal(output.image, output.stages["corrected"])


@has_oidn
def test_refuses_invalid_settings() -> None:
    assert "quality: expected one of fast, balanced, high" in refused(
        lambda: create_model("oidn_pyramid", quality="best")
    )
    assert "history: expected above 0, found 0" in refused(lambda: create_model("oidn_pyramid", history=0))
