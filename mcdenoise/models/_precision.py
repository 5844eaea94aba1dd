"""In which precision the convolutions of a network run: what was asked for, or what is fastest on this machine."""

from __future__ import annotations

import json
import math
import os
import platform
import statistics
from pathlib import Path
from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F

from mcdenoise.errors import InputError
from mcdenoise.models._stopwatch import Stopwatch
from mcdenoise.reading import read_text
from mcdenoise.user_cache import cache_file, keep

Precision = Literal["float32", "bfloat16"]
PRECISIONS: tuple[Precision, ...] = ("float32", "bfloat16")
# What "auto" means, for whoever wants the same on every machine.
ENVIRONMENT = "MCDENOISE_PRECISION"
# So many times as fast bfloat16 must be: below that, what it rounds buys nothing.
_WORTH = 1.2
_CHANNELS, _SIDE, _ROUNDS = 32, 160, 7


class Chosen(NamedTuple):
    """A precision, and why this one."""

    precision: Precision
    reason: str


def fastest_precision(device: torch.device) -> Chosen:
    """bfloat16 where the processor computes with it and that pays, else float32.

    A convolution is measured in both, once on each machine: the ratio is kept in the user's cache folder, by processor
    and version of torch. The environment variable MCDENOISE_PRECISION takes the choice away.

    Raises:
        InputError: the environment variable is no precision.
    """
    if own := os.environ.get(ENVIRONMENT):
        for known in PRECISIONS:
            if own == known:
                return Chosen(known, f"the environment variable {ENVIRONMENT} says so")
        raise InputError(f"{ENVIRONMENT}: expected one of {', '.join(PRECISIONS)}, found '{own}'")
    if not _has_bfloat16(device):
        return Chosen("float32", "the processor has no bfloat16")
    cache, key = cache_file("precision.json"), _machine(device)
    ratios = _read(cache)
    ratio = ratios.get(key, 0.0)
    if not (math.isfinite(ratio) and ratio > 0):
        ratio = _measured(device)
        keep(cache, json.dumps({**ratios, key: ratio}, indent=1) + "\n")
    precision: Precision = "bfloat16" if ratio >= _WORTH else "float32"
    return Chosen(precision, f"a convolution in bfloat16 takes {1 / ratio:.2f} of the time in float32 here")


def _has_bfloat16(device: torch.device) -> bool:
    if device.type == "cuda":
        return torch.cuda.get_device_capability(device) >= (8, 0)
    try:
        return bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())
    except AttributeError:
        # Built without oneDNN.
        return False


def _measured(device: torch.device) -> float:
    """How many times as fast a convolution is in bfloat16."""
    # Not a layer, whose weights would be drawn from the caller's random numbers.
    weight = torch.full((_CHANNELS, _CHANNELS, 3, 3), 0.01, device=device)
    image = torch.full((1, _CHANNELS, _SIDE, _SIDE), 0.01, device=device)
    image = image.contiguous(memory_format=torch.channels_last)
    times: dict[Precision, list[float]] = {precision: [] for precision in PRECISIONS}
    watch = Stopwatch(device)
    with torch.inference_mode():
        for _ in range(_ROUNDS):
            for precision, own in times.items():
                with torch.autocast(device.type, torch.bfloat16, enabled=precision == "bfloat16"):
                    start = watch.mark()
                    F.conv2d(image, weight, padding=1)
                    own.append(watch.between(start, watch.mark()))
    # The first rounds make kernels.
    exact, rounded = (statistics.median(own[2:]) for own in times.values())
    return exact / rounded


def _machine(device: torch.device) -> str:
    """What the ratio depends on."""
    if device.type == "cuda":
        name = torch.cuda.get_device_name(device)
    else:
        known: dict[str, object] = getattr(torch.cpu, "get_capabilities", dict)()
        units = [unit for unit in ("amx_bf16", "avx512_bf16", "bf16") if known.get(unit)]
        name = " ".join([platform.machine(), str(known.get("cpu_name", "")), *units])
    return f"{name}, torch {torch.__version__}"


def _read(cache: Path) -> dict[str, float]:
    try:
        return {key: float(value) for key, value in json.loads(read_text(cache)).items()}
    except (OSError, ValueError, TypeError, AttributeError, RecursionError):
        return {}
