"""The method ``oidn_pyramid``: a network combines Open Image Denoise's images with the noisy pixels, then stabilizes.

OIDN's images for noisy and for clean features have different errors, and both differ from the errors of a mean of noisy
pixels. The network of ``pyramid`` takes all three and predicts their weights for each pixel. This is an ensemble as in
Zheng et al. 2021, "Ensemble Denoising for Monte Carlo Renderings"; its own learnt member is trained to be right where
the library is not.
"""

from __future__ import annotations

from mcdenoise.models._interface import Model
from mcdenoise.models._registry import register_model
from mcdenoise.models.chain import Chain
from mcdenoise.models.demodulated import Demodulated
from mcdenoise.models.oidn import Quality
from mcdenoise.models.pyramid import PyramidNetwork, widths_of
from mcdenoise.models.recurrent import Recurrent
from mcdenoise.models.steadied import Steadied
from mcdenoise.models.tiled import Tiled
from mcdenoise.models.with_oidn import OIDN, OIDN_ALBEDO, OIDN_CLEAN, Engine, WithOidn


@register_model("oidn_pyramid", kind="peer", paper="after Zheng et al. 2021", requires="pyoidn")
def oidn_pyramid(
    width: int = 16,
    kernel_size: int = 5,
    *,
    quality: Quality = "high",
    threads: int | None = None,
    engine: Engine = "library",
    history: float = 4.0,
) -> Model:
    """Combine Open Image Denoise (optional package pyoidn) with a network on the noisy pixels, and stabilize over time.

    Args:
        width: feature channels of the finest level of the network, a multiple of 4.
        kernel_size: side of the network's kernels.
        quality: see :class:`mcdenoise.models.with_oidn.WithOidn`.
        threads: likewise.
        engine: see :class:`mcdenoise.models.with_oidn.WithOidn`.
        history: see :class:`mcdenoise.models.steadied.Steadied`.

    Raises:
        InputError: see both classes.
    """
    network = PyramidNetwork(widths_of(width), kernel_size, others=(OIDN, OIDN_CLEAN))
    corrected, steadied = Demodulated(Tiled(network)), Recurrent(Tiled(Steadied(history)), albedo=OIDN_ALBEDO)
    return WithOidn(Chain(corrected=corrected, steadied=steadied), quality=quality, threads=threads, engine=engine)
