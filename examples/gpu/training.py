"""Time training steps, and compare the losses of forty steps with those of the CPU.

python examples/gpu/training.py -o training.json
"""

import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import torch
from part import Part

from mcdenoise.models import DEFAULT, Precision

sys.path.append(str(Path(__file__).parents[1]))
from training_speed import config_of, noise, steps

SMALLEST = "cascaded_v2_micro"


def steps_of(model: str, device: str, precision: Precision, crop: int, batch: int = 4) -> Callable[[], float]:
    """A function that makes the next training step of a model on clips of noise, and returns its loss."""
    config = config_of(model, precision, batch, 4, crop)
    return steps(config, noise(config), device)


def losses(part: Part, device: str) -> list[float]:
    """The losses of the first steps in float32."""
    step = steps_of(SMALLEST, device, "float32", crop=64)
    return [round(step(), 6) for _ in range(5 if part.quick else 40)]


def compared(part: Part) -> dict[str, object]:
    """The losses on the device and on the CPU."""
    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False
    start = time.monotonic()
    found, exact = losses(part, part.device.type), losses(part, "cpu")
    worst = max(abs(one - other) / other for one, other in zip(found, exact, strict=True))
    seconds = round(time.monotonic() - start, 1)
    return {"largest difference": worst, "device": found[::10], "CPU": exact[::10], "seconds": seconds}


def main() -> None:
    part = Part.begin(__doc__)
    models, crop = ((SMALLEST,), 32) if part.quick else ((DEFAULT, "oidn_tuned", SMALLEST), 128)
    for model in models:
        for precision in ("bfloat16", "float32"):
            for batch in (2,) if part.quick else (4, 16):
                measure = partial(
                    lambda *given: part.milliseconds(steps_of(*given), 10), model, part.device.type, precision
                )
                part.attempt(f"{model}, {precision}, {batch} clips of 4x{crop}x{crop}", partial(measure, crop, batch))
        if model == models[0]:
            part.attempt("losses", partial(compared, part))


if __name__ == "__main__":
    main()
