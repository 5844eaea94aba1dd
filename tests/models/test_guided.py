"""The guided filter: kornia's own, with all features for a guide."""

import pytest
import torch
from kornia.filters import guided_blur

from mcdenoise.denoiser import Denoiser
from mcdenoise.frame import Frame
from mcdenoise.models.guided import Guided


def frame(height: int = 40, width: int = 44, seed: int = 0) -> Frame:
    generator = torch.Generator().manual_seed(seed)
    color, albedo, normal, depth = (torch.rand(1, c, height, width, generator=generator) for c in (3, 3, 3, 1))
    return Frame(color=color, albedo=albedo, normal=torch.nn.functional.normalize(normal, dim=1), depth=1 + depth)


def test_is_the_filter_of_kornia() -> None:
    given = frame()
    typical = torch.exp(torch.log(given.depth).mean())
    guide = torch.cat([given.albedo, given.normal, 10 * given.depth / (given.depth + typical)], 1)
    expected = guided_blur(guide, given.color, 7, 0.05, border_type="replicate").clamp_min(0)
    torch.testing.assert_close(Guided(3, 0.05)(given)[0].image, expected, rtol=1e-4, atol=1e-5)


def test_light_that_is_linear_in_the_guides_stays() -> None:
    """Every window's model of such light is exact, up to eps beside the guides' variance."""
    given = frame().to(torch.float64)
    light = 0.2 * given.albedo + 0.1 * given.normal.sum(1, keepdim=True) + 0.3
    image = Guided(4, 1e-9)(given.replace(color=light))[0].image
    torch.testing.assert_close(image, light, rtol=1e-5, atol=1e-6)


def test_an_edge_of_normals_is_not_crossed() -> None:
    """Within a wall the guides are constant, so that each side is blurred, and by no more than eps with the other."""
    right = (torch.arange(44) >= 22).expand(1, 1, 40, 44)
    normal = torch.cat([right, torch.zeros_like(right), ~right], 1).double()
    given = Frame(color=torch.where(right, 1.0, 0.1).double().expand(1, 3, 40, 44).contiguous(), normal=normal)
    image = Guided(4, 1e-4)(given)[0].image
    # In a window with the fraction f beyond the edge, the guides' variance along the step is f (1 - f) times two, of
    # which eps takes eps / (2 f (1 - f)), with f (1 - f) of 8 / 81 at least.
    assert (image - given.color).abs().max() < 0.9 * 1e-4 / (2 * 8 / 81) * 1.01


@pytest.mark.parametrize("model", ["guided", "joint_bilateral"])
def test_noise_does_not_guide_itself(model: str) -> None:
    """Without features, noise of a constant image goes, an edge stays, and an infinite pixel stays local."""
    right = (torch.arange(64) >= 32).expand(1, 3, 48, 64)
    clean = torch.where(right, 1.0, 0.1)
    uniform = torch.rand(8, 1, 1, 48, 64, generator=torch.Generator().manual_seed(0))
    given = clean * -uniform.log().mean(0)
    image = Denoiser(model)(Frame(given))
    assert (image / clean - 1).abs().mean() < 0.25 * (given / clean - 1).abs().mean()
    spot = given.clone()
    spot[..., 24, 12] = torch.inf
    other = Denoiser(model)(Frame(spot))
    assert ((other / image - 1).abs()[..., :, 21:]).max() < 1e-2
