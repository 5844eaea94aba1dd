"""A wrapper that gives back the detail that a method has smoothed.

What a denoiser removes, ``n = color - image``, is noise and, where it smooths too much, detail. The two are told apart
by their correlation: the noise of different pixels is independent, apart from neighbours under a renderer's pixel
filter, while detail continues over several pixels. Such tests of the whiteness of the residual tell how far a
restoration may go (Almeida and Figueiredo 2013, "Parameter Estimation for Blind and Non-Blind Deblurring Using Residual
Whiteness Measures", IEEE Transactions on Image Processing 22). No weights are learnt.
"""

from __future__ import annotations

from math import lcm

import torch
import torch.nn.functional as F
from torch import Tensor

from mcdenoise.frame import Frame
from mcdenoise.models._interface import Needs, Output, State
from mcdenoise.models._journal import timed
from mcdenoise.models._wrapper import Wrapper
from mcdenoise.ops._rows import by_rows
from mcdenoise.ops._window import pad

_CELL, _CELLS = 4, 7  # the statistics are means over windows of 7x7 cells of 4x4 pixels
_LAG = 2  # distance in pixels over which the noise is uncorrelated, also under a Gaussian pixel filter
_DEVIATIONS = 3.0  # a correlation counts as far as it exceeds so many standard deviations
_GAIN = 4.0  # weight per correlation: detail is correlated only in part over the lag
_LEAST = 0.1  # smallest mean that differences are relative to, as a fraction of the window's
# Interpolation and window, twice because of the mean that differences are relative to, and the lag. It is a multiple of
# a cell, so that bands of rows have the cells of the whole image.
_REACH = 2 * (_CELL + 1 + _CELLS // 2 * _CELL) + _LAG
_DARKEST, _MOST = 1e-15, 1e4  # smallest mean and largest relative difference, so that all derivatives are finite


class Restored(Wrapper):
    """Blends the noisy color into the result of a method as far as what it removed is correlated, so is not noise.

    ``result = image + w (color - image)``. With the relative difference ``r = (color - image) / mean(image)``, the mean
    over 3x3 pixels, ``A`` the mean of ``r(x)^2`` over a window of 28x28 pixels, ``C`` that of ``r(x) r(x + 2 pixels)``
    over rows and columns, and ``s`` the standard deviation of ``C`` if ``r`` is independent, the weight is
    ``w = clamp(4 (C - 3 s) / A, 0, 1)``. Layers and alpha are blended with the same weights.

    Args:
        inner: any method.
    """

    @property
    def needs(self) -> Needs:
        """The needs of the inner method; windows add to its reach."""
        needs = self.inner.needs
        reach = None if needs.reach is None else needs.reach + _REACH
        return Needs(needs.buffers, needs.uses, needs.trainable, reach, lcm(needs.stride, _CELL))

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        output, state = self.inner(frame, state)
        with timed("restore", frame.color.device):
            weight = by_rows(weight_of_noisy, frame.color, output.image, reach=_REACH)
            layers = {name: torch.lerp(layer, frame.layers[name], weight) for name, layer in output.layers.items()}
            alpha = None if output.alpha is None or frame.alpha is None else output.alpha.lerp(frame.alpha, weight)
            return Output(torch.lerp(output.image, frame.color, weight), output.stages, layers, alpha), state


def weight_of_noisy(color: Tensor, image: Tensor) -> Tensor:
    """Weight of the noisy color, ``(B, 1, H, W)`` in [0, 1], see :class:`Restored`.

    Args:
        color: ``(B, 3, H, W)`` noisy radiance.
        image: ``(B, 3, H, W)`` denoised radiance.
    """
    size = color.shape[-2], color.shape[-1]
    bright = image.mean(1, keepdim=True)
    scale = _mean(bright, 3) + _LEAST * _pixels(_mean(_cells(bright), _CELLS), size)
    r = ((color - image) / scale.clamp_min(_DARKEST)).clamp(-_MOST, _MOST)
    squares, rows, columns = (_product(r, *lag) for lag in ((0, 0), (0, _LAG), (_LAG, 0)))
    statistics = (squares, rows + columns, rows * rows + columns * columns)
    power, correlation, variance = _mean(torch.cat([_cells(each) for each in statistics], 1), _CELLS).split(1, 1)
    deviation = variance.clamp_min(1e-30).sqrt() / (2 * _CELL * _CELLS)
    weight = _GAIN * (correlation / 2 - _DEVIATIONS * deviation) / power.clamp_min(1e-12)
    return _pixels(weight.clamp(0, 1), size)


def _product(r: Tensor, down: int, right: int) -> Tensor:
    """Product of each pixel with the one below or to the right, summed over the channels; 0 where that is outside."""
    height, width = r.shape[2:]
    product = r[..., down:, right:] * r[..., : max(height - down, 0), : max(width - right, 0)]
    return F.pad(product.sum(1, keepdim=True), (0, min(right, width), 0, min(down, height)))


def _cells(image: Tensor) -> Tensor:
    """Means over cells of 4x4 pixels, as far as they lie inside the image."""
    return F.avg_pool2d(image, _CELL, ceil_mode=True, count_include_pad=False)


def _pixels(cells: Tensor, size: tuple[int, int]) -> Tensor:
    """Interpolate the means of cells at pixels, linearly along both axes.

    ``torch.nn.functional.interpolate`` and ``torch.lerp`` would round differently in bands of rows.
    """
    for axis in (-1, -2):
        count = cells.shape[axis]
        padded = F.pad(cells, (1, 1, 0, 0) if axis == -1 else (0, 0, 1, 1), mode="replicate")
        before, here, after = (padded.narrow(axis, start, count) for start in range(3))
        (a, b), (c, d) = ([here + w / 8 * (other - here) for w in (3, 1)] for other in (before, after))
        cells = torch.stack([a, b, d, c], axis).flatten(axis - 1, axis)
    return cells[..., : size[0], : size[1]]


def _mean(image: Tensor, side: int) -> Tensor:
    """Means over the window around each pixel; outside the image, its edge is repeated."""
    image = pad(image, side // 2, "replicate")
    for axis in (-1, -2):
        length = image.shape[axis] - side + 1
        first, *others = (image.narrow(axis, start, length) for start in range(side))
        image = sum(others, first)
    return image / side**2
