"""The joint bilateral filter: kornia's own, in tiles, on accumulated light."""

import torch
from kornia.filters import joint_bilateral_blur
from toys import frame_of

from mcdenoise.denoiser import Denoiser
from mcdenoise.frame import Frame
from mcdenoise.models import Tiled, create_model
from mcdenoise.models._wrapper import parts_of
from mcdenoise.models.joint_bilateral import JointBilateral
from mcdenoise.nn import auto_exposure
from mcdenoise.ops import demodulate, remodulate


def test_is_the_filter_of_kornia() -> None:
    given = frame_of(40, 60)
    given = given.replace(albedo=0.3 + given.albedo / 2)
    depth = torch.where(given.depth.isfinite(), given.depth, 1)
    typical = torch.exp(torch.log(depth).sum() / given.depth.isfinite().sum())
    nearness = torch.where(given.depth.isfinite(), depth / (depth + typical), 1)
    guide = torch.cat([given.albedo, given.normal, 10 * nearness], 1)
    light = demodulate(given.color, given.albedo)
    settings = {"border_type": "replicate", "color_distance_type": "l2"}
    expected = remodulate(joint_bilateral_blur(light, guide, 9, 0.3, (2.0, 2.0), **settings), given.albedo)
    model = create_model("joint_bilateral", sigma_color=0.3, sigma_space=2.0)
    image = Denoiser(model)(given)
    # The albedos' floor and fireflies are not met here; frames without motion stand alone.
    torch.testing.assert_close(image, expected, rtol=1e-5, atol=1e-6)


def test_windows_stay_within_memory() -> None:
    """Unfolded, a tile of the default has no more than 250 million values, also where kornia is called directly."""
    for sigma in (1.5, 4.0, 6.0, 12.0):
        (tiled,) = parts_of(create_model("joint_bilateral", sigma_space=sigma), Tiled)
        radius = int(2 * sigma)
        assert tiled.side is not None
        assert tiled.halo == radius + 1
        values = 10 * (2 * radius + 1) ** 2 * (tiled.side + 2 * radius) ** 2
        assert values <= 250_000_000 or tiled.side == 64


def test_guides_itself_without_features() -> None:
    color = frame_of(20, 26).color
    settings = {"border_type": "replicate", "color_distance_type": "l2"}
    guide = torch.nn.functional.pad(torch.log1p(color * auto_exposure(color)), (1, 1, 1, 1), mode="replicate")
    guide = guide.unfold(2, 3, 1).unfold(3, 3, 1).flatten(4).median(4).values
    expected = joint_bilateral_blur(color, guide, 9, 0.2, (2.0, 2.0), **settings)
    torch.testing.assert_close(JointBilateral(0.2, 2.0)(Frame(color=color))[0].image, expected)


def test_differentiable() -> None:
    given = frame_of(3, 4).to(torch.float64)
    model = JointBilateral(0.5, 0.5)

    def image(color: torch.Tensor, albedo: torch.Tensor) -> torch.Tensor:
        return model(given.replace(color=color, albedo=albedo))[0].image

    leaves = given.color.requires_grad_(), given.albedo.clone().requires_grad_()
    assert torch.autograd.gradcheck(image, leaves)
