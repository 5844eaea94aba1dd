"""The family ``cascaded_v3``: :mod:`mcdenoise.models.cascaded_v2` for frames as renderers write them.

The networks are those of ``cascaded_v2``. :class:`mcdenoise.models.refined.Refined` around them filters noisy features,
predicts how diffuse the light is, and decides for each pixel how far to trust the history. The history is shorter:
reprojected over many frames it is blurred and lags behind highlights, which costs more than the noise that it saves
unless the light is diffuse and very noisy.
"""

from __future__ import annotations

from mcdenoise.models._entries import register_family
from mcdenoise.models._interface import Model
from mcdenoise.models.cascaded_v2 import both_networks, with_history
from mcdenoise.models.refined import Refined
from mcdenoise.models.skipping import TOLERANCE


def _cascade(
    width: int = 40,
    kernel_width: int | None = None,
    kernel_size: int = 5,
    resolutions: int = 3,
    half: bool = False,
    feature_width: int = 16,
    *,
    alpha_min: float = 0.3,
    anti_lag: bool = True,
    tolerance: float = TOLERANCE,
    restore: bool = True,
) -> Model:
    """The cascade with all its wrappers.

    Args:
        width: feature channels of the pixel network.
        kernel_width: feature channels of the kernel network; ``width`` by default.
        kernel_size: K.
        resolutions: number of image sizes that the pixel network denoises.
        half: whether the U-Nets begin at half the resolution.
        feature_width: see :class:`mcdenoise.models.refined.FeatureNetwork`.
        alpha_min: see :class:`mcdenoise.models.Accumulated`.
        anti_lag: see :class:`mcdenoise.models.Accumulated`.
        tolerance: see :class:`mcdenoise.models.Skipping`.
        restore: whether :class:`mcdenoise.models.Restored` gives back detail.
    """
    networks = Refined(both_networks(width, kernel_width, kernel_size, resolutions, half), feature_width)
    return with_history(networks, alpha_min, anti_lag, tolerance, restore)


register_family(
    _cascade,
    "P+K for noisy features, with a short history",
    {
        "cascaded_v3": ("width 40, 5x5 kernels", {}),
        "cascaded_v3_small": ("widths 16 and 32, 5x5 kernels", {"width": 16, "kernel_width": 32}),
        "cascaded_v3_tiny": ("width 16, 3x3 kernels", {"width": 16, "kernel_size": 3, "feature_width": 12}),
        "cascaded_v3_micro": (
            "width 16, 3x3 kernels, half the resolution",
            {"width": 16, "kernel_size": 3, "half": True, "feature_width": 8},
        ),
    },
    kind="kernel",
    paper="after DOI 10.1007/s00371-023-02951-6",
)
