"""The method ``oidn_temporal``: Open Image Denoise made steady, and its two ways with features in one.

The library denoises every frame by itself, in the state of the art for a still, and flickers in a film. And it has to
be told whether albedo and normal have noise, which is hardly ever true of a whole image: they are exact on a wall, and
noisy behind glass, in a blurred mirror and out of focus. Here it comes first, once for noisy and once for clean
features, and their mean is about as good as the better of them, which one had to know. Then the result of the frame
before is blended in. Nothing is learnt.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from mcdenoise.frame import Frame
from mcdenoise.models._interface import Model, Needs, Output, State
from mcdenoise.models._layers import answered
from mcdenoise.models._registry import register_model
from mcdenoise.models.chain import Chain
from mcdenoise.models.oidn import Quality
from mcdenoise.models.recurrent import Recurrent
from mcdenoise.models.steadied import Steadied
from mcdenoise.models.tiled import Tiled
from mcdenoise.models.with_oidn import EXACT, OIDN, OIDN_CLEAN, WithOidn

# Parts of the image for clean features for each of that for noisy ones, where they are not exact, and where they are.
_CLEAN_PARTS = (1.0, 3.0)


class Mixed(nn.Module):
    """The mean of Open Image Denoise's two images: ``(oidn + a oidn_clean) / (1 + a)``, a = 1, or 3 of exact features.

    See :class:`mcdenoise.models.with_oidn.WithOidn`, which hands it both.
    """

    @property
    def needs(self) -> Needs:
        """Color; of use is what it mixes."""
        return Needs(uses=frozenset({OIDN, OIDN_CLEAN, EXACT}), trainable=False, reach=0)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        noisy: Tensor = frame.extra.get(OIDN, frame.color)
        clean = frame.extra.get(OIDN_CLEAN, frame.color)
        exact = frame.extra.get(EXACT, torch.zeros_like(noisy[:, :1]))
        part = torch.where(exact > 0, _CLEAN_PARTS[1], _CLEAN_PARTS[0]).to(exact)
        return answered(frame, (noisy + part * clean) / (1 + part), None), None


@register_model("oidn_temporal", kind="peer", requires="pyoidn")
def oidn_temporal(*, quality: Quality = "high", threads: int | None = None, history: float = 10.0) -> Model:
    """Open Image Denoise (optional package pyoidn) for noisy and for clean features, made steady by the frame before.

    Args:
        quality: see :class:`mcdenoise.models.with_oidn.WithOidn`.
        threads: likewise.
        history: see :class:`mcdenoise.models.steadied.Steadied`.

    Raises:
        InputError: as of both.
    """
    steadied = Recurrent(Tiled(Steadied(history)))
    return WithOidn(Chain(mixed=Mixed(), steadied=steadied), quality=quality, threads=threads)
