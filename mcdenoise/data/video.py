"""Writing videos through FFmpeg: H.264 in MP4, which browsers, players and editors support."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Final

import numpy as np

from mcdenoise.data.files import atomic_path
from mcdenoise.data.png import Picture
from mcdenoise.errors import InputError, import_optional

# Longest side that hardware decoders support (level 5.1); larger pictures are scaled down.
_LONGEST = 4096
_RATES = (1.0, 1000.0)
_CODEC: Final = "libx264"
# Slower presets save less than a fifth of the bytes and take more memory.
_ENCODER = {"preset": "veryfast", "crf": "18"}


def check_video(frames_per_second: float) -> None:
    """Check that a video can be written.

    Args:
        frames_per_second: 1 to 1000.

    Raises:
        InputError: the frame rate is out of range, or the package of ``mcdenoise[preview]`` is not installed or was
            built without the encoder.
    """
    slowest, fastest = _RATES
    if not slowest <= frames_per_second <= fastest:
        raise InputError(f"frames per second: expected {slowest:g} to {fastest:g}, found {frames_per_second:g}")
    if _CODEC not in import_optional("av", "a video", "preview").codecs_available:
        raise InputError(f"a video: expected av with {_CODEC}, found it built without; install its wheel")


def write_video(path: Path, pictures: Iterable[Picture], frames_per_second: float = 24.0) -> None:
    """Write pictures as an MP4 file (H.264, 8 bit, 4:2:0 chroma), atomically.

    Memory does not depend on the number of pictures: besides the encoder's look-ahead, one picture is held at a time.
    4:2:0 chroma needs even sizes, so an odd last row or column is repeated. Pictures with a side of more than 4096
    pixels are scaled down.

    Args:
        path: the file. Its folder must exist.
        pictures: at least one, ``(H, W, 3)``, on the sRGB curve, all of one size.
        frames_per_second: 1 to 1000.

    Raises:
        InputError: see :func:`check_video`; the pictures differ in size, or the file cannot be written.
        ValueError: there is no picture.
    """
    check_video(frames_per_second)
    # Imported here because it is optional, and loads FFmpeg.
    import av
    from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc

    remaining = iter(pictures)
    first = next(remaining, None)
    if first is None:
        raise ValueError("a video: expected at least one picture, found none")
    width, height = _size_in_video(first)
    with atomic_path(path) as temporary:
        try:
            # Put the index first, so that a browser can play the video while it loads.
            with av.open(temporary, "w", options={"movflags": "faststart"}) as container:
                # MP4 counts time in integer ticks: use a ratio of small integers.
                rate = Fraction(frames_per_second).limit_denominator(1001)
                stream = container.add_stream(_CODEC, rate, options=_ENCODER)
                stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
                # Without this, players guess the color space from the number of rows.
                stream.codec_context.color_primaries = ColorPrimaries.BT709
                stream.codec_context.color_trc = ColorTrc.IEC61966_2_1
                stream.codec_context.colorspace = Colorspace.ITU709
                stream.codec_context.color_range = ColorRange.MPEG
                for picture in chain([first], remaining):
                    if picture.shape != first.shape:
                        raise InputError(f"{path}: expected pictures of {first.shape}, found one of {picture.shape}")
                    frame = av.VideoFrame.from_ndarray(_even(picture), "rgb24").reformat(
                        width,
                        height,
                        "yuv420p",
                        src_color_range=ColorRange.JPEG,
                        dst_colorspace=Colorspace.ITU709,
                        dst_color_range=ColorRange.MPEG,
                    )
                    container.mux(stream.encode(frame))
                container.mux(stream.encode())
        except av.FFmpegError as error:
            # `atomic_path` reports errors of the operating system, such as a full disk.
            if isinstance(error, OSError):
                raise
            raise InputError(f"{path}: expected frames that H.264 can hold, found: {error.strerror}") from error


def _size_in_video(picture: Picture) -> tuple[int, int]:
    """Width and height, both even, with a longest side of at most 4096."""
    height, width, _ = _even(picture).shape
    scale = min(1.0, _LONGEST / max(width, height))
    across, down = (max(2 * round(length * scale / 2), 2) for length in (width, height))
    return across, down


def _even(picture: Picture) -> Picture:
    height, width, _ = picture.shape
    return np.pad(picture, ((0, height % 2), (0, width % 2), (0, 0)), "edge")
