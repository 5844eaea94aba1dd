"""Tell which machine, which driver and which versions a measurement was made with.

python examples/gpu/about.py -o about.json
"""

import importlib.metadata
import shutil
import subprocess
from dataclasses import asdict

import torch
from part import Part

from mcdenoise.benchmark.machine import describe_machine


def card() -> dict[str, object]:
    """The GPU, as torch and the driver describe it."""
    found = torch.cuda.get_device_properties(0)
    row: dict[str, object] = {
        "card": found.name,
        "GB": round(found.total_memory / 1e9, 1),
        "multiprocessors": found.multi_processor_count,
        "capability": f"{found.major}.{found.minor}",
        "CUDA": torch.version.cuda,
        "cuDNN": torch.backends.cudnn.version(),
        "Triton": importlib.metadata.version("triton"),
    }
    if tool := shutil.which("nvidia-smi"):
        query = [tool, "--query-gpu=driver_version,clocks.max.sm,power.limit", "--format=csv,noheader"]
        row["driver, clock, power"] = subprocess.run(query, capture_output=True, text=True, timeout=20).stdout.strip()
    return row


def main() -> None:
    part = Part.begin(__doc__)
    part.attempt("machine", lambda: asdict(describe_machine(part.device.type)))
    if part.device.type == "cuda":
        part.attempt("card", card)
    tensor = torch.empty(2**28 if not part.quick else 2**20, dtype=torch.uint8, device=part.device)
    other = torch.empty_like(tensor)
    part.attempt("copy", lambda: {"bytes": 2 * tensor.nbytes, **part.milliseconds(lambda: other.copy_(tensor))})


if __name__ == "__main__":
    main()
