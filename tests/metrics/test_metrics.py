"""Metrics and the training loss: known answers, and the equations of the paper written out."""

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.autograd import gradcheck

from mcdenoise.metrics import (
    displayed,
    flip_hdr,
    flip_srgb,
    psnr_gamma,
    psnr_srgb,
    relmse_linear,
    rmse_linear,
    smape_linear,
    ssim_srgb,
    temporal_rmse_srgb,
    temporal_smape_linear,
)

IMAGE_METRICS = [smape_linear, relmse_linear, rmse_linear, psnr_srgb, psnr_gamma, ssim_srgb, flip_srgb, flip_hdr]
CLIP_METRICS = [temporal_smape_linear, temporal_rmse_srgb]


def image(*values: float) -> Tensor:
    """``(1, 3, 1, N)``: N gray pixels."""
    return torch.tensor(values, dtype=torch.float32).expand(1, 3, 1, len(values))


def rgb(*values: float) -> Tensor:
    """``(1, 3, 1, 1)``: one pixel."""
    return torch.tensor(values, dtype=torch.float32).reshape(1, 3, 1, 1)


def clip(*values: float) -> Tensor:
    """``(1, T, 3, 1, 1)``: T frames of one gray pixel."""
    return torch.tensor(values, dtype=torch.float32).reshape(1, -1, 1, 1, 1).expand(1, -1, 3, 1, 1)


TWO = torch.zeros(1, 2, 3, 1, 2)
TWO[:, 1, :, :, 0] = 0.002
# Metric, image, reference, value, and the bound of its relative error.
WRITTEN_OUT = [
    # |1 - 3| / (1 + 3 + 0.01), and a black pixel without an error.
    (smape_linear, image(1, 0), image(3, 0), 2 / 4.01 / 2, 1e-6),
    # In the dark the epsilon decides: 0.01 against 0 is half an error, not a whole one.
    (smape_linear, image(0.01), image(0), 0.5, 1e-6),
    # Differences 1, 2 against 1, 0: the first has no error, the second |2 - 0| / (2 + 0 + 0.01).
    (temporal_smape_linear, clip(0, 1, 3), clip(5, 6, 6), 2 / 2.01 / 2, 1e-6),
    # Differences are absolute, so the direction does not matter.
    (temporal_smape_linear, clip(0, 1), clip(1, 0), 0, 0),
    # The errors of a pixel's channels are relative to the mean of these.
    (relmse_linear, rgb(1, 2, 3), rgb(1, 2, 6), 9 / (3**2 + 0.01) / 3, 1e-6),
    # One of two pixels has an error of 2 in every channel: sqrt((4 + 0) / 2).
    (rmse_linear, image(1, 5), image(3, 5), math.sqrt(2), 1e-6),
    # The sRGB curve multiplies values up to 0.0031308 by 12.92; an error of 0.01292 is -20 log10(0.01292) dB.
    (psnr_srgb, image(0.001), image(0.002), -20 * math.log10(0.01292), 2e-5),
    (psnr_srgb, image(5), image(1), math.inf, 0),
    # The errors 0, 1, 3 (in 1/1000) change by 1 and 2.
    (temporal_rmse_srgb, clip(0, 0.001, 0.003), clip(0, 0, 0), 12.92e-3 * (1 + 2) / 2, 1e-4),
    # A change in the wrong direction is an error, unlike in temporal_smape_linear.
    (temporal_rmse_srgb, clip(0, 0.001), clip(0.001, 0), 12.92e-3 * 2, 1e-4),
    # The root is taken of the mean over the frame, in which one of two pixels changes by 0.002.
    (temporal_rmse_srgb, TWO, torch.zeros_like(TWO), 12.92 * 0.002 / math.sqrt(2), 1e-4),
    # Changes above white are not displayed, and a constant error does not flicker.
    (temporal_rmse_srgb, clip(2, 7), clip(1, 1), 0, 0),
]


@pytest.mark.parametrize(("metric", "image", "reference", "expected", "bound"), WRITTEN_OUT)
def test_written_out(metric: Any, image: Tensor, reference: Tensor, expected: float, bound: float) -> None:
    assert metric(image, reference).item() == pytest.approx(expected, rel=bound, abs=0)


def noisy_pair(height: int, width: int) -> tuple[Tensor, Tensor]:
    torch.manual_seed(0)
    y, x = torch.meshgrid(torch.linspace(0, 3, height), torch.linspace(0, 5, width), indexing="ij")
    reference = torch.stack([0.5 + 0.5 * torch.sin(x + y), 0.4 + 0.3 * torch.cos(2 * x), 0.3 * y])[None]
    return (reference + 0.1 * torch.randn_like(reference)).clamp_min(0), reference


def test_ssim_is_that_of_scikit_image() -> None:
    structural_similarity = pytest.importorskip("skimage.metrics").structural_similarity
    image, reference = noisy_pair(31, 40)
    expected = structural_similarity(
        displayed(image)[0].double().numpy(),
        displayed(reference)[0].double().numpy(),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1,
        channel_axis=0,
    )
    assert 0.1 < expected < 0.9
    # Measured: 1e-8 in double precision, 1e-7 in single.
    assert ssim_srgb(image.double(), reference.double()).item() == pytest.approx(expected, abs=1e-6)
    assert ssim_srgb(image, reference).item() == pytest.approx(expected, abs=1e-5)


def test_ssim_has_a_gradient() -> None:
    image, reference = (x.double() * 0.5 + 0.1 for x in noisy_pair(11, 12))
    image.requires_grad_()
    assert gradcheck(lambda x: ssim_srgb(x, reference), (image,), fast_mode=True)


@pytest.mark.parametrize("kind", ["LDR", "HDR"])
def test_flip_is_that_of_its_authors(kind: str) -> None:
    flip = pytest.importorskip("flip_evaluator")
    metric, show, light = (flip_srgb, displayed, 1) if kind == "LDR" else (flip_hdr, torch.clone, 40)
    image, reference = (light * x for x in noisy_pair(20, 24))
    test, truth = (show(x)[0].permute(1, 2, 0).contiguous().numpy() for x in (image, reference))
    # The mean of the error map without the color map.
    errors = flip.evaluate(truth, test, kind, applyMagma=False)[0]
    assert 0.05 < errors.mean() < 0.9
    assert metric(image, reference).item() == pytest.approx(float(errors.mean()), rel=1e-4)


def test_hdr_flip_sees_errors_that_a_display_clamps() -> None:
    pytest.importorskip("flip_evaluator")
    # Half the image is twenty times as bright as white.
    reference = torch.full((1, 3, 16, 16), 0.5)
    reference[..., 8:] = 20
    dimmer = reference.clamp_max(10)
    assert flip_srgb(dimmer, reference).item() == 0
    assert flip_hdr(dimmer, reference).item() > 0.05
    # Exposures depend on the reference alone, so errors beyond all of them are finite too.
    assert 0 < flip_hdr(torch.full_like(reference, 1e9), reference).item() <= 1


def test_temporal_metrics_batch_and_have_a_gradient() -> None:
    torch.manual_seed(0)
    clips, references = torch.rand(2, 3, 3, 4, 5, dtype=torch.float64), torch.rand(2, 3, 3, 4, 5, dtype=torch.float64)
    for metric in CLIP_METRICS:
        together = metric(clips, references)
        assert together.shape == (2,)
        torch.testing.assert_close(together[1], metric(clips[1], references[1]))
    assert gradcheck(lambda x: temporal_rmse_srgb(x, references), (clips.requires_grad_(),))


def test_displayed_values_agree_with_colour_science(colour: Any) -> None:
    values = torch.linspace(0, 1, 1001, dtype=torch.float64).expand(3, 1, 1001)
    expected = colour.cctf_encoding(values[0, 0].numpy(), "sRGB")
    # Measured: 2e-8, where the linear part meets the power curve.
    torch.testing.assert_close(displayed(values)[0, 0], torch.from_numpy(expected), atol=1e-7, rtol=0)


@pytest.mark.parametrize("metric", IMAGE_METRICS)
def test_leading_axes_are_batch_axes(metric: Callable[[Tensor, Tensor], Tensor]) -> None:
    torch.manual_seed(0)
    images, references = torch.rand(2, 4, 3, 12, 13) * 1.5, torch.rand(2, 4, 3, 12, 13) * 1.5
    together = metric(images, references)
    assert together.shape == (2, 4)
    for b in range(2):
        for t in range(4):
            torch.testing.assert_close(together[b, t], metric(images[b, t], references[b, t]))
