"""The Triton kernels in Triton's interpreter, which must be chosen before they are imported: see ``test_triton.py``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from plain_form import (
    FAST,
    TOLERANCE,
    assert_same,
    by,
    channels_last,
    drawn,
    every_other_column,
    outcomes,
    slice_of_pixels,
    transposed,
)
from torch import Tensor
from triton.runtime import interpreter

from mcdenoise import ops
from mcdenoise.check.cases import Case, Op, map_tensors
from mcdenoise.ops import _backend
from mcdenoise.ops._triton import _filter as _triton_filter

every_op = pytest.mark.parametrize("op", FAST, ids=lambda op: op.name)
CASES = [(op, case) for op in FAST for case in op.cases if case.differentiable]


@pytest.fixture(autouse=True)
def nan_in_fresh_memory() -> Iterator[None]:
    """Fills what is left to be written with NaN, so that what was forgotten shows."""
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)


@pytest.fixture(autouse=True)
def calls_within_a_kernel_are_plain_calls(monkeypatch: pytest.MonkeyPatch) -> None:
    """The interpreter sets up the language for each of them once more, which takes most of the time."""
    call = interpreter.InterpretedFunction.__call__

    def called(function: Any, *given: Any, **named: Any) -> Any:
        if function.fn.__module__ == _triton_filter.__name__:
            return function.rewrite()(*given, **named)
        return call(function, *given, **named)

    monkeypatch.setattr(interpreter.InterpretedFunction, "__call__", called)


def is_that_of_the_plain_form(op: Op, case: Case, dtype: torch.dtype) -> None:
    actual = outcomes(op, case, case.inputs(dtype), "triton")
    assert {tensor.dtype for tensor in actual} == {dtype}
    exact = outcomes(op, case, map_tensors(lambda tensor: tensor.double(), case.inputs(dtype)), "torch")
    assert_same(actual, exact, TOLERANCE[dtype])


@pytest.mark.parametrize(("op", "case"), [pytest.param(*pair, id=f"{pair[0].name}-{pair[1].name}") for pair in CASES])
def test_result_and_derivatives(op: Op, case: Case) -> None:
    is_that_of_the_plain_form(op, case, torch.float64)


@pytest.mark.parametrize(
    "dtype", [torch.bfloat16, *(pytest.param(each, marks=pytest.mark.slow) for each in (torch.float32, torch.float16))]
)
@every_op
def test_dtypes(op: Op, dtype: torch.dtype) -> None:
    is_that_of_the_plain_form(op, drawn(1, 3, 3, 5, 3, op, border="renormalize"), dtype)


# Wider, and taller than a tile, and no whole number of them.
@pytest.mark.parametrize("size", [(1, 1, 2, 35, 3), (2, 1, 6, 3, 3)], ids=str)
@pytest.mark.parametrize(
    "border", ["renormalize", *(pytest.param(each, marks=pytest.mark.slow) for each in ("replicate", "zeros"))]
)
@every_op
def test_sizes(op: Op, border: str, size: tuple[int, int, int, int, int]) -> None:
    is_that_of_the_plain_form(op, drawn(*size, op, border=border), torch.float64)


@pytest.mark.parametrize("layout", [channels_last, slice_of_pixels, every_other_column, transposed])
def test_layout_in_memory_changes_nothing(layout: Callable[[Tensor], Tensor]) -> None:
    op = FAST[-1]
    case = drawn(1, 3, 2, 3, 3, op)
    inputs = {
        name: [layout(part) for part in value] if isinstance(value, list) else layout(value)
        for name, value in case.inputs(torch.bfloat16).items()
    }
    laid_out = outcomes(op, case, inputs, "triton")
    assert all(map(torch.equal, laid_out, outcomes(op, case, case.inputs(torch.bfloat16), "triton")))


def test_wide_offsets_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    op = FAST[-1]
    case = drawn(1, 2, 3, 4, 3, op)
    narrow = outcomes(op, case, case.inputs(), "triton")
    monkeypatch.setattr(_triton_filter, "_NARROW", 0)
    assert all(map(torch.equal, narrow, outcomes(op, case, case.inputs(), "triton")))


def test_which_offsets_are_wide() -> None:
    # The kernel's planes are far apart in memory, and the offsets of its pixels within a plane are not.
    assert not _triton_filter._is_wide(torch.empty(1, 100, 4320, 7680, device="meta"))
    # Side by side for each pixel, they are: 3.3e9 numbers.
    tensor = torch.empty(1, 100, 4320, 7680, device="meta")
    assert _triton_filter._is_wide(tensor.contiguous(memory_format=torch.channels_last))
    # A batch of images is no single one.
    assert not _triton_filter._is_wide(torch.empty(100, 1, 4320, 7680, device="meta"))


def test_other_dtypes_beside_the_image() -> None:
    op = FAST[-1]
    case = drawn(1, 3, 2, 3, 3, op)
    inputs = case.inputs(torch.float32)
    inputs["kernel"] = inputs["kernel"].bfloat16()
    actual = outcomes(op, case, inputs, "triton")
    assert [tensor.dtype for tensor in actual[:3]] == [torch.float32, torch.float32, torch.bfloat16]
    exact = outcomes(op, case, map_tensors(lambda tensor: tensor.detach().double(), inputs), "torch")
    of_kernel = actual.pop(2), exact.pop(2)
    assert_same(actual, exact, TOLERANCE[torch.float32])
    assert_same([of_kernel[0]], [of_kernel[1]], TOLERANCE[torch.bfloat16])


@pytest.mark.parametrize("needed", [("image",), ("kernel",), ("scales",), ("guides",)])
def test_derivatives_of_some_arguments_only(needed: tuple[str, ...]) -> None:
    op = FAST[-1]
    case = drawn(1, 3, 2, 3, 3, op)
    partial = Case("partial", "ordinary", case.tensors, needed, {"normalize": "none", "border": "renormalize"})
    is_that_of_the_plain_form(op, partial, torch.float64)


def test_second_derivatives_go_the_plain_way() -> None:
    image = torch.rand(1, 1, 2, 2, dtype=torch.float64, requires_grad=True)

    def second(backend: Any) -> Tensor:
        result = by(backend, ops.kernel_conv)(image, image.expand(1, 9, 2, 2) * 2)
        (first,) = torch.autograd.grad(result.square().sum(), image, create_graph=True)
        return torch.autograd.grad(first.square().sum(), image)[0]

    torch.testing.assert_close(second("triton"), second("torch"), rtol=1e-12, atol=0)


# The compiler raises deprecation warnings of torch's own making.
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@every_op
def test_goes_through_the_compiler(op: Op) -> None:
    case = drawn(1, 2, 2, 3, 3, op)
    torch.compiler.reset()
    compiled = torch.compile(op.function, fullgraph=True, backend="aot_eager")
    through = Op(compiled, op.reference, op.cases)
    assert_same(outcomes(through, case, case.inputs(), "triton"), outcomes(op, case, case.inputs(), "triton"), 1e-15)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_is_exported_where_it_is_named() -> None:
    arguments = (torch.rand(1, 3, 2, 3), torch.rand(1, 9, 2, 3), [torch.rand(1, 2, 2, 3)], [torch.rand(1, 1, 2, 3)])
    program = by("triton", torch.export.export)(ops.CrossBilateralFilter(), arguments)
    assert "mcdenoise.triton_cross_bilateral_filter" in str(program.graph)
    torch.testing.assert_close(program.module()(*arguments), by("torch", ops.CrossBilateralFilter())(*arguments))


def test_no_image() -> None:
    image, kernel = torch.rand(0, 3, 4, 5, requires_grad=True), torch.rand(0, 9, 4, 5)
    result = by("triton", ops.kernel_conv)(image, kernel)
    assert result.shape == image.shape
    assert torch.autograd.grad(result.sum(), image)[0].shape == image.shape


# The difference of the largest number and its opposite is infinite, as it should be.
@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning")
def test_infinite_logits_are_the_limit_of_large_ones() -> None:
    image, logits = torch.tensor([1.0, 2.0, 4.0]).reshape(1, 1, 1, 3), torch.zeros(1, 9, 1, 3)
    logits[:, 3] = torch.inf
    logits[:, 5] = -torch.inf
    result = by("triton", ops.cross_bilateral_filter)(image, logits, border="replicate")
    assert result.flatten().tolist() == [1.0, 1.0, 2.0]


def test_the_interpreter_is_no_default() -> None:
    assert by("triton", _backend.choose_backend)(["triton"], [torch.rand(1, 3, 4, 5)]) == "triton"
    assert _backend.choose_backend(["triton"], [torch.rand(1, 3, 256, 256)]) != "triton"
