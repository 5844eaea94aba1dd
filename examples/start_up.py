"""Measure whole processes that denoise one frame from EXR to EXR, with this package and with Open Image Denoise.

    python examples/start_up.py
    python examples/start_up.py --size 640x360 --rounds 9 --model wild --precisions auto,float32

Every round starts each process once, one after the other, so that other work of the machine affects all of them
equally; the first round, in which files are read from the disk and kernels are compiled, does not count. The script
prints the median and the quartiles in seconds, and the difference from the first process. The peer is a short script
that reads color, albedo and normal with OpenImageIO, runs `pyoidn`, and writes the result. `pyoidn` imports torch if it
is installed, as it is with this package; in the second row it cannot, and the last row is the import of torch alone.
"""

import argparse
import statistics
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path

from run_time import check_least, size_of, write_figures

from mcdenoise.benchmark.machine import fix_threads
from mcdenoise.benchmark.sizes import synthetic_frame
from mcdenoise.data.readers.bmfr import write_bmfr_frame
from mcdenoise.errors import InputError, run_script
from mcdenoise.turns import interleaved

PEER = """
import sys

folder, out, quality, threads, torch = sys.argv[1:]
if torch == "without torch":
    sys.modules["torch"] = None

import numpy as np
import OpenImageIO as oiio
import pyoidn

images = {}
for name, stem in (("color", "color"), ("albedo", "albedo"), ("normal", "shading_normal")):
    image = oiio.ImageInput.open(f"{folder}/{stem}0.exr")
    images[name] = np.ascontiguousarray(image.read_image(0, 0, 0, 3, oiio.FLOAT))
    image.close()
images["output"] = np.zeros_like(images["color"])
device = pyoidn.Device()
device.set_int("numThreads", int(threads))
device.commit()
run = pyoidn.Filter(device, pyoidn.OIDN_FILTER_TYPE_RT)
for name, image in images.items():
    run.set_image(name, image, pyoidn.OIDN_FORMAT_FLOAT3)
run.set_bool("hdr", True)
run.set_quality(getattr(pyoidn, f"OIDN_QUALITY_{quality.upper()}"))
run.commit()
run.execute()
assert not device.get_error()
height, width, _ = images["output"].shape
spec = oiio.ImageSpec(width, height, 3, "half")
spec.attribute("compression", "zip")
file = oiio.ImageOutput.create("openexr")
assert file.open(out, spec) and file.write_image(images["output"]) and file.close()
run.release()
device.release()
"""


def run(command: list[str]) -> None:
    """Run a process, which must succeed."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise InputError(f"{' '.join(command[:4])}: expected to succeed, found: {done.stderr.strip()[-300:]}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--model", default="wild_small")
    parser.add_argument("--precisions", default="auto,float32", help="precisions of mcdenoise, separated by commas")
    parser.add_argument(
        "--quality", default="balanced", choices=["fast", "balanced", "high"], help="quality of the peer"
    )
    parser.add_argument("--size", default="1280x720", metavar="WxH")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every time to this file too")
    options = parser.parse_args()

    check_least(options, threads=1, rounds=2)
    fix_threads(options.threads)
    width, height = size_of(options.size)
    with tempfile.TemporaryDirectory(prefix="start-up-") as place:
        folder = Path(place)
        write_bmfr_frame(folder / "frame", 0, synthetic_frame(width, height))
        threads = str(options.threads)
        peer = [str(folder / "frame"), str(folder / "oidn.exr"), options.quality, threads]
        own = ["denoise", str(folder / "frame"), "-o", str(folder / "out"), "--model", options.model]
        commands = {
            f"pyoidn, {options.quality}": [sys.executable, "-P", "-c", PEER, *peer, "as it is"],
            f"pyoidn, {options.quality}, without torch": [sys.executable, "-P", "-c", PEER, *peer, "without torch"],
            **{
                f"mcdenoise denoise, {options.model}, {precision}": [
                    *(sys.executable, "-P", "-m", "mcdenoise", *own),
                    *("--precision", precision, "--threads", threads),
                ]
                for precision in options.precisions.split(",")
            },
            "import torch": [sys.executable, "-P", "-c", "import torch"],
        }
        milliseconds = interleaved({name: partial(run, command) for name, command in commands.items()}, options.rounds)

    times = {name: [each / 1e3 for each in later] for name, (_, *later) in milliseconds.items()}
    first = statistics.median(next(iter(times.values())))
    print(f"{options.size}, one frame, whole process, {threads} threads, {options.rounds} rounds")
    print(f"{'seconds':<46}{'median':>8}{'quartiles':>16}{'behind':>9}")
    for name, values in times.items():
        low, median, high = statistics.quantiles(values, n=4)
        print(f"{name:<46}{median:>8.2f}{f'{low:.2f} .. {high:.2f}':>16}{median - first:>+9.2f}")
    write_figures(options.json, seconds=times)


if __name__ == "__main__":
    run_script(main)
