"""Metrics and the training loss: known answers, and the paper's equations written out."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from kornia.metrics import psnr
from torch import Tensor
from torch.autograd import gradcheck

from mcdenoise.losses import cascade_loss
from mcdenoise.metrics import displayed, psnr_srgb, relmse_linear, smape_linear, temporal_smape_linear

IMAGE_METRICS = [smape_linear, relmse_linear, psnr_srgb]


def image(*values: float) -> Tensor:
    """``(1, 3, 1, N)``: N gray pixels."""
    return torch.tensor(values).expand(1, 3, 1, len(values))


def clip(*values: float) -> Tensor:
    """``(1, T, 3, 1, 1)``: T frames of one gray pixel."""
    return torch.tensor(values).reshape(1, -1, 1, 1, 1).expand(1, -1, 3, 1, 1)


def test_smape_written_out() -> None:
    # |1 - 3| / (1 + 3 + 0.01), and a black pixel that is right.
    assert smape_linear(image(1, 0), image(3, 0)).item() == pytest.approx((2 / 4.01 + 0) / 2)
    # In the dark the epsilon decides: 0.01 against 0 is half an error, not a whole one.
    assert smape_linear(image(0.01), image(0)).item() == pytest.approx(0.5)


def test_temporal_smape_written_out() -> None:
    # Differences 1, 2 against 1, 0: the first is right, the second |2 - 0| / (2 + 0 + 0.01).
    error = temporal_smape_linear(clip(0, 1, 3), clip(5, 6, 6))
    assert error.item() == pytest.approx((0 + 2 / 2.01) / 2)
    # Differences are absolute: up is as far as down.
    assert temporal_smape_linear(clip(0, 1), clip(1, 0)).item() == 0


def test_relmse_written_out() -> None:
    color = torch.tensor([1.0, 2.0, 3.0]).reshape(1, 3, 1, 1)
    reference = torch.tensor([1.0, 2.0, 6.0]).reshape(1, 3, 1, 1)
    assert relmse_linear(color, reference).item() == pytest.approx((0 + 0 + 9) / (3**2 + 0.01) / 3)


def test_psnr_written_out() -> None:
    # 0.0031308 and less is 12.92 times as much on a display; an error of 0.01292 is -20 log10(0.01292) dB.
    assert psnr_srgb(image(0.001), image(0.002)).item() == pytest.approx(-20 * math.log10(0.01292), abs=1e-3)
    assert psnr_srgb(image(5.0), image(1.0)).item() == math.inf


def test_psnr_is_that_of_kornia() -> None:
    torch.manual_seed(0)
    first, second = torch.rand(1, 3, 9, 7) * 1.5, torch.rand(1, 3, 9, 7) * 1.5
    expected = psnr(displayed(first), displayed(second), 1.0)
    torch.testing.assert_close(psnr_srgb(first, second)[0], expected)


def test_a_display_clamps_and_bends() -> None:
    shown = displayed(image(-1.0, 0.0, 0.5, 1.0, 9.0))[0, 0, 0]
    torch.testing.assert_close(shown, torch.tensor([0.0, 0.0, 1.055 * 0.5 ** (1 / 2.4) - 0.055, 1.0, 1.0]))


@pytest.mark.parametrize("metric", IMAGE_METRICS)
def test_whatever_stands_before_the_image_is_a_batch(metric: Callable[[Tensor, Tensor], Tensor]) -> None:
    torch.manual_seed(0)
    images, references = torch.rand(2, 4, 3, 5, 6), torch.rand(2, 4, 3, 5, 6)
    together = metric(images, references)
    assert together.shape == (2, 4)
    for b in range(2):
        for t in range(4):
            torch.testing.assert_close(together[b, t], metric(images[b, t], references[b, t]))


@pytest.mark.parametrize("metric", [smape_linear, relmse_linear])
def test_no_error_is_zero(metric: Callable[[Tensor, Tensor], Tensor]) -> None:
    images = torch.rand(2, 3, 4, 5) * 100
    assert metric(images, images).tolist() == [0, 0]


@pytest.mark.parametrize("metric", [*IMAGE_METRICS, temporal_smape_linear])
def test_shapes_must_agree(metric: Callable[[Tensor, Tensor], Tensor]) -> None:
    with pytest.raises(ValueError, match=r"reference: expected the shape of image .* found \(1, 2, 3, 4, 6\)"):
        metric(torch.rand(1, 2, 3, 4, 5), torch.rand(1, 2, 3, 4, 6))
    with pytest.raises(ValueError, match=r"reference: expected the shape of image and \(\.\.\., C, H, W\)"):
        metric(torch.rand(4, 5), torch.rand(4, 5))


def test_one_frame_has_no_temporal_error() -> None:
    for shape in ((1, 1, 3, 4, 5), (3, 4, 5)):
        with pytest.raises(ValueError, match=r"clip: expected .* at least 2 frames"):
            temporal_smape_linear(torch.rand(shape), torch.rand(shape))


def test_the_loss_is_equation_11() -> None:
    torch.manual_seed(0)
    r1, r2, y = (torch.rand(2, 3, 3, 4, 5, dtype=torch.float64).tolist() for _ in range(3))

    def spatial(r: list[list[list[float]]]) -> float:
        terms = [abs(a - b) / (abs(a) + abs(b) + 1e-2) for a, b in zip(values(r), values(y), strict=True)]
        return sum(terms) / len(terms)

    def temporal(r: list[list[list[float]]]) -> float:
        terms = []
        for shot, true in zip(r, y, strict=True):
            for i in range(1, 3):
                moved = [abs(a - b) for a, b in zip(values(shot[i]), values(shot[i - 1]), strict=True)]
                truth = [abs(a - b) for a, b in zip(values(true[i]), values(true[i - 1]), strict=True)]
                terms += [abs(a - b) / (a + b + 1e-2) for a, b in zip(moved, truth, strict=True)]
        return sum(terms) / len(terms)

    initial, final, reference = (torch.tensor(x, dtype=torch.float64) for x in (r1, r2, y))
    expected = spatial(r1) + spatial(r2) + 0.1 * temporal(r1) + 0.1 * temporal(r2)
    assert cascade_loss(initial, final, reference).item() == pytest.approx(expected, rel=1e-12)
    without = cascade_loss(initial, final, reference, temporal_weight=0)
    assert without.item() == pytest.approx(spatial(r1) + spatial(r2), rel=1e-12)


def values(nested: object) -> list[float]:
    return torch.tensor(nested, dtype=torch.float64).flatten().tolist()


def test_the_gradient_of_the_loss() -> None:
    torch.manual_seed(0)
    # Away from the kinks: no error, and no frame difference, is near zero.
    frames = torch.arange(3, dtype=torch.float64).reshape(1, 3, 1, 1, 1)
    reference = 1 + frames + torch.rand(1, 3, 3, 2, 3, dtype=torch.float64) * 0.1
    initial = (3 * reference + torch.rand_like(reference) * 0.1).requires_grad_()
    final = (0.4 * reference + torch.rand_like(reference) * 0.01).requires_grad_()
    assert gradcheck(lambda a, b: cascade_loss(a, b, reference), (initial, final))


def test_the_loss_of_one_frame() -> None:
    one = torch.rand(1, 1, 3, 2, 2)
    assert cascade_loss(one, one, one, temporal_weight=0).item() == 0
    with pytest.raises(ValueError, match="at least 2 frames"):
        cascade_loss(one, one, one)
