"""Properties of a buffer that its values reveal: encodings, placeholders, units and signs.

All arrays are ``(H, W, C)``. Every decision comes with a description for the table of buffers.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F

from mcdenoise.data.camera_path import Array
from mcdenoise.data.exr import LARGEST_HALF
from mcdenoise.data.images import Image, Mask

# Larger than any scene's depth; placeholders of renderers are larger still: 1e10 (Blender), 1e30, 3.4e38.
_FARTHEST = 1e9
_BLOCK = 8
# Mean square contrast below which a block is uniform up to rounding and feature noise.
_UNIFORM = 1e-4
# Elasticities near 1 and near 0 are distinguished, although gloss and light between colored walls lower both (measured:
# 0.47 to 1.17 and -0.53 to 0.19). The value must exceed this many standard errors, and errors must be below this limit.
_THRESHOLD, _SIGMAS, _LARGEST_ERROR = 1 / 3, 3.0, 0.15
# Edges of the color at those of the albedo must exceed this many standard errors, and an error of the part of them that
# the albedo explains: in 1000 images whose color is blurred beyond any edge, 5 exceed both.
_EDGES, _UNEXPLAINED = 2.5, 2.0
# Offsets of the blocks in which edges are compared, and the largest number of all blocks.
_OFFSETS, _MOST_BLOCKS = tuple(product((0, 2, 5, 7), (0, 3, 5, 6))), 2**18
# One reading must be closer to the reference than the other by this factor.
_NEARER = 1.5


class Row(NamedTuple):
    """The source of one buffer.

    Args:
        buffer: name of the buffer.
        source: file and layer.
        reading: how its values are interpreted, and why.
    """

    buffer: str
    source: str
    reading: str


class Albedo(NamedTuple):
    """Whether radiance includes the albedo.

    Args:
        included: ``None`` if the data does not tell.
        elasticity: percentage by which the radiance grows with one percent of albedo: near 1 if included, 0 if not.
        error: standard error of the elasticity.
    """

    included: bool | None
    elasticity: float
    error: float


def albedo_included(color: Image, albedo: Image) -> Albedo:
    """Determine from a frame whether its radiance includes the albedo.

    An elasticity near 0 proves nothing where the color lacks the edges of the albedo, because of a lens, fog or glass.
    So radiance is without albedo only if it also has edges where the albedo has, which the albedo does not explain:
    see :func:`_has_other_edges`.

    Two regressions over blocks of pixels are combined, both of them insensitive to noise: of the ratios of two channels
    (a path's noise is nearly the same in all three), and of the fourth root of the relative brightness (under which one
    path in a thousand that hits a lamp has the weight of ten others). The standard error is that of a jackknife over
    stripes of blocks.
    """
    usable: Mask = np.all([(albedo > 0.02).all(-1), (color >= 0).all(-1), np.isfinite(color).all(-1)], axis=0)
    sums = []
    lit: Mask = np.logical_and(usable, (color > 0).all(-1))
    for one, other in ((0, 1), (1, 2)):
        with np.errstate(divide="ignore", invalid="ignore"):
            sums.append(
                _slopes(np.log(albedo[..., one] / albedo[..., other]), np.log(color[..., one] / color[..., other]), lit)
            )
    roots = [np.sqrt(np.sqrt(np.maximum(image.mean(-1), 0))) for image in (albedo, color)]
    sums.append(_slopes(roots[0], roots[1], usable, relative=True))
    # Weight each estimate by its inverse variance.
    found = [_jackknife(each) for each in sums]
    weights = np.array([1 / max(error, 1e-3) ** 2 if np.isfinite(error) else 0.0 for _, error in found])
    if not weights.sum():
        return Albedo(None, float("nan"), float("inf"))
    slope = float(sum(w * value for w, (value, _) in zip(weights, found, strict=True) if w) / weights.sum())
    error = float(weights.sum() ** -0.5)
    significant = abs(slope - _THRESHOLD) > _SIGMAS * error and error < _LARGEST_ERROR
    included = slope > _THRESHOLD if significant else None
    if included is False and not _has_other_edges(albedo, color, usable):
        included = None
    return Albedo(included, slope, error)


def _has_other_edges(albedo: Image, color: Image, usable: Mask) -> bool:
    """Whether the color has edges at those of the albedo that do not follow the albedo, as light alone has.

    In each block, with the relative deviations x of the albedo and y of the color from their means, ``c = sum(x y)`` is
    split into the sums of both fields of a checkerboard of pixels, whose product is free of independent noise. The same
    with mirrored x, which gradients give as well, is subtracted: the rest, q, is of edges that coincide. Of a sharp
    image, however faint or partial, the albedo explains most edges: ``sum(c x x) > 2 sum(q) / 3``; of light, few.
    """
    fields = (np.add.outer(np.arange(_BLOCK), np.arange(_BLOCK)) % 2).astype(bool).ravel()
    stripes = np.zeros((16, 2))
    # Fewer blocks are enough for a large image.
    offsets = _OFFSETS[: max(1, _MOST_BLOCKS * _BLOCK**2 // max(usable.size, 1))]
    for (top, left), channel in product(offsets, range(3)):
        inside = _blocks(usable[top:, left:])
        x, y = (_blocks(np.where(usable, image[..., channel], 0)[top:, left:]) ** 0.25 for image in (albedo, color))
        known = np.flatnonzero(inside.all(1) & (y.sum(1) > 0))
        x, y = (each[known] / each[known].mean(1, keepdims=True) - 1 for each in (x, y))
        x[(x**2).mean(1) < _UNIFORM] = 0
        whole = x.reshape(-1, _BLOCK, _BLOCK)
        q, contrast, *decoys = (
            np.stack([image[:, fields].sum(1), image[:, ~fields].sum(1)])
            for image in (x * y, x * x, *(np.flip(whole, axes).reshape(x.shape) * y for axes in (1, 2, (1, 2))))
        )
        scale = np.sqrt(contrast.prod(0)) + 1e-12
        edges = (q.prod(0) - np.mean([each.prod(0) for each in decoys], 0)) / scale
        explained = (q * contrast[::-1]).mean(0) / scale
        np.add.at(stripes, known % 16, np.stack([edges, 2 / 3 * edges - explained], 1))
    left_out = stripes.sum(0) - stripes
    errors = np.sqrt(15 / 16 * ((left_out - left_out.mean(0)) ** 2).sum(0))
    return bool((stripes.sum(0) > np.array([_EDGES, _UNEXPLAINED]) * errors).all())


def albedo_included_as_in(reference: Image, color: Image, albedo: Image) -> bool | None:
    """Whether radiance includes the albedo by comparison with its reference; ``None`` if neither is clearly closer."""
    with_it, without = (_distance(image, reference) for image in (color, color * albedo))
    return with_it < without if max(with_it, without) > _NEARER * min(with_it, without) else None


def _distance(image: Image, reference: Image) -> float:
    """Mean relative difference of large blocks, which average the noise."""
    one, other = (
        F.adaptive_avg_pool2d(torch.from_numpy(np.nan_to_num(each)).permute(2, 0, 1).contiguous(), (6, 8))
        for each in (image, reference)
    )
    return float(((one - other).abs() / (one + other + 1e-6)).mean())


def _slopes(x: Image, y: Image, usable: Mask, *, relative: bool = False) -> Array:
    """``(N, 2)`` covariance and variance, summed over the blocks of each of N stripes."""
    inside, xs, ys = (_blocks(np.where(usable, image, 0)) for image in (np.ones_like(x), x, y))
    count = np.maximum(inside.sum(1, keepdims=True), 1)
    mean_x, mean_y = xs.sum(1, keepdims=True) / count, ys.sum(1, keepdims=True) / count
    within = (inside > 0) & (count > _BLOCK**2 / 2)
    if relative:
        within &= (mean_x > 0) & (mean_y > 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            xs, ys = np.nan_to_num(xs / mean_x), np.nan_to_num(ys / mean_y)
        mean_x = mean_y = np.ones_like(mean_x)
    dx, dy = np.where(within, xs - mean_x, 0), np.where(within, ys - mean_y, 0)
    pairs = np.stack([(dx * dy).sum(1), (dx * dx).sum(1)], 1)
    # Blocks that are uniform up to rounding and feature noise carry no information.
    pairs[pairs[:, 1] < count[:, 0] * _UNIFORM] = 0
    return np.stack([pairs[k::16].sum(0) for k in range(16)])


def _blocks(image: Image | Array | Mask) -> Array:
    """``(N, 64)`` pixels of the whole blocks of an image ``(H, W)``."""
    height, width = (size // _BLOCK for size in image.shape)
    cut = image[: height * _BLOCK, : width * _BLOCK].reshape(height, _BLOCK, width, _BLOCK).swapaxes(1, 2)
    return cut.reshape(-1, _BLOCK**2).astype(np.float64)


def _jackknife(stripes: Array) -> tuple[float, float]:
    total = stripes.sum(0)
    informative = np.count_nonzero(stripes[:, 1])
    if informative < 8 or not total[1] > 0:
        return 0.0, float("inf")
    left_out = (total[0] - stripes[:, 0]) / np.maximum(total[1] - stripes[:, 1], 1e-30)
    n = len(stripes)
    return float(total[0] / total[1]), float(np.sqrt((n - 1) / n * ((left_out - left_out.mean()) ** 2).sum()))


def read_radiance(
    color: Image, albedo: Image, reference: Image | None, stated: bool | None
) -> tuple[bool, str, list[str]]:
    """Determine whether radiance includes the albedo: as stated, or by its values, or by default yes.

    Returns:
        The answer, its description, and warnings.
    """
    readings = {True: "radiance with albedo", False: "radiance without albedo, which is multiplied back"}
    if stated is not None:
        return stated, f"{readings[stated]}, as stated", []
    included = None if reference is None else albedo_included_as_in(reference, color, albedo)
    why = "only so it is as bright as its reference"
    if included is None:
        measured = albedo_included(color, albedo)
        included = measured.included
        why = f"1 % of albedo makes {measured.elasticity:.2f} +- {measured.error:.2f} % of light"
        if included is None:
            # Without any texture the values cannot tell, which is fine; with a contradicting texture the answer is
            # doubtful.
            doubtful = measured.elasticity + _SIGMAS * measured.error < 2 / 3
            warning = (
                "'color': taken as ordinary radiance; its values do not tell whether it was divided by the albedo. If "
                "it was, say --color-without-albedo"
            )
            return True, f"{readings[True]}, taken as such: its values do not tell", [warning] if doubtful else []
    warning = (
        "'color': taken as divided by its albedo, which is multiplied back, since only so it fits; if it is ordinary "
        "radiance, say --color-with-albedo"
    )
    return included, f"{readings[included]}: {why}", [] if included else [warning]


def normal_is_encoded(normal: Image) -> bool:
    """Whether a normal is stored as ``n / 2 + 1 / 2``: no value is negative, and decoding gives unit length."""
    present = (normal != 0).any(-1) & np.isfinite(normal).all(-1)
    if not present.any() or normal[present].min() < -0.05 or normal[present].max() > 1.05:
        return False
    seen = normal[present]
    as_stored, decoded = np.linalg.norm(seen, axis=-1), np.linalg.norm(2 * seen - 1, axis=-1)
    return bool(np.median(np.abs(decoded - 1)) < np.median(np.abs(as_stored - 1)))


def is_direction(vectors: Image) -> bool:
    """Whether most vectors have length one or zero."""
    length = np.linalg.norm(np.where(np.isfinite(vectors), vectors, 0), axis=-1)
    present = length > 1e-3
    return bool(present.any() and (np.abs(length[present] - 1) < 0.05).mean() > 0.9)


def nothing_hit(depth: Image) -> Mask:
    """The pixels whose depth means that nothing was hit: 0 or less, 1e9 or more, the largest half float, or NaN."""
    with np.errstate(invalid="ignore"):
        nothing: Mask = ~((depth > 0) & (depth < _FARTHEST) & (depth != LARGEST_HALF))
    return nothing
