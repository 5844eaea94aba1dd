"""Reads each file of a folder in a process of its own, with little memory: one line of JSON for each on stdout."""

import json
import resource
import sys
from pathlib import Path

from mcdenoise.data.camera_matrices import read_camera_matrices
from mcdenoise.data.exr import read_exr, read_exr_header
from mcdenoise.errors import InputError

# Beyond what the libraries have taken already.
MEMORY = 512 * 2**20


def taken() -> int:
    """Bytes of address space that this process has."""
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def main(folder: Path) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (taken() + MEMORY, -1))
    for path in sorted(folder.iterdir()):
        print(json.dumps({"begun": path.name}), flush=True)
        try:
            if path.suffix == ".h":
                read_camera_matrices(path)
            else:
                read_exr_header(path)
                read_exr(path)
            outcome = ""
        except InputError as error:
            outcome = str(error)
        except BaseException as error:
            outcome = f"!{type(error).__name__}: {error}"
        print(json.dumps({"file": path.name, "outcome": outcome}), flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
