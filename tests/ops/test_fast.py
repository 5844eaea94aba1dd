"""The compiled forms against the plain ones."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from plain_form import (
    FAST,
    TOLERANCE,
    assert_same,
    channels_last,
    drawn,
    every_other_column,
    leaves_of,
    outcomes,
    slice_of_pixels,
    transposed,
)
from torch import Tensor

from mcdenoise import ops
from mcdenoise.ops import _backend
from mcdenoise.ops._cases import OPS, Case, Inputs, Op, map_tensors
from mcdenoise.ops._fast import _numba_filter

every_op = pytest.mark.parametrize("op", FAST, ids=lambda op: op.name)
every_dtype = pytest.mark.parametrize("dtype", TOLERANCE, ids=str)


@pytest.fixture(autouse=True)
def nan_in_fresh_memory() -> Iterator[None]:
    """Fills what is left to be written with NaN, so that what was forgotten shows."""
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)


@every_dtype
@pytest.mark.parametrize(
    ("op", "case"),
    # The extreme ones have bounds of their own, see `mcdenoise stability`.
    [pytest.param(op, case, id=f"{op.name}-{case.name}") for op in FAST for case in op.cases if case.differentiable],
)
def test_result_and_derivatives_are_those_of_the_plain_form(op: Op, case: Case, dtype: torch.dtype) -> None:
    actual = outcomes(op, case, case.inputs(dtype), "numba")
    assert {tensor.dtype for tensor in actual} == {dtype}
    # The same numbers in float64: what differs is the arithmetic.
    exact = outcomes(op, case, map_tensors(lambda tensor: tensor.double(), case.inputs(dtype)), "torch")
    assert_same(actual, exact, TOLERANCE[dtype])


# Wider than a run of pixels, taller than a share, smaller than the kernel.
@pytest.mark.parametrize("size", [(1, 3, 3, 300, 5), (1, 4, 40, 2, 7), (2, 3, 7, 9, 3), (1, 1, 1, 1, 5)], ids=str)
@pytest.mark.parametrize("border", ["replicate", "zeros", "renormalize"])
@every_op
def test_sizes(op: Op, border: str, size: tuple[int, int, int, int, int]) -> None:
    case = drawn(*size, op, border=border)
    assert_same(
        outcomes(op, case, case.inputs(), "numba"), outcomes(op, case, case.inputs(), "torch"), TOLERANCE[torch.float64]
    )


@pytest.mark.parametrize("border", ["replicate", "zeros", "renormalize"])
@every_op
def test_threads_change_nothing(op: Op, border: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_numba_filter, "_PIXELS_A_THREAD", 1)
    case = drawn(2, 3, 9, 6, 5, op, border=border)
    threads, results = torch.get_num_threads(), []
    try:
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            results.append(outcomes(op, case, case.inputs(torch.float32), "numba"))
    finally:
        torch.set_num_threads(threads)
    for result in results[1:]:
        assert all(map(torch.equal, result, results[0]))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=str)
@pytest.mark.parametrize("layout", [channels_last, slice_of_pixels, every_other_column, transposed])
@every_op
def test_layout_in_memory_changes_nothing(op: Op, layout: Callable[[Tensor], Tensor], dtype: torch.dtype) -> None:
    case = drawn(2, 3, 5, 7, 3, op)
    inputs = {
        name: [layout(part) for part in value] if isinstance(value, list) else layout(value)
        for name, value in case.inputs(dtype).items()
    }
    laid_out = outcomes(op, case, inputs, "numba")
    assert all(map(torch.equal, laid_out, outcomes(op, case, case.inputs(dtype), "numba")))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=str)
@pytest.mark.parametrize("border", ["replicate", "zeros", "renormalize"])
def test_what_is_spread_is_the_same_without_the_slopes_of_the_kernel(border: Any, dtype: torch.dtype) -> None:
    inputs = drawn(2, 3, 9, 300, 5, FAST[1]).inputs(dtype)
    image, kernel = inputs["image"], inputs["kernel"]
    alone, with_slopes = (
        _numba_filter.derivatives(image, image, kernel, (), (), None, False, border, of_kernel=wanted)
        for wanted in (False, True)
    )
    assert torch.equal(alone[0], with_slopes[0])
    assert [of_kernel.numel() for of_kernel in (alone[1], with_slopes[1])] == [0, kernel.numel()]
    assert torch.equal(ops.kernel_splat(image, kernel, border=border, backend="numba"), alone[0])


@every_op
def test_other_dtypes_beside_the_image(op: Op) -> None:
    case = drawn(1, 3, 5, 7, 3, op)
    inputs = case.inputs(torch.float32)
    inputs["kernel"] = inputs["kernel"].bfloat16()
    actual = outcomes(op, case, inputs, "numba")
    assert [tensor.dtype for tensor in actual[:3]] == [torch.float32, torch.float32, torch.bfloat16]
    exact = outcomes(op, case, map_tensors(lambda tensor: tensor.detach().double(), inputs), "torch")
    of_kernel = actual.pop(2), exact.pop(2)
    assert_same(actual, exact, TOLERANCE[torch.float32])
    assert_same([of_kernel[0]], [of_kernel[1]], TOLERANCE[torch.bfloat16])


@every_op
def test_first_derivatives_are_difference_quotients_and_second_ones_go_the_plain_way(op: Op) -> None:
    for border in ("replicate", "renormalize"):
        case = drawn(1, 2, 2, 3, 3, op, border=border)
        inputs = case.inputs()
        leaves = leaves_of(inputs, case)

        def function(*tensors: Tensor, inputs: Inputs = inputs, case: Case = case) -> Tensor:
            rest = iter(tensors)
            return op.function(**map_tensors(lambda _: next(rest), inputs), **case.settings, backend="numba")

        assert torch.autograd.gradcheck(function, leaves, fast_mode=False)
        assert torch.autograd.gradgradcheck(function, leaves, fast_mode=False)


def test_second_derivatives_where_one_argument_is_computed_from_another() -> None:
    image = torch.rand(1, 1, 3, 3, dtype=torch.float64, requires_grad=True)

    def function(image: Tensor) -> Tensor:
        return ops.kernel_conv(image, image.expand(1, 9, 3, 3) * 2, backend="numba")

    assert torch.autograd.gradgradcheck(function, image, fast_mode=False)


# The compiler raises deprecation warnings of torch's own making.
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@every_op
def test_goes_through_the_compiler(op: Op) -> None:
    case = drawn(2, 3, 5, 7, 3, op)
    torch.compiler.reset()
    compiled = torch.compile(op.function, fullgraph=True, backend="aot_eager")
    through = Op(compiled, op.reference, op.cases)
    assert_same(outcomes(through, case, case.inputs(), "numba"), outcomes(op, case, case.inputs(), "numba"), 1e-15)


class _Filter(torch.nn.Module):
    def __init__(self, backend: Any) -> None:
        super().__init__()
        self.filter = ops.CrossBilateralFilter(backend=backend)

    def forward(self, image: Tensor, kernel: Tensor, guide: Tensor, scale: Tensor) -> Tensor:
        return self.filter(image, kernel, [guide], [scale])


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_is_exported_where_it_is_named() -> None:
    # Large enough that it would run compiled.
    arguments = (torch.rand(1, 3, 96, 96), torch.rand(1, 9, 96, 96), torch.rand(1, 2, 96, 96), torch.rand(1, 1, 96, 96))
    for backend, there in (("numba", True), (None, False)):
        program = torch.export.export(_Filter(backend), arguments)
        assert ("mcdenoise.cross_bilateral_filter" in str(program.graph)) is there
        torch.testing.assert_close(program.module()(*arguments), _Filter("torch")(*arguments))


@pytest.mark.parametrize("needed", [("image",), ("kernel",), ("scales",), ("guides",)])
def test_derivatives_of_some_arguments_only(needed: tuple[str, ...]) -> None:
    op = FAST[-1]
    case = drawn(1, 3, 5, 7, 3, op)
    partial = Case("partial", "ordinary", case.tensors, needed, {})
    assert_same(
        outcomes(op, partial, partial.inputs(), "numba"), outcomes(op, partial, partial.inputs(), "torch"), 1e-13
    )


def test_an_empty_batch() -> None:
    image, kernel = torch.rand(0, 3, 4, 5, requires_grad=True), torch.rand(0, 9, 4, 5)
    result = ops.kernel_conv(image, kernel, backend="numba")
    assert result.shape == image.shape
    assert torch.autograd.grad(result.sum(), image)[0].shape == image.shape


def test_what_runs_by_default(monkeypatch: pytest.MonkeyPatch) -> None:
    large, small = torch.rand(2, 3, 64, 64), torch.rand(1, 3, 64, 64)
    assert _backend.choose_backend(None, large) == "numba"
    assert _backend.choose_backend(None, small) == "torch"
    assert _backend.choose_backend("torch", large) == "torch"
    assert _backend.choose_backend(None, large.to("meta")) == "torch"
    assert _backend.choose_backend("numba", small) == "numba"
    monkeypatch.setattr(_backend, "_missing", lambda backend: "cannot be imported")
    assert _backend.choose_backend(None, large) == "torch"


def test_another_backend_may_be_preferred_for_a_while() -> None:
    large, small = torch.rand(2, 3, 64, 64), torch.rand(1, 3, 4, 4)
    with _backend.preferred("torch"):
        assert _backend.choose_backend(None, large) == "torch"
        assert _backend.choose_backend("numba", large) == "numba"
        with pytest.raises(ValueError, match="backend: expected one of"), _backend.preferred("c"):  # type: ignore[arg-type]
            pytest.fail("entered")
        with _backend.preferred("numba"):
            assert _backend.choose_backend(None, small) == "numba"
            assert _backend.choose_backend(None, small.to("meta")) == "torch"
    assert _backend.choose_backend(None, large) == "numba"


def test_denormal_numbers_are_flushed_in_derivatives_and_nowhere_else() -> None:
    image, kernel = torch.ones(1, 1, 3, 3), torch.full((1, 9, 3, 3), 1e-40)
    for flush in (False, True):
        torch.set_flush_denormal(flush)
        try:
            assert ops.kernel_splat(image, kernel, backend="numba").eq(0).all()
            # Where all numbers are small, denormal ones count.
            assert bool(ops.kernel_splat(1e-20 * image, 1e20 * kernel, backend="numba").eq(0).all()) is flush
            assert bool(ops.kernel_conv(image, kernel, backend="numba").eq(0).all()) is flush
            assert bool((image * kernel[:, :1] == 0).all()) is flush
        finally:
            torch.set_flush_denormal(False)


def test_a_named_backend_runs_or_says_why_it_cannot(monkeypatch: pytest.MonkeyPatch) -> None:
    image, kernel = torch.rand(1, 3, 4, 5), torch.rand(1, 9, 4, 5)
    with pytest.raises(ValueError, match="backend: expected one of torch, numba, triton, found 'cuda'"):
        ops.kernel_conv(image, kernel, backend="cuda")  # type: ignore[arg-type]
    for module in (ops.KernelConv, ops.KernelSplat, ops.CrossBilateralFilter, ops.Accumulate):
        with pytest.raises(ValueError, match="backend: expected one of torch, numba, triton, found 'c'"):
            module(backend="c")
    with pytest.raises(ValueError, match="found 'numba', which runs on the CPU, not on meta"):
        ops.kernel_conv(image.to("meta"), kernel.to("meta"), backend="numba")

    def gone(name: str) -> None:
        raise ImportError("gone")

    monkeypatch.setattr(_backend.importlib, "import_module", gone)
    _backend._tried_import.cache_clear()
    with pytest.raises(
        ValueError, match=r"found 'numba', which cannot be imported \(gone\); install mcdenoise\[fast\]"
    ):
        ops.cross_bilateral_filter(image, kernel, backend="numba")
    _backend._tried_import.cache_clear()


ACCUMULATE = next(op for op in OPS if op.name == "accumulate")


@every_dtype
@pytest.mark.parametrize("case", ACCUMULATE.cases, ids=lambda case: case.name)
def test_accumulation_is_that_of_the_plain_form(case: Case, dtype: torch.dtype) -> None:
    inputs = case.inputs(dtype)
    actual = ops.accumulate(**inputs, **case.settings, backend="numba")
    for result, plain in zip(actual, ops.accumulate(**inputs, **case.settings, backend="torch"), strict=True):
        assert result.dtype == dtype
        # Both round to half precision once.
        eps = torch.finfo(dtype).eps
        torch.testing.assert_close(result, plain, rtol=8 * eps, atol=8 * eps)


@pytest.mark.parametrize("rule", ["relative", "bmfr"])
@pytest.mark.parametrize("layout", [channels_last, slice_of_pixels, every_other_column, transposed])
def test_accumulation_of_any_layout_and_by_any_number_of_threads(
    layout: Callable[[Tensor], Tensor], rule: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_numba_filter, "_PIXELS_A_THREAD", 1)
    case = next(case for case in ACCUMULATE.cases if "all buffers" in case.name)
    inputs = case.inputs()
    limits: dict[str, Any] = {"rule": rule, "position_limit": 0.05, "normal_limit": 0.3}
    plain = ops.accumulate(**inputs, **limits, backend="torch")
    threads = torch.get_num_threads()
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            results = ops.accumulate(**map_tensors(layout, inputs), **limits, backend="numba")
            for result, expected in zip(results, plain, strict=True):
                torch.testing.assert_close(result, expected, rtol=1e-12, atol=1e-12)
    finally:
        torch.set_num_threads(threads)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_accumulation_goes_through_the_compiler() -> None:
    case = ACCUMULATE.cases[1]
    torch.compiler.reset()
    compiled = torch.compile(ops.accumulate, fullgraph=True, backend="aot_eager")
    results = compiled(**case.inputs(), **case.settings, backend="numba")
    for result, expected in zip(results, ops.accumulate(**case.inputs(), **case.settings), strict=True):
        torch.testing.assert_close(result, expected, rtol=1e-12, atol=1e-12)


def test_accumulation_with_derivatives_is_plain() -> None:
    case = ACCUMULATE.cases[0]
    inputs = case.inputs()
    leaves_of(inputs, case)
    with pytest.raises(ValueError, match="found 'numba', which has no derivatives of this op"):
        ops.accumulate(**inputs, **case.settings, backend="numba")
    color = torch.rand(1, 3, 96, 96, requires_grad=True)
    result, _ = ops.accumulate(color, color.detach(), color.detach()[:, :1] + 1, torch.zeros(1, 2, 96, 96))
    assert torch.autograd.grad(result.sum(), color)[0].shape == color.shape


@pytest.mark.parametrize(("settings", "message"), [({"rule": "svgf"}, "rule: expected"), ({"rule": "bmfr"}, "needs")])
def test_accumulation_refuses_what_the_plain_form_refuses(settings: dict[str, Any], message: str) -> None:
    inputs = ACCUMULATE.cases[1].inputs()
    for backend in ("torch", "numba"):
        with pytest.raises(ValueError, match=message):
            ops.accumulate(**inputs, **settings, backend=backend)


MOTION = next(op for op in OPS if op.name == "motion_from_position")


@every_dtype
@pytest.mark.parametrize("case", [case for case in MOTION.cases if case.kind != "extreme"], ids=lambda case: case.name)
def test_motion_is_that_of_the_plain_form(case: Case, dtype: torch.dtype) -> None:
    inputs = case.inputs(dtype)
    plain = ops.motion_from_position(**inputs, backend="torch")
    for layout in (torch.clone, channels_last, transposed):
        position = layout(inputs["position"])
        motion = ops.motion_from_position(position, inputs["previous_view_projection"], backend="numba")
        assert motion.dtype == plain.dtype
        assert torch.equal(motion.isinf(), plain.isinf())
        eps, largest = torch.finfo(motion.dtype).eps, plain[plain.isfinite()].abs().max().item()
        torch.testing.assert_close(motion, plain, rtol=8 * eps, atol=8 * eps * (largest + sum(plain.shape[2:])))


def test_motion_of_what_was_not_seen_is_infinite() -> None:
    matrix = torch.eye(4)[None]
    matrix[:, 2, 3], matrix[:, 3, 3] = 1, 0  # clip w = z
    position = torch.tensor(
        [[0.0, 0, 1], [0, 0, -1], [0, 0, 0], [torch.inf, 0, 1], [0, torch.nan, 1], [0, 0, torch.inf]]
    )
    motion = ops.motion_from_position(position.T.reshape(1, 3, 1, 6), matrix, backend="numba")
    assert motion.isinf().all(1).flatten().tolist() == [False, True, True, True, True, True]


def test_without_a_folder_for_compiled_code_it_is_compiled_anew() -> None:
    code = (
        "import numba.core.caching as caching, torch\n"
        "for name in dir(caching):\n"
        "    kind = getattr(caching, name)\n"
        "    if hasattr(kind, '_locator_classes'):\n"
        "        kind._locator_classes = []\n"
        "from mcdenoise.ops import kernel_conv\n"
        "image, kernel = torch.rand(1, 3, 4, 5), torch.rand(1, 9, 4, 5)\n"
        "found, expected = (kernel_conv(image, kernel, backend=name) for name in ('numba', 'torch'))\n"
        "torch.testing.assert_close(found, expected)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
