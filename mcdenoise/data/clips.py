"""Training clips: successive frames, accumulated, cropped and augmented."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from kornia.augmentation import RandomHorizontalFlip, RandomRotation90, RandomVerticalFlip
from torch import Tensor, nn
from torch.nn.functional import normalize

from mcdenoise.data.sequences import Sequence
from mcdenoise.errors import InputError
from mcdenoise.history import History
from mcdenoise.ops import Accumulate, demodulate

# name, channels: what a training clip holds, in the order in which it is stacked for augmentation
_PARTS = {"color": 3, "albedo": 3, "normal": 3, "depth": 1, "reference": 3}


@dataclass(frozen=True)
class Clip:
    """Successive frames of one shot, each ``(B, T, C, H, W)``.

    Args:
        color: accumulated demodulated radiance, 3 channels.
        albedo: diffuse reflectance, 3 channels.
        normal: world-space normals, 3 channels.
        depth: distance along the view axis, 1 channel.
        reference: converged radiance with albedo in it, 3 channels.
    """

    color: Tensor
    albedo: Tensor
    normal: Tensor
    depth: Tensor
    reference: Tensor

    def to(self, device: torch.device) -> Clip:
        """The clip on another device."""
        return Clip(*(getattr(self, name).to(device) for name in _PARTS))

    @staticmethod
    def from_stack(stack: Tensor) -> Clip:
        """Take apart what :func:`accumulated_shots` stacked: ``(B, T, 13, H, W)``."""
        return Clip(*stack.split(list(_PARTS.values()), 2))


def accumulated_shots(sequence: Sequence, alpha_min: float, start_every: int) -> list[Tensor]:
    """A sequence as a network sees it, once for each of several first frames.

    A shot that starts later has shorter histories, so that a network also learns how a shot begins.

    Args:
        sequence: frames with references and all features.
        alpha_min: see :func:`mcdenoise.ops.accumulate`.
        start_every: distance between the first frames.

    Returns:
        For each first frame ``(T, 13, H, W)``, the parts of a :class:`Clip` stacked.

    Raises:
        InputError: a buffer or a reference is missing.
    """
    missing = sorted({"albedo", "normal", "depth"} - sequence.buffers)
    if missing:
        raise InputError(f"{sequence.root}: expected albedo, normal and depth to train on, found no {missing[0]}")
    without = sorted(set(sequence.numbers) - set(sequence.reference_numbers))
    if without:
        raise InputError(
            f"{sequence.root}: expected a reference for every frame to train on, found none for frame {without[0]}; "
            "render it or choose other frames"
        )
    frames = [sequence.frame(number).validate()[0] for number in sequence.numbers]
    shots = []
    for first in range(0, len(frames), start_every):
        history = History(Accumulate(alpha_min))
        stacks = []
        for frame in frames[first:]:
            color = history.update(frame).color
            parts = [color, *(getattr(frame, name) for name in _PARTS if name != "color")]
            stacks.append(torch.cat(parts, 1))
        shots.append(torch.cat(stacks))
    return shots


class ClipSampler:
    """Draws random clips from shots: position, frames, flips, 90-degree turns, and what else leaves physics intact.

    All randomness comes from torch's global generator, so that a seed before each draw makes every draw repeatable.
    Flips and turns are kornia's, the same for all buffers and frames of a clip. World-space normals stay as they are: a
    mirrored or turned image is one of a mirrored or turned world whose axes are named otherwise, and so the axes
    themselves are shuffled and reversed too. Colour channels are shuffled alike in radiance and albedo.

    Args:
        shots: tensors ``(T, 13, H, W)`` of :func:`accumulated_shots`; those shorter than ``frames`` are left out.
        frames: T of a clip.
        crop: side of the square crop in pixels.
        lamps: chance that a clip gets rectangles of constant radiance, without noise, up to 30 times as bright as its
            mean: emitters seen directly, of which few training scenes have any.

    Raises:
        InputError: no shot is long enough, or one is smaller than the crop.
    """

    def __init__(self, shots: Iterable[Tensor], frames: int, crop: int, lamps: float = 0.0) -> None:
        self.shots = [shot for shot in shots if len(shot) >= frames]
        self.frames, self.crop, self.lamps = frames, crop, lamps
        if not self.shots:
            raise InputError(f"training clips: expected a sequence of at least {frames} frames, found none")
        for shot in self.shots:
            if min(shot.shape[-2:]) < crop:
                raise InputError(
                    f"training clips: expected images of at least {crop} pixels, found {tuple(shot.shape[-2:])}"
                )
        self.flips_and_turns = nn.Sequential(
            RandomHorizontalFlip(p=0.5),
            RandomVerticalFlip(p=0.5),
            # "nearest" moves whole pixels; "bilinear" would mix them, and infinity into its neighbours.
            RandomRotation90((0, 3), p=1.0, resample="nearest"),
        )

    def draw(self, batch: int) -> Clip:
        """``batch`` clips, each drawn from a shot with a chance in proportion to its number of frames."""
        chances = torch.tensor([float(len(shot)) for shot in self.shots])
        chosen = torch.multinomial(chances, batch, replacement=True)
        return Clip.from_stack(torch.stack([self._draw_one(self.shots[int(i)]) for i in chosen]))

    def _draw_one(self, shot: Tensor) -> Tensor:
        length, _, height, width = shot.shape
        start = _randint(length - self.frames + 1)
        top, left = _randint(height - self.crop + 1), _randint(width - self.crop + 1)
        clip = shot[start : start + self.frames, :, top : top + self.crop, left : left + self.crop].float()
        turned: Tensor = self.flips_and_turns(clip.flatten(0, 1)[None])[0]
        color, albedo, normal, depth, reference = turned.unflatten(0, clip.shape[:2]).split(list(_PARTS.values()), 1)
        order = torch.randperm(3)
        signs = (torch.randint(2, (3,)) * 2 - 1).float().reshape(3, 1, 1)
        normal = normal[:, torch.randperm(3)] * signs
        stack = torch.cat([color[:, order], albedo[:, order], normal, depth, reference[:, order]], 1)
        if self.lamps and float(torch.rand(())) < self.lamps:
            for _ in range(1 + _randint(3)):
                self._hang_lamp(stack, reference.mean())
        return stack

    def _hang_lamp(self, stack: Tensor, mean: Tensor) -> None:
        """Paint a rectangle that shines in all frames of ``(T, 13, H, W)``, with or without an albedo of its own."""
        height, width = 2 + _randint(self.crop // 3), 2 + _randint(self.crop // 3)
        top, left = _randint(self.crop - height), _randint(self.crop - width)
        tint = 0.7 + 0.6 * torch.rand(1, 3, 1, 1)
        radiance = mean * 30 ** torch.rand(()) * tint
        albedo = torch.rand(1, 1, 1, 1).expand(1, 3, 1, 1) * _randint(2)
        normal = normalize(torch.randn(1, 3, 1, 1), dim=1)
        lamp = stack[:, :, top : top + height, left : left + width]
        for part, value in zip(
            lamp.split(list(_PARTS.values()), 1),
            (demodulate(radiance, albedo), albedo, normal, None, radiance),
            strict=True,
        ):
            if value is not None:  # depth stays: lamps hang on whatever is there
                part.copy_(value.expand_as(part))


def _randint(high: int) -> int:
    return int(torch.randint(high, ()))
