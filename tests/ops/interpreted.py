"""The Triton kernels in Triton's interpreter, which must be chosen before they are imported: see ``test_triton.py``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
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
    outcomes,
    slice_of_pixels,
    transposed,
)
from torch import Tensor
from torch.utils import _pytree as pytree
from triton.runtime import interpreter

from mcdenoise import ops
from mcdenoise.check.cases import OPS, Case, Op, map_tensors
from mcdenoise.check.step_cases import STEPS
from mcdenoise.ops import Surface, _backend
from mcdenoise.ops._op import backends_of
from mcdenoise.ops._steps import history, network
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
        if function.fn.__module__.startswith("mcdenoise.ops._triton."):
            return function.rewrite()(*given, **named)
        return call(function, *given, **named)

    monkeypatch.setattr(interpreter.InterpretedFunction, "__call__", called)


def is_that_of_the_reference(op: Op, case: Case, dtype: torch.dtype) -> None:
    actual = outcomes(op, case, case.inputs(dtype), "triton")
    assert {tensor.dtype for tensor in actual} == {dtype}
    exact = outcomes(op, case, map_tensors(lambda tensor: tensor.double(), case.inputs(dtype)), "torch")
    assert_same(actual, exact, TOLERANCE[dtype])


def tried(pairs: list[tuple[Op, Case]]) -> list[Any]:
    """Parameters of a test; all but the first two cases of an op are slow, as the interpreter is."""
    return [
        pytest.param(op, case, id=f"{op.name}-{case.name}", marks=[] if case in seen[:2] else pytest.mark.slow)
        for op, case in pairs
        if (seen := [other for each, other in pairs if each is op])
    ]


@pytest.mark.parametrize(("op", "case"), tried(CASES))
def test_result_and_derivatives(op: Op, case: Case) -> None:
    is_that_of_the_reference(op, case, torch.float64)


@pytest.mark.parametrize(
    "dtype", [torch.bfloat16, *(pytest.param(each, marks=pytest.mark.slow) for each in (torch.float32, torch.float16))]
)
@every_op
def test_dtypes(op: Op, dtype: torch.dtype) -> None:
    is_that_of_the_reference(op, drawn(1, 3, 3, 5, 3, op, border="renormalize"), dtype)


# Wider, and taller than a tile, and no whole number of them.
@pytest.mark.parametrize("size", [(1, 1, 2, 35, 3), (2, 1, 6, 3, 3)], ids=str)
@pytest.mark.parametrize(
    "border", ["renormalize", *(pytest.param(each, marks=pytest.mark.slow) for each in ("replicate", "zeros"))]
)
@every_op
def test_sizes(op: Op, border: str, size: tuple[int, int, int, int, int]) -> None:
    is_that_of_the_reference(op, drawn(*size, op, border=border), torch.float64)


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


@pytest.mark.parametrize("needed", [("image",), ("kernel",), ("falloffs",), ("guides",)])
def test_derivatives_of_some_arguments_only(needed: tuple[str, ...]) -> None:
    op = FAST[-1]
    case = drawn(1, 3, 2, 3, 3, op)
    partial = Case("partial", "ordinary", case.tensors, needed, {"normalize": "none", "border": "renormalize"})
    is_that_of_the_reference(op, partial, torch.float64)


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


# Functions without derivatives: the steps of the models, and the operators of the accumulation.

WITHOUT = [
    *(step for step in STEPS if "triton" in backends_of(step.function)),
    *(op for op in OPS if op.name in ("motion_from_position", "accumulate")),
]
STEP_CASES = [(op, case) for op in WITHOUT for case in op.cases if case.kind == "ordinary"]


def is_plain(function: Callable[..., Any], tolerance: float, *given: Any, **settings: Any) -> None:
    """Compare a result in another precision with that of the reference implementation in float64."""

    def exact(value: Any) -> Any:
        return value.double() if isinstance(value, Tensor) else value

    with torch.no_grad():
        found = by("triton", function)(*given, **settings)
        expected = by("torch", function)(*pytree.tree_map(exact, given), **pytree.tree_map(exact, settings))
    for one, other in zip(pytree.tree_leaves(found), pytree.tree_leaves(expected), strict=True):
        torch.testing.assert_close(one.double(), other.double(), rtol=tolerance, atol=tolerance)


def test_every_step_of_the_default_model_has_a_triton_backend() -> None:
    # Torch itself has one for what is not among them: the mean of 2x2 pixels, the product with the albedo.
    names = {op.name for op in WITHOUT}
    assert names >= {"incoming", "lights", "blend", "depth_scale", "buffers_input", "network_guides", "softplus"}
    assert names >= {"gated_fusion", "low_frequencies_of", "motion_from_position", "accumulate"}


@pytest.mark.parametrize(("op", "case"), tried(STEP_CASES))
def test_result_of_a_step(op: Op, case: Case) -> None:
    given = case.inputs()
    found: Any = {}
    with torch.no_grad():
        for backend in ("triton", "torch"):
            found[backend] = pytree.tree_leaves(by(backend, op.function)(**given, **case.settings))
    for one, other in zip(found["triton"], found["torch"], strict=True):
        assert one.dtype == other.dtype
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-13, equal_nan=True)


def draw(channels: int, height: int = 9, width: int = 37, batch: int = 1, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.rand(batch, channels, height, width, dtype=torch.float64).to(dtype)


def seen(dtype: torch.dtype, *, depth: bool = True) -> Surface:
    """Surfaces of which some pixels are alike, of two labels, with background."""
    far = (1 + 0.05 * draw(1)).masked_fill(draw(1) < 0.1, torch.inf)
    buffers = (0.05 * draw(3), torch.nn.functional.normalize(draw(3), dim=1), far if depth else None)
    return Surface(*(None if each is None else each.to(dtype) for each in (*buffers, (draw(1) > 0.5).double())))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("rule", ["relative", "bmfr"])
def test_all_of_a_blend(rule: str, dtype: torch.dtype) -> None:
    limits = {"position_limit": 0.01, "normal_limit": 1.0} if rule == "bmfr" else {}
    # Half of the pixels see mirrors; motion out of the image, and unknown.
    motion = 2 * draw(2) - 1
    motion[..., :2, :2], motion[..., 3, 4] = torch.inf, torch.nan
    given = {
        "entering": draw(5),
        "previous": draw(9),
        "previous_length": 1 + 12 * draw(1),
        "motion": motion,
        "albedo": draw(3) * (draw(1) > 0.5),
    }
    given = {name: value.to(dtype) for name, value in given.items()}
    depth = rule == "relative"
    surfaces = {"surface": seen(dtype, depth=depth), "previous_surface": seen(dtype, depth=depth)}
    settings = {"rule": rule, "specular_length": 2.0, "lag_threshold": 0.8, **limits}
    is_plain(history.blend, 1e-12 if dtype == torch.float64 else 1e-5, **given, **surfaces, **settings)


# Without a limit the highest radiance is infinite on its way to the largest number.
@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning")
@pytest.mark.parametrize("albedo", [True, False])
@pytest.mark.parametrize("limit", [15.0, 2.0, torch.inf, "of each image"])
def test_incoming_color_of_a_history(limit: Any, albedo: bool) -> None:
    limits = torch.tensor([1.5, torch.inf]).double().reshape(2, 1, 1, 1) if isinstance(limit, str) else limit
    color = draw(3, batch=2) * (draw(1, batch=2) > 0.3) * 10 ** (3 * draw(1, batch=2))
    tint = draw(3, batch=2) * (draw(1, batch=2) > 0.2) if albedo else None
    is_plain(history.incoming, 1e-12, color, tint, limits, kernel_size=5)
    is_plain(history.incoming, 1e-12, color, tint, limits, kernel_size=3, compared=False)


def test_lights_across_tiles() -> None:
    root = draw(1, 13, 40)
    root[..., 3:9, 28:36] = 4
    found = by("triton", history.lights)(root)
    assert found[..., 3:9, 28:36].all()
    assert found.sum() == 48
    is_plain(history.lights, 0, root)


@pytest.mark.parametrize("logarithms", [True, False])
def test_a_fusion_with_all_that_it_may_have(logarithms: bool) -> None:
    fine, coarse = draw(3, batch=2), draw(3, 5, 19, batch=2)
    weight, bias, maximum = (
        torch.randn(1, 6, 3, 3).double(),
        torch.randn(1).double(),
        torch.full((2, 1, 1, 1), 0.4).double(),
    )
    residual = None if logarithms else draw(3, batch=2, dtype=torch.bfloat16)
    is_plain(
        network.gated_fusion,
        1e-12,
        fine,
        coarse,
        weight,
        bias,
        residual=residual,
        maximum=maximum,
        logarithms=logarithms,
    )


def test_low_frequencies_over_many_blocks() -> None:
    fine, coarse = draw(3, 27, 41), draw(3, 14, 21)
    maximum, exposure = torch.full((1, 1, 1, 1), 0.9).double(), torch.full((1, 1, 1, 1), 2.0).double()
    is_plain(network.low_frequencies_of, 1e-12, fine, coarse, maximum, exposure)


def test_a_depth_of_more_pixels_than_threads() -> None:
    depth = (1 + 30 * draw(1, 97, 131, batch=2)).masked_fill(draw(1, 97, 131, batch=2) < 0.2, torch.inf)
    depth[..., 0, :9] = 1e30
    depth[1] = torch.inf
    is_plain(network.depth_scale, 1e-12, depth)


def test_the_input_of_a_network_is_as_a_convolution_takes_it() -> None:
    buffers: dict[str, Any] = {
        "image": draw(3, dtype=torch.float32),
        "albedo": channels_last(draw(3, dtype=torch.bfloat16)),
        "normal": transposed(draw(3, dtype=torch.float32)),
        "depth": every_other_column(draw(1, dtype=torch.float32)),
        "current": slice_of_pixels(draw(3, dtype=torch.float32)),
        "length": None,
        "exposure": torch.full((1, 1, 1, 1), 3.0),
        "scale": (torch.full((1, 1, 1, 1), 2.0), torch.full((1, 1, 1, 1), 0.7)),
    }
    factor = torch.full((1, 1, 1, 1), 0.3)
    is_plain(network.buffers_input, 1e-6, **buffers, image_factor=factor)
    with torch.autocast("cpu", torch.bfloat16):
        found = by("triton", network.buffers_input)(**buffers, logarithms=False)
    assert found.dtype == torch.bfloat16
    assert found.is_contiguous(memory_format=torch.channels_last)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
@pytest.mark.parametrize("op", WITHOUT, ids=lambda op: op.name)
def test_a_step_goes_through_the_compiler(op: Op) -> None:
    case = op.cases[0]
    given = case.inputs()
    torch.compiler.reset()
    with torch.no_grad():
        compiled = by("triton", torch.compile(op.function, fullgraph=True, backend="aot_eager"))(
            **given, **case.settings
        )
        plainly = by("triton", op.function)(**given, **case.settings)
    for one, other in zip(pytree.tree_leaves(compiled), pytree.tree_leaves(plainly), strict=True):
        assert torch.equal(one, other)
