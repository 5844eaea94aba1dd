"""A-SVGF: what its temporal gradients do to the history of SVGF."""

import pytest
import torch
from test_svgf import HEIGHT, WIDTH, frame, kept

from mcdenoise.frame import Frame
from mcdenoise.models.asvgf import Asvgf
from mcdenoise.models.svgf import Svgf


def shaded(given: Frame, now: float, before: float, there: float = 1.0) -> Frame:
    """The frame with samples of the frame before, shaded once more."""
    values = torch.tensor([now, before, there], dtype=torch.float32).reshape(1, 3, 1, 1)
    return given.replace(extra={"gradient": values.expand(1, 3, HEIGHT, WIDTH)})


def test_where_samples_shaded_once_more_are_the_same_it_is_svgf() -> None:
    model, plain = Asvgf(alpha=0.2), Svgf(alpha=0.2)
    state = expected = None
    for seed in range(6):
        given = frame(seed=seed)
        output, state = model(shaded(given, 0.7, 0.7), state)
        image, expected = plain(given, expected)
        assert torch.equal(output.image, image.image)
        assert torch.equal(kept(state)[2], kept(expected)[2])


@pytest.mark.parametrize("change", [0.25, 0.5, 1.0])
def test_the_weight_of_the_frame_is_that_of_the_paper(change: float) -> None:
    """``(1 - lambda) alpha + lambda``, of moments, which no filter changes; the length is one over it."""
    model, state = Asvgf(alpha=0.2), None
    dark, lit = frame(torch.zeros(1, 3, HEIGHT, WIDTH)), frame(torch.full((1, 3, HEIGHT, WIDTH), 2.0))
    for _ in range(3):
        _, state = model(shaded(lit, 1, 1), state)
    _, state = model(shaded(dark, 1 - change, 1), state)
    alpha = (1 - change) / 4 + change
    _, moments, length = kept(state)
    torch.testing.assert_close(moments, (1 - alpha) * torch.tensor([2.0, 4.0]).reshape(1, 2, 1, 1).expand_as(moments))
    torch.testing.assert_close(length, torch.full_like(length, 1 / alpha))


def test_strata_without_samples_keep_their_history() -> None:
    model, state = Asvgf(), None
    for seed in range(4):
        _, state = model(shaded(frame(seed=seed), 0, 1, there=0), state)
    assert (kept(state)[2] == 4).all()


def test_a_light_that_goes_out_is_gone_at_once() -> None:
    """At alpha = 0.1, nine tenths of it would be left."""
    model, plain, state, other = Asvgf(), Svgf(alpha=0.1), None, None
    for seed in range(12):
        _, state = model(frame(seed=seed), state)
        _, other = plain(frame(seed=seed), other)
    dark = frame(torch.zeros(1, 3, HEIGHT, WIDTH))
    assert plain(dark, other)[0].image.mean() > 0.85
    assert model(dark, state)[0].image.mean() < 0.1
    # The light is there as fast when it comes back.
    _, state = model(dark, model(dark, state)[1])
    assert model(frame(seed=20), state)[0].image.mean() > 0.9


def test_noise_is_hardly_taken_for_a_change() -> None:
    """Pixels beyond two standard errors of a neighbourhood discard as much: a few parts in a hundred."""
    model, plain, state, other = Asvgf(alpha=0.1), Svgf(alpha=0.1), None, None
    for seed in range(16):
        output, state = model(frame(seed=seed), state)
        expected, other = plain(frame(seed=seed), other)
    assert kept(state)[2].mean() > 8
    error, least = ((image - 1).square().mean() for image in (output.image, expected.image))
    assert error < 1.3 * least


def test_a_firefly_is_no_change_of_the_light() -> None:
    model, state = Asvgf(), None
    for seed in range(8):
        _, state = model(frame(seed=seed), state)
    given = frame(seed=8)
    given.color[..., 12, 10] = 1e4
    _, after = model(given, state)
    assert kept(after)[2][..., 12, 10] > 6
