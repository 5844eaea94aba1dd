"""Protocols of published numbers: tone curve, rounding, windows, data range, and skipped frames and rows.

Numbers of different protocols are not comparable: for the same images, the SSIM of ``meng2020`` is higher than that of
``strict`` by 0.04 to 0.1.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

from mcdenoise.metrics.display import flip, psnr_of, psnr_srgb, ssim_of, ssim_srgb
from mcdenoise.metrics.linear import mse, rmse_linear, smape_linear
from mcdenoise.metrics.metric import Metric, check_images, check_window, package_of

ProtocolName = Literal["strict", "meng2020", "fan2021", "noisebase"]

# Side of the window of the older SSIM.
_BOX = 7
# The published code of both protocols rounds 1 / 2.2 to this.
_GAMMA = 0.454545
# The ACES fit by Stephen Hill (BakingLab): matrices from linear sRGB to the space of the curve and back.
_ACES_IN = ((0.59719, 0.35458, 0.04823), (0.07600, 0.90834, 0.01566), (0.02840, 0.13383, 0.83777))
_ACES_OUT = ((1.60475, -0.53108, -0.07367), (-0.10208, 1.10813, -0.00605), (-0.00327, -0.07276, 1.07602))
_REC709_LUMINANCE = (0.2126, 0.7152, 0.0722)
# Noisebase renders 1080 rows and crops the same number at the top and at the bottom, so that 1024 remain.
_NOISEBASE_ROWS, _NOISEBASE_CUT = 1080, 28


@dataclass(frozen=True)
class Protocol:
    """The way in which a publication computed its numbers from scene-linear images.

    Args:
        description: tone curve, rounding, SSIM, and skipped frames and rows, in one line.
        metrics: metrics by name; they take scene-linear radiance like those of :mod:`mcdenoise.metrics`.
        skipped_frames: number of frames at the start of a sequence that are not compared.
        missing: metrics of the publication that are not computed here, with the reason.
    """

    description: str
    metrics: Mapping[str, Metric]
    skipped_frames: int = 0
    missing: Mapping[str, str] = field(default_factory=dict)


def gamma_displayed(image: Tensor) -> Tensor:
    """Scene-linear radiance with a power curve, as in Meng et al. and Fan et al.: ``min(max(x, 0)^0.454545, 1)``.

    Args:
        image: scene-linear radiance of any shape.

    Returns:
        The same shape, in [0, 1].
    """
    return image.clamp_min(0).pow(_GAMMA).clamp_max(1)


def aces_displayed(image: Tensor) -> Tensor:
    """Scene-linear radiance with Stephen Hill's fit of the ACES curves, clamped to [0, 1], then raised to 1/2.2.

    Args:
        image: ``(..., 3, H, W)`` scene-linear radiance, Rec. 709 primaries.

    Returns:
        The same shape, in [0, 1].
    """
    x = _matrix(_ACES_IN, image)
    x = (x * (x + 0.0245786) - 0.000090537) / (x * (0.983729 * x + 0.4329510) + 0.238081)
    return _matrix(_ACES_OUT, x).clamp(0, 1).pow(1 / 2.2)


def _matrix(rows: tuple[tuple[float, ...], ...], image: Tensor) -> Tensor:
    return torch.einsum("ji,...ihw->...jhw", torch.tensor(rows, dtype=image.dtype, device=image.device), image)


def _show_meng2020(image: Tensor) -> Tensor:
    return torch.floor(gamma_displayed(image) * 255 + 0.5) / 255


def _show_noisebase(image: Tensor) -> Tensor:
    if image.shape[-2] == _NOISEBASE_ROWS:
        image = image[..., _NOISEBASE_CUT:-_NOISEBASE_CUT, :]
    return torch.floor(aces_displayed(image) * 255) / 255


def _of_shown(
    show: Callable[[Tensor], Tensor], function: Callable[[Tensor, Tensor], Tensor]
) -> Callable[[Tensor, Tensor], Tensor]:
    """Turn a metric of displayed values into a metric of scene-linear radiance."""

    def metric(image: Tensor, reference: Tensor) -> Tensor:
        check_images(image, reference)
        return function(show(image), show(reference))

    return metric


def _ssim_default(image: Tensor, reference: Tensor) -> Tensor:
    """SSIM by the defaults of scikit-image before 0.20 for floats: 7x7 box, sample covariance, a data range of 2."""
    x, y = (each.reshape(-1, *each.shape[-3:]) for each in (image, reference))
    check_window("SSIM's window", x, _BOX)
    mean = partial(avg_pool2d, kernel_size=_BOX, stride=1)
    sample, c1, c2 = _BOX**2 / (_BOX**2 - 1), (0.01 * 2) ** 2, (0.03 * 2) ** 2
    xx, yy, xy = (sample * (mean(a * b) - mean(a) * mean(b)) for a, b in ((x, x), (y, y), (x, y)))
    x, y = mean(x), mean(y)
    values = (2 * x * y + c1) * (2 * xy + c2) / ((x * x + y * y + c1) * (xx + yy + c2))
    return values.mean((-3, -2, -1)).reshape(image.shape[:-3])


def _smape_percent(image: Tensor, reference: Tensor) -> Tensor:
    return 200 * smape_linear(image, reference, epsilon=1e-7)


def _relmse(image: Tensor, reference: Tensor) -> Tensor:
    return ((image - reference).square() / (reference.square() + 1e-7)).mean((-3, -2, -1))


def _luminance_noisebase(image: Tensor) -> Tensor:
    """``(..., 1, H, W)`` luminance of displayed values with a gamma of 2.2."""
    shown = _show_noisebase(image)
    weights = torch.tensor(_REC709_LUMINANCE, dtype=shown.dtype, device=shown.device).reshape(3, 1, 1)
    return (shown.pow(2.2) * weights).sum(-3, keepdim=True)


def _ms_ssim(image: Tensor, reference: Tensor) -> Tensor:
    check_window("MS-SSIM's five scales", image, 161)
    package = package_of("MS-SSIM", "pytorch-msssim", "pytorch_msssim")
    flat = (each.reshape(-1, *each.shape[-3:]) for each in (image, reference))
    values: Tensor = package.ms_ssim(*flat, data_range=1.0, size_average=False)
    return values.reshape(image.shape[:-3])


def _temporal_psnr(clip: Tensor, reference: Tensor) -> Tensor:
    return psnr_of(clip.diff(dim=-4), reference.diff(dim=-4)).mean(-1)


def _temporal_rmae(clip: Tensor, reference: Tensor) -> Tensor:
    """The factor 1/3 is noisebase's: it divides the mean over the channels by their number once more."""
    moved, truth = clip.diff(dim=-4), reference.diff(dim=-4)
    return ((moved - truth).abs() / (truth.abs() + 0.01)).mean((-3, -2, -1)).mean(-1) / 3


_meng2020 = partial(_of_shown, _show_meng2020)
_fan2021 = partial(_of_shown, gamma_displayed)
_noisebase = partial(_of_shown, _show_noisebase)

PROTOCOLS: dict[ProtocolName, Protocol] = {
    "strict": Protocol(
        "clamped to [0, 1], sRGB curve, floats; SSIM with an 11x11 Gaussian window and data range 1; every frame",
        {"PSNR": Metric(psnr_srgb, higher_is_better=True), "SSIM": Metric(ssim_srgb, higher_is_better=True)},
    ),
    "meng2020": Protocol(
        "x^0.454545, clamped to [0, 1], rounded to 8 bits; SSIM with a 7x7 box window, sample covariance and data "
        "range 2; RMSE, SMAPE (in per cent) and relMSE of the same values",
        {
            "PSNR": Metric(_meng2020(psnr_of), higher_is_better=True),
            "SSIM": Metric(_meng2020(_ssim_default), higher_is_better=True),
            "RMSE": Metric(_meng2020(rmse_linear)),
            "SMAPE": Metric(_meng2020(_smape_percent)),
            "relMSE": Metric(_meng2020(_relmse)),
        },
    ),
    "fan2021": Protocol(
        "x^0.454545, clamped to [0, 1], floats; SSIM with a 7x7 box window, sample covariance and data range 2",
        {
            "PSNR": Metric(_fan2021(psnr_of), higher_is_better=True),
            "SSIM": Metric(_fan2021(_ssim_default), higher_is_better=True),
        },
    ),
    "noisebase": Protocol(
        "ACES fit, clamped to [0, 1], gamma 1/2.2, truncated to 8 bits; SSIM with an 11x11 Gaussian window and data "
        "range 1 of the luminance of x^2.2; without the first 16 frames, and with the middle 1024 of 1080 rows",
        {
            "PSNR": Metric(_noisebase(psnr_of), higher_is_better=True),
            "SSIM": Metric(_of_shown(_luminance_noisebase, ssim_of), higher_is_better=True),
            "MS-SSIM": Metric(_of_shown(_luminance_noisebase, _ms_ssim), higher_is_better=True),
            "FLIP": Metric(_noisebase(partial(flip, dynamic_range="LDR"))),
            "MSE": Metric(_noisebase(mse)),
            "tPSNR": Metric(_noisebase(_temporal_psnr), higher_is_better=True, temporal=True),
            "tRMAE": Metric(_noisebase(_temporal_rmae), temporal=True),
        },
        skipped_frames=16,
        missing={"FVVDP": "FovVideoVDP is a video metric of another package, pyfvvdp"},
    ),
}
