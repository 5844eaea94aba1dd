"""Make the files of this folder again: every command that rendered one, and nothing else.

    python make.py BLENDER_PYTHON MITSUBA_PYTHON [LUXCORE_PYTHON]

Each argument is a Python interpreter that can import ``bpy`` 4.5, ``mitsuba`` 3 or ``pyluxcore`` 2.11. The renderers
are not needed to run the tests: what they wrote lies here. ``README.md`` tells what is in it.
"""

import shlex
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
CYCLES = HERE.parents[2] / "examples" / "blender" / "render.py"

BLENDER = [
    "-o blender --size 64x36 --frames 4 --samples 1 --filter none --seed 1",
    "-o blender_reference --name reference --size 64x36 --frames 4 --samples 512 --filter none --passes --seed 1001",
    "-o blender_filtered --size 64x36 --frames 2 --start 7 --samples 4 --depth-of-field --codec DWAA --seed 2"
    " --view-layer 'Main Layer v1.2' --passes denoising data samples",
    "-o blender_denoised --size 64x36 --frames 1 --samples 4 --denoise --passes denoising --codec PIZ --seed 3",
    "-o blender_blur --size 64x36 --frames 1 --samples 4 --motion-blur --transparent --passes denoising data --seed 4",
    "-o blender_stereo --size 32x18 --frames 1 --samples 1 --filter none --stereo --passes denoising --seed 5",
]


def main():
    blender, mitsuba, *luxcore = sys.argv[1:]
    for command in BLENDER:
        run(blender, CYCLES, *shlex.split(command))
    run(mitsuba, HERE / "mitsuba.py", "-o", "mitsuba")
    for python in luxcore:
        run(python, HERE / "luxcore.py", "-o", "luxcore")


def run(*command):
    print(shlex.join(map(str, command)), flush=True)
    subprocess.run(command, cwd=HERE, check=True)


if __name__ == "__main__":
    main()
