"""A user's own recurrent denoiser, given as a file and a factory: hidden features that are warped by the motion."""

import torch
from torch import Tensor, nn

from mcdenoise.frame import Frame
from mcdenoise.models import Accumulated, Demodulated, Model, Needs, Output
from mcdenoise.models._wrapper import FromBuffers
from mcdenoise.ops import reproject


class Recurrent(nn.Module):
    """A gated recurrent unit of convolutions on log radiance."""

    needs = Needs(frozenset({"color", "motion"}))

    def __init__(self, width: int = 8) -> None:
        super().__init__()
        self.width = width
        self.gates = nn.Conv2d(3 + width, 2 * width, 3, padding=1)
        self.candidate = nn.Conv2d(3 + width, width, 3, padding=1)
        self.head = nn.Conv2d(width, 3, 1)

    def forward(self, frame: Frame, state: Tensor | None = None) -> tuple[Output, Tensor]:
        image = torch.log1p(frame.color)
        hidden = image.new_zeros(len(image), self.width, *frame.size)
        if state is not None and state.shape == hidden.shape:
            hidden, _ = reproject(state.to(image.dtype), frame.motion)
        update, reset = self.gates(torch.cat([image, hidden], 1)).sigmoid().chunk(2, 1)
        candidate = self.candidate(torch.cat([image, reset * hidden], 1)).tanh()
        hidden = hidden + update * (candidate - hidden)
        return Output(torch.expm1(image + self.head(hidden)).clamp_min(0), {"input": frame.color}), hidden


def plain(width: int = 8) -> Model:
    return Recurrent(width)


def accumulated(width: int = 8) -> Model:
    """Return a model of accumulated radiance without albedo; the hidden state ends where the history ends."""
    return Demodulated(Accumulated(Recurrent(width)))


class Guided(nn.Module):
    """Four buffers in, an image out, and no word of frames and states."""

    def __init__(self, width: int = 4) -> None:
        super().__init__()
        self.layers = nn.Sequential(nn.Conv2d(10, width, 3, padding=1), nn.ReLU(), nn.Conv2d(width, 3, 1))

    def forward(self, color: Tensor, albedo: Tensor, normal: Tensor, depth: Tensor) -> Tensor:
        near = torch.where(depth.isfinite(), 1 / (1 + depth), 0)
        return torch.relu(color + self.layers(torch.cat([torch.log1p(color), albedo, normal, near], 1)))


class Scaled(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.factor = nn.Parameter(torch.ones(()))

    def forward(self, color: Tensor) -> Tensor:
        return color * self.factor


class Cropped(Scaled):
    def forward(self, color: Tensor) -> Tensor:
        return super().forward(color)[..., ::2]


class Detached(Scaled):
    def forward(self, color: Tensor) -> Tensor:
        return super().forward(color).detach()


def broken() -> nn.Module:
    class Broken(Scaled):
        def forward(self, color: Tensor, curvature: Tensor) -> Tensor:
            return color * curvature * self.factor

    return Broken()


def without_weights() -> Model:
    return FromBuffers(lambda color: color)


def forgetful() -> nn.Module:
    class Forgetful(Recurrent):
        def forward(self, frame: Frame, state: Tensor | None = None) -> tuple[Output, Tensor]:
            if state is not None:
                raise RuntimeError("the state is gone")
            return super().forward(frame, state)

    return Forgetful()
