"""Removal of remaining noise from the references of training data."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from mcdenoise.data import open_sequence, write_exr
from mcdenoise.data.files import write_text
from mcdenoise.data.readers.bmfr import read_clean_features
from mcdenoise.frame import Frame
from mcdenoise.models import create_model
from mcdenoise.reading import read_text


def clean_references(source: Path, out: Path) -> Path:
    """Copy a sequence in the BMFR layout, with its references denoised by Open Image Denoise.

    A network trained with a relative error learns the median of noisy references, which is darker than their mean, and
    much noise remains in a few samples per pixel where light is hard to find. Open Image Denoise at high quality with
    clean albedo and normal removes nearly all of it: at 50 samples per pixel this is far easier than at one. An
    anti-aliased reference was rendered with its own features. Use the result for training only; errors are measured
    against references as rendered.

    Args:
        source: folder of the sequence. If its features have noise, this noise will be in the references.
        out: folder for the copy. A finished copy is kept.

    Returns:
        Folder of the copy, ``out/NAME``.

    Raises:
        InputError: the optional package pyoidn is missing, a file is damaged, or the copy cannot be written.
    """
    oidn = create_model("oidn", quality="high", auxiliary="clean")
    sequence = open_sequence(source)
    inputs = source / "inputs" if (source / "inputs").is_dir() else source
    copied = out / sequence.name / "inputs"
    # Written last, as a sign that the copy is complete.
    description = copied / "camera.json"
    if description.exists():
        return copied.parent
    ignored = shutil.ignore_patterns("reference*.exr", description.name, ".*")
    shutil.copytree(inputs, copied, ignore=ignored, dirs_exist_ok=True)
    for number in sequence.reference_numbers:
        frame, _ = sequence.frame(number).validate()
        if frame.reference is None:
            continue
        features = read_clean_features(inputs, number) or (frame.albedo, frame.normal)
        image = oidn(Frame(color=frame.reference, albedo=features[0], normal=features[1]))[0].image
        # The filter may return negative radiance.
        pixels = image[0].clamp(0, 65504).permute(1, 2, 0).numpy()
        write_exr(copied / f"reference{number}.exr", pixels, ["R", "G", "B"])
    rendered = inputs / description.name
    about = json.loads(read_text(rendered)) if rendered.exists() else {}
    # Remove statements about the references that no longer hold, so that no renderer refines them as means of paths.
    about = {key: value for key, value in about.items() if key not in ("reference_spp", "reference_noise")}
    write_text(description, json.dumps({**about, "reference_filter": "Open Image Denoise, high, clean aux"}) + "\n")
    return copied.parent
