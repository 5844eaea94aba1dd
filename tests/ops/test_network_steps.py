"""The compiled steps between the convolutions of a network against their reference, formulas of torch."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from reference_cases import by, channels_last, every_other_column, slice_of_pixels, transposed
from torch import Tensor

from mcdenoise.ops import downsample
from mcdenoise.ops._numba import _runtime
from mcdenoise.ops._steps import network, transfer, tuned

# The tolerance is relative to the largest number in a result: a few roundings of sums of up to 54 products.
TOLERANCE = {dtype: 32 * torch.finfo(dtype).eps for dtype in (torch.float32, torch.float64)}
SIZES = [(1, 1, 1), (2, 5, 7), (1, 8, 300), (2, 33, 2), (1, 2, 1030)]

every_size = pytest.mark.parametrize("size", SIZES, ids=str)
every_dtype = pytest.mark.parametrize("dtype", TOLERANCE, ids=str)


@pytest.fixture(autouse=True)
def nan_in_fresh_memory() -> Iterator[None]:
    """Fills what is left to be written with NaN, so that what was forgotten shows."""
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)


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
    threads, found = torch.get_num_threads(), []
    try:
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            found.append([result for call in calls((2, 9, 6), torch.float32) for result in results(call, "numba")])
    finally:
        torch.set_num_threads(threads)
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


@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_a_choice_without_a_share_has_no_weight_however_large_its_logit(backend: str) -> None:
    predicted, images = draw(1, 2, 7, 5, 6, torch.float32).tanh(), draw(2, 2, 9, 5, 6, torch.float32).sigmoid()
    valid, exposure, offsets = torch.zeros(2, 1, 5, 6), torch.ones(1, 1, 1, 1), (0.0, 0.0, 0.0, 0.0)
    expected = by("torch", tuned.tuned_choice)(predicted, images, valid, exposure, offsets)
    predicted[:, 4:6] += 300
    found = by(backend, tuned.tuned_choice)(predicted, images, valid, exposure, offsets)
    assert_same([found], [expected], TOLERANCE[torch.float32])


def test_one_exposure_is_for_all_images_of_a_batch() -> None:
    images = [draw(seed, 3, 3, 4, 6, torch.float32).exp() for seed in range(3)]
    valid, exposure = torch.ones(3, 1, 4, 6), torch.full((1, 1, 1, 1), 0.7)
    arguments = (*images, None, None, valid, exposure, 4)
    found, expected = (by(backend, tuned.tuned_input)(*arguments) for backend in ("numba", "torch"))
    assert_same(list(found), list(expected), TOLERANCE[torch.float32])


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


def test_alpha_under_autocast_is_that_of_float32() -> None:
    call = calls((1, 8, 30), torch.float32)[0]
    plain = results(call, "torch")
    with torch.autocast("cpu", torch.bfloat16):
        fast, rounded = results(call, "numba"), results(call, "torch")
    assert_same(fast, plain, TOLERANCE[torch.float32])
    assert (rounded[0] - plain[0]).abs().max() > 1e-4


@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_a_coarse_scale_that_agrees_changes_nothing(backend: str) -> None:
    """The paper's Eq. 2 with ``i_c = D i_f`` is ``i_f``, whatever alpha; also of logarithms, at an edge of light."""
    fine = draw(1, 2, 3, 9, 14, torch.float64).exp()
    fine[:, :, :5], fine[:, :, 5:] = 0.1 * fine[:, :, :5], 3 * fine[:, :, 5:]
    weight, bias = draw(2, 1, 6, 3, 3, torch.float64), torch.tensor([0.2], dtype=torch.float64)
    coarse = torch.log1p(downsample(fine))
    fused = by(backend, network.gated_fusion)(fine, coarse, weight, bias, logarithms=True)
    torch.testing.assert_close(fused, torch.log1p(fine), rtol=0, atol=1e-13)


def test_logarithms_have_no_residual() -> None:
    fine = torch.ones(1, 3, 4, 4)
    with pytest.raises(ValueError, match="residual:"):
        network.gated_fusion(
            fine, fine[..., ::2, ::2], torch.ones(1, 6, 3, 3), torch.ones(1), residual=fine, logarithms=True
        )


def test_numbers_of_any_size() -> None:
    image = torch.tensor([0, 1e-40, 1e-30, 1e-8, 0.3, 0.5, 1, 7, 3e5, 1e20, 1e38])
    image = image.reshape(1, 1, 1, -1).expand(1, 3, 2, -1)
    # The fusion turns logarithms back, and changes nothing where alpha is 0.
    logs = torch.log1p(image)
    weight, bias, maximum = torch.zeros(1, 6, 3, 3), torch.tensor([-1e4]), torch.full((1, 1, 1, 1), 80.0)
    given = (logs, downsample(logs), weight, bias)
    fast, plain = (by(name, network.gated_fusion)(*given, maximum=maximum) for name in ("numba", "torch"))
    torch.testing.assert_close(fast, plain, rtol=1e-5, atol=0)
    torch.testing.assert_close(fast[..., :10], image[..., :10], rtol=1e-5, atol=1e-37)


def test_nan_stays_where_it_is_and_below_zero_is_zero() -> None:
    fine = torch.full((1, 3, 6, 9), -1.0)
    fine[..., 2, 4] = torch.nan
    weight, bias, maximum = torch.zeros(1, 6, 3, 3), torch.tensor([-1e4]), torch.ones(1, 1, 1, 1)
    fused = by("numba", network.gated_fusion)(fine, torch.zeros(1, 3, 3, 5), weight, bias, maximum=maximum)
    assert fused[..., 2, 4].isnan().all()
    assert fused[..., 3:, 6:].unique().tolist() == [0]


def test_where_nothing_was_hit_there_is_no_depth() -> None:
    depth = torch.full((2, 1, 3, 4), torch.inf)
    depth[1, 0, 1] = torch.tensor([1.0, 4.0, torch.inf, 2.0])
    near, typical = (part.flatten().tolist() for part in network.depth_scale(depth))
    # The mean of 1 / sqrt(d) is (1 + 1 / 2 + 1 / sqrt(2)) / 3, the geometric mean of d is 2.
    assert near == pytest.approx([1, (9 / (1.5 + math.sqrt(0.5)) ** 2)])
    assert [unit * each for unit, each in zip(near, typical, strict=True)] == pytest.approx([1, 2])


@pytest.mark.parametrize("unit", [1e-20, 1.0, 1e20])
def test_normalised_depth_is_that_of_the_geometric_mean(unit: float) -> None:
    depth = draw(1, 2, 1, 9, 40, torch.float64).exp()
    depth[0, 0, :4] = torch.inf
    hits = torch.isfinite(depth)
    means = [torch.exp(torch.log(image[hit]).mean()) for image, hit in zip(depth, hits, strict=True)]
    expected = torch.where(hits, 1 - 1 / (1 + depth / torch.stack(means).reshape(2, 1, 1, 1)), 1)
    depth = (depth * unit).float()
    found = network.normalized_depth(depth, *network.depth_scale(depth))
    torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=0)


@pytest.mark.parametrize("sky", [1e10, 1e30, 3e38, torch.inf])
@pytest.mark.parametrize("rows", [1, 60, 95])
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


def test_the_reference_runs_where_derivatives_are_needed() -> None:
    for function, arguments, settings in calls((1, 96, 96), torch.float32):
        leaf = arguments[0].clone().requires_grad_()
        found = function(leaf, *arguments[1:], **settings)
        result = found if isinstance(found, Tensor) else found[1]
        assert torch.autograd.grad(result.sum(), leaf)[0].shape == leaf.shape
        with pytest.raises(ValueError, match="found 'numba', which has no derivatives of this op"):
            by("numba", function)(leaf, *arguments[1:], **settings)


def test_an_empty_batch() -> None:
    empty = torch.ones(0, 3, 4, 6)
    given = (empty, empty[..., ::2, ::2], torch.ones(1, 6, 3, 3), torch.ones(1))
    assert by("numba", network.gated_fusion)(*given).shape == empty.shape
    assert by("numba", transfer.compress)(empty).shape == empty.shape
