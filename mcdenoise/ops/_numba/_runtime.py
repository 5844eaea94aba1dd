"""Shared by all numba backends: the compiler and its cache, threads, and how kernels read and store numbers."""

from __future__ import annotations

import functools
import hashlib
import math
import os
import secrets
import stat
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch
from numba import types
from numba.core.caching import FunctionCache
from numba.extending import overload
from torch import Tensor

# Numba takes settings from a file in the working folder, too, which has no say in the folder of compiled code.
numba.config.CACHE_DIR = os.environ.get("NUMBA_CACHE_DIR", "")  # type: ignore[attr-defined]
# Handing rows to a thread takes as long as filtering some thousand pixels, or this many times as many pixels if there
# are a few operations for each.
PIXELS_A_THREAD, LIGHT = 16384, 4

# A tensor as numba sees it: its memory from the first element on, strides in elements, and number of channels.
Source = tuple[Any, tuple[int, ...], int]


class _Cache(FunctionCache):
    """Numba's cache, which fails for no run: not by a file that is cut off, a full disk, or a folder of somebody else.

    Its files are pickles, and loading one runs what is in it.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)  # type: ignore[no-untyped-call]
        # Of two processes that write at once neither overwrites code that the other one enters in the index.
        own = f"{self._impl.filename_base}.{secrets.token_hex(4)}"
        self._cache_file._data_name_pattern = own + ".{number:d}.nbc"

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        with suppress(Exception):
            if _is_own(self._cache_path):
                return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        with suppress(Exception):
            self._impl.locator.ensure_cache_path()
            if not _is_own(self._cache_path):
                return
            try:
                super().save_overload(sig, data)  # type: ignore[no-untyped-call]
            except Exception:  # the index may be damaged
                self.flush()  # type: ignore[no-untyped-call]
                super().save_overload(sig, data)  # type: ignore[no-untyped-call]


def _is_own(folder: str) -> bool:
    """Whether nobody writes into a folder who could not change this package too."""
    if os.name != "posix":
        return True
    found = os.stat(folder)
    return found.st_uid in (0, os.getuid(), os.stat(__file__).st_uid) and not found.st_mode & stat.S_IWOTH


def compiled(function: Callable[..., Any]) -> Any:
    """``function`` compiled, once for all runs: beside its file or, failing that, in the user's cache folder.

    Numba looks for changes in the function's own file alone, and functions and constants of other files are compiled
    into it. So its name, by which numba finds its stored code, contains a digest of all those files.
    """
    function.__qualname__ = f"{function.__qualname__}_{_digest()}"
    kernel: Any = numba.njit(nogil=True, error_model="numpy", fastmath={"contract"})(function)
    # Where no such folder can be written to, it is compiled anew in every run.
    with suppress(RuntimeError):
        kernel._cache = _Cache(function)
    return kernel


@functools.cache
def _digest() -> str:
    """A digest of all files that may be compiled into a kernel: this folder, and the constants of ops."""
    folder = Path(__file__).parent
    files = [*sorted(folder.glob("*.py")), folder.parent / "_constants.py", folder.parent / "_window.py"]
    return hashlib.sha256(b"\0".join(file.read_bytes() for file in files)).hexdigest()[:16]


def source(tensor: Tensor) -> Source:
    """Any layout is fine: strides go with the memory."""
    strides = tensor.stride()
    extent = 1 + sum((size - 1) * stride for size, stride in zip(tensor.shape, strides, strict=True))
    memory = tensor.detach().as_strided((extent if tensor.numel() else 0,), (1,))
    if memory.dtype == torch.bfloat16:
        memory = memory.view(torch.uint16)
    return memory.numpy(), strides, tensor.shape[1]


def readable(tensor: Tensor, dtype: torch.dtype) -> Tensor:
    """``tensor`` in a dtype that the kernels read: bfloat16 as it is, where sums are float32; else that of the sums."""
    return tensor if tensor.dtype == torch.bfloat16 and dtype == torch.float32 else tensor.to(dtype)


def share_rows(image: Tensor, run: Callable[[int, int, int], None], light: bool = False) -> None:
    """``run(b, first, last)`` for all rows of all images of the batch, on at most as many threads as torch uses.

    Args:
        image: an image of the same batch and size.
        run: computes rows of one image.
        light: whether there are only a few operations for each pixel, and so fewer threads.
    """
    batch, _, height, width = image.shape
    least = PIXELS_A_THREAD * (LIGHT if light else 1)
    threads = max(1, min(torch.get_num_threads(), batch * height, batch * height * width // least))

    def compute(number: int) -> None:
        done, end = batch * height * number // threads, batch * height * (number + 1) // threads
        while done < end:
            b, first = divmod(done, height)
            last = min(height, first + end - done)
            run(b, first, last)
            done += last - first

    if threads == 1:
        compute(0)
        return
    pool = _pool(threads - 1, os.getpid())
    others = [pool.submit(compute, number) for number in range(1, threads)]
    try:
        compute(0)
    finally:
        # No thread may write to a caller's arrays after this returns, even after an error.
        wait(others)
    for other in others:
        other.result()


@functools.lru_cache(maxsize=1)
def _pool(workers: int, process: int) -> ThreadPoolExecutor:
    """Threads that stay: to start one takes longer than many a kernel. A forked process has none of its parent's."""
    return ThreadPoolExecutor(workers, thread_name_prefix="mcdenoise-rows")


def load(value: Any) -> Any:
    """A number of a source, in the dtype of the sums."""


def _unchanged(value: Any) -> Any:
    return value


@overload(load)
def _load_overload(value: Any) -> Any:
    if value != types.uint16:
        return _unchanged

    def from_bfloat16(value: Any) -> Any:
        return np.uint32(np.uint32(value) << np.uint32(16)).view(np.float32)

    return from_bfloat16


def rounded(value: Any, memory: Any) -> Any:
    """A number as ``memory`` stores it."""


@overload(rounded)
def _rounded_overload(value: Any, memory: Any) -> Any:
    def unchanged(value: Any, memory: Any) -> Any:
        return value

    def to_bfloat16(value: Any, memory: Any) -> Any:
        # To the nearest, of two equally near to the even one; a NaN must not carry over into an infinity.
        bits = np.float32(value).view(np.uint32)
        odd = np.uint32(np.uint32(bits >> np.uint32(16)) & np.uint32(1))
        up = np.uint32(np.uint32(bits + np.uint32(0x7FFF)) + odd)
        return np.uint16(np.uint32(up >> np.uint32(16))) if value == value else np.uint16(0x7FC0)

    return to_bfloat16 if memory.dtype == types.uint16 else unchanged


@compiled
def read_row(row: Any, image: Any, b: int, c: int, y: int, x0: int) -> None:
    """A run of pixels of one channel."""
    memory, strides, _ = image
    start, stride = b * strides[0] + c * strides[1] + y * strides[2] + x0 * strides[3], strides[3]
    if stride == 1:
        values = memory[start : start + row.size]
        for x in range(row.size):
            row[x] = load(values[x])
    else:
        for x in range(row.size):
            row[x] = load(memory[start + x * stride])


@compiled
def add(total: Any, values: Any) -> None:
    for x in range(total.size):
        total[x] += values[x]


@compiled
def add_product(total: Any, a: Any, b: Any) -> None:
    for x in range(total.size):
        total[x] += a[x] * b[x]


@compiled
def multiply(values: Any, factors: Any) -> None:
    for x in range(values.size):
        values[x] *= factors[x]


@compiled
def larger(total: Any, values: Any) -> None:
    for x in range(total.size):
        total[x] = max(total[x], values[x])


def exp(value: Any) -> Any:
    """``exp``, which LLVM vectorises for float32 in this form only."""


def _math_exp(value: Any) -> Any:
    return math.exp(value)


@overload(exp)
def _exp_overload(value: Any) -> Any:
    if value != types.float32:
        return _math_exp
    # Cephes' expf: exp(x) = 2^n exp(r) with r = x - n log(2) in two parts and a polynomial for exp(r). Adding and
    # subtracting 1.5 * 2^23 rounds to the nearest whole number. Results below the smallest normal number are 0.
    log2_e, high, low = np.float32(1.44269504), np.float32(0.693359375), np.float32(-2.12194440e-4)
    magic, one, zero = np.float32(12582912.0), np.float32(1), np.float32(0)
    least, most, infinity = np.float32(-87.0), np.float32(88.3), np.float32(np.inf)
    c0, c1, c2 = np.float32(1.9875691500e-4), np.float32(1.3981999507e-3), np.float32(8.3334519073e-3)
    c3, c4, c5 = np.float32(4.1665795894e-2), np.float32(1.6666665459e-1), np.float32(5.0000001201e-1)
    bias, mantissa = np.int32(127), np.int32(23)

    def exp(value: Any) -> Any:
        x = max(min(value, most), least)
        n = (x * log2_e + magic) - magic
        r = (x - n * high) - n * low
        p = ((((c0 * r + c1) * r + c2) * r + c3) * r + c4) * r + c5
        power = np.int32(np.int32(np.int32(n) + bias) << mantissa).view(np.float32)
        result = (p * r * r + r + one) * power
        # A comparison with a NaN is false, and the NaN stays.
        return zero if value < least else infinity if value > most else result + (value - value)

    return exp


def log(value: Any) -> Any:
    """``log`` of a positive number, which LLVM vectorises for float32 in this form only."""


def _math_log(value: Any) -> Any:
    return math.log(value)


@overload(log)
def _log_overload(value: Any) -> Any:
    if value != types.float32:
        return _math_log
    # Cephes' logf: of 2^n (1 + f) with 1 + f from sqrt(1/2) to sqrt(2), n log(2) in two parts and a polynomial.
    c0, c1, c2 = np.float32(7.0376836292e-2), np.float32(-1.1514610310e-1), np.float32(1.1676998740e-1)
    c3, c4, c5 = np.float32(-1.2420140846e-1), np.float32(1.4249322787e-1), np.float32(-1.6668057665e-1)
    c6, c7, c8 = np.float32(2.0000714765e-1), np.float32(-2.4999993993e-1), np.float32(3.3333331174e-1)
    high, low = np.float32(0.693359375), np.float32(-2.12194440e-4)
    one, half, infinity = np.float32(1), np.float32(0.5), np.float32(np.inf)
    bits_of_root, mantissa = np.int32(0x3F3504F3), np.int32(23)

    def log(value: Any) -> Any:
        bits = np.float32(value).view(np.int32)
        n = np.int32(np.int32(bits - bits_of_root) >> mantissa)
        f = np.int32(bits - np.int32(n << mantissa)).view(np.float32) - one
        p = ((((((((c0 * f + c1) * f + c2) * f + c3) * f + c4) * f + c5) * f + c6) * f + c7) * f + c8) * f
        exponent, square = np.float32(n), f * f
        result = f + (p * square + (exponent * low - half * square)) + exponent * high
        # Neither infinity nor a NaN is less.
        return result if value < infinity else value

    return log
