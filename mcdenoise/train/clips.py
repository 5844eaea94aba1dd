"""Training clips: consecutive frames, accumulated, cropped and augmented."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from mcdenoise.errors import InputError
from mcdenoise.frame import RADIANCE, Frame, Hints, part_of_view
from mcdenoise.models.with_oidn import NOISY, OIDN, OIDN_ALBEDO, OIDN_CLEAN
from mcdenoise.nn.inputs import auto_exposure
from mcdenoise.ops import demodulate
from mcdenoise.train.config import TrainConfig
from mcdenoise.train.shots import Array, Shot

_KNOWN = frozenset(field.name for field in fields(Frame))

# Buffers of radiance, of reflectance, and of world-space vectors, whose channels can be permuted.
LIGHT = frozenset({*RADIANCE, "reference", NOISY, OIDN, OIDN_CLEAN})
_COLORED = LIGHT | {"albedo", OIDN_ALBEDO, "specular_albedo", "variance"}
_WORLD = frozenset({"normal", "position", "previous_position"})


@dataclass(frozen=True)
class Clip:
    """Consecutive frames of one shot, with the buffers of :class:`mcdenoise.frame.Frame`.

    Args:
        buffers: ``(B, T, C, H, W)`` by name, and ``view_projection`` ``(B, T, 4, 4)``. A reference of fewer frames is
            that of the last ones, and no part of a frame.
    """

    buffers: dict[str, Tensor]

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
        """Frame ``t`` of each clip, or all frames of all clips as a batch of ``B T``."""
        when = slice(None) if t is None else slice(t, t + 1)
        # Convolutions are faster on channels last.
        flat: dict[str, Any] = {
            name: buffer[:, when].flatten(0, 1).contiguous(memory_format=torch.channels_last)
            if buffer.dim() == 5
            else buffer[:, when].flatten(0, 1)
            for name, buffer in self.buffers.items()
            if buffer.shape[1] == len(self)
        }
        extra = {name: flat.pop(name) for name in list(flat) if name not in _KNOWN}
        return Frame(**flat, extra=extra, hints=Hints(keep_all=True))


class ClipSampler:
    """Draws random clips from shots, with augmentations that are physically exact.

    The position, the frames, the noise seed, flips, 90-degree rotations and the options below are random. Each clip
    depends only on its own seed: a batch can be drawn in any order, at any time, by any number of processes.

    Flips and rotations are the same for all buffers and frames of a clip. Motion is transformed with the image, and the
    camera's matrix projects to the transformed crop. World-space normals and positions are not transformed: a flipped
    or rotated image shows a flipped or rotated world with other names of axes. For the same reason, axes are also
    permuted and reversed at random. Color channels are permuted in the same way in radiance and albedo.

    Light is linear: scaling all lamps of a scene, also per channel, scales noisy color and reference by the same
    factor. Networks normalize the exposure, so this changes only the loss, whose epsilon is in units of radiance.
    Changing an albedo would change the light between surfaces, so albedos are not augmented.

    Where only the last frames of a shot have references, a clip ends with the shot, and its reference has fewer frames.
    A clip of a shot of one frame has as many parts of it as it has frames: no network is trained on copies.

    Args:
        shots: those shorter than a clip are skipped, except for stills, which must have a reference. Beside stills, the
            others must have references on as many of their last frames as a clip has.
        config: says how long and wide a clip is, and how its light is changed: ``frames``, ``crop``, ``lamps``,
            ``key``, ``exposure`` and ``tint``. A lamp is up to 30 times as bright as the clip's mean.

    Raises:
        InputError: no shot is long enough, one is smaller than the crop, or clips differ in their number of references.
    """

    def __init__(self, shots: Iterable[Shot], config: TrainConfig) -> None:
        self.config, self.shots = config, [shot for shot in shots if _is_enough(len(shot), config.frames)]
        check_sizes([(len(shot), shot.references, shot.size) for shot in self.shots], config.frames, config.crop)
        self.chances = torch.tensor([float(max(len(shot), config.frames)) for shot in self.shots])

    def draw(self, seeds: Sequence[int]) -> Clip:
        """Draw a clip for each seed; the probability of a shot is proportional to its number of frames."""
        drawn = []
        # Torch's global generator must not change for other users.
        with torch.random.fork_rng(devices=[]):
            for seed in seeds:
                torch.default_generator.manual_seed(seed)
                shot = self.shots[int(torch.multinomial(self.chances, 1))]
                parts = [self._draw_one(shot) for _ in range(self.config.frames if len(shot) == 1 else 1)]
                drawn.append({name: torch.cat([part[name] for part in parts]) for name in parts[0]})
        return Clip({name: torch.stack([clip[name] for clip in drawn]) for name in drawn[0]})

    def _draw_one(self, shot: Shot) -> dict[str, Tensor]:
        (height, width), config = shot.size, self.config
        frames = min(config.frames, len(shot))
        first = 0 if shot.references == len(shot) else len(shot) - frames
        noise_seed, start = _randint(shot.noise_seeds), first + _randint(len(shot) - frames + 1 - first)
        top, left = _randint(height - config.crop + 1), _randint(width - config.crop + 1)
        order, axes = torch.randperm(3).tolist(), torch.randperm(3).tolist()
        turn = _Turn(_randint(4), bool(_randint(2)))
        rows, columns = slice(top, top + config.crop), slice(left, left + config.crop)
        clip = shot.read(
            slice(start, start + frames),
            rows,
            columns,
            noise_seed=noise_seed,
            channels=dict.fromkeys(_COLORED, order) | dict.fromkeys(_WORLD, axes),
            turn=turn.image,
        )
        signs = (torch.randint(2, (3, 1, 1)) * 2 - 1).float()
        for name in _WORLD & clip.keys():
            clip[name] *= signs
        if "motion" in clip:
            clip["motion"] = turn.vectors(clip["motion"])
        if "view_projection" in clip:
            view = part_of_view(clip["view_projection"], shot.size, rows, columns)
            view[:, :3] = view[:, axes] * signs.reshape(3, 1)
            view[..., :2] = turn.vectors(view[..., :2].mT).mT
            clip["view_projection"] = view
        stops = config.exposure * (2 * torch.rand(1) - 1) + config.tint * (2 * torch.rand(3) - 1)
        factor = torch.exp2(stops).reshape(3, 1, 1)
        if config.key:
            factor = factor * auto_exposure(clip["reference"][:1], config.key)[0]
        _light(clip, factor)
        if config.lamps and float(torch.rand(())) < config.lamps:
            mean = clip["reference"].mean()
            for _ in range(1 + _randint(3)):
                self._hang_lamp(clip, mean, demodulated=shot.demodulated)
        return clip

    def _hang_lamp(self, clip: dict[str, Tensor], mean: Tensor, *, demodulated: bool) -> None:
        """Paint a rectangle of constant radiance in all frames, with or without albedo."""
        crop = self.config.crop
        height, width = 2 + _randint(crop // 3), 2 + _randint(crop // 3)
        top, left = _randint(crop - height), _randint(crop - width)
        tint = 0.7 + 0.6 * torch.rand(1, 3, 1, 1)
        radiance = mean * 30 ** torch.rand(()) * tint
        albedo = torch.rand(1, 1, 1, 1).expand(1, 3, 1, 1) * _randint(2)
        normal = normalize(torch.randn(1, 3, 1, 1), dim=1)
        light = demodulate(radiance, albedo) if demodulated else radiance
        painted = {name: light for name in ("color", "current", "recent")}
        painted |= {"albedo": albedo, "normal": normal, "reference": radiance}
        # Depth, motion and history are not changed: the lamp lies on the surface. It has no albedo and no noise.
        painted |= dict.fromkeys(("emission", NOISY, OIDN, OIDN_CLEAN), radiance)
        painted |= dict.fromkeys(("diffuse", "specular", "variance"), torch.zeros(1, 3, 1, 1))
        for name in painted.keys() & clip.keys():
            clip[name][..., top : top + height, left : left + width] = painted[name]


def check_sizes(shots: Sequence[tuple[int, int, tuple[int, int]]], frames: int, crop: int) -> int:
    """Check that clips can be cut from shots, and stacked.

    Args:
        shots: number of frames, number of references, and height and width in pixels of each.
        frames: T, the number of frames of a clip.
        crop: side of the square crop in pixels.

    Returns:
        Number of references of a clip.

    Raises:
        InputError: no shot is long enough, one of these is smaller than the crop, or clips differ in their number of
            references.
    """
    used = [shot for shot in shots if _is_enough(shot[0], frames)]
    if not used:
        raise InputError(f"training clips: expected a sequence of at least {frames} frames, found none")
    # A clip of a still has that reference in each of its parts.
    counts = {frames if length == 1 else min(frames, references) for length, references, _ in used}
    if len(counts) > 1:
        raise InputError(
            f"training clips: expected equally many references in clips of {frames} frames, found {min(counts)} in "
            f"some and {max(counts)} in others; choose --frames {min(counts)}, or train on other data"
        )
    for *_, size in used:
        if min(size) < crop:
            raise InputError(
                f"training clips: expected images of at least {crop} pixels, found {size}; "
                "choose a smaller --crop, a multiple of 32, or larger images"
            )
    return counts.pop()


def _is_enough(length: int, frames: int) -> bool:
    return length >= frames or length == 1


@dataclass(frozen=True)
class _Turn:
    """Rotations by 90 degrees from rows to columns, followed by a flip of the columns."""

    turns: int
    flip: bool

    def image(self, image: Array) -> Array:
        """A transformed view of ``(..., H, W)``."""
        turned = np.rot90(image, self.turns, (-2, -1))
        return turned[..., ::-1] if self.flip else turned

    def vectors(self, image: Tensor) -> Tensor:
        """Transform vectors (x right, y down) in ``(T, 2, ...)`` without moving the pixels."""
        x, y = image.unbind(1)
        for _ in range(self.turns):
            # A vector to the right points up after the rotation.
            x, y = y, -x
        return torch.stack([-x if self.flip else x, y], 1)


def _light(clip: dict[str, Tensor], factor: Tensor) -> None:
    """Scale all light of a clip."""
    for name in LIGHT & clip.keys():
        clip[name] *= factor
    if "variance" in clip:
        clip["variance"] *= factor.square()


def _randint(high: int) -> int:
    return int(torch.randint(high, ()))
