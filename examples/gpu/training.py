"""Time training steps, and compare the losses of a hundred steps with those of the CPU.

python examples/gpu/training.py -o training.json
"""

import sys
import time
from functools import partial
from pathlib import Path

import torch
from part import Part

from mcdenoise.models import DEFAULT, Precision, create_model
from mcdenoise.train import TrainConfig
from mcdenoise.train.devices import open_fabric
from mcdenoise.train.loop import Trainer

sys.path.append(str(Path(__file__).parents[1]))
from training_speed import noise

SMALLEST = "cascaded_v2_micro"


class Steps:
    """Training steps of a model on clips of noise."""

    def __init__(self, model: str, device: str, precision: Precision, crop: int, batch: int = 4) -> None:
        config = TrainConfig(
            model=model,
            batch=batch,
            frames=4,
            crop=crop,
            precision=precision,
            gradient_norm=1.0,
            ema=0.998,
            draw_resolutions=False,
            validation_frames=0,
        )
        torch.manual_seed(0)
        network = create_model(model).train()
        self.trainer = Trainer(
            config, network, open_fabric(device, precision, batch), {"image": 1.0, "initial": 1.0}, has_state=False
        )
        self.sampler, self.done = noise(config), 0

    def __call__(self) -> float:
        """Run a step; the loss."""
        loss, _ = self.trainer.step(self.done, self.sampler.draw(self.trainer.seeds(self.done)))
        self.done += 1
        return loss


def losses(part: Part, device: str) -> list[float]:
    """The losses of the first steps in float32."""
    step = Steps(SMALLEST, device, "float32", crop=64)
    return [round(step(), 6) for _ in range(5 if part.quick else 100)]


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
    models, crop = ((SMALLEST,), 32) if part.quick else ((DEFAULT, SMALLEST, "oidn_tuned"), 128)
    for model in models:
        for precision in ("float32", "bfloat16"):
            for batch in (2,) if part.quick else (4, 16):
                measure = partial(
                    lambda *given: part.milliseconds(Steps(*given), 10), model, part.device.type, precision
                )
                part.attempt(f"{model}, {precision}, {batch} clips of 4x{crop}x{crop}", partial(measure, crop, batch))
    part.attempt("losses", partial(compared, part))


if __name__ == "__main__":
    main()
