"""Reads each file of a folder in a process of its own, with little memory: one line of JSON for each on stdout.

Each is opened as the shot of a renderer, and its frame is written to a second folder.
"""

import json
import resource
import sys
import traceback
import warnings
from pathlib import Path

import kornia.color  # noqa: F401 - before memory is counted
import numpy as np
import OpenEXR  # noqa: F401

from mcdenoise.data.images import read_channels, read_image_header
from mcdenoise.data.sequences import open_sequence
from mcdenoise.errors import InputError

# Beyond what the libraries have taken already.
MEMORY = 512 * 2**20


def taken() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def read_and_write(path: Path, out: Path) -> None:
    """All that is in it; then as a shot of one frame, which is written."""
    header = read_image_header(path)
    read_channels(path, {index: part.channels for index, part in enumerate(header.parts)})
    sequence = open_sequence([path])
    (number,) = sequence.numbers
    frame = sequence.frame(number)
    image = frame.color[0].permute(1, 2, 0).numpy()
    out.mkdir()
    try:
        written = sequence.write(out, number, np.nan_to_num(image, posinf=1))
    finally:
        files = list(out.iterdir())
        # The file is not there yet, or whole; nothing else is there.
        if files and files != [out / path.name]:
            raise AssertionError(f"left behind: {files}")
    again = read_image_header(written)
    read_channels(written, {index: part.channels for index, part in enumerate(again.parts)})
    if [part.channels for part in again.parts] != [part.channels for part in header.parts]:
        raise AssertionError(f"{path}: written with other channels")


def main(folder: Path, out: Path) -> None:
    # They would stand on the screen beside the one line.
    warnings.simplefilter("error")
    resource.setrlimit(resource.RLIMIT_AS, (taken() + MEMORY, -1))
    for path in sorted(folder.iterdir()):
        print(json.dumps({"begun": path.name}), flush=True)
        try:
            read_and_write(path, out / path.name)
            outcome = ""
        except InputError as error:
            outcome = str(error)
        except BaseException as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            outcome = f"!{type(error).__name__} at {Path(place.filename).name}:{place.lineno}: {error}"
        print(json.dumps({"file": path.name, "outcome": outcome}), flush=True)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
