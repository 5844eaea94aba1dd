"""What the frames of a shot tell about mistakes in the next one: wrong motion, and noise that is repeated."""

from __future__ import annotations

from typing import NamedTuple

from mcdenoise.frame import Frame
from mcdenoise.motion import MOTION_PAIRS, Seen, doubt_motion, seen_in
from mcdenoise.noise import noise_is_repeated, thinned

REPEATED = (
    "the noise is that of the frame before, pixel by pixel, and counts once, as it does only on a CPU where nothing "
    "moves; render each frame with its own seed"
)


class Watch(NamedTuple):
    """What is remembered of the last frame.

    Args:
        pixels: a few of its pixels, to find the same noise; ``None`` if it is not looked for.
        compared: what the next frame's motion is compared with.
        left: number of frames whose motion is still examined.
    """

    pixels: Frame | None = None
    compared: Seen | None = None
    left: int = 1 + MOTION_PAIRS

    def after(self, frame: Frame, *, motion: bool, noise: bool) -> tuple[Watch, bool, str]:
        """The same after the next frame, whether that repeats the noise of the last one, and a doubt about its motion.

        Args:
            frame: the next frame of the shot.
            motion: whether to examine its motion.
            noise: whether to look for repeated noise.
        """
        pixels = thinned(frame) if noise else None
        last = self.pixels
        repeats = pixels is not None and last is not None and noise_is_repeated(frame, pixels, last)
        seen = seen_in(frame) if motion and self.left else None
        doubt = "" if seen is None else doubt_motion(frame, seen, self.compared)
        return Watch(pixels, None if doubt else seen, 0 if doubt else max(self.left - 1, 0)), repeats, doubt
