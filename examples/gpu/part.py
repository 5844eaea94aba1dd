"""What the scripts of this folder share: their options, their rows, a shot to denoise, and times."""

import argparse
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise import Frame
from mcdenoise.benchmark.machine import check_device
from mcdenoise.data.files import write_json
from mcdenoise.models._times import Stopwatch

# Width and height of whole frames.
SIZES = ((1280, 720), (1920, 1080))
_WARM_UP = 3


@dataclass
class Part:
    """One part of the measurement.

    Args:
        out: file of the rows.
        device: that is measured.
        quick: whether few rows and small images suffice.
        end: time of :func:`time.monotonic` after which no row is begun.
    """

    out: Path
    device: torch.device
    quick: bool
    end: float
    rows: list[dict[str, object]] = field(default_factory=list)

    @classmethod
    def begin(cls, description: str) -> "Part":
        """The part that the command line asks for."""
        parser = argparse.ArgumentParser(description=description.split("\n\n")[0])
        parser.add_argument("-o", "--out", type=Path, required=True, metavar="FILE.json")
        parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"))
        parser.add_argument("--quick", action="store_true", help="few rows and small images")
        parser.add_argument("--seconds", type=float, default=600.0, help="no row is begun after this time")
        options = parser.parse_args()
        check_device(options.device)
        # What cannot be written is known before anything is measured.
        write_json(options.out, [])
        return cls(options.out, torch.device(options.device), options.quick, time.monotonic() + options.seconds)

    @property
    def is_over(self) -> bool:
        """Whether the time is up."""
        return time.monotonic() > self.end

    @property
    def left(self) -> float:
        """Seconds that are left."""
        return max(self.end - time.monotonic(), 0.0)

    def add(self, **row: object) -> None:
        """Add a row to the file."""
        self.rows.append(row)
        write_json(self.out, self.rows)
        print(", ".join(f"{name} {value}" for name, value in row.items()), flush=True)

    def attempt(self, name: str, measure: Callable[[], dict[str, object]]) -> None:
        """Add the row that ``measure`` returns, or the error that it raises; the parts go on."""
        try:
            found = {"failed": "not reached in time"} if self.is_over else measure()
            if self.device.type == "cuda":
                # What fails on the device fails in this row, and later ones have its memory.
                torch.cuda.synchronize()
                torch.cuda.empty_cache()
        except Exception as error:  # whatever a device or a compiler raises
            found = failure(error)
        self.add(name=name, **found)

    def milliseconds(self, call: Callable[[], object], rounds: int = 20) -> dict[str, object]:
        """See :func:`milliseconds`; few rounds if the part is quick."""
        return milliseconds(self.device, call, 2 if self.quick else rounds)


def failure(error: Exception) -> dict[str, object]:
    """What a row says about an error: some errors of compilers cannot be sent from process to process."""
    return {"failed": f"{type(error).__name__}: {' '.join(str(error).split())[:300]}"}


def milliseconds(device: torch.device, call: Callable[[], object], rounds: int = 20) -> dict[str, object]:
    """Median and quartiles of the time of a call on the device; the first rounds warm up."""
    watch, times = Stopwatch(device), []
    for turn in range(_WARM_UP + rounds):
        start = watch.mark()
        call()
        taken = watch.between(start, watch.mark())
        if turn >= _WARM_UP:
            times.append(taken)
    low, median, high = statistics.quantiles(times, n=4)
    return {"ms": round(median, 4), "quartiles": [round(low, 4), round(high, 4)]}


@cache
def shot(count: int, width: int, height: int) -> list[Frame]:
    """Noisy frames of a textured, curved wall that moves past the camera by a fraction of a pixel; for all rows."""
    g = torch.Generator().manual_seed(0)
    y, x = torch.meshgrid(torch.arange(height) / height, torch.arange(width) / height, indexing="ij")
    frames = []
    for number in range(count):
        shifted = x + 0.3 * number / height
        albedo = 0.5 + 0.4 * torch.stack([torch.sin(f * shifted) * torch.cos(f * y) for f in (9.0, 23.0, 57.0)])
        normal = F.normalize(torch.stack([torch.cos(5 * shifted), torch.sin(5 * y), torch.ones_like(y)]), dim=0)
        light = (0.6 + 0.4 * normal[:1]) * torch.empty(1, height, width).exponential_(generator=g)
        buffers = {
            "color": albedo * light,
            "albedo": albedo,
            "normal": normal,
            "depth": (3 + torch.sin(3 * shifted))[None],
        }
        motion = torch.tensor([0.3, 0.0])[:, None, None].expand(2, height, width)
        frames.append(Frame(**{name: buffer[None].float() for name, buffer in {**buffers, "motion": motion}.items()}))
    return frames


def difference(found: Tensor, exact: Tensor) -> float:
    """``max |found - exact| / max |exact|`` where both are finite; infinite where one alone is."""
    found, exact = found.detach().double().cpu(), exact.detach().double().cpu()
    finite = exact.isfinite()
    if not torch.equal(found.isfinite(), finite):
        return float("inf")
    size = torch.where(finite, exact, 0).abs().max().clamp_min(1e-30)
    return float(torch.where(finite, found - exact, 0).abs().max() / size)
