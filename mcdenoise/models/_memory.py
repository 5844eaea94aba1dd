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
from mcdenoise.models.tiled import Region, Tiled

GB = 1e9
LEAST_SIDE = 64
MULTIPLE = 32
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
# Kinds of frames whose tiles are remembered: sizes may be ever new ones.
_TILINGS = 16
# Channels of a history: a long and a recent one, the moments by which they are compared, and the length.
_KEPT = 10
# Channels of a layer, measured: as given, without albedo, two histories of six, each scale, and temporary results.
_PER_CARRIED = 56
# Buffers of a frame that are kept beside them.
_SURFACE = ("position", "normal", "depth")
_STATM = Path("/proc/self/statm")


class Tiling(NamedTuple):
    """The parts of an image on which a network runs.

    Args:
        side: longest side in pixels; ``None`` for the whole image at once.
        reason: why, in words.
    """

    side: int | None
    reason: str


class Division:
    """How a model's images are divided into tiles.

    Args:
        model: any method; whole images are computed unless it contains :class:`mcdenoise.models.Tiled`.
        side: of the tiles in pixels, a multiple of 32 from 64 on; by default as memory allows.
        max_memory: in GB, see :class:`mcdenoise.denoiser.Denoiser`.
        device: where the model runs.

    Raises:
        InputError: side or memory are no such number, both are given, or the model computes no tiles.
    """

    def __init__(self, model: Model, side: int | None, max_memory: float | None, device: torch.device) -> None:
        self._tiled = [tiled for tiled in parts_of(model, Tiled) if tiled.halo is not None]
        if side is not None:
            check_side(side)
            if max_memory is not None:
                raise InputError("tile, max_memory: expected one of them, found both; max_memory chooses the tiles")
        self._memory = Memory(None if max_memory is None else max_memory * GB, device)
        if not self._tiled and (side, max_memory) != (None, None):
            raise InputError("tile, max_memory: expected a model that computes tiles of an image, found one without")
        self._side = side
        self._tilings: dict[Frames, Tiling] = {}

    def divide(self, frames: Frames) -> str:
        """Choose the tiles of the next frame; says which, and why.

        Raises:
            InputError: not even the smallest tiles fit.
        """
        if not self._tiled:
            return "whole frames: the model computes no tiles"
        tiling = self._tiling(frames)
        for tiled in self._tiled:
            tiled.side = tiling.side
        return tiling.reason

    def has_room_ahead(self, frames: Frames) -> bool:
        """Whether the next frame can be read, and the last one be written, while one is denoised.

        Raises:
            InputError: not even the smallest tiles fit.
        """
        if not self._tiled:
            return True
        self._tiling(frames)
        return self._memory.has_room_ahead(frames, self._network(frames))

    def _tiling(self, frames: Frames) -> Tiling:
        if frames not in self._tilings:
            if len(self._tilings) == _TILINGS:
                self._tilings.clear()
            if self._side is not None:
                tiling = Tiling(self._side, f"{describe(frames.size, self._side)}: as asked for")
            else:
                tiling = self._memory.choose(frames, self._network(frames))
            self._tilings[frames] = tiling
        return self._tilings[frames]

    def _network(self, frames: Frames) -> Network:
        halo = max(tiled.halo or 0 for tiled in self._tiled)
        return Network(halo, max(tiled.inner.needs.live.bytes(bfloat16=frames.bfloat16) for tiled in self._tiled))


class Memory:
    """The memory that a denoiser may take, and the memory that it takes.

    Args:
        cap: maximum of bytes of the whole process (of the device, where that is no CPU); ``None`` for no limit.
        device: where the network runs.

    Raises:
        InputError: the cap is not a positive number.
    """

    def __init__(self, cap: float | None, device: torch.device) -> None:
        if cap is not None and not 0 < cap < math.inf:
            raise InputError(f"max_memory: expected a number of GB above 0, found {cap / GB:g}")
        self.cap = cap
        self._device = device
        self._loaded = _memory_in_use(device)

    def has_room_ahead(self, frames: Frames, network: Network) -> bool:
        """Whether the next frame can be read, and the last one be written, beside tiles that are not too small."""
        return self.cap is None or self._least(frames._replace(ahead=True), network, _WORTHWHILE_SIDE) <= self.cap

    def choose(self, frames: Frames, network: Network) -> Tiling:
        """The largest tiles that fit.

        Without a cap, the features of a network are kept below 2 GB on a CPU, and 0.4 of the memory of a GPU.

        Raises:
            InputError: not even the smallest tiles fit.
        """
        height, width = frames.size
        if self.cap is None:
            limit = _FEATURES
            if self._device.type == "cuda":
                limit = _GPU_FRACTION * torch.cuda.get_device_properties(self._device).total_memory
            why = f"features of the network within {limit / GB:.3g} GB"
        else:
            least = self._least(frames, network)
            if least > self.cap:
                raise InputError(
                    f"max_memory: expected at least {least / GB + 0.005:.2f} GB for frames of {width}x{height}, found "
                    f"{self.cap / GB:g}; allow that much, or take a smaller model, bfloat16 or fewer buffers"
                )
            limit = self.cap - self._loaded - frames.held
            why = f"all within {self.cap / GB:g} GB"

        def fits(side: int) -> bool:
            return frames.batch * network.bytes_per_pixel * _largest_part(frames.size, side, network.halo) <= limit

        side = -(-max(frames.size) // MULTIPLE) * MULTIPLE
        if fits(side):
            return Tiling(None, f"whole frames: {why}")
        while side > LEAST_SIDE and not fits(side):
            side -= MULTIPLE
        return Tiling(side, f"{describe(frames.size, side)}: {why}")

    def _least(self, frames: Frames, network: Network, side: int = LEAST_SIDE) -> float:
        """Bytes that are needed with small tiles."""
        part = _largest_part(frames.size, side, network.halo)
        features = frames.batch * network.bytes_per_pixel * part
        return self._loaded + max(frames.held + features, frames.held_elsewhere)


class Network(NamedTuple):
    """The properties of a network that its memory depends on.

    Args:
        halo: width of the margin around a tile in pixels.
        bytes_per_pixel: memory that it takes for each pixel of a tile and its margin.
    """

    halo: int
    bytes_per_pixel: float


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


def check_side(side: int) -> None:
    """``InputError`` for a side that tiles cannot have."""
    if side < LEAST_SIDE or side % MULTIPLE:
        raise InputError(f"tile: expected a multiple of {MULTIPLE} of at least {LEAST_SIDE} pixels, found {side}")


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


def _largest_part(size: tuple[int, int], side: int, halo: int) -> int:
    whole = Region(0, 0, *size)
    return max(tile.grown(halo, size).pixels for tile in whole.split(side))
