"""Properties of every op, on every case of the table in ``mcdenoise/check/cases.py``."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import pytest
import torch
from oracles import oracle
from torch import Tensor

from mcdenoise import ops
from mcdenoise.check import gradients
from mcdenoise.check.case import as_tuple
from mcdenoise.check.cases import OPS, Case, Inputs, Op, map_tensors
from mcdenoise.check.overview import DTYPES, overview
from mcdenoise.errors import InputError

every_op = pytest.mark.parametrize("op", OPS, ids=lambda op: op.name)


def results_of(op: Op, inputs: Inputs, case: Case) -> Sequence[Tensor]:
    return as_tuple(op.function(**inputs, **case.settings))


def tensors_in(inputs: Inputs) -> list[Tensor]:
    found: list[Tensor] = []
    map_tensors(lambda tensor: found.append(tensor) or tensor, inputs)
    return found


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


@every_op
def test_cases_are_named_and_cover_what_is_differentiable(op: Op) -> None:
    names = [case.name for case in op.cases]
    assert len(names) == len(set(names))
    assert sum(case.kind == "ordinary" for case in op.cases) >= 4
    assert sum(case.kind != "ordinary" for case in op.cases) >= 5
    tensors = {name for case in op.cases for name in case.inputs()}
    differentiable = {name for case in op.cases for name in case.differentiable}
    assert tensors - differentiable <= {"surface", "previous_surface"}


# One test of all cases: of hundreds of cases tests cost more than the ops in them.
@every_op
def test_equals_the_equation_in_float64(op: Op) -> None:
    for case in op.cases:
        inputs = case.inputs()
        expected = as_tuple(oracle(op.name)(**inputs, **case.settings))
        assert_same(results_of(op, inputs, case), expected, note=case.name)
        # Inputs are left alone.
        assert_same(tensors_in(inputs), tensors_in(case.inputs()), rtol=0)


@every_op
def test_results_have_the_dtype_of_the_inputs(op: Op) -> None:
    for dtype in (torch.float64, *DTYPES):
        expected = dtype if op.least_dtype is None else torch.promote_types(dtype, op.least_dtype)
        for case in op.cases[:2]:
            assert {result.dtype for result in results_of(op, case.inputs(dtype), case)} == {expected}, dtype


@every_op
def test_gradcheck(op: Op) -> None:
    results = gradients.check([op.name])
    assert [result.case for result in results] == [case.name for case in op.cases if case.differentiable]
    assert not [f"{result.case}: {result.message}" for result in results if not result.passed]


def test_gradcheck_of_an_unknown_op() -> None:
    with pytest.raises(InputError, match=r"expected one of kernel_conv, .*accumulate, .*:function, found sharpen"):
        gradients.check(["kernel_conv", "sharpen"])


def transposed(tensor: Tensor) -> Tensor:
    return tensor.transpose(-1, -2).contiguous().transpose(-1, -2)


def channels_last(tensor: Tensor) -> Tensor:
    return tensor.movedim(1, -1).contiguous().movedim(-1, 1)


def strided(tensor: Tensor) -> Tensor:
    return torch.stack([tensor, torch.full_like(tensor, torch.nan)], -1).flatten(-2)[..., ::2]


def expanded(tensor: Tensor) -> Tensor:
    return tensor[:1].expand(2 * min(len(tensor), 1), *tensor.shape[1:])


@every_op
def test_layout_in_memory_changes_nothing(op: Op) -> None:
    for case in (case for case in op.cases if case.kind != "extreme"):
        for layout in (transposed, channels_last, strided, expanded):
            inputs = map_tensors(layout, case.inputs())
            contiguous = map_tensors(lambda tensor: tensor.contiguous(), inputs)
            note = f"{case.name}, {layout.__name__}"
            assert_same(results_of(op, inputs, case), results_of(op, contiguous, case), rtol=1e-12, note=note)


# Generating code takes five to thirty seconds for an op, a minute for one with many taps, and what there is to generate
# is alike within a family. One of each is generated here, the others, and those with many taps, where slow tests run;
# all go through the compiler up to its generator.
GENERATED = {
    "laplacian_fusion",  # resolutions
    "demodulate",  # pixels alone
    "grid_splat",  # scattered sums
    "clamp_fireflies",  # sums over windows
    "motion_from_position",  # matrices
}
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
        outcomes.append([*(result.detach() for result in results), *torch.autograd.grad(total, leaves)])
    assert_same(outcomes[1], outcomes[0])
    # Without gradients the compiler takes another way through a function that has its own.
    assert_same(as_tuple(compiled(**case.inputs(), **case.settings)), outcomes[0][: len(results)])


@pytest.mark.parametrize("op", [op for op in OPS if op.module is not None], ids=lambda op: op.name)
def test_module_stores_settings_and_calls_the_function(op: Op) -> None:
    for case in op.cases:
        assert op.module is not None
        module = op.module(**case.settings)
        assert not list(module.parameters())
        results = as_tuple(module(**case.inputs()))
        for result, expected in zip(results, results_of(op, case.inputs(), case), strict=True):
            torch.testing.assert_close(result, expected, rtol=0, atol=0, equal_nan=True)


def test_overview() -> None:
    entries = {entry.name: entry for entry in overview()}
    assert list(entries) == [op.name for op in OPS]
    for entry in entries.values():
        assert entry.summary.endswith(".")
        assert set(entry.errors) == {str(dtype).removeprefix("torch.") for dtype in DTYPES}
        # Half precision is rounded once, after a sum in float32; float32 at every tap.
        assert all(entry.errors[str(kind).removeprefix("torch.")] <= 16 * torch.finfo(kind).eps for kind in DTYPES)
    assert entries["accumulate"].differentiable == ("color", "previous", "previous_length", "motion")
    assert entries["accumulate"].module == "Accumulate"
    assert entries["reproject"].module is None
    # Copies numbers, so it cannot err.
    assert set(entries["upsample"].errors.values()) == {0.0}


def image(*shape: int) -> Tensor:
    return torch.zeros(shape)


ONE, THREE = image(1, 1, 4, 5), image(1, 3, 4, 5)
GRID = image(1, 3, 1, 1, 4)
SURFACE = ops.Surface(position=THREE, normal=THREE)

REFUSED: list[tuple[Callable[..., Any], tuple[Any, ...], dict[str, Any], type[Exception], str]] = [
    (ops.kernel_conv, ("image", ONE), {}, TypeError, "image: expected a torch.Tensor, found str"),
    (ops.kernel_conv, (THREE.int(), ONE), {}, TypeError, "image: expected a floating-point dtype, found torch.int32"),
    (ops.kernel_conv, (THREE[0], ONE), {}, ValueError, "image: expected shape (B, C, H, W), found (3, 4, 5)"),
    (ops.kernel_conv, (THREE, image(1, 9, 5, 4)), {}, ValueError, "kernel: expected H = 4 as in image, found 5"),
    (ops.kernel_conv, (THREE, image(1, 4, 4, 5)), {}, ValueError, "kernel: expected K*K channels with odd K"),
    (ops.kernel_conv, (THREE, image(1, 8, 4, 5)), {}, ValueError, "(1, 9, 25, 49, ...), found 8"),
    (ops.kernel_conv, (THREE, ONE), {"border": "wrap"}, ValueError, "border: expected one of replicate, zeros"),
    (ops.KernelConv, (), {"border": "wrap"}, ValueError, "renormalize, found 'wrap'"),
    (ops.kernel_splat, (THREE, image(1, 16, 4, 5)), {}, ValueError, "kernel: expected K*K channels"),
    (ops.KernelSplat, (), {"border": ""}, ValueError, "border: expected one of"),
    (ops.softmax_splat, (THREE, image(1, 4, 4, 5)), {}, ValueError, "logits: expected K*K channels with odd K"),
    (ops.cross_bilateral_weights, (ONE, [THREE]), {}, ValueError, "falloffs: expected one for each of the 1 guides"),
    (ops.cross_bilateral_weights, (ONE, [THREE], [None]), {}, TypeError, "falloffs[0]: expected a torch.Tensor"),
    (ops.cross_bilateral_weights, (image(1, 2, 4, 5),), {}, ValueError, "kernel: expected K*K channels"),
    (ops.cross_bilateral_weights, (ONE,), {"normalize": "sum"}, ValueError, "normalize: expected 'softmax' or 'none'"),
    (ops.cross_bilateral_weights, (ONE,), {"border": "wrap"}, ValueError, "border: expected one of"),
    (ops.CrossBilateralWeights, (), {"normalize": "sum"}, ValueError, "found 'sum'"),
    (ops.cross_bilateral_filter, (THREE, ONE, [THREE]), {}, ValueError, "falloffs: expected one for each of the 1"),
    (ops.cross_bilateral_filter, (THREE, image(1, 2, 4, 5)), {}, ValueError, "kernel: expected K*K channels"),
    (ops.cross_bilateral_filter, (THREE, ONE), {"normalize": "sum"}, ValueError, "normalize: expected 'softmax' or"),
    (ops.CrossBilateralFilter, (), {"border": "wrap"}, ValueError, "border: expected one of"),
    (ops.upsample, (THREE, (8, 11)), {}, ValueError, "expected height and width (4, 6) for size (8, 11), found (4, 5)"),
    (ops.laplacian_fusion, (THREE, image(1, 3, 2, 2), ONE), {}, ValueError, "coarse: expected height and width (2, 3)"),
    # One pixel would broadcast.
    (ops.laplacian_fusion, (THREE, image(1, 3, 1, 1), ONE), {}, ValueError, "(2, 3) for (4, 5) of fine, found (1, 1)"),
    (ops.laplacian_fusion, (THREE, image(1, 3, 2, 3), image(1, 2, 4, 5)), {}, ValueError, "alpha: expected 1 or 3"),
    (ops.pyramid_partition, (THREE, image(1, 0, 4, 5)), {}, ValueError, "logits: expected a channel for each of at"),
    (ops.learned_upsample, (THREE, image(1, 9, 4, 5), (8, 10)), {}, ValueError, "(4, 16, 36, ...), found 9"),
    (ops.learned_upsample, (THREE, image(1, 8, 4, 5), (8, 10)), {}, ValueError, "K*K channels with even K"),
    (ops.learned_upsample, (THREE, image(1, 16, 4, 4), (8, 10)), {}, ValueError, "kernel: expected w = 5 as in image"),
    (ops.learned_upsample, (THREE, image(1, 16, 4, 5), (8, 11)), {}, ValueError, "expected height and width (4, 6)"),
    (
        ops.learned_upsample,
        (THREE, image(1, 16, 4, 5), (8, 10)),
        {"border": "renormalize"},
        ValueError,
        "border: expected 'replicate' or 'zeros', found 'renormalize'",
    ),
    (ops.demodulate, (THREE, THREE), {"floor": 0.0}, ValueError, "floor: expected a positive number, found 0.0"),
    (ops.grid_splat, (THREE, ONE), {"cell": 0}, ValueError, "cell: expected at least 1, found 0"),
    (ops.GridSplat, (), {"bins": 0}, ValueError, "bins: expected at least 1, found 0"),
    (ops.grid_slice, (GRID, GRID[:, :1], ONE), {"cell": 2}, ValueError, "grid: expected (2, 3) rows and columns for"),
    (ops.GridSlice, (), {"cell": -1}, ValueError, "cell: expected at least 1, found -1"),
    (ops.remodulate, (THREE, THREE), {"floor": float("nan")}, ValueError, "floor: expected a positive number"),
    (ops.clamp_fireflies, (THREE,), {"limit": 0.0}, ValueError, "limit: expected above 0, found 0.0"),
    (ops.clamp_fireflies, (THREE,), {"limit": float("nan")}, ValueError, "limit: expected above 0, found nan"),
    (ops.clamp_fireflies, (THREE,), {"kernel_size": 4}, ValueError, "kernel_size: expected odd and at least 3"),
    (ops.ClampFireflies, (), {"kernel_size": 1}, ValueError, "kernel_size: expected odd and at least 3, found 1"),
    (ops.importance_filter, (THREE, THREE), {"kernel_size": 3}, ValueError, "importance: expected shape (B, 1, H, W)"),
    (ops.importance_filter, (THREE, ONE.int()), {"kernel_size": 3}, TypeError, "importance: expected a floating-point"),
    (ops.ImportanceFilter, (), {"kernel_size": 4}, ValueError, "kernel_size: expected odd and at least 3, found 4"),
    (ops.atrous, (ONE, ONE), {}, ValueError, "light: expected at least 3 channels, found 1"),
    (ops.atrous, (THREE, ONE), {"step": 0}, ValueError, "step: expected at least 1, found 0"),
    (ops.Atrous, (), {"sigma_l": 0.0}, ValueError, "sigma_l: expected a positive number, found 0.0"),
    (ops.Atrous, (), {"sigma_n": 0.5}, ValueError, "sigma_n: expected at least 1, found 0.5"),
    (
        ops.affinity_filter,
        (THREE, ONE, ONE, ONE, THREE),
        {},
        ValueError,
        "previous_features: expected with previous, found None",
    ),
    (ops.affinity_filter, (THREE, ONE, ONE, ONE), {"kernel_size": 4}, ValueError, "kernel_size: expected odd and at"),
    (ops.AffinityFilter, (), {"dilation": 0}, ValueError, "dilation: expected at least 1, found 0"),
    (ops.MomentsVariance, (), {"kernel_size": 2}, ValueError, "kernel_size: expected odd and at least 1, found 2"),
    (ops.MomentsVariance, (), {"sigma_z": math.inf}, ValueError, "sigma_z: expected a positive number, found inf"),
    (ops.temporal_gradient, (ONE, ONE), {"stratum": 0}, ValueError, "stratum: expected at least 1, found 0"),
    (ops.TemporalGradient, (), {"levels": -1}, ValueError, "levels: expected at least 0, found -1"),
    (ops.TemporalGradient, (), {"threshold": math.nan}, ValueError, "threshold: expected at least 0, found nan"),
    (ops.block_regression, (THREE, image(1, 0, 4, 5)), {}, ValueError, "features: expected at least 1 channels, found"),
    (ops.block_regression, (THREE, ONE), {"squares": 2}, ValueError, "features: expected at least 2 channels, found 1"),
    (ops.block_regression, (THREE, ONE), {"block": 1}, ValueError, "block: expected at least 2, found 1"),
    (ops.block_regression, (THREE, ONE), {"offset": (0, 32)}, ValueError, "offset: expected two numbers from 0 to 31"),
    (ops.BlockRegression, (), {"ridge": 0.0}, ValueError, "ridge: expected a positive number, found 0.0"),
    (ops.BlockRegression, (), {"squares": -1}, ValueError, "squares: expected at least 0, found -1"),
    (ops.history_lag, (THREE, THREE, ONE), {"threshold": 0.0}, ValueError, "threshold: expected above 0, found 0.0"),
    (
        ops.history_lag,
        (THREE, THREE, ONE),
        {"kernel_size": 4},
        ValueError,
        "kernel_size: expected odd and at least 3, found 4",
    ),
    (ops.reproject, (THREE, THREE[:, :2]), {"rule": "svgf"}, ValueError, "rule: expected 'relative' or 'bmfr'"),
    (ops.reproject, (THREE, THREE[:, :2], SURFACE, SURFACE), {"rule": "bmfr"}, ValueError, "position_limit: the rule"),
    (
        ops.reproject,
        (THREE, THREE[:, :2], SURFACE, SURFACE),
        {"rule": "bmfr", "position_limit": 1.0},
        ValueError,
        "normal_limit: the rule 'bmfr' needs the scene's squared limit, found None",
    ),
    (
        ops.reproject,
        (THREE, THREE[:, :2], SURFACE._replace(normal=None), SURFACE),
        {"rule": "bmfr", "position_limit": 1.0, "normal_limit": 1.0},
        ValueError,
        "surface.normal: the rule 'bmfr' needs it in both frames, found None",
    ),
    (
        ops.reproject,
        (THREE, THREE[:, :2], ops.Surface(position=THREE), ops.Surface(position=THREE)),
        {},
        ValueError,
        "surface.depth: the rule 'relative' needs it beside position in both frames, found None",
    ),
    (ops.accumulate, (THREE, THREE, ONE.int(), THREE[:, :2]), {}, TypeError, "previous_length: expected a floating"),
    (
        ops.accumulate,
        (THREE, THREE, ONE, THREE[:, :2]),
        {"alpha_min": 0.0},
        ValueError,
        "alpha_min: expected in (0, 1], found 0.0",
    ),
    (ops.accumulate, (THREE, THREE, ONE, THREE[:, :2]), {"rule": ""}, ValueError, "rule: expected 'relative' or"),
]


@pytest.mark.parametrize(("function", "arguments", "settings", "error", "message"), REFUSED)
def test_refuses_with_name_expected_and_found(
    function: Callable[..., Any],
    arguments: tuple[Any, ...],
    settings: dict[str, Any],
    error: type[Exception],
    message: str,
) -> None:
    with pytest.raises(error, match=re.escape(message)):
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


@every_op
def test_docstring_has_every_part_of_the_contract(op: Op) -> None:
    text = inspect.getdoc(op.function) or ""
    parts = ["Args:", "Returns:", "Raises:", "Differentiable in", "Source:", "Example:"]
    places = [text.find(part) for part in parts]
    assert -1 not in places
    assert places == sorted(places)
