"""The formulas of the fused steps in float64, written with torch's primitives or with other oracles."""

import torch
import torch.nn.functional as F
from torch import Tensor

from oracles import edges, history, resolutions


def _normalized(depth: Tensor, scale: list[Tensor]) -> Tensor:
    near, typical = (each.double() for each in scale)
    depth = depth.double()
    return torch.where(depth.isinf(), 1, 1 - 1 / (1 + torch.where(depth.isinf(), 1, depth) / (near * typical)))


def buffers_input(
    image: Tensor,
    albedo: Tensor,
    normal: Tensor,
    depth: Tensor,
    current: Tensor,
    length: Tensor,
    exposure: Tensor,
    scale: list[Tensor],
) -> Tensor:
    lit = torch.log(1 + current.double() * exposure.double())
    features = [albedo.double(), (normal.double() + 1) / 2, _normalized(depth, scale), lit, 1 / length.double()]
    return torch.cat([torch.log(1 + image.double()), *features], 1)


def gated_fusion(fine: Tensor, coarse: Tensor, weight: Tensor, bias: Tensor, *, logarithms: bool = False) -> Tensor:
    fine, coarse, weight, bias = fine.double(), coarse.double(), weight.double(), bias.double()
    size = (fine.shape[-2], fine.shape[-1])
    wide, low = resolutions.upsample(coarse, size), resolutions.upsample(resolutions.downsample(fine), size)
    detail = torch.log(1 + fine) if logarithms else fine
    alpha = torch.sigmoid(F.conv2d(torch.cat([detail, wide], 1), weight, bias, padding=1))
    return detail + alpha * (wide - (torch.log(1 + low) if logarithms else low))


def incoming(color: Tensor, albedo: Tensor) -> Tensor:
    clamped = edges.clamp_fireflies(resolutions.demodulate(color, albedo))
    mean = clamped.mean(1, keepdim=True)
    return torch.cat([clamped, mean**0.25, mean**0.5], 1)


def lights(root: Tensor) -> Tensor:
    root = root.double()
    batch, _, height, width = root.shape
    found = torch.zeros_like(root)
    for b in range(batch):
        image = root[b, 0]
        for top in range(height - 2):
            for left in range(width - 2):
                block = image[top : top + 3, left : left + 3]
                if block.max() - block.min() <= 0.03 * block.max():
                    found[b, 0, top : top + 3, left : left + 3] = 1
        for y in range(height):
            for x in range(width):
                window = image[max(y - 4, 0) : y + 5, max(x - 4, 0) : x + 5]
                found[b, 0, y, x] *= image[y, x] > 1.2 * window.mean()
    return found


def blend(entering: Tensor, previous: Tensor, previous_length: Tensor, motion: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    color, length = history.accumulate(entering, previous, previous_length, motion)
    return color, length, (length > 1).double().mean((1, 2, 3))
