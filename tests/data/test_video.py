"""Videos: as many frames as pictures, the same pictures, and no file that is not whole."""

import sys
from pathlib import Path

import numpy as np
import pytest
from pictures import frames_of
from refusals import full_disk, refused

from mcdenoise.data.png import Picture
from mcdenoise.data.video import write_video

av = pytest.importorskip("av")


def gradient(height: int, width: int, blue: int = 60) -> Picture:
    """Colours that change little from pixel to pixel, which chroma of half the resolution holds."""
    rows, columns = np.mgrid[0:height, 0:width]
    red, green = 40 + 150 * rows / height, 40 + 150 * columns / width
    return np.stack([red, green, np.full_like(red, blue)], -1).astype(np.uint8)


@pytest.mark.parametrize("count", [1, 11])
def test_every_picture_is_a_frame(tmp_path: Path, count: int) -> None:
    pictures = [gradient(48, 64, 20 * number) for number in range(count)]
    write_video(tmp_path / "a.mp4", iter(pictures), 12.5)
    frames = frames_of(tmp_path / "a.mp4")
    assert len(frames) == count
    for picture, frame in zip(pictures, frames, strict=True):
        # A wrong matrix or range, or a neighbour in its place, is off by 6 codes and more.
        assert np.abs(frame.astype(float) - picture).mean() < 3
    with av.open(tmp_path / "a.mp4") as container:
        stream = container.streams.video[0]
        assert (stream.codec.name, stream.pix_fmt, float(stream.average_rate)) == ("h264", "yuv420p", 12.5)
        assert float(stream.duration * stream.time_base) == pytest.approx(count / 12.5)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


@pytest.mark.parametrize(
    ("color", "luma"),
    # ITU-R BT.709: Y = 16 + 219 (0.2126 R + 0.7152 G + 0.0722 B).
    [((255, 255, 255), 235), ((0, 0, 0), 16), ((255, 0, 0), 63), ((0, 255, 0), 173), ((0, 0, 255), 32)],
)
def test_colors_are_those_that_the_file_states(tmp_path: Path, color: tuple[int, int, int], luma: int) -> None:
    write_video(tmp_path / "a.mp4", [np.full((32, 32, 3), color, np.uint8)])
    with av.open(tmp_path / "a.mp4") as container:
        frame = next(container.decode(video=0))
        stated = (frame.color_primaries, frame.color_trc, frame.colorspace, frame.color_range)
        # BT.709 primaries and matrix, IEC 61966-2-1 (sRGB) curve, 16 to 235.
        assert stated == (1, 13, 1, 1)
        assert abs(int(frame.to_ndarray(format="yuv420p")[16, 16]) - luma) <= 1


def test_a_failed_video_leaves_the_old_one(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    write_video(path, [gradient(16, 16)] * 2)
    before = path.read_bytes()
    assert "expected pictures of" in refused(write_video, path, [gradient(16, 16), gradient(16, 18)])
    with pytest.raises(ValueError, match="expected at least one picture"):
        write_video(path, [])

    def interrupted() -> None:
        write_video(path, (picture if number < 5 else 1 / 0 for number, picture in enumerate([gradient(16, 16)] * 6)))

    with pytest.raises(ZeroDivisionError):
        interrupted()
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
    assert "cannot be written" in refused(write_video, tmp_path / "missing" / "a.mp4", [gradient(16, 16)])


@pytest.mark.skipif(sys.platform == "win32", reason="limits the file size through the POSIX resource limit")
@pytest.mark.parametrize("room", [0, 100, 5000, 40000])
def test_a_full_disk_is_told(tmp_path: Path, room: int) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (8, 96, 96, 3), dtype=np.uint8)
    with full_disk(room):
        assert "cannot be written" in refused(write_video, tmp_path / "a.mp4", noise)
    assert not list(tmp_path.iterdir())
