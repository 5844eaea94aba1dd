"""Derivatives through time: of the third frame of a shot in the buffers of the first, against finite differences."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import torch
from torch import Tensor, nn

from mcdenoise import Denoiser, Frame, create_model

# Central differences in float64: rounding is 1e-16 / 1e-7 of the value, truncation 1e-14; few kinks are that near.
STEP, TOLERANCE = 1e-7, 1e-6
COMPILED = ("mcdenoise.ops._fast", "mcdenoise.ops._numba", "torch")


def shot(size: tuple[int, int], frames: int = 3) -> list[dict[str, Tensor]]:
    """A slope that moves by a part of a pixel, with noise on it; float64."""
    generator = torch.Generator().manual_seed(1)
    height, width = size
    rows, columns = torch.meshgrid(
        torch.arange(height, dtype=torch.float64), torch.arange(width, dtype=torch.float64), indexing="ij"
    )
    found = []
    for number in range(frames):
        x, y = columns + 1.3 * number, rows + 0.4 * number
        albedo = 0.5 + 0.3 * torch.stack([(x / 5).sin(), (y / 7).cos(), ((x + y) / 9).sin()])
        normal = torch.stack([0.3 * (x / 11).sin(), 0.2 * (y / 13).cos(), torch.ones_like(x)])
        noise = 0.5 + torch.rand(3, *size, generator=generator).double()
        buffers = {
            "color": albedo * noise * (1 + 0.5 * (x / 17).cos()),
            "albedo": albedo,
            "normal": nn.functional.normalize(normal, dim=0),
            "depth": (5 + 0.01 * x + 0.02 * y)[None],
            "motion": torch.stack([torch.full_like(x, 1.3), torch.full_like(y, 0.4)]),
        }
        found.append({name: buffer[None] for name, buffer in buffers.items()})
    return found


@contextmanager
def decisions(kept: list[Tensor], *, replay: bool) -> Iterator[None]:
    """Record what is detached from the graph, or put in its place what was recorded: decisions held fixed."""
    original = torch.Tensor.detach
    recorded = iter(kept)

    def detach(self: Tensor) -> Tensor:
        found = original(self)
        # A fast backend computes with the memory of its arguments, and has derivatives of its own.
        if sys._getframe(1).f_globals["__name__"].startswith(COMPILED):
            return found
        if not replay:
            kept.append(found.clone())
            return found
        before = next(recorded)
        assert before.shape == found.shape
        return before.clone()

    torch.Tensor.detach = detach  # type: ignore[method-assign, assignment]
    try:
        yield
    finally:
        torch.Tensor.detach = original  # type: ignore[method-assign]


def last_image(denoiser: Denoiser, frames: list[dict[str, Tensor]]) -> Tensor:
    denoiser.reset()
    images = [denoiser(Frame(**buffers)) for buffers in frames]
    assert denoiser.report.reset == ("" if len(frames) > 1 else "first frame")
    return images[-1]


def check(denoiser: Denoiser, frames: list[dict[str, Tensor]], names: tuple[str, ...]) -> dict[str, float]:
    """Compare derivatives of the last image along random directions; their sizes by name."""
    kept: list[Tensor] = []
    first = {name: frames[0][name].clone().requires_grad_() for name in names}
    with decisions(kept, replay=False):
        image = last_image(denoiser, [{**frames[0], **first}, *frames[1:]])
    assert image.dtype == torch.float64
    generator = torch.Generator().manual_seed(2)
    weights = torch.randn(image.shape, generator=generator, dtype=torch.float64)
    gradients = torch.autograd.grad((image * weights).sum(), list(first.values()), materialize_grads=True)
    sizes = {}
    for name, gradient in zip(names, gradients, strict=True):
        direction = torch.randn(gradient.shape, generator=generator, dtype=torch.float64)
        values = []
        for sign in (1, -1):
            # The changed buffers require gradients as well, so that the same backends of operators are chosen.
            changed = {key: buffer.detach().clone() for key, buffer in first.items()}
            changed[name] += sign * STEP * direction
            changed = {**frames[0], **{key: buffer.requires_grad_() for key, buffer in changed.items()}}
            with decisions(kept, replay=True):
                values.append((last_image(denoiser, [changed, *frames[1:]]) * weights).sum().item())
        expected, found = (values[0] - values[1]) / (2 * STEP), float((gradient * direction).sum())
        sizes[name] = abs(expected)
        scale = float(gradient.abs().mul(direction.abs()).sum())
        assert abs(found - expected) <= TOLERANCE * scale, (name, found, expected, scale)
    return sizes


# The larger one has enough pixels for compiled backends, which are chosen if no derivative is requested.
@pytest.mark.parametrize("size", [(24, 40), (96, 96)], ids=str)
def test_derivative_of_the_third_frame_in_the_first(size: tuple[int, int]) -> None:
    model = create_model("wild_small", pretrained=True)
    denoiser = Denoiser(model.double(), differentiable=True)
    sizes = check(denoiser, shot(size), ("color", "albedo", "normal"))
    # A demodulated history has divided by the albedo of the first frame. Of the normals it knows only decisions, and
    # the networks of the third frame see those of the third.
    assert sizes["color"] > 0
    assert sizes["albedo"] > 0
    assert sizes["normal"] == 0


def test_derivative_in_the_normals_of_the_same_frame() -> None:
    model = create_model("wild_small", pretrained=True)
    sizes = check(Denoiser(model.double(), differentiable=True), shot((24, 40), 1)[:1], ("color", "albedo", "normal"))
    assert all(size > 0 for size in sizes.values())


def test_detach_ends_the_graph_and_changes_no_image() -> None:
    frames = [{name: buffer.float() for name, buffer in each.items()} for each in shot((24, 32), frames=2)]
    images = []
    for cut in (False, True):
        denoiser = Denoiser("wild_small", differentiable=True)
        leaves = [each["color"].clone().requires_grad_() for each in frames]
        for frame, color in zip(frames, leaves, strict=True):
            image = denoiser(Frame(**{**frame, "color": color}))
            if cut:
                denoiser.detach()
        images.append(image.detach())
        image.sum().backward()
        assert (leaves[0].grad is None) is cut
        assert leaves[1].grad is not None
    assert torch.equal(*images)
