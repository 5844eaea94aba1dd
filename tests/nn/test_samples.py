"""Samples as networks see them, and their embedding, written out."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mcdenoise.errors import InputError
from mcdenoise.frame import LARGEST_RADIANCE, Frame
from mcdenoise.nn.inputs import image_statistics
from mcdenoise.nn.samples import CHANNELS, LeakyUNet, SampleEmbedding, samples_input, samples_of


def drawn(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def leaky(x: Tensor) -> Tensor:
    return torch.where(x > 0, x, 0.01 * x)


def convolved(x: Tensor, block: nn.Module, *, linear: bool = False) -> Tensor:
    layers = [layer for layer in block.modules() if isinstance(layer, nn.Conv2d)]
    for number, layer in enumerate(layers):
        x = F.conv2d(x, layer.weight, layer.bias, padding=layer.weight.shape[-1] // 2)
        x = x if linear and number == len(layers) - 1 else leaky(x)
    return x


def doubled(image: Tensor) -> Tensor:
    """Bilinear: a pixel of the fine image is a quarter of a pixel from a coarse one."""
    height, width = image.shape[-2:]
    result = image.new_zeros(*image.shape[:2], 2 * height, 2 * width)
    for y in range(2 * height):
        for x in range(2 * width):
            rows = ((y // 2, 0.75), (min(max(y // 2 - 1 + 2 * (y % 2), 0), height - 1), 0.25))
            columns = ((x // 2, 0.75), (min(max(x // 2 - 1 + 2 * (x % 2), 0), width - 1), 0.25))
            result[..., y, x] = sum(a * b * image[..., i, j] for i, a in rows for j, b in columns)
    return result


def by_unet(unet: LeakyUNet, x: Tensor) -> Tensor:
    """Three levels, written out; sizes that are no multiples of four are filled up with zeros."""
    height, width = x.shape[-2:]
    x = F.pad(x, (0, -width % 4, 0, -height % 4))
    fine = convolved(x, unet.encoder[0])
    half = convolved(F.max_pool2d(fine, 2), unet.encoder[1])
    quarter = convolved(F.max_pool2d(half, 2), unet.encoder[2])
    half = convolved(torch.cat([doubled(quarter), half], 1), unet.decoder[0])
    return convolved(torch.cat([doubled(half), fine], 1), unet.decoder[1])[..., :height, :width]


@torch.no_grad()
def test_the_embedding_written_out() -> None:
    torch.manual_seed(1)
    network, samples = SampleEmbedding(CHANNELS, 4, 2, 2).double(), drawn(2, 3, CHANNELS, 6, 7)
    embedded = [convolved(each, network.chains[0]) for each in samples.unbind(1)]
    context = by_unet(network.unets[0], sum(embedded) / 3)
    embedded = [convolved(torch.cat([each, context], 1), network.chains[1]) for each in embedded]
    context = by_unet(network.unets[1], sum(embedded) / 3)
    found, found_context = network(samples)
    torch.testing.assert_close(found, torch.stack(embedded, 1), rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(found_context, context, rtol=1e-10, atol=1e-12)


@torch.no_grad()
def test_samples_in_another_order_are_embedded_alike() -> None:
    torch.manual_seed(1)
    network, samples = SampleEmbedding(CHANNELS, 4, 2, 1).double(), drawn(1, 3, CHANNELS, 6, 7)
    embedded, context = network(samples)
    turned, same = network(samples.flip(1))
    torch.testing.assert_close(turned.flip(1), embedded)
    torch.testing.assert_close(same, context)
    # Twice each of them says nothing new.
    twice, same = network(torch.cat([samples, samples], 1))
    torch.testing.assert_close(twice[:, :3], embedded)
    torch.testing.assert_close(same, context)


@pytest.mark.parametrize("convolutions", [1, 3])
@torch.no_grad()
def test_the_reach_of_a_unet(convolutions: int) -> None:
    """No weight is zero, and no unit is dead: what lies within reach is seen from some pixel, and nothing beyond."""
    unet = LeakyUNet(1, 4, convolutions).double()
    for parameter in unet.parameters():
        nn.init.uniform_(parameter, 0.01, 0.1)
    reach = LeakyUNet.reach(convolutions)
    farthest = 0
    for place in range(4):
        image = torch.zeros(1, 1, 4, 4 * reach, dtype=torch.float64)
        changed = image.clone()
        changed[..., 2 * reach // 4 * 4 + place] = 1
        columns = (unet(changed) != unet(image)).any(2).any(1).nonzero()[:, 1] - (2 * reach // 4 * 4 + place)
        farthest = max(farthest, int(columns.abs().max()))
    # Pooled pixels and interpolated ones do not add up to all of the bound in one direction.
    assert reach - 2 * LeakyUNet.multiple <= farthest <= reach


def frame(**buffers: Tensor) -> Frame:
    features = {"albedo": drawn(2, 3, 3, 4), "normal": 2 * drawn(2, 3, 3, 4) - 1, "depth": 1 + drawn(2, 1, 3, 4)}
    made = Frame(drawn(2, 3, 3, 4, seed=1), **features, **buffers)
    return made.replace(statistics=image_statistics(made))


def test_the_color_is_the_one_sample_of_a_frame_without_samples() -> None:
    given = frame(length=torch.full((2, 1, 3, 4), 4.0, dtype=torch.float64))
    samples = samples_of(given)
    assert torch.equal(samples, given.color[:, None])
    seen = samples_input(given, samples)
    assert seen.shape == (2, 1, CHANNELS, 3, 4)
    torch.testing.assert_close(seen[:, 0, :3], torch.log(1 + given.color))
    assert torch.equal(seen[:, 0, 3:6], given.albedo)
    torch.testing.assert_close(seen[:, 0, 6:9], (given.normal + 1) / 2)
    assert (seen[:, :, -1] == 0.25).all()
    alone = given.replace(length=None)
    assert (samples_input(alone, samples_of(alone))[:, :, -1] == 1).all()


def test_a_history_is_one_more_sample() -> None:
    samples = drawn(2, 3, 5, 3, 4, seed=2)
    given = frame(samples=samples, length=torch.full((2, 1, 3, 4), 4.0, dtype=torch.float64))
    found = samples_of(given)
    assert torch.equal(found, torch.cat([samples[:, :, :3], given.color[:, None]], 1))
    assert samples_input(given, found)[:, :, -1].unique(dim=1).shape[1] == 2
    assert [float(fresh.unique()) for fresh in samples_input(given, found)[:, :, -1].unbind(1)] == [1, 1, 1, 0.25]
    assert torch.equal(samples_of(given.replace(length=None)), samples[:, :, :3])


def test_samples_that_are_no_radiance() -> None:
    samples = torch.tensor([-1.0, 2.0, torch.inf, torch.nan, -torch.inf, 0.5]).reshape(1, 2, 3, 1, 1)
    found = samples_of(Frame(torch.ones(1, 3, 1, 1), samples=samples))
    assert found.flatten().tolist() == pytest.approx([0, 2, LARGEST_RADIANCE, 0, 0, 0.5])
    with pytest.raises(InputError, match=r"buffer 'samples'"):
        samples_of(Frame(torch.ones(1, 3, 1, 1), samples=samples[:, :, :2]))


@pytest.mark.parametrize("setting", ["width", "rounds", "convolutions"])
def test_sizes_of_nothing_are_refused(setting: str) -> None:
    with pytest.raises(InputError, match=rf"{setting}: .*0"):
        SampleEmbedding(CHANNELS, **{"width": 4, "rounds": 1, "convolutions": 1, setting: 0})
