"""Neural partitioning pyramids: a network partitions each pixel's light among five scales and splats it there.

Balint et al. 2023, "Neural Partitioning Pyramids for Denoising Monte Carlo Renderings", SIGGRAPH, and its public code
(balintio/nppd), whose steps, layers and weights this file follows. The steps are:

1. warp the state of the previous frame to the current one: the mean radiance ``c'``, the result ``o'``, the features
   ``f'``;
2. encode every sample and average: ``f = mean_s E(depth, normal, albedo, log(1 + radiance / mean radiance))``;
3. predict all weights from ``log(1 + (c', c) / mean of both)``, ``f'`` and ``f``: 6 + 32 + 32 = 70 channels;
4. ``c <- lambda c' + (1 - lambda) c`` and ``f <- lambda f' + (1 - lambda) f`` with one sigmoid ``lambda`` per pixel;
5. partition ``c`` among K = 5 levels by a softmax, average each part down to its level, splat it there by a 5x5
   softmax, and sum from coarse to fine, upsampling by 4x4 weights that are 4 times a softmax;
6. splat ``o'`` by a 5x5 softmax, and blend by a sigmoid: ``o = mu o' + (1 - mu) d``.

The radiance includes its albedo. Each pixel splats all of its light, but the weights that a pixel receives need not sum
to one: a splat is not a mean. Only training makes a constant image stay constant.

Choices where the code depends on its data set or its user:

- image sizes that are not multiples of 32: the network takes the image with repeated edges, the pyramid only the image,
  and the predicted weights are cropped;
- samples: those of ``frame.samples``, radiance only, each with the features of its pixel; without them the color is the
  only sample. The published networks are trained on 2, 4, 8 or 32 samples;
- depth in [0, 1] (:func:`mcdenoise.nn.normalize_depth`) instead of the scaling by the data set's reader; normals as in
  the frame;
- history outside the image is zero, as before the first frame. At the image border (:func:`mcdenoise.ops.reproject`) it
  is the mean of the valid taps, where the code blends with black. Surfaces are not compared: lambda and mu are
  predicted from the warped features instead;
- the code adds 1e-8 to a mean radiance; here nothing is added, so that the unit of radiance does not matter;
- taps of a splat are numbered by destination; in the code by source, which only permutes channels.

As in the code, light that is splatted outside the image is lost, and the network learns to avoid that.

The authors train with ``2 SMAPE`` in space, ``0.2 SMAPE`` of differences to the warped previous frame, and ``0.025``
times a perceptual loss in each, on two frames at a time without gradients through the state, by Adam at 1e-4 with a
decay of 0.94 per epoch. The trainer here uses SMAPE in space, and in time without warping, over whole clips.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mcdenoise.errors import InputError, check_choice
from mcdenoise.frame import MOTION, Frame
from mcdenoise.models._history import Past, reprojected
from mcdenoise.models._interface import GUIDES, Needs, Note, Output, State
from mcdenoise.models._layers import answered, carried
from mcdenoise.models._registry import register_model
from mcdenoise.models.tiled import MIRRORED, with_border, without_border
from mcdenoise.nn.inputs import features_of, normalize_depth
from mcdenoise.nn.samples import describe_samples, samples_of
from mcdenoise.ops import kernel_splat, learned_upsample, pyramid_partition
from mcdenoise.ops._window import corner, parts_of, up_to_multiple

Backbone = Literal["convunet", "convunext"]

LEVELS = 5  # K
FEATURES = 32  # per sample
_SPLAT, _UPSAMPLE = 5**2, 4**2
_SLOPE = 0.3  # of the leaky ReLUs
# Names and channels of the predictions at the finest scale, in order, and at each coarser one: 57 and 41 channels.
_FINE = {"splat": _SPLAT, "previous": _SPLAT, "mu": 1, "lambda": 1, "partition": LEVELS}
_COARSE = {"splat": _SPLAT, "upsample": _UPSAMPLE}


class ConvUNet(nn.Module):
    """The small network of the code: a U-Net of 3x3 convolutions, max-pooling, and nearest-neighbour upsampling.

    Args:
        in_channels: number of input channels.
        out_channels: number of channels predicted at each scale, the finest first, by 1x1 convolutions.
        width: feature channels of the finest level, the published 96; the six levels have 3, 3, 4, 6, 8, 12 and 16
            thirds of it. The encoder has one convolution more per level than the decoder.
    """

    multiple = 32  # side of a pixel of the coarsest level

    def __init__(self, in_channels: int, out_channels: Sequence[int], width: int) -> None:
        super().__init__()
        # 96, 128, 192, 256, 384, 512 as published.
        widths = [round(width * thirds / 3) for thirds in (3, 4, 6, 8, 12, 16)]
        finer = [widths[0], *widths[:-1]]
        *above, (before, bottom) = zip(finer, widths, strict=True)
        entering = [in_channels, *widths[:-1]]
        self.down = nn.ModuleList(
            _convolutions(channels, *each)
            for channels, each in zip(entering, [*above, (bottom, bottom, before)], strict=True)
        )
        # Each decoder level ends with as many features as the next finer level has.
        self.up = nn.ModuleList(_convolutions(2 * own, own, ending) for ending, own in above)
        self.heads = nn.ModuleList(
            nn.Conv2d(ending, channels, 1) for (ending, _), channels in zip(above, out_channels, strict=True)
        )

    def forward(self, x: Tensor) -> list[Tensor]:
        """Predict.

        Args:
            x: ``(B, in_channels, H, W)``, height and width multiples of 32.

        Returns:
            ``(B, out_channels[i], H / 2^i, W / 2^i)``.
        """
        levels: list[Tensor] = []
        for level, block in enumerate(self.down):
            x = block(x if level == 0 else F.max_pool2d(x, 2))
            levels.append(x)
        predicted: list[Tensor] = []
        for level in reversed(range(len(self.up))):
            x = self.up[level](torch.cat([F.interpolate(x, scale_factor=2), levels[level]], 1))
            predicted.append(self.heads[level](x))
        return predicted[::-1]


class ConvUNeXt(nn.Module):
    """The large network of the code: ConvNeXt blocks (Liu et al. 2022); 2x2 pixels become channels and back.

    Args:
        in_channels: number of input channels.
        out_channels: number of channels predicted at each scale, the finest first, by 1x1 convolutions.
        width: feature channels of the finest level, the published 128, a multiple of 4; the five levels have 1, 1, 2, 2
            and 4 times it.
    """

    multiple = 16  # side of a pixel of the coarsest level

    def __init__(self, in_channels: int, out_channels: Sequence[int], width: int) -> None:
        super().__init__()
        widths, depths = [width, width, 2 * width, 2 * width, 4 * width], (4, 4, 6, 6, 8)
        entering = [in_channels, *(4 * each for each in widths[:-1])]
        coming = [each // 4 + own for own, each in itertools.pairwise(widths)]
        self.down = nn.ModuleList(_blocks(*each) for each in zip(entering, widths, depths, strict=True))
        self.up = nn.ModuleList(_blocks(*each) for each in zip(coming, widths[:-1], depths[:-1], strict=True))
        self.heads = nn.ModuleList(nn.Conv2d(*each, 1) for each in zip(widths, out_channels, strict=True))

    def forward(self, x: Tensor) -> list[Tensor]:
        """See :meth:`ConvUNet.forward`; sizes are multiples of 16."""
        levels: list[Tensor] = []
        for level, block in enumerate(self.down):
            x = block(x if level == 0 else F.pixel_unshuffle(x, 2))
            levels.append(x)
        predicted = [self.heads[-1](x)]
        for level in reversed(range(len(self.up))):
            x = self.up[level](torch.cat([F.pixel_shuffle(x, 2), levels[level]], 1))
            predicted.append(self.heads[level](x))
        return predicted[::-1]


class _Block(nn.Module):
    """A ConvNeXt residual block: depthwise 7x7 convolution, layer norm, and a pixelwise MLP of four times the width."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.spatial = nn.Conv2d(width, width, 7, padding=3, groups=width)
        self.norm = nn.LayerNorm(width, eps=1e-6)
        self.wide, self.narrow = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)
        self.scale = nn.Parameter(torch.full((width,), 1e-6))

    def forward(self, x: Tensor) -> Tensor:
        pixels: Tensor = self.norm(self.spatial(x).movedim(1, -1))
        pixels = self.scale * self.narrow(F.gelu(self.wide(pixels)))
        return x + pixels.movedim(-1, 1)


class Nppd(nn.Module):
    """The method, see the module's docstring.

    Args:
        width: feature channels of the network.
        backbone: type of the network.
    """

    # Means of the whole image and the history allow no tiles.
    needs = Needs(uses=MOTION | GUIDES | {"samples", "view_projection"})
    persistence = None  # the network learns what to remember

    def __init__(self, width: int, backbone: Backbone) -> None:
        super().__init__()
        self.encoder = nn.Sequential(
            nn.Conv2d(10, FEATURES, 1),
            nn.LeakyReLU(_SLOPE),
            nn.Conv2d(FEATURES, FEATURES, 1),
            nn.LeakyReLU(_SLOPE),
            nn.Conv2d(FEATURES, FEATURES, 1),
        )
        predicted = [sum(_FINE.values())] + [sum(_COARSE.values())] * (LEVELS - 1)
        network = ConvUNet if backbone == "convunet" else ConvUNeXt
        self.network: ConvUNet | ConvUNeXt = network(6 + 2 * FEATURES, predicted, width)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        frame = frame.with_depth()
        dtype = torch.promote_types(frame.color.dtype, torch.float32)
        radiance, others = frame.color.to(dtype), carried(frame)
        if others is not None:
            # The result of the ones is the sum of all weights.
            radiance = torch.cat([radiance, others.to(dtype), torch.ones_like(radiance[:, :1])], 1)
        sizes = [radiance.shape[1], radiance.shape[1], FEATURES]
        warped, _, notes = reprojected(frame, state, sum(sizes), "nppd")  #                                         1.
        mean_before, image_before, features_before = warped.to(dtype).split(sizes, 1)
        features = self._encoded(frame, dtype)  #                                                                   2.
        both = torch.cat([mean_before[:, :3], radiance[:, :3]], 1)
        # As in Tiled, there is a mirror image around the image, except in training.
        border = 0 if self.training else MIRRORED
        radiance, mean_before, image_before, features, features_before, both = (
            with_border(image, border)
            for image in (radiance, mean_before, image_before, features, features_before, _logarithm(both))
        )
        fine, coarse = self._weights(torch.cat([both, features_before, features], 1))  #                            3.
        trust, mix = torch.sigmoid(fine["lambda"]), torch.sigmoid(fine["mu"])
        radiance = torch.lerp(radiance, mean_before, trust)  #                                                      4.
        features = torch.lerp(features, features_before, trust)
        denoised = _denoised(radiance, fine, coarse)  #                                                             5.
        image = torch.lerp(denoised, _splatted(image_before, fine["previous"]), mix)  #                             6.
        radiance, image, features = (without_border(each, border) for each in (radiance, image, features))
        stages = {"accumulated": radiance[:, :3].to(frame.color.dtype)}
        result = image[:, :3].to(frame.color.dtype)
        output = answered(frame, result, None if others is None else _mean(image[:, 3:]))._replace(stages=stages)
        kept = Past.of(frame, torch.cat([radiance, image, features], 1), surfaces=False)
        return output.noted(*notes, Note("samples", describe_samples(frame))), kept

    def _encoded(self, frame: Frame, dtype: torch.dtype) -> Tensor:
        """The mean of the samples' features."""
        samples = samples_of(frame).to(dtype)
        albedo, normal, depth = features_of(frame)
        pixel = torch.cat([normalize_depth(depth), normal, albedo], 1).to(dtype)
        count = samples.shape[1]
        seen = torch.cat([pixel[:, None].expand(-1, count, -1, -1, -1), _logarithm(samples)], 2)
        encoded: Tensor = self.encoder(seen.flatten(0, 1)).to(dtype)
        return torch.unflatten(encoded, 0, (-1, count)).mean(1)

    def _weights(self, seen: Tensor) -> tuple[dict[str, Tensor], list[dict[str, Tensor]]]:
        """Predicted weights at the finest scale, and at each coarser one."""
        height, width = seen.shape[-2:]
        predicted = self.network(up_to_multiple(seen, self.network.multiple, mode="replicate"))
        found = []
        for level, weights in enumerate(predicted):
            side = 1 << level
            names = _COARSE if level else _FINE
            cut = corner(weights, parts_of(height, side), parts_of(width, side)).to(seen.dtype)
            found.append(dict(zip(names, cut.split(list(names.values()), 1), strict=True)))
        return found[0], found[1:]


def _logarithm(radiance: Tensor) -> Tensor:
    """``log(1 + x / mean x)`` of each image or stack of images."""
    mean = radiance.mean(tuple(range(1, radiance.dim())), keepdim=True)
    return torch.log1p(radiance / torch.where(mean > 0, mean, 1))


def _mean(filtered: Tensor) -> Tensor:
    """Divide filtered images by their last channel, the sum of the weights, so that an alpha of one stays one."""
    total = filtered[:, -1:]
    return filtered[:, :-1] / torch.where(total > 0, total, 1)


def _denoised(radiance: Tensor, fine: dict[str, Tensor], coarse: list[dict[str, Tensor]]) -> Tensor:
    """The pyramid: partition and average down, splat, and sum from coarse to fine."""
    parts = pyramid_partition(radiance, fine["partition"])
    splatted = [_splatted(part, weights["splat"]) for part, weights in zip(parts, (fine, *coarse), strict=True)]
    denoised = splatted.pop()
    for part, weights in zip(reversed(splatted), reversed(coarse), strict=True):
        kernel = 4 * torch.softmax(weights["upsample"], 1)
        denoised = part + learned_upsample(denoised, kernel, (part.shape[-2], part.shape[-1]), border="zeros")
    return denoised


def _splatted(image: Tensor, logits: Tensor) -> Tensor:
    return kernel_splat(image, torch.softmax(logits, 1), border="zeros")


def _convolutions(entering: int, *widths: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for channels, width in zip((entering, *widths[:-1]), widths, strict=True):
        layers += [nn.Conv2d(channels, width, 3, padding=1), nn.LeakyReLU(_SLOPE)]
    return nn.Sequential(*layers)


def _blocks(entering: int, width: int, depth: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(entering, width, 1), *(_Block(width) for _ in range(depth)))


@register_model("nppd", kind="recurrent", paper="Balint et al. 2023")
def nppd(width: int = 18, backbone: Backbone = "convunet") -> Nppd:
    """Neural partitioning pyramids (Balint et al. 2023), recurrent; the published networks are larger (width 96, 128).

    Args:
        width: feature channels of the finest level. The published small network, for 2 and 4 samples per pixel, is
            ``"convunet"`` with 96; the large one, for 8 and 32, is ``"convunext"`` with 128.
        backbone: ``"convunet"`` or ``"convunext"``.

    Raises:
        InputError: the backbone is unknown or does not support this width.
    """
    check_choice("backbone", backbone, Backbone)
    step = 1 if backbone == "convunet" else 4
    if width < 1 or width % step:
        raise InputError(f"width: expected a positive multiple of {step} for {backbone}, found {width}")
    return Nppd(width, backbone)
