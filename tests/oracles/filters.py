"""The filters of one image with weights of each pixel."""

import itertools
import math
from collections.abc import Sequence
from decimal import Decimal, localcontext

from torch import Tensor

from oracles.loops import Image, indices, softmax_of, taps_of, tensor_of, zeros


def kernel_conv(image: Tensor, kernel: Tensor, *, border: str = "replicate") -> Tensor:
    """Eq. 4: ``out[p] = sum_t kernel[t, p] image[p + o_t]``; ``"renormalize"`` divides by the sum of weights inside."""
    source, weights, out = image.tolist(), kernel.tolist(), zeros(image.shape)
    for b, c, y, x in indices(image.shape):
        total = inside = 0.0
        for t, _, row, column in taps_of(kernel, y, x, border):
            weight = weights[b][t][y][x]
            if row is not None:
                total += weight * source[b][c][row][column]
                inside += weight
        if border == "renormalize":
            total = total / inside if inside != 0 else 0.0
        out[b][c][y][x] = total
    return tensor_of(out, image.shape)


def kernel_splat(image: Tensor, kernel: Tensor, *, border: str = "replicate") -> Tensor:
    """``out[p + o_t] += kernel[t, p] image[p]``; ``"renormalize"`` first divides by the sum of weights inside."""
    source, weights, out = image.tolist(), kernel.tolist(), zeros(image.shape)
    for b, c, y, x in indices(image.shape):
        value = source[b][c][y][x]
        if border == "renormalize":
            inside = sum(weights[b][t][y][x] for t, _, row, _ in taps_of(kernel, y, x, border) if row is not None)
            value = value / inside if inside != 0 else 0.0
        for t, _, row, column in taps_of(kernel, y, x, border):
            if row is not None:
                out[b][c][row][column] += weights[b][t][y][x] * value
    return tensor_of(out, image.shape)


def softmax_splat(image: Tensor, logits: Tensor) -> tuple[Tensor, Tensor]:
    """``sum exp(l) image / sum exp(l)`` over the splats at a pixel, and ``log(sum exp(l))``, in decimal numbers."""
    source, exponents = image.tolist(), logits.tolist()
    batch, channels, height, width = image.shape
    out, log_weight = zeros(image.shape), zeros((batch, 1, height, width))
    with localcontext(prec=40):
        for b, y, x in itertools.product(range(batch), range(height), range(width)):
            weights = {}
            # The splat of tap t comes from the pixel in the opposite direction.
            for t, _, row, column in taps_of(logits, y, x, "zeros"):
                if row is not None:
                    weights[row, column] = Decimal(exponents[b][logits.shape[1] - 1 - t][row][column]).exp()
            total = sum(weights.values(), Decimal())
            log_weight[b][0][y][x] = float(total.ln())
            for c in range(channels):
                light = (weight * Decimal(source[b][c][row][column]) for (row, column), weight in weights.items())
                out[b][c][y][x] = float(sum(light, Decimal()) / total)
    return tensor_of(out, image.shape), tensor_of(log_weight, (batch, 1, height, width))


def cross_bilateral_weights(
    kernel: Tensor,
    guides: Sequence[Tensor] = (),
    falloffs: Sequence[Tensor] = (),
    distance_falloff: Tensor | None = None,
    *,
    normalize: str = "softmax",
    border: str = "replicate",
) -> Tensor:
    """Eqs. 5-8: ``w' = w * prod_g exp(-f_g |g(q) - g(p)|^2) * exp(-f_d |q - p|^2)``.

    ``"softmax"`` has ``w = exp(logit)``, and divides by the sum over the taps.
    """
    logits, out = kernel.tolist(), zeros(kernel.shape)
    images = [guide.tolist() for guide in guides]
    factors = [scale.tolist() for scale in falloffs]
    factor_of_distance = None if distance_falloff is None else distance_falloff.tolist()
    batch, _, height, width = kernel.shape
    for b, y, x in itertools.product(range(batch), range(height), range(width)):
        exponents: dict[int, list[float]] = {}
        for t, squared_distance, row, column in taps_of(kernel, y, x, border):
            if row is None and border == "renormalize":
                continue
            terms = exponents[t] = []
            for guide, factor in zip(images, factors, strict=True):
                difference = sum(
                    ((channel[row][column] if row is not None else 0.0) - channel[y][x]) ** 2 for channel in guide[b]
                )
                terms.append(-factor[b][0][y][x] * difference)
            if factor_of_distance is not None:
                terms.append(-factor_of_distance[b][0][y][x] * squared_distance)
        if normalize == "softmax":
            weights = softmax_of({t: [logits[b][t][y][x], *terms] for t, terms in exponents.items()})
        else:
            weights = {t: logits[b][t][y][x] * math.exp(sum(terms)) for t, terms in exponents.items()}
        for t, weight in weights.items():
            out[b][t][y][x] = weight
    return tensor_of(out, kernel.shape)


def cross_bilateral_filter(
    image: Tensor,
    kernel: Tensor,
    guides: Sequence[Tensor] = (),
    falloffs: Sequence[Tensor] = (),
    distance_falloff: Tensor | None = None,
    *,
    normalize: str = "softmax",
    border: str = "replicate",
) -> Tensor:
    """Eqs. 5-8, then Eq. 4."""
    weights = cross_bilateral_weights(kernel, guides, falloffs, distance_falloff, normalize=normalize, border=border)
    return kernel_conv(image, weights, border=border)


def affinity_filter(
    image: Tensor,
    features: Tensor,
    bandwidth: Tensor,
    center: Tensor,
    previous: Tensor | None = None,
    previous_features: Tensor | None = None,
    previous_bandwidth: Tensor | None = None,
    previous_weight: Tensor | None = None,
    *,
    kernel_size: int = 7,
    dilation: int = 1,
) -> Tensor:
    """Means with weights ``exp(-a |f_p - f_q|^2)``, and ``c`` for the pixel itself; also over the previous frame."""
    frames: list[tuple[Image, Image, Image, Image | None]]
    frames = [(image.tolist(), features.tolist(), bandwidth.tolist(), None)]
    if previous is not None and previous_features is not None:
        of_before = previous_bandwidth.tolist(), previous_weight.tolist()
        frames.append((previous.tolist(), previous_features.tolist(), *of_before))
    here, own, out = features.tolist(), center.tolist(), zeros(image.shape)
    batch, channels, height, width = image.shape
    steps = range(-(kernel_size // 2), kernel_size // 2 + 1)
    for b, y, x in itertools.product(range(batch), range(height), range(width)):
        taps = []
        for source, there, band, known in frames:
            for i, j in itertools.product(steps, repeat=2):
                row, column = y + dilation * i, x + dilation * j
                if not (0 <= row < height and 0 <= column < width):
                    continue
                if known is None and (i, j) == (0, 0):
                    weight = max(own[b][0][y][x], 1e-6)
                else:
                    apart = sum((here[b][f][y][x] - there[b][f][row][column]) ** 2 for f in range(features.shape[1]))
                    weight = math.exp(-band[b][0][y][x] * apart)
                    weight *= 1 if known is None else known[b][0][row][column]
                taps.append((weight, [source[b][c][row][column] for c in range(channels)]))
        total = sum(weight for weight, _ in taps)
        for c in range(channels):
            out[b][c][y][x] = sum(weight * value[c] for weight, value in taps) / total
    return tensor_of(out, image.shape)


def importance_filter(image: Tensor, importance: Tensor, *, kernel_size: int) -> Tensor:
    """Fan et al. 2021: means over a window, weighted by the softmax of the importance; taps outside are skipped."""
    source, worth, out = image.tolist(), importance.tolist(), zeros(image.shape)
    radius, (_, _, height, width) = kernel_size // 2, image.shape
    for b, c, y, x in indices(image.shape):
        rows = range(max(0, y - radius), min(height, y + radius + 1))
        taps = list(itertools.product(rows, range(max(0, x - radius), min(width, x + radius + 1))))
        largest = max(worth[b][0][row][column] for row, column in taps)
        weights = [math.exp(worth[b][0][row][column] - largest) for row, column in taps]
        total = math.fsum(w * source[b][c][row][column] for w, (row, column) in zip(weights, taps, strict=True))
        out[b][c][y][x] = total / math.fsum(weights)
    return tensor_of(out, image.shape)
