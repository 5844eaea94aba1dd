"""Figures of the effect of operators on an image, drawn from one small picture when the site is made.

The picture has two walls, a chequered floor and a ball, in uniform light; every pixel has one sample of noise.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mcdenoise import ops
from mcdenoise.data.png import caption, enlarge, write_png
from mcdenoise.metrics import display_codes

HEIGHT, WIDTH, ZOOM = 60, 90, 3
Panels = dict[str, Tensor]


@dataclass(frozen=True)
class Figure:
    """A row of pictures.

    Args:
        text: what it shows, in a sentence.
        draw: makes its pictures, by caption.
    """

    text: str
    draw: Callable[[], Panels]


@dataclass(frozen=True)
class Scene:
    """The picture, its features, and a noisy rendering."""

    albedo: Tensor
    normal: Tensor
    depth: Tensor
    light: Tensor
    noisy: Tensor

    @property
    def clean(self) -> Tensor:
        """Albedo times light."""
        return self.albedo * self.light


@cache
def scene(seed: int = 0) -> Scene:
    """The picture with noise of a seed."""
    y, x = torch.meshgrid(torch.linspace(0, 1, HEIGHT), torch.linspace(0, 1.5, WIDTH), indexing="ij")
    floor = y > 0.62
    chequers = ((x * 8).floor() + (1 / (y - 0.4).clamp_min(0.1) * 3).floor()) % 2
    albedo = torch.where(floor, 0.25 + 0.5 * chequers, torch.where(x < 0.8, 0.7, 0.45)).expand(3, -1, -1).clone()
    albedo[2] *= torch.where(x < 0.8, 0.7, 1.0)
    normal = torch.zeros(3, HEIGHT, WIDTH)
    normal[1][floor], normal[2][~floor & (x < 0.8)], normal[0][~floor & (x >= 0.8)] = 1, 1, 1
    depth = torch.where(floor, 1.2 / (y - 0.3).clamp_min(0.2), 3.75)
    u, v = (x - 0.75) / 0.27, (y - 0.55) / 0.27
    ball = u.square() + v.square() < 1
    z = (1 - u.square() - v.square()).clamp_min(0).sqrt()
    normal = torch.where(ball, torch.stack([u, -v, z]), normal)
    depth = torch.where(ball, 2.0 - 0.4 * z, depth)
    albedo = torch.where(ball, torch.tensor([0.75, 0.35, 0.25]).reshape(3, 1, 1), albedo)
    light = torch.where(
        ball, 0.25 + 0.9 * (normal * torch.tensor([-0.5, 0.6, 0.6]).reshape(3, 1, 1)).sum(0).clamp_min(0), 0.8
    )
    light = light * (1 - 0.45 * torch.exp(-((x - 0.85).square() / 0.05 + (y - 0.83).square() / 0.004)))
    noise = torch.distributions.Gamma(0.6, 0.6)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        noisy = albedo * light * noise.sample((1, HEIGHT, WIDTH))
    return Scene(*(each[None] for each in (albedo, normal, depth[None], light.expand(3, -1, -1), noisy)))


def kernels(falloffs: tuple[float, float, float] = (8.0, 6.0, 0.03), size: int = 9) -> Tensor:
    """Cross-bilateral weights of the scene's normals and depths."""
    shown = scene()
    falloffs = [falloff * torch.ones_like(shown.depth) for falloff in falloffs]
    logits = torch.zeros(1, size * size, HEIGHT, WIDTH)
    return ops.cross_bilateral_weights(logits, [shown.normal, shown.depth], falloffs[:2], falloffs[2])


def _light() -> Tensor:
    return ops.demodulate(scene().noisy, scene().albedo)


def _box(size: int = 7) -> Tensor:
    return torch.full((1, size * size, HEIGHT, WIDTH), 1 / size**2)


def _kernel_conv() -> Panels:
    light = _light()
    return {
        "noisy light": light,
        "a box everywhere": ops.kernel_conv(light, _box(9)),
        "kernels by pixel": ops.kernel_conv(light, kernels()),
    }


def _kernel_splat() -> Panels:
    sparse = torch.zeros(1, 3, HEIGHT, WIDTH)
    sparse[..., 6::12, 6::12] = scene().clean[..., 6::12, 6::12] * 20
    return {
        "some pixels": sparse,
        "spread by boxes": ops.kernel_splat(sparse, _box()),
        "by kernels": ops.kernel_splat(sparse, kernels()),
    }


def _softmax_splat() -> Panels:
    light, logits = _light(), kernels().clamp_min(1e-6).log()
    return {"noisy light": light, "spread and divided": ops.softmax_splat(light, logits)[0]}


def _weights() -> Panels:
    weights = kernels()
    one = torch.zeros(1, 81, HEIGHT, WIDTH)
    spots = torch.zeros(1, 1, HEIGHT, WIDTH)
    for row in range(8, HEIGHT, 14):
        for column in range(8, WIDTH, 14):
            one[..., row, column] = weights[..., row, column]
            spots[..., row, column] = 1
    shown = ops.kernel_splat(spots, one)
    return {"scene": scene().clean, "weights of some pixels": (shown / shown.max()).expand(-1, 3, -1, -1) * 0.9}


def _filter() -> Panels:
    shown = scene()
    falloffs = [falloff * torch.ones_like(shown.depth) for falloff in (8.0, 6.0, 0.03)]
    guides = [shown.normal, shown.depth]
    filtered = ops.cross_bilateral_filter(
        _light(), torch.zeros(1, 81, HEIGHT, WIDTH), guides, falloffs[:2], falloffs[2]
    )
    return {"noisy": shown.noisy, "filtered": ops.remodulate(filtered, shown.albedo), "reference": shown.clean}


def _downsample() -> Panels:
    return {"image": scene().noisy, "half the size": ops.downsample(scene().noisy)}


def _upsample() -> Panels:
    half = ops.downsample(scene().clean)
    return {"half the size": half, "repeated": ops.upsample(half, (HEIGHT, WIDTH))}


def _fusion() -> Panels:
    light = _light()
    coarse = ops.downsample(light)
    for _ in range(2):
        coarse = ops.kernel_conv(coarse, torch.full((1, 49, *coarse.shape[-2:]), 1 / 49))
    fine = ops.kernel_conv(light, kernels(size=5))
    fused = ops.laplacian_fusion(fine, coarse, torch.full_like(scene().depth, 0.8))
    return {"fine": fine, "coarse": coarse, "fused": fused}


def _partition() -> Panels:
    logits = torch.zeros(1, 3, HEIGHT, WIDTH)
    logits[:, 0], logits[:, 2] = 2 * (scene().normal[:, 1] > 0.5), 2 * (scene().normal[:, 2] > 0.9)
    return {f"level {i}": level * 2 for i, level in enumerate(ops.pyramid_partition(scene().clean, logits))}


def _learned_upsample() -> Panels:
    half = ops.downsample(scene().clean)
    kernel = torch.tensor([1.0, 3, 3, 1]).outer(torch.tensor([1.0, 3, 3, 1])).reshape(1, 16, 1, 1) / 16
    return {
        "half the size": half,
        "spread": ops.learned_upsample(half, kernel.expand(-1, -1, *half.shape[-2:]).contiguous(), (HEIGHT, WIDTH)),
    }


def _demodulate() -> Panels:
    return {"radiance": scene().noisy, "albedo": scene().albedo, "light": _light()}


def _remodulate() -> Panels:
    smooth = ops.kernel_conv(_light(), kernels())
    return {"smooth light": smooth, "albedo": scene().albedo, "radiance": ops.remodulate(smooth, scene().albedo)}


def _guide() -> Tensor:
    return scene().clean.mean(1, keepdim=True).clamp(0, 1)


def _grid() -> Panels:
    grid, filled = ops.grid_splat(scene().noisy, _guide(), cell=10, bins=6)
    return {
        "noisy": scene().noisy,
        "guide": _guide().expand(-1, 3, -1, -1),
        "through the grid": ops.grid_slice(grid, filled, _guide(), cell=10),
    }


def _grid_cells() -> Panels:
    grid, _ = ops.grid_splat(scene().noisy, _guide(), cell=6, bins=4)
    return {"noisy": scene().noisy} | {f"bin {i}": grid[..., i] for i in range(4)}


def _fireflies() -> Panels:
    noisy = scene().clean.clone()
    noisy[..., 11::17, 7::19] = 40.0
    blurred = torch.nn.functional.avg_pool2d
    clamped = ops.clamp_fireflies(noisy, limit=3.0)
    return {
        "fireflies": noisy,
        "blurred": blurred(noisy, 5, 1, 2),
        "clamped": clamped,
        "then blurred": blurred(clamped, 5, 1, 2),
    }


def _importance() -> Panels:
    importance = 4 * scene().normal[:, 1:2]
    return {
        "noisy light": _light(),
        "importance": (importance / 4).clamp_min(0).expand(-1, 3, -1, -1),
        "filtered": ops.importance_filter(_light(), importance, kernel_size=9),
    }


def _atrous() -> Panels:
    light, shown = _light(), scene()
    variance = torch.full_like(shown.depth, 1.0)
    panels = {"noisy light": light}
    for step in (1, 2, 4):
        light, variance = ops.atrous(light, variance, shown.normal, shown.depth, step=step)
        panels[f"step {step}"] = light
    return panels


def _affinity() -> Panels:
    features = torch.cat([scene().normal, scene().depth / 4], 1) * 3
    one = torch.ones_like(scene().depth)
    return {"noisy light": _light(), "filtered": ops.affinity_filter(_light(), features, one, one, kernel_size=9)}


def _accumulated(frames: int) -> Tensor:
    light = ops.demodulate(scene(1).noisy, scene().albedo)
    length = torch.ones_like(scene().depth)
    for seed in range(2, frames + 1):
        current = ops.demodulate(scene(seed).noisy, scene().albedo)
        light, length = ops.accumulate(current, light, length, torch.zeros(1, 2, HEIGHT, WIDTH))
    return ops.remodulate(light, scene().albedo)


def _accumulate() -> Panels:
    return {f"{frames} frame{'s' * (frames > 1)}": _accumulated(frames) for frames in (1, 4, 16)}


def _reproject() -> Panels:
    motion = torch.zeros(1, 2, HEIGHT, WIDTH)
    motion[:, 0], motion[:, 1] = 8.5, 4.0
    value, weight = ops.reproject(scene().clean, motion)
    return {"frame before": scene().clean, "fetched": value, "weight": weight.expand(-1, 3, -1, -1)}


def _resample() -> Panels:
    motion = torch.full((1, 2, HEIGHT, WIDTH), 0.5)
    bilinear = bicubic = scene().clean
    for _ in range(8):
        bilinear, bicubic = ops.reproject(bilinear, motion)[0], ops.resample(bicubic, motion)
    return {"eight frames before": scene().clean, "by bilinear interpolation": bilinear, "by this": bicubic}


def _regression() -> Panels:
    shown = scene()
    features = torch.cat([torch.ones_like(shown.depth), shown.normal, shown.depth / 4, shown.albedo], 1)
    return {"noisy": shown.noisy, "explained by features": ops.block_regression(shown.noisy, features).clamp_min(0)}


FIGURES = {
    "kernel_conv": Figure(
        "A box blurs across edges; kernels of each pixel's own, here of normals and depth, do not.", _kernel_conv
    ),
    "kernel_splat": Figure("The transpose: single pixels, spread by a box and by kernels of their own.", _kernel_splat),
    "softmax_splat": Figure(
        "Every pixel spreads over its neighbours, and what arrives is divided by the weights that did.", _softmax_splat
    ),
    "cross_bilateral_weights": Figure(
        "Weights of some pixels, where they fall: they end at edges of normals and depth.", _weights
    ),
    "cross_bilateral_filter": Figure(
        "Light is filtered where normals and depth are alike, and the albedo multiplied back.", _filter
    ),
    "downsample": Figure("Means of 2x2 pixels.", _downsample),
    "upsample": Figure("Every pixel 2x2 times.", _upsample),
    "laplacian_fusion": Figure(
        "A fine image keeps its edges and takes its low frequencies from a coarse one.", _fusion
    ),
    "pyramid_partition": Figure(
        "Light shared among three levels by logits: floor to the finest, walls to the coarsest.", _partition
    ),
    "learned_upsample": Figure(
        "Every pixel is spread over 4x4 finer ones, here with fixed weights.", _learned_upsample
    ),
    "demodulate": Figure("Radiance divided by albedo leaves light, which is smooth but for its noise.", _demodulate),
    "remodulate": Figure("Smooth light times albedo is radiance with all of its texture.", _remodulate),
    "grid_splat": Figure("Means of blocks of pixels, apart by the value of a guide: four bins of a grid.", _grid_cells),
    "grid_slice": Figure(
        "Splat into a bilateral grid and read out along a guide: smooth, with the guide's edges.", _grid
    ),
    "clamp_fireflies": Figure("Without the clamp a single bright pixel becomes a blotch.", _fireflies),
    "importance_filter": Figure(
        "A map gives every pixel its importance; here the floor has more than the walls.", _importance
    ),
    "atrous": Figure("Three passes with taps ever farther apart, stopped at edges of normal and depth.", _atrous),
    "affinity_filter": Figure("Weights by the distance of features; here of normals and depth.", _affinity),
    "block_regression": Figure("Each block as the best linear combination of its features.", _regression),
    "reproject": Figure(
        "The frame before, fetched from 8.5 pixels right and 4 down; the weight says what was found.", _reproject
    ),
    "resample": Figure("A frame, fetched from half a pixel right and down in each of eight frames.", _resample),
    "accumulate": Figure("A still camera: the average of 1, 4 and 16 frames.", _accumulate),
}


def pictures() -> dict[str, bytes]:
    """All figures as PNG files, by their place in the site."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "figure.png"
        found = {}
        for name, figure in FIGURES.items():
            write_png(path, sheet(figure.draw()))
            found[f"operators/figures/{name}.png"] = path.read_bytes()
    return found


def sheet(panels: Panels) -> np.ndarray:
    """Pictures side by side under their captions; smaller ones are enlarged to the size of the others."""
    columns = []
    for text, image in panels.items():
        codes = display_codes(image[0]).permute(1, 2, 0).numpy()
        factor = max(1, round(HEIGHT / codes.shape[0])) * ZOOM
        picture = enlarge(codes, factor)[: HEIGHT * ZOOM, : WIDTH * ZOOM]
        missing = HEIGHT * ZOOM - picture.shape[0], WIDTH * ZOOM - picture.shape[1]
        picture = np.pad(picture, ((0, missing[0]), (0, missing[1]), (0, 0)))
        columns.append(np.pad(caption(picture, text), ((0, 2), (2, 2), (0, 0))))
    return np.concatenate(columns, 1)
