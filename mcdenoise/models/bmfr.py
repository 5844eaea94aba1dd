"""BMFR, a filter without weights: it fits every block of the image by a linear combination of its features.

Koskela et al. 2019, "Blockwise Multi-Order Feature Regression for Real-Time Path-Tracing Reconstruction", ACM
Transactions on Graphics 38(5), and its public code, ``bmfr.cl``. The steps are:

1. Demodulated radiance is accumulated with the weight ``max(1 / n, 0.2)`` of the current frame
   (:class:`mcdenoise.models.Accumulated`).
2. Blocks of 32x32 pixels, whose origin cycles through 16 offsets from frame to frame, are fitted by 1, the normal, the
   position, and the squares of the position (:func:`mcdenoise.ops.block_regression`). Negative results are clamped to
   0.
3. The result is accumulated again, over the taps that the first accumulation accepted, with ``max(1 / n, 0.1)``.
4. The result is remodulated, gamma-mapped, and temporally anti-aliased with the weight 0.2
   (:class:`mcdenoise.models.antialiased.Antialiased`).

Differences from the public code:

- The limits of its consistency test are in scene units, chosen for each scene. Here they are relative to the depth.
- The code adds noise of +-0.01 to the features, different in every frame, to make them linearly independent. Here a
  ridge does this, so that the result of a frame is reproducible. The ridge is as small as float32's rounding, so that
  radiance that is linear in the features is preserved.
- The code normalizes positions to 0..1 within a block only if they span more than one scene unit; smaller spans are
  lost in its noise. Here each feature is normalized in every block, whatever its unit.
- The code squares world coordinates; here the distances from the block's mean are squared. Together with the positions
  and 1, both span the same functions.
- The code ends with an 8-bit image: gamma-mapped values are clamped at 1 before anti-aliasing. Here nothing is clamped
  and the result is mapped back to linear radiance. For values up to 1 both agree.

Layers and alpha are fitted, accumulated and clamped at 0 together with the color.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from mcdenoise.errors import InputError
from mcdenoise.frame import MOTION, Frame
from mcdenoise.models._contract import check_needs
from mcdenoise.models._history import Past, reprojected
from mcdenoise.models._interface import Model, Needs, Output, State
from mcdenoise.models._layers import answered, with_carried
from mcdenoise.models._published import ALPHA, as_published
from mcdenoise.models._registry import register_model
from mcdenoise.models._state import own_state
from mcdenoise.models.antialiased import Antialiased
from mcdenoise.ops import block_regression
from mcdenoise.ops._window import mirrored_places, parts_of
from mcdenoise.ops.regression import BLOCK

# Offsets of the first block of a frame, (x, y) in pixels for blocks of 32; half a block is subtracted from both.
_OFFSETS = (
    *((-14, -14), (4, -6), (-8, 14), (8, 0), (-10, -8), (2, 12), (12, -12), (-10, 0)),
    *((12, 14), (-8, -16), (6, 6), (-2, -2), (6, -14), (-16, 12), (14, -4), (-6, 4)),
)
# Rows and columns of a frame's first block before the image.
STARTS = [((BLOCK // 2 - y) % BLOCK, (BLOCK // 2 - x) % BLOCK) for x, y in _OFFSETS]


class History(NamedTuple):
    """State of a shot.

    Args:
        past: its image is the fitted and accumulated color, followed by layers and alpha.
        number: ``(B, 1, 1, 1)`` number of the next frame, modulo 16.
    """

    past: Past
    number: Tensor


class Bmfr(nn.Module):
    """Fits accumulated radiance by the features of each block, and accumulates the result.

    It has to be wrapped in :class:`mcdenoise.models.Accumulated`.

    Args:
        second_alpha: smallest weight of the current frame in the second accumulation, in (0, 1].

    Raises:
        InputError: a setting is out of its range.
    """

    _starts: Tensor

    def __init__(self, *, second_alpha: float = 0.1) -> None:
        super().__init__()
        if not 0 < second_alpha <= 1:
            raise InputError(f"second_alpha: expected in (0, 1], found {second_alpha}")
        self.second_alpha, self.persistence = second_alpha, 1 - second_alpha
        self.register_buffer("_starts", torch.tensor(STARTS), persistent=False)
        buffers = frozenset({"color", "normal", "position", "length"})
        self.needs = Needs(buffers, MOTION - {"position"} | {"view_projection"}, trainable=False)

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        check_needs(self.needs, frame.buffers)
        color, light = frame.color, with_carried(frame)
        history = own_state(state, History, frame, channels=light.shape[1])
        number = torch.zeros_like(color[:, :1, :1, :1]) if history is None else history.number
        images = self._fitted(frame, light, number)
        fitted = images[:, :3]
        # Over the taps and with the length of the first accumulation.
        before, weight, _ = reprojected(frame, history and history.past, light.shape[1], "bmfr")
        assert frame.length is not None
        alpha = torch.where(weight > 0, (1 / frame.length).clamp_min(self.second_alpha), 1)
        images = torch.lerp(before.to(images.dtype), images, alpha.to(images.dtype))
        kept = Past.of(frame, images)
        after = None if kept is None else History(kept, (number + 1) % len(_OFFSETS))
        return answered(frame, images)._replace(stages={"fitted": fitted}), after

    def _fitted(self, frame: Frame, images: Tensor, number: Tensor) -> Tensor:
        """Fit the images in the blocks of this frame; clamp at 0."""
        assert frame.normal is not None
        assert frame.position is not None
        features = torch.cat([frame.normal, frame.position], 1)
        # Images of a batch may be at different frame numbers; the offset is looked up on the device.
        starts = self._starts[number.flatten().long()].mT[..., None]
        whole, back = [], []
        for size, start in zip(frame.size, starts.unbind(), strict=True):
            places = torch.arange(parts_of(size + BLOCK - 1, BLOCK) * BLOCK, device=start.device)
            # Beyond the image its pixels are mirrored.
            whole.append(mirrored_places(places - start, size))
            back.append(torch.arange(size, device=start.device) + start)
        fitted = block_regression(_gathered(images, *whole), _gathered(features, *whole), squares=3)
        return _gathered(fitted, *back).clamp_min(0)


def _gathered(image: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
    """The pixels at some rows ``(B, N)`` and columns ``(B, M)`` of each image of a batch, ``(B, C, N, M)``."""
    index = (rows[:, :, None] * image.shape[-1] + columns[:, None]).flatten(1)[:, None]
    found = image.flatten(2).gather(2, index.expand(-1, image.shape[1], -1))
    return torch.unflatten(found, 2, (rows.shape[1], columns.shape[1]))


@register_model("bmfr", kind="filter", paper="Koskela et al. 2019")
def bmfr(
    *,
    alpha_min: float = ALPHA,
    second_alpha: float = 0.1,
    taa: bool = True,
    taa_alpha: float = 0.2,
) -> Model:
    """Blockwise multi-order feature regression (Koskela et al. 2019), with its accumulations and anti-aliasing.

    Args:
        alpha_min: smallest weight of the current frame in the first accumulation, in (0, 1].
        second_alpha: the same for the second accumulation.
        taa: whether the result is temporally anti-aliased, as published.
        taa_alpha: weight of the current frame in the anti-aliasing, in (0, 1].
    """
    model = as_published(Bmfr(second_alpha=second_alpha), alpha_min)
    return Antialiased(model, alpha=taa_alpha) if taa else model
