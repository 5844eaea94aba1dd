"""The fast backends against plain torch."""

import contextvars
import importlib
import threading
from collections.abc import Callable
from typing import Any

import pytest
import torch
from reference_cases import FAST, LAYOUTS, TOLERANCE, assert_same, by, outcomes
from torch import Generator, Tensor
from torch.fx.experimental.proxy_tensor import make_fx

from mcdenoise import ops
from mcdenoise.check.cases import Case, Inputs, Op, map_tensors
from mcdenoise.ops import _backend
from mcdenoise.ops._numba import _runtime

pytestmark = pytest.mark.usefixtures("nan_in_fresh_memory")
Draw = Callable[[int], Tensor]
every_op = pytest.mark.parametrize("op", FAST, ids=lambda op: op.name)


@every_op
def test_result_is_that_of_plain_torch(op: Op) -> None:
    # The extreme ones have bounds of their own, see `mcdenoise stability`.
    for i, case in enumerate(case for case in op.cases if case.kind != "extreme"):
        for dtype, tolerance in [*TOLERANCE.items()][i % 2 :: 2]:
            inputs = case.inputs(dtype)
            actual, plain = (outcomes(op, case, inputs, backend) for backend in ("numba", "torch"))
            assert [tensor.dtype for tensor in actual] == [tensor.dtype for tensor in plain]
            assert_same(actual, [tensor.double() for tensor in plain], 2 * tolerance)


def _filter(draw: Draw) -> Inputs:
    return {"image": draw(3), "kernel": draw(25) + 0.1}


def _bilateral(draw: Draw) -> Inputs:
    guides = {"guides": [draw(3), draw(1)], "falloffs": [draw(1), 3 * draw(1)], "distance_falloff": draw(1)}
    return {**_filter(draw), **guides}


def _affinity(draw: Draw) -> Inputs:
    inputs: Inputs = {"image": draw(3), "features": draw(5), "bandwidth": 5 * draw(1), "center": draw(1) + 0.1}
    before = "previous", "previous_features", "previous_bandwidth", "previous_weight"
    return inputs | dict(zip(before, (draw(3), draw(5), 5 * draw(1), draw(1)), strict=True))


def _slice(draw: Draw) -> Inputs:
    guide = 1.4 * draw(1) - 0.2
    cells = len(guide), 4, -(-guide.shape[2] // 4), -(-guide.shape[3] // 4), 5
    grid = torch.rand(cells, generator=Generator().manual_seed(1), dtype=torch.float64)
    return {"grid": grid[:, :3], "filled": (grid[:, 3:] - 0.2).clamp_min(0), "guide": guide}


def _moments(draw: Draw) -> Inputs:
    mean = draw(1)
    return {"moments": torch.cat([mean, mean.square() + draw(1)], 1), "normal": draw(3), "depth": 1 + draw(1)}


def _changes(draw: Draw) -> Inputs:
    before = draw(1)
    named = {"current": 2 * before + draw(1), "previous": before, "weight": 0.1 + draw(1), "variance": 0.01 * draw(1)}
    return {**named, "normal": draw(3), "depth": 1 + draw(1)}


def _reprojected(draw: Draw) -> Inputs:
    inputs: Inputs = {"previous": draw(3), "motion": 4 * draw(2) - 2}
    surfaces = ("surface", "previous_surface")
    return inputs | {name: ops.Surface(draw(3), draw(3), 1 + draw(1), draw(1).round()) for name in surfaces}


def _accumulated(draw: Draw) -> Inputs:
    return {"color": draw(3), **_reprojected(draw), "previous_length": 1 + 5 * draw(1)}


LIMITS = {"position_limit": 0.3, "normal_limit": 0.4}
WINDOWS: dict[str, tuple[Callable[[Draw], Inputs], dict[str, Any]]] = {
    "kernel_conv": (_filter, {"border": "replicate"}),
    "cross_bilateral_filter": (_bilateral, {"border": "renormalize"}),
    "affinity_filter": (_affinity, {"kernel_size": 5, "dilation": 2}),
    "grid_splat": (lambda draw: {"image": draw(5), "guide": 1.4 * draw(1) - 0.2}, {"cell": 4, "bins": 5}),
    "grid_slice": (_slice, {"cell": 4}),
    "importance_filter": (lambda draw: {"image": draw(3), "importance": 20 * draw(1)}, {"kernel_size": 5}),
    "atrous": (
        lambda draw: {"light": draw(5), "variance": 0.1 * draw(1) + 0.01, "normal": draw(3), "depth": 1 + draw(1)},
        {"step": 2, "sigma_n": 2.0},
    ),
    "moments_variance": (_moments, {"kernel_size": 5, "sigma_n": 2.0}),
    "temporal_gradient": (_changes, {"stratum": 2, "levels": 2, "sigma_n": 2.0}),
    "resample": (lambda draw: {"previous": draw(3), "motion": 4 * draw(2) - 2}, {}),
    "reproject": (_reprojected, LIMITS),
    "accumulate": (_accumulated, LIMITS),
}
every_window = pytest.mark.parametrize("op", [op for op in FAST if op.name in WINDOWS], ids=lambda op: op.name)


def drawn(op: Op, batch: int, height: int, width: int, **settings: Any) -> Case:
    inputs_of, usual = WINDOWS[op.name]

    def tensors(g: Generator) -> Inputs:
        return inputs_of(lambda count: torch.rand(batch, count, height, width, generator=g, dtype=torch.float64))

    return Case("drawn", "ordinary", tensors, (), usual | settings)


# Wider than a run of pixels, taller than the rows of a thread, smaller than a window and than a cell, and empty.
@every_window
def test_sizes(op: Op) -> None:
    borders = [{"border": border} for border in ("replicate", "zeros", "renormalize")]
    for size in ((1, 3, 600), (2, 40, 2), (2, 9, 7), (1, 1, 1), (0, 5, 7)):
        for settings in borders if "border" in WINDOWS[op.name][1] else [{}]:
            case = drawn(op, *size, **settings)
            actual, plain = (outcomes(op, case, case.inputs(), backend) for backend in ("numba", "torch"))
            assert_same(actual, plain, TOLERANCE[torch.float64])


def _cells_apart(tensor: Tensor) -> Tensor:
    """Return a view of a grid that has other cells beside each of its own."""
    return torch.stack([torch.full_like(tensor, torch.nan), tensor], -1)[..., 1]


@every_window
def test_neither_threads_nor_layout_in_memory_change_a_bit(op: Op, monkeypatch: pytest.MonkeyPatch) -> None:
    case = drawn(op, 2, 9, 11)
    for dtype in (torch.float32, torch.bfloat16):
        expected = outcomes(op, case, case.inputs(dtype), "numba")
        for layout in LAYOUTS:
            laid_out = map_tensors(lambda x, lay=layout: (lay if x.ndim == 4 else _cells_apart)(x), case.inputs(dtype))
            assert all(map(torch.equal, outcomes(op, case, laid_out, "numba"), expected)), layout.__name__
    monkeypatch.setattr(_runtime, "PIXELS_A_THREAD", 1)
    torch.set_num_threads(5)
    assert all(map(torch.equal, outcomes(op, case, case.inputs(torch.bfloat16), "numba"), expected))


@every_window
def test_a_nan_is_seen(op: Op) -> None:
    case = drawn(op, 1, 5, 7)
    for name, value in case.inputs().items():
        # An image that is resampled is finite, by its contract.
        if not isinstance(value, Tensor) or op.name == "resample":
            continue
        inputs = case.inputs(torch.float32)
        inputs[name][0, 0, 1, 1] = torch.nan  # type: ignore[index]
        fast, plain = (outcomes(op, case, inputs, backend)[0] for backend in ("numba", "torch"))
        assert torch.equal(fast.isnan(), plain.isnan()), name


def test_a_kernel_of_another_dtype_than_the_image() -> None:
    for op in (op for op in FAST if op.name in ("kernel_conv", "cross_bilateral_filter")):
        case = drawn(op, 1, 5, 7)
        inputs = case.inputs(torch.float32)
        inputs["kernel"] = inputs["kernel"].bfloat16()
        exact = map_tensors(lambda tensor: tensor.double(), inputs)
        assert_same(outcomes(op, case, inputs, "numba"), outcomes(op, case, exact, "torch"), TOLERANCE[torch.float32])


def chosen(image: Tensor) -> str:
    return _backend.choose_backend(["numba"], [image])


LARGE, SMALL = torch.rand(2, 3, 64, 64), torch.rand(1, 3, 4, 4)


def test_the_default_backend(monkeypatch: pytest.MonkeyPatch) -> None:
    assert chosen(LARGE) == "numba"
    assert chosen(SMALL) == "torch"
    assert chosen(LARGE.to("meta")) == "torch"
    assert chosen(LARGE.clone().requires_grad_()) == "torch"
    assert _backend.choose_backend([], [LARGE]) == "torch"
    assert _backend.choose_backend(["numba"], [torch.rand(1, 3, 2, 2, 4), LARGE]) == "numba"
    assert by("torch", chosen)(LARGE) == "torch"
    assert by("numba", chosen)(SMALL) == "numba"
    monkeypatch.setattr(_backend, "_missing", lambda: "cannot be imported")
    assert chosen(LARGE) == "torch"


def test_threads_and_contexts_that_use_different_backends_do_not_cross() -> None:
    turns, found = threading.Barrier(2, timeout=60), {}

    def work(backend: Any) -> None:
        with ops.use(backend):
            turns.wait()
            found[backend] = [chosen(LARGE)]
            turns.wait()
        found[backend].append(chosen(LARGE))

    threads = [threading.Thread(target=work, args=(backend,)) for backend in ("torch", "numba")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == {"torch": ["torch", "numba"], "numba": ["numba", "numba"]}
    with ops.use("torch"):
        other = contextvars.copy_context()
        assert other.run(chosen, LARGE) == "torch"
    assert other.run(chosen, LARGE) == "torch"
    assert chosen(LARGE) == "numba"


def test_a_named_backend_runs_or_says_why_it_cannot(monkeypatch: pytest.MonkeyPatch) -> None:
    image, kernel = torch.rand(1, 3, 4, 5), torch.rand(1, 9, 4, 5)
    with pytest.raises(ValueError, match=r"backend: .*'cuda'"):
        by("cuda", ops.kernel_conv)(image, kernel)
    with pytest.raises(ValueError, match="found 'numba', which runs on the CPU, not on meta"):
        by("numba", ops.kernel_conv)(image.to("meta"), kernel.to("meta"))
    with pytest.raises(ValueError, match="found 'numba', which has no derivatives"):
        by("numba", ops.kernel_conv)(image, kernel.requires_grad_())

    def gone(name: str) -> None:
        raise ImportError("gone")

    monkeypatch.setattr(importlib, "import_module", gone)
    _backend._missing.cache_clear()
    # It is there and fails, as with too little memory: said once, and then plain torch runs.
    with (
        pytest.warns(UserWarning, match="plain torch is used"),
        pytest.raises(ValueError, match=r"found 'numba', which cannot be imported \(gone\); install mcdenoise\[fast\]"),
    ):
        by("numba", ops.cross_bilateral_filter)(image, kernel.detach())
    big, of_big = torch.rand(1, 3, 300, 300), torch.rand(1, 9, 300, 300)
    assert torch.equal(ops.kernel_conv(big, of_big), by("torch", ops.kernel_conv)(big, of_big))
    _backend._missing.cache_clear()


class _Filter(torch.nn.Module):
    def forward(self, image: Tensor, kernel: Tensor, guide: Tensor, scale: Tensor) -> Tensor:
        return ops.cross_bilateral_filter(image, kernel, [guide], [scale])


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_graph_needs_no_numba() -> None:
    # Large enough that it would run compiled.
    arguments = (torch.rand(1, 3, 96, 96), torch.rand(1, 9, 96, 96), torch.rand(1, 2, 96, 96), torch.rand(1, 1, 96, 96))
    program = by("numba", torch.export.export)(_Filter(), arguments)
    assert "mcdenoise" not in str(program.graph)
    torch.testing.assert_close(program.module()(*arguments), by("torch", _Filter())(*arguments))


# The warnings are torch's own, about sizes that become constants.
@pytest.mark.filterwarnings("ignore:.*jit.*:DeprecationWarning", "ignore::torch.jit.TracerWarning")
@pytest.mark.parametrize("trace", [lambda f, x: make_fx(f)(*x), torch.jit.trace], ids=["make_fx", "jit"])
@pytest.mark.parametrize(
    "call",
    [lambda a, b: ops.kernel_conv(a, b), lambda a, b: ops.accumulate(a, b[:, :3], b[:, 3:4], b[:, 4:6])[0]],
    ids=["kernel_conv", "accumulate"],
)
def test_what_is_traced_is_plain_torch(trace: Callable[..., Any], call: Callable[..., Tensor]) -> None:
    first, second = ((torch.rand(1, 3, 96, 96), torch.rand(1, 9, 96, 96)) for _ in range(2))
    torch.testing.assert_close(trace(call, first)(*second), by("torch", call)(*second))
