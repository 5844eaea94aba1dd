"""Clean frames for people to look at: a PNG of each, and a video of all."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
from torch import Tensor

from mcdenoise.data.color_space import to_rec709
from mcdenoise.data.files import make_folder, remove
from mcdenoise.data.images import Metadata
from mcdenoise.data.png import Picture, read_png, write_png
from mcdenoise.data.video import check_video, write_video
from mcdenoise.errors import InputError
from mcdenoise.metrics import display_codes
from mcdenoise.nn import auto_exposure

# Reflectance of the grey card that a light meter expects.
_MIDDLE_GREY = 0.18
# Beyond, float32 has no such radiance.
_MOST_STOPS = 100.0
# Rows that are converted at a time: a frame of 7680x4320 would take gigabytes as a whole.
_ROWS = 128


class Preview:
    """Writes ``FOLDER/preview/NAME.png`` of each frame, and of two or more of them ``FOLDER/preview.mp4``.

    Frames are shown as by :func:`mcdenoise.metrics.displayed`: times one factor, clamped to [0, 1], on the sRGB curve.
    The factor is the same for all frames, so that only what changes in the scene changes in the video.

    Args:
        folder: folder to write to; made with the first frame. A video of an earlier preview there is removed: what
            stands there is of these frames, or nothing.
        video: whether there is to be a video; it needs the package of ``mcdenoise[preview]``, a PNG needs none.
        frames_per_second: of the video, 1 to 1000.
        exposure: stops, in [-100, 100]: radiance is shown times ``2**exposure``. By default, the typical radiance (see
            :func:`mcdenoise.nn.auto_exposure`) of the first frame that is not black becomes middle grey, 0.18.

    Attributes:
        written: the files, in the order of their writing.

    Raises:
        InputError: a setting is out of its range, or the package is not installed.

    Example:
        >>> import tempfile, torch
        >>> folder = Path(tempfile.mkdtemp())
        >>> preview = Preview(folder, video=False)
        >>> preview.add("still", torch.rand(3, 16, 16))
        >>> preview.close()
        >>> [path.relative_to(folder).as_posix() for path in preview.written]
        ['preview/still.png']
    """

    def __init__(
        self, folder: Path, *, video: bool = True, frames_per_second: float = 24.0, exposure: float | None = None
    ) -> None:
        if exposure is not None and not -_MOST_STOPS <= exposure <= _MOST_STOPS:
            raise InputError(f"exposure: expected {-_MOST_STOPS:g} to {_MOST_STOPS:g} stops, found {exposure:g}")
        if video:
            check_video(frames_per_second)
        self.folder = folder
        self.video = video
        self.frames_per_second = frames_per_second
        self.exposure = exposure
        self.written: list[Path] = []

    def add(self, name: str, image: Tensor, metadata: Metadata | None = None) -> None:
        """Write the PNG of the next frame.

        Args:
            name: of the frame; its PNG has that name.
            image: ``(3, H, W)`` or ``(1, 3, H, W)`` scene-linear radiance.
            metadata: of the frame's file; primaries that it states are converted to those of sRGB.

        Raises:
            InputError: the primaries are no colour space, or the file cannot be written.
        """
        if not self.written:
            make_folder(self.folder / "preview")
            if self._video_path.is_file():
                remove(self._video_path)
        shown = to_rec709(image.detach().reshape(3, *image.shape[-2:]), metadata or {})
        if self.exposure is None and float(shown.amax()) > 0:
            self.exposure = math.log2(float(auto_exposure(shown[None].float(), _MIDDLE_GREY)))
        factor = 2.0 ** (self.exposure or 0.0)
        codes = [display_codes(rows.float() * factor).permute(1, 2, 0).cpu().numpy() for rows in shown.split(_ROWS, 1)]
        path = self.folder / "preview" / f"{name}.png"
        write_png(path, np.concatenate(codes))
        self.written.append(path)

    def close(self, *, on_frame: Callable[[], None] = lambda: None) -> None:
        """Write the video of the frames, whole or not at all; nothing where there is one frame, or none.

        It is made of the PNGs, one at a time, after the last frame: while frames are denoised, it takes no memory.

        Args:
            on_frame: called before each frame of the video.

        Raises:
            InputError: the frames differ in size, or the file cannot be written.
        """

        def picture(path: Path) -> Picture:
            on_frame()
            return read_png(path)

        if self.video and len(self.written) > 1:
            write_video(self._video_path, map(picture, self.written), self.frames_per_second)
            self.written.append(self._video_path)

    @property
    def _video_path(self) -> Path:
        return self.folder / "preview.mp4"
