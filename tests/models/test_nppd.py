"""Partitioning pyramids against their equations, in float64 with loops, and against the published layers."""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from toys import small, still, whole_frame

from mcdenoise.models import create_model
from mcdenoise.ops import reproject


def decided(**biases: Tensor | float) -> Any:
    """A model whose weights do not depend on the frame: softmaxes of zeros, or of logits at the finest scale."""
    model = small("nppd")
    places = {"splat": slice(0, 25), "previous": slice(25, 50), "mu": 50, "trust": 51, "partition": slice(52, 57)}
    with torch.no_grad():
        for head in model.network.heads:
            head.weight.zero_()
            head.bias.zero_()
        for name, bias in biases.items():
            model.network.heads[0].bias[places[name]] = bias
    return model


def only(index: int, count: int) -> Tensor:
    """Logits that choose one."""
    return 100 * F.one_hot(torch.tensor(index), count).float()


NOTHING = {"mu": -100.0, "trust": -100.0}


@torch.no_grad()
def test_all_on_the_finest_level_and_splatted_to_itself_is_the_image() -> None:
    model = decided(**NOTHING, splat=only(12, 25), partition=only(0, 5))
    state = None
    for seed in range(2):
        frame = whole_frame(model, 21, 34, seed=seed)
        output, state = model(frame, state)
        torch.testing.assert_close(output.image, frame.color)


@torch.no_grad()
def test_a_constant_image_stays_constant_away_from_the_border() -> None:
    """Equal weights everywhere.

    At level 4 two pixels from the border on lack neighbours, and ``n`` of those make ``2 n + 1`` of the next finer
    level: 5, 11, 23 and at last 47, of which 16 are of the mirror image around the frame.
    """
    model = decided(**NOTHING)
    frame = still(torch.full((1, 3, 128, 160), 0.7))
    image = model(frame)[0].image
    torch.testing.assert_close(image[..., 31:-31, 31:-31], torch.full((1, 3, 66, 98), 0.7))
    assert not torch.isclose(image[..., 30, 80], torch.tensor(0.7)).any()
    assert image.max() <= 0.7 * (1 + 1e-5)
    assert image[..., 0, 0].max() < 0.65


@torch.no_grad()
def test_lambda_keeps_the_mean_and_mu_the_result() -> None:
    """Both are one half here: the results are means of halves, since nothing moves."""
    model = decided(mu=0.0, trust=0.0, splat=only(12, 25), previous=only(12, 25), partition=only(0, 5))
    state, mean, image = None, torch.zeros(1, 3, 6, 7), torch.zeros(1, 3, 6, 7)
    for seed in range(4):
        color = torch.rand(1, 3, 6, 7, generator=torch.Generator().manual_seed(seed))
        output, state = model(still(color), state)
        mean = (mean + color) / 2
        image = (image + mean) / 2
        torch.testing.assert_close(output.stages["accumulated"], mean)
        torch.testing.assert_close(output.image, image)


@torch.no_grad()
def test_the_history_is_warped() -> None:
    model = decided(mu=100.0, trust=0.0, previous=only(12, 25))
    first, second = (whole_frame(model, 12, 15, seed=seed) for seed in range(2))
    _, state = model(first)
    moved = model(second, state)[0].image
    torch.testing.assert_close(moved, reproject(state.image[:, 3:6], second.motion)[0])


@torch.no_grad()
def test_samples_are_averaged_after_they_were_seen_one_by_one() -> None:
    model = small("nppd")
    frame = whole_frame(model, 17, 20)
    image = model(frame)[0].image
    shuffled = model(frame.replace(samples=frame.samples[:, [2, 0, 3, 1]]))[0].image
    torch.testing.assert_close(shuffled, image)
    doubled = model(frame.replace(samples=frame.samples.repeat(1, 2, 1, 1, 1)))[0].image
    torch.testing.assert_close(doubled, image)
    # Further channels of samples are not looked at, and one sample is the color.
    more = torch.cat([frame.samples, frame.samples], 2)
    assert torch.equal(model(frame.replace(samples=more))[0].image, image)
    alone = model(frame.replace(samples=None))[0].image
    torch.testing.assert_close(model(frame.replace(samples=frame.color[:, None]))[0].image, alone)
    assert not torch.allclose(alone, image)


@torch.no_grad()
def test_the_large_network_at_any_size() -> None:
    torch.manual_seed(0)
    model = create_model("nppd", width=4, backbone="convunext")
    state = None
    for seed in range(2):
        frame = whole_frame(model, 5, 18, seed=seed)
        output, state = model(frame, state)
        assert output.image.shape == frame.color.shape
        assert (output.image >= 0).all()
    assert [head.out_channels for head in model.network.heads] == [57, 41, 41, 41, 41]
