"""Time whole frames and streams of the models, compare them with the CPU, and look for reads of the host.

    python examples/gpu/models.py -o models.json

Whole frames are steps of the model in a stream, and the same as a CUDA graph. A process of its own meanwhile compiles
the step of some models (:func:`torch.compile`, one graph without a break), which is timed, also as a CUDA graph, when
nothing else runs. "stream" is what a user of Denoiser gets, frame by frame, with the memory that torch holds after the
tenth and after the last frame. Models without shipped weights have random ones, on which their times do not depend.
"""

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from itertools import product
from multiprocessing import get_context
from typing import Any

import torch
from part import SIZES, Part, difference, failure, milliseconds, shot
from torch.utils import _pytree as pytree

from mcdenoise import Denoiser, Frame, InputError, create_model
from mcdenoise.models import DEFAULT, list_models
from mcdenoise.models._registry import find_model
from mcdenoise.ops import use

# In this order, the most important first; then all others.
FIRST = (DEFAULT, "wild_small", "wild_large")
COMPILED = STREAMING = (DEFAULT, "wild_small")
AGREEING = (320, 180)
STREAMED = 60
PRECISIONS = {"bfloat16": torch.bfloat16, "float16": torch.float16, "float32": None}
# The compiled steps that the other process holds.
MADE: dict[str, "Steps"] = {}


def denoiser_of(name: str, **settings: Any) -> tuple[Denoiser, dict[str, object]]:
    """A denoiser with shipped weights, or with random ones, and what a row says about these."""
    try:
        return Denoiser(name, **settings), {}
    except InputError:
        torch.manual_seed(0)
        return Denoiser(create_model(name), **settings), {"weights": "random"}


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
    found: dict[str, list[torch.Tensor]] = {}
    # The forms for processors would be compiled first.
    with use("torch"):
        for device in (torch.device("cpu"), part.device):
            denoiser, row = denoiser_of(name, device=device, precision="float32")
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
    denoiser, _ = denoiser_of(name, device=device, precision="float32", differentiable=True)
    color = frames[0].color.detach().clone().requires_grad_()
    denoiser(frames[0].replace(color=color))
    image = denoiser(frames[1])
    if not image.requires_grad:
        return []
    return [each.cpu() for each in torch.autograd.grad(image.mean(), [color], allow_unused=True) if each is not None]


class Steps:
    """Steps of a model in a stream, with the frame and the state in place, as a graph needs them."""

    def __init__(self, name: str, device: torch.device, size: tuple[int, int], dtype: torch.dtype | None) -> None:
        torch.backends.cudnn.benchmark = True
        denoiser, self.about = denoiser_of(name, device=device, precision="float32")
        self.model: Any = denoiser.model
        self.device, self.dtype = device, dtype
        self.frame = shot(1, *size)[0].to(device)
        self.state: Any = None
        for _ in range(2):
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


def times(part: Part, name: str, size: tuple[int, int], precision: str) -> None:
    """Add the times of a whole frame: as a step, and as a graph."""
    where, start = f"{name}, {size[0]}x{size[1]}, {precision}", time.monotonic()
    made: list[Steps] = []

    def step() -> dict[str, object]:
        made.append(Steps(name, part.device, size, PRECISIONS[precision]))
        seconds = round(time.monotonic() - start, 1)
        return made[0].about | part.milliseconds(made[0], 10) | {"seconds until the first": seconds}

    part.attempt(f"{where}: step", step)
    if part.device.type == "cuda":
        part.attempt(f"{where}: graph", lambda: made[0].about | part.milliseconds(made[0].graph(), 10))


def compiled(name: str, device: torch.device, size: tuple[int, int]) -> dict[str, object]:
    """Compile the step of a model, and tell what failed, or how long it took."""
    start = time.monotonic()
    try:
        steps = Steps(name, device, size, PRECISIONS["bfloat16"])
        steps.model = torch.compile(steps.model, fullgraph=True, dynamic=False)
        steps()
    except Exception as error:  # whatever a compiler raises
        return failure(error)
    MADE[name] = steps
    return {"seconds to compile": round(time.monotonic() - start, 1)}


def times_of_compiled(name: str, quick: bool) -> dict[str, object]:
    """The times of a compiled step: by itself, and as a graph."""
    steps, rounds = MADE[name], 2 if quick else 10
    try:
        row: dict[str, object] = {"step": milliseconds(steps.device, steps, rounds)}
        if steps.device.type == "cuda":
            row["graph"] = milliseconds(steps.device, steps.graph(), rounds)
    except Exception as error:  # whatever a device raises
        return failure(error)
    return row | steps.about


def of_other(part: Part, other: Any, name: str, made: Any) -> dict[str, object]:
    """The row of a model that another process compiles, as soon as it has."""
    row: dict[str, object] = made.get(part.left)
    return row if "failed" in row else row | other.apply(times_of_compiled, (name, part.quick))


def stream(part: Part, name: str, size: tuple[int, int]) -> dict[str, object]:
    """The time and the memory of a stream of frames that are on the device already."""
    torch.backends.cudnn.benchmark = True
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
    names, sizes = (FIRST[:2], ((64, 48),)) if part.quick else (FIRST, SIZES)
    first = "{}x{}".format(*sizes[0])

    def timed(names: Iterable[str], precisions: Iterable[str]) -> None:
        for name, precision, size in product(names, precisions, sizes):
            times(part, name, size, precision)

    def agree(names: Iterable[str]) -> None:
        torch.backends.cudnn.benchmark = False
        for name in names:
            part.attempt(f"{name}: agreement", partial(agreement, part, name))

    torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = False
    with get_context("spawn").Pool(1) as other:
        chosen = ("noisy",) if part.quick else COMPILED
        making = {name: other.apply_async(compiled, (name, part.device, sizes[0])) for name in chosen}
        timed(names, ["bfloat16"])
        agree(names)
        for name in STREAMING[: len(sizes)]:
            part.attempt(f"{name}, {first}: stream", partial(stream, part, name, sizes[0]))
        for name, made in making.items():
            part.attempt(f"{name}, {first}, bfloat16: compiled", partial(of_other, part, other, name, made))
    timed(names, ["float16", "float32"])
    if not part.quick:
        # But for those of other libraries, which may not run on the device.
        others = [name for name in list_models() if find_model(name).kind != "peer" and name not in FIRST]
        timed(others, ["bfloat16"])
        agree(others)


if __name__ == "__main__":
    main()
