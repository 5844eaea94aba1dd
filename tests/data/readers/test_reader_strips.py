"""Images are decoded in strips of as many rows as compression takes together."""

from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from pictures import save

from mcdenoise.data import open_sequence
from mcdenoise.data.images import read_channels

HEIGHT, WIDTH = 301, 5
LOSSLESS = ("none", "rle", "zip", "zips", "piz", "htj2k256")
LOSSY = ("pxr24", "b44", "b44a", "dwaa", "dwab")


@pytest.mark.parametrize("compression", LOSSLESS + LOSSY)
def test_strips_are_the_rows_of_the_image(tmp_path: Path, compression: str) -> None:
    rows = np.arange(HEIGHT, dtype=np.float32)[:, None].repeat(WIDTH, 1)
    path = save(tmp_path / "a.exr", {"R": rows, "G": rows + 1, "B": rows + 2}, compression=compression)
    file = oiio.ImageInput.open(str(path))
    assert file.spec()["compression"] == compression
    file.close()
    whole = read_channels(path, {0: ["B", "R"]})[0]
    np.testing.assert_allclose(whole[:, 0, :], np.stack([rows[:, 0] + 2, rows[:, 0]], -1), rtol=0.05, atol=2)
    if compression in LOSSLESS:
        np.testing.assert_array_equal(whole, np.stack([rows + 2, rows], -1))
    for some in (slice(-16, None), slice(3, 40), slice(0, HEIGHT + 9)):
        np.testing.assert_array_equal(read_channels(path, {0: ["B", "R"]}, some)[0], whole[some])


def test_light_of_display_values_is_made_linear_like_the_color(tmp_path: Path) -> None:
    codes = np.random.default_rng(0).integers(1, 255, (24, 32, 3)) / 255
    for name in ("color", "emission"):
        save(tmp_path / f"{name}.png", dict(zip("RGB", codes.transpose(2, 0, 1), strict=True)), "uint8")
    opened = open_sequence(tmp_path, lights=("emission",))
    assert list(opened.lights) == ["emission"]
    frame = opened.frame(0)
    np.testing.assert_allclose(frame.layers["emission"].numpy(), frame.color.numpy(), rtol=1e-5)
