"""Detail that a method smooths is given back where what it removed is correlated over two pixels."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor
from toys import Blur, Same, frame_of

from mcdenoise.frame import Frame, Hints
from mcdenoise.models import Demodulated, Model, Needs, Output, Restored
from mcdenoise.ops._op import plain
from mcdenoise.ops._steps.residual import weight_of_noisy
from mcdenoise.train.front import split


class Smooth(Same):
    """Means of 9x9 pixels of color, layers and alpha."""

    def forward(self, frame: Frame, state: object = None) -> tuple[Output, object]:
        layers = {name: smooth(layer) for name, layer in frame.layers.items()}
        return Output(smooth(frame.color), {}, layers, None if frame.alpha is None else smooth(frame.alpha)), None


def smooth(image: Tensor) -> Tensor:
    return F.avg_pool2d(image, 9, 1, 4, count_include_pad=False)


def waves(height: int, width: int) -> Tensor:
    """A clean image with detail of a few pixels."""
    y, x = torch.meshgrid(torch.arange(float(height)), torch.arange(float(width)), indexing="ij")
    texture = 1 + 0.5 * torch.sin(y * 0.5) * torch.sin(x * 0.4 + 1)
    return texture * torch.tensor([0.8, 1.0, 0.4])[None, :, None, None]


def noise(height: int, width: int, seed: int = 0) -> Tensor:
    return torch.randn(1, 3, height, width, generator=torch.Generator().manual_seed(seed))


def weights(color: Tensor, image: Tensor) -> np.ndarray:
    """The equations of :class:`Restored` for each pixel, with loops."""
    c, d = (each[0].double().numpy() for each in (color, image))
    height, width = d.shape[1:]
    rows, columns = -(-height // 4), -(-width // 4)

    def cells(values: np.ndarray) -> np.ndarray:
        found = np.empty((rows, columns))
        for y, x in np.ndindex(rows, columns):
            found[y, x] = values[4 * y : 4 * y + 4, 4 * x : 4 * x + 4].mean()
        return found

    def window(values: np.ndarray, radius: int) -> np.ndarray:
        h, w = values.shape
        found = np.empty_like(values)
        for y, x in np.ndindex(h, w):
            inside = [
                values[min(max(y + dy, 0), h - 1), min(max(x + dx, 0), w - 1)]
                for dy in range(-radius, radius + 1)
                for dx in range(-radius, radius + 1)
            ]
            found[y, x] = np.mean(inside)
        return found

    def pixels(values: np.ndarray) -> np.ndarray:
        found = np.empty((height, width))
        for y, x in np.ndindex(height, width):
            v, u = max((y + 0.5) / 4 - 0.5, 0), max((x + 0.5) / 4 - 0.5, 0)
            top, left = int(v), int(u)
            below, right = min(top + 1, rows - 1), min(left + 1, columns - 1)
            upper = values[top, left] * (1 - u + left) + values[top, right] * (u - left)
            lower = values[below, left] * (1 - u + left) + values[below, right] * (u - left)
            found[y, x] = upper * (1 - v + top) + lower * (v - top)
        return found

    bright = d.mean(0)
    r = (c - d) / (window(bright, 1) + 0.1 * pixels(window(cells(bright), 3)))
    squares, products, variances = (np.zeros((height, width)) for _ in range(3))
    for y, x in np.ndindex(height, width):
        squares[y, x] = (r[:, y, x] ** 2).sum()
        across = (r[:, y, x] * r[:, y, x + 2]).sum() if x + 2 < width else 0.0
        down = (r[:, y, x] * r[:, y + 2, x]).sum() if y + 2 < height else 0.0
        products[y, x], variances[y, x] = (across + down) / 2, (across**2 + down**2) / 4
    power, correlation, variance = (window(cells(each), 3) for each in (squares, products, variances))
    return pixels(np.clip(4 * (correlation - 3 * np.sqrt(variance / 28**2)) / power, 0, 1))


@pytest.mark.parametrize(("height", "width"), [(24, 32), (13, 22)])
def test_the_weight_is_that_of_the_equations(height: int, width: int) -> None:
    clean = waves(height, width).double()
    image = smooth(clean)
    color = clean + 0.3 * noise(height, width).double()
    expected = weights(color, image)
    assert 0.01 < expected.mean() < 1
    np.testing.assert_allclose(weight_of_noisy(color, image)[0, 0].numpy(), expected, rtol=1e-9, atol=1e-12)


def test_white_noise_is_not_given_back() -> None:
    clean = torch.ones(1, 3, 128, 128)
    weight = weight_of_noisy(clean + 0.5 * noise(128, 128), clean)
    # The correlation exceeds three standard deviations in 1 of 1000 windows, by little.
    assert weight.mean() < 0.003


def test_noise_under_a_pixel_filter_is_not_given_back() -> None:
    """Under a Gaussian of a deviation of half a pixel, Mitsuba's default, neighbours are correlated by exp(-1)."""
    taps = torch.tensor([0.2, 1.0, 0.2])
    filtered = F.conv2d(noise(130, 130), (taps[:, None] * taps).expand(3, 1, 3, 3), groups=3)
    clean = torch.ones(1, 3, 128, 128)
    neighbours = (filtered[..., 1:] * filtered[..., :-1]).mean() / filtered.square().mean()
    assert neighbours > 0.3
    assert weight_of_noisy(clean + filtered, clean).mean() < 0.05


def test_smoothed_detail_is_given_back() -> None:
    clean = waves(64, 64)
    smoothed, _ = Smooth()(Frame(clean))
    restored, _ = Restored(Smooth())(Frame(clean))
    error, before = ((output.image - clean).abs().mean() for output in (restored, smoothed))
    assert error < 0.1 * before


def test_layers_and_alpha_take_the_weights_of_the_color() -> None:
    clean = waves(40, 48)
    layers, alpha = {"diffuse": 0.75 * clean, "glossy": 0.25 * clean}, clean[:, :1] / 2
    output, _ = Restored(Smooth())(Frame(clean, layers=layers, alpha=alpha, hints=Hints(alpha=True)))
    torch.testing.assert_close(output.layers["diffuse"], 0.75 * output.image)
    torch.testing.assert_close(output.layers["diffuse"] + output.layers["glossy"], output.image)
    weight = weight_of_noisy(clean, smooth(clean))
    torch.testing.assert_close(output.alpha, torch.lerp(smooth(alpha), alpha, weight))


@pytest.mark.parametrize("size", [(1, 1), (2, 3), (3, 2), (1, 9), (5, 4)])
def test_small_images(size: tuple[int, int]) -> None:
    frame = frame_of(*size)
    output, _ = Restored(Blur())(frame)
    assert output.image.shape == frame.color.shape
    assert output.image.isfinite().all()


@pytest.mark.parametrize("bright", [0.0, 1e-30, 1e-6, 1e4, 1e9])
def test_results_and_derivatives_are_finite(bright: float) -> None:
    color = bright * frame_of(24, 24).color
    color[..., :8] = 0
    color[0, :, 12, 12] = 65504.0
    for image in (smooth(color), torch.zeros_like(color), color.clone()):
        given = [each.clone().requires_grad_() for each in (color, image)]
        weight = weight_of_noisy(*given)
        assert ((weight >= 0) & (weight <= 1)).all()
        for gradient in torch.autograd.grad(weight.sum(), given):
            assert gradient.isfinite().all()


def test_derivatives_are_those_of_finite_differences() -> None:
    clean = waves(8, 12).double()
    color, image = clean + 0.3 * noise(8, 12).double(), smooth(clean)
    weight = weight_of_noisy(color, image)
    assert ((weight > 0) & (weight < 1)).any()
    given = (color.requires_grad_(), image.requires_grad_())
    assert torch.autograd.gradcheck(weight_of_noisy, given, fast_mode=True)
    assert torch.autograd.gradgradcheck(weight_of_noisy, given, fast_mode=True)


def test_a_pixel_depends_on_those_within_the_reach() -> None:
    assert Restored(Same()).needs == Needs(reach=36, stride=4, trainable=Same().needs.trainable)
    clean = waves(100, 104)
    color, image = clean + 0.3 * noise(100, 104), smooth(clean).requires_grad_()
    farthest = 0
    for y, x in ((48, 50), (49, 51), (50, 52), (51, 53)):
        (gradient,) = torch.autograd.grad(weight_of_noisy(color, image)[0, 0, y, x], image)
        ys, xs = gradient[0].abs().sum(0).nonzero().unbind(1)
        farthest = max(farthest, int((ys - y).abs().max()), int((xs - x).abs().max()))
    assert 30 < farthest <= 36


def test_bands_of_rows_give_the_same_weights(monkeypatch: pytest.MonkeyPatch) -> None:
    clean = waves(149, 63)
    color, image = clean + 0.3 * noise(149, 63), smooth(clean)
    whole = plain(weight_of_noisy)(color, image)
    monkeypatch.setattr("mcdenoise.ops._rows._PIXELS", 63 * 23)
    assert torch.equal(plain(weight_of_noisy)(color, image), whole)


def test_a_network_is_trained_without_it() -> None:
    network: Model = Blur()
    front, rest = split(Restored(Demodulated(network)))
    assert front == split(Demodulated(network))[0]
    assert type(rest) is Demodulated
