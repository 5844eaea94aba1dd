"""The fast backends of the ops that methods of the zoo have beside the filters, against the reference."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import pytest
import torch
from reference_cases import (
    TOLERANCE,
    assert_same,
    by,
    channels_last,
    every_other_column,
    leaves_of,
    outcomes,
    slice_of_pixels,
    transposed,
)
from torch import Generator, Tensor

from mcdenoise.check.cases import OPS, Case, Inputs, Op, map_tensors
from mcdenoise.ops import _backend
from mcdenoise.ops._numba import _runtime

OF_A_FRAME_BEFORE = ("previous", "previous_features", "previous_bandwidth", "previous_weight")
Draw = Callable[[int], Tensor]


def _affinity(draw: Draw, channels: int) -> Inputs:
    inputs: Inputs = {"image": draw(channels), "features": draw(5), "bandwidth": 5 * draw(1), "center": draw(1) + 0.1}
    return inputs | dict(zip(OF_A_FRAME_BEFORE, (draw(channels), draw(5), 5 * draw(1), draw(1)), strict=True))


def _splat(draw: Draw, channels: int) -> Inputs:
    return {"image": draw(channels), "guide": 1.4 * draw(1) - 0.2}


def _slice(draw: Draw, channels: int) -> Inputs:
    guide = 1.4 * draw(1) - 0.2
    rows, columns = -(-guide.shape[2] // 4), -(-guide.shape[3] // 4)

    def cells(count: int) -> Tensor:
        shape = (len(guide), count, rows, columns, 5)
        return torch.rand(shape, generator=torch.Generator().manual_seed(count), dtype=torch.float64)

    return {"grid": cells(channels), "filled": (cells(1) - 0.2).clamp_min(0), "guide": guide}


def _importance(draw: Draw, channels: int) -> Inputs:
    return {"image": draw(channels), "importance": 20 * draw(1)}


def _atrous(draw: Draw, channels: int) -> Inputs:
    return {"light": draw(channels + 2), "variance": 0.1 * draw(1) + 0.01, "normal": draw(3), "depth": 1 + draw(1)}


def _moments(draw: Draw, channels: int) -> Inputs:
    mean = draw(1)
    return {"moments": torch.cat([mean, mean.square() + draw(1)], 1), "normal": draw(3), "depth": 1 + draw(1)}


def _changes(draw: Draw, channels: int) -> Inputs:
    before = draw(1)
    named = {"current": 2 * before + draw(1), "previous": before, "weight": 0.1 + draw(1), "variance": 0.01 * draw(1)}
    return {**named, "normal": draw(3), "depth": 1 + draw(1)}


ZOO: dict[str, tuple[Callable[[Draw, int], Inputs], dict[str, Any]]] = {
    "affinity_filter": (_affinity, {"kernel_size": 5, "dilation": 2}),
    "grid_splat": (_splat, {"cell": 4, "bins": 5}),
    "grid_slice": (_slice, {"cell": 4}),
    "importance_filter": (_importance, {"kernel_size": 5}),
    "atrous": (_atrous, {"step": 2, "sigma_n": 2.0}),
    "moments_variance": (_moments, {"kernel_size": 5, "sigma_n": 2.0}),
    "temporal_gradient": (_changes, {"stratum": 2, "levels": 2, "sigma_n": 2.0}),
}
FAST = [op for op in OPS if op.name in ZOO]
# The derivatives of the other operators are those of the reference implementation.
DIFFERENTIABLE = [op for op in FAST if op.name != "importance_filter"]
every_op = pytest.mark.parametrize("op", FAST, ids=lambda op: op.name)


def found(op: Op, case: Case, inputs: Inputs, backend: str) -> list[Tensor]:
    """The results and, of a fast backend that has them, derivatives."""
    if op.name in {each.name for each in DIFFERENTIABLE}:
        return outcomes(op, case, inputs, backend)
    return [by(backend, op.function)(**inputs, **case.settings)]


def drawn(op: Op, batch: int, channels: int, height: int, width: int) -> Case:
    inputs_of, settings = ZOO[op.name]

    def tensors(g: Generator) -> Inputs:
        def draw(count: int) -> Tensor:
            return torch.rand(batch, count, height, width, generator=g, dtype=torch.float64)

        return inputs_of(draw, channels)

    return Case("drawn", "ordinary", tensors, tuple(tensors(torch.Generator())), settings)


@pytest.fixture(autouse=True)
def nan_in_fresh_memory() -> Iterator[None]:
    """Fills what is left to be written with NaN, so that what was forgotten shows."""
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)


@pytest.mark.parametrize("dtype", TOLERANCE, ids=str)
@pytest.mark.parametrize(
    ("op", "case"),
    # The extreme ones have bounds of their own, see `mcdenoise stability`.
    [pytest.param(op, case, id=f"{op.name}-{case.name}") for op in FAST for case in op.cases if case.kind != "extreme"],
)
def test_result_and_derivatives_are_those_of_the_reference(op: Op, case: Case, dtype: torch.dtype) -> None:
    actual = found(op, case, case.inputs(dtype), "numba")
    assert {tensor.dtype for tensor in actual} == {dtype}
    # The same numbers in float64: what differs is the arithmetic.
    exact = found(op, case, map_tensors(lambda tensor: tensor.double(), case.inputs(dtype)), "torch")
    assert_same(actual, exact, TOLERANCE[dtype])


# Wider than a run of pixels, more channels than stand side by side, smaller than a window and than a cell.
@pytest.mark.parametrize("size", [(1, 3, 3, 600), (2, 7, 21, 9), (1, 1, 1, 1), (2, 4, 2, 3)], ids=str)
@every_op
def test_sizes(op: Op, size: tuple[int, int, int, int]) -> None:
    case = drawn(op, *size)
    actual, plain = (found(op, case, case.inputs(), backend) for backend in ("numba", "torch"))
    assert_same(actual, plain, 10 * TOLERANCE[torch.float64])


@every_op
def test_threads_change_nothing(op: Op, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_runtime, "PIXELS_A_THREAD", 1)
    case = drawn(op, 2, 3, 19, 16)
    threads, results = torch.get_num_threads(), []
    try:
        for count in (1, 2, 5):
            torch.set_num_threads(count)
            results.append(found(op, case, case.inputs(torch.float32), "numba"))
    finally:
        torch.set_num_threads(threads)
    for result in results[1:]:
        assert all(map(torch.equal, result, results[0]))


def _cells_apart(tensor: Tensor) -> Tensor:
    """Return a view of a grid that has other cells beside each of its own."""
    return torch.stack([torch.full_like(tensor, torch.nan), tensor], -1)[..., 1]


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=str)
@pytest.mark.parametrize("layout", [channels_last, slice_of_pixels, every_other_column, transposed])
@every_op
def test_layout_in_memory_changes_nothing(op: Op, layout: Callable[[Tensor], Tensor], dtype: torch.dtype) -> None:
    case = drawn(op, 2, 3, 9, 11)
    inputs = map_tensors(lambda tensor: (layout if tensor.ndim == 4 else _cells_apart)(tensor), case.inputs(dtype))
    laid_out = found(op, case, inputs, "numba")
    assert all(map(torch.equal, laid_out, found(op, case, case.inputs(dtype), "numba")))


@pytest.mark.parametrize("op", DIFFERENTIABLE, ids=lambda op: op.name)
def test_first_derivatives_equal_difference_quotients_and_second_ones_use_the_reference(op: Op) -> None:
    case = op.cases[0]
    inputs = case.inputs()
    leaves = leaves_of(inputs, case)

    def function(*tensors: Tensor) -> Tensor:
        rest = iter(tensors)
        results = by("numba", op.function)(**map_tensors(lambda _: next(rest), inputs), **case.settings)
        return results if isinstance(results, Tensor) else results[0]

    assert torch.autograd.gradcheck(function, leaves, fast_mode=False)
    assert torch.autograd.gradgradcheck(function, leaves, fast_mode=False)


# The compiler raises deprecation warnings of torch's own making.
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@every_op
def test_goes_through_the_compiler(op: Op) -> None:
    case = drawn(op, 2, 3, 5, 7)
    torch.compiler.reset()
    compiled = torch.compile(op.function, fullgraph=True, backend="aot_eager")
    assert_same(
        found(replace(op, function=compiled), case, case.inputs(), "numba"),
        found(op, case, case.inputs(), "numba"),
        1e-15,
    )


@every_op
def test_an_empty_batch(op: Op) -> None:
    case = drawn(op, 0, 3, 5, 7)
    shapes = [tensor.shape for tensor in found(op, case, case.inputs(), "numba")]
    results = by("torch", op.function)(**case.inputs(), **case.settings)
    expected = [result.shape for result in ((results,) if isinstance(results, Tensor) else results)]
    assert shapes[: len(expected)] == expected
    assert shapes[len(expected) :] in ([], [tensor.shape for tensor in leaves_of(case.inputs(), case)])


@every_op
def test_a_nan_is_seen(op: Op) -> None:
    for name in drawn(op, 1, 3, 5, 7).inputs():
        inputs = drawn(op, 1, 3, 5, 7).inputs(torch.float32)
        inputs[name][0, 0, 1, 1] = torch.nan  # type: ignore[index]
        seen = []
        for backend in ("numba", "torch"):
            results = by(backend, op.function)(**inputs, **ZOO[op.name][1])  # type: ignore[arg-type]
            seen.append((results if isinstance(results, Tensor) else results[0]).isnan())
        assert torch.equal(*seen), name


def test_the_size_of_the_image_chooses_the_backend_of_a_small_grid() -> None:
    grid, guide = torch.rand(1, 3, 2, 2, 4), torch.rand(1, 1, 128, 128)
    assert _backend.choose_backend(["numba"], [grid, guide]) == "numba"
    assert _backend.choose_backend(["numba"], [grid, guide[..., :8, :8]]) == "torch"
