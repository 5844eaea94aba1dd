"""Data windows that differ between frames or parts of one display window."""

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from pictures import part_of, stored
from refusals import refused

from mcdenoise import Denoiser
from mcdenoise.data import open_sequence
from mcdenoise.folder import denoise_sequence

Image = np.ndarray[Any, Any]
DISPLAY = (40, 64)


def radiance(height: int, width: int, seed: int) -> dict[str, Image]:
    pixels = np.random.default_rng(seed).gamma(2, 0.2, (3, height, width)).astype(np.float32)
    return dict(zip("RGB", pixels, strict=True))


WINDOWS = [(4, 5, 20, 30), (6, 9, 24, 28), (0, 30, 10, 34)]


@pytest.fixture
def cropped(tmp_path: Path) -> Path:
    """Frames that the renderer has cropped to what they show, as (top, left, height, width)."""
    (tmp_path / "in").mkdir()
    for number, (top, left, height, width) in enumerate(WINDOWS):
        channels = radiance(height, width, number) | {"Z": np.full((height, width), 2 + number, np.float32)}
        OpenEXR.File([part_of(channels, place=(top, left), display=DISPLAY)]).write(
            str(tmp_path / f"in/shot_{number:04d}.exr")
        )
    return tmp_path / "in"


def test_frames_share_the_window_of_all_and_void_pixels_are_masked(cropped: Path) -> None:
    sequence = open_sequence(cropped)
    # Rows 0 to 30, columns 5 to 64.
    assert sequence.size == (30, 59)
    assert "mask" in sequence.buffers
    for number, (top, left, height, width) in enumerate(WINDOWS):
        frame = sequence.frame(number)
        frame.validate()
        inside = np.zeros((30, 59), bool)
        inside[top : top + height, left - 5 : left - 5 + width] = True
        np.testing.assert_array_equal(frame.mask[0, 0].numpy() > 0, inside)
        np.testing.assert_array_equal(frame.depth[0, 0].numpy(), np.where(inside, 2 + number, np.inf))
        expected = np.stack(list(radiance(height, width, number).values()))
        np.testing.assert_array_equal(frame.color[0].numpy()[:, inside], expected.reshape(3, -1))


@pytest.mark.parametrize("matte", [0.0, 1.0])
def test_a_matte_of_an_object_masks_no_light_even_where_the_object_is_not_seen(matte: float, tmp_path: Path) -> None:
    channels = radiance(*DISPLAY, 0) | {"mask": np.zeros(DISPLAY, np.float32)}
    for name in "RGB":
        channels[name][:3] = 0
    channels["mask"][30:] = matte
    OpenEXR.File([part_of(channels)]).write(str(tmp_path / "shot.exr"))
    frame = open_sequence(tmp_path / "shot.exr").frame(0)
    np.testing.assert_array_equal(frame.mask[0, 0].numpy() > 0, np.arange(DISPLAY[0])[:, None] >= np.full(DISPLAY, 3))


@pytest.mark.parametrize("options", [{}, {"output_layer": "clean"}])
def test_each_file_is_written_in_its_own_window(cropped: Path, tmp_path: Path, options: dict[str, str]) -> None:
    denoise_sequence(open_sequence(cropped), tmp_path / "out", Denoiser("noisy"), "noisy", **options)
    for path in sorted(cropped.iterdir()):
        ((before, old),), ((after, new),) = stored(path), stored(tmp_path / "out" / path.name)
        assert str(before["dataWindow"]) == str(after["dataWindow"])
        for name in "RGBZ":
            np.testing.assert_array_equal(old[name], new[name])
        for name in "RGB" if options else "":
            np.testing.assert_array_equal(old[name], new[f"clean.{name}"])


def test_a_cropped_feature_is_placed_where_it_belongs(tmp_path: Path) -> None:
    albedo = {f"albedo.{name}": np.full((10, 12), 0.25, np.float32) for name in "RGB"}
    path = tmp_path / "shot.exr"
    cropped = part_of(albedo, "albedo", place=(8, 20), display=DISPLAY)
    OpenEXR.File([part_of(radiance(*DISPLAY, 0), "rgba"), cropped]).write(str(path))
    sequence = open_sequence(path)
    frame = sequence.frame(sequence.numbers[0])
    expected = np.zeros(DISPLAY, np.float32)
    expected[8:18, 20:32] = 0.25
    np.testing.assert_array_equal(frame.albedo[0, 0].numpy(), expected)
    assert bool((frame.mask == 1).all())
    denoise_sequence(sequence, tmp_path / "out", Denoiser("noisy"), "noisy")
    for (before, old), (after, new) in zip(stored(path), stored(tmp_path / "out/shot.exr"), strict=True):
        assert str(before["dataWindow"]) == str(after["dataWindow"])
        assert all(np.array_equal(old[name], new[name]) for name in old)


def test_another_display_window_is_refused(cropped: Path) -> None:
    channels = radiance(20, 30, 0) | {"Z": np.ones((20, 30), np.float32)}
    other = part_of(channels, place=(4, 6), display=(80, 128))
    OpenEXR.File([other]).write(str(cropped / "shot_0001.exr"))
    assert "shot_0001.exr" in refused(open_sequence, cropped)
