"""The compiled steps between the convolutions of a network against their reference, formulas of torch."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from reference_cases import by, channels_last, every_other_column, slice_of_pixels, transposed
from torch import Tensor

from mcdenoise.ops import downsample
from mcdenoise.ops._numba import _runtime
from mcdenoise.ops._steps import network, transfer, tuned

pytestmark = pytest.mark.usefixtures("nan_in_fresh_memory")
# The tolerance is relative to the largest number in a result: a few roundings of sums of up to 54 products.
TOLERANCE = {dtype: 32 * torch.finfo(dtype).eps for dtype in (torch.float32, torch.float64)}
SIZES = [(1, 1, 1), (2, 33, 2), (1, 2, 1030)]

every_size = pytest.mark.parametrize("size", SIZES, ids=str)
every_dtype = pytest.mark.parametrize("dtype", TOLERANCE, ids=str)


def as_it_is(tensor: Tensor) -> Tensor:
    return tensor


def draw(seed: int, batch: int, channels: int, height: int, width: int, dtype: torch.dtype) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(batch, channels, height, width, generator=generator, dtype=torch.float64).to(dtype)


Call = tuple[Callable[..., Any], list[Any], dict[str, Any]]


def calls(size: tuple[int, int, int], dtype: torch.dtype, layout: Callable[[Tensor], Tensor] = as_it_is) -> list[Call]:
    """Every step with arguments of its kind."""
    batch, height, width = size

    def some(seed: int, channels: int, like: torch.dtype = dtype) -> Tensor:
        return layout(draw(seed, batch, channels, height, width, like))

    coarse = layout(draw(1, batch, 3, (height + 1) // 2, (width + 1) // 2, dtype) + 1)
    weight, bias = draw(2, 1, 6, 3, 3, dtype) * 0.3, torch.tensor([0.2], dtype=dtype)
    maximum = 1 + torch.arange(1, batch + 1, dtype=dtype).reshape(-1, 1, 1, 1)
    radiance = layout(draw(3, batch, 3, height, width, dtype).exp())
    depth = draw(4, batch, 1, height, width, dtype).exp() * 20
    depth[..., 0, -1] = torch.inf
    scale = network.depth_scale(depth)
    depth = layout(depth)
    exposure = maximum * 0.7
    buffers = [some(5, 3), some(6, 3), depth, radiance]
    # Some pixels have no history, and some features are out of their range.
    seen, valid = [some(5, 3), some(6, 3)], some(23, 1).clamp(0, 1)
    previous = [layout(draw(seed, batch, 3, height, width, dtype).exp()) for seed in (19, 20)]
    predicted, on_scale = (layout(draw(21, batch, count, height, width, dtype).tanh()) for count in (7, 9))
    calls: list[Call] = [
        (network.gated_fusion, [some(7, 3), coarse, weight, bias], {}),
        (network.gated_fusion, [some(7, 3), coarse, weight, bias], {"residual": some(8, 3), "maximum": maximum}),
        (network.gated_fusion, [some(7, 3).abs(), coarse, weight, bias], {"logarithms": True}),
        (network.buffers_input, [radiance, *buffers, 1 + some(12, 1).abs(), exposure, scale], {}),
        (network.buffers_input, [some(14, 3), *buffers, None, exposure, scale], {"logarithms": False}),
        (downsample, [some(13, 3)], {}),
        # From the dark, where the scale is linear, to the largest radiance and beyond.
        (transfer.compress, [layout((6 * draw(15, batch, 3, height, width, dtype)).exp())], {}),
        (transfer.expand, [layout(draw(16, batch, 3, height, width, dtype).sigmoid())], {}),
        (tuned.tuned_input, [radiance, *previous, *seen, valid, exposure, 4], {}),
        (tuned.tuned_input, [radiance, *previous, None, None, valid, exposure, 1], {}),
        (tuned.tuned_choice, [predicted, on_scale, valid, exposure, (0.0, -2.0, -1.0, 0.5)], {}),
    ]
    return calls


def results(call: Call, backend: str) -> list[Tensor]:
    function, arguments, settings = call
    found = by(backend, function)(*arguments, **settings)
    return [found] if isinstance(found, Tensor) else list(found)


def assert_same(actual: list[Tensor], expected: list[Tensor], tolerance: float) -> None:
    for a, e in zip(actual, expected, strict=True):
        assert (a.dtype, a.shape) == (e.dtype, e.shape)
        torch.testing.assert_close(a, e, rtol=tolerance, atol=tolerance * float(e.abs().max()))


@every_dtype
@every_size
def test_fast_backends_equal_the_reference(size: tuple[int, int, int], dtype: torch.dtype) -> None:
    for call in calls(size, dtype):
        assert_same(results(call, "numba"), results(call, "torch"), TOLERANCE[dtype])


@pytest.mark.parametrize("layout", [channels_last, slice_of_pixels, every_other_column, transposed])
def test_layout_in_memory_changes_nothing(layout: Callable[[Tensor], Tensor]) -> None:
    size = (2, 5, 70)
    for laid_out, contiguous in zip(calls(size, torch.float32, layout), calls(size, torch.float32), strict=True):
        assert all(map(torch.equal, results(laid_out, "numba"), results(contiguous, "numba")))


def test_threads_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_runtime, "PIXELS_A_THREAD", 1)
    found = []
    for count in (1, 2, 5):
        torch.set_num_threads(count)
        found.append([result for call in calls((2, 9, 6), torch.float32) for result in results(call, "numba")])
    for other in found[1:]:
        assert all(map(torch.equal, other, found[0]))


@every_size
def test_predictions_in_bfloat16_are_read_as_they_are(size: tuple[int, int, int]) -> None:
    batch, height, width = size
    fine, coarse = draw(1, batch, 3, height, width, torch.float32), draw(2, *_half(size), torch.float32)
    prediction = channels_last(draw(3, batch, 12, height, width, torch.bfloat16))
    weight, bias = draw(4, 1, 6, 3, 3, torch.float32), torch.zeros(1)
    call: Call = (network.gated_fusion, [fine, coarse, weight, bias], {"residual": prediction[:, 9:]})
    assert_same(results(call, "numba"), results(call, "torch"), TOLERANCE[torch.float32])


@every_dtype
@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_a_scale_of_radiance_keeps_what_is_no_number(backend: str, dtype: torch.dtype) -> None:
    image = torch.full((1, 3, 4, 5), torch.nan, dtype=dtype)
    assert by(backend, transfer.compress)(image).isnan().all()
    assert by(backend, transfer.expand)(image).isnan().all()
    ends = torch.tensor([-torch.inf, -1.0, 0.0, torch.inf], dtype=dtype).reshape(1, 1, 2, 2)
    expected = [0.0, 0.0, 0.0, 1.0]
    assert by(backend, transfer.compress)(ends).flatten().tolist() == pytest.approx(expected, abs=1e-6)
    assert by(backend, transfer.expand)(ends).flatten().tolist() == [0.0, 0.0, 0.0, torch.inf]


def _half(size: tuple[int, int, int]) -> tuple[int, int, int, int]:
    return size[0], 3, (size[1] + 1) // 2, (size[2] + 1) // 2


@every_size
def test_the_input_of_a_network_has_the_precision_of_autocast(size: tuple[int, int, int]) -> None:
    for call in calls(size, torch.float32):
        if call[0] in (network.buffers_input, tuned.tuned_input):
            plain = results(call, "torch")[0]
            with torch.autocast("cpu", torch.bfloat16):
                found = results(call, "numba")[0]
            assert found.dtype == torch.bfloat16
            assert found.is_contiguous(memory_format=torch.channels_last)
            # The rounding may fall to either side.
            torch.testing.assert_close(found.float(), plain, rtol=2**-7, atol=1e-6)


@pytest.mark.parametrize(("sky", "rows"), [(1e10, 1), (1e30, 60), (3e38, 95), (torch.inf, 60)])
def test_a_far_sky_hides_no_differences_of_what_is_near(rows: int, sky: float) -> None:
    """Blender writes 1e10 where nothing was hit, others 1e30; here and there one of these is beside infinity."""
    depth = draw(1, 1, 1, 100, 8, torch.float32).exp() * 5
    depth[..., :rows, :] = torch.inf
    expected = network.normalized_depth(depth, *network.depth_scale(depth))
    depth[..., :rows, :-1] = sky
    found = network.normalized_depth(depth, *network.depth_scale(depth))
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=0)


def test_depths_of_zero_are_finite() -> None:
    """Some renderers write 0 where nothing was hit."""
    depth = torch.ones(1, 1, 4, 6)
    depth[..., 0] = 0
    for image in (depth, torch.zeros_like(depth), torch.full_like(depth, 1e-38)):
        found = network.normalized_depth(image, *network.depth_scale(image))
        assert found.isfinite().all()
        assert 0 <= found.min() <= found.max() <= 1


def test_the_scale_of_depths_has_a_derivative() -> None:
    depth = (draw(1, 2, 1, 3, 4, torch.float64).exp() + 0.1).requires_grad_()

    def normalized(depth: Tensor) -> Tensor:
        return network.normalized_depth(depth, *network.depth_scale(depth))

    assert torch.autograd.gradcheck(normalized, (depth,))
    depth = depth.detach().clone()
    depth[0, 0, 0, 0], depth[1, 0, 0, 0] = torch.inf, 1e10
    depth.requires_grad_()
    assert torch.autograd.grad(normalized(depth).sum(), depth)[0].isfinite().all()
