"""The recurrent autoencoder against its equations, and what it remembers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils import _pytree as pytree
from toys import frame_of, small

from mcdenoise import Denoiser, Frame
from mcdenoise.export import export_model
from mcdenoise.models import Demodulated, Exposed
from mcdenoise.models.rae import Rae, input_of, view_normal
from mcdenoise.train import TrainConfig, train

SIZE = (7, 9)


def drawn() -> Any:
    """Narrow, in float64, with biases of which something is felt."""
    torch.manual_seed(2)
    model = Rae(4).double()
    for parameter in model.parameters():
        if parameter.dim() == 1:
            nn.init.normal_(parameter, 0.1, std=0.1)
    # Few pixels are cut off.
    nn.init.constant_(model.decoder[-1][-1].bias, 0.7)
    return model


def shot(frames: int = 3, size: tuple[int, int] = SIZE) -> list[Frame]:
    """Other noise in each frame; nothing moves."""
    motion = torch.zeros(1, 2, *size)
    found = [frame_of(*size, seed=seed, motion=motion, roughness=torch.rand(1, 1, *size)) for seed in range(frames)]
    same = {"normal": found[0].normal, "depth": found[0].depth}
    return [frame.replace(**same).to(torch.float64) for frame in found]


def leaky(x: Tensor) -> Tensor:
    return torch.where(x > 0, x, 0.1 * x)


def convolved(x: Tensor, layer: nn.Conv2d) -> Tensor:
    """3x3 taps, zero outside: a sum over the taps."""
    height, width = x.shape[-2:]
    padded = F.pad(x, (1, 1, 1, 1))
    total = layer.bias[None, :, None, None].expand(len(x), -1, height, width)
    for i in range(3):
        for j in range(3):
            tap = padded[..., i : i + height, j : j + width]
            total = total + torch.einsum("oc,bchw->bohw", layer.weight[:, :, i, j], tap)
    return total


def halved(x: Tensor) -> Tensor:
    rows = [x[..., y : y + 2, :].amax(-2) for y in range(0, x.shape[-2], 2)]
    x = torch.stack(rows, -2)
    return torch.stack([x[..., c : c + 2].amax(-1) for c in range(0, x.shape[-1], 2)], -1)


def doubled(x: Tensor, like: Tensor) -> Tensor:
    height, width = like.shape[-2:]
    return x[..., torch.arange(height) // 2, :][..., torch.arange(width) // 2]


def seen(frame: Frame) -> Tensor:
    """The seven channels of a frame without a camera."""
    assert frame.depth is not None
    assert frame.normal is not None
    assert frame.roughness is not None
    hit = torch.isfinite(frame.depth)
    typical = torch.exp(torch.log(frame.depth[hit]).mean())
    near = torch.where(hit, frame.depth / (frame.depth + typical), 1)
    return torch.cat([torch.log(1 + frame.color), frame.normal[:, :2], near, frame.roughness], 1)


def test_the_network_is_its_equations() -> None:
    model, state, hidden = drawn(), None, [None] * 6
    for frame in shot():
        output, state = model(frame, state)
        x, found = seen(frame), []
        for i, stage in enumerate([*model.encoder, model.bottleneck]):
            a = leaky(convolved(x, stage.entry))
            before = torch.zeros_like(a) if hidden[i] is None else hidden[i]
            x = leaky(convolved(leaky(convolved(torch.cat([a, before], 1), stage.first)), stage.second))
            found.append(x)
            x = halved(x) if i < 5 else x
        hidden = list(found)
        for i, (first, second) in enumerate(model.decoder):
            skip = found[4 - i]
            x = convolved(leaky(convolved(torch.cat([doubled(x, skip), skip], 1), first)), second)
            x = leaky(x) if i < 4 else x
        expected = (torch.exp(x) - 1).clamp(min=0).minimum(frame.color.max())
        torch.testing.assert_close(output.image, expected, rtol=1e-9, atol=1e-12)
        # Neither all black nor all at the brightest.
        assert ((output.image > 0) & (output.image < frame.color.max())).double().mean() > 0.2
        for mine, theirs in zip(state.hidden, hidden, strict=True):
            torch.testing.assert_close(mine, theirs, rtol=1e-9, atol=1e-12)


def test_the_channels_are_those_of_the_paper() -> None:
    model = Rae()
    widths = [32, 43, 57, 76, 101, 101]
    assert [stage.second.out_channels for stage in (*model.encoder, model.bottleneck)] == widths
    pairs = [(first.in_channels, second.out_channels) for first, second in model.decoder]
    assert pairs == [(202, 76), (152, 57), (114, 43), (86, 32), (64, 3)]
    entering = [7, *widths[:-1]]
    weights = sum(9 * (x + 2 * w + w) * w + 3 * w for x, w in zip(entering, widths, strict=True))
    inside = [76, 57, 43, 32, 32]
    for (x, out), middle in zip(pairs, inside, strict=True):
        weights += 9 * (x * middle + middle * out) + middle + out
    assert sum(parameter.numel() for parameter in model.parameters()) == weights == 1_521_529


def turned() -> Tensor:
    """Axes of a camera, in rows: right, down, ahead."""
    axes, _ = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(4)))
    return axes


@pytest.mark.parametrize("perspective", [True, False])
def test_the_normal_is_along_the_axes_of_the_image(perspective: bool) -> None:
    right, down, ahead = turned()
    matrix = torch.zeros(1, 4, 4)
    # The right lower corner of a larger image: clip x and y have a part of w.
    matrix[0, :3, 0], matrix[0, :3, 1] = 1.7 * right, 2.9 * down
    if perspective:
        matrix[0, :3, 0] += 0.6 * ahead
        matrix[0, :3, 1] -= 1.1 * ahead
        matrix[0, :3, 3] = 3 * ahead
    else:
        matrix[0, 3, 3] = 1
    frame = frame_of(4, 5, view_projection=matrix)
    assert frame.normal is not None
    expected = torch.einsum("ac,bchw->bahw", torch.stack([right, down]), frame.normal)
    torch.testing.assert_close(view_normal(frame), expected)
    assert torch.equal(view_normal(frame.replace(view_projection=None)), frame.normal[:, :2])


def test_a_world_that_is_turned_looks_the_same() -> None:
    frame = frame_of(4, 5, view_projection=torch.randn(1, 4, 4))
    assert frame.normal is not None
    turn = turned()
    matrix = frame.view_projection.clone()
    matrix[:, :3] = turn @ matrix[:, :3]
    moved = frame.replace(normal=torch.einsum("ac,bchw->bahw", turn, frame.normal), view_projection=matrix)
    torch.testing.assert_close(input_of(moved), input_of(frame))


def test_it_has_no_accumulation_of_its_own() -> None:
    model = small("rae")
    assert [type(part) for part in (model, model.inner, model.inner.inner)] == [Demodulated, Exposed, Rae]


# The hidden state


@torch.no_grad()
def test_the_image_depends_on_the_frames_before() -> None:
    model = drawn()
    first, second, third = shot()
    after = [model(second, model(frame)[1])[0].image for frame in (first, third)]
    assert not torch.allclose(*after, rtol=1e-3)
    assert not torch.allclose(after[0], model(second)[0].image, rtol=1e-3)


@torch.no_grad()
def test_a_state_of_zeros_is_that_of_no_frame() -> None:
    model = drawn()
    first, second, _ = shot()
    zeros = pytree.tree_map_only(Tensor, torch.zeros_like, model(first)[1])
    torch.testing.assert_close(model(second, zeros)[0].image, model(second)[0].image)


@torch.no_grad()
def test_a_cut_begins_anew_in_each_image_of_a_batch() -> None:
    model = drawn()
    first, second, _ = shot()
    _, state = model(Frame(**{name: buffer.repeat(2, 1, 1, 1) for name, buffer in first.items()}))
    assert second.motion is not None
    motion = torch.cat([second.motion, torch.full_like(second.motion, 1e3)])
    both = Frame(**{name: buffer.repeat(2, 1, 1, 1) for name, buffer in second.items()}).replace(motion=motion)
    output, _ = model(both, state)
    torch.testing.assert_close(output.image[:1], model(second, model(first)[1])[0].image)
    torch.testing.assert_close(output.image[1:], model(second)[0].image)


@torch.no_grad()
def test_without_motion_there_is_no_cut() -> None:
    model = drawn()
    first, second, _ = (frame.replace(motion=None) for frame in shot())
    assert not torch.allclose(model(second, model(first)[1])[0].image, model(second)[0].image, rtol=1e-3)


@torch.no_grad()
def test_the_reason_of_a_new_beginning_is_told() -> None:
    denoiser = Denoiser(small("rae"))
    still = [frame.to(torch.float32) for frame in shot()]
    small_ones = [frame.to(torch.float32) for frame in shot(1, (5, 4))]
    lost = still[2].replace(motion=torch.full_like(still[2].color[:, :2], torch.inf))
    told = []
    for frame in (still[0], still[1], lost, small_ones[0]):
        denoiser(frame)
        told.append(denoiser.report.reset)
    assert told == ["first frame", "", "cut", "size change"]


def test_it_learns_with_its_own_loss(small_sequence: Path, tmp_path: Path) -> None:
    """The gradient goes through the state of three frames."""
    config = TrainConfig(
        model="rae", width=4, frames=3, crop=16, batch=1, steps=40, learning_rate=3e-3, validation_frames=0, loss="rae"
    )
    reports: list[Any] = []
    train(config, [small_sequence], tmp_path / "run", checkpoint_every=10, report=reports.append)
    # 0.129 to 0.098 was measured.
    assert reports[-1].loss < 0.9 * reports[0].loss


@pytest.mark.slow
def test_it_is_one_graph_with_its_state(tmp_path: Path) -> None:
    exported = export_model(small("rae"), tmp_path / "rae.pt2")
    assert {f"state.hidden.{stage}" for stage in range(6)} < set(exported.inputs)
