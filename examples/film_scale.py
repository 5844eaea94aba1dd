"""Measure the cost of distributing a film: processor time of the driver process, by the number of Ray nodes.

    python examples/film_scale.py
    python examples/film_scale.py --nodes 2,4,8 --shots 16 --frames 25 --json scale.json

The script writes small shots, starts a Ray cluster on this machine with nodes of one slot each, processes the shots as
a film with the method `noisy`, which returns its input, and prints frames per second and the processor time of the
driver, per frame and per task. All nodes share this machine, so the driver's time is representative of a real cluster,
but frames per second are not. The script needs `mcdenoise[ray]`.
"""

import argparse
import tempfile
import time
from pathlib import Path

import torch

from mcdenoise.data.files import write_json
from mcdenoise.data.readers.bmfr import write_bmfr_frame
from mcdenoise.engines import RayEngine
from mcdenoise.film import read_film, run_film
from mcdenoise.frame import Frame
from mcdenoise.shot import ShotSettings


def measure(nodes: int, shots: Path, out: Path) -> dict[str, float]:
    """Process the film on this number of nodes."""
    try:
        from ray.cluster_utils import Cluster
    except ImportError as error:
        raise SystemExit("film_scale.py: expected Ray, found none; pip install 'mcdenoise[ray]'") from error

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0})
    for _ in range(nodes):
        cluster.add_node(num_cpus=1)
    try:
        engine = RayEngine(cluster.address)
        processor, began = time.process_time(), time.perf_counter()
        results = run_film(read_film(shots / "*", ShotSettings("noisy", threads=1)), out, engine)
        processor, taken = time.process_time() - processor, time.perf_counter() - began
    finally:
        cluster.shutdown()
    made, tasks = sum(each.made for each in results), 3 * len(results)
    return {
        "nodes": nodes,
        "frames": made,
        "frames_per_second": made / taken,
        "driver_ms_per_frame": processor * 1e3 / made,
        "driver_ms_per_task": processor * 1e3 / tasks,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--nodes", default="2,4,8", metavar="N,...")
    parser.add_argument("--shots", type=int, default=16)
    parser.add_argument("--frames", type=int, default=25)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write every figure to this file too")
    options = parser.parse_args()
    rows = []
    print(f"{'nodes':>5}{'frames':>8}{'frames/s':>10}{'driver, ms a frame':>20}{'ms a task':>11}")
    with tempfile.TemporaryDirectory() as folder:
        for shot in range(options.shots):
            for number in range(options.frames):
                write_bmfr_frame(Path(folder, "shots", f"s{shot:03d}"), number, Frame(torch.rand(1, 3, 16, 16)))
        for nodes in map(int, options.nodes.split(",")):
            row = measure(nodes, Path(folder, "shots"), Path(folder, f"out{nodes}"))
            rows.append(row)
            print(
                f"{row['nodes']:>5}{row['frames']:>8}{row['frames_per_second']:>10.2f}"
                f"{row['driver_ms_per_frame']:>20.2f}{row['driver_ms_per_task']:>11.2f}",
                flush=True,
            )
    if options.json is not None:
        write_json(options.json, rows)


if __name__ == "__main__":
    main()
