"""Properties of the ops on any input: hypothesis draws shapes, dtypes and values, and shrinks the inputs that fail.

A failure that turns up here becomes a row of the op in ``mcdenoise/check/``.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from torch import Tensor

from mcdenoise import ops

# The same examples every time, so that a failure is that of the change, not of the day.
settings.register_profile("deterministic", max_examples=20, derandomize=True, deadline=None, database=None)
settings.load_profile("deterministic")

DTYPES = (torch.float32, torch.bfloat16, torch.float16)
BORDERS = ("replicate", "zeros", "renormalize")
Size = tuple[int, int, int, int]

sizes = st.tuples(st.integers(0, 2), st.integers(1, 4), st.integers(1, 6), st.integers(1, 6))
dtypes = st.sampled_from(DTYPES)
radiances = st.one_of(
    st.sampled_from([0.0, 1e-40, 1e-30, 1e-4, 1.0, 65504.0, 1e6, 1e30]), st.floats(0, 1e30, allow_subnormal=False)
)
anything = st.floats(allow_nan=True, allow_infinity=True)


@st.composite
def images(
    draw: Any,
    size: Size,
    dtype: torch.dtype,
    elements: st.SearchStrategy[float] = radiances,
    channels: int | None = None,
) -> Tensor:
    """Values as a dtype has them: beyond its range its largest, as in an image that was saved."""
    shape = size if channels is None else (size[0], channels, *size[2:])
    values = torch.from_numpy(draw(arrays(np.float64, shape, elements=elements)))
    largest = torch.finfo(dtype).max
    return torch.where(values.isfinite(), values.clamp(-largest, largest), values).to(dtype)


def eps(dtype: torch.dtype, roundings: int = 1) -> float:
    """Relative: the last rounding, and those in float32 before."""
    return torch.finfo(dtype).eps / 2 + roundings * torch.finfo(torch.float32).eps


def assert_between(result: Tensor, *images: Tensor, roundings: int) -> None:
    """A weighted mean of images of no negative values lies between their minimum and maximum, up to rounding."""
    if result.numel():
        low, high = (float(f(torch.stack([f(image.double()) for image in images]))) for f in (torch.min, torch.max))
        slack = eps(result.dtype, roundings)
        # Denormal numbers have fewer digits.
        tiny = torch.finfo(result.dtype).tiny
        assert float(result.double().min()) >= low * (1 - slack) - tiny
        assert float(result.double().max()) <= high * (1 + slack) + tiny


@st.composite
def weighted(draw: Any) -> tuple[Tensor, Tensor]:
    """An image and kernels of sum one."""
    size, dtype, side = draw(sizes), draw(dtypes), draw(st.sampled_from([1, 3, 5]))
    image = draw(images(size, dtype))
    logits = draw(images(size, torch.float32, st.floats(-20, 20), side * side))
    return image, torch.softmax(logits, 1)


@given(weighted(), st.sampled_from(["replicate", "renormalize"]))
def test_a_filter_of_sum_one_stays_between_the_extremes(drawn: tuple[Tensor, Tensor], border: Any) -> None:
    image, kernel = drawn
    assume(float(image.max() if image.numel() else 0) < torch.finfo(image.dtype).max / 2)
    assert_between(ops.kernel_conv(image, kernel, border=border), image, roundings=60)


@given(weighted(), st.sampled_from(BORDERS), st.integers(0, 35), st.sampled_from([math.nan, math.inf]))
def test_a_broken_pixel_reaches_its_window_and_no_further(
    drawn: tuple[Tensor, Tensor], border: Any, place: int, value: float
) -> None:
    image, kernel = drawn
    assume(len(image))
    side, (height, width) = math.isqrt(kernel.shape[1]), image.shape[-2:]
    row, column = divmod(place % (height * width), width)
    before = ops.kernel_conv(image, kernel, border=border)
    image = image.clone()
    image[..., row, column] = value
    rows = (torch.arange(height) - row).abs() > side // 2
    columns = (torch.arange(width) - column).abs() > side // 2
    outside = rows[:, None] | columns
    assert torch.equal(ops.kernel_conv(image, kernel, border=border)[..., outside], before[..., outside])


@given(st.data(), sizes, dtypes, st.sampled_from(BORDERS), st.sampled_from([1, 3, 5]))
def test_bilateral_weights_are_weights(data: st.DataObject, size: Size, dtype: Any, border: Any, side: int) -> None:
    logits = data.draw(images(size, dtype, st.floats(-1e4, 1e4) | st.just(-math.inf) | st.just(math.inf), side * side))
    guide = data.draw(images(size, dtype, st.floats(-1e10, 1e10)))
    falloffs = [data.draw(images(size, dtype, st.floats(0, 1e8), 1)) for _ in range(2)]
    weights = ops.cross_bilateral_weights(logits, [guide], falloffs[:1], falloffs[1], border=border)
    assert weights.dtype == dtype
    assert bool((weights >= 0).all())
    total = weights.double().sum(1)
    torch.testing.assert_close(total, torch.ones_like(total), rtol=0, atol=eps(dtype, 60) + side**2 * 1e-4 * eps(dtype))


@given(st.data(), sizes, dtypes)
def test_remodulating_undoes_demodulating(data: st.DataObject, size: Size, dtype: Any) -> None:
    color, albedo = data.draw(images(size, dtype)), data.draw(images(size, dtype, st.floats(0, 2)))
    light = ops.demodulate(color, albedo)
    assume(bool(light.isfinite().all()))
    back = ops.remodulate(light, albedo)
    # Each of the two rounds once; a light below the normal numbers has lost digits.
    torch.testing.assert_close(back.double(), color.double(), rtol=3 * eps(dtype, 4), atol=4 * torch.finfo(dtype).tiny)


@given(st.data(), sizes, dtypes, st.sampled_from([3, 7, 99]), st.sampled_from([1e-6, 1.0, 30.0, 1e30, math.inf]))
def test_clamping_only_darkens(data: st.DataObject, size: Size, dtype: Any, side: int, limit: float) -> None:
    image = data.draw(images(size, dtype))
    clamped = ops.clamp_fireflies(image, limit=limit, kernel_size=side)
    assert bool(clamped.isfinite().all())
    assert bool((clamped >= 0).all())
    assert bool((clamped <= image).all())


@given(st.data(), sizes, dtypes)
def test_downsampling_undoes_upsampling(data: st.DataObject, size: Size, dtype: Any) -> None:
    image = data.draw(images(size, dtype))
    assume(float(image.max() if image.numel() else 0) < torch.finfo(dtype).max / 4)
    odd = (2 * size[2] - 1, 2 * size[3] - 1)
    upsampled = ops.upsample(image, odd)
    down = ops.downsample(upsampled).double()
    torch.testing.assert_close(down, image.double(), rtol=eps(dtype, 3), atol=torch.finfo(dtype).tiny)
    zero, one = (torch.full((size[0], 1, *odd), alpha, dtype=dtype) for alpha in (0.0, 1.0))
    assert torch.equal(ops.laplacian_fusion(upsampled, 2 * image, zero), upsampled)
    assert_between(ops.laplacian_fusion(upsampled, image, one), image, roundings=8)


@given(st.data(), sizes, dtypes, st.sampled_from([1e-6, 0.1, 1.0]))
def test_accumulating_stays_between_history_and_frame(
    data: st.DataObject, size: Size, dtype: Any, alpha_min: float
) -> None:
    color, previous = data.draw(images(size, dtype)), data.draw(images(size, dtype))
    length = data.draw(images(size, dtype, st.floats(1, 1e4), 1))
    motion = data.draw(images(size, dtype, st.floats(-8, 8) | anything, 2))
    accumulated, grown = ops.accumulate(color, previous, length, motion, alpha_min=alpha_min)
    assert_between(accumulated, color, previous, roundings=16)
    assert bool((grown >= 1).all())
    assert grown.numel() == 0 or float(grown.max()) <= float(length.max()) * (1 + 16 * eps(dtype)) + 1


@given(st.data(), sizes, dtypes)
def test_an_unknown_place_has_no_motion_but_no_nan(data: st.DataObject, size: Size, dtype: Any) -> None:
    position = data.draw(images(size, dtype, st.floats(-1e15, 1e15) | anything, 3))
    matrix = torch.eye(4, dtype=dtype).repeat(size[0], 1, 1)
    matrix[:, 2, 3], matrix[:, 3, 3] = 1, 0
    motion = ops.motion_from_position(position, matrix)
    in_front = position.isfinite().all(1, keepdim=True) & (position[:, 2:] > 0)
    assert not motion.isnan().any()
    assert bool((motion == math.inf)[~in_front.expand_as(motion)].all())


@given(st.data(), sizes, dtypes, st.sampled_from([3, 7]))
def test_lag_is_a_fraction(data: st.DataObject, size: Size, dtype: Any, side: int) -> None:
    history, recent = data.draw(images(size, dtype)), data.draw(images(size, dtype))
    variance = data.draw(images(size, dtype, st.floats(0, float(torch.finfo(dtype).max)), 1))
    share = ops.history_lag(history, recent, variance, kernel_size=side)
    assert bool(((share >= 0) & (share <= 1)).all())
    assert not ops.history_lag(history, history, variance, kernel_size=side).any()


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@given(data=st.data(), size=sizes)
def test_gradients_of_a_denoiser_are_finite(data: st.DataObject, dtype: torch.dtype, size: Size) -> None:
    """All ops in a row; radiance 2e3 over the least albedo that divides is what half precision holds."""
    color, previous = (data.draw(images(size, dtype, st.floats(0, 2e3), 3)).requires_grad_() for _ in range(2))
    albedo = data.draw(images(size, dtype, st.floats(0, 1), 3)).requires_grad_()
    logits = data.draw(images(size, dtype, st.floats(-1e4, 1e4), 9)).requires_grad_()
    scale = data.draw(images(size, dtype, st.floats(0, 1e8), 1)).requires_grad_()
    motion = data.draw(images(size, dtype, st.floats(-2, 2) | anything, 2))
    light = ops.clamp_fireflies(ops.demodulate(color, albedo))
    light, _ = ops.accumulate(light, previous, torch.ones_like(scale), motion)
    weights = ops.cross_bilateral_weights(logits, [albedo], [scale], border="renormalize")
    image = ops.kernel_conv(light, weights, border="zeros")
    image = ops.laplacian_fusion(image, ops.downsample(light), torch.full_like(scale, 0.5))
    image = torch.lerp(image, light, ops.history_lag(image, light, scale))
    total = ops.remodulate(image, albedo).float().mean() if image.numel() else image.sum()
    for gradient in torch.autograd.grad(total, (color, previous, albedo, logits, scale), allow_unused=True):
        assert gradient is None or bool(gradient.isfinite().all())
