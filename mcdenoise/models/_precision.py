"""The precision of a network's convolutions: the requested one, or the fastest on this machine."""

from __future__ import annotations

import json
import math
import os
import platform
import statistics
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F

from mcdenoise.errors import InputError
from mcdenoise.models._interface import Model
from mcdenoise.models._stopwatch import Stopwatch
from mcdenoise.models._wrapper import Wrapper, parts_of
from mcdenoise.nn import UNet
from mcdenoise.nn.int8 import has_int8, integers
from mcdenoise.nn.oidn import OidnUNet
from mcdenoise.reading import read_text
from mcdenoise.user_cache import cache_file, keep

FloatPrecision = Literal["float32", "bfloat16"]
Precision = Literal["float32", "bfloat16", "int8"]
# Every model runs in these.
FLOATS: tuple[FloatPrecision, ...] = ("float32", "bfloat16")
PRECISIONS: tuple[Precision, ...] = (*FLOATS, "int8")
# A fixed precision for callers that need the same result on every machine, unlike "auto".
ENVIRONMENT = "MCDENOISE_PRECISION"
# Minimum speed-up of bfloat16; a smaller one is not worth the rounding.
_WORTH = 1.2
_CHANNELS, _SIDE, _ROUNDS = 32, 160, 7
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
    if own := os.environ.get(ENVIRONMENT):
        for known in FLOATS:
            if own == known:
                return Chosen(known, f"the environment variable {ENVIRONMENT} says so")
        raise InputError(f"{ENVIRONMENT}: expected one of {', '.join(FLOATS)}, found '{own}'")
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


def has_network(model: Model) -> bool:
    """Whether a model has convolutions of its own: those that it is trained with, or those of Open Image Denoise.

    A wrapper that loads them with the first frame has an attribute ``has_network``.
    """
    loads = any(getattr(part, "has_network", False) for part in parts_of(model, Wrapper))
    return model.needs.trainable or loads or any(True for _ in parts_of(model, OidnUNet))


def precisions_of(model: Model) -> tuple[Precision, ...]:
    """The precisions in which a model can run on this machine's CPU."""
    return PRECISIONS if has_int8() and _is_calibrated(model) else FLOATS


def quantize(model: Model, device: torch.device) -> None:
    """Prepare the U-Nets of a model for computing in integers, see :mod:`mcdenoise.nn.int8`.

    Raises:
        InputError: the U-Nets are not calibrated, or the processor does not support it.
    """
    if device.type != "cpu" or not has_int8():
        raise InputError(
            "precision: expected a processor with dot products of 8-bit integers (VNNI) for int8, found none; "
            "take bfloat16 or float32"
        )
    unets = list(parts_of(model, UNet))
    if not _is_calibrated(model):
        found = "one that is not" if unets else "one without a U-Net that could be"
        raise InputError(
            f"precision: expected a model that is calibrated for int8, found {found}; "
            "see `mcdenoise calibrate --help`, or take bfloat16 or float32"
        )
    for unet in unets:
        try:
            unet.quantize()
        except ValueError as error:
            raise InputError(f"precision: int8: {error}; calibrate the weights again") from error


@contextmanager
def calibrating(model: Model) -> Iterator[None]:
    """Record the value ranges of the model's U-Nets while they run inside this block.

    Raises:
        InputError: the model has no U-Net.
    """
    unets = list(parts_of(model, UNet))
    if not unets:
        raise InputError("model: expected one with a U-Net of `mcdenoise.nn`, found none; no other is computed in int8")
    handles = [unet.register_forward_pre_hook(lambda own, given: own.calibrate(*given)) for unet in unets]
    try:
        yield
    finally:
        for handle in handles:
            handle.remove()


@contextmanager
def computing_in(precision: Precision, device: torch.device) -> Iterator[None]:
    """Run convolutions in this precision; for int8, run the remaining ones in bfloat16 if the processor supports it."""
    rounded = precision == "bfloat16" or (precision == "int8" and _has_bfloat16(device))
    with torch.autocast(device.type, torch.bfloat16, enabled=rounded), integers(precision == "int8"):
        yield


def _is_calibrated(model: Model) -> bool:
    ranges = [unet.ranges for unet in parts_of(model, UNet)]
    return bool(ranges) and all(each is not None for each in ranges)


def _has_bfloat16(device: torch.device) -> bool:
    if device.type == "cuda":
        return torch.cuda.get_device_capability(device) >= (8, 0)
    try:
        return bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())
    except AttributeError:
        # torch was built without oneDNN.
        return False


def _measured(device: torch.device) -> float:
    """Speed-up of a convolution in bfloat16."""
    # A layer object would draw its weights from the caller's random generator.
    weight = torch.full((_CHANNELS, _CHANNELS, 3, 3), 0.01, device=device)
    image = torch.full((1, _CHANNELS, _SIDE, _SIDE), 0.01, device=device)
    image = image.contiguous(memory_format=torch.channels_last)
    times: dict[FloatPrecision, list[float]] = {precision: [] for precision in FLOATS}
    watch = Stopwatch(device)
    with _measuring, torch.inference_mode():
        # On a busy machine, several threads would mostly wait for one another.
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            for precision in FLOATS * _ROUNDS:
                with torch.autocast(device.type, torch.bfloat16, enabled=precision == "bfloat16"):
                    start = watch.mark()
                    F.conv2d(image, weight, padding=1)
                    times[precision].append(watch.between(start, watch.mark()))
        finally:
            torch.set_num_threads(threads)
    # The first rounds compile kernels.
    exact, rounded = (statistics.median(own[2:]) for own in times.values())
    return exact / rounded


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


def _read(cache: Path) -> dict[str, float]:
    try:
        return {key: float(value) for key, value in json.loads(read_text(cache)).items()}
    except (OSError, ValueError, TypeError, AttributeError, RecursionError):
        return {}
