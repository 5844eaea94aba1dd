"""The inputs that networks see of a frame."""

import pytest
import torch

from mcdenoise.frame import Frame
from mcdenoise.nn import auto_exposure, normalize_depth
from mcdenoise.nn.inputs import unit_features_of


def test_auto_exposure_brings_a_constant_image_to_the_key() -> None:
    color = torch.full((1, 3, 20, 20), 8.0)
    torch.testing.assert_close(auto_exposure(color, key=0.5), torch.full((1, 1, 1, 1), 0.0625))
    assert auto_exposure(torch.zeros(2, 3, 5, 5)).flatten().tolist() == [1, 1]
    # Half precision holds no larger factor.
    assert auto_exposure(torch.full((1, 3, 5, 5), 1e-6, dtype=torch.float16)).item() == 65504


def test_normalized_depth_written_out() -> None:
    # The geometric mean of 1 and 4 is 2.
    depth = torch.tensor([1.0, 4.0, torch.inf]).reshape(1, 1, 1, 3)
    torch.testing.assert_close(normalize_depth(depth).flatten(), torch.tensor([1 / 3, 2 / 3, 1.0]))
    assert normalize_depth(torch.full((1, 1, 2, 2), torch.inf)).unique().tolist() == [1]


def test_a_buffer_that_is_not_there_is_constant() -> None:
    frame = Frame(torch.rand(1, 3, 5, 6))
    given = unit_features_of(frame)
    assert [each.unique().tolist() for each in given] == [[1], [0.5], [0.5]]


@pytest.mark.parametrize(("sky", "rows"), [(1e10, 1), (1e30, 60), (3e38, 95), (torch.inf, 60)])
def test_a_far_sky_hides_no_differences_of_what_is_near(rows: int, sky: float) -> None:
    """Blender writes 1e10 where nothing was hit, others 1e30; here and there one of these is beside infinity."""
    depth = torch.randn(1, 1, 100, 8).exp() * 5
    depth[..., :rows, :] = torch.inf
    expected = normalize_depth(depth)
    depth[..., :rows, :-1] = sky
    found = normalize_depth(depth)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=0)


def test_depths_of_zero_are_finite() -> None:
    """Some renderers write 0 where nothing was hit."""
    depth = torch.ones(1, 1, 4, 6)
    depth[..., 0] = 0
    for image in (depth, torch.zeros_like(depth), torch.full_like(depth, 1e-38)):
        found = normalize_depth(image)
        assert found.isfinite().all()
        assert 0 <= found.min() <= found.max() <= 1


def test_the_scale_of_depths_has_a_derivative() -> None:
    depth = (torch.randn(2, 1, 3, 4, dtype=torch.float64).exp() + 0.1).requires_grad_()
    assert torch.autograd.gradcheck(normalize_depth, (depth,))
    depth = depth.detach().clone()
    depth[0, 0, 0, 0], depth[1, 0, 0, 0] = torch.inf, 1e10
    depth.requires_grad_()
    assert torch.autograd.grad(normalize_depth(depth).sum(), depth)[0].isfinite().all()
