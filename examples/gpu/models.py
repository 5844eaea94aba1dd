"""Compare the models with themselves on the CPU, look for reads of the host, and time whole frames and streams.

    python examples/gpu/models.py -o models.json

Whole frames are steps of the model in a stream, and the same as a CUDA graph, in every precision that the device has;
the first model is also compiled by torch. "stream" is what a user of Denoiser gets, frame by frame, with the memory
that torch holds after the tenth and after the last frame.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from part import SIZES, Part, difference, shot
from torch.utils import _pytree as pytree

from mcdenoise import Denoiser, Frame
from mcdenoise.models import DEFAULT, find_model, list_models

# In this order, the most important first; then all others.
FIRST = (DEFAULT, "oidn_tuned", "oidn_tuned_small", "cascaded_v2_small", "cascaded", "svgf")
AGREEING = (320, 180)
STREAMED = 100
PRECISIONS = {"bfloat16": torch.bfloat16, "float16": torch.float16, "float32": None}


@contextmanager
def reading_nothing(device: torch.device) -> Iterator[None]:
    """An error where the host waits for the device."""
    if device.type != "cuda":
        yield
        return
    torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


def agreement(part: Part, name: str) -> dict[str, object]:
    """The difference of three frames from those of the CPU, and that of the gradient of the last one in its color."""
    row: dict[str, object] = {}
    found: dict[str, list[torch.Tensor]] = {}
    for device in (torch.device("cpu"), part.device):
        denoiser = Denoiser(name, device=device, precision="float32")
        frames = [frame.to(device) for frame in shot(3, *((64, 48) if part.quick else AGREEING))]
        images = [denoiser(frame).cpu() for frame in frames]
        found["CPU" if "CPU" not in found else "device"] = [*images, *gradient(name, device, frames)]
    row["differences"] = list(map(difference, found["device"], found["CPU"]))
    denoiser.reset()
    denoiser(frames[0])
    try:
        with reading_nothing(part.device):
            denoiser(frames[1])
        row["reads of the host"] = "none"
    except RuntimeError as error:
        row["reads of the host"] = str(error).splitlines()[0]
    return row


def gradient(name: str, device: torch.device, frames: list[Frame]) -> list[torch.Tensor]:
    """The gradient of the second image's mean in the color of the first frame; none of methods without one."""
    denoiser = Denoiser(name, device=device, precision="float32", differentiable=True)
    color = frames[0].color.detach().clone().requires_grad_()
    denoiser(frames[0].replace(color=color))
    image = denoiser(frames[1])
    if not image.requires_grad:
        return []
    return [each.cpu() for each in torch.autograd.grad(image.mean(), [color], allow_unused=True) if each is not None]


class Steps:
    """Steps of a model in a stream, with the frame and the state in place, as a graph needs them."""

    def __init__(self, name: str, device: torch.device, size: tuple[int, int], dtype: torch.dtype | None) -> None:
        self.model: Any = Denoiser(name, device=device, precision="float32").model
        self.device, self.dtype = device, dtype
        self.frame = shot(1, *size)[0].to(device)
        self.state: Any = None
        for _ in range(3):
            self.state = self.computed()[1]

    def computed(self) -> Any:
        """Output and state of a step."""
        with torch.no_grad(), torch.autocast(self.device.type, self.dtype, enabled=self.dtype is not None):
            return self.model(self.frame, self.state)

    def __call__(self) -> None:
        """Run a step, and put its state in place of the last one."""
        _, state = self.computed()
        for held, new in zip(pytree.tree_leaves(self.state), pytree.tree_leaves(state), strict=True):
            if isinstance(held, torch.Tensor):
                held.copy_(new)

    def graph(self) -> Callable[[], None]:
        """The same step as a CUDA graph."""
        side = torch.cuda.Stream()
        side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(side):
            self()
        torch.cuda.current_stream().wait_stream(side)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            self()
        self.recorded = graph
        return graph.replay


def times(part: Part, name: str, size: tuple[int, int], precision: str, form: str) -> dict[str, object]:
    """The time of a whole frame."""
    steps = Steps(name, part.device, size, PRECISIONS[precision])
    if form == "compiled":
        steps.model = torch.compile(steps.model)
        steps()
    return part.milliseconds(steps.graph() if part.device.type == "cuda" and form != "step" else steps)


def stream(part: Part, name: str, size: tuple[int, int]) -> dict[str, object]:
    """The time and the memory of a stream of frames that are on the device already."""
    denoiser, frames = Denoiser(name, device=part.device), [frame.to(part.device) for frame in shot(4, *size)]
    # They come round again, which the motion does not say.
    denoiser.warns = False
    memory: list[float] = []
    count = 12 if part.quick else STREAMED
    turn = iter(range(count + 10))

    def one() -> None:
        number = next(turn)
        denoiser(frames[number % len(frames)])
        if part.device.type == "cuda" and number in (10, count - 1):
            memory.append(round(torch.cuda.memory_allocated() / 1e6, 1))

    found = part.milliseconds(one, rounds=count - 3)
    return {**found, "precision": denoiser.precision, "MB after 10 and all frames": memory}


def main() -> None:
    part = Part.begin(__doc__)
    # Those of other libraries, which may not run on the device.
    others = [name for name in list_models() if find_model(name).kind != "peer" and name not in FIRST]
    names, others, sizes = (FIRST[:2], [], ((64, 48),)) if part.quick else (FIRST, others, SIZES)
    graphs = part.device.type == "cuda"

    def frames(name: str, form: str) -> None:
        torch.backends.cudnn.benchmark = True
        for precision in PRECISIONS:
            for size in sizes:
                where = f"{name}, {size[0]}x{size[1]}, {precision}: {form}"
                part.attempt(where, partial(times, part, name, size, precision, form))

    def agreements(names: Sequence[str]) -> None:
        torch.backends.cudnn.benchmark = False
        for name in names:
            part.attempt(f"{name}: agreement", partial(agreement, part, name))

    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False
    for form in ("step", "graph") if graphs else ("step",):
        frames(DEFAULT, form)
    agreements(names)
    torch.backends.cudnn.benchmark = True
    for name in names:
        for size in sizes:
            part.attempt(f"{name}, {size[0]}x{size[1]}: stream", partial(stream, part, name, size))
    for name in names[1:]:
        for form in ("step", "graph") if graphs else ("step",):
            frames(name, form)
    if graphs:
        for precision in ("float16", "float32"):
            where = f"{DEFAULT}, {sizes[0][0]}x{sizes[0][1]}, {precision}: compiled"
            part.attempt(where, partial(times, part, DEFAULT, sizes[0], precision, "compiled"))
    agreements(others)
    for name in others:
        frames(name, "step")


if __name__ == "__main__":
    main()
