"""Give a rendered sequence more realisations of its noise: cheap, beside references that took minutes a frame.

    python training/more_noise.py SEQUENCE scene.xml -o OUT --realisations 6

Copies the sequence to OUT/NAME and renders its frames again from the same cameras, once for each further realisation,
with other seeds (101, 102, ...). Its ``camera.json`` must have the cameras, as those that `mcdenoise render` writes do.
"""

import argparse
import json
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np

from mcdenoise.data import open_sequence
from mcdenoise.errors import InputError
from mcdenoise.scenes.render import Camera, render_sequence

_FIRST_SEED = 100


def add_realisations(source: Path, scene: Path, out: Path, realisations: int) -> Path:
    """Copy a sequence and add noisy colours; returns the folder of the copy."""
    sequence = open_sequence(source)
    inputs = source / "inputs" if (source / "inputs").is_dir() else source
    try:
        about = json.loads((inputs / "camera.json").read_text())
        cameras = [Camera(np.array(pose), about["fov_x_degrees"]) for pose in about["camera_to_world"]]
        max_depth, spp = about["max_depth"], about.get("noisy_spp", 1)
        moves = {name: np.array(path) for name, path in about.get("moves", {}).items()}
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{inputs / 'camera.json'}: expected cameras and max_depth, found none ({error})") from error
    copied = out / sequence.name / "inputs"
    shutil.copytree(inputs, copied, ignore=shutil.ignore_patterns(".*"), dirs_exist_ok=True)
    height, width = sequence.size
    for realisation in range(1, realisations):
        with tempfile.TemporaryDirectory(dir=out) as folder:
            rendered = render_sequence(
                scene,
                cameras,
                Path(folder),
                size=(width, height),
                spp=spp,
                reference_frames=[],
                moves=moves,
                seed=_FIRST_SEED + realisation,
                max_depth=max_depth,
            )
            place = copied / f"realisation{realisation}"
            place.mkdir(exist_ok=True)
            for number in sequence.numbers:
                shutil.move(rendered / f"color{number}.exr", place / f"color{number}.exr")
    return copied.parent


def main() -> None:
    """Parse, copy and render."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("sequence", type=Path, help="folder of a sequence with its camera.json")
    parser.add_argument("scene", type=Path, help="the Mitsuba scene it was rendered from")
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder for the copy")
    parser.add_argument("--realisations", type=int, default=6, help="in all, with the one that is there")
    options = parser.parse_args()
    print(add_realisations(options.sequence, options.scene, options.out, options.realisations))


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
