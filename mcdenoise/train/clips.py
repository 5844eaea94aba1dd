"""Training clips: successive frames, accumulated, cropped and augmented."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from kornia.augmentation import RandomHorizontalFlip, RandomRotation90, RandomVerticalFlip
from torch import Tensor, nn
from torch.nn.functional import normalize

from mcdenoise.errors import InputError
from mcdenoise.frame import RADIANCE, Frame, Hints
from mcdenoise.models.accumulated import ALBEDO_HISTORY
from mcdenoise.models.with_oidn import NOISY, OIDN, OIDN_CLEAN
from mcdenoise.nn.inputs import auto_exposure
from mcdenoise.ops import NO_ALBEDO, demodulate
from mcdenoise.train.cache import Array, Shot

_KNOWN = frozenset(field.name for field in fields(Frame))


# What holds radiance, colours, and vectors of the world: all else has no channels that could be shuffled.
LIGHT = frozenset({*RADIANCE, "reference", NOISY, OIDN, OIDN_CLEAN})
_COLORED = LIGHT | {"albedo", ALBEDO_HISTORY, "specular_albedo", "variance"}
_WORLD = frozenset({"normal", "position", "previous_position"})


@dataclass(frozen=True)
class Clip:
    """Successive frames of one shot, in the vocabulary of :class:`mcdenoise.frame.Frame`.

    Args:
        buffers: by name, ``(B, T, C, H, W)`` each, and ``view_projection`` ``(B, T, 4, 4)``.
    """

    buffers: dict[str, Tensor]

    @staticmethod
    def of(shot: dict[str, Tensor]) -> Clip:
        """A clip of what :meth:`mcdenoise.train.cache.Shot.read` has read: a batch of one."""
        return Clip({name: buffer[None] for name, buffer in shot.items()})

    def __getitem__(self, name: str) -> Tensor:
        return self.buffers[name]

    def __len__(self) -> int:
        return self["color"].shape[1]

    def to(self, device: torch.device) -> Clip:
        """The clip on another device."""
        return Clip({name: buffer.to(device) for name, buffer in self.buffers.items()})

    @property
    def batch(self) -> int:
        """B, the number of clips."""
        return len(self["color"])

    def frame(self, t: int | None = None) -> Frame:
        """One frame of each clip, or all frames of all of them as a batch of ``B T``."""
        when = slice(None) if t is None else slice(t, t + 1)
        # Convolutions are faster on channels last.
        flat: dict[str, Any] = {
            name: buffer[:, when].flatten(0, 1).contiguous(memory_format=torch.channels_last)
            if buffer.dim() == 5
            else buffer[:, when].flatten(0, 1)
            for name, buffer in self.buffers.items()
        }
        extra = {name: flat.pop(name) for name in list(flat) if name not in _KNOWN}
        return Frame(**flat, extra=extra, hints=Hints(keep_all=True))


class ClipSampler:
    """Draws random clips from shots: position, frames, noise, flips, 90-degree turns, and what else is exact physics.

    Each clip has a seed of its own, and depends on nothing else: a batch can be drawn in any order, at any time, by any
    number of processes.

    Flips and turns are kornia's, the same for all buffers and frames of a clip; motion vectors are flipped and turned
    with the image, and the camera's matrix projects to the crop, flipped and turned. World-space normals and positions
    stay as they are: a mirrored or turned image is one of a mirrored or turned world whose axes are named otherwise,
    and so the axes themselves are shuffled and reversed too. Colour channels are shuffled alike in radiance and albedo.

    Light is linear: all lamps of a scene, brighter by a factor or of another colour, make noisy color and reference
    brighter by this factor, channel by channel. The networks bring the exposure to a standard before they look; what
    the exposure changes is the loss, whose epsilon is in units of radiance. Another albedo would change the light that
    surfaces send to each other, so albedos are left alone.

    Args:
        shots: those shorter than ``frames`` are skipped.
        frames: T of a clip.
        crop: side of the square crop in pixels.
        lamps: chance that a clip gets rectangles of constant radiance, without noise, up to 30 times as bright as its
            mean: emitters seen directly, of which few training scenes have any.
        key: the typical radiance that each clip is brought to first, see :func:`mcdenoise.nn.inputs.auto_exposure`; 0
            leaves it as it is.
        exposure: all light of a clip is scaled by up to so many stops, up or down.
        tint: each colour channel of the light is scaled by up to so many stops, up or down.
        gloss: chance that what has no albedo in a clip (mirrors, glass, black gloss, and lamps) is darker, by up to six
            stops: emitters are common there, and a network that knows nothing else takes a black screen for one.

    Raises:
        InputError: no shot is long enough, or one is smaller than the crop.
    """

    def __init__(
        self,
        shots: Iterable[Shot],
        frames: int,
        crop: int,
        *,
        lamps: float = 0.0,
        key: float = 0.0,
        exposure: float = 0.0,
        tint: float = 0.0,
        gloss: float = 0.0,
    ) -> None:
        self.shots = [shot for shot in shots if len(shot) >= frames]
        self.frames, self.crop = frames, crop
        self.lamps, self.key, self.exposure, self.tint, self.gloss = lamps, key, exposure, tint, gloss
        check_sizes([(len(shot), shot.size) for shot in self.shots], frames, crop)
        self.chances = torch.tensor([float(len(shot)) for shot in self.shots])
        self.flips_and_turns = nn.Sequential(
            RandomHorizontalFlip(p=0.5),
            RandomVerticalFlip(p=0.5),
            # "nearest" moves whole numbers; "bilinear" would mix them.
            RandomRotation90((0, 3), p=1.0, resample="nearest"),
        )

    def draw(self, seeds: Sequence[int]) -> Clip:
        """A clip for each seed, from a shot drawn with a chance in proportion to its number of frames."""
        drawn = []
        # kornia draws from torch's global generator, which is others' too.
        with torch.random.fork_rng(devices=[]):
            for seed in seeds:
                torch.default_generator.manual_seed(seed)
                drawn.append(self._draw_one())
        return Clip({name: torch.stack([clip[name] for clip in drawn]) for name in drawn[0]})

    def _draw_one(self) -> dict[str, Tensor]:
        shot = self.shots[int(torch.multinomial(self.chances, 1))]
        height, width = shot.size
        realisation, start = _randint(len(shot.colors)), _randint(len(shot) - self.frames + 1)
        top, left = _randint(height - self.crop + 1), _randint(width - self.crop + 1)
        order, axes = torch.randperm(3).tolist(), torch.randperm(3).tolist()
        turn = self._draw_turn()
        clip = shot.read(
            slice(start, start + self.frames),
            slice(top, top + self.crop),
            slice(left, left + self.crop),
            realisation=realisation,
            channels=dict.fromkeys(_COLORED, order) | dict.fromkeys(_WORLD, axes),
            turn=turn.image,
        )
        signs = (torch.randint(2, (3, 1, 1)) * 2 - 1).float()
        for name in _WORLD & clip.keys():
            clip[name] *= signs
        if "motion" in clip:
            clip["motion"] = turn.vectors(clip["motion"])
        if "view_projection" in clip:
            view = _cropped(clip["view_projection"], (height, width), (top, left), self.crop)
            view[:, :3] = view[:, axes] * signs.reshape(3, 1)
            view[..., :2] = turn.vectors(view[..., :2].mT).mT
            clip["view_projection"] = view
        stops = self.exposure * (2 * torch.rand(1) - 1) + self.tint * (2 * torch.rand(3) - 1)
        factor = torch.exp2(stops).reshape(3, 1, 1)
        if self.key:
            factor = factor * auto_exposure(clip["reference"][:1], self.key)[0]
        _light(clip, factor)
        if self.gloss and float(torch.rand(())) < self.gloss:
            # Less is reflected or sent out towards the camera; what that would take from other surfaces is left out.
            glossy = clip["albedo"].amax(1, keepdim=True) < NO_ALBEDO
            _light(clip, torch.where(glossy, torch.exp2(-6 * torch.rand(())), 1))
        if self.lamps and float(torch.rand(())) < self.lamps:
            mean = clip["reference"].mean()
            for _ in range(1 + _randint(3)):
                self._hang_lamp(clip, mean, demodulated=shot.demodulated)
        return clip

    def _draw_turn(self) -> _Turn:
        """Let kornia flip and turn four numbers; what it did to them can be done to any array without copying it."""
        corners = torch.arange(4.0).reshape(1, 1, 2, 2)
        moved = self.flips_and_turns(corners)[0, 0].numpy()
        for turns in range(4):
            for flip in (False, True):
                turn = _Turn(turns, flip)
                if np.array_equal(turn.image(corners[0, 0].numpy()), moved):
                    return turn
        raise RuntimeError(f"kornia: expected flips and 90-degree turns, found {moved.tolist()}")

    def _hang_lamp(self, clip: dict[str, Tensor], mean: Tensor, *, demodulated: bool) -> None:
        """Paint a rectangle that shines in all frames, with or without an albedo of its own."""
        height, width = 2 + _randint(self.crop // 3), 2 + _randint(self.crop // 3)
        top, left = _randint(self.crop - height), _randint(self.crop - width)
        tint = 0.7 + 0.6 * torch.rand(1, 3, 1, 1)
        radiance = mean * 30 ** torch.rand(()) * tint
        albedo = torch.rand(1, 1, 1, 1).expand(1, 3, 1, 1) * _randint(2)
        normal = normalize(torch.randn(1, 3, 1, 1), dim=1)
        light = demodulate(radiance, albedo) if demodulated else radiance
        painted = {name: light for name in ("color", "current")}
        painted |= {"albedo": albedo, ALBEDO_HISTORY: albedo, "normal": normal, "reference": radiance}
        # Depth, motion and history stay: lamps hang on whatever is there. Nor do they reflect, or have noise.
        painted |= dict.fromkeys(("emission", NOISY, OIDN, OIDN_CLEAN), radiance)
        painted |= dict.fromkeys(("diffuse", "specular", "variance"), torch.zeros(1, 3, 1, 1))
        for name in painted.keys() & clip.keys():
            clip[name][..., top : top + height, left : left + width] = painted[name]


def check_sizes(shots: Sequence[tuple[int, tuple[int, int]]], frames: int, crop: int) -> None:
    """See that clips can be cut from shots.

    Args:
        shots: number of frames, and height and width in pixels of each.
        frames: T of a clip.
        crop: side of the square crop in pixels.

    Raises:
        InputError: no shot is long enough, or one that is is smaller than the crop.
    """
    sizes = [size for length, size in shots if length >= frames]
    if not sizes:
        raise InputError(f"training clips: expected a sequence of at least {frames} frames, found none")
    for size in sizes:
        if min(size) < crop:
            raise InputError(f"training clips: expected images of at least {crop} pixels, found {size}")


@dataclass(frozen=True)
class _Turn:
    """Turns of 90 degrees, from the rows to the columns, and a flip of the columns after."""

    turns: int
    flip: bool

    def image(self, image: Array) -> Array:
        """A view of ``(..., H, W)``."""
        turned = np.rot90(image, self.turns, (-2, -1))
        return turned[..., ::-1] if self.flip else turned

    def vectors(self, image: Tensor) -> Tensor:
        """What the turn makes of the vectors (x right, y down) in ``(T, 2, ...)``; their places stay."""
        x, y = image.unbind(1)
        for _ in range(self.turns):
            # What was to the right is above.
            x, y = y, -x
        return torch.stack([-x if self.flip else x, y], 1)


def _cropped(view: Tensor, size: tuple[int, int], corner: tuple[int, int], crop: int) -> Tensor:
    """The matrices ``(T, 4, 4)`` of a camera that sees a square of the image: clip x and y from -1 to 1 across it."""
    view = view.clone()
    for column, (pixels, start) in enumerate(zip(size[::-1], corner[::-1], strict=True)):
        offset = (pixels - 2 * start) / crop - 1
        view[..., column] = view[..., column] * (pixels / crop) + view[..., 3] * offset
    return view


def _light(clip: dict[str, Tensor], factor: Tensor) -> None:
    """Scale all light of a clip."""
    for name in LIGHT & clip.keys():
        clip[name] *= factor
    if "variance" in clip:
        clip["variance"] *= factor.square()


def _randint(high: int) -> int:
    return int(torch.randint(high, ()))
