from collections.abc import Callable
from typing import Any

import kornia
import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from mcdenoise.ops import kernel_conv, kernel_splat

BORDERS = ["replicate", "zeros", "renormalize"]
every_border = pytest.mark.parametrize("border", BORDERS)


def draw(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize(("border", "kornia_border"), [("replicate", "replicate"), ("zeros", "constant")])
@pytest.mark.parametrize("size", [1, 3, 5])
def test_the_same_kernel_everywhere_is_filter2d(border: Any, kornia_border: str, size: int) -> None:
    image, kernel = draw(2, 3, 7, 9), draw(1, size, size, seed=3)
    everywhere = kernel.reshape(1, size * size, 1, 1).expand(2, -1, 7, 9)
    expected = kornia.filters.filter2d(image, kernel, border_type=kornia_border)
    torch.testing.assert_close(kernel_conv(image, everywhere, border=border), expected, rtol=1e-12, atol=1e-12)


def test_a_half_precision_mean_of_fireflies_does_not_overflow() -> None:
    image = torch.full((1, 3, 4, 4), 6e4, dtype=torch.float16)
    weights = torch.full((1, 25, 4, 4), 2.0, dtype=torch.float16)
    torch.testing.assert_close(kernel_conv(image, weights, border="renormalize"), image)


def test_half_precision_sums_in_float32() -> None:
    # 2401 ones: float16 alone would stop counting at 2048.
    image = torch.ones(1, 1, 1, 1, dtype=torch.float16)
    weights = torch.ones(1, 49 * 49, 1, 1, dtype=torch.float16)
    assert kernel_conv(image, weights).item() == 2400.0
    assert kernel_splat(image, weights).item() == 2400.0


class _Largest(TorchDispatchMode):
    """Number of elements of the largest tensor that came into being, other than the given ones."""

    def __init__(self, given: list[Tensor]) -> None:
        super().__init__()
        self.numel = 0
        self._given = {tensor.untyped_storage().data_ptr() for tensor in given}

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        if isinstance(result, Tensor) and result.untyped_storage().data_ptr() not in self._given:
            self.numel = max(self.numel, result.untyped_storage().nbytes() // result.element_size())
        return result


@pytest.mark.parametrize("op", [kernel_conv, kernel_splat])
@every_border
def test_memory_of_the_gradient_is_that_of_a_kernel(op: Callable[..., Tensor], border: Any) -> None:
    image, kernel = torch.rand(1, 3, 32, 32, requires_grad=True), torch.rand(1, 49, 32, 32, requires_grad=True)
    with _Largest([image, kernel]) as largest:
        op(image, kernel, border=border).sum().backward()
    # A stack of 49 shifted images would hold 3 * 49 * 32 * 32.
    assert largest.numel == 49 * 32 * 32


@pytest.mark.parametrize("op", [kernel_conv, kernel_splat])
def test_a_float32_kernel_of_a_half_image_keeps_its_gradient(op: Callable[..., Tensor]) -> None:
    """Autocast gives half images and float32 weights; a product beyond 65504 must not end as infinity."""
    g = torch.Generator().manual_seed(0)
    image = (torch.rand(1, 3, 3, 5, generator=g) * 2e4).half()
    kernel = torch.rand(1, 9, 3, 5, generator=g) / 9
    upstream = torch.rand(1, 3, 3, 5, generator=g).half() * 10
    results = []
    for dtype in (torch.float16, torch.float64):
        weights = kernel.to(torch.promote_types(dtype, torch.float32)).requires_grad_()
        (gradient,) = torch.autograd.grad(op(image.to(dtype), weights), weights, upstream.to(dtype))
        results.append(gradient.double())
    torch.testing.assert_close(*results, rtol=1e-6, atol=0)


@every_border
@pytest.mark.parametrize("shape", [(0, 3, 4, 5), (1, 0, 4, 5), (1, 3, 0, 5), (1, 3, 4, 0), (1, 3, 0, 0)], ids=str)
def test_empty_images_have_empty_results_and_derivatives(shape: tuple[int, ...], border: Any) -> None:
    image = torch.zeros(shape, requires_grad=True)
    kernel = torch.ones(shape[0], 9, *shape[2:], requires_grad=True)
    for function in (kernel_conv, kernel_splat):
        result = function(image, kernel, border=border)
        assert result.shape == shape
        of_image, of_kernel = torch.autograd.grad(result.sum(), (image, kernel))
        assert of_image.shape == shape
        assert not of_kernel.any()
