"""The cascaded pixel-kernel network, and by composition K, P, K+P, K+K and P+K.

``cascaded`` has the paper's sizes. ``cascaded_small`` (widths 16 and 32, 0.41 of the multiply-adds) and
``cascaded_tiny`` (width 16, 3x3 kernels, 0.18 of them) are the same network for processors on which it is too slow, and
``cascaded_micro`` (0.08 of them) is one whose U-Nets begin at half the resolution.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple, Protocol

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from mcdenoise.models._regions import Region, halved, regions
from mcdenoise.models._registry import register_model
from mcdenoise.models.unet import Head, UNet
from mcdenoise.ops import cross_bilateral_filter, downsample
from mcdenoise.ops._backend import one_backend
from mcdenoise.ops._rows import by_rows
from mcdenoise.ops._steps.network import (
    BLOCK,
    depth_scale,
    gated_fusion,
    low_frequencies_of,
    network_features,
    network_input,
    normalized_depth,
    softplus,
)

FEATURES = 11  # albedo 3, normal 3, depth 1; and of the history: the frame alone 3, its share 1
SCALE_UNITS = (10.0, 1000.0, 1.0)  # of f1, f2, f3
GUIDES = ("normal", "depth")
# Numbers that are alive at once for each pixel of a part, measured: of a U-Net, in widths (what is concatenated, its
# convolutions, and a third for the coarser levels); and of images and features, which are never rounded.
_UNET_WIDTHS, _IMAGES = 4.5, 54


class Denoised(NamedTuple):
    """What a cascade returns.

    Args:
        initial: ``(B, 3, H, W)`` result of the first network, the paper's R'.
        final: ``(B, 3, H, W)`` result of the whole cascade, the paper's R''.
    """

    initial: Tensor
    final: Tensor


class Known(NamedTuple):
    """Pixels whose result is known beforehand.

    Args:
        mask: ``(B, 1, H, W)`` bool, true where it is.
        initial: ``(B, 3, H, W)`` the initial image there, demodulated radiance; anything finite elsewhere.
        final: ``(B, 3, H, W)`` the final image there.
    """

    mask: Tensor
    initial: Tensor
    final: Tensor


class Predictor(Protocol):
    """A network that takes an image and guiding features and returns a better image."""

    def __call__(
        self, image: Tensor, features: Tensor, guides: Collection[str] = GUIDES, top: Tensor | None = None
    ) -> Tensor:
        """Better an image, or a part of one.

        Args:
            image: ``(B, 3, H, W)`` radiance.
            features: ``(B, 11, H, W)``.
            guides: which of :data:`GUIDES` differ from pixel to pixel; weights need no others.
            top: ``(B, 1, 1, 1)`` largest logarithm of the radiance of the whole image; that of ``image`` by default.

        Returns:
            ``(B, 3, H, W)`` radiance.
        """

    @property
    def reach(self) -> int:
        """How far from a pixel its result may depend on the image and the features, in pixels."""


class FusionModule(nn.Module):
    """FM of the paper's Fig. 2: predicts the blending weight of Eq. 2 from both images, and blends.

    ``alpha = sigmoid(conv3x3([i_f, U i_c]))``. The images are logarithms of radiance: in linear radiance the low
    frequencies of a lamp, exchanged between scales, would drag the pixels beside it far below zero.
    """

    def __init__(self) -> None:
        super().__init__()
        self.conv = nn.Conv2d(6, 1, 3, padding=1)

    def forward(
        self,
        fine: Tensor,
        coarse: Tensor,
        residual: Tensor | None = None,
        top: Tensor | None = None,
        logarithms: bool = False,
    ) -> Tensor:
        """Fuse two scales.

        Args:
            fine: ``(B, 3, H, W)``.
            coarse: ``(B, 3, ceil(H / 2), ceil(W / 2))``.
            residual: ``(B, 3, H, W)`` to be added to the fine image; none by default.
            logarithms: whether to take those of the fine image, which then is radiance.
            top: ``(B, 1, 1, 1)`` largest logarithm of the radiance of the result. With it, the result is radiance.

        Returns:
            ``(B, 3, H, W)`` logarithms of radiance, or radiance.
        """
        weight, bias = self.conv.parameters()
        return gated_fusion(fine, coarse, weight, bias, residual=residual, top=top, logarithms=logarithms)


class PixelPredictor(nn.Module):
    """P: predicts the image itself at three scales and fuses them, coarse to fine.

    Beside what it makes of the noisy pixels itself, its U-Net is given the logarithm of their means at each coarser
    scale: with one path a pixel most of the light of a dark surface is in few bright pixels, whose mean is easily taken
    of radiance, but not of its logarithm or of what a maximum leaves of it.

    Args:
        width: feature channels of the U-Net.
        half: whether it has no level at full resolution, and twice the width at all coarser ones than the finest.
    """

    def __init__(self, width: int, half: bool = False) -> None:
        super().__init__()
        self.unet = _unet(width, half, coarse_channels=3)
        self.heads = nn.ModuleList(Head(self.unet, scale, 3) for scale in range(UNet.scales))
        self.fusions = nn.ModuleList(FusionModule() for _ in range(UNet.scales - 1))
        for head in self.heads:
            nn.init.zeros_(head.weight)  # type: ignore[arg-type]
            nn.init.zeros_(head.bias)  # type: ignore[arg-type]

    @property
    def reach(self) -> int:
        """See :class:`Predictor`."""
        return _reach(self.unet, 0)

    def forward(
        self, image: Tensor, features: Tensor, guides: Collection[str] = GUIDES, top: Tensor | None = None
    ) -> Tensor:
        """See :class:`Predictor`; there are no weights to guide."""
        logs = torch.log1p(image)
        means: list[Tensor] = []
        for _ in range(1, self.unet.stride):
            image = downsample(image)
        for _ in range(self.unet.levels - 1):
            image = downsample(image)
            means.append(torch.log1p(image))
        levels = self.unet(network_input(logs, features, logarithms=False), means)
        # The heads predict the logarithm of the radiance, on top of the input's: a network at rest is the identity,
        # and errors are relative, as the eye and the loss see them. No pixel grows beyond the brightest of the input.
        top = logs.amax((1, 2, 3), keepdim=True) if top is None else top
        scales = [logs]
        for _ in levels[1:]:
            scales.append(downsample(scales[-1]))
        residuals = [
            head(level, scale.shape[-2:]) for head, level, scale in zip(self.heads, levels, scales, strict=True)
        ]
        return _fuse(scales, residuals, self.fusions, top)


class KernelPredictor(nn.Module):
    """K: predicts kernels at three scales, filters the image's pyramid with them, and fuses, coarse to fine.

    With bilateral weights each scale has ``K*K + 3`` channels (28 in the paper): the kernel's logits and the scales
    f1 (normal), f2 (depth) and f3 (distance) of Eqs. 5-8, kept non-negative by a softplus and counted in units in which
    1 is a plausible value: normals and depths in [0, 1] differ by much less than pixel coordinates.

    Args:
        width: feature channels of the U-Net.
        kernel_size: K, 5 in the paper.
        bilateral: adjust the kernels by normal, depth and distance.
        half: as of :class:`PixelPredictor`.
    """

    def __init__(self, width: int, kernel_size: int = 5, bilateral: bool = True, half: bool = False) -> None:
        super().__init__()
        self.taps = kernel_size * kernel_size
        self.radius = kernel_size // 2
        self.bilateral = bilateral
        self.unet = _unet(width, half)
        channels = self.taps + (3 if bilateral else 0)
        self.heads = nn.ModuleList(Head(self.unet, scale, channels) for scale in range(UNet.scales))
        self.fusions = nn.ModuleList(FusionModule() for _ in range(UNet.scales - 1))

    @property
    def reach(self) -> int:
        """See :class:`Predictor`."""
        return _reach(self.unet, self.radius)

    def forward(
        self, image: Tensor, features: Tensor, guides: Collection[str] = GUIDES, top: Tensor | None = None
    ) -> Tensor:
        """See :class:`Predictor`."""
        # One for all scales: a part of an image must not be filtered otherwise than the whole.
        with one_backend(image):
            return self._predicted(image, features, guides, top)

    def _predicted(self, image: Tensor, features: Tensor, guides: Collection[str], top: Tensor | None) -> Tensor:
        levels = self.unet(network_input(image, features))
        guiding = {"normal": features[:, 3:6], "depth": features[:, 6:7]}
        guiding = {name: guide for name, guide in guiding.items() if name in guides}
        top = torch.log1p(image).amax((1, 2, 3), keepdim=True) if top is None else top
        scales: list[Tensor] = []
        for head, level in zip(self.heads, levels, strict=True):
            prediction = head(level, image.shape[-2:])
            logits = prediction[:, : self.taps]
            # A mean of radiance keeps the energy of a noisy image; a mean of logarithms would darken it.
            if self.bilateral:
                *falloffs, f3 = softplus(prediction[:, self.taps :], SCALE_UNITS).split(1, 1)
                falloffs = [falloff for falloff, name in zip(falloffs, GUIDES, strict=True) if name in guiding]
                filtered = cross_bilateral_filter(
                    image, logits, list(guiding.values()), falloffs, f3, border="renormalize"
                )
            else:
                filtered = cross_bilateral_filter(image, logits, border="renormalize")
            scales.append(filtered)
            if len(scales) < len(levels):
                image = downsample(image)
                guiding = {name: downsample(guide) for name, guide in guiding.items()}
        # Each scale is a weighted mean; their fusion could leave the range of the input.
        return _fuse(scales, None, self.fusions, top)


class Cascade(nn.Module):
    """One predictor after another: the second sees the first's image and the same features.

    Beside the paper's ten channels the networks see what accumulation did: the current frame alone, and how much of the
    accumulated image it is. So they can tell long histories from short ones, and lag from light.

    With several ``resolutions`` the first network, with the same weights, also denoises the image at half its size, at
    a quarter of it, and so on, and each size gives the next larger one its low frequencies (see
    ``low_frequencies_of``). A network sees no further than some 60 pixels. At one sample a pixel the mean of all of
    these is still noisy, and where light is sparse most of them are black.

    Args:
        first: predicts the initial image R'.
        second: predicts the final image R'' from R'; ``None`` makes the initial image the final one.
        resolutions: how many sizes of the image the first network denoises; 1 in the paper.
    """

    takes_history = True
    takes_plan = True

    def __init__(self, first: nn.Module, second: nn.Module | None = None, resolutions: int = 1) -> None:
        super().__init__()
        self.first = first
        self.second = second
        self.resolutions = resolutions

    def forward(
        self,
        color: Tensor,
        albedo: Tensor,
        normal: Tensor,
        depth: Tensor,
        current: Tensor | None = None,
        length: Tensor | None = None,
        *,
        guides: Collection[str] = GUIDES,
        known: Known | None = None,
        parts: list[Region] | None = None,
    ) -> Denoised:
        """Denoise one frame of any size.

        What is ``known`` is taken as it is, also by the second network, and only ``parts`` of the image are computed,
        each with as much around it as its pixels depend on. What depends on the whole image (exposure, depth, the
        brightest pixel) is computed on the whole image. So a result does not depend on which parts are computed, up to
        the rounding of convolutions, whose order of summation may depend on the size of the image. In small parts, a
        large image takes little more memory than its inputs and results.

        Args:
            color: ``(B, 3, H, W)`` demodulated accumulated radiance, scene-linear, finite, non-negative.
            albedo: ``(B, 3, H, W)`` in [0, 1].
            normal: ``(B, 3, H, W)`` world-space unit normals in [-1, 1].
            depth: ``(B, 1, H, W)`` distance along the view axis, scene units, ``inf`` where nothing was hit.
            current: ``(B, 3, H, W)`` demodulated radiance of the current frame alone; ``color`` by default.
            length: ``(B, 1, H, W)`` history length of ``color`` in frames, at least 1; 1 by default.
            guides: which of :data:`GUIDES` differ from pixel to pixel. Without the others the result is the same.
            known: pixels that need not be computed.
            parts: those of :meth:`parts`, or smaller ones (:meth:`Region.split`); the whole image by default.

        Returns:
            The initial and the final image, demodulated as ``color`` is.
        """
        whole = Region(0, 0, color.shape[-2], color.shape[-1])
        exposure = auto_exposure(color)
        alone = color if current is None else current
        # Both networks see the same, and often all of it at once.
        buffers = _Features(albedo, normal, depth, depth_scale(depth), alone, exposure, length)
        features = functools.lru_cache(maxsize=1)(buffers.of)
        if known is None and (parts is None or parts == [whole]):
            image = color * exposure
            top = _top(image)
            coarse = self._coarse(image, buffers, guides, top, [whole], self.resolutions)
            initial = self.first(image, features(whole), guides, top)
            if coarse is not None:
                initial = low_frequencies_of(initial, coarse, top)
            final = initial if self.second is None else self.second(initial, features(whole), guides, _top(initial))
            return Denoised(initial / exposure, final / exposure)
        if known is None:
            known = Known(torch.zeros_like(depth[..., :1, :1], dtype=torch.bool).expand_as(depth), color, color)
        parts = [whole] if parts is None else parts
        coarse = self._coarse(color, buffers, guides, _top(color, exposure), parts, self.resolutions, exposure)
        better = functools.partial(self._completed, features, guides, known.mask, parts)
        exposed = better(self.first, color, known.initial * exposure, exposure, coarse=coarse)
        del coarse
        final = None
        if self.second is not None:
            final = better(self.second, exposed, known.final.clone(), divisor=exposure)
        initial = by_rows(lambda mask, given, image: torch.where(mask, given, image / exposure), *known[:2], exposed)
        return Denoised(initial, by_rows(torch.where, known.mask, known.final, initial) if final is None else final)

    def parts(self, known: Tensor) -> list[Region]:
        """The rectangles to compute; the whole image where less would hardly pay, none where everything is known.

        Args:
            known: ``(B, 1, H, W)`` bool.
        """
        return regions(~known, self.halo)

    @property
    def halo(self) -> int:
        """Margin around a rectangle without which its pixels would not be the same, in pixels."""
        multiple = max((module.multiple for module in self.modules() if isinstance(module, UNet)), default=1)
        reach = max(int(part.reach) for part in (self.first, self.second) if part is not None)  # type: ignore[arg-type]
        # Means are interpolated between neighbouring blocks.
        reach = max(reach, int(self.first.reach) + BLOCK) if self.resolutions > 1 else reach  # type: ignore[arg-type]
        return -(-reach // multiple) * multiple

    def bytes_per_pixel(self, *, bfloat16: bool) -> float:
        """Memory that a part takes while it is computed, for each of its pixels with those around it.

        Args:
            bfloat16: whether convolutions are in bfloat16, else in float32.
        """
        width = max((module.width for module in self.modules() if isinstance(module, UNet)), default=0)
        return _UNET_WIDTHS * width * (2 if bfloat16 else 4) + _IMAGES * 4

    def _coarse(
        self,
        image: Tensor,
        buffers: _Features,
        guides: Collection[str],
        top: Tensor,
        parts: list[Region],
        resolutions: int,
        factor: Tensor | float = 1.0,
    ) -> Tensor | None:
        """The initial image at half the size of ``image * factor``, at least where ``parts`` of that depend on it."""
        parts = halved(parts, BLOCK, (image.shape[-2], image.shape[-1]))
        if resolutions == 1 or not parts:
            return None
        image, buffers = downsample(image) * factor, buffers.halved()
        coarse = self._coarse(image, buffers, guides, top, parts, resolutions - 1)
        whole = Region(0, 0, image.shape[-2], image.shape[-1])
        result = image
        for part in parts:
            around = part.grown(self.halo, (whole.bottom, whole.right))
            better: Tensor = self.first(around.of(image), buffers.of(around), guides, top)
            if coarse is not None:
                better = low_frequencies_of(better, around.halved().of(coarse), top)
            if part == whole:
                return better
            if result is image:
                result = torch.zeros_like(image, dtype=better.dtype)
            part.of(result).copy_(part.within(around).of(better))
        return result

    def _completed(
        self,
        features: Callable[[Region], Tensor],
        guides: Collection[str],
        known: Tensor,
        parts: list[Region],
        predictor: nn.Module,
        image: Tensor,
        result: Tensor,
        factor: Tensor | float = 1.0,
        divisor: Tensor | float = 1.0,
        coarse: Tensor | None = None,
    ) -> Tensor:
        """``result``, with the pixels that are not known computed: ``predictor(image * factor) / divisor``.

        Low frequencies are those of the ``coarse`` image, if there is one.
        """
        top = _top(image, factor)
        for part in parts:
            around = part.grown(self.halo, (image.shape[-2], image.shape[-1]))
            better = predictor(around.of(image) * factor, features(around), guides, top)
            if coarse is not None:
                better = low_frequencies_of(better, around.halved().of(coarse), top)
            there = part.of(result)
            there.copy_(torch.where(part.of(known), there, part.within(around).of(better) / divisor))
        return result


class _Features(NamedTuple):
    """The buffers of an image, and what the features of its parts have in common."""

    albedo: Tensor
    normal: Tensor
    depth: Tensor
    depth_scale: tuple[Tensor, Tensor]
    current: Tensor
    exposure: Tensor
    length: Tensor | None

    def of(self, part: Region) -> Tensor:
        """The features of a part, ``(B, 11, h, w)``."""
        length = None if self.length is None else part.of(self.length)
        albedo, normal, depth, current = map(part.of, (self.albedo, self.normal, self.depth, self.current))
        return network_features(albedo, normal, depth, current, length, self.exposure, self.depth_scale)

    def halved(self) -> _Features:
        """Those of the image at half its size."""
        albedo, normal, depth, current = map(downsample, (self.albedo, self.normal, self.depth, self.current))
        length = None if self.length is None else downsample(self.length)
        return _Features(albedo, normal, depth, self.depth_scale, current, self.exposure, length)


def auto_exposure(color: Tensor, key: float = 0.5) -> Tensor:
    """The factor that brings an image's typical radiance to ``key``, so that no network depends on a scene's unit.

    ``key / exp(mean(log(blocks)))`` over the means of 16x16-pixel blocks: a block mean is hardly moved by the noise,
    the logarithm by a lamp in view.

    Args:
        color: ``(B, C, H, W)`` radiance up to 1e35; what is below 1e-30 counts as that.
        key: radiance that the typical block is brought to.

    Returns:
        ``(B, 1, 1, 1)`` positive factor; 1 for a black image. The factor has no gradient.
    """
    luminance = _at_least_float32(color.detach()).mean(1, keepdim=True)
    blocks = F.avg_pool2d(luminance, 16, ceil_mode=True, count_include_pad=False)
    mean = blocks.mean((1, 2, 3), keepdim=True)
    lit = mean > 0
    # Of the mean, so that the logarithms are small numbers at any exposure. Black blocks count as a thousandth of it.
    shares = (blocks / torch.where(lit, mean, 1)).clamp_min(1e-3)
    typical = (mean * torch.exp(torch.log(shares).mean((1, 2, 3), keepdim=True))).clamp_min(1e-30)
    return torch.where(lit, key / typical, 1).to(color.dtype)


def normalize_depth(depth: Tensor) -> Tensor:
    """Depth in [0, 1), whatever the scene's unit: ``d / (d + typical d)``, and 1 where nothing was hit.

    Args:
        depth: ``(B, 1, H, W)`` distance, scene units, ``inf`` where nothing was hit.

    Returns:
        ``(B, 1, H, W)`` in [0, 1]. The typical depth is the image's geometric mean over what was hit.
    """
    return normalized_depth(depth, *depth_scale(depth))


def _top(image: Tensor, factor: Tensor | float = 1.0) -> Tensor:
    """The logarithm of the brightest of ``image * factor``, ``(B, 1, 1, 1)``."""
    return torch.log1p(image.amax((1, 2, 3), keepdim=True) * factor)


def _at_least_float32(tensor: Tensor) -> Tensor:
    """Half precision as float32, float64 as it is: the shipped weights also run in float64, to measure what rounds."""
    return tensor.to(torch.promote_types(tensor.dtype, torch.float32))


def _unet(width: int, half: bool, coarse_channels: int = 0) -> UNet:
    if not half:
        return UNet(3 + FEATURES, width, coarse_channels=coarse_channels)
    return UNet(3 + FEATURES, width, 3, coarse_channels, coarse_width=2 * width, half=True)


def _reach(unet: UNet, radius: int) -> int:
    """Of a head, a filter and the fusions behind a U-Net: a pixel each, and the filter's radius, at their scales."""
    fusions = sum(1 << scale for scale in range(UNet.scales - 1))
    heads = (max(1 << scale, unet.stride) for scale in range(UNet.scales))
    return max(unet.reach(scale) + head + (radius << scale) for scale, head in enumerate(heads)) + fusions


def _fuse(images: Sequence[Tensor], residuals: Sequence[Tensor] | None, fusions: nn.ModuleList, top: Tensor) -> Tensor:
    """All scales, finest first, to radiance up to ``top``: radiance, or logarithms of it and what to add to them."""
    radiance = residuals is None
    fused = torch.log1p(images[-1]) if residuals is None else _at_least_float32(residuals[-1]) + images[-1]
    for scale, fusion in zip(range(len(fusions) - 1, -1, -1), fusions, strict=True):
        residual = None if residuals is None else residuals[scale]
        fused = fusion(images[scale], fused, residual, None if scale else top, logarithms=radiance)
    return fused


def _register(
    name: str,
    cascade: str,
    bilateral: bool,
    width: int,
    kernel_width: int | None = None,
    kernel_size: int = 5,
    resolutions: int = 1,
    half: bool = False,
) -> None:
    """Enter the cascade spelt as in the paper's Table 3, such as ``P+K``; its K may have a width of its own."""

    def construct(
        width: int = width, kernel_width: int | None = kernel_width, kernel_size: int = kernel_size
    ) -> Cascade:
        parts = [
            PixelPredictor(width, half)
            if part == "P"
            else KernelPredictor(kernel_width or width, kernel_size, bilateral, half)
            for part in cascade.split("+")
        ]
        return Cascade(parts[0], parts[1] if len(parts) > 1 else None, resolutions)

    widths = f"widths {width} and {kernel_width}" if kernel_width else f"width {width}"
    kernels = f"{kernel_size}x{kernel_size} kernels, {'with' if bilateral else 'without'} bilateral weights"
    note = ", no level at full resolution" if half else ""
    construct.__doc__ = f"{cascade}, {widths}{f', {kernels}' if 'K' in cascade else ''}{note}."
    register_model(name)(construct)


_register("cascaded", "P+K", bilateral=True, width=40, resolutions=3)
_register("cascaded_small", "P+K", bilateral=True, width=16, kernel_width=32, resolutions=3)
_register("cascaded_tiny", "P+K", bilateral=True, width=16, kernel_size=3, resolutions=3)
_register("cascaded_micro", "P+K", bilateral=True, width=16, kernel_size=3, resolutions=3, half=True)
_register("cascaded_plain", "P+K", bilateral=False, width=40)
_register("pixel", "P", bilateral=False, width=64)
_register("kernel", "K", bilateral=True, width=64)
_register("kernel_plain", "K", bilateral=False, width=64)
_register("kernel_pixel", "K+P", bilateral=True, width=40)
_register("kernel_pixel_plain", "K+P", bilateral=False, width=40)
_register("kernel_kernel", "K+K", bilateral=True, width=40)
_register("kernel_kernel_plain", "K+K", bilateral=False, width=40)
