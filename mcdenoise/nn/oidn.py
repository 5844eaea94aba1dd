"""Open Image Denoise's network, and its exposure.

Layers and exposure are those of the library (https://www.openimagedenoise.org, version 2.5, Apache License 2.0), so
that weights are interchangeable.
"""

from __future__ import annotations

import itertools
from typing import Literal, NamedTuple, TypeAlias, get_args

import torch
from torch import Tensor, nn

from mcdenoise.nn._cpu import ConvBlock, UpConvBlock, channels_last, convolved_in_float32, halved
from mcdenoise.nn.unet import Live
from mcdenoise.ops._numbers import numbers_like
from mcdenoise.ops._window import computing_dtype, corner, parts_of, up_to_multiple

Size: TypeAlias = Literal["small", "base", "large"]

_COLORS = 3
_LEVELS = 5
_MULTIPLE = 1 << (_LEVELS - 1)
# Peak numbers per pixel, measured: at most twice the features that are upsampled to full resolution, and 100 for the
# surrounding images, which stay float32.
_LIVE_IMAGES = 100

_KEY, _BIN, _DARK, _LEAST = 0.18, 16, 1e-8, 1e-30
_LUMINANCE = (0.212671, 0.715160, 0.072169)


class _Widths(NamedTuple):
    """Channels of the convolutions of each level: encoder finest first, decoder coarsest first."""

    encoder: tuple[tuple[int, ...], ...]
    decoder: tuple[tuple[int, ...], ...]


_SIZES: dict[Size, _Widths] = {
    "small": _Widths(((32, 32), (32,), (32,), (32,), (32, 32)), ((64, 64), (64, 64), (64, 32), (32, 32))),
    "base": _Widths(((32, 32), (48,), (64,), (80,), (96, 96)), ((112, 112), (96, 96), (64, 64), (64, 32))),
    "large": _Widths(
        ((64, 64), (96, 96), (128, 128), (192, 192), (256, 256)), ((192, 192), (128, 128), (96, 96), (64, 64))
    ),
}


class OidnUNet(nn.Module):
    """Open Image Denoise's U-Net: 3x3 convolutions with ReLU, 2x2 max-pooling, and nearest-neighbour upsampling.

    The decoder concatenates the pooled features of the encoder, and the input at full resolution. Images are padded
    with zeros to whole pixels of the coarsest level, a sixteenth of the resolution.

    Args:
        in_channels: number of input channels: 3 color, 3 albedo and 3 normal in the library.
        size: size in the library: "small" has 62 thousand multiply-adds per pixel, "base" 125, "large" 312.
        out_channels: number of output channels: 3 in the library.

    Raises:
        ValueError: there is no such size.
    """

    multiple = _MULTIPLE  # side of a pixel of the coarsest level

    def __init__(self, in_channels: int = 9, size: Size = "base", out_channels: int = _COLORS) -> None:
        super().__init__()
        if size not in _SIZES:
            raise ValueError(f"size: expected one of {', '.join(get_args(Size))}, found '{size}'")
        encoder, decoder = _SIZES[size]
        self.size: Size = size
        entering = [in_channels, *(widths[-1] for widths in encoder[:-1])]
        self.encoder = nn.ModuleList(itertools.starmap(_block, zip(entering, encoder, strict=True)))
        skips = [*(widths[-1] for widths in encoder[-3::-1]), in_channels]
        coarser = [encoder[-1][-1], *(widths[-1] for widths in decoder[:-1])]
        entering = [below + skip for below, skip in zip(coarser, skips, strict=True)]
        self.decoder = nn.ModuleList(UpConvBlock(*_block(*each)) for each in zip(entering, decoder, strict=True))
        self.last = nn.Conv2d(decoder[-1][-1], out_channels, 3, padding=1)

    @property
    def convolutions(self) -> list[nn.Conv2d]:
        """All convolutions, in the order of the library's archives."""
        return [layer for layer in self.modules() if isinstance(layer, nn.Conv2d)]

    @property
    def reach(self) -> int:
        """Largest distance between a pixel of the result and an input pixel that it depends on."""
        levels = [*range(_LEVELS), *range(_LEVELS - 2, -1, -1)]
        counts = [len(widths) for part in _SIZES[self.size] for widths in part]
        convolutions: int = sum(count << level for count, level in zip(counts, levels, strict=True))
        return convolutions + 1 + _MULTIPLE - 1

    @property
    def live(self) -> Live:
        """What it holds at its peak."""
        return Live(2 * _SIZES[self.size].decoder[-2][-1], _LIVE_IMAGES)

    def forward(self, x: Tensor) -> Tensor:
        """Predict.

        Args:
            x: ``(B, in_channels, H, W)``.

        Returns:
            ``(B, out_channels, H, W)``, at least in float32: on a logarithmic scale of radiance, half a percent is less
            than bfloat16 resolves.
        """
        height, width = x.shape[-2:]
        x = up_to_multiple(x, _MULTIPLE)
        x = channels_last(x, computing_dtype(x))
        # The first channels are those of the image; what follows is of the same size as the other results.
        near, skips = x[:, : self.last.out_channels], [x]
        for level, block in enumerate(self.encoder):
            x = block(x)
            if level < _LEVELS - 1:
                x = halved(x)
                skips.append(x)
        # The coarsest level is the result of the last pooling.
        skips.pop()
        for block in self.decoder:
            x = block(x, skips.pop())
        return corner(convolved_in_float32(x, self.last, near), height, width)


class FeatureFilter(nn.Module):
    """The network for a single feature, from noisy to clean.

    Args:
        name: "albedo" or "normal".
        size: see :class:`OidnUNet`; the library has "base" and "large".
    """

    def __init__(self, name: str, size: Size = "base") -> None:
        super().__init__()
        self.name = name
        self.unet = OidnUNet(3, size)

    def forward(self, image: Tensor) -> Tensor:
        """Filter ``(B, 3, H, W)``: an albedo on the scale of sRGB, a normal from -1 to 1."""
        # All of kornia comes with it, which takes as long to import as a single frame to denoise.
        from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb

        if self.name == "albedo":
            clean: Tensor = rgb_to_linear_rgb(self.unet(linear_rgb_to_rgb(image.clamp(0, 1))).clamp(0, 1))
        else:
            clean = 2 * self.unet(image.clamp(-1, 1) * 0.5 + 0.5).clamp(0, 1) - 1
        return clean.to(image.dtype)


def _block(in_channels: int, widths: tuple[int, ...]) -> ConvBlock:
    layers: list[nn.Module] = []
    for entering, leaving in itertools.pairwise([in_channels, *widths]):
        layers += [nn.Conv2d(entering, leaving, 3, padding=1), nn.ReLU(inplace=True)]
        nn.init.kaiming_normal_(layers[-2].weight, nonlinearity="relu")  # type: ignore[arg-type]
        nn.init.zeros_(layers[-2].bias)  # type: ignore[arg-type]
    return ConvBlock(*layers)


def oidn_exposure(color: Tensor) -> Tensor:
    """The factor by which Open Image Denoise scales an image's radiance.

    ``0.18 / exp2(mean(log2(luminance)))`` over the means of bins of about 16x16 pixels, without black ones. In an image
    whose mean is below 1, what counts as black falls with the mean, unlike in the library, which takes a dim image for
    a black one.

    Args:
        color: ``(B, 3, H, W)`` radiance.

    Returns:
        ``(B, 1, 1, 1)``, positive, at least in float32. A black image counts as one of 1e-30, so that what a network
        sees in it, divided by the exposure, is none. It has no gradient.
    """
    color = color.detach().to(torch.promote_types(color.dtype, torch.float32))
    weights = numbers_like(color, _LUMINANCE).reshape(1, _COLORS, 1, 1)
    luminance = (color * weights).sum(1, keepdim=True)
    bins = _binned(_binned(luminance, 2), 3)
    dark = _DARK * bins.mean((1, 2, 3), keepdim=True).clamp(_LEAST, 1.0)
    lit = bins > dark
    count = lit.sum((1, 2, 3), keepdim=True)
    mean = torch.where(lit, torch.log2(bins.maximum(dark)), 0).sum((1, 2, 3), keepdim=True) / count.clamp_min(1)
    return _KEY / torch.where(count > 0, torch.exp2(mean), _LEAST)


def _binned(image: Tensor, axis: int) -> Tensor:
    """Means over equal parts of an axis, as sums: autocast would round a matrix product to half precision."""
    side = image.shape[axis]
    count = parts_of(side, _BIN)
    edges = torch.arange(count + 1, device=image.device) * side // count
    # The part between whose edges a pixel lies: i >= floor(b side / count) if and only if b < (i + 1) count / side.
    part = (torch.arange(1, side + 1, device=image.device) * count - 1) // side
    shape = [size if each != axis else count for each, size in enumerate(image.shape)]
    sizes = edges.diff().reshape([-1 if each == axis else 1 for each in range(4)])
    return image.new_zeros(shape).index_add(axis, part, image) / sizes
