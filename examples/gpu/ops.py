"""Compare every operator, compiled by torch, with its plain form in float64 on the CPU, and its time with a copy's.

    python examples/gpu/ops.py -o ops.json

A row has the largest errors of the results and of the gradients, relative to the largest value, on 320x180 pixels; or
the times of a call in float32 on 1280x720 pixels, with and without gradients, beside the time of a copy of as many
bytes as are read and written. Several processes compile at once, for both; torch keeps what they compile on the disk.
Times are measured when they have ended.
"""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from multiprocessing import get_context
from typing import Any

import torch
from part import SIZES, Part, difference
from torch import Tensor

from mcdenoise.benchmark.operators import enlarged, largest_case
from mcdenoise.check.case import Inputs, Op, as_tuple, map_tensors, tensors_in
from mcdenoise.check.cases import OPS
from mcdenoise.ops import use

# In this order, the most important first; then all others.
FIRST = (
    "kernel_conv",
    "reproject",
    "accumulate",
    "cross_bilateral_filter",
    "kernel_splat",
    "softmax_splat",
    "downsample",
    "upsample",
    "laplacian_fusion",
    "atrous",
    "pyramid_partition",
    "demodulate",
)
PROCESSES = 14
COMPARED = (320, 180)
# The parts of the time after which no process compares, and none compiles.
COMPARING, COMPILING = 0.5, 0.65


def named(name: str) -> Op:
    """The operator of this name."""
    return next(op for op in OPS if op.function.__name__ == name)


def differentiated(
    function: Callable[..., Any], inputs: Inputs, settings: dict[str, Any], weights: Sequence[Tensor] = ()
) -> list[list[Tensor]]:
    """The results of a function, and the gradients of a sum of them with weights, by default those of the results."""
    leaves: list[Tensor] = []

    def leaf(tensor: Tensor) -> Tensor:
        if not tensor.is_floating_point():
            return tensor
        leaves.append(tensor.detach().requires_grad_())
        return leaves[-1]

    results = as_tuple(function(**map_tensors(leaf, inputs), **settings))
    pairs = [pair for pair in zip(results, weights or weights_of(results), strict=True) if pair[0].requires_grad]
    if not pairs:
        return [list(results), []]
    summed, scales = zip(*pairs, strict=True)
    gradients = torch.autograd.grad(summed, leaves, scales, allow_unused=True)
    return [list(summed), [each for each in gradients if each is not None]]


def weights_of(results: Sequence[Tensor]) -> list[Tensor]:
    """Weights that differ from pixel to pixel, for each result."""
    return [torch.arange(each.numel()).double().cos().view(each.shape).to(each) for each in results]


def compare(name: str, device: str, size: tuple[int, int]) -> dict[str, object]:
    """Errors of a compiled operator, and the seconds that compiling took."""
    torch.set_num_threads(1)
    function = named(name).function
    inputs, settings = enlarged(largest_case(named(name)), *size, device=device)
    start = time.monotonic()
    found = differentiated(compiled(function), inputs, settings)
    seconds = time.monotonic() - start
    with use("torch"):
        exact = differentiated(function, map_tensors(lambda tensor: tensor.double().cpu(), inputs), settings)
    worst = [max(map(difference, *pair), default=0.0) for pair in zip(found, exact, strict=True)]
    return {"error": worst[0], "error of gradients": worst[1], "seconds to compile": round(seconds, 1)}


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function compiled for one size of images."""
    return torch.compile(function, dynamic=False)


def forms(name: str, device: str, size: tuple[int, int], *, compiling: bool) -> Iterator[tuple[str, Callable[[], Any]]]:
    """A call of an operator without and one with gradients; each must be made while it is the last one."""
    function = named(name).function
    inputs, settings = enlarged(largest_case(named(name)), *size, device=device)
    call = compiled(function) if compiling else function
    with torch.inference_mode(), use("torch"):
        yield "without gradients", partial(call, **inputs, **settings)
    with use("torch"):
        with torch.no_grad():
            weights = weights_of(as_tuple(function(**inputs, **settings)))
        yield "with gradients", partial(differentiated, call, inputs, settings, weights)


def compile_forms(name: str, device: str, size: tuple[int, int]) -> None:
    """Compile what is timed later."""
    for _, call in forms(name, device, size, compiling=True):
        call()


def timed(part: Part, name: str, size: tuple[int, int], copy: float, *, compiling: bool) -> dict[str, object]:
    """Times of an operator; ``copy`` in milliseconds a byte."""
    row: dict[str, object] = {
        form: part.milliseconds(call, rounds=10)
        for form, call in forms(name, part.device.type, size, compiling=compiling)
    }
    function = named(name).function
    inputs, settings = enlarged(largest_case(named(name)), *size, device=part.device.type)
    with torch.inference_mode(), use("torch"):
        results: Sequence[Tensor] = as_tuple(function(**inputs, **settings))
    moved = sum(each.nbytes for each in (*tensors_in(inputs), *results))
    return {**row, "copy": {"ms": round(moved * copy, 4)}}


def main() -> None:
    part = Part.begin(__doc__)
    names = list(dict.fromkeys((*FIRST, *(op.function.__name__ for op in OPS))))
    size, compared, processes, seconds = SIZES[0], COMPARED, PROCESSES, part.left
    if part.quick:
        names, size, compared, processes = names[:1], (64, 48), (48, 32), 1
    device = part.device.type
    # Each process compiles by itself.
    os.environ.setdefault("TORCHINDUCTOR_COMPILE_THREADS", "1")
    with get_context("spawn").Pool(processes) as pool:
        found = {name: pool.apply_async(compare, (name, device, compared)) for name in names}
        ready = [pool.apply_async(compile_forms, (name, device, size)) for name in names]
        for name, result in found.items():
            left = part.left - seconds * (1 - COMPARING)
            part.attempt(f"{name}: errors", partial(result.get, max(left, 0.01)))
        for done in ready:
            done.wait(max(part.left - seconds * (1 - COMPILING), 0.01))
    source = torch.ones(2**26, device=part.device)
    target = torch.empty_like(source)
    copy = float(str(part.milliseconds(lambda: target.copy_(source))["ms"])) / (2 * source.nbytes)
    for compiling in (False, True):
        for name in names:
            measure = partial(timed, part, name, size, copy, compiling=compiling)
            part.attempt(f"{name}: times, {'compiled' if compiling else 'plain'}", measure)


if __name__ == "__main__":
    main()
