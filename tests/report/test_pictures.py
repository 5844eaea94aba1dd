import numpy as np
import pytest

from mcdenoise.report.pictures import BRIGHTEST, choose_crops, choose_row, decode, encode


def test_a_code_is_the_nearest_one():
    radiance = np.geomspace(1e-6, BRIGHTEST, 5000).astype(np.float32)
    codes = encode(radiance).astype(float)
    assert (decode(np.maximum(codes - 0.5, 0)) <= radiance * (1 + 1e-5)).all()
    # Half a step above the last code there is nothing to decode.
    below = codes < 255
    assert (decode(codes[below] + 0.5) >= radiance[below] * (1 - 1e-5)).all()


def test_codes_of_known_values():
    # Computed by hand: x = 1 is 1/2 of 64/65, and (65/128)^(1/2.2) = 0.7350, times 255 = 187.4.
    assert encode(np.float32([0, 1, BRIGHTEST, 1e9, np.inf, np.nan, -3])).tolist() == [0, 187, 255, 255, 255, 0, 0]
    assert decode(np.array([0, 255])) == pytest.approx([0, BRIGHTEST])
    assert (encode(decode(np.arange(256)).astype(np.float32)) == np.arange(256)).all()


def test_crops_are_where_images_differ_and_where_detail_is():
    random = np.random.default_rng(0)
    reference = np.full((120, 240, 3), 0.5, np.float32)
    reference[10:40, 190:230] += 0.3 * (random.random((30, 40, 1)) > 0.5)  # fine detail at the top right
    first, second = reference.copy(), reference.copy()
    second[80:110, 30:70] += 0.4  # differs at the bottom left
    crops = choose_crops([first, second], reference)
    assert len(crops) == 3
    differ, detail = crops[0], crops[2]
    assert differ.left <= 50 <= differ.left + differ.width
    assert differ.top <= 95 <= differ.top + differ.height
    assert detail.left <= 210 <= detail.left + detail.width
    assert detail.top <= 25 <= detail.top + detail.height
    covered = np.zeros((120, 240), int)
    for crop in crops:
        crop.of(covered)[...] += 1
    assert covered.max() == 1


def test_a_frame_too_small_for_three_crops_has_fewer():
    crops = choose_crops([], np.random.default_rng(0).random((9, 20, 3), np.float32))
    assert [(crop.left, crop.top, crop.width, crop.height) for crop in crops] == [(0, 0, 20, 9)]


def test_row_of_the_profile_is_where_something_flickers():
    still = np.full((40, 200, 3), 90, np.uint8)
    flicker = still.copy()
    flicker[23, 120:200] = 200
    flicker[0] = 255  # what enters at the border is no flicker
    row, left, columns = choose_row([[still, flicker, still]])
    assert (row, columns) == (23, 100)
    assert left <= 120
    assert left + columns >= 200
