"""Affinity of neural features against its equations, and what it keeps from frame to frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from oracles import filters
from torch import Tensor, nn
from torch.utils import _pytree as pytree
from toys import frame_of, small, whole_frame

from mcdenoise import Denoiser, Frame
from mcdenoise.export import export_model
from mcdenoise.models import Demodulated
from mcdenoise.models.anf import Anf
from mcdenoise.nn import auto_exposure
from mcdenoise.train import TrainConfig, train
from mcdenoise.train.clips import Clip, ClipSampler

SIZE = (6, 7)


def drawn(width: int = 6) -> Any:
    """Return the model in float64, with weights so that every part of the equations has an effect."""
    torch.manual_seed(2)
    model = Anf(width).double()
    for parameter in model.parameters():
        nn.init.normal_(parameter, std=0.25)
    return model


def shot(frames: int = 3, size: tuple[int, int] = SIZE, **buffers: Any) -> list[Frame]:
    """Everything moves by a pixel to the left, on one plane; noise and albedo are drawn anew."""
    motion = torch.zeros(1, 2, *size)
    motion[:, 0] = 1
    flat = {"normal": torch.tensor([0.0, 0.6, 0.8]).reshape(1, 3, 1, 1).expand(1, 3, *size)}
    flat["depth"] = torch.full((1, 1, *size), 3.0)
    found = [frame_of(*size, seed=seed, motion=motion, **flat, **buffers) for seed in range(frames)]
    return [frame.to(torch.float64) for frame in found]


def from_the_right(image: Tensor) -> Tensor:
    """W: what was a pixel further right, and nothing in the last column."""
    return F.pad(image[..., 1:], (0, 1))


def test_the_method_is_its_equations() -> None:
    model, state = drawn(), None
    known = from_the_right(torch.ones(1, 1, *SIZE, dtype=torch.float64))
    light_bar = e_bar = result = features = None
    first, *_, last = (layer for layer in model.embedding if isinstance(layer, nn.Conv2d))
    layers = [first, model.embedding[2], last]
    for frame in shot():
        output, state = model(frame, state)
        # 1. One sample a pixel, in units of the typical radiance; all is equally deep, and so at a half.
        assert frame.albedo is not None
        assert frame.normal is not None
        light = torch.log(1 + frame.color * auto_exposure(frame.color))
        e = torch.cat([light, frame.albedo, frame.normal, torch.full_like(frame.color[:, :1], 0.5)], 1)
        for layer in layers:
            e = torch.einsum("oc,bchw->bohw", layer.weight[..., 0, 0], e) + layer.bias[:, None, None]
            e = torch.where(e > 0, e, 0.01 * e)
        # 2.
        before = torch.zeros_like(e) if e_bar is None else from_the_right(e_bar)
        predicted = F.conv2d(
            model.unet(torch.cat([e, before], 1))[0], model.head.weight, model.head.bias, padding=1
        ).detach()
        # 3.
        stays = torch.zeros_like(known) if e_bar is None else known / (1 + torch.exp(-predicted[:, 30:31]))
        e_bar = (1 - stays) * e + stays * before
        light_bar = (1 - stays) * frame.color + (0 if light_bar is None else stays * from_the_right(light_bar))
        # 4. and 5.
        image = light_bar
        for k in range(3):
            f, a, c = predicted[:, 10 * k : 10 * k + 8], predicted[:, 10 * k + 8, None], predicted[:, 10 * k + 9, None]
            temporal: tuple[Tensor, ...] = ()
            if k == 2 and result is not None and features is not None:
                warped = from_the_right(result), from_the_right(features)
                temporal = (*warped, predicted[:, 31:].square(), known)
            center = 1 / (1 + torch.exp(-c))
            image = filters.affinity_filter(image, f, a.square(), center, *temporal, kernel_size=7, dilation=2**k)
        result, features = image, f
        torch.testing.assert_close(output.image, image, rtol=1e-9, atol=1e-12)
    # Something is kept, and not all.
    assert 0.2 < stays[..., :-1].mean() < 0.8


def test_the_number_of_weights() -> None:
    model = Anf()
    embedding = 10 * 32 + 32 + 2 * (32 * 32 + 32)
    # Two convolutions a level down and up, three times 2x2 up.
    convolution, up = 9 * 32 * 32 + 32, 4 * 32 * 32 + 32
    unet = (9 * 64 * 32 + 32) + 7 * convolution + 3 * (up + (9 * 64 * 32 + 32) + convolution)
    head = 9 * 32 * 32 + 32
    assert sum(parameter.numel() for parameter in model.parameters()) == embedding + unet + head == 190_432


@torch.no_grad()
def test_samples_that_are_all_the_color_are_as_none_and_their_order_says_nothing() -> None:
    model = small("anf")
    frame = frame_of(9, 11)
    plain, _ = model(frame)
    same, _ = model(frame.replace(samples=frame.color[:, None].repeat(1, 3, 1, 1, 1)))
    torch.testing.assert_close(same.image, plain.image)
    samples = torch.rand(1, 4, 5, 9, 11) * frame.color[:, None].mean(2, keepdim=True)
    one, _ = model(frame.replace(samples=samples))
    other, _ = model(frame.replace(samples=samples[:, [2, 0, 3, 1]]))
    torch.testing.assert_close(one.image, other.image)
    embedded = [model.inner.embedded(each) for each in (frame, frame.replace(samples=samples))]
    assert not torch.allclose(*embedded, rtol=1e-3)


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -2.0])
@torch.no_grad()
def test_a_broken_sample_breaks_nothing(value: float) -> None:
    model = small("anf")
    frame = whole_frame(model, 9, 8)
    assert frame.samples is not None
    samples = frame.samples.clone()
    samples[0, 1, 2, 3, 4] = value
    assert model(frame.replace(samples=samples))[0].image.isfinite().all()


def test_the_albedo_is_divided_out_of_samples() -> None:
    class Sees(nn.Module):
        needs = Anf(4).needs

        def forward(self, frame: Frame, state: Any = None) -> Any:
            self.frame = frame
            return Anf(4)(frame, state)

    inner, frame = Sees(), frame_of(5, 6)
    assert frame.albedo is not None
    frame = frame.replace(albedo=0.1 + 0.9 * frame.albedo)
    samples = torch.rand(1, 2, 4, 5, 6)
    Demodulated(inner)(frame.replace(samples=samples))
    seen = inner.frame.samples
    assert seen is not None
    torch.testing.assert_close(seen[:, :, :3], samples[:, :, :3] / frame.albedo[:, None])
    assert torch.equal(seen[:, :, 3:], samples[:, :, 3:])


@torch.no_grad()
def test_the_result_is_between_minimum_and_maximum_of_all_frames() -> None:
    """No pixel is darker or brighter than all of the frames."""
    model, state, low, high = drawn(), None, torch.inf, 0.0
    for frame in shot(5):
        output, state = model(frame, state)
        low, high = min(low, float(frame.color.min())), max(high, float(frame.color.max()))
        assert low - 1e-12 <= output.image.min()
        assert output.image.max() <= high + 1e-12


@torch.no_grad()
def test_pixels_of_another_surface_have_no_weight() -> None:
    """In a frame of another depth nothing of the one before is left, however bright it was."""
    model = drawn()
    first, second, _ = shot()
    assert second.depth is not None
    moved = second.replace(depth=2 * second.depth)
    for before in (first, first.replace(color=1e6 * first.color)):
        _, state = model(before)
        torch.testing.assert_close(model(moved, state)[0].image, model(moved)[0].image)
        assert not torch.allclose(model(second, state)[0].image, model(second)[0].image, rtol=1e-3)


@torch.no_grad()
def test_a_state_of_zeros_is_that_of_no_frame() -> None:
    model = drawn()
    first, second, _ = shot()
    zeros = pytree.tree_map_only(Tensor, torch.zeros_like, model(first)[1])
    torch.testing.assert_close(model(second, zeros)[0].image, model(second)[0].image)


@torch.no_grad()
def test_the_reason_of_a_new_beginning_is_told() -> None:
    denoiser, told = Denoiser(small("anf")), []
    frames = [frame.to(torch.float32) for frame in (*shot(2), *shot(1, (5, 4)))]
    for frame in (*frames, frames[-1].replace(motion=None)):
        denoiser(frame)
        told.append(denoiser.report.reset)
    assert told == ["first frame", "", "size change", "no motion"]


@torch.no_grad()
def test_the_unit_of_radiance_may_change_in_a_shot() -> None:
    """The state is in the unit of the frames: twice the light, twice the result."""
    model, state, scaled = drawn(), None, None
    for frame in shot():
        output, state = model(frame, state)
        double, scaled = model(frame.replace(color=2 * frame.color), scaled)
        torch.testing.assert_close(double.image, 2 * output.image)


def test_it_learns(small_sequence: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One clip by heart, through the state of three frames, with the temporal weight of its authors."""
    draw, clips, reports = ClipSampler.draw, [], []

    def draw_once(sampler: ClipSampler, seeds: list[int]) -> Clip:
        clips.append(clips[0] if clips else draw(sampler, seeds))
        return clips[-1]

    monkeypatch.setattr(ClipSampler, "draw", draw_once)
    config = TrainConfig(
        model="anf",
        width=8,
        frames=3,
        crop=16,
        batch=1,
        steps=40,
        learning_rate=1e-2,
        temporal_weight=0.25,
        validation_frames=0,
    )
    train(config, [small_sequence], tmp_path / "run", checkpoint_every=5, report=reports.append)
    # 0.238 to 0.152 was measured.
    assert reports[-1].loss < 0.8 * reports[0].loss


@pytest.mark.slow
def test_it_is_one_graph_with_its_state(tmp_path: Path) -> None:
    exported = export_model(small("anf"), tmp_path / "anf.pt2")
    assert {"samples", "state.image", "state.weight"} < set(exported.inputs)
