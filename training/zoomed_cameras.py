"""Write camera paths that show a part of what another path shows, magnified: crops of images of many more pixels.

    python training/zoomed_cameras.py camera_path.json -o OUT --shots 6 --frames 12 --zoom 3 8 --seed 0

A network that has only seen small images knows neither the wide even surfaces nor the fast motion of large ones, and
these are too expensive to render in numbers. Each shot takes successive cameras of the path, a direction of its own
within their image, and an angle of view that is narrower by a factor drawn between the two of ``--zoom``.
"""

import argparse
import json
import math
import sys
from pathlib import Path

import numpy as np

from mcdenoise.data.camera_path import Camera, load_shot
from mcdenoise.data.files import write_text
from mcdenoise.errors import InputError


def zoomed(cameras: list[Camera], frames: int, zoom: tuple[float, float], rng: np.random.Generator) -> list[Camera]:
    """One shot: ``frames`` successive cameras, turned and magnified alike."""
    start = int(rng.integers(len(cameras) - frames + 1))
    factor = math.exp(rng.uniform(*np.log(zoom)))
    half = math.tan(math.radians(cameras[start].fov_x) / 2)
    # Anywhere in an image of 16:9, as far as a square around it stays inside.
    inside = half * (1 - 1 / factor)
    direction = (rng.uniform(-inside, inside), rng.uniform(-inside, inside) * 9 / 16, 1.0)
    turn = Camera.look_at((0, 0, 0), direction, 1).to_world
    fov = 2 * math.degrees(math.atan(half / factor))
    return [Camera(camera.to_world @ turn, fov) for camera in cameras[start : start + frames]]


def main() -> None:
    """Parse, turn and write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("path", type=Path, help="camera path, as `mcdenoise render` takes it")
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder for shot0.json, shot1.json, ...")
    parser.add_argument("--shots", type=int, default=6)
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--zoom", type=float, nargs=2, default=(3.0, 8.0), metavar=("LEAST", "MOST"))
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    cameras = load_shot(options.path).cameras
    if not 1 <= options.frames <= len(cameras):
        raise InputError(f"--frames: expected 1 to {len(cameras)}, found {options.frames}")
    if not 1 <= options.zoom[0] <= options.zoom[1]:
        raise InputError(f"--zoom: expected two factors of at least 1, the least first, found {options.zoom}")
    rng = np.random.default_rng(options.seed)
    options.out.mkdir(parents=True, exist_ok=True)
    for number in range(options.shots):
        shot = zoomed(cameras, options.frames, tuple(options.zoom), rng)
        content = {"fov": shot[0].fov_x, "to_world": [camera.to_world.tolist() for camera in shot]}
        write_text(options.out / f"shot{number}.json", json.dumps(content) + "\n")


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
