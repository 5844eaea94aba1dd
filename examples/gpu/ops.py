"""Compare every operator, compiled by torch, with its plain form in float64, and its time with a copy's.

    python examples/gpu/ops.py -o ops.json

A row has an operator without or with gradients on 1280x720 pixels: times of the plain and of the compiled form in
float32, beside the time of a copy of as many bytes as are read and written, and the largest errors of the compiled
form, relative to the largest value. Several processes compile at once, and take turns on the device.
"""

import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from multiprocessing import TimeoutError, get_context
from typing import Any

import torch
from part import SIZES, Part, difference, failure, milliseconds
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
FORMS = ("without gradients", "with gradients")
# What the processes take turns with.
TURN: list[Any] = []


def named(name: str) -> Op:
    """The operator of this name."""
    return next(op for op in OPS if op.function.__name__ == name)


def differentiated(
    function: Callable[..., Any], inputs: Inputs, settings: dict[str, Any], weights: Sequence[Tensor]
) -> list[list[Tensor]]:
    """The results of a function, and the gradients of a sum of them with weights."""
    leaves: list[Tensor] = []

    def leaf(tensor: Tensor) -> Tensor:
        if not tensor.is_floating_point():
            return tensor
        leaves.append(tensor.detach().requires_grad_())
        return leaves[-1]

    results = as_tuple(function(**map_tensors(leaf, inputs), **settings))
    pairs = [pair for pair in zip(results, weights, strict=True) if pair[0].requires_grad]
    if not pairs:
        return [list(results), []]
    summed, scales = zip(*pairs, strict=True)
    gradients = torch.autograd.grad(summed, leaves, scales, allow_unused=True)
    return [list(summed), [each for each in gradients if each is not None]]


def weights_of(results: Sequence[Tensor]) -> list[Tensor]:
    """Weights that differ from pixel to pixel, for each result."""
    return [torch.arange(each.numel()).double().cos().view(each.shape).to(each) for each in results]


def begin(turn: Any) -> None:
    """Make one of the processes ready."""
    torch.set_num_threads(1)
    TURN.append(turn)


def measured(
    task: tuple[str, str], device: torch.device, size: tuple[int, int], copy: float, rounds: int
) -> tuple[str, dict[str, object]]:
    """The row of an operator in one form; ``copy`` in milliseconds a byte."""
    (name, form), row = task, dict[str, object]()
    try:
        function = named(name).function
        inputs, settings = enlarged(largest_case(named(name)), *size, device=device.type)
        with torch.no_grad(), use("torch"):
            results: Sequence[Tensor] = as_tuple(function(**inputs, **settings))
        weights, moved = weights_of(results), sum(each.nbytes for each in (*tensors_in(inputs), *results))

        def run(function: Callable[..., Any], inputs: Inputs, weights: Sequence[Tensor]) -> list[list[Tensor]]:
            with use("torch"):
                if form == FORMS[1]:
                    return differentiated(function, inputs, settings, weights)
                with torch.no_grad():
                    return [list(as_tuple(function(**inputs, **settings))), []]

        with TURN[0]:
            row["plain"] = milliseconds(device, partial(run, function, inputs, weights), rounds)
        row["copy"] = {"ms": round(moved * copy, 4)}
        start, call = time.monotonic(), partial(run, torch.compile(function, dynamic=False), inputs, weights)
        found = call()
        row["seconds to compile"] = round(time.monotonic() - start, 1)
        with TURN[0]:
            row["compiled"] = milliseconds(device, call, rounds)
            exact = run(function, map_tensors(to_float64, inputs), list(map(to_float64, weights)))
            errors = [max(map(difference, *pair), default=0.0) for pair in zip(found, exact, strict=True)]
            row |= dict(zip(("error", "error of gradients"), errors, strict=True))
    except Exception as error:  # whatever a device or a compiler raises
        row |= failure(error)
    return f"{name}, {form}", row


def to_float64(tensor: Tensor) -> Tensor:
    """The same numbers in double precision; whole numbers as they are."""
    return tensor.double() if tensor.is_floating_point() else tensor


def main() -> None:
    part = Part.begin(__doc__)
    names = list(dict.fromkeys((*FIRST, *(op.function.__name__ for op in OPS))))
    size, processes, rounds = SIZES[0], PROCESSES, 10
    if part.quick:
        names, size, processes, rounds = names[:1], (64, 48), 1, 2
    source = torch.ones(2**26, device=part.device)
    target = torch.empty_like(source)
    copy = float(str(part.milliseconds(lambda: target.copy_(source))["ms"])) / (2 * source.nbytes)
    # Each process compiles by itself.
    os.environ.setdefault("TORCHINDUCTOR_COMPILE_THREADS", "1")
    context, tasks = get_context("spawn"), [(name, form) for form, name in product(FORMS, names)]
    missing = {f"{name}, {form}" for name, form in tasks}
    with context.Pool(processes, begin, (context.Lock(),)) as pool:
        measure = partial(measured, device=part.device, size=size, copy=copy, rounds=rounds)
        rows = pool.imap_unordered(measure, tasks)
        try:
            for _ in tasks:
                name, row = rows.next(part.left)
                missing.remove(name)
                part.add(name=name, **row)
        except TimeoutError:
            pool.terminate()
    for name in sorted(missing):
        part.add(name=name, failed="not reached in time")


if __name__ == "__main__":
    main()
