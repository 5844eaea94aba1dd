"""Properties of every op, on every case of the table in ``mcdenoise/check/cases.py``."""

import inspect
import math
import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import pytest
import torch
from oracles import oracle
from reference_cases import channels_last, every_other_column, transposed
from torch import Tensor

from mcdenoise import ops
from mcdenoise.check import gradients
from mcdenoise.check.case import DTYPES, as_tuple, tensors_in
from mcdenoise.check.cases import OPS, Case, Inputs, Op, map_tensors

every_op = pytest.mark.parametrize("op", OPS, ids=lambda op: op.name)


def results_of(op: Op, inputs: Inputs, case: Case) -> Sequence[Tensor]:
    return as_tuple(op.function(**inputs, **case.settings))


def assert_same(actual: Sequence[Tensor], expected: Sequence[Tensor], rtol: float = 1e-10, note: str = "") -> None:
    for a, e in zip(actual, expected, strict=True):
        # Sums that cancel are known to a fraction of their terms only.
        scale = torch.where(torch.isfinite(e), e, 0).abs().max().item() if e.numel() else 0.0
        try:
            torch.testing.assert_close(a, e, rtol=rtol, atol=1e-4 * rtol * scale, equal_nan=True)
        except AssertionError as error:
            error.add_note(note)
            raise


def test_every_public_function_is_in_the_table() -> None:
    public = [name for name in ops.__all__ if inspect.isfunction(getattr(ops, name)) and name != "use"]
    assert sorted(op.name for op in OPS) == sorted(public)
    assert all(getattr(ops, op.name) is op.function for op in OPS)


# One test of all cases: of hundreds of cases tests cost more than the ops in them.
@every_op
def test_equals_the_equation_in_float64(op: Op) -> None:
    for case in op.cases:
        inputs = case.inputs()
        expected = as_tuple(oracle(op.name)(**inputs, **case.settings))
        assert_same(results_of(op, inputs, case), expected, note=case.name)
        assert_same(tensors_in(inputs), tensors_in(case.inputs()), rtol=0)


# Half precision holds neither the square of most numbers nor a place in a wide image.
LEAST_FLOAT32 = {"luminance_moments", "motion_from_position"}


@every_op
def test_results_have_the_dtype_of_the_inputs(op: Op) -> None:
    for dtype in (torch.float64, *DTYPES):
        expected = torch.promote_types(dtype, torch.float32) if op.name in LEAST_FLOAT32 else dtype
        for case in op.cases[:2]:
            assert {result.dtype for result in results_of(op, case.inputs(dtype), case)} == {expected}, dtype


@every_op
def test_gradcheck(op: Op) -> None:
    results = [gradients.check_case(*each) for each in gradients.select([op.name])]
    assert [result.case for result in results] == [case.name for case in op.cases if case.differentiable]
    assert not [f"{result.case}: {result.message}" for result in results if not result.passed]


def expanded(tensor: Tensor) -> Tensor:
    return tensor[:1].expand(2 * min(len(tensor), 1), *tensor.shape[1:])


@every_op
def test_layout_in_memory_changes_nothing(op: Op) -> None:
    for case in (case for case in op.cases if case.kind != "extreme"):
        for layout in (transposed, channels_last, every_other_column, expanded):
            inputs = map_tensors(layout, case.inputs())
            contiguous = map_tensors(lambda tensor: tensor.contiguous(), inputs)
            note = f"{case.name}, {layout.__name__}"
            assert_same(results_of(op, inputs, case), results_of(op, contiguous, case), rtol=1e-12, note=note)


# Generating code takes five to thirty seconds for an op, a minute for one with many taps, and what there is to generate
# is alike within a family. Of pixels alone and of scattered sums one is generated here, the others, and those with many
# taps, where slow tests run; all go through the compiler up to its generator.
GENERATED = {"demodulate", "grid_splat"}
# Splatting is the derivative of kernel_conv, and accumulate reprojects; the many taps of atrous and of
# temporal_gradient take minutes with their derivatives; and torch lowers no derivative of a QR decomposition.
MANY_TAPS = {"atrous", "temporal_gradient"}
NOT_GENERATED = {"kernel_splat", "reproject", "block_regression"} | MANY_TAPS


def compiled_cases(op: Op) -> Iterator[Any]:
    quick = "inductor" if op.name in GENERATED else "aot_eager"
    for i, backend in ((0, quick), (1, "aot_eager"), (3, "aot_eager")):
        case = op.cases[i]
        # Other cases change little but numbers in what is compiled.
        marks = [pytest.mark.slow] if i > 0 or op.name in MANY_TAPS else []
        yield pytest.param(op, case, backend, id=f"{op.name}-{case.name}-{backend}", marks=marks)
    if op.name not in NOT_GENERATED | GENERATED:
        name = f"{op.name}-{op.cases[0].name}-inductor"
        yield pytest.param(op, op.cases[0], "inductor", id=name, marks=pytest.mark.slow)


# The compiler raises deprecation warnings of torch's own making.
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize(("op", "case", "backend"), [each for op in OPS for each in compiled_cases(op)])
def test_compiles_to_the_same(op: Op, case: Case, backend: str) -> None:
    torch.compiler.reset()
    compiled = torch.compile(op.function, fullgraph=True, backend=backend)
    outcomes = []
    for function in (op.function, compiled):
        inputs = case.inputs()
        leaves = [x.requires_grad_() for x in tensors_in({name: inputs[name] for name in case.differentiable})]
        results = as_tuple(function(**inputs, **case.settings))
        total = sum((result * torch.arange(result.numel()).reshape(result.shape).cos()).sum() for result in results)
        # Without levels, features guide nothing.
        slopes = torch.autograd.grad(total, leaves, materialize_grads=True)
        outcomes.append([*(result.detach() for result in results), *slopes])
    assert_same(outcomes[1], outcomes[0])
    # Without gradients the compiler takes another way through a function that has its own.
    assert_same(as_tuple(compiled(**case.inputs(), **case.settings)), outcomes[0][: len(results)])


@pytest.mark.parametrize("op", [op for op in OPS if op.module is not None], ids=lambda op: op.name)
def test_module_stores_settings_and_calls_the_function(op: Op) -> None:
    for case in op.cases:
        module = op.module(**case.settings)
        assert not list(module.parameters())
        results = as_tuple(module(**case.inputs()))
        for result, expected in zip(results, results_of(op, case.inputs(), case), strict=True):
            torch.testing.assert_close(result, expected, rtol=0, atol=0, equal_nan=True)


def image(*shape: int) -> Tensor:
    return torch.zeros(shape)


ONE, THREE = image(1, 1, 4, 5), image(1, 3, 4, 5)
GRID = image(1, 3, 1, 1, 4)
SURFACE = ops.Surface(position=THREE, normal=THREE)

Refused = tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any], str]
# Each with the argument that is named, and the value that was found.
REFUSED: list[Refused] = [
    (ops.kernel_conv, (THREE[0], ONE), {}, "image: .*found (3, 4, 5)"),
    (ops.kernel_conv, (THREE, image(1, 9, 5, 4)), {}, "kernel: .*found 5"),
    (ops.kernel_conv, (THREE, image(1, 8, 4, 5)), {}, "kernel: .*found 8"),
    (ops.kernel_conv, (THREE, ONE), {"border": "wrap"}, "border: .*found 'wrap'"),
    (ops.KernelConv, (), {"border": "wrap"}, "border: .*found 'wrap'"),
    (ops.softmax_splat, (THREE, image(1, 4, 4, 5)), {}, "logits: .*found 4"),
    (ops.cross_bilateral_weights, (ONE, [THREE]), {}, "falloffs: .*1 guides"),
    (ops.cross_bilateral_weights, (ONE,), {"normalize": "sum"}, "normalize: .*found 'sum'"),
    (ops.upsample, (THREE, (8, 11)), {}, "image: .*found (4, 5)"),
    # One pixel would broadcast.
    (ops.laplacian_fusion, (THREE, image(1, 3, 1, 1), ONE), {}, "coarse: .*found (1, 1)"),
    (ops.laplacian_fusion, (THREE, image(1, 3, 2, 3), image(1, 2, 4, 5)), {}, "alpha: .*found 2"),
    (ops.pyramid_partition, (THREE, image(1, 0, 4, 5)), {}, "logits: .*found 0"),
    (ops.learned_upsample, (THREE, image(1, 9, 4, 5), (8, 10)), {}, "kernel: .*found 9"),
    (ops.demodulate, (THREE, THREE), {"floor": float("nan")}, "floor: .*found nan"),
    (ops.grid_splat, (THREE, ONE), {"cell": 0}, "cell: .*found 0"),
    (ops.grid_slice, (GRID, GRID[:, :1], ONE), {"cell": 2}, "grid: .*(2, 3)"),
    (ops.clamp_fireflies, (THREE,), {"limit": 0.0}, "limit: .*found 0.0"),
    (ops.importance_filter, (THREE, ONE), {"kernel_size": 4}, "kernel_size: .*found 4"),
    (ops.atrous, (ONE, ONE), {}, "light: .*found 1"),
    (ops.Atrous, (), {"sigma_n": 0.5}, "sigma_n: .*found 0.5"),
    (ops.affinity_filter, (THREE, ONE, ONE, ONE, THREE), {}, "previous_features: .*found None"),
    (ops.temporal_gradient, (ONE, ONE), {"threshold": math.nan}, "threshold: .*found nan"),
    (ops.block_regression, (THREE, ONE), {"offset": (0, 32)}, "offset: .*32"),
    (ops.history_lag, (THREE, THREE, ONE), {"threshold": 0.0}, "threshold: .*found 0.0"),
    (ops.reproject, (THREE, THREE[:, :2], SURFACE, SURFACE), {}, "surface.depth: .*found None"),
    (ops.accumulate, (THREE, THREE, ONE, THREE[:, :2]), {"alpha_min": 0.0}, "alpha_min: .*found 0.0"),
]


@pytest.mark.parametrize(("function", "arguments", "settings", "message"), REFUSED)
def test_refuses_with_the_name_and_what_was_found(
    function: Callable[..., Any], arguments: tuple[Any, ...], settings: dict[str, Any], message: str
) -> None:
    name, _, found = message.partition(".*")
    with pytest.raises(ValueError, match=f"^{re.escape(name)}.*{re.escape(found)}"):
        function(*arguments, **settings)


@every_op
def test_refuses_tensors_of_a_wrong_kind(op: Op) -> None:
    case = max(op.cases, key=lambda case: len(case.inputs()))
    tensors = {name: value for name, value in case.inputs().items() if isinstance(value, Tensor)}
    for name, value in tensors.items():
        for wrong, error in ((value.int(), TypeError), (value[None], ValueError)):
            with pytest.raises(error, match=name):
                op.function(**{**case.inputs(), name: wrong}, **case.settings)
        if len(tensors) > 1:
            with pytest.raises(ValueError, match="expected B = "):
                op.function(**{**case.inputs(), name: torch.cat([value] * 3)}, **case.settings)
