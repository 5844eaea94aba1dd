"""Embeddings of single samples: each sample is embedded separately, with its neighbourhood's context from a U-Net.

This is common to the methods of Gharbi et al. 2019 ("Sample-based Monte Carlo denoising using a kernel-splatting
network") and of Munkberg and Hasselgren 2020 ("Neural Denoising with Layer Embeddings").
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.light import LARGEST_RADIANCE
from mcdenoise.nn.inputs import unit_features_of
from mcdenoise.ops._window import accumulator_dtype, corner, up_to_multiple

# Logarithm of the radiance 3, albedo 3, normal 3, depth 1, and one over the number of averaged frames 1.
CHANNELS = 11
LEVELS = 3  # levels of a U-Net
PLANNED = 9  # number of samples per pixel for estimating memory: eight, and the history
SLOPE = 0.01  # negative slope of the leaky ReLU


def samples_of(frame: Frame) -> Tensor:
    """Radiance of the samples of each pixel.

    Without ``frame.samples`` the color is the only sample. Samples belong to the current frame, so an accumulated color
    (in a frame with ``length``) is one more sample, for the history.

    Returns:
        ``(B, S, 3, H, W)`` in the unit of ``frame.color``, from 0 to 1e16; NaN counts as 0.

    Raises:
        InputError: samples have fewer than three channels.
    """
    color = frame.color[:, None]
    if frame.samples is None:
        return color
    if frame.samples.shape[2] < 3:
        raise InputError(
            f"buffer 'samples': expected (B, S, C, H, W) with at least 3 channels, found {tuple(frame.samples.shape)}; "
            "the first three are radiance"
        )
    # ``Frame.validate`` does not check every value of the samples.
    light = frame.samples[:, :, :3].to(accumulator_dtype(color.dtype)).nan_to_num(0).clamp(0.0, LARGEST_RADIANCE)
    return light if frame.length is None else torch.cat([light, color.to(light.dtype)], 1)


def describe_samples(frame: Frame) -> str:
    """Describe the result of :func:`samples_of` for the report."""
    if frame.samples is None:
        return "none: the color is one sample of each pixel"
    return f"{frame.samples.shape[1]} of each pixel{'' if frame.length is None else ', and the history'}"


def samples_input(frame: Frame, samples: Tensor) -> Tensor:
    """The network input for each sample.

    Args:
        frame: with the features of each pixel.
        samples: ``(B, S, 3, H, W)``, see :func:`samples_of`.

    Returns:
        ``(B, S, 11, H, W)``: ``log1p`` of its radiance; albedo, normal and depth of the pixel, in [0, 1]; and 1, or one
        over the history length for the accumulated color.
    """
    batch, count, _, height, width = samples.shape
    features = torch.cat(unit_features_of(frame), 1).to(samples.dtype)
    fresh = torch.ones_like(samples[:, :, :1])
    if frame.length is not None:
        fresh = torch.cat([fresh[:, 1:], 1 / frame.length[:, None].to(samples.dtype)], 1)
    return torch.cat([torch.log1p(samples), features[:, None].expand(batch, count, -1, height, width), fresh], 2)


class SampleEmbedding(nn.Module):
    """Rounds of a chain of 1x1 convolutions on each sample, and a U-Net on the mean of the samples' embeddings.

    From the second round on, a chain also takes the pixel's context, the result of the previous round's U-Net. The
    result does not depend on the order of the samples, and their number is arbitrary.

    Args:
        in_channels: number of channels of a sample.
        width: channels of an embedding and of a context.
        rounds: number of rounds.
        convolutions: number of convolutions in each block of the U-Nets.
    """

    def __init__(self, in_channels: int, width: int, rounds: int, convolutions: int) -> None:
        super().__init__()
        for name, value in (("width", width), ("rounds", rounds), ("convolutions", convolutions)):
            if value < 1:
                raise InputError(f"{name}: expected at least 1, found {value}")
        entering = [in_channels] + [2 * width] * (rounds - 1)
        self.chains = nn.ModuleList(chain([first, width, width, width]) for first in entering)
        self.unets = nn.ModuleList(LeakyUNet(width, width, convolutions) for _ in range(rounds))

    def forward(self, samples: Tensor) -> tuple[Tensor, Tensor]:
        """Embeddings, and the last context.

        Args:
            samples: ``(B, S, in_channels, H, W)``.

        Returns:
            ``(B, S, width, H, W)`` and ``(B, width, H, W)``.
        """
        context: Tensor | None = None
        for embed, unet in zip(self.chains, self.unets, strict=True):
            samples = of_each(embed, samples if context is None else with_context(samples, context))
            context = unet(samples.mean(1))
        assert context is not None
        return samples, context


def with_context(samples: Tensor, context: Tensor) -> Tensor:
    """Concatenate each sample of a pixel with the pixel's context ``(B, D, H, W)``: ``(B, S, C + D, H, W)``."""
    return torch.cat([samples, context[:, None].expand(-1, samples.shape[1], -1, -1, -1)], 2)


def of_each(layer: nn.Module, samples: Tensor) -> Tensor:
    """Apply a layer for images to every sample ``(B, S, C, H, W)``."""
    batch, count = samples.shape[:2]
    result: Tensor = layer(samples.flatten(0, 1))
    return result.reshape(batch, count, *result.shape[1:])


def chain(widths: Sequence[int], *, linear: bool = False) -> nn.Sequential:
    """1x1 convolutions with leaky ReLU.

    Args:
        widths: number of input channels, and of the output channels of each convolution.
        linear: whether the last convolution has no leaky ReLU.
    """
    return _convolutions(widths, 1, linear=linear)


class LeakyUNet(nn.Module):
    """A U-Net of three levels, each twice as wide as the finer one.

    3x3 convolutions with leaky ReLU, 2x2 max-pooling on the way down, bilinear interpolation on the way up, followed by
    concatenation with the features of the same scale. Any image size: it is padded with zeros to a multiple of 4.

    Args:
        in_channels: number of input channels.
        width: channels of the finest level, and of the result.
        convolutions: number of convolutions per level, on the way down and on the way up.
    """

    multiple: int = 2 ** (LEVELS - 1)

    def __init__(self, in_channels: int, width: int, convolutions: int) -> None:
        super().__init__()
        widths = [width << level for level in range(LEVELS)]
        self.encoder = nn.ModuleList(
            _convolutions([before] + [after] * convolutions, 3)
            for before, after in itertools.pairwise([in_channels, *widths])
        )
        self.decoder = nn.ModuleList(
            _convolutions([coarse + fine] + [fine] * convolutions, 3)
            for coarse, fine in itertools.pairwise(widths[::-1])
        )

    @staticmethod
    def reach(convolutions: int) -> int:
        """Largest distance between a pixel of the result and an input pixel that it depends on."""
        down, up = range(LEVELS), range(LEVELS - 1)
        interpolated: int = sum(2 << level for level in up)
        convolved: int = sum(convolutions << level for level in (*down, *up))
        return convolved + interpolated + LeakyUNet.multiple - 1

    def forward(self, x: Tensor) -> Tensor:
        """Map ``(B, in_channels, H, W)`` to ``(B, width, H, W)``."""
        height, width = x.shape[-2:]
        x = up_to_multiple(x, self.multiple)
        skips: list[Tensor] = []
        for level, block in enumerate(self.encoder):
            x = block(F.max_pool2d(x, 2) if level else x)
            skips.append(x)
        x = skips.pop()
        for block in self.decoder:
            above = F.interpolate(x, scale_factor=2, mode="bilinear", align_corners=False)
            x = block(torch.cat([above, skips.pop()], 1))
        return corner(x, height, width)


def _convolutions(widths: Sequence[int], side: int, *, linear: bool = False) -> nn.Sequential:
    layers: list[nn.Module] = []
    for entering, leaving in itertools.pairwise(widths):
        convolution = nn.Conv2d(entering, leaving, side, padding=side // 2)
        nn.init.kaiming_normal_(convolution.weight, SLOPE)
        nn.init.zeros_(convolution.bias)  # type: ignore[arg-type]
        layers += [convolution, nn.LeakyReLU(SLOPE)]
    return nn.Sequential(*(layers[:-1] if linear else layers))
