"""Time networks and Open Image Denoise side by side on one frame: what the image filter alone costs.

    python examples/run_time.py
    python examples/run_time.py --models cascaded_v2 cascaded_v2_tiny --size 1920x1080 --rounds 9 --json times.json

Every round runs each of them once, one after the other, so that whatever else the machine does hits all alike; the
first round warms up and is not counted. Prints the median and the quartiles, and the ratio to Open Image Denoise's
fastest network. The input is noise, which costs as much as any picture: the time depends on the number of pixels only.
The time of Open Image Denoise includes copies to its layout and back, 10 to 20 ms at 1280x720 on one core. As in the
commands of the package, freed memory is kept (mcdenoise/heap.py); --no-heap leaves that to the system.
"""

import argparse
import json
import re
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from mcdenoise import models
from mcdenoise.benchmark.machine import describe_machine
from mcdenoise.data.files import write_text
from mcdenoise.errors import InputError
from mcdenoise.heap import keep_heap
from mcdenoise.peers import Oidn, Quality

OIDN: dict[str, tuple[Quality, bool]] = {
    "OIDN fast": ("fast", False),
    "OIDN balanced": ("balanced", False),
    "OIDN high, clean aux": ("high", True),
}


def network(name: str, inputs: list[Tensor], bfloat16: bool) -> Callable[[], object]:
    """A call of a network on these inputs."""
    model = models.create_model(name).to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    @torch.inference_mode()
    def call() -> object:
        with torch.autocast("cpu", torch.bfloat16, enabled=bfloat16):
            return model(*inputs)

    return call


def peer(settings: tuple[Quality, bool], inputs: list[Tensor], threads: int) -> Callable[[], object]:
    """A call of Open Image Denoise on these inputs."""
    oidn = Oidn(threads=threads)
    color, albedo, normal, _ = inputs
    quality, clean_aux = settings
    return lambda: oidn.denoise(color, albedo, normal, quality=quality, clean_aux=clean_aux)


def interleaved(calls: dict[str, Callable[[], object]], rounds: int) -> dict[str, list[float]]:
    """Milliseconds of each call in every round but the first."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds + 1):
        for name, call in calls.items():
            start = time.perf_counter()
            call()
            times[name].append((time.perf_counter() - start) * 1e3)
    return {name: values[1:] for name, values in times.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--models", nargs="+", default=models.pretrained_models(), metavar="MODEL")
    parser.add_argument("--size", default="1280x720", metavar="WxH")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--no-heap", action="store_true", help="give freed memory back to the system at once")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every time to this file too")
    options = parser.parse_args()

    for name, lowest in (("threads", 1), ("rounds", 2)):
        if getattr(options, name) < lowest:
            raise InputError(f"--{name}: expected at least {lowest}, found {getattr(options, name)}")
    match = re.fullmatch(r"([1-9][0-9]{0,4})x([1-9][0-9]{0,4})", options.size)
    if not match:
        raise InputError(f"--size: expected WIDTHxHEIGHT such as 1280x720, found '{options.size}'")
    torch.set_num_threads(options.threads)
    if not options.no_heap:
        keep_heap()
    width, height = int(match[1]), int(match[2])
    torch.manual_seed(0)
    normal = torch.nn.functional.normalize(torch.randn(1, 3, height, width))
    inputs = [torch.rand(1, 3, height, width), torch.rand(1, 3, height, width), normal, torch.rand(1, 1, height, width)]
    calls = {name: peer(settings, inputs, options.threads) for name, settings in OIDN.items()}
    for name in options.models:
        calls[name] = network(name, inputs, bfloat16=False)
        calls[f"{name}, bfloat16"] = network(name, inputs, bfloat16=True)

    times = interleaved(calls, options.rounds)
    unit = statistics.median(times["OIDN fast"])
    print(f"{options.size}, {options.threads} threads, {options.rounds} rounds, torch {torch.__version__}")
    print(f"{'milliseconds':<28}{'median':>8}{'quartiles':>16}{'/ OIDN fast':>13}")
    for name, values in times.items():
        low, median, high = statistics.quantiles(values, n=4)
        print(f"{name:<28}{median:>8.0f}{f'{low:.0f} .. {high:.0f}':>16}{median / unit:>13.2f}")
    if options.json:
        machine = describe_machine("cpu")
        write_text(options.json, json.dumps({"machine": vars(machine), "milliseconds": times}, indent=2) + "\n")


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
