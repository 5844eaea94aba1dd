"""Measure in four minutes what a GPU does with the models, the operators and a training step: one JSON file a part.

    python examples/gpu/run_all.py -o OUT
    python examples/gpu/run_all.py -o OUT --device cpu --quick

Each part is a script of this folder, which also runs by itself. It writes OUT/PART.json after every row, so that a part
that fails, or reaches its time limit, keeps what it had measured. OUT/summary.json says how each part ended. The second
command tries all parts on a processor, with few rows and small images.
"""

import argparse
import subprocess
import sys
import time
from pathlib import Path

from mcdenoise.data.files import write_json
from mcdenoise.errors import run_script

# Seconds of each part once Python and torch have started; rows that have begun then still end.
PARTS = {"about": 15, "models": 100, "peer": 12, "mitsuba_loop": 20, "training": 22, "ops": 70}


def run(name: str, out: Path, options: list[str], seconds: float) -> dict[str, object]:
    """Run one part, and tell how it ended."""
    start = time.monotonic()
    script, log = Path(__file__).with_name(f"{name}.py"), out / f"{name}.log"
    command = [sys.executable, str(script), "-o", str(out / f"{name}.json"), "--seconds", str(seconds), *options]
    with log.open("w") as file:
        try:
            # Parts end by themselves before their limit; this is for those that hang.
            status = subprocess.run(command, stdout=file, stderr=subprocess.STDOUT, timeout=seconds + 20).returncode
        except subprocess.TimeoutExpired:
            status = -1
    last = log.read_text(errors="replace").strip().rpartition("\n")[2]
    ended = {0: "done", -1: "stopped at its time limit"}.get(status, f"failed with status {status}: {last}")
    return {"part": name, "ended": ended, "seconds": round(time.monotonic() - start, 1)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="OUT")
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"))
    parser.add_argument("--quick", action="store_true", help="few rows and small images")
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=PARTS, metavar="PART")
    options = parser.parse_args()

    options.out.mkdir(parents=True, exist_ok=True)
    passed = ["--device", options.device, *(["--quick"] if options.quick else [])]
    ends = []
    for name in options.parts:
        # A slow processor compiles for a minute what takes a GPU's machine some seconds.
        ends.append(run(name, options.out, passed, PARTS[name] * (10 if options.device == "cpu" else 1)))
        write_json(options.out / "summary.json", ends)
        print("{part}: {ended}, {seconds} s".format(**ends[-1]), flush=True)
    sys.exit(any(each["ended"] != "done" for each in ends))


if __name__ == "__main__":
    run_script(main)
