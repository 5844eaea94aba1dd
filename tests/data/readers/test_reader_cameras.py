"""Cameras found from the positions that they see, and cameras checked by them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mcdenoise.data import open_sequence
from mcdenoise.data.camera_matrices import read_camera_matrices, write_camera_matrices
from mcdenoise.data.images import read_channels
from mcdenoise.data.readers.cameras import fit_camera

Array = np.ndarray[Any, Any]
HEIGHT, WIDTH = 54, 96
EYE, TARGET, UP = np.array([1.5, -6.0, 2.5]), np.array([0.2, 0.5, 0.8]), np.array([0.0, 0.0, 1.0])
# Half the width of what is seen at distance 1.
TANGENT = 0.6


FORWARD = (TARGET - EYE) / np.linalg.norm(TARGET - EYE)
RIGHT = np.cross(FORWARD, UP) / np.linalg.norm(np.cross(FORWARD, UP))
DOWN = np.cross(FORWARD, RIGHT)
# The centres of pixels, from -1 to 1.
SCREEN = (np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), -1) + 0.5) / (WIDTH, HEIGHT) * 2 - 1


def rays() -> Array:
    """Directions of the centres of pixels, with length 1 along the axis."""
    return FORWARD + TANGENT * (SCREEN[..., :1] * RIGHT + HEIGHT / WIDTH * SCREEN[..., 1:] * DOWN)


def room(directions: Array, origin: Array = EYE) -> Array:
    """Return where rays meet a floor, a wall, a wall on the left or a ball."""
    distances = [(0 - origin[..., 2]) / directions[..., 2], (3 - origin[..., 1]) / directions[..., 1]]
    distances.append((-3 - origin[..., 0]) / directions[..., 0])
    away, radius = origin - np.array([0.3, 0.0, 1.0]), 0.9
    a, b, c = (directions**2).sum(-1), (directions * away).sum(-1), (away**2).sum(-1) - radius**2
    found = b**2 - a * c
    distances.append(np.where(found > 0, (-b - np.sqrt(np.maximum(found, 0))) / a, -1))
    stacked = np.stack([np.broadcast_to(each, directions.shape[:2]) for each in distances])
    nearest = np.where(stacked > 0, stacked, np.inf).min(0)
    return origin + nearest[..., None] * directions


ALL = np.ones((HEIGHT, WIDTH), bool)


def test_the_camera_of_exact_positions() -> None:
    position = room(rays())
    found = fit_camera(position, ALL)
    # Clip y is down, and z is w, the distance along the axis.
    columns = np.stack([RIGHT / TANGENT, DOWN / TANGENT * WIDTH / HEIGHT, FORWARD, FORWARD], 1)
    expected = np.concatenate([columns, -(EYE @ columns)[None]])
    np.testing.assert_allclose(found.matrix, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
    np.testing.assert_allclose(found.eye, EYE, atol=1e-6)
    assert found.error < 1e-6


def test_an_orthographic_camera() -> None:
    origin = EYE + 2 * SCREEN[..., :1] * RIGHT + 2 * HEIGHT / WIDTH * SCREEN[..., 1:] * DOWN
    position = room(np.broadcast_to(FORWARD, (HEIGHT, WIDTH, 3)), origin)
    found = fit_camera(position, ALL)
    assert found.error < 1e-6
    # Without a perspective w is 1 everywhere.
    np.testing.assert_allclose(position @ found.matrix[:3, 3] + found.matrix[3, 3], 1, atol=1e-6)
    expected = np.concatenate([RIGHT / 2, [-(EYE @ RIGHT) / 2]])
    np.testing.assert_allclose(found.matrix[:, 0], expected, atol=1e-6)


def test_no_camera_is_found_from_points_of_one_plane() -> None:
    direction = rays()
    floor = EYE + (0 - EYE[2]) / direction[..., 2:] * direction
    down = direction[..., 2] < -0.05
    assert down.sum() > 1000
    assert fit_camera(floor, down) is None
    # It is still a plane with the noise of 32 bits.
    assert fit_camera(floor.astype(np.float32).astype(np.float64), down) is None


@pytest.mark.parametrize("number", [1, 4])
def test_the_camera_of_blender(number: int, rendered: Path, others: Any) -> None:
    channels = {0: [f"ViewLayer.{each}" for each in ("Position.X", "Position.Y", "Position.Z", "Depth.Z")]}
    pixels = read_channels(rendered / "blender" / f"shot_{number:04d}.exr", channels)[0].astype(np.float64)
    found = fit_camera(pixels[..., :3], pixels[..., 3] < 1e9)
    place = others.CAMERA + (number - 1) * others.STEP
    # Positions of 32 bits up to 13 are exact to 1e-6, and a ray of a pixel is 0.02 wide.
    np.testing.assert_allclose(found.eye, place, atol=1e-4)
    forward = (others.TARGET - place) / np.linalg.norm(others.TARGET - place)
    np.testing.assert_allclose(found.matrix[:3, 3], forward, atol=1e-4)
    # A focal length of 30 on a sensor of 36 millimetres.
    assert np.linalg.norm(found.matrix[:3, 0] - found.matrix[:3, 0] @ forward * forward) == pytest.approx(
        60 / 36, rel=1e-4
    )
    assert found.error < 1e-4


@pytest.mark.parametrize("convention", ["", "y up", "transposed", "transposed, y up"])
def test_matrices_of_a_folder_are_read_in_any_convention(convention: str, small_sequence: Path) -> None:
    path = small_sequence / "inputs" / "camera_matrices.h"
    sequence = open_sequence(small_sequence)
    expected = [sequence.frame(number).view_projection for number in sequence.numbers]
    cameras = read_camera_matrices(path)
    stored = []
    for number in sequence.numbers:
        each = cameras.view_projection(number, sequence.size).copy()
        if "y up" in convention:
            each[:, 1] *= -1
        stored.append(each.T if "transposed" in convention else each)
    write_camera_matrices(path, replace(cameras, matrices=np.stack(stored)), "plane")
    opened = open_sequence(small_sequence)
    assert len(opened.warnings) == (convention != "")
    assert all(convention in warning for warning in opened.warnings)
    for number, matrix_of_frame in zip(opened.numbers, expected, strict=True):
        frame = opened.frame(number)
        frame.validate()
        np.testing.assert_allclose(frame.view_projection, matrix_of_frame, rtol=1e-4, atol=1e-5)


def test_matrices_of_something_else_are_told(small_sequence: Path) -> None:
    path = small_sequence / "inputs" / "camera_matrices.h"
    cameras = read_camera_matrices(path)
    moved = np.stack([cameras.view_projection(n, (20, 24)) for n in range(4)])
    moved[:, 3, 0] += 3
    write_camera_matrices(path, replace(cameras, matrices=moved), "plane")
    (warning,) = open_sequence(small_sequence).warnings
    assert "camera_matrices.h" in warning
    assert "whichever way" in warning
