"""Images are decoded in strips of as many rows as compression takes together."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest

from mcdenoise.data import open_sequence
from mcdenoise.data.images import read_channels

HEIGHT, WIDTH = 301, 5
LOSSLESS = ("none", "rle", "zip", "zips", "piz", "htj2k256")
LOSSY = ("pxr24", "b44", "b44a", "dwaa", "dwab")


@pytest.mark.parametrize("compression", LOSSLESS + LOSSY)
def test_strips_are_the_rows_of_the_image(save: Callable[..., Path], tmp_path: Path, compression: str) -> None:
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


def test_a_layer_that_is_the_color_but_for_its_first_rows_is_no_twin(save: Callable[..., Path], tmp_path: Path) -> None:
    color = np.random.default_rng(0).random((40, 24), dtype=np.float32)
    other = color.copy()
    other[0, 0] += 1
    channels: dict[str, Any] = {f"Combined.{c}": color for c in "RGB"}
    channels |= {f"same.{c}": color for c in "RGB"} | {f"near.{c}": other for c in "RGB"}
    opened = open_sequence(save(tmp_path / "a.exr", channels))
    (row,) = opened.table
    assert "the same as same.RGB," in row.reading
    assert "near" not in row.reading


def test_light_of_display_values_is_made_linear_like_the_color(save: Callable[..., Path], tmp_path: Path) -> None:
    codes = np.random.default_rng(0).integers(1, 255, (24, 32, 3)) / 255
    for name in ("color", "emission"):
        save(tmp_path / f"{name}.png", dict(zip("RGB", codes.transpose(2, 0, 1), strict=True)), "uint8")
    opened = open_sequence(tmp_path, lights=("emission",))
    assert list(opened.lights) == ["emission"]
    frame = opened.frame(0)
    np.testing.assert_allclose(frame.layers["emission"].numpy(), frame.color.numpy(), rtol=1e-5)
