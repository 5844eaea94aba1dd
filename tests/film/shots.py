"""Small shots, that a camera walks past a wall in, films of them, and an engine that makes films in this process."""

from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future
from pathlib import Path
from typing import Any

import numpy as np
from planes import exponential, leaning_wall

from mcdenoise.data.camera_matrices import CameraMatrices, write_camera_matrices
from mcdenoise.data.exr import read_exr, write_exr
from mcdenoise.data.readers.bmfr import write_bmfr_frame
from mcdenoise.engines import Outcome
from mcdenoise.errors import in_one_line
from mcdenoise.film import work
from mcdenoise.frame import Frame


class Inline:
    """An engine that does every task at once, in this process, and loses those that ``lose`` selects."""

    lost, slots = (BrokenExecutor,), 1

    def __init__(self, lose: Callable[[str, int], bool] = lambda task, count: False) -> None:
        self.tasks: list[str] = []
        self.lose = lose

    def submit(self, function: Callable[..., Any], *arguments: Any) -> Future[Outcome]:
        self.tasks.append(function.__name__)
        done: Future[Outcome] = Future()
        if self.lose(function.__name__, len(self.tasks)):
            done.set_exception(BrokenExecutor())
            return done
        try:
            done.set_result((function(*arguments), None))
        except Exception as error:
            done.set_result((None, in_one_line(error)))
        return done

    def close(self) -> None:
        work.open_shot.cache_clear()


def write_shot(folder: Path, frames: int, *, width: int = 32, height: int = 20, seed: int = 0) -> Path:
    inputs = folder / "inputs"
    walls = [leaning_wall(number, width, height) for number in range(frames)]
    matrices = np.concatenate([wall["view_projection"].double().numpy() for wall in walls])
    for number in range(frames):
        write_bmfr_frame(inputs, number, frame(number, width, height, seed))
    cameras = CameraMatrices(matrices, np.full((frames, 2), 0.5))
    write_camera_matrices(inputs / "camera_matrices.h", cameras, "wall")
    return folder


def frame(number: int, width: int, height: int, seed: int) -> Frame:
    """One sample a pixel of a leaning wall."""
    noise = exponential(1, 3, height, width, seed=seed * 100_003 + number)
    wall = leaning_wall(number, width, height)
    # The camera has a file of its own.
    del wall["view_projection"]
    return Frame(wall["albedo"] * noise, **wall)


def write_manifest(path: Path, shots: dict[str, Path], **every: object) -> Path:
    lines = ["[every]", *(f"{key} = {_toml(value)}" for key, value in every.items())]
    for name, folder in shots.items():
        lines += ["[[shot]]", f"name = {_toml(name)}", f"input = {_toml(str(folder))}"]
    path.write_text("\n".join(lines) + "\n")
    return path


def _toml(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else f'"{value}"' if isinstance(value, str) else str(value)


def edit(path: Path) -> None:
    image, channels, _ = read_exr(path)
    write_exr(path, image * 1.5, channels, full_float=True)


def pixels(folder: Path) -> dict[str, np.ndarray]:
    return {path.name: read_exr(path)[0] for path in sorted(folder.glob("*.exr"))}


def same(one: Path, other: Path) -> bool:
    a, b = pixels(one), pixels(other)
    return a.keys() == b.keys() and bool(a) and all(np.array_equal(a[name], b[name], equal_nan=True) for name in a)
