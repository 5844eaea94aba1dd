"""Image and video metrics: one value for each image or clip; the suffix of a name tells the domain of its values.

Images are ``(..., 3, H, W)`` scene-linear radiance; all axes before the last three are batch axes.
"""

from mcdenoise.metrics.display import display_codes, displayed, flip_hdr, flip_srgb, psnr_gamma, psnr_srgb, ssim_srgb
from mcdenoise.metrics.linear import relmse_linear, rmse_linear, smape_linear
from mcdenoise.metrics.metric import Metric, UncomputableError
from mcdenoise.metrics.protocols import PROTOCOLS, Protocol, aces_displayed, gamma_displayed
from mcdenoise.metrics.temporal import (
    Flicker,
    temporal_rmse_srgb,
    temporal_smape_linear,
    warped_rmse_srgb,
    warping_error_srgb,
)

__all__ = [
    "PROTOCOLS",
    "Flicker",
    "Metric",
    "Protocol",
    "UncomputableError",
    "aces_displayed",
    "display_codes",
    "displayed",
    "flip_hdr",
    "flip_srgb",
    "gamma_displayed",
    "psnr_gamma",
    "psnr_srgb",
    "relmse_linear",
    "rmse_linear",
    "smape_linear",
    "ssim_srgb",
    "temporal_rmse_srgb",
    "temporal_smape_linear",
    "warped_rmse_srgb",
    "warping_error_srgb",
]
