"""The fast backends against the reference implementations."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from reference_cases import (
    FAST,
    TOLERANCE,
    assert_same,
    by,
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
from mcdenoise.check.cases import OPS, Case, Inputs, Op, map_tensors
from mcdenoise.ops import _backend
from mcdenoise.ops._numba import _filter, _runtime

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
def test_result_and_derivatives_are_those_of_the_reference(op: Op, case: Case, dtype: torch.dtype) -> None:
    actual = outcomes(op, case, case.inputs(dtype), "numba")
    assert {tensor.dtype for tensor in actual} == {dtype}
    # The same numbers in float64: what differs is the arithmetic.
    exact = outcomes(op, case, map_tensors(lambda tensor: tensor.double(), case.inputs(dtype)), "torch")
    assert_same(actual, exact, TOLERANCE[dtype])


# The sizes are wider than a run of pixels, taller than the rows of a thread, and smaller than the kernel.
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
    monkeypatch.setattr(_runtime, "PIXELS_A_THREAD", 1)
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
def test_splatting_is_the_same_without_derivatives_of_the_kernel(border: Any, dtype: torch.dtype) -> None:
    inputs = drawn(2, 3, 9, 300, 5, FAST[1]).inputs(dtype)
    image, kernel = inputs["image"], inputs["kernel"]
    alone, with_slopes = (
        _filter.derivatives(image, image, kernel, (), (), None, False, border, of_kernel=wanted)
        for wanted in (False, True)
    )
    assert torch.equal(alone[0], with_slopes[0])
    assert [of_kernel.numel() for of_kernel in (alone[1], with_slopes[1])] == [0, kernel.numel()]
    assert torch.equal(by("numba", ops.kernel_splat)(image, kernel, border=border), alone[0])


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
def test_first_derivatives_equal_difference_quotients_and_second_ones_use_the_reference(op: Op) -> None:
    for border in ("replicate", "renormalize"):
        case = drawn(1, 2, 2, 3, 3, op, border=border)
        inputs = case.inputs()
        leaves = leaves_of(inputs, case)

        def function(*tensors: Tensor, inputs: Inputs = inputs, case: Case = case) -> Tensor:
            rest = iter(tensors)
            return by("numba", op.function)(**map_tensors(lambda _: next(rest), inputs), **case.settings)

        assert torch.autograd.gradcheck(function, leaves, fast_mode=False)
        assert torch.autograd.gradgradcheck(function, leaves, fast_mode=False)


def test_second_derivatives_where_one_argument_is_computed_from_another() -> None:
    image = torch.rand(1, 1, 3, 3, dtype=torch.float64, requires_grad=True)

    def function(image: Tensor) -> Tensor:
        return by("numba", ops.kernel_conv)(image, image.expand(1, 9, 3, 3) * 2)

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
    def forward(self, image: Tensor, kernel: Tensor, guide: Tensor, scale: Tensor) -> Tensor:
        return ops.cross_bilateral_filter(image, kernel, [guide], [scale])


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_is_exported_where_it_is_named() -> None:
    # Large enough that it would run compiled.
    arguments = (torch.rand(1, 3, 96, 96), torch.rand(1, 9, 96, 96), torch.rand(1, 2, 96, 96), torch.rand(1, 1, 96, 96))
    for export, there in ((by("numba", torch.export.export), True), (torch.export.export, False)):
        program = export(_Filter(), arguments)
        assert ("mcdenoise.numba_cross_bilateral_filter" in str(program.graph)) is there
        torch.testing.assert_close(program.module()(*arguments), by("torch", _Filter())(*arguments))


@pytest.mark.parametrize("needed", [("image",), ("kernel",), ("falloffs",), ("guides",)])
def test_derivatives_of_some_arguments_only(needed: tuple[str, ...]) -> None:
    op = FAST[-1]
    case = drawn(1, 3, 5, 7, 3, op)
    partial = Case("partial", "ordinary", case.tensors, needed, {})
    assert_same(
        outcomes(op, partial, partial.inputs(), "numba"), outcomes(op, partial, partial.inputs(), "torch"), 1e-13
    )


def test_an_empty_batch() -> None:
    image, kernel = torch.rand(0, 3, 4, 5, requires_grad=True), torch.rand(0, 9, 4, 5)
    result = by("numba", ops.kernel_conv)(image, kernel)
    assert result.shape == image.shape
    assert torch.autograd.grad(result.sum(), image)[0].shape == image.shape


def chosen(image: Tensor) -> str:
    return _backend.choose_backend(["numba"], [image])


def test_the_default_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    large, small = torch.rand(2, 3, 64, 64), torch.rand(1, 3, 64, 64)
    assert chosen(large) == "numba"
    assert chosen(small) == "torch"
    assert chosen(large.to("meta")) == "torch"
    assert _backend.choose_backend([], [large]) == "torch"
    assert by("torch", chosen)(large) == "torch"
    assert by("numba", chosen)(small) == "numba"
    monkeypatch.setattr(_backend, "_missing", lambda: "cannot be imported")
    assert chosen(large) == "torch"


def test_another_backend_may_be_used_for_a_while() -> None:
    large, small = torch.rand(2, 3, 64, 64), torch.rand(1, 3, 4, 4)
    with ops.use("torch"):
        assert chosen(large) == "torch"
        with pytest.raises(ValueError, match="backend:"), ops.use("c"):  # type: ignore[arg-type]
            pytest.fail("entered")
        with ops.use("numba", strict=False):
            assert chosen(small) == "numba"
            assert chosen(small.to("meta")) == "torch"
        assert chosen(large) == "torch"
    assert chosen(large) == "numba"


def test_the_size_of_one_image_can_choose_the_backend_of_all() -> None:
    large, small = torch.rand(2, 3, 64, 64), torch.rand(1, 3, 4, 4)
    with _backend.one_backend(large):
        assert chosen(small) == "numba"
        with _backend.one_backend(small):
            assert chosen(large) == "numba"
    with _backend.one_backend(small):
        assert chosen(large) == "torch"
    with ops.use("torch"), _backend.one_backend(large):
        assert chosen(large) == "torch"


def test_denormal_numbers_are_flushed_in_derivatives_and_nowhere_else() -> None:
    image, kernel = torch.ones(1, 1, 3, 3), torch.full((1, 9, 3, 3), 1e-40)
    for flush in (False, True):
        torch.set_flush_denormal(flush)
        try:
            assert by("numba", ops.kernel_splat)(image, kernel).eq(0).all()
            # Where all numbers are small, denormal ones count.
            assert bool(by("numba", ops.kernel_splat)(1e-20 * image, 1e20 * kernel).eq(0).all()) is flush
            assert bool(by("numba", ops.kernel_conv)(image, kernel).eq(0).all()) is flush
            assert bool((image * kernel[:, :1] == 0).all()) is flush
        finally:
            torch.set_flush_denormal(False)


def test_a_named_backend_runs_or_says_why_it_cannot(monkeypatch: pytest.MonkeyPatch) -> None:
    image, kernel = torch.rand(1, 3, 4, 5), torch.rand(1, 9, 4, 5)
    with pytest.raises(ValueError, match=r"backend: .*'cuda'"):
        by("cuda", ops.kernel_conv)(image, kernel)
    with pytest.raises(ValueError, match="found 'numba', which runs on the CPU, not on meta"):
        by("numba", ops.kernel_conv)(image.to("meta"), kernel.to("meta"))

    def gone(name: str) -> None:
        raise ImportError("gone")

    monkeypatch.setattr(_backend.importlib, "import_module", gone)
    monkeypatch.setattr(_backend, "_FOUND", True)
    _backend._tried_import.cache_clear()
    # It is there and fails, as with too little memory: said once, and then the reference runs.
    with (
        pytest.warns(UserWarning, match="plain torch is used"),
        pytest.raises(ValueError, match=r"found 'numba', which cannot be imported \(gone\); install mcdenoise\[fast\]"),
    ):
        by("numba", ops.cross_bilateral_filter)(image, kernel)
    big, of_big = torch.rand(1, 3, 300, 300), torch.rand(1, 9, 300, 300)
    assert torch.equal(ops.kernel_conv(big, of_big), by("torch", ops.kernel_conv)(big, of_big))
    _backend._tried_import.cache_clear()


ACCUMULATE = next(op for op in OPS if op.name == "accumulate")
REPROJECT = next(op for op in OPS if op.name == "reproject")
of_both_ops = pytest.mark.parametrize("op", [ACCUMULATE, REPROJECT], ids=lambda op: op.name)


@every_dtype
@pytest.mark.parametrize(
    ("op", "case"),
    [pytest.param(op, case, id=f"{op.name}-{case.name}") for op in (ACCUMULATE, REPROJECT) for case in op.cases],
)
def test_histories_are_those_of_the_reference(op: Op, case: Case, dtype: torch.dtype) -> None:
    inputs = case.inputs(dtype)
    actual = by("numba", op.function)(**inputs, **case.settings)
    for result, plain in zip(actual, by("torch", op.function)(**inputs, **case.settings), strict=True):
        assert result.dtype == dtype
        # Both round to half precision once.
        eps = torch.finfo(dtype).eps
        torch.testing.assert_close(result, plain, rtol=8 * eps, atol=8 * eps)


@of_both_ops
@pytest.mark.parametrize("rule", ["relative", "bmfr"])
@pytest.mark.parametrize("layout", [channels_last, slice_of_pixels, every_other_column, transposed])
def test_histories_of_any_layout_and_by_any_number_of_threads(
    layout: Callable[[Tensor], Tensor], rule: Any, op: Op, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_runtime, "PIXELS_A_THREAD", 1)
    case = next(case for case in op.cases if "all buffers" in case.name)
    inputs = case.inputs()
    limits: dict[str, Any] = {"rule": rule, "position_limit": 0.05, "normal_limit": 0.3}
    plain = by("torch", op.function)(**inputs, **limits)
    threads = torch.get_num_threads()
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            results = by("numba", op.function)(**map_tensors(layout, inputs), **limits)
            for result, expected in zip(results, plain, strict=True):
                torch.testing.assert_close(result, expected, rtol=1e-12, atol=1e-12)
    finally:
        torch.set_num_threads(threads)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_no_tap_shows_is_zero_whatever_the_image_holds(value: float) -> None:
    """The normals of both frames face away from one another, so that no tap is kept."""
    image = torch.full((1, 2, 4, 6), value)
    normal = torch.ones(1, 3, 4, 6) / math.sqrt(3)
    found, weight = by("numba", ops.reproject)(
        image, torch.full((1, 2, 4, 6), 0.25), ops.Surface(None, normal, None), ops.Surface(None, -normal, None)
    )
    assert not found.any()
    assert not weight.any()


@of_both_ops
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_histories_go_through_the_compiler(op: Op) -> None:
    case = op.cases[1]
    torch.compiler.reset()
    compiled = torch.compile(op.function, fullgraph=True, backend="aot_eager")
    results = by("numba", compiled)(**case.inputs(), **case.settings)
    for result, expected in zip(results, op.function(**case.inputs(), **case.settings), strict=True):
        torch.testing.assert_close(result, expected, rtol=1e-12, atol=1e-12)


def gradients_of_both(backend: Any, case: Case, dtype: torch.dtype, **changed: Any) -> list[Tensor]:
    inputs = {**case.inputs(dtype), **changed}
    leaves = leaves_of(inputs, case)
    results = [each for each in by(backend, ops.accumulate)(**inputs, **case.settings) if each.requires_grad]
    generator = torch.Generator().manual_seed(1)
    upstream = [torch.randn(each.shape, generator=generator, dtype=torch.float64).to(dtype) for each in results]
    return list(torch.autograd.grad(results, leaves, upstream, allow_unused=True, materialize_grads=True))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.bfloat16])
@pytest.mark.parametrize(
    "case", [case for case in ACCUMULATE.cases if case.kind != "extreme"], ids=lambda case: case.name
)
def test_derivatives_of_accumulation_are_those_of_the_reference(case: Case, dtype: torch.dtype) -> None:
    found, expected = (gradients_of_both(backend, case, dtype) for backend in ("numba", "torch"))
    assert [each.dtype for each in found] == [each.dtype for each in expected]
    # The derivative of a motion is a difference of the taps: its rounding is in proportion to their size.
    largest = max(1.0, *(each.abs().max().item() for each in expected if each.numel()))
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=32 * torch.finfo(dtype).eps * largest)


def test_derivatives_of_accumulation_are_the_same_by_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_runtime, "PIXELS_A_THREAD", 1)
    case = next(case for case in ACCUMULATE.cases if "all buffers, batch" in case.name)
    threads = torch.get_num_threads()
    try:
        found = []
        for count in (1, 3):
            torch.set_num_threads(count)
            found.append(gradients_of_both("numba", case, torch.float64))
    finally:
        torch.set_num_threads(threads)
    assert all(map(torch.equal, *found))


def test_accumulation_is_differentiated_twice() -> None:
    case = ACCUMULATE.cases[0]

    def second(backend: Any) -> tuple[Tensor, ...]:
        inputs = case.inputs()
        leaves = leaves_of(inputs, case)
        color, length = by(backend, ops.accumulate)(**inputs, **case.settings)
        first = torch.autograd.grad(color.square().sum() + length.square().sum(), leaves, create_graph=True)
        return torch.autograd.grad(sum(each.square().sum() for each in first), leaves)

    for one, other in zip(second("numba"), second("torch"), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-11, atol=1e-11)


def test_large_images_are_accumulated_with_compiled_derivatives() -> None:
    color = torch.rand(1, 3, 96, 96, requires_grad=True)
    result, _ = ops.accumulate(color, color.detach(), color.detach()[:, :1] + 1, torch.zeros(1, 2, 96, 96))
    assert "accumulate_pair" in type(result.grad_fn).__name__
    assert torch.autograd.grad(result.sum(), color)[0].shape == color.shape


@pytest.mark.parametrize(("settings", "message"), [({"rule": "svgf"}, "rule: expected"), ({"rule": "bmfr"}, "needs")])
def test_accumulation_refuses_the_same_arguments_as_the_reference(settings: dict[str, Any], message: str) -> None:
    inputs = ACCUMULATE.cases[1].inputs()
    for backend in ("torch", "numba"):
        with pytest.raises(ValueError, match=message):
            by(backend, ops.accumulate)(**inputs, **settings)


MOTION = next(op for op in OPS if op.name == "motion_from_position")


@every_dtype
@pytest.mark.parametrize("case", [case for case in MOTION.cases if case.kind != "extreme"], ids=lambda case: case.name)
def test_motion_is_that_of_the_reference(case: Case, dtype: torch.dtype) -> None:
    inputs = case.inputs(dtype)
    plain = by("torch", ops.motion_from_position)(**inputs)
    for layout in (torch.clone, channels_last, transposed):
        position = layout(inputs["position"])
        motion = by("numba", ops.motion_from_position)(position, inputs["previous_view_projection"])
        assert motion.dtype == plain.dtype
        assert torch.equal(motion.isinf(), plain.isinf())
        eps, largest = torch.finfo(motion.dtype).eps, plain[plain.isfinite()].abs().max().item()
        torch.testing.assert_close(motion, plain, rtol=8 * eps, atol=8 * eps * (largest + sum(plain.shape[2:])))


def test_motion_of_points_behind_the_previous_camera_is_infinite() -> None:
    matrix = torch.eye(4)[None]
    matrix[:, 2, 3], matrix[:, 3, 3] = 1, 0  # clip w = z
    position = torch.tensor(
        [[0.0, 0, 1], [0, 0, -1], [0, 0, 0], [torch.inf, 0, 1], [0, torch.nan, 1], [0, 0, torch.inf]]
    )
    motion = by("numba", ops.motion_from_position)(position.T.reshape(1, 3, 1, 6), matrix)
    assert motion.isinf().all(1).flatten().tolist() == [False, True, True, True, True, True]


@pytest.mark.slow
def test_without_a_folder_for_compiled_code_it_is_compiled_anew() -> None:
    code = (
        "import numba.core.caching as caching, torch\n"
        "for name in dir(caching):\n"
        "    kind = getattr(caching, name)\n"
        "    if hasattr(kind, '_locator_classes'):\n"
        "        kind._locator_classes = []\n"
        "from mcdenoise.ops import kernel_conv\n"
        "from mcdenoise.ops._op import plain\n"
        "image, kernel = torch.rand(1, 3, 96, 96), torch.rand(1, 9, 96, 96)\n"
        "found, expected = (by(image, kernel) for by in (kernel_conv, plain(kernel_conv)))\n"
        "torch.testing.assert_close(found, expected)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_a_change_in_any_file_that_a_kernel_has_built_in_compiles_it_again(tmp_path: Path) -> None:
    """Numba itself looks at the file of the kernel alone."""
    shutil.copytree(Path(ops.__file__).parent, tmp_path / "mcdenoise" / "ops", ignore=shutil.ignore_patterns("__py*"))
    (tmp_path / "mcdenoise" / "__init__.py").touch()
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    code = (
        "import torch\n"
        "from mcdenoise.ops._numba.network import softplus\n"
        "print(softplus(torch.ones(1, 1, 1, 1, dtype=torch.float64), [1.0]).item())\n"
    )

    def run() -> float:
        command = [sys.executable, "-c", code]
        done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        return float(done.stdout)

    runtime = tmp_path / "mcdenoise" / "ops" / "_numba" / "_runtime.py"
    assert run() == pytest.approx(math.log1p(math.e))
    runtime.write_text(runtime.read_text().replace("return math.log1p(value)", "return 2 * math.log1p(value)"))
    assert run() == pytest.approx(1 + 2 * math.log1p(math.exp(-1)))
