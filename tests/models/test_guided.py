"""The guided filter: kornia's own, with all features for a guide."""

import pytest
import torch
from kornia.filters import guided_blur
from toys import frame_of

from mcdenoise.denoiser import Denoiser
from mcdenoise.frame import Frame
from mcdenoise.models.guided import Guided


def test_is_the_filter_of_kornia() -> None:
    given = frame_of(40, 44, depth=1 + torch.rand(1, 1, 40, 44)).to(torch.float64)
    typical = torch.exp(torch.log(given.depth).mean())
    guide = torch.cat([given.albedo, given.normal, 10 * given.depth / (given.depth + typical)], 1)
    expected = guided_blur(guide, given.color, 7, 0.05, border_type="replicate").clamp_min(0)
    torch.testing.assert_close(Guided(3, 0.05)(given)[0].image, expected, rtol=1e-10, atol=1e-11)


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
