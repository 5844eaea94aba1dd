"""BMFR, a filter without weights: every block of the image is the best combination of its features.

Koskela et al. 2019, "Blockwise Multi-Order Feature Regression for Real-Time Path-Tracing Reconstruction", ACM
Transactions on Graphics 38(5), and its public code, ``bmfr.cl``. In its order:

1. The radiance without albedo is accumulated by its rule, with the weight ``max(1 / n, 0.2)`` of the current frame
   (:class:`mcdenoise.models.Accumulated`, ``rule="bmfr"``). The limits of the rule are in scene units, and the authors
   chose them for each scene: the defaults are those of their "classroom".
2. Blocks of 32x32 pixels, which begin in another one of 16 places in every frame, are fitted by 1, the normal, the
   position, and the squares of the position (:func:`mcdenoise.ops.block_regression`). What is negative is cut off.
3. The result is accumulated once more, over the taps that the first accumulation accepted, with ``max(1 / n, 0.1)``.
4. It gets its albedo back, is gamma-mapped, and anti-aliased over time with the weight 0.2
   (:class:`mcdenoise.models.antialiased.Antialiased`).

What differs from the public code:

- It adds noise of +-0.01 to the features, another one in every frame, lest they depend on one another. Here a ridge
  does that, which leaves the result of a frame the same however often it is computed; and it is as small as float32's
  rounding, so that what is linear in the features stays.
- It brings positions to 0..1 within a block only where they span more than one scene unit, and loses smaller ones in
  its noise. Here each feature has the same spread in every block, whatever its unit.
- Its squares are those of the world's coordinates; here they are those of the distances from the block's mean. Both
  with the positions themselves and 1 span the same functions.
- It ends with an image of 8 bits: gamma-mapped values are cut off at 1 before they are anti-aliased. Radiance has no
  such limit, so that nothing is cut off here, and the result is brought back to linear radiance. In numbers up to 1
  that is the same.

Layers and alpha are fitted and accumulated as the color is, and cut off below 0 as it is.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from mcdenoise.errors import InputError
from mcdenoise.frame import MOTION, Frame
from mcdenoise.models._contract import check_needs
from mcdenoise.models._interface import Model, Needs, Output, State
from mcdenoise.models._journal import timed
from mcdenoise.models._layers import answered, with_carried
from mcdenoise.models._published import NORMAL_LIMIT, POSITION_LIMIT, as_published
from mcdenoise.models._registry import register_model
from mcdenoise.models._state import own_state
from mcdenoise.models.accumulated import has_motion, motion_unless_still, surface_before
from mcdenoise.models.antialiased import Antialiased
from mcdenoise.ops import Surface, block_regression, reproject
from mcdenoise.ops.regression import BLOCK, RIDGE

# Where the first block of a frame begins, (x, y) in pixels of blocks of 32; half a block is taken off both.
_OFFSETS = (
    *((-14, -14), (4, -6), (-8, 14), (8, 0), (-10, -8), (2, 12), (12, -12), (-10, 0)),
    *((12, 14), (-8, -16), (6, 6), (-2, -2), (6, -14), (-16, 12), (14, -4), (-6, 4)),
)


class History(NamedTuple):
    """What is kept of a shot.

    Args:
        images: ``(B, 3 + C, H, W)`` fitted and accumulated, with layers and alpha behind the color.
        surface: what was seen.
        view_projection: ``(B, 4, 4)`` by which camera.
        number: ``(B, 1, 1, 1)`` of the next frame, modulo 16.
    """

    images: Tensor
    surface: Surface
    view_projection: Tensor | None
    number: Tensor


class Bmfr(nn.Module):
    """Fits accumulated radiance by the features of each block, and accumulates what comes of it.

    It stands in :class:`mcdenoise.models.Accumulated`, with the same limits.

    Args:
        block: side of a block in pixels, at least 2.
        second_alpha: smallest weight of the current frame in the second accumulation, in (0, 1].
        position_limit: see :func:`mcdenoise.ops.reproject`, rule "bmfr".
        normal_limit: likewise.
        ridge: see :func:`mcdenoise.ops.block_regression`.

    Raises:
        InputError: a setting is out of its range.
    """

    _starts: Tensor

    def __init__(
        self,
        *,
        block: int = BLOCK,
        second_alpha: float = 0.1,
        position_limit: float = POSITION_LIMIT,
        normal_limit: float = NORMAL_LIMIT,
        ridge: float = RIDGE,
    ) -> None:
        super().__init__()
        if block < 2:
            raise InputError(f"block: expected at least 2, found {block}")
        if not 0 < second_alpha <= 1:
            raise InputError(f"second_alpha: expected in (0, 1], found {second_alpha}")
        if not 0 < ridge < math.inf:
            raise InputError(f"ridge: expected a positive number, found {ridge}")
        self.block, self.second_alpha, self.ridge = block, second_alpha, ridge
        self.position_limit, self.normal_limit = position_limit, normal_limit
        starts = torch.tensor([_start(number, block) for number in range(len(_OFFSETS))])
        self.register_buffer("_starts", starts, persistent=False)

    @property
    def needs(self) -> Needs:
        """Features, and the length of the accumulated history; whatever tells motion is of use."""
        buffers = frozenset({"color", "normal", "position", "length"})
        return Needs(buffers, MOTION - {"position"} | {"view_projection"}, trainable=False)

    @property
    def persistence(self) -> float:
        """What one more frame leaves of the history, see :func:`mcdenoise.models.frames_remembered`."""
        return 1 - self.second_alpha

    def forward(self, frame: Frame, state: State = None) -> tuple[Output, State]:
        """See :class:`mcdenoise.models.Model`."""
        check_needs(self.needs, frame.buffers)
        color, light = frame.color, with_carried(frame)
        history = own_state(state, History, frame, channels=light.shape[1])
        number = torch.zeros_like(color[:, :1, :1, :1]) if history is None else history.number
        with timed("fit", color.device):
            images = self._fitted(frame, light, number)
            fitted = images[:, :3]
        if history is not None:
            with timed("accumulate again", color.device):
                images = self._accumulated(frame, images, history)
        surface = Surface(frame.position, frame.normal)
        after = History(images, surface, frame.view_projection, (number + 1) % len(_OFFSETS))
        return answered(frame, images)._replace(stages={"fitted": fitted}), after

    def _fitted(self, frame: Frame, images: Tensor, number: Tensor) -> Tensor:
        """Fitted by the blocks of this frame, none below zero."""
        assert frame.normal is not None
        assert frame.position is not None
        features = torch.cat([frame.normal, frame.position], 1)
        # Images of a batch may be at different places of their shots; and no place is read from where it is computed.
        rows, columns = self._starts[number.flatten().long()].unbind(1)
        image, guide = (
            _moved(_moved(each, rows, -2, self.block), columns, -1, self.block) for each in (images, features)
        )
        fitted = block_regression(image, guide, block=self.block, squares=3, ridge=self.ridge)
        height, width = frame.size
        return _moved_back(_moved_back(fitted, rows, -2, height), columns, -1, width).clamp_min(0)

    def _accumulated(self, frame: Frame, images: Tensor, history: History) -> Tensor:
        """With the result before, at the taps and with the length of the first accumulation."""
        if not has_motion(frame, history.view_projection):
            return images
        motion = motion_unless_still(frame, history.view_projection)
        surface = surface_before(frame)._replace(depth=None)
        limits = {"position_limit": self.position_limit, "normal_limit": self.normal_limit}
        before, weight = reproject(history.images, motion, surface, history.surface, rule="bmfr", **limits)
        assert frame.length is not None
        alpha = torch.where(weight > 0, (1 / frame.length).clamp_min(self.second_alpha), 1)
        return torch.lerp(before, images, alpha.to(images.dtype))


def _moved(image: Tensor, starts: Tensor, axis: int, block: int) -> Tensor:
    """Whole blocks that begin so many pixels before each image ``(B, C, H, W)``, which goes on mirrored."""
    size = image.shape[axis]
    places = torch.arange(-(-(size + block - 1) // block) * block, device=image.device)
    places = (places - starts[:, None]) % (2 * size)
    return _taken(image, torch.minimum(places, 2 * size - 1 - places), axis)


def _moved_back(blocks: Tensor, starts: Tensor, axis: int, size: int) -> Tensor:
    """The inverse of :func:`_moved`."""
    return _taken(blocks, torch.arange(size, device=blocks.device) + starts[:, None], axis)


def _taken(image: Tensor, places: Tensor, axis: int) -> Tensor:
    """Of each image of a batch other places along one of its last two axes, ``(B, N)``."""
    index = places[:, None, :, None] if axis == -2 else places[:, None, None, :]
    shape = list(image.shape)
    shape[axis] = places.shape[1]
    return image.gather(axis, index.expand(shape))


def _start(number: int, block: int) -> tuple[int, int]:
    """How many rows and columns before the image the blocks of a frame begin."""
    x, y = _OFFSETS[number % len(_OFFSETS)]
    return ((BLOCK // 2 - y) * block // BLOCK) % block, ((BLOCK // 2 - x) * block // BLOCK) % block


@register_model("bmfr", kind="filter", paper="Koskela et al. 2019")
def bmfr(
    *,
    alpha_min: float = 0.2,
    second_alpha: float = 0.1,
    taa: bool = True,
    taa_alpha: float = 0.2,
    position_limit: float = POSITION_LIMIT,
    normal_limit: float = NORMAL_LIMIT,
    block: int = BLOCK,
    ridge: float = RIDGE,
) -> Model:
    """Blockwise multi-order feature regression of Koskela et al. 2019, with its accumulations and its anti-aliasing.

    Args:
        alpha_min: smallest weight of the current frame in the first accumulation, in (0, 1].
        second_alpha: the same of the second one.
        taa: whether the result is anti-aliased over time, as the published one is.
        taa_alpha: weight of the current frame in that, in (0, 1].
        position_limit: squared distance in scene units below which two points are one, see
            :func:`mcdenoise.ops.reproject`.
        normal_limit: likewise for normals.
        block: see :func:`mcdenoise.ops.block_regression`.
        ridge: likewise.
    """
    limits = {"position_limit": position_limit, "normal_limit": normal_limit}
    fit = Bmfr(block=block, second_alpha=second_alpha, ridge=ridge, **limits)
    model = as_published(fit, alpha_min, position_limit, normal_limit)
    return Antialiased(model, alpha=taa_alpha) if taa else model
