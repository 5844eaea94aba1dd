"""SVGF: what its accumulation, its variance and its transform promise."""

import pytest
import torch
from planes import exponential
from torch import Tensor

from mcdenoise import ops
from mcdenoise.denoiser import Denoiser
from mcdenoise.frame import Frame
from mcdenoise.models import create_model
from mcdenoise.models._history import Past
from mcdenoise.models.svgf import Svgf, variance_of
from mcdenoise.ops import atrous, luminance_moments, moments_variance
from mcdenoise.ops._backend import Backend

HEIGHT, WIDTH = 24, 40


def frame(light: Tensor | None = None, seed: int = 0, **changes: Tensor) -> Frame:
    """A still corner of two walls, lit by noise of mean 1."""
    light = exponential(1, 3, HEIGHT, WIDTH, seed=seed) if light is None else light
    right = (torch.arange(light.shape[-1]) >= light.shape[-1] // 2).expand(1, 1, *light.shape[-2:])
    normal = torch.cat([right, torch.zeros_like(right), ~right], 1).to(light.dtype)
    buffers = {
        "color": light,
        "normal": normal,
        "depth": torch.full_like(light[:, :1], 3.0),
        "motion": torch.zeros_like(light[:, :2]),
    }
    return Frame(**{**buffers, **changes})


def kept(state: Past) -> tuple[Tensor, ...]:
    """Light, moments and length."""
    return state.image.split([3, 2, 1], 1)


def test_the_weight_of_a_frame_is_one_over_their_number_down_to_alpha() -> None:
    """Moments are not filtered: those of n frames, of which the first is lit, have alpha times its own."""
    model, state, rest = Svgf(alpha=0.2), None, 1.0
    dark, lit = frame(torch.zeros(1, 3, HEIGHT, WIDTH)), frame(torch.full((1, 3, HEIGHT, WIDTH), 2.0))
    for number in range(1, 9):
        _, state = model(lit if number == 1 else dark, state)
        rest *= 1 if number == 1 else 1 - max(1 / number, 0.2)
        _, moments, length = kept(state)
        torch.testing.assert_close(moments, rest * torch.tensor([2.0, 4.0]).reshape(1, 2, 1, 1).expand_as(moments))
        assert length.unique().tolist() == [number]


@pytest.mark.parametrize("name", ["svgf", "asvgf"])
def test_the_report_tells_how_many_pixels_have_a_history(name: str) -> None:
    denoiser, lost = Denoiser(name), torch.zeros(1, 2, HEIGHT, WIDTH)
    lost[..., : WIDTH // 4] = torch.inf
    denoiser(frame())
    assert denoiser.report.history is None
    denoiser(frame(seed=1, motion=lost))
    assert denoiser.report.history == 0.75


@pytest.mark.parametrize("name", ["svgf", "asvgf"])
def test_a_still_camera_moves_nothing(name: str) -> None:
    """Positions, which a renderer takes anywhere in a pixel, would be projected to the pixels beside it."""
    first, second = (frame(seed=seed, position=torch.rand(1, 3, HEIGHT, WIDTH)) for seed in (0, 1))
    model, images = create_model(name), []
    for changes in ({}, {"motion": None, "view_projection": torch.eye(4)[None]}):
        given = [each.replace(**changes, previous_position=each.position) for each in (first, second)]
        images.append(model(given[1], model(given[0])[1])[0].image)
    assert torch.equal(*images)


def test_the_first_level_feeds_the_history() -> None:
    given = frame()
    output, state = Svgf()(given)
    variance = 4 * moments_variance(luminance_moments(given.color), given.normal, given.depth, kernel_size=7)
    light = given.color
    for level in range(5):
        light, variance = atrous(light, variance, given.normal, given.depth, step=2**level)
        if level == 0:
            torch.testing.assert_close(kept(state)[0], light)
    torch.testing.assert_close(output.image, light)
    assert torch.equal(output.stages["accumulated"], given.color)


def test_the_variance_is_that_of_neighbours_where_the_history_is_short() -> None:
    """After three equal frames the variance in time is zero, and so would the filter be; after four it is."""
    # No two pixels are alike, which a filter of zero width would still average.
    levels = torch.randperm(HEIGHT * WIDTH, generator=torch.Generator().manual_seed(0)).reshape(1, 1, HEIGHT, WIDTH)
    noise = frame((levels / 100.0).expand(-1, 3, -1, -1))
    model, state, images = Svgf(), None, []
    for _ in range(6):
        if state is not None:
            state = state._replace(image=torch.cat([noise.color, *kept(state)[1:]], 1))
        output, state = model(noise, state)
        images.append(output.image)
    for image in images[:3]:
        assert image.var() < 0.2 * noise.color.var()
    for image in images[3:]:
        torch.testing.assert_close(image, noise.color, rtol=1e-3, atol=1e-3)


def test_rounding_of_the_length_hardly_changes_the_variance() -> None:
    given, length = frame(), torch.full((1, 1, HEIGHT, WIDTH), 4.0)
    moments = torch.cat([0.5 * torch.ones_like(length), torch.rand(1, 1, HEIGHT, WIDTH) + 0.25], 1)
    exact, rounded = (variance_of(moments, each, given) for each in (length, length - 4e-7))
    torch.testing.assert_close(rounded, exact, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("name", ["svgf", "asvgf"])
@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_layers_of_even_light_are_filtered(name: str, backend: Backend) -> None:
    """The light has no variance, and its luminance differs by rounding only."""
    slope = torch.linspace(2, 3, WIDTH).expand(1, 1, HEIGHT, WIDTH)
    with ops.use(backend):
        denoiser, even = Denoiser(name), torch.tensor([0.37, 0.26, 0.11]).reshape(1, 3, 1, 1)
        for seed in range(4):
            given = frame(even.expand(1, 3, HEIGHT, WIDTH), depth=slope, motion=torch.full((1, 2, HEIGHT, WIDTH), 0.3))
            part = torch.rand(1, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(seed))
            layer = denoiser.output(given.replace(layers={"part": 0.1 * part})).layers["part"]
    assert layer.var() < 1e-3 * (0.1 * part).var()


@pytest.mark.parametrize("sigma_n", [1.0, 1.5, 128.0])
def test_the_second_derivative_at_a_right_angle_is_finite(sigma_n: float) -> None:
    given = frame()
    normal = given.normal.clone().requires_grad_()
    filtered, _ = atrous(given.color, torch.ones_like(given.depth), normal, sigma_n=sigma_n)
    slope = torch.autograd.grad(filtered.square().sum(), normal, create_graph=True)[0]
    assert torch.autograd.grad(slope.square().sum(), normal)[0].isfinite().all()
