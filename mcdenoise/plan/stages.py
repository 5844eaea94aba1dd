"""The plan of a shot: what is done with each frame, what is not, and why."""

from __future__ import annotations

import copy
import math
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from mcdenoise.buffers import Inspected
from mcdenoise.errors import InputError
from mcdenoise.ops import NO_ALBEDO
from mcdenoise.plan.noise_free import noise_free
from mcdenoise.plan.tiles import Results, Tiles

# So small that no metric moves in its third digit.
TOLERANCE = 1e-3

_SINGLE = "no motion, and no positions with cameras: single frames"


@dataclass(frozen=True)
class Stage:
    """One stage of denoising a frame.

    Args:
        name: such as ``reproject``.
        left_out: how much of it is left out, from 0 to 1.
        reason: why, or why not.
        exact: whether the pixels are the same without it; else they agree to the tolerance.
    """

    name: str
    left_out: float
    reason: str
    exact: bool = True


class Steps(NamedTuple):
    """What to do with a frame before its network.

    Args:
        demodulates: divide the albedo out, and multiply it back.
        reprojects: look for the past of each pixel where it was, not where it is.
        keeps: remember the frame for the next one.
        guides: which of ``normal`` and ``depth`` differ from pixel to pixel.
    """

    demodulates: bool
    reprojects: bool
    keeps: bool
    guides: tuple[str, ...]


class Shortcut(NamedTuple):
    """Pixels whose result needs no network.

    Args:
        mask: ``(B, 1, H, W)`` bool.
        initial: ``(B, 3, H, W)`` demodulated radiance, finite everywhere.
        final: likewise.
    """

    mask: Tensor
    initial: Tensor
    final: Tensor


class Plan:
    """Looks at each frame of a shot and says which stages it needs.

    Left out exactly, so that all pixels stay the same: reprojection where nothing moves in the image; accumulation
    where there is no way to reproject; demodulation where there is no albedo, or one that would not change a pixel;
    bilateral weights of a guide that is constant; the memory of a frame that no other reads; and the network where
    there is no noise (:func:`mcdenoise.plan.noise_free`), since pixels without noise are copied, by every plan.

    Left out up to a tolerance, while nothing moves in the image: tiles of 32x32 pixels whose accumulated noise has
    fallen below it are passed through; tiles that have changed by less, and four tiles around them too, since
    they were last computed are not computed again. Neither switches to and fro: a tile that is passed through comes
    back only at twice the noise, and one is reused only when it changes by less than a quarter of the tolerance from
    frame to frame.

    Args:
        keep_all: leave nothing out.
        tolerance: largest noise (root mean square, relative to the tile's mean) of a tile that is passed through, and
            largest change of one that is not computed again; 0 computes every tile that has noise.

    Raises:
        InputError: the tolerance is negative or not finite.
    """

    def __init__(self, *, keep_all: bool = False, tolerance: float = TOLERANCE) -> None:
        if not 0 <= tolerance < math.inf:
            raise InputError(f"tolerance: expected a finite number of at least 0, found {tolerance:g}")
        self.keep_all = keep_all
        self.tolerance = tolerance
        self.reset()

    def reset(self, buffers: Collection[str] | None = None, frames: int | None = None) -> None:
        """Forget the past: the next frame is the first of a shot.

        Args:
            buffers: names that every frame will have, as :attr:`mcdenoise.data.Sequence.buffers`, where that is known.
            frames: how many there will be, where that is known.
        """
        self.stages: list[Stage] = []
        self._buffers, self._frames = buffers, frames
        self._count = 0
        self._still = False
        self._tiles: Tiles | None = None

    def snapshot(self) -> dict[str, Any]:
        """What :meth:`restore` needs to take back the frames that are planned from now on; no image is copied."""
        return {**vars(self), "_tiles": copy.copy(self._tiles)}

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Take back every frame that was planned since."""
        vars(self).update(snapshot)

    def has_past(self, buffers: Collection[str]) -> bool:
        """Whether frames with these buffers may be accumulated."""
        return self.keep_all or (self._frames != 1 and _can_reproject(buffers))

    def begin(self, inspected: Inspected, still: bool) -> Steps:
        """Decide on what comes before the network.

        Args:
            inspected: the frame, valid, with its depth.
            still: nothing moves in the image, see :meth:`mcdenoise.history.History.is_still`.
        """
        self._count += 1
        self._still = still
        self.stages = []
        frame, _, ranges = inspected
        alone = "one frame" if self._frames == 1 else "" if _can_reproject(dict(frame.items())) else _SINGLE
        source = "motion" if frame.motion is not None else "positions and cameras"
        self._note("accumulate", alone or source, left_out=alone != "")
        reprojects = self._needs("reproject", alone or ("nothing moves in the image" if still else ""), source)
        keeps = self._needs("remember", self._unread(), "for the next frame")
        demodulates = self._needs("demodulate", _why_not_demodulate(ranges.get("albedo")), "albedo")
        guides = tuple(
            name
            for name in ("normal", "depth")
            if self._needs(f"{name} weights", _why_not_guide(name, getattr(frame, name), ranges.get(name)), name)
        )
        return Steps(demodulates, reprojects or not still, keeps, guides)

    def known(
        self, inspected: Inspected, color: Tensor, current: Tensor, length: Tensor, reset: str, alpha_min: float
    ) -> Shortcut | None:
        """Decide which pixels need a network.

        Args:
            inspected: as for :meth:`begin`.
            color: ``(B, 3, H, W)`` accumulated demodulated radiance.
            current: ``(B, 3, H, W)`` demodulated radiance of the frame alone.
            length: ``(B, 1, H, W)`` history length in frames.
            reset: why there is no past, or ``""``.
            alpha_min: of the accumulation.

        Returns:
            What is known of the result, or ``None`` where that is nothing.
        """
        free = noise_free(inspected)
        self._note_pixels("noise-free pixels", free, "background and emitters are copied", exact=True)
        known: Shortcut | None = None
        if self.keep_all or self.tolerance == 0 or reset or not self._still:
            self._tiles = None
        else:
            if self._tiles is None:
                self._tiles = Tiles(self.tolerance, alpha_min)
            passed, reused = self._tiles.decide(inspected.frame, color, current, length)
            self._note_pixels("converged tiles", passed, f"noise below {self.tolerance:g}", exact=False)
            self._note_pixels("unchanged tiles", reused, f"change below {self.tolerance:g}", exact=False)
            if passed.any() or reused.any():
                old = self._tiles.results or Results(color, color)
                mask = (passed | reused).expand_as(length)
                known = Shortcut(mask, *(torch.where(passed, color, image) for image in old))
        if free is None:
            return known
        if known is None:
            return Shortcut(free, current, current)
        return Shortcut(known.mask | free, *(torch.where(free, current, image) for image in known[1:]))

    def finish(self, initial: Tensor, final: Tensor, network: float) -> None:
        """Take note of what became of the frame.

        Args:
            initial: ``(B, 3, H, W)`` result of a cascade's first network, demodulated radiance.
            final: ``(B, 3, H, W)`` the result.
            network: the share of the image on which a network ran.
        """
        self._note("network", f"on {network:.0%} of the pixels", left_out=1 - network)
        if self._tiles is not None:
            self._tiles.results = Results(initial, final)

    def _unread(self) -> str:
        if self._frames is not None and self._count >= self._frames:
            return "one frame" if self._frames == 1 else "last frame"
        return _SINGLE if self._buffers is not None and not _can_reproject(self._buffers) else ""

    def _needs(self, stage: str, reason_against: str, reason: str) -> bool:
        """Whether a stage is kept, which is noted."""
        needed = self.keep_all or not reason_against
        self._note(stage, reason_against or reason, left_out=not needed)
        return needed

    def _note_pixels(self, name: str, pixels: Tensor | None, reason: str, *, exact: bool) -> None:
        share = 0.0 if pixels is None else int(pixels.count_nonzero()) / pixels.numel()
        self._note(name, reason if share else "there are none", left_out=share, exact=exact)

    def _note(self, name: str, reason: str, *, left_out: float, exact: bool = True) -> None:
        self.stages.append(Stage(name, float(left_out), reason, exact))


def summarize(frames: list[list[Stage]]) -> list[dict[str, Any]]:
    """What was left out of a shot.

    Args:
        frames: the stages of each frame.

    Returns:
        For each stage, in order: ``stage``; ``kept``, false if all of it was left out of all frames; ``left_out``, its
        mean share, from 0 to 1; ``reason``, the most frequent one for leaving it out, or else for keeping it; and
        ``exact``.
    """
    rows = []
    for name in dict.fromkeys(stage.name for stages in frames for stage in stages):
        found = [stage for stages in frames for stage in stages if stage.name == name]
        share = sum(stage.left_out for stage in found) / len(frames)
        telling = [stage for stage in found if stage.left_out > 0] or found
        reason = Counter(stage.reason for stage in telling).most_common(1)[0][0]
        rows.append({"stage": name, "kept": share < 1, "left_out": share, "reason": reason, "exact": found[0].exact})
    return rows


def _can_reproject(buffers: Collection[str]) -> bool:
    return "motion" in buffers or {"position", "view_projection"} <= set(buffers)


def _why_not_demodulate(extremes: tuple[float, float] | None) -> str:
    if extremes is None:
        return "no albedo"
    low, high = extremes
    return "albedo is one everywhere" if low == high == 1 else "no albedo anywhere" if high < NO_ALBEDO else ""


def _why_not_guide(name: str, guide: Tensor | None, extremes: tuple[float, float] | None) -> str:
    if guide is None:
        return f"no {name}"
    if extremes is not None and extremes[0] == extremes[1]:
        return f"{name} is constant"
    first = guide[..., :1, :1]
    # Most differ somewhere in one pixel of 64 already.
    differs = (guide[..., ::8, ::8] != first).any() or (guide != first).any()
    return "" if differs else f"{name} is constant"
