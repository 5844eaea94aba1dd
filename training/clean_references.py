"""Copy sequences with the remaining noise of their references removed: what the shipped weights were trained on.

    python training/clean_references.py SEQUENCE... -o OUT

A network that is trained with an error of relative differences learns the median of noisy references, which is darker
than their mean, and few samples a pixel leave much noise where light is hard to find. Open Image Denoise, told that
albedo and normal are clean, removes nearly all of it: at 50 samples a pixel that is a far easier problem than at one.
For training only: what is measured is measured against references as they were rendered.
"""

import argparse
import json
import shutil
import sys
from pathlib import Path

from mcdenoise.data import open_sequence, write_exr
from mcdenoise.data.files import write_text
from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.models import Model, create_model


def clean(source: Path, out: Path, oidn: Model) -> Path:
    """Copy a sequence to ``out``, its references denoised at high quality; returns the folder of the copy."""
    sequence = open_sequence(source)
    inputs = source / "inputs" if (source / "inputs").is_dir() else source
    copied = out / sequence.name / "inputs"
    shutil.copytree(inputs, copied, ignore=shutil.ignore_patterns("reference*.exr", ".*"), dirs_exist_ok=True)
    for number in sequence.reference_numbers:
        frame, _ = sequence.frame(number).validate()
        if frame.reference is None:
            continue
        image = oidn(Frame(color=frame.reference, albedo=frame.albedo, normal=frame.normal))[0].image
        # The filter may undershoot; radiance may not.
        pixels = image[0].clamp(0, 65504).permute(1, 2, 0).numpy()
        write_exr(copied / f"reference{number}.exr", pixels, ["R", "G", "B"], half=True)
    description = copied / "camera.json"
    about = json.loads(description.read_text()) if description.exists() else {}
    # What was said of the references no longer holds, and without it no renderer takes them for means of so many paths.
    about = {key: value for key, value in about.items() if key not in ("reference_spp", "reference_noise")}
    write_text(description, json.dumps({**about, "reference_filter": "Open Image Denoise, high, clean aux"}) + "\n")
    return copied.parent


def main() -> None:
    """Parse and copy."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("sequences", type=Path, nargs="+", metavar="SEQUENCE", help="folder with references")
    parser.add_argument("-o", "--out", type=Path, required=True, help="folder for the copies")
    options = parser.parse_args()
    oidn = create_model("oidn", quality="high", auxiliary="clean", source="raw")
    for source in options.sequences:
        print(clean(source, options.out, oidn))


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
