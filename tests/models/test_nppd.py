"""Partitioning pyramids against their equations, in float64 with loops, and against the published layers."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from oracles import filters, history, resolutions
from torch import Tensor, nn
from torch.utils import _pytree as pytree
from toys import refused, small, still, whole_frame

from mcdenoise import Denoiser, Frame
from mcdenoise.models import create_model
from mcdenoise.models.nppd import History, Nppd
from mcdenoise.ops import reproject
from mcdenoise.train.clips import Clip
from mcdenoise.train.losses import stage_loss
from mcdenoise.train.unroll import unroll

SIZE = (7, 9)


def drawn() -> Any:
    """Return the model with weights in float64, so that every part of the equations has an effect."""
    model = small("nppd", width=3)
    torch.manual_seed(3)
    for name, parameter in model.named_parameters():
        nn.init.normal_(parameter, std=0.5 if "heads" in name or "encoder" in name else 0.2)
    return model.double()


def frame_of_doubles(seed: int, samples: int = 2, batch: int = 1) -> Frame:
    generator = torch.Generator().manual_seed(seed)

    def image(*channels: int) -> Tensor:
        return torch.rand(batch, *channels, *SIZE, generator=generator, dtype=torch.float64)

    depth = 1 + 9 * image(1)
    depth[..., 0, 0] = torch.inf
    single = 4 * image(samples, 3).square()
    motion = torch.full((batch, 2, *SIZE), 0.25, dtype=torch.float64)
    normal = F.normalize(image(3) - 0.5, dim=1)
    return Frame(single.mean(1), albedo=image(3), normal=normal, depth=depth, samples=single, motion=motion)


def leaky(x: Tensor) -> Tensor:
    return torch.where(x > 0, x, 0.3 * x)


def logarithm(x: Tensor) -> Tensor:
    """Return the logarithm of one image or stack of images, relative to its mean."""
    return torch.log(1 + x / x.mean())


def encoded(model: Nppd, frame: Frame) -> Tensor:
    """The mean over the samples of ten channels that three layers have made 32 of, pixel by pixel."""
    assert frame.depth is not None
    assert frame.normal is not None
    assert frame.albedo is not None
    assert frame.samples is not None
    hit = torch.isfinite(frame.depth)
    typical = torch.exp(torch.log(frame.depth[hit]).mean())
    near = torch.where(hit, frame.depth / (frame.depth + typical), 1)
    radiance = logarithm(frame.samples)[0]
    layers = [layer for layer in model.encoder if isinstance(layer, nn.Conv2d)]
    result = torch.zeros(1, 32, *SIZE, dtype=torch.float64)
    for y, x in itertools.product(*map(range, SIZE)):
        for sample in radiance:
            v = torch.cat([near[0, :, y, x], frame.normal[0, :, y, x], frame.albedo[0, :, y, x], sample[:, y, x]])
            for number, layer in enumerate(layers):
                assert layer.bias is not None
                v = layer.weight[:, :, 0, 0] @ v + layer.bias
                v = leaky(v) if number < 2 else v
            result[0, :, y, x] += v / len(radiance)
    return result


def predicted(model: Any, seen: Tensor) -> list[Tensor]:
    """The U-Net, its edge repeated up to 32 pixels, layer by layer as its code lists them."""

    def convolved(block: Any, x: Tensor) -> Tensor:
        for layer in block:
            if isinstance(layer, nn.Conv2d):
                x = leaky(F.conv2d(x, layer.weight, layer.bias, padding=1))
        return x

    rows = torch.arange(32).clamp_max(SIZE[0] - 1)
    columns = torch.arange(32).clamp_max(SIZE[1] - 1)
    x, skips, found = seen[:, :, rows][..., columns], [], []
    for block in model.network.down:
        x = convolved(block, x)
        skips.append(x)
        x = x.unflatten(-1, (-1, 2)).amax(-1).unflatten(-2, (-1, 2)).amax(-2) if len(skips) < 6 else x
    for level in (4, 3, 2, 1, 0):
        x = x.repeat_interleave(2, -1).repeat_interleave(2, -2)
        x = convolved(model.network.up[level], torch.cat([x, skips[level]], 1))
        head = model.network.heads[level]
        side = 2**level
        cut = F.conv2d(x, head.weight, head.bias)[..., : -(-SIZE[0] // side), : -(-SIZE[1] // side)]
        found.append(cut)
    return found[::-1]


def written_out(model: Any, frame: Frame, state: History | None) -> tuple[Tensor, History]:
    """A step."""
    zeros = torch.zeros(1, 38, *SIZE, dtype=torch.float64)
    before = zeros if state is None else history.reproject(torch.cat(state[:3], 1), frame.motion)[0]
    mean, image, features = before[:, :3], before[:, 3:6], before[:, 6:]
    own = encoded(model, frame)
    fine, *coarse = predicted(model, torch.cat([logarithm(torch.cat([mean, frame.color], 1)), features, own], 1))
    trust, mix = (1 / (1 + torch.exp(-fine[:, index : index + 1])) for index in (51, 50))
    mean = trust * mean + (1 - trust) * frame.color
    features = trust * features + (1 - trust) * own
    parts = resolutions.pyramid_partition(mean, fine[:, 52:])

    def splatted(part: Tensor, logits: Tensor) -> Tensor:
        return filters.kernel_splat(part, torch.softmax(logits, 1), border="zeros")

    result = splatted(parts[4], coarse[3][:, :25])
    for level in (3, 2, 1, 0):
        kernel = 4 * torch.softmax(coarse[level][:, 25:], 1)
        up = resolutions.learned_upsample(result, kernel, (*parts[level].shape[-2:],), border="zeros")
        result = splatted(parts[level], (fine, *coarse)[level][:, :25]) + up
    result = mix * splatted(image, fine[:, 25:50]) + (1 - mix) * result
    return result, History(mean, result, features, None)


@torch.no_grad()
def test_three_frames_written_out() -> None:
    # In training there is no mirror image around the frame.
    model, state, expected_state = drawn().train(), None, None
    for seed in range(3):
        frame = frame_of_doubles(seed)
        expected, expected_state = written_out(model, frame, expected_state)
        output, state = model(frame, state)
        torch.testing.assert_close(output.image, expected, rtol=1e-9, atol=1e-12)
        torch.testing.assert_close(output.stages["accumulated"], expected_state.radiance, rtol=1e-9, atol=1e-12)
        torch.testing.assert_close(state.features, expected_state.features, rtol=1e-9, atol=1e-12)


def convolutions(layers: list[tuple[int, int]], side: int) -> int:
    """Weights and biases of convolutions."""
    return sum(entering * leaving * side**2 + leaving for entering, leaving in layers)


ENCODER = convolutions([(10, 32), (32, 32), (32, 32)], 1)


def test_the_published_small_network_has_as_many_parameters() -> None:
    """The layers as the code lists them, for what it calls 15M."""
    down = [(70, 96), (96, 96), (96, 96), (96, 128), (128, 128), (128, 192), (192, 192), (192, 256), (256, 256)]
    down += [(256, 384), (384, 512), (512, 512), (512, 384)]
    up = [(768, 384), (384, 256), (512, 256), (256, 192), (384, 192), (192, 128), (256, 128), (128, 96)]
    up += [(192, 96), (96, 96)]
    heads = [(96, 57), (96, 41), (128, 41), (192, 41), (256, 41)]
    expected = ENCODER + convolutions(down + up, 3) + convolutions(heads, 1)
    assert sum(each.numel() for each in create_model("nppd", width=96).parameters()) == expected
    assert expected == 15_593_341


def test_the_published_large_network_has_as_many_parameters() -> None:
    """The layers as the code lists them, for what it calls 30M."""

    def block(width: int) -> int:
        return (49 * width + width) + 2 * width + convolutions([(width, 4 * width), (4 * width, width)], 1) + width

    down = [(70, 128), (512, 128), (512, 256), (1024, 256), (1024, 512)]
    up = [(128 // 4 + 128, 128), (256 // 4 + 128, 128), (256 // 4 + 256, 256), (512 // 4 + 256, 256)]
    heads = [(128, 57), (128, 41), (256, 41), (256, 41), (512, 41)]
    blocks = 8 * block(128) + 8 * block(128) + 12 * block(256) + 12 * block(256) + 8 * block(512)
    expected = ENCODER + convolutions(down + up + heads, 1) + blocks
    model = create_model("nppd", width=128, backbone="convunext")
    assert sum(each.numel() for each in model.parameters()) == expected
    assert expected == 33_446_525


def decided(**biases: Tensor | float) -> Any:
    """A model whose weights do not depend on the frame: softmaxes of zeros, or of what is given.

    Args:
        biases: logits at the finest scale by what they are of, ``splat``, ``previous``, ``mu``, ``trust``,
            ``partition``.
    """
    model = small("nppd")
    places = {"splat": slice(0, 25), "previous": slice(25, 50), "mu": 50, "trust": 51, "partition": slice(52, 57)}
    with torch.no_grad():
        for head in model.network.heads:
            head.weight.zero_()
            head.bias.zero_()
        for name, bias in biases.items():
            model.network.heads[0].bias[places[name]] = bias
    return model


def only(index: int, count: int) -> Tensor:
    """Logits that choose one."""
    return 100 * F.one_hot(torch.tensor(index), count).float()


NOTHING = {"mu": -100.0, "trust": -100.0}


@torch.no_grad()
def test_all_on_the_finest_level_and_splatted_to_itself_is_the_image() -> None:
    model = decided(**NOTHING, splat=only(12, 25), partition=only(0, 5))
    state = None
    for seed in range(2):
        frame = whole_frame(model, 21, 34, seed=seed)
        output, state = model(frame, state)
        torch.testing.assert_close(output.image, frame.color)


@torch.no_grad()
def test_a_constant_image_stays_constant_away_from_the_border() -> None:
    """Equal weights everywhere.

    At level 4 two pixels from the border on lack neighbours, and ``n`` of those make ``2 n + 1`` of the next finer
    level: 5, 11, 23 and at last 47, of which 16 are of the mirror image around the frame.
    """
    model = decided(**NOTHING)
    frame = still(torch.full((1, 3, 128, 160), 0.7))
    image = model(frame)[0].image
    torch.testing.assert_close(image[..., 31:-31, 31:-31], torch.full((1, 3, 66, 98), 0.7))
    assert not torch.isclose(image[..., 30, 80], torch.tensor(0.7)).any()
    # Light that leaves the image is lost, and nothing is added.
    assert image.max() <= 0.7 * (1 + 1e-5)
    assert image[..., 0, 0].max() < 0.65


@torch.no_grad()
def test_lambda_keeps_the_mean_and_mu_the_result() -> None:
    """Both are one half here: the results are means of halves, since nothing moves."""
    model = decided(mu=0.0, trust=0.0, splat=only(12, 25), previous=only(12, 25), partition=only(0, 5))
    state, mean, image = None, torch.zeros(1, 3, 6, 7), torch.zeros(1, 3, 6, 7)
    for seed in range(4):
        color = torch.rand(1, 3, 6, 7, generator=torch.Generator().manual_seed(seed))
        output, state = model(still(color), state)
        mean = (mean + color) / 2
        image = (image + mean) / 2
        torch.testing.assert_close(output.stages["accumulated"], mean)
        torch.testing.assert_close(output.image, image)


@torch.no_grad()
def test_the_history_is_warped() -> None:
    model = decided(mu=100.0, trust=0.0, previous=only(12, 25))
    first, second = (whole_frame(model, 12, 15, seed=seed) for seed in range(2))
    _, state = model(first)
    moved = model(second, state)[0].image
    assert second.motion is not None
    torch.testing.assert_close(moved, reproject(state.image, second.motion)[0])


@torch.no_grad()
def test_samples_are_averaged_after_they_were_seen_one_by_one() -> None:
    model = small("nppd")
    frame = whole_frame(model, 17, 20)
    assert frame.samples is not None
    image = model(frame)[0].image
    shuffled = model(frame.replace(samples=frame.samples[:, [2, 0, 3, 1]]))[0].image
    torch.testing.assert_close(shuffled, image)
    doubled = model(frame.replace(samples=frame.samples.repeat(1, 2, 1, 1, 1)))[0].image
    torch.testing.assert_close(doubled, image)
    # Further channels of samples are not looked at, and one sample is the color.
    more = torch.cat([frame.samples, frame.samples], 2)
    assert torch.equal(model(frame.replace(samples=more))[0].image, image)
    alone = model(frame.replace(samples=None))[0].image
    torch.testing.assert_close(model(frame.replace(samples=frame.color[:, None]))[0].image, alone)
    assert not torch.allclose(alone, image)


@torch.no_grad()
def test_a_broken_sample_breaks_nothing() -> None:
    denoiser = Denoiser(small("nppd"))
    frame = whole_frame(denoiser.model, 9, 8)
    assert frame.samples is not None
    for value in (torch.inf, -1.0, 1e30):
        samples = frame.samples.clone()
        samples[0, 1, 2, 3, 4] = value
        for _ in range(2):
            image = denoiser(frame.replace(samples=samples))
            assert image.isfinite().all()
            assert image.min() >= 0


@torch.no_grad()
def test_a_state_of_zeros_is_that_of_no_frame() -> None:
    model = small("nppd")
    frame = whole_frame(model, 12, 15)
    output, state = model(frame)
    zeros = pytree.tree_map_only(Tensor, torch.zeros_like, state)
    torch.testing.assert_close(model(frame, zeros)[0].image, output.image)


def test_a_resize_and_frames_without_motion_begin_anew() -> None:
    denoiser = Denoiser(small("nppd"))
    for frame, reset in (
        (whole_frame(denoiser.model, 12, 15), "first frame"),
        (whole_frame(denoiser.model, 12, 15, seed=1), ""),
        (whole_frame(denoiser.model, 9, 8), "size change"),
        (whole_frame(denoiser.model, 9, 8).replace(motion=None, position=None), "no motion"),
    ):
        image = denoiser(frame)
        assert denoiser.report.reset == reset
        if reset:
            assert torch.equal(image, Denoiser(denoiser.model)(frame))


@torch.no_grad()
def test_the_large_network_at_any_size() -> None:
    torch.manual_seed(0)
    model = create_model("nppd", width=4, backbone="convunext")
    state = None
    for seed in range(2):
        frame = whole_frame(model, 5, 18, seed=seed)
        output, state = model(frame, state)
        assert output.image.shape == frame.color.shape
        assert (output.image >= 0).all()
    assert [head.out_channels for head in model.network.heads] == [57, 41, 41, 41, 41]


def test_it_learns() -> None:
    """The noise of a clip, of which each frame is lit alike: a few steps take half of the error."""
    torch.manual_seed(0)
    model = create_model("nppd", width=6).train()
    generator = torch.Generator().manual_seed(0)
    reference_image = torch.rand(1, 1, 3, 1, 1, generator=generator).expand(1, 3, 3, 32, 32)
    color = -reference_image * torch.log(torch.rand(1, 3, 3, 32, 32, generator=generator).clamp_min(1e-6))
    clip = Clip({"color": color, "motion": torch.zeros(1, 3, 2, 32, 32)})
    optimizer = torch.optim.Adam(model.parameters(), lr=3e-3)
    losses = []
    for _ in range(25):
        loss = stage_loss(unroll(model, clip), reference_image, {"image": 1})
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0] / 2


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"width": 0}, "width: expected a positive multiple of 1 for convunet, found 0"),
        ({"width": 6, "backbone": "convunext"}, "width: expected a positive multiple of 4 for convunext, found 6"),
        ({"backbone": "resnet"}, "backbone: expected convunet or convunext, found 'resnet'"),
    ],
)
def test_settings_that_make_no_network_are_refused(settings: dict[str, Any], expected: str) -> None:
    assert expected in refused(lambda: create_model("nppd", **settings))
