"""How large the parts of an image are on which a network runs, so that a frame keeps within memory."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import NamedTuple

import torch

from mcdenoise.errors import InputError
from mcdenoise.frame import BUFFERS
from mcdenoise.models._interface import Model
from mcdenoise.models._wrapper import parts_of
from mcdenoise.models.tiled import TILE, Region, Tiled

GB = 1e9
LEAST_SIDE = 64
# Smaller tiles cost more time, because of their margins, than reading at the same time can save.
_WORTHWHILE_SIDE = 512
# Default memory for the features of a network: a frame of 1920x1080 is one piece for every model of the package, and
# the margins of larger ones cost at most a seventh. It does not depend on the free memory, so that the same frames give
# the same images.
_FEATURES = 2 * GB
# Fraction of a GPU's memory, on which the largest pieces are the fastest.
_GPU_FRACTION = 0.4
# Memory that the first frame takes once: compiled kernels, the library of convolutions, its buffers, and gaps between
# freed pieces.
_LOADED_LATER = 0.45 * GB
_BYTES = 4
# Channels of a history: a long and a recent one, the moments by which they are compared, and the length.
_KEPT = 10
# Channels of a layer, measured: as given, without albedo, two histories of six, each scale, and temporary results.
_PER_CARRIED = 56
# Buffers of a frame that are kept beside them.
_SURFACE = ("position", "normal", "depth")
_STATM = Path("/proc/self/statm")


class Division:
    """How a model's images are divided into tiles.

    Args:
        model: any method; whole images are computed unless it contains :class:`mcdenoise.models.Tiled`.
        side: of the tiles in pixels, a multiple of 32 from 64 on; by default as memory allows.
        max_memory: in GB, of the whole process (of the device, where that is no CPU), see
            :class:`mcdenoise.denoiser.Denoiser`.
        device: where the model runs.

    Raises:
        InputError: side or memory are no such number, both are given, or the model computes no tiles.
    """

    def __init__(self, model: Model, side: int | None, max_memory: float | None, device: torch.device) -> None:
        self._tiled = [tiled for tiled in parts_of(model, Tiled) if tiled.halo is not None]
        if side is not None and (side < LEAST_SIDE or side % TILE):
            raise InputError(f"tile: expected a multiple of {TILE} of at least {LEAST_SIDE} pixels, found {side}")
        if side is not None and max_memory is not None:
            raise InputError("tile, max_memory: expected one of them, found both; max_memory chooses the tiles")
        if max_memory is not None and not 0 < max_memory < math.inf:
            raise InputError(f"max_memory: expected a number of GB above 0, found {max_memory:g}")
        if not self._tiled and (side, max_memory) != (None, None):
            raise InputError("tile, max_memory: expected a model that computes tiles of an image, found one without")
        self._side, self._device = side, device
        self._cap = None if max_memory is None else max_memory * GB
        self._loaded = _memory_in_use(device)
        self._halo = max((tiled.halo or 0 for tiled in self._tiled), default=0)

    def divide(self, frames: Frames) -> str:
        """Choose the tiles of the next frame; says which, and why.

        Raises:
            InputError: not even the smallest tiles fit.
        """
        if not self._tiled:
            return "whole frames: the model computes no tiles"
        side, reason = self.chosen(frames)
        for tiled in self._tiled:
            tiled.side = side
        return reason

    def has_room_ahead(self, frames: Frames) -> bool:
        """Whether the next frame can be read, and the last one be written, beside tiles that are not too small.

        Raises:
            InputError: not even the smallest tiles fit.
        """
        if not self._tiled or self._cap is None:
            return True
        self.chosen(frames)
        return self._least(frames._replace(ahead=True), _WORTHWHILE_SIDE) <= self._cap

    def chosen(self, frames: Frames) -> tuple[int | None, str]:
        """The side of the largest tiles that fit, ``None`` for whole frames, and why.

        Without a cap, the features of a network are kept below 2 GB on a CPU, and 0.4 of the memory of a GPU.

        Raises:
            InputError: not even the smallest tiles fit.
        """
        height, width = frames.size
        if self._side is not None:
            return self._side, f"{describe(frames.size, self._side)}: as asked for"
        if self._cap is None:
            limit = _FEATURES
            if self._device.type == "cuda":
                limit = _GPU_FRACTION * torch.cuda.get_device_properties(self._device).total_memory
            why = f"features of the network within {limit / GB:.3g} GB"
        else:
            least = self._least(frames, LEAST_SIDE)
            if least > self._cap:
                raise InputError(
                    f"max_memory: expected at least {least / GB + 0.005:.2f} GB for frames of {width}x{height}, found "
                    f"{self._cap / GB:g}; allow that much, or take a smaller model, bfloat16 or fewer buffers"
                )
            limit = self._cap - self._loaded - frames.held
            why = f"all within {self._cap / GB:g} GB"
        whole = -(-max(frames.size) // TILE) * TILE
        fitting = (side for side in range(whole, LEAST_SIDE, -TILE) if self._features(frames, side) <= limit)
        side = next(fitting, LEAST_SIDE)
        return (None, f"whole frames: {why}") if side >= whole else (side, f"{describe(frames.size, side)}: {why}")

    def _least(self, frames: Frames, side: int) -> float:
        """Bytes that are needed with tiles of a side."""
        return self._loaded + max(frames.held + self._features(frames, side), frames.held_elsewhere)

    def _features(self, frames: Frames, side: int) -> float:
        """Bytes of a network's features for the largest tile and its margin."""
        bytes_per_pixel = max(tiled.inner.needs.live.bytes(bfloat16=frames.bfloat16) for tiled in self._tiled)
        tiles = Region(0, 0, *frames.size).split(side)
        return frames.batch * bytes_per_pixel * max(tile.grown(self._halo, frames.size).pixels for tile in tiles)


class Frames(NamedTuple):
    """The properties of frames that their memory depends on.

    Args:
        size: height and width in pixels.
        buffers: names of their buffers.
        streaming: a frame has a history, or will be part of one.
        ahead: the next frame is read, and the last one written, at the same time.
        batch: number of images.
        carried: number of layers, with the rest that is in none of them, and of denoised alphas.
        bfloat16: convolutions are in bfloat16.
    """

    size: tuple[int, int]
    buffers: frozenset[str]
    streaming: bool
    ahead: bool = False
    batch: int = 1
    carried: int = 0
    bfloat16: bool = False

    @property
    def held(self) -> int:
        """Bytes of whole images while a network runs."""
        # Demodulated color; its history and that of the frame before, to which a failure returns; the results of both
        # networks.
        kept = 2 * (_KEPT + self._channels(*_SURFACE)) if self.streaming else 1
        return self._bytes(self._channels() + 3 + kept + 6)

    @property
    def held_elsewhere(self) -> int:
        """Bytes of whole images, at most, while none runs."""
        # One of the results is kept in other units, too.
        kept = _KEPT + self._channels(*_SURFACE) if self.streaming else 1
        after = self._channels() + 3 + kept + 9
        if not self.streaming:
            return self._bytes(after)
        # Color as given and as it enters the history; the old history with its features; the new one, long and short,
        # before and after the correction of lag.
        histories = 12 + _KEPT + 2 * _KEPT
        return self._bytes(max(after, self._channels() + 2 * self._channels(*_SURFACE) + histories))

    def _channels(self, *names: str) -> int:
        return sum(BUFFERS[name].channels for name in names or BUFFERS if name in self.buffers)

    def _bytes(self, channels: int) -> int:
        # The next frame, and the last result.
        channels += self._channels() + 3 + 6 * self.carried if self.ahead else 0
        channels += _PER_CARRIED * self.carried
        return self.batch * self.size[0] * self.size[1] * channels * _BYTES


def describe(size: tuple[int, int], side: int) -> str:
    """Such as ``"6 x 4 tiles of up to 1280x1088 pixels"``."""
    tiles = Region(0, 0, *size).split(side)
    columns = sum(tile.top == 0 for tile in tiles)
    return f"{columns} x {len(tiles) // columns} tiles of up to {tiles[0].right}x{tiles[0].bottom} pixels"


def _memory_in_use(device: torch.device) -> float:
    """Bytes that this process will hold on the device besides its images."""
    if device.type == "cuda":
        return float(torch.cuda.memory_allocated(device))
    try:
        resident = int(_STATM.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        # The system does not tell: as much as torch takes.
        resident = int(0.4 * GB)
    return resident + _LOADED_LATER
