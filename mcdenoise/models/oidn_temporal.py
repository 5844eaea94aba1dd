"""The method ``oidn_temporal``: Open Image Denoise's images for noisy and clean features combined, and stabilized.

The library denoises every frame separately: single images are state of the art, but sequences flicker. It also has to
be told whether albedo and normal have noise, which rarely holds for a whole image: they are exact on a wall, and noisy
behind glass, in a blurred mirror and out of focus. This method runs the library for noisy features and for clean ones,
which it denoises first if they have noise. The mean of both images is about as good as the better one, without having
to know which one that is. Then the previous result is blended in, and detail that the library has smoothed is given
back. No weights are learnt.
"""

from __future__ import annotations

from typing import Literal

from torch import Tensor

from mcdenoise.errors import check_choice
from mcdenoise.models._interface import Model
from mcdenoise.models._registry import register_model
from mcdenoise.models._wrapper import FromBuffers
from mcdenoise.models.chain import Chain
from mcdenoise.models.oidn import Quality
from mcdenoise.models.recurrent import Recurrent
from mcdenoise.models.restored import Restored
from mcdenoise.models.steadied import Steadied
from mcdenoise.models.tiled import Tiled
from mcdenoise.models.with_oidn import OIDN_ALBEDO, Engine, WithOidn

Auxiliary = Literal["both", "noisy"]
# Weight of the image for clean features relative to that for noisy ones. On 74 frames of training data the errors of
# weights from 2 to 8 differ by at most 1 %.
_CLEAN_PART = 3.0


def mixed(oidn: Tensor, oidn_clean: Tensor | None = None) -> Tensor:
    """A weighted mean of Open Image Denoise's images: ``(oidn + 3 oidn_clean) / 4``.

    Args:
        oidn: ``(B, 3, H, W)`` for noisy features, see :class:`mcdenoise.models.with_oidn.WithOidn`.
        oidn_clean: likewise, for clean ones; ``None`` for the first image alone.
    """
    return oidn if oidn_clean is None else (oidn + _CLEAN_PART * oidn_clean) / (1 + _CLEAN_PART)


@register_model("oidn_temporal", kind="peer")
def oidn_temporal(
    *,
    quality: Quality = "high",
    auxiliary: Auxiliary = "both",
    prefilter: Quality = "high",
    threads: int | None = None,
    engine: Engine = "auto",
    history: float = 4.0,
    restore: bool = True,
) -> Model:
    """Open Image Denoise (optional package pyoidn) for noisy and for clean features, stabilized by the previous result.

    Args:
        quality: see :class:`mcdenoise.models.with_oidn.WithOidn`.
        auxiliary: ``"noisy"`` takes only the image for noisy features, in a fifth to a half of the time.
        prefilter: see :class:`mcdenoise.models.with_oidn.WithOidn`.
        threads: see :class:`mcdenoise.models.with_oidn.WithOidn`.
        engine: see :class:`mcdenoise.models.with_oidn.WithOidn`.
        history: see :class:`mcdenoise.models.steadied.Steadied`.
        restore: whether :class:`mcdenoise.models.Restored` gives back detail.

    Raises:
        InputError: ``auxiliary`` is neither; otherwise see both classes.
    """
    check_choice("auxiliary", auxiliary, Auxiliary)
    both = auxiliary == "both"
    steadied = Recurrent(Tiled(Steadied(history)), albedo=OIDN_ALBEDO)
    chain = Chain(mixed=FromBuffers(mixed), steadied=steadied)
    model = WithOidn(chain, quality=quality, prefilter=prefilter, threads=threads, engine=engine, clean=both)
    return Restored(model) if restore else model
