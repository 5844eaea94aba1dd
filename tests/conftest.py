import gc
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from toys import small

from mcdenoise.data.camera_matrices import CameraMatrices, write_camera_matrices
from mcdenoise.data.color_space import import_colour
from mcdenoise.data.readers.bmfr import write_bmfr_frame
from mcdenoise.frame import Frame
from mcdenoise.models import save_weights

HEIGHT, WIDTH, FRAMES = 20, 24, 4

# The same on every processor, where a test does not ask for another; for the processes that tests start, too.
os.environ["MCDENOISE_PRECISION"] = "float32"


# Models that differ from smaller ones of their family by their sizes, in tests of every model: those show as much.
LARGER = ("wild_large",)
OF_EVERY_MODEL = ("bad_input", "defaults", "device_reads", "export", "layers", "models", "pieces")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the larger members of a family as slow."""
    for item in items:
        given = item.callspec.params if isinstance(item, pytest.Function) and hasattr(item, "callspec") else {}
        larger = any(str(given.get(key)) in LARGER for key in ("name", "model"))
        if larger and item.path.stem.removeprefix("test_") in OF_EVERY_MODEL:
            item.add_marker(pytest.mark.slow)


@pytest.fixture(scope="session")
def colour() -> Any:
    return import_colour()


torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def seed() -> Iterator[None]:
    """A test draws the same numbers each time, on one thread, whatever ran before it."""
    torch.manual_seed(0)
    yield
    torch.set_num_threads(1)


@pytest.fixture
def no_finalizers() -> Iterator[None]:
    """No garbage is collected while nested text uses up the stack: a finalizer of any test before would fail there."""
    gc.disable()
    yield
    gc.enable()


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    path = tmp_path / "small.safetensors"
    path.write_bytes(save_weights(small("cascaded"), "cascaded", {"width": 8}, {}))
    return path


@pytest.fixture
def small_sequence(tmp_path: Path) -> Path:
    """A scene folder of :func:`write_small_sequence`, for one test."""
    return write_small_sequence(tmp_path)


@pytest.fixture(scope="session")
def shared_sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same for all tests, none of which writes to it."""
    return write_small_sequence(tmp_path_factory.mktemp("shared"))


def write_small_sequence(folder: Path) -> Path:
    """Write a scene folder in the bmfr layout: 4 frames, 24 x 20 pixels, a moving camera above a floor, sky at the top.

    A strip of the floor is a mirror (no albedo, but a normal). Color is noisy radiance; its mean is the reference.
    """
    inputs = folder / "plane" / "inputs"
    cameras = [_camera(number) for number in range(FRAMES)]
    for number, (eye, axes, focal, _) in enumerate(cameras):
        write_bmfr_frame(inputs, number, _render(eye, axes, focal, seed=number))
    matrices = np.stack([matrix for *_, matrix in cameras])
    write_camera_matrices(inputs / "camera_matrices.h", CameraMatrices(matrices, np.full((FRAMES, 2), 0.5)), "plane")
    return inputs.parent


def _camera(number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Eye, rows (right, down, forward), focal lengths in clip units, row-vector world-to-clip matrix."""
    eye = np.array([0.1 * number, 1.0, 0.05 * number])
    yaw, pitch = 0.02 * number, 0.3
    forward = np.array([np.sin(yaw) * np.cos(pitch), -np.sin(pitch), np.cos(yaw) * np.cos(pitch)])
    right = np.array([np.cos(yaw), 0.0, -np.sin(yaw)])
    axes = np.stack([right, np.cross(right, forward), forward])
    axes[1] *= -np.sign(axes[1, 1])  # down
    focal = np.array([1.2, 1.2 * WIDTH / HEIGHT])
    near, far = 0.01, 100.0
    columns = [focal[0] * axes[0], focal[1] * axes[1], far / (far - near) * axes[2], axes[2]]
    offsets = [0.0, 0.0, -near * far / (far - near), 0.0]
    matrix = np.zeros((4, 4))
    for index, (column, offset) in enumerate(zip(columns, offsets, strict=True)):
        matrix[:3, index], matrix[3, index] = column, offset - column @ eye
    return eye, axes, focal, matrix


def _render(eye: np.ndarray, axes: np.ndarray, focal: np.ndarray, seed: int) -> Frame:
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    x, y = (2 * columns / WIDTH - 1) / focal[0], (2 * rows / HEIGHT - 1) / focal[1]
    rays = axes[2] + x[..., None] * axes[0] + y[..., None] * axes[1]
    hit = rays[..., 1] < -0.02
    depth = np.where(hit, -eye[1] / np.where(hit, rays[..., 1], -1.0), 50.0)
    position = eye + depth[..., None] * rays
    mirror = hit & (np.abs(position[..., 0]) < 0.2)
    checker = (np.floor(position[..., 0] * 2) + np.floor(position[..., 2] * 2)) % 2
    albedo = np.where(checker[..., None] > 0, [0.8, 0.6, 0.4], [0.2, 0.3, 0.4]) * (hit & ~mirror)[..., None]
    irradiance = 1 + 0.5 * np.cos(position[..., 2:])
    sky = np.array([0.3, 0.5, 0.9])
    reference = np.where((hit & ~mirror)[..., None], albedo * irradiance, sky)
    noise = np.random.default_rng(seed).exponential(size=reference.shape)
    return Frame(
        color=_tensor(reference * np.where(hit[..., None], noise, 1)),
        albedo=_tensor(albedo),
        normal=_tensor(np.array([0.0, 1.0, 0.0]) * hit[..., None]),
        depth=_tensor(np.where(hit, depth, np.inf)[..., None]),
        position=_tensor(position),
        reference=_tensor(reference),
    )


def _tensor(image: np.ndarray) -> Tensor:
    return torch.from_numpy(image).float().permute(2, 0, 1)[None].contiguous()
