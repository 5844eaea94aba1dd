"""Close-ups of the suite: crops of mirrors, lacquer, glass, rods, print and shadows by each denoiser."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from mcdenoise.data.files import make_folder
from mcdenoise.data.png import Picture, caption, enlarge, write_png
from mcdenoise.report.gallery import REFERENCE, kept_pictures, read_picture
from mcdenoise.report.pictures import Crop, Image, crop_errors, to_srgb
from mcdenoise.results import Results
from mcdenoise.suite.rows import Row

# Crops of each scene: left, top, right and bottom as fractions of the frame.
PARTS: dict[str, dict[str, tuple[float, float, float, float]]] = {
    "parlour": {
        "mirror": (0.2, 0.05, 0.46, 0.4),
        "lacquer": (0.3, 0.6, 0.56, 0.85),
        "glass": (0.54, 0.42, 0.8, 0.72),
        "books": (0.68, 0.08, 0.94, 0.43),
        "print": (0.46, 0.05, 0.68, 0.35),
        "rods": (0.36, 0.0, 0.54, 0.5),
        "contact": (0.55, 0.62, 0.85, 0.84),
        "disocclusion": (0.0, 0.2, 0.3, 0.7),
    },
    "gallery": {
        "mirror": (0.72, 0.2, 0.98, 0.6),
        "lacquer": (0.1, 0.7, 0.5, 0.98),
        "glass": (0.3, 0.52, 0.6, 0.9),
        "print": (0.42, 0.15, 0.62, 0.5),
        "head": (0.05, 0.45, 0.3, 0.85),
    },
    "garden": {"fence": (0.45, 0.3, 0.85, 0.6), "glass": (0.3, 0.52, 0.55, 0.85), "grass": (0.05, 0.6, 0.4, 0.95)},
    "attic": {"boxes": (0.1, 0.4, 0.5, 0.8), "head": (0.5, 0.45, 0.85, 0.95)},
}
_GAP, _LEAST_WIDTH = 4, 320


def write_close_ups(folder: Path, results: Results, rows: Iterable[Row], shown: Sequence[str]) -> list[Path]:
    """Write ``close-ups/ROW/PART.png``: the input, the methods and the reference side by side, with PSNR and SMAPE.

    Small frames are enlarged by whole factors, so that pixels stay square and sharp.

    Args:
        folder: of a finished benchmark, with its images.
        results: of that benchmark.
        rows: rows to draw; rows of scenes without an entry in :data:`PARTS` are skipped.
        shown: names of methods, in the order of the panels; a method that is missing on a row is skipped there.

    Returns:
        The files written.
    """
    written = []
    for row in rows:
        pictures = _pictures(folder, results, row, shown)
        if len(pictures) < 2:
            continue
        reference = pictures[-1][1]
        height, width, _ = reference.shape
        for name, (left, top, right, bottom) in PARTS.get(row.shot.scene, {}).items():
            crop = Crop(
                round(left * width),
                round(top * height),
                round((right - left) * width),
                round((bottom - top) * height),
                name,
            )
            path = folder / "close-ups" / row.name / f"{name}.png"
            make_folder(path.parent)
            columns = [_column(title, image, reference, crop) for title, image in pictures]
            gap = np.full((len(columns[0]), _GAP, 3), 255, np.uint8)
            write_png(path, np.concatenate([part for column in columns for part in (column, gap)][:-1], 1))
            written.append(path)
    return written


def _pictures(folder: Path, results: Results, row: Row, shown: Sequence[str]) -> list[tuple[str, Image]]:
    """The last stored frame of each method, and last the reference."""
    scene = next((scene for scene in results.scenes if scene.name == row.name), None)
    if scene is None or not scene.pictures:
        return []
    files, last = kept_pictures(folder, results, scene), scene.pictures[-1]
    there = [name for name in (*shown, REFERENCE) if last in files.get(name, ())]
    return [(name, read_picture(files[name][last], scene)) for name in there]


def _column(title: str, image: Image, reference: Image, crop: Crop) -> Picture:
    """A crop, enlarged, below its title and its errors."""
    own, truth = np.ascontiguousarray(crop.of(image)), np.ascontiguousarray(crop.of(reference))
    picture = enlarge(to_srgb(own), max(1, -(-_LEAST_WIDTH // own.shape[1])))
    psnr, smape = crop_errors(own, truth)
    errors = "" if image is reference else f"{psnr:.2f} dB, SMAPE {smape:.3f}"
    # Drop the names of settings, which would not fit, and keep their values.
    return caption(caption(picture, errors), re.sub(r"\w+=", "", title))
