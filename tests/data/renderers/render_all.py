"""Make the files of this folder again: every command that rendered one, and nothing else.

    python render_all.py --blender PYTHON --blender5 PYTHON --mitsuba PYTHON --luxcore PYTHON

Each option names a Python interpreter that can import ``bpy`` 4.5, ``bpy`` 5.0, ``mitsuba`` 3 or ``pyluxcore`` 2.11;
what has none is not made. The tests need no renderer: what they wrote lies here. ``README.md`` tells what is in it.
"""

import argparse
import shlex
import subprocess
from pathlib import Path

HERE = Path(__file__).resolve().parent
CYCLES = "../../../examples/blender/render.py"

COMMANDS = {
    "blender": [
        f"{CYCLES} -o blender --size 64x36 --frames 4 --samples 1 --filter none --seed 1",
        f"{CYCLES} -o blender_reference --name reference --size 64x36 --frames 4 --samples 512 --filter none --passes"
        " --seed 1001",
        f"{CYCLES} -o blender_filtered --size 64x36 --frames 2 --start 7 --samples 4 --depth-of-field --codec DWAA"
        " --view-layer 'Main Layer v1.2' --passes denoising data samples --seed 2",
        f"{CYCLES} -o blender_denoised --size 64x36 --frames 1 --samples 4 --denoise --passes denoising --codec PIZ"
        " --seed 3",
        f"{CYCLES} -o blender_blur --size 64x36 --frames 1 --samples 4 --motion-blur --transparent"
        " --passes denoising data --seed 4",
        f"{CYCLES} -o blender_stereo --size 32x18 --frames 1 --samples 1 --filter none --stereo --passes denoising"
        " --seed 5",
        f"{CYCLES} -o blender_layers --size 32x18 --frames 1 --samples 4 --second-layer 'No Wall' --composite"
        " --passes denoising --seed 8",
    ],
    "blender5": [
        f"{CYCLES} -o blender5 --size 64x36 --frames 1 --samples 4 --denoise --seed 6",
        f"{CYCLES} -o blender5_stereo --size 32x18 --frames 1 --samples 1 --filter none --stereo --passes denoising"
        " --seed 7",
    ],
    "mitsuba": ["mitsuba_frames.py -o mitsuba"],
    "luxcore": ["luxcore_frames.py -o luxcore"],
}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for renderer in COMMANDS:
        parser.add_argument(f"--{renderer}", metavar="PYTHON")
    for renderer, python in vars(parser.parse_args()).items():
        for command in COMMANDS[renderer] if python else ():
            print(python, command, flush=True)
            subprocess.run([python, *shlex.split(command)], cwd=HERE, check=True)


if __name__ == "__main__":
    main()
