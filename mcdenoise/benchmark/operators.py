"""The cost of each op in each backend and dtype, its error, and its time in units of a copy."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import nullcontext
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mcdenoise.benchmark.machine import check_device, describe_machine, fix_threads
from mcdenoise.benchmark.tables import write_ops_csv
from mcdenoise.check.case import DTYPES, as_tuple, tensors_in
from mcdenoise.check.cases import OPS, Case, Inputs, Op, map_tensors
from mcdenoise.check.overview import relative_error
from mcdenoise.data.files import new_folder
from mcdenoise.errors import InputError, in_one_line
from mcdenoise.models._times import Stopwatch
from mcdenoise.ops import use
from mcdenoise.ops._backend import Backend
from mcdenoise.ops._op import backends_of
from mcdenoise.ops._window import parts_of
from mcdenoise.results import OpCost, OpResults, Spread

# Far larger than any cache, so that the copy shows the memory's speed.
_COPY_BYTES = 2**28
_WARM_UP = 2


@dataclass
class _Entry:
    """One op in one backend and dtype, at one size."""

    op: Op
    case: Case
    backend: Backend
    dtype: torch.dtype
    inputs: Inputs
    settings: dict[str, Any]
    times: list[float] = field(default_factory=list)
    mebibytes: float = 0.0
    times_with_derivatives: list[float] = field(default_factory=list)
    mebibytes_with_derivatives: float = 0.0
    upstream: list[Tensor] = field(default_factory=list)
    error: float | None = None
    failure: str = ""

    def run(self, watch: Stopwatch, device: str, warm: bool) -> None:
        """Call the op once, and once with its derivatives; times count once it is warm."""
        if self.failure:
            return
        try:
            with torch.inference_mode():
                self.error = _error(self, device) if self.error is None else self.error
                start = watch.mark()
                results = self.call(self.inputs, self.settings)
                taken = watch.between(start, watch.mark())
            start = watch.mark()
            gradients = self._differentiate()
            with_derivatives = watch.between(start, watch.mark())
        except Exception as error:  # whatever a backend refuses with: the others go on
            self.failure = in_one_line(error)
            return
        moved = sum(tensor.nbytes for tensor in (*tensors_in(self.inputs), *results)) / 2**20
        self.mebibytes = moved
        if gradients is not None:
            self.mebibytes_with_derivatives = 2 * moved + sum(gradient.nbytes for gradient in gradients) / 2**20
        if warm:
            self.times.append(taken)
            self.times_with_derivatives += [] if gradients is None else [with_derivatives]

    def call(self, inputs: dict[str, Any], settings: dict[str, Any]) -> tuple[Tensor, ...]:
        """The op's results."""
        with use(self.backend):
            return as_tuple(self.op.function(**inputs, **settings))

    def _differentiate(self) -> list[Tensor] | None:
        """Derivatives in all floating-point inputs of the sum of the results, ``None`` if there are none."""
        inputs = map_tensors(lambda x: x.detach().requires_grad_() if x.is_floating_point() else x, self.inputs)
        try:
            results = [result for result in self.call(inputs, self.settings) if result.requires_grad]
        except ValueError:  # this backend has none
            return None
        if not results:
            return None
        # Made in the rounds that warm up.
        self.upstream = self.upstream or [torch.ones_like(result) for result in results]
        leaves = [tensor for tensor in tensors_in(inputs) if tensor.requires_grad]
        found = torch.autograd.grad(results, leaves, self.upstream, allow_unused=True)
        return [gradient for gradient in found if gradient is not None]

    def cost(self, bandwidth: float) -> OpCost:
        """The measured cost; ``bandwidth`` in bytes a second."""
        about = self.op.name, self.backend, str(self.dtype).removeprefix("torch."), self.case.name
        if self.failure:
            return OpCost(*about, failure=self.failure)
        a_mebibyte = 2**20 * 1e3 / bandwidth
        alone = Spread.of(self.times), self.error, self.mebibytes, self.mebibytes * a_mebibyte
        if not self.times_with_derivatives:
            return OpCost(*about, *alone)
        moved = self.mebibytes_with_derivatives
        return OpCost(*about, *alone, Spread.of(self.times_with_derivatives), moved, moved * a_mebibyte)


def benchmark_ops(
    *,
    size: tuple[int, int] = (1280, 720),
    rounds: int = 5,
    threads: int = 1,
    device: str = "cpu",
    out: Path | None = None,
    command: str = "",
    ops: Iterable[Op] = OPS,
    on_step: Callable[[int, int], None] = lambda done, total: None,
) -> OpResults:
    """Time every op, alone and with its derivatives, in each of its backends and in float32, bfloat16 and float16.

    The inputs are those of an ordinary case, see :func:`largest_case`, repeated to the size. All backends and
    dtypes of an op, and a copy of 256 MiB, take turns; two rounds warm up. The error is that over the op's ordinary
    cases at their own size, where the equation is written out in float64.

    Args:
        size: width and height in pixels, at least 2.
        rounds: calls of each.
        threads: of torch; sets them.
        device: ``"cpu"`` or ``"cuda"``.
        out: folder to make for ``ops.json`` and ``ops.csv``; by default nothing is written.
        command: the command line, to be stored with the results.
        ops: which.
        on_step: called with the number of ops done, and that of all of them.

    Raises:
        InputError: a number is too small, the device cannot be used, or ``out`` exists and is no empty folder.
    """
    width, height = size
    if min(size) < 2 or rounds < 1 or threads < 1:
        raise InputError(
            f"--ops: expected an image of 2x2 pixels at least, rounds and threads, "
            f"found {width}x{height}, {rounds} and {threads}"
        )
    check_device(device)
    with new_folder(out) if out is not None else nullcontext() as folder:
        fix_threads(threads)
        entries, bandwidth = _measured(list(ops), size, rounds, device, on_step)
        results = OpResults(
            command=command,
            created=datetime.now(UTC).isoformat(timespec="seconds"),
            machine=describe_machine(device),
            width=width,
            height=height,
            rounds=rounds,
            bandwidth=bandwidth / 1e9,
            costs=[entry.cost(bandwidth) for entry in entries],
        )
        if folder is not None:
            results.write(folder)
            write_ops_csv(results, folder)
    return results


def _measured(
    ops: list[Op], size: tuple[int, int], rounds: int, device: str, on_step: Callable[[int, int], None]
) -> tuple[list[_Entry], float]:
    """What was measured of every op, and the bytes that a copy moves in a second."""
    watch, source = Stopwatch(device), torch.ones(_COPY_BYTES // 4, device=device)
    target = torch.empty_like(source)
    copies: list[float] = []
    entries: list[_Entry] = []
    for done, op in enumerate(ops, start=1):
        case = largest_case(op)
        own = [
            _Entry(op, case, backend, dtype, *enlarged(case, *size, dtype=dtype, device=device))
            for backend in backends_of(op.function)
            for dtype in DTYPES
        ]
        for turn in range(_WARM_UP + rounds):
            for entry in own:
                entry.run(watch, device, turn >= _WARM_UP)
            start = watch.mark()
            target.copy_(source)
            copies += [watch.between(start, watch.mark())] if turn >= _WARM_UP else []
        for entry in own:
            # The next ones need the memory.
            entry.inputs, entry.upstream = {}, []
        entries += own
        on_step(done, len(ops))
    # Read once, and written once.
    return entries, 2 * _COPY_BYTES * 1e3 / Spread.of(copies).median


def largest_case(op: Op) -> Case:
    """The ordinary case of one image, of more than one pixel, with the most values a pixel; in RGB if there is one."""

    def size(case: Case) -> tuple[bool, float]:
        tensors, (height, width) = tensors_in(case.inputs()), _size(case)
        in_rgb = any(tensor.ndim == 4 and tensor.shape[1] == 3 for tensor in tensors)
        return in_rgb, sum(tensor.numel() for tensor in tensors) / (height * width)

    images = (case for case in op.cases if case.kind == "ordinary" and max(_size(case)) > 1)
    return max((case for case in images if all(len(tensor) == 1 for tensor in tensors_in(case.inputs()))), key=size)


def enlarged(
    case: Case, width: int, height: int, *, dtype: torch.dtype = torch.float32, device: str = "cpu"
) -> tuple[Inputs, dict[str, Any]]:
    """The inputs and settings of a case, repeated to a size; inputs of half the case's size get half of the size.

    A grid of cells, which has five axes, gets as many of them as the size takes.
    """
    whole = _size(case)

    def repeat(tensor: Tensor) -> Tensor:
        if tensor.ndim < 4:
            return tensor.to(device)
        cell = case.settings["cell"] if tensor.ndim == 5 else 1 if tuple(tensor.shape[2:]) == whole else 2
        rows, columns = (parts_of(side, cell) for side in (height, width))
        times = parts_of(rows, tensor.shape[2]), parts_of(columns, tensor.shape[3]), *(1,) * (tensor.ndim - 4)
        return tensor.to(device).repeat(1, 1, *times)[:, :, :rows, :columns].contiguous()

    settings = case.settings | ({"size": (height, width)} if "size" in case.settings else {})
    return map_tensors(repeat, case.inputs(dtype)), settings


def _size(case: Case) -> tuple[int, int]:
    """Height and width of the case's image, or where there are two, of the larger one."""
    if "size" in case.settings:
        height, width = case.settings["size"]
        return height, width
    sizes = [tuple(tensor.shape[-2:]) for tensor in tensors_in(case.inputs()) if tensor.ndim == 4]
    height, width = max(sizes)
    return height, width


def _error(entry: _Entry, device: str) -> float:
    """The largest relative error over the op's ordinary cases."""

    def on_device(**arguments: Any) -> list[Tensor]:
        inputs = map_tensors(
            lambda tensor: tensor.to(device), {name: arguments[name] for name in arguments if name not in settings}
        )
        return [result.cpu() for result in entry.call(inputs, settings)]

    worst = 0.0
    for case in (each for each in entry.op.cases if each.kind == "ordinary"):
        settings = case.settings
        worst = max(worst, relative_error(entry.op, case, entry.dtype, on_device))
    if worst == float("inf"):
        raise ArithmeticError("a result is NaN or infinite where float64 is not")
    return worst
