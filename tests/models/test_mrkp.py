"""MRKP and KP against their equations, written out in float64 with loops."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from test_cascaded import frame_of_doubles, halved
from torch import Tensor, nn

from mcdenoise.frame import Frame
from mcdenoise.models import Tiled, create_model, parts_of
from mcdenoise.models.kp import KpNetwork
from mcdenoise.models.mrkp import MrkpNetwork, aligned

SIZE = (7, 9)


def drawn(network: nn.Module) -> Any:
    torch.manual_seed(3)
    for parameter in network.parameters():
        nn.init.normal_(parameter, std=0.2)
    return network.double()


def filtered(image: Tensor, kernel: Tensor) -> Tensor:
    """sum w c / (sum w + 1e-8) over the taps inside whose channel is above zero."""
    out, side = torch.zeros_like(image), math.isqrt(kernel.shape[1])
    _, channels, height, width = image.shape
    for c in range(channels):
        for y in range(height):
            for x in range(width):
                total = weights = 0.0
                for tap in range(side**2):
                    row, column = y + tap // side - side // 2, x + tap % side - side // 2
                    if 0 <= row < height and 0 <= column < width and image[0, c, row, column] > 0:
                        weight = max(0.0, float(kernel[0, tap, y, x]))
                        total += weight * float(image[0, c, row, column])
                        weights += weight
                out[0, c, y, x] = total / (weights + 1e-8)
    return out


def copied(image: Tensor, height: int, width: int) -> Tensor:
    """Even pixels copy, odd ones are the mean of those of their neighbours that there are."""
    out = image.new_zeros(*image.shape[:2], height, width)
    for y in range(height):
        for x in range(width):
            rows = {y // 2, min(y // 2 + y % 2, image.shape[2] - 1)}
            columns = {x // 2, min(x // 2 + x % 2, image.shape[3] - 1)}
            taps = [image[..., row, column] for row in rows for column in columns]
            out[..., y, x] = sum(taps) / len(taps)
    return out


def features(unet: Any, x: Tensor) -> list[Tensor]:
    """Return the features of the finest three decoders, layer by layer."""
    height, width = x.shape[-2:]
    x = F.pad(x, (0, -width % 32, 0, -height % 32), mode="replicate")
    skips, found = [], []
    for layer in unet.encoder:
        skips.append(F.conv2d(x, layer.weight, layer.bias, padding=1).clamp_min(0))
        x = halved(skips[-1])
    for layer in unet.decoder:
        # Each pixel writes its 3x3 weights around twice its place.
        spread = x.new_zeros(1, layer.out_channels, 2 * x.shape[2] + 2, 2 * x.shape[3] + 2)
        for i in range(3):
            for j in range(3):
                part = torch.einsum("bchw,cd->bdhw", x, layer.weight[:, :, i, j])
                spread[..., i : i + 2 * x.shape[2] : 2, j : j + 2 * x.shape[3] : 2] += part
        up = spread[..., 1:-1, 1:-1] + layer.bias[:, None, None]
        x = torch.cat([up.clamp_min(0), skips.pop()], 1)
        found.append(x)
    return [level[..., : -(-height // 2**scale), : -(-width // 2**scale)] for scale, level in enumerate(found[:-4:-1])]


def ten(frame: Frame) -> Tensor:
    assert frame.albedo is not None
    assert frame.normal is not None
    assert frame.depth is not None
    hit = frame.depth.isfinite()
    typical = torch.exp(torch.log(frame.depth[hit]).mean())
    depth = torch.where(hit, frame.depth / (frame.depth + typical), 1)
    return torch.cat([frame.color, frame.albedo, frame.normal * 0.5 + 0.5, depth], 1)


@torch.no_grad()
def test_mrkp_is_its_equations() -> None:
    network = drawn(MrkpNetwork(4, 3))
    for head in network.heads:
        head.bias[-1] += 1  # lest the ReLU hides the coarser scales
    frame = frame_of_doubles(*SIZE)
    color = frame.color.clone()
    color[0, 1, 2, 3] = 0
    frame = frame.replace(color=color)
    levels = features(network.unet, ten(frame))
    n1 = frame.color
    n2 = halved(n1)
    n3 = halved(n2)
    out = halved(n3)
    for n, level, head in zip((n3, n2, n1), levels[::-1], list(network.heads)[::-1], strict=True):
        predicted = F.conv2d(level, head.weight, head.bias, padding=1)
        d, alpha = filtered(n, predicted[:, :-1]), predicted[:, -1:].clamp_min(0)
        assert (alpha > 0).any()
        size = n.shape[-2:]
        out = d - alpha * copied(halved(d), *size) + alpha * copied(out, *size)
    torch.testing.assert_close(network(frame)[0].image, out.clamp_min(0))


@torch.no_grad()
def test_kp_is_its_equations() -> None:
    network, frame = drawn(KpNetwork(4, 5)), frame_of_doubles(*SIZE)
    logits = F.conv2d(features(network.unet, ten(frame))[0], network.head.weight, network.head.bias, padding=1)
    windows = F.unfold(F.pad(frame.color, (2, 2, 2, 2), mode="replicate"), 5).reshape(1, 3, 25, *SIZE)
    expected = (windows * torch.softmax(logits, 1)[:, None]).sum(2)
    torch.testing.assert_close(network(frame)[0].image, expected)


def test_parameters_are_those_of_the_public_code() -> None:
    assert sum(p.numel() for p in create_model("mrkp").parameters()) == 341_838


@pytest.mark.parametrize("size", [(1, 1), (2, 4), (5, 6), (6, 9)])
def test_upsampling_aligned_with_the_even_pixels(size: tuple[int, int]) -> None:
    height, width = size
    image = torch.rand(1, 2, -(-height // 2), -(-width // 2), dtype=torch.float64)
    found = aligned(image, height, width)
    assert torch.equal(found[..., ::2, ::2], image)
    torch.testing.assert_close(found, copied(image, height, width))


@pytest.mark.parametrize("name", ["mrkp", "kp"])
@torch.no_grad()
def test_tiles_give_the_image(name: str) -> None:
    """The halo is as wide as what a pixel depends on."""
    torch.manual_seed(0)
    network = create_model(name, width=4, kernel_size=5).double()
    inner = next(parts_of(network, Tiled)).inner
    drawn(inner)
    frame = frame_of_doubles(9, 480)
    frame = frame.replace(statistics=inner.statistics(frame))
    whole, tiled = inner(frame)[0].image, Tiled(inner, side=32)(frame)[0].image
    torch.testing.assert_close(tiled, whole)
