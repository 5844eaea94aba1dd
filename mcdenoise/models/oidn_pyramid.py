"""The method ``oidn_pyramid``: Open Image Denoise's images corrected by a network, and made steady.

Its two images of a frame, for noisy and for clean features, are wrong in other places, and both in other ones than a
mean of noisy pixels is: the network of ``pyramid`` sees all three, and weighs them pixel by pixel. That is an ensemble
as of Zheng et al. 2021, "Ensemble Denoising for Monte Carlo Renderings", with a learnt denoiser as one of those in it,
which is trained to be right where the library is not.
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
from mcdenoise.models.with_oidn import OIDN, OIDN_CLEAN, WithOidn


@register_model("oidn_pyramid", kind="peer", paper="after Zheng et al. 2021", requires="pyoidn")
def oidn_pyramid(
    width: int = 16,
    kernel_size: int = 5,
    *,
    quality: Quality = "high",
    threads: int | None = None,
    history: float = 10.0,
) -> Model:
    """Open Image Denoise (optional package pyoidn) corrected by a network that sees the noisy pixels, and made steady.

    Args:
        width: feature channels of the finest level of the network, a multiple of 4.
        kernel_size: side of its kernels.
        quality: see :class:`mcdenoise.models.with_oidn.WithOidn`.
        threads: likewise.
        history: see :class:`mcdenoise.models.steadied.Steadied`.

    Raises:
        InputError: as of both.
    """
    network = PyramidNetwork(widths_of(width), kernel_size, others=(OIDN, OIDN_CLEAN))
    corrected, steadied = Demodulated(Tiled(network)), Recurrent(Tiled(Steadied(history)))
    return WithOidn(Chain(corrected=corrected, steadied=steadied), quality=quality, threads=threads)
