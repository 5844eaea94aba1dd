"""The square window of per-pixel kernels: its taps, and pixels beyond the border of the image."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

Border = Literal["replicate", "zeros", "renormalize"]
BORDERS: tuple[Border, ...] = ("replicate", "zeros", "renormalize")


def check_border(border: str) -> None:
    """``ValueError`` for an unknown border mode."""
    if border not in BORDERS:
        raise ValueError(f"border: expected one of {', '.join(BORDERS)}, found {border!r}")


def kernel_size_of(taps: int, name: str) -> int:
    """The odd ``K`` of ``taps = K * K``; ``ValueError`` for any other number of taps."""
    # While torch traces, a size is a tensor, which has no root.
    size = math.isqrt(taps)
    if size * size != taps or size % 2 == 0:
        raise ValueError(f"{name}: expected K*K channels with odd K (1, 9, 25, 49, ...), found {taps}")
    return size


def pad(image: Tensor, radius: int, border: Border) -> Tensor:
    """``image`` with ``radius`` more pixels on each side: its edge repeated, or zeros for the other modes."""
    repeated = border == "replicate" and radius > 0 and image.numel() > 0
    return F.pad(image, (radius,) * 4, mode="replicate" if repeated else "constant")


def unpad(padded: Tensor, radius: int, border: Border) -> Tensor:
    """The transpose of :func:`pad`: values on the margin are added to the pixels that it repeats, or dropped."""
    height, width = padded.shape[-2] - 2 * radius, padded.shape[-1] - 2 * radius
    if border != "replicate" or radius == 0:
        return shifted(padded, radius, 0, 0, height, width)
    rows = _fold_edges(padded, radius, height, -2)
    return _fold_edges(rows, radius, width, -1)


def _fold_edges(padded: Tensor, radius: int, size: int, dim: int) -> Tensor:
    inner = padded.narrow(dim, radius, size)
    if size == 0:
        return inner
    before = padded.narrow(dim, 0, radius).sum(dim, keepdim=True)
    after = padded.narrow(dim, radius + size, radius).sum(dim, keepdim=True)
    first, last = ((0, 0) * (-1 - dim) + margin for margin in ((0, size - 1), (size - 1, 0)))
    return inner + F.pad(before, first) + F.pad(after, last)


def taps(image: Tensor, kernel_size: int, border: Border) -> Iterator[Tensor]:
    """The image as each tap of the window sees it, as views of one padded copy."""
    height, width = image.shape[-2:]
    padded = pad(image, kernel_size // 2, border)
    for top in range(kernel_size):
        # One view of these rows for all taps in them, whose derivatives are padded together.
        rows = padded.narrow(-2, top, height)
        for left in range(kernel_size):
            yield rows.narrow(-1, left, width)


def offsets(kernel_size: int) -> Iterator[tuple[int, int, int]]:
    """Index, row offset and column offset of every tap, row by row from the top left."""
    radius = kernel_size // 2
    for tap in range(kernel_size * kernel_size):
        yield tap, tap // kernel_size - radius, tap % kernel_size - radius


def shifted(padded: Tensor, radius: int, dy: int, dx: int, height: int, width: int) -> Tensor:
    """The view of ``padded`` in which pixel ``p`` shows the image's pixel ``p + (dy, dx)``."""
    return padded.narrow(-2, radius + dy, height).narrow(-1, radius + dx, width)


def parts_of(size: int, part: int) -> int:
    """How many parts cover a size; exported graphs round the quotient of a negative number up, unlike Python."""
    return (size + part - 1) // part


def up_to_multiple(image: Tensor, side: int, mode: Literal["constant", "replicate"] = "constant") -> Tensor:
    """``(..., H, W)`` with zeros after it, or its edge repeated, up to whole multiples of ``side``."""
    right, below = (parts_of(size, side) * side - size for size in (image.shape[-1], image.shape[-2]))
    # A graph for any image size cannot branch on whether padding is needed.
    padded = torch.compiler.is_compiling() or right or below
    return F.pad(image, (0, right, 0, below), mode=mode) if padded else image


def mirrored(image: Tensor, rows: tuple[int, int], columns: tuple[int, int]) -> Tensor:
    """``(..., H, W)`` with its mirror image around it, as many rows and columns before and after it as these say."""
    for dim, (before, after) in ((-2, rows), (-1, columns)):
        size = image.shape[dim]
        # A graph for any image size cannot branch on it.
        if torch.compiler.is_compiling() or max(before, after) > size:
            ends = [
                image.index_select(dim, mirrored_places(torch.arange(*place, device=image.device), size))
                for place in ((-before, 0), (size, size + after))
            ]
        elif before or after:
            # A fifth of the calls, each of which is a kernel on a GPU.
            ends = [image.narrow(dim, start, count).flip(dim) for start, count in ((0, before), (size - after, after))]
        else:
            continue
        image = torch.cat([ends[0], image, ends[1]], dim)
    return image


def mirrored_places(place: Tensor, size: int) -> Tensor:
    """The places in an image of some size that are shown at places outside, by mirrors at both ends."""
    # Graphs in ONNX divide by no number that is a size.
    place = place % torch.full_like(place, 2 * size)
    return torch.minimum(place, 2 * size - 1 - place)


def corner(image: Tensor, height: int, width: int) -> Tensor:
    """The first rows and columns of ``(..., H, W)``, as a view.

    No slice, whose size would be the smaller one of two in a graph for images of any size, and an expression in that
    for all that follows.
    """
    return image.narrow(-2, 0, height).narrow(-1, 0, width)


def block_means(image: Tensor, side: int) -> Tensor:
    """Means over blocks of ``side x side`` pixels; those at the lower and right border have only the pixels there."""
    if 0 in image.shape:
        return image[..., ::side, ::side]
    return F.avg_pool2d(image, side, ceil_mode=True, count_include_pad=False)


def of_blocks(blocks: Tensor, side: int, height: int, width: int) -> Tensor:
    """The image ``(..., H, W)`` in which all pixels of a block ``side x side`` have the block's value."""
    return corner(blocks.repeat_interleave(side, -2).repeat_interleave(side, -1), height, width)


def inside(kernel: Tensor, kernel_size: int) -> Tensor:
    """``(1, K*K, H, W)`` bool: whether each tap of each pixel of kernels ``(B, K*K, H, W)`` lies inside the image."""
    offset = torch.arange(kernel_size, device=kernel.device)[:, None] - kernel_size // 2
    places = [(torch.arange(side, device=kernel.device) + offset, side) for side in kernel.shape[-2:]]
    rows, columns = ((place >= 0) & (place < side) for place, side in places)
    return (rows[:, None, :, None] & columns[None, :, None, :]).reshape(1, kernel_size**2, *kernel.shape[-2:])


def accumulator_dtype(dtype: torch.dtype) -> torch.dtype:
    """The dtype in which sums over taps are kept: half precision is summed in float32."""
    return torch.float32 if dtype in (torch.float16, torch.bfloat16) else dtype


def computing_dtype(x: Tensor) -> torch.dtype:
    """The dtype in which a convolution of a tensor is computed: that of autocast where it is enabled."""
    kind = x.device.type
    # Devices without values have no autocast to ask for.
    if torch.amp.is_autocast_available(kind) and torch.is_autocast_enabled(kind):
        return torch.get_autocast_dtype(kind)
    return x.dtype
