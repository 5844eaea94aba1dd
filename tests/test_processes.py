"""Denoisers in several threads and processes, and what they leave behind in them."""

import multiprocessing
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import torch
from planes import random_shot
from reads import without_reads
from torch import Tensor

from mcdenoise import Denoiser, Frame, InputError, ops

# Of each kind: an a-trous filter, a network, and a local filter.
METHODS = ["svgf", "wild_small", "bmfr"]


def denoised(method: str, frames: list[Frame]) -> list[tuple[Tensor, Any]]:
    denoiser = Denoiser(method, precision="float32")
    found = []
    for frame in frames:
        image = denoiser(frame)
        report = denoiser.report
        found.append((image, (report.stages, report.history, report.reset, report.tiles, sorted(report.milliseconds))))
    return found


def together(*actions: Callable[[], Any]) -> list[Any]:
    """Results of functions that begin at the same time, each in a thread of its own."""
    barrier = threading.Barrier(len(actions))

    def start(action: Callable[[], Any]) -> Any:
        barrier.wait(60)
        return action()

    with ThreadPoolExecutor(len(actions)) as pool:
        return [each.result() for each in [pool.submit(start, action) for action in actions]]


@pytest.mark.parametrize("pair", [(0, 0), (0, 1), (1, 2)], ids=lambda pair: "-".join(METHODS[i] for i in pair))
def test_denoisers_in_two_threads_are_those_alone(pair: tuple[int, int]) -> None:
    # Of different sizes, for which different backends are the fastest.
    tasks = [(METHODS[pair[0]], random_shot(1)), (METHODS[pair[1]], random_shot(2, 40, 48, frames=9))]
    alone = [denoised(*task) for task in tasks]
    for found, expected in zip(together(*(lambda task=task: denoised(*task) for task in tasks)), alone, strict=True):
        for (image, report), (same, own) in zip(found, expected, strict=True):
            torch.testing.assert_close(image, same, rtol=1e-5, atol=1e-6)
            assert report == own


def test_errors_that_are_told_late_are_those_of_the_own_frames() -> None:
    """As on a GPU, where values are read after the frame."""
    good = random_shot(1)[0]
    broken = good.replace(depth=torch.full_like(good.color[:, :1], torch.nan))

    def refused(frame: Frame) -> int:
        denoiser, count = Denoiser("svgf", precision="float32"), 0
        with ops.use("torch"):
            for _ in range(8):
                try:
                    denoiser(frame)
                    _ = denoiser.report
                except InputError:
                    count += 1
        return count

    with without_reads():
        assert together(lambda: refused(good), lambda: refused(broken)) == [0, 8]


def test_one_denoiser_takes_the_frames_of_several_threads_in_turn() -> None:
    denoiser, frame = Denoiser("svgf", precision="float32"), random_shot(1)[0]
    alone = [denoiser(frame) for _ in range(6)]
    denoiser.reset()
    found = [image for images in together(*[lambda: [denoiser(frame) for _ in range(3)]] * 2) for image in images]
    # Which thread is the first is not known; every step of the shot is there, and each of them once.
    for image in alone:
        assert sum(torch.allclose(image, each, rtol=1e-5, atol=1e-6) for each in found) >= 1


IN_CHILDREN = """
import multiprocessing, sys, torch
sys.path.insert(0, {folder!r})
from planes import random_shot
from test_processes import denoised

def child(method, connection):
    connection.send([(image.numpy(), report) for image, report in denoised(method, random_shot(1))])

if __name__ == "__main__":
    torch.set_num_threads(2)
    for method in ("wild_small",):
        expected = denoised(method, random_shot(1))
        here, there = multiprocessing.Pipe()
        process = multiprocessing.get_context(sys.argv[1]).Process(target=child, args=(method, there))
        process.start()
        assert here.poll(240), "the child hangs"
        for (image, report), (same, own) in zip(here.recv(), expected, strict=True):
            assert torch.allclose(torch.from_numpy(image), same, rtol=1e-5, atol=1e-6)
            assert report == own
        process.join(60)
        assert process.exitcode == 0
"""


@pytest.mark.parametrize(
    "method", [each for each in ("fork", "spawn") if each in multiprocessing.get_all_start_methods()]
)
def test_a_process_started_after_use_denoises_alike(method: str, tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(IN_CHILDREN.format(folder=str(Path(__file__).parent)))
    # More than one thread, which a fork does not take along.
    environment = {**os.environ, "OMP_NUM_THREADS": "2"}
    done = subprocess.run(
        [sys.executable, script, method], env=environment, capture_output=True, text=True, timeout=900, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


STATE = """
import gc, locale, os, random, signal, sys, threading, warnings
import numpy as np, torch

def state():
    handlers = {number: signal.getsignal(number) for number in signal.valid_signals()}
    return {
        "threads": (torch.get_num_threads(), torch.get_num_interop_threads()),
        "dtype": torch.get_default_dtype(), "device": torch.get_default_device(),
        "grad": (torch.is_grad_enabled(), torch.is_inference_mode_enabled(), torch.is_autocast_enabled("cpu")),
        "deterministic": torch.get_deterministic_debug_mode(),
        "mkldnn": torch.backends.mkldnn.flags, "mkldnn on": torch.backends.mkldnn.enabled,
        "precision": torch.get_float32_matmul_precision(), "denormals": sys.float_info.min / 2 > 0,
        "drawn": (torch.get_rng_state().tolist(), random.getstate(), str(np.random.get_state())),
        "numpy": (np.geterr(), np.get_printoptions()), "warnings": list(warnings.filters),
        "showwarning": warnings.showwarning, "locale": locale.setlocale(locale.LC_ALL), "signals": handlers,
        "gc": (gc.isenabled(), gc.get_threshold(), gc.get_freeze_count()), "environment": dict(os.environ),
        "folder": os.getcwd(), "path": list(sys.path), "hooks": (sys.excepthook, threading.excepthook, sys.displayhook),
        "limits": (sys.getrecursionlimit(), sys.getswitchinterval()), "umask": os.umask(os.umask(0o22) or 0o22),
        "sharing": torch.multiprocessing.get_sharing_strategy(), "print": repr(torch._tensor_str.PRINT_OPTS),
    }

def changed(before, what):
    after = state()
    for name, value in before.items():
        assert after[name] == value, (what, name, value, after[name])

torch.set_num_threads(2)
before = state()
import mcdenoise
for name in mcdenoise.__all__:
    getattr(mcdenoise, name)
changed(before, "import")
g = torch.Generator().manual_seed(0)
images = [torch.rand(1, count, 80, 112, generator=g) for count in (3, 3, 3, 1)]
rest = torch.zeros(1, 2, 80, 112)
frame = mcdenoise.Frame(images[0], albedo=images[1], normal=images[2], depth=images[3], motion=rest)
for model, precision in (("wild_small", "auto"), ("wild_small", "bfloat16")):
    for differentiable in (False, precision == "auto"):
        denoiser = mcdenoise.Denoiser(model, precision=precision, differentiable=differentiable)
        for number in range(2):
            denoiser(frame.replace(color=images[0].roll(number, -1)))
            str(denoiser.report)
        try:
            denoiser(frame.replace(depth=images[3] * torch.nan))
        except mcdenoise.InputError:
            pass
        del denoiser
        changed(before, model)
mcdenoise.denoise(images[0][0].permute(1, 2, 0).numpy())
changed(before, "denoise")
"""


def test_nothing_of_the_process_is_left_changed(tmp_path: Path) -> None:
    environment = {name: value for name, value in os.environ.items() if name != "MCDENOISE_PRECISION"}
    # A new cache, so that the speed of both precisions is measured.
    environment |= {"XDG_CACHE_HOME": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", STATE], env=environment, capture_output=True, text=True, timeout=900, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
