"""Compare the losses of twenty training steps with those of the CPU, and time steps.

python examples/gpu/training.py -o training.json

All steps of a row have the same clips, which are drawn before and are on the device.
"""

import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from part import Part

from mcdenoise.models import DEFAULT
from mcdenoise.models._precision import Precision

sys.path.append(str(Path(__file__).parents[1]))
from training_speed import config_of, noise, steps

SMALLEST = "wild_small"


def steps_of(model: str, device: str, precision: Precision, crop: int, batch: int) -> Callable[[], float]:
    """A function that makes the next training step of a model on clips of noise, and returns its loss."""
    config = config_of(model, precision, batch, 4, crop)
    clips = noise(config).draw(range(batch)).to(torch.device(device))
    drawn: Any = SimpleNamespace(draw=lambda seeds: clips)
    return steps(config, drawn, device)


def losses(part: Part, device: str) -> list[float]:
    """The losses of the first steps in float32."""
    step = steps_of(SMALLEST, device, "float32", 64, 2)
    return [round(step(), 6) for _ in range(5 if part.quick else 20)]


def compared(part: Part) -> dict[str, object]:
    """The losses on the device and on the CPU."""
    start = time.monotonic()
    found, exact = losses(part, part.device.type), losses(part, "cpu")
    worst = max(abs(one - other) / other for one, other in zip(found, exact, strict=True))
    seconds = round(time.monotonic() - start, 1)
    return {"largest difference": worst, "device": found[::5], "CPU": exact[::5], "seconds": seconds}


def main() -> None:
    part = Part.begin(__doc__)
    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False
    part.attempt("losses", partial(compared, part))
    models, crop = ((SMALLEST,), 32) if part.quick else ((DEFAULT, SMALLEST), 128)
    for precision in ("bfloat16", "float32"):
        for model in models:
            for batch in (2,) if part.quick else (4, 16):

                def measure(*given: Any) -> dict[str, object]:
                    return part.milliseconds(steps_of(*given), 5)

                where = f"{model}, {precision}, {batch} clips of 4x{crop}x{crop}"
                part.attempt(where, partial(measure, model, part.device.type, precision, crop, batch))


if __name__ == "__main__":
    main()
