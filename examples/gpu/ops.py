"""Compare every operator, compiled by torch, with its plain form in float64 on the CPU, and its time with a copy's.

    python examples/gpu/ops.py -o ops.json

A row has the largest errors of the results and of the gradients, relative to the largest value, and the times of a
call in float32 on 1280x720 pixels, with and without gradients, plain and compiled, beside the time of a copy of as many
bytes as are read and written. Several processes compile at once; torch keeps what they compile on the disk.
"""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from typing import Any

import torch
from part import Part, difference
from torch import Tensor

from mcdenoise.benchmark.operators import enlarged, largest_case
from mcdenoise.check.case import Inputs, Op, as_tuple, map_tensors, tensors_in
from mcdenoise.check.cases import OPS
from mcdenoise.ops import use

PROCESSES = 8


def named(name: str) -> Op:
    """The operator of this name."""
    return next(op for op in OPS if op.function.__name__ == name)


def differentiated(function: Callable[..., Any], inputs: Inputs, settings: dict[str, Any]) -> list[list[Tensor]]:
    """The results of a function, and the gradients of a sum of them with weights that differ from pixel to pixel."""
    leaves: list[Tensor] = []

    def leaf(tensor: Tensor) -> Tensor:
        if not tensor.is_floating_point():
            return tensor
        leaves.append(tensor.detach().requires_grad_())
        return leaves[-1]

    results = [each for each in as_tuple(function(**map_tensors(leaf, inputs), **settings)) if each.requires_grad]
    if not results:
        return [list(as_tuple(function(**inputs, **settings))), []]
    weights = [torch.arange(each.numel()).double().cos().view(each.shape).to(each) for each in results]
    gradients = torch.autograd.grad(results, leaves, weights, allow_unused=True)
    return [results, [each for each in gradients if each is not None]]


def compare(name: str, device: str, size: tuple[int, int]) -> dict[str, object]:
    """Errors of a compiled operator, and the seconds that compiling took."""
    torch.set_num_threads(2)
    function = named(name).function
    inputs, settings = enlarged(largest_case(named(name)), *size, device=device)
    start = time.monotonic()
    found = differentiated(torch.compile(function), inputs, settings)
    seconds = time.monotonic() - start
    with use("torch"):
        exact = differentiated(function, map_tensors(lambda tensor: tensor.double().cpu(), inputs), settings)
    worst = [max(map(difference, *pair), default=0.0) for pair in zip(found, exact, strict=True)]
    return {"error": worst[0], "error of gradients": worst[1], "seconds to compile": round(seconds, 1)}


def timed(part: Part, name: str, size: tuple[int, int], copy: float) -> dict[str, object]:
    """Times of an operator; ``copy`` in milliseconds a byte."""
    function = named(name).function
    inputs, settings = enlarged(largest_case(named(name)), *size, device=part.device.type)
    row: dict[str, object] = {}
    for form, call in {"plain": function, "compiled": torch.compile(function)}.items():
        with torch.inference_mode(), use("torch"):
            row[form] = part.milliseconds(partial(call, **inputs, **settings))
        with use("torch"):
            row[f"{form}, gradients"] = part.milliseconds(partial(differentiated, call, inputs, settings), rounds=5)
    with torch.inference_mode():
        results: Sequence[Tensor] = as_tuple(function(**inputs, **settings))
    moved = sum(each.nbytes for each in (*tensors_in(inputs), *results))
    return {**row, "copy": {"ms": round(moved * copy, 4)}}


def main() -> None:
    part = Part.begin(__doc__)
    names = [op.function.__name__ for op in OPS]
    names, size, processes = (names[:1], (48, 32), 1) if part.quick else (names, (1280, 720), PROCESSES)
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        found = {name: pool.submit(compare, name, part.device.type, size) for name in names}
        for name, future in found.items():
            part.attempt(f"{name}: errors", partial(future.result, max(part.end - time.monotonic(), 1)))
        pool.shutdown(wait=False, cancel_futures=True)
    source = torch.ones(2**26, device=part.device)
    target = torch.empty_like(source)
    copy = float(str(part.milliseconds(lambda: target.copy_(source))["ms"])) / (2 * source.nbytes)
    for name in names:
        part.attempt(f"{name}: times", partial(timed, part, name, size, copy))


if __name__ == "__main__":
    main()
