from __future__ import annotations

import pytest
import torch
from torch import Tensor

from mcdenoise.ops import demodulate, kernel_conv, remodulate
from mcdenoise.ops.demodulation import FLOOR


def pixel(*values: float, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.tensor(values, dtype=dtype).reshape(1, -1, 1, 1)


def hard_albedo() -> Tensor:
    """Every triple of hard values: nothing, next to nothing, about the floor, ordinary, white, above white."""
    values = torch.tensor([0.0, 1e-8, FLOOR * 0.999, FLOOR, FLOOR * 1.001, 0.5, 1.0, 3.5], dtype=torch.float64)
    return torch.cartesian_prod(values, values, values).T.reshape(1, 3, 16, 32)


# float16 is not tested: 1e4 / FLOOR is more than it holds.
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16])
def test_remodulate_is_the_inverse_everywhere(dtype: torch.dtype) -> None:
    albedo = hard_albedo().to(dtype)
    exponent = torch.rand(albedo.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    color = (10 ** (6 * exponent - 2)).to(dtype)
    eps = torch.finfo(dtype).eps
    for there, back in ((demodulate, remodulate), (remodulate, demodulate)):
        torch.testing.assert_close(back(there(color, albedo), albedo), color, rtol=2 * eps, atol=0)


def test_no_albedo_passes_unchanged() -> None:
    color = pixel(0.0, 0.3, 1e4)
    for albedo in (pixel(0, 0, 0), pixel(1e-8, 0, 9e-5)):
        assert torch.equal(demodulate(color, albedo), color)
        assert torch.equal(remodulate(color, albedo), color)


def test_a_channel_without_albedo_is_divided_by_the_floor() -> None:
    color, albedo = pixel(0.25, 0.5, 0.01), pixel(0.5, 0.25, 0.0)
    torch.testing.assert_close(demodulate(color, albedo), pixel(0.5, 2.0, 0.01 / FLOOR), rtol=1e-12, atol=0)


def test_the_floor_itself_is_texture() -> None:
    color = pixel(1.0, 1.0, 1.0)
    expected = color / FLOOR
    assert torch.equal(demodulate(color, pixel(FLOOR, 0, 0)), expected)


def test_albedo_above_one_is_divided_by() -> None:
    assert torch.equal(demodulate(pixel(7.0), pixel(3.5)), pixel(2.0))


def test_floor_can_be_set() -> None:
    assert torch.equal(demodulate(pixel(1.0, 1.0), pixel(0.75, 0.25), floor=0.5), pixel(1 / 0.75, 2.0))
    assert torch.equal(demodulate(pixel(1.0, 1.0), pixel(0.25, 0.25), floor=0.5), pixel(2.0, 2.0))


def test_a_dark_texture_is_filtered_without_steps() -> None:
    """Uniform light on a texture that crosses the floor: what filtering leaves is still a multiple of the texture."""
    albedo = FLOOR * torch.tensor([0.03, 0.99, 1.01, 2.0], dtype=torch.float64).reshape(1, 1, 1, 4)
    light = demodulate(2 * albedo, albedo)
    assert light[..., 1:].amax() / light[..., 1:].amin() < 1.02
    box = torch.full((1, 9, 1, 4), 1 / 9, dtype=torch.float64)
    filtered = remodulate(kernel_conv(light, box), albedo)
    assert (filtered <= 2 * albedo.clamp_min(FLOOR) * (1 + 1e-12)).all()


def test_gradients_are_finite_everywhere() -> None:
    albedo = hard_albedo().requires_grad_()
    color = torch.ones_like(albedo).requires_grad_()
    for op in (demodulate, remodulate):
        gradients = torch.autograd.grad(op(color, albedo).sum(), [color, albedo])
        assert all(gradient.isfinite().all() for gradient in gradients)
        # Below the floor the albedo itself is not used.
        assert gradients[1][albedo < FLOOR].eq(0).all()
