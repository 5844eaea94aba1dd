"""Count the kernels that a step of a model launches on a GPU, by the page that asks for them; needs no GPU.

    python examples/gpu/launches.py wild

The step runs on tensors without values, whose operators are counted but for views and empty memory.
"""

import sys
from collections import Counter
from typing import Any

import torch
from models import denoiser_of
from part import SIZES, shot
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode

from mcdenoise.models import DEFAULT
from mcdenoise.ops import use

PAGES = "/mcdenoise/models/"


class Launches(TorchDispatchMode):
    """Counts operators, by the innermost page of a model that they come from."""

    def __init__(self) -> None:
        super().__init__()
        self.found: Counter[str] = Counter()

    def __torch_dispatch__(self, function: Any, types: Any, given: Any = (), named: Any = None) -> Any:
        schema = function._schema
        is_view = all(each.alias_info is not None and not each.alias_info.is_write for each in schema.returns)
        if not is_view and "empty" not in schema.name:
            frame = sys._getframe()
            while frame.f_back and (PAGES + "_" in frame.f_code.co_filename or PAGES not in frame.f_code.co_filename):
                frame = frame.f_back
            self.found[frame.f_code.co_filename.rpartition("/")[2]] += 1
        return function(*given, **(named or {}))


@torch.no_grad()
def launches(name: str, size: tuple[int, int] = SIZES[0]) -> Counter[str]:
    """The kernels of the third step of a shot."""
    denoiser, _ = denoiser_of(name, precision="float32")
    model: Any = denoiser.model
    if isinstance(model, nn.Module):
        model.to("meta")
    frame, state = shot(1, *size)[0].to("meta"), None
    with use("torch"):
        for _ in range(2):
            state = model(frame, state)[1]
        with Launches() as counted:
            model(frame, state)
    return counted.found


if __name__ == "__main__":
    for name in sys.argv[1:] or [DEFAULT]:
        found = launches(name)
        print(f"{name}: {found.total()} ({', '.join(f'{page} {count}' for page, count in found.most_common())})")
