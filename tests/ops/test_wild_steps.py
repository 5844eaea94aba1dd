"""The compiled steps before and behind the networks against their reference, formulas of torch."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
from reference_cases import LAYOUTS, by
from torch import Tensor

from mcdenoise.check.case import as_tuple
from mcdenoise.ops._numba import _runtime
from mcdenoise.ops._steps import transfer, wild

pytestmark = pytest.mark.usefixtures("nan_in_fresh_memory")
# The tolerance is relative to the largest number in a result: a few roundings.
TOLERANCE = {dtype: 32 * torch.finfo(dtype).eps for dtype in (torch.float32, torch.float64)}
SIZES = [(1, 1, 1), (2, 33, 2), (1, 2, 1030)]

every_size = pytest.mark.parametrize("size", SIZES, ids=str)
every_dtype = pytest.mark.parametrize("dtype", TOLERANCE, ids=str)


def as_it_is(tensor: Tensor) -> Tensor:
    return tensor


def draw(seed: int, batch: int, channels: int, height: int, width: int, dtype: torch.dtype) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(batch, channels, height, width, generator=generator, dtype=torch.float64).to(dtype)


Call = tuple[Callable[..., Any], list[Any]]


def calls(size: tuple[int, int, int], dtype: torch.dtype, layout: Callable[[Tensor], Tensor] = as_it_is) -> list[Call]:
    batch, height, width = size

    def some(seed: int, channels: int) -> Tensor:
        return layout(draw(seed, batch, channels, height, width, dtype))

    exposure = 0.7 * (1 + torch.arange(1, batch + 1, dtype=dtype).reshape(-1, 1, 1, 1))
    # Some pixels have no history, or no albedo, and some features are out of their range.
    seen, part, length = [some(5, 3), some(6, 3)], some(23, 1).clamp(0, 1), 2 + 3 * some(24, 1)
    radiance = [layout(draw(seed, batch, 3, height, width, dtype).exp()) for seed in (3, 19, 20)]
    logits = layout(draw(25, batch, 2, -(-height // 4), -(-width // 4), dtype))
    predicted, on_scale = (layout(draw(21, batch, count, height, width, dtype).tanh()) for count in (7, 9))
    calls: list[Call] = [
        # From the dark, where the scale is linear, to the largest radiance and beyond.
        (transfer.compress, [layout((6 * draw(15, batch, 3, height, width, dtype)).exp())]),
        (transfer.expand, [layout(draw(16, batch, 3, height, width, dtype).sigmoid())]),
        (wild.wild_figures, [*radiance, *seen, length, exposure]),
        (wild.wild_figures, [*radiance, None, None, length, exposure]),
        (wild.wild_input, [*radiance, *seen, length, logits, exposure, 4]),
        (wild.wild_input, [*radiance, None, None, length, logits, exposure, 1]),
        (wild.wild_choice, [predicted, on_scale, part, seen[0], exposure, (0.0, -2.0, -1.0, 0.5), 3.0]),
        (wild.wild_choice, [predicted, on_scale, part, None, exposure, (0.0, -2.0, -1.0, 0.5), 3.0]),
    ]
    return calls


def results(call: Call, backend: str) -> list[Tensor]:
    function, arguments = call
    found = list(as_tuple(by(backend, function)(*arguments)))
    if function is wild.wild_figures:
        # Radiance is larger than the rest.
        means, radiance, variances = found[0].split([11, 3, 5], 1)
        found = [torch.cat([means, variances], 1), radiance]
    return found


def assert_same(actual: list[Tensor], expected: list[Tensor], tolerance: float) -> None:
    for a, e in zip(actual, expected, strict=True):
        assert (a.dtype, a.shape) == (e.dtype, e.shape)
        torch.testing.assert_close(a, e, rtol=tolerance, atol=tolerance * float(e.abs().max()))


@every_dtype
@every_size
def test_fast_backends_equal_the_reference(size: tuple[int, int, int], dtype: torch.dtype) -> None:
    for call in calls(size, dtype):
        assert_same(results(call, "numba"), results(call, "torch"), TOLERANCE[dtype])


@pytest.mark.parametrize("layout", LAYOUTS)
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


@every_size
def test_the_input_of_a_network_has_the_precision_of_autocast(size: tuple[int, int, int]) -> None:
    for call in calls(size, torch.float32):
        if call[0] is wild.wild_input:
            plain = results(call, "torch")[0]
            with torch.autocast("cpu", torch.bfloat16):
                found = results(call, "numba")[0]
            assert found.dtype == torch.bfloat16
            assert found.is_contiguous(memory_format=torch.channels_last)
            # The rounding may fall to either side.
            torch.testing.assert_close(found.float(), plain, rtol=2**-7, atol=1e-6)
