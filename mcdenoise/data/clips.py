"""Training clips: successive frames, accumulated, cropped and augmented."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from kornia.augmentation import RandomHorizontalFlip, RandomRotation90, RandomVerticalFlip
from torch import Tensor, nn
from torch.nn.functional import normalize

from mcdenoise.data.cache import PARTS, Array, Shot
from mcdenoise.errors import InputError
from mcdenoise.ops import NO_ALBEDO, demodulate


@dataclass(frozen=True)
class Clip:
    """Successive frames of one shot, each ``(B, T, C, H, W)``.

    Args:
        color: accumulated demodulated radiance, 3 channels.
        current: demodulated radiance of each frame alone, 3 channels.
        length: history length in frames, 1 channel.
        albedo: diffuse reflectance, 3 channels.
        normal: world-space normals, 3 channels.
        depth: distance along the view axis, 1 channel.
        reference: converged radiance with albedo in it, 3 channels.
    """

    color: Tensor
    current: Tensor
    length: Tensor
    albedo: Tensor
    normal: Tensor
    depth: Tensor
    reference: Tensor

    def to(self, device: torch.device) -> Clip:
        """The clip on another device."""
        return Clip(*(getattr(self, name).to(device) for name in PARTS))

    @staticmethod
    def from_stack(stack: Tensor) -> Clip:
        """Take apart what :meth:`mcdenoise.data.cache.Shot.read` stacked: ``(B, T, 17, H, W)``."""
        return Clip(*stack.split(list(PARTS.values()), 2))


class ClipSampler:
    """Draws random clips from shots: position, frames, noise, flips, 90-degree turns, and what else is exact physics.

    Each clip has a seed of its own, and depends on nothing else: a batch can be drawn in any order, at any time, by any
    number of processes.

    Flips and turns are kornia's, the same for all buffers and frames of a clip. World-space normals stay as they are: a
    mirrored or turned image is one of a mirrored or turned world whose axes are named otherwise, and so the axes
    themselves are shuffled and reversed too. Colour channels are shuffled alike in radiance and albedo.

    Light is linear: all lamps of a scene, brighter by a factor or of another colour, make noisy color and reference
    brighter by this factor, channel by channel. The networks bring the exposure to a standard before they look; what
    the exposure changes is the loss, whose epsilon is in units of radiance. Another albedo would change the light that
    surfaces send to each other, so albedos are left alone.

    Args:
        shots: those shorter than ``frames`` are left out.
        frames: T of a clip.
        crop: side of the square crop in pixels.
        lamps: chance that a clip gets rectangles of constant radiance, without noise, up to 30 times as bright as its
            mean: emitters seen directly, of which few training scenes have any.
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
        exposure: float = 0.0,
        tint: float = 0.0,
        gloss: float = 0.0,
    ) -> None:
        self.shots = [shot for shot in shots if len(shot) >= frames]
        self.frames, self.crop = frames, crop
        self.lamps, self.exposure, self.tint, self.gloss = lamps, exposure, tint, gloss
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
        stacks = []
        # kornia draws from torch's global generator, which is others' too.
        with torch.random.fork_rng(devices=[]):
            for seed in seeds:
                torch.default_generator.manual_seed(seed)
                stacks.append(self._draw_one())
        return Clip.from_stack(torch.stack(stacks))

    def _draw_one(self) -> Tensor:
        shot = self.shots[int(torch.multinomial(self.chances, 1))]
        height, width = shot.size
        realisation, start = _randint(len(shot.colors)), _randint(len(shot) - self.frames + 1)
        top, left = _randint(height - self.crop + 1), _randint(width - self.crop + 1)
        order, axes = torch.randperm(3).tolist(), torch.randperm(3).tolist()
        stack = shot.read(
            slice(start, start + self.frames),
            slice(top, top + self.crop),
            slice(left, left + self.crop),
            realisation=realisation,
            channels=[
                *order,
                *(3 + i for i in order),
                6,
                *(7 + i for i in order),
                *(10 + i for i in axes),
                13,
                *(14 + i for i in order),
            ],
            turn=self._draw_turn(),
        )
        color, current, _, albedo, normal, _, reference = stack.split(list(PARTS.values()), 1)
        normal *= (torch.randint(2, (3, 1, 1)) * 2 - 1).float()
        stops = self.exposure * (2 * torch.rand(1) - 1) + self.tint * (2 * torch.rand(3) - 1)
        light = torch.exp2(stops).reshape(3, 1, 1)
        for image in (color, current, reference):
            image *= light
        if self.gloss and float(torch.rand(())) < self.gloss:
            # Less is reflected or sent out towards the camera; what that would take from other surfaces is left out.
            share = torch.where(albedo.amax(1, keepdim=True) < NO_ALBEDO, torch.exp2(-6 * torch.rand(())), 1)
            for image in (color, current, reference):
                image *= share
        if self.lamps and float(torch.rand(())) < self.lamps:
            mean = reference.mean()
            for _ in range(1 + _randint(3)):
                self._hang_lamp(stack, mean)
        return stack

    def _draw_turn(self) -> Callable[[Array], Array]:
        """Let kornia flip and turn four numbers; what it did to them can be done to any array without copying it."""
        corners = torch.arange(4.0).reshape(1, 1, 2, 2)
        moved = self.flips_and_turns(corners)[0, 0].numpy()
        for turns in range(4):
            for flip in (False, True):
                turn = functools.partial(_turn, turns=turns, flip=flip)
                if np.array_equal(turn(corners[0, 0].numpy()), moved):
                    return turn
        raise RuntimeError(f"kornia: expected flips and 90-degree turns, found {moved.tolist()}")

    def _hang_lamp(self, stack: Tensor, mean: Tensor) -> None:
        """Paint a rectangle that shines in all frames of ``(T, 17, H, W)``, with or without an albedo of its own."""
        height, width = 2 + _randint(self.crop // 3), 2 + _randint(self.crop // 3)
        top, left = _randint(self.crop - height), _randint(self.crop - width)
        tint = 0.7 + 0.6 * torch.rand(1, 3, 1, 1)
        radiance = mean * 30 ** torch.rand(()) * tint
        albedo = torch.rand(1, 1, 1, 1).expand(1, 3, 1, 1) * _randint(2)
        normal = normalize(torch.randn(1, 3, 1, 1), dim=1)
        lamp = stack[:, :, top : top + height, left : left + width]
        light = demodulate(radiance, albedo)
        painted = {"color": light, "current": light, "albedo": albedo, "normal": normal, "reference": radiance}
        for name, part in zip(PARTS, lamp.split(list(PARTS.values()), 1), strict=True):
            if name in painted:  # depth and history stay: lamps hang on whatever is there
                part.copy_(painted[name].expand_as(part))


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


def _turn(image: Array, turns: int, flip: bool) -> Array:
    turned = np.rot90(image, turns, (-2, -1))
    return turned[..., ::-1] if flip else turned


def _randint(high: int) -> int:
    return int(torch.randint(high, ()))
