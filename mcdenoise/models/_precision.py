"""The precision of a network's convolutions: the requested one, or the fastest on this machine."""

from __future__ import annotations

import os
import platform
import statistics
import threading
from typing import Any, Literal, NamedTuple, get_args

import torch
import torch.nn.functional as F

from mcdenoise.errors import check_choice
from mcdenoise.models._interface import Model
from mcdenoise.models._times import Stopwatch
from mcdenoise.models._wrapper import Wrapper, parts_of
from mcdenoise.nn._cpu import has_fused_convolution
from mcdenoise.nn.oidn import OidnUNet
from mcdenoise.user_cache import measured_once

Precision = Literal["float32", "bfloat16"]
PRECISIONS: tuple[Precision, ...] = get_args(Precision)
# A fixed precision for callers that need the same result on every machine, unlike "auto".
ENVIRONMENT = "MCDENOISE_PRECISION"
# Minimum speed-up of bfloat16; a smaller one is not worth the rounding.
_WORTH = 1.2
_CHANNELS, _SIDE, _ROUNDS = 32, 160, 7
# On a GPU, a small image takes as long to start as to compute.
_SIDE_ON_GPU = 1536
# The number of threads belongs to the process.
_measuring = threading.Lock()


class Chosen(NamedTuple):
    """A precision and the reason for choosing it."""

    precision: Precision
    reason: str


def fastest_precision(device: torch.device) -> Chosen:
    """Choose bfloat16 if the processor supports it and it is sufficiently faster, else float32.

    A convolution is timed in both, once per machine: the ratio is stored in the user's cache folder, by processor and
    version of torch. The environment variable MCDENOISE_PRECISION overrides the choice.

    Raises:
        InputError: the environment variable does not name a precision.
    """
    own: Any = os.environ.get(ENVIRONMENT)
    if own:
        check_choice(ENVIRONMENT, own, Precision)
        return Chosen(own, f"the environment variable {ENVIRONMENT} says so")
    if not _has_bfloat16(device):
        return Chosen("float32", "the processor has no bfloat16")
    ratio = measured_once("precision.json", _machine(device), lambda: _measured(device))
    precision: Precision = "bfloat16" if ratio >= _WORTH else "float32"
    return Chosen(precision, f"a convolution in bfloat16 takes {1 / ratio:.2f} of the time in float32 here")


def has_network(model: Model) -> bool:
    """Whether a model has convolutions of its own: those that it is trained with, or those of Open Image Denoise.

    A wrapper that loads them with the first frame has an attribute ``has_network``.
    """
    loads = any(getattr(part, "has_network", False) for part in parts_of(model, Wrapper))
    return model.needs.trainable or loads or any(True for _ in parts_of(model, OidnUNet))


def computing_in(precision: Precision, device: torch.device) -> torch.autocast:
    """Run convolutions in this precision."""
    return torch.autocast(device.type, torch.bfloat16, enabled=precision == "bfloat16")


def _has_bfloat16(device: torch.device) -> bool:
    if device.type == "cuda":
        return torch.cuda.get_device_capability(device) >= (8, 0)
    return has_fused_convolution(torch.bfloat16)


def _measured(device: torch.device) -> float:
    """Speed-up of a convolution in bfloat16."""
    # A layer object would draw its weights from the caller's random generator.
    weight = torch.full((_CHANNELS, _CHANNELS, 3, 3), 0.01, device=device)
    side = _SIDE if device.type == "cpu" else _SIDE_ON_GPU
    image = torch.full((1, _CHANNELS, side, side), 0.01, device=device)
    image = image.contiguous(memory_format=torch.channels_last)
    # Inside a network a GPU reads what the layer before wrote, in the same precision.
    rounded = image if device.type == "cpu" else image.bfloat16()
    times: dict[Precision, list[float]] = {precision: [] for precision in PRECISIONS}
    watch = Stopwatch(device)
    with _measuring, torch.inference_mode():
        # On a busy machine, several threads would mostly wait for one another.
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            for precision in PRECISIONS * _ROUNDS:
                with computing_in(precision, device):
                    start = watch.mark()
                    F.conv2d(rounded if precision == "bfloat16" else image, weight, padding=1)
                    times[precision].append(watch.between(start, watch.mark()))
        finally:
            torch.set_num_threads(threads)
    # The first rounds compile kernels.
    exact, fast = (statistics.median(own[2:]) for own in times.values())
    return exact / fast


def _machine(device: torch.device) -> str:
    """Identifies the machine, and how the ratio is measured: everything that it depends on."""
    if device.type == "cuda":
        name = torch.cuda.get_device_name(device)
    else:
        known: dict[str, object] = getattr(torch.cpu, "get_capabilities", dict)()
        units = [unit for unit in ("amx_bf16", "avx512_bf16", "bf16") if known.get(unit)]
        # oneDNN, which computes the convolutions, can be told to use fewer of the processor's instructions.
        told = [os.environ[limit] for limit in ("ONEDNN_MAX_CPU_ISA", "DNNL_MAX_CPU_ISA") if limit in os.environ]
        name = " ".join([platform.machine(), str(known.get("cpu_name", "")), *units, *told])
    return f"{name}, torch {torch.__version__}, one thread"
