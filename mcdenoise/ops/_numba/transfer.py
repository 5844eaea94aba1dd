"""Open Image Denoise's transfer function on a CPU: one pass, where torch takes a dozen."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from mcdenoise.ops._constants import MAX_RADIANCE, PU_BRIGHT, PU_DARK, PU_JOINTS, PU_MIDDLE, PU_WHITE
from mcdenoise.ops._numba._runtime import compiled, exp, log, read_row, share_rows, source

_B, _C, _D = PU_MIDDLE
_E, _F, _G = PU_BRIGHT
_Y0, _Y1, _X0, _X1 = PU_JOINTS


def compress(radiance: Tensor) -> Any:
    """See :func:`mcdenoise.ops._steps.transfer.compress`."""
    return _mapped(radiance, expanding=False)


def expand(compressed: Tensor) -> Any:
    """See :func:`mcdenoise.ops._steps.transfer.expand`."""
    return _mapped(compressed, expanding=True)


def _mapped(image: Tensor, *, expanding: bool) -> Any:
    if image.ndim != 4 or image.dtype not in (torch.float32, torch.float64):
        return NotImplemented
    result = torch.empty(image.shape, dtype=image.dtype, device="cpu")
    if result.numel():
        arguments = (result.numpy(), source(image), expanding)
        share_rows(image, lambda *rows: _map_rows(*arguments, *rows), light=True)
    return result


@compiled
def _map_rows(out: Any, image: Any, expanding: bool, b: int, first: int, last: int) -> None:
    for y in range(first, last):
        for c in range(out.shape[1]):
            row = out[b, c, y]
            read_row(row, image, b, c, y, 0)
            if expanding:
                expand_values(row)
            else:
                compress_values(row)


@compiled
def compress_values(row: Any) -> None:
    number = row.dtype.type
    zero, most = number(0), number(MAX_RADIANCE)
    for x in range(row.size):
        # Where a comparison with a NaN is false, `min` and `max` return their first argument, the NaN.
        light = min(max(row[x], zero), most)
        # One logarithm for both.
        logarithm = log(max(light, number(_Y0)) if light <= number(_Y1) else light + number(_F))
        power = number(_B) * exp(number(_C) * logarithm) + number(_D)
        bright = number(_E) * logarithm + number(_G)
        found = number(PU_DARK) * light if light <= number(_Y0) else power if light <= number(_Y1) else bright
        row[x] = found / number(PU_WHITE)


@compiled
def expand_values(row: Any) -> None:
    number = row.dtype.type
    zero, inverse = number(0), number(1 / _C)
    for x in range(row.size):
        scaled = max(row[x], zero) * number(PU_WHITE)
        power = exp(inverse * log((max(scaled, number(_X0)) - number(_D)) / number(_B)))
        bright = exp((max(scaled, number(_X1)) - number(_G)) / number(_E)) - number(_F)
        lit = power if scaled <= number(_X1) else bright
        row[x] = scaled / number(PU_DARK) if scaled <= number(_X0) else lit
