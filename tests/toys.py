"""Methods of ten lines that know nothing of their wrappers, and frames for them."""

import importlib.util
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mcdenoise import ops
from mcdenoise.frame import BUFFERS, Frame
from mcdenoise.models import Accumulated, Demodulated, Exposed, Model, Needs, Output, Skipping, create_model
from mcdenoise.models._registry import find_model
from mcdenoise.models._report import FrameReport
from mcdenoise.models._wrapper import parts_of
from mcdenoise.ops._backend import Backend

has_oidn = pytest.mark.skipif(
    importlib.util.find_spec("pyoidn") is None, reason="Open Image Denoise is in the extra mcdenoise[oidn]"
)


def report_of(output: Output) -> FrameReport:
    report = FrameReport()
    report.add(output.notes)
    return report


def frame_of(height: int, width: int, batch: int = 1, seed: int = 0, **buffers: Any) -> Frame:
    """Color, albedo, normal and depth at random, with background in the first row of larger images."""
    generator = torch.Generator().manual_seed(seed)
    color, albedo, normal, depth = (
        torch.rand(batch, channels, height, width, generator=generator) for channels in (3, 3, 3, 1)
    )
    depth = 1 + 9 * depth
    if height > 1:
        depth[:, :, 0] = torch.inf
    defaults = {"albedo": albedo, "normal": F.normalize(normal - 0.5, dim=1), "depth": depth}
    return Frame(color.square() * 4, **(defaults | buffers))


def sampled(height: int, width: int, samples: int = 3) -> Frame:
    """A frame in float64 with so many samples a pixel, whose mean is its color; with 0 it has none."""
    generator = torch.Generator().manual_seed(5)
    light = 4 * torch.rand(1, samples, 3, height, width, generator=generator).square()
    given = frame_of(height, width, **({"samples": light} if samples else {}))
    return (given.replace(color=light.mean(1)) if samples else given).to(torch.float64)


def still(color: Tensor, **buffers: Any) -> Frame:
    """A frame of a scene in which nothing moves."""
    return Frame(color=color, **{"motion": torch.zeros_like(color[:, :2]), **buffers})


def whole_frame(model: Model, height: int, width: int, batch: int = 1, seed: int = 0) -> Frame:
    """A frame with all that a model is better with, in range: a wall that moves half a pixel, and seeded noise."""
    rows, columns = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    position = torch.stack([columns / 40, rows / 40, 2 + columns / 400]).repeat(batch, 1, 1, 1)
    depth = position[:, 2:].clone()
    if height > 1:
        depth[:, :, 0] = torch.inf
    normal = torch.tensor([0.6, 0.0, -0.8]).reshape(1, 3, 1, 1).repeat(batch, 1, height, width)
    albedo = (0.2 + 0.6 * ((rows // 4 + columns // 4) % 2)).repeat(batch, 3, 1, 1)
    motion = torch.full((batch, 2, height, width), 0.5)
    generator = torch.Generator().manual_seed(seed)
    color = 4 * torch.rand(batch, 3, height, width, generator=generator).square()
    given: dict[str, Any] = {"albedo": albedo, "normal": normal, "depth": depth, "motion": motion}
    extra = {}
    wanted = model.needs.buffers | model.needs.uses
    if wanted & {"position", "previous_position"}:
        given["position"] = position
    if "view_projection" in wanted:
        given["view_projection"] = torch.eye(4).repeat(batch, 1, 1)
    for name in sorted(wanted - given.keys() - {"color", "previous_position"}):
        samples = (4,) if name == "samples" else ()
        channels = BUFFERS[name].channels if name in BUFFERS else 3
        image = torch.rand(batch, *samples, channels, height, width, generator=generator)
        (given if name in BUFFERS or name == "samples" else extra)[name] = 1 + image if name == "length" else image
    return Frame(color, **given, extra=extra)


def one_of_each(names: Iterable[str]) -> list[str]:
    """One name for each constructor: the sizes of a method differ in their settings only."""
    return list({find_model(name).construct: name for name in sorted(names, reverse=True)}.values())[::-1]


def small(name: str, **settings: Any) -> Any:
    """A small model of the zoo off its initial values: heads of zeros hide everything that is before them."""
    narrow = {"width": 8} if "width" in find_model(name).architecture else {}
    torch.manual_seed(1)
    model = create_model(name, **{**narrow, **settings})
    if isinstance(model, nn.Module):
        for parameter in model.parameters():
            if parameter.dim() > 1 and not parameter.any():
                nn.init.normal_(parameter, std=0.02)
    return model


def cascade(**settings: Any) -> Any:
    """The paper's cascade, small, behind a history and :class:`Skipping`, whose settings these are."""
    (networks,) = parts_of(small("cascaded"), Exposed)
    return Demodulated(Accumulated(Skipping(networks, **settings))).eval()


def drawn(network: nn.Module, std: float = 0.15) -> Any:
    """The network with drawn weights in float64, so that every part of its equations has an effect."""
    torch.manual_seed(3)
    for parameter in network.parameters():
        nn.init.normal_(parameter, std=std)
    return network.double()


class Same(nn.Module):
    needs = Needs(trainable=False, reach=0)

    def forward(self, frame: Frame, state: Any = None) -> tuple[Output, Any]:
        return Output(frame.color), None


class Blur(nn.Module):
    """The mean of 5x5 pixels, and of as much albedo; counts the pixels that it was asked for."""

    needs = Needs(uses=frozenset({"albedo"}), trainable=False, reach=2)

    def __init__(self) -> None:
        super().__init__()
        self.pixels = 0

    def forward(self, frame: Frame, state: Any = None) -> tuple[Output, Any]:
        self.pixels += frame.color.shape[-2] * frame.color.shape[-1]
        image = frame.color if frame.albedo is None else frame.color + 0.25 * frame.albedo
        return Output(F.avg_pool2d(image, 5, 1, 2, count_include_pad=False)), None


class Brightest(nn.Module):
    """Twice the color, up to the brightest pixel of the whole image: depends on a statistic."""

    needs = Needs(trainable=False, reach=0)

    def statistics(self, frame: Frame) -> Mapping[str, Tensor]:
        return {"brightest": frame.color.amax((1, 2, 3), keepdim=True)}

    def forward(self, frame: Frame, state: Any = None) -> tuple[Output, Any]:
        statistics = frame.statistics or self.statistics(frame)
        return Output(torch.minimum(2 * frame.color, statistics["brightest"])), None


class Mean(nn.Module):
    """The mean of all frames since there was no state."""

    needs = Needs(trainable=False)

    def forward(self, frame: Frame, state: Any = None) -> tuple[Output, Any]:
        total, count = (0 * frame.color, 0 * frame.color[:, :1]) if state is None else (state["total"], state["count"])
        state = {"total": total + frame.color, "count": count + 1}
        return Output(state["total"] / state["count"]), state


class Watching(Same):
    """Changes nothing, and remembers what it saw, and in which state."""

    def __init__(self) -> None:
        super().__init__()
        self.frames: list[Frame] = []
        self.states: list[Any] = []

    def forward(self, frame: Frame, state: Any = None) -> tuple[Output, Any]:
        self.frames.append(frame)
        self.states.append(state)
        return Output(frame.color), {"seen": torch.full_like(frame.color, float(len(self.frames)))}


class Seen(NamedTuple):
    """A record of the frame that a method inside :class:`Accumulated` sees, and what is told of its history."""

    color: Tensor
    current: Tensor
    length: Tensor
    reset: str
    history: float | None


class Shot:
    """The history of a shot, frame by frame; settings are those of :class:`Accumulated`."""

    def __init__(self, backend: Backend | None = None, **settings: Any) -> None:
        self.watching, self.backend, self.state = Watching(), backend, None
        self.model = Demodulated(Accumulated(self.watching, **settings))

    def reset(self) -> None:
        self.state = None

    def update(self, frame: Frame, **hints: bool) -> Seen:
        frame = frame.replace(hints=frame.hints._replace(**hints))
        if self.backend is None:
            output, self.state = self.model(frame, self.state)
        else:
            with ops.use(self.backend, strict=False):
                output, self.state = self.model(frame, self.state)
        seen, report = self.watching.frames[-1], report_of(output)
        return Seen(seen.color, seen.current, seen.length, report.reset, report.history)
