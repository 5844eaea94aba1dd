"""Close-ups of the suite: a mirror, lacquer, glass, rods, print and shadows."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from mcdenoise.data.exr import Image, read_exr
from mcdenoise.report.pictures import Codes, Crop, crop_errors, to_srgb
from mcdenoise.results import IMAGES, Results
from mcdenoise.suite.rows import Row

# Regions by scene: left, top, right and bottom as fractions of the frame.
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
_GAP, _TITLE, _LEAST_WIDTH = 4, 26, 240


def write_close_ups(folder: Path, results: Results, rows: Iterable[Row], shown: Sequence[str]) -> list[Path]:
    """Write ``close-ups/ROW/REGION.png``: input, methods and reference side by side, each with its PSNR and SMAPE.

    Small regions are enlarged by an integer factor without interpolation.

    Args:
        folder: folder of the finished benchmark, with its images.
        results: results of the benchmark.
        rows: rows whose scenes have named regions.
        shown: names of methods, in order; a method that is missing on a row is omitted there.

    Returns:
        Paths of the files.
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
            path.parent.mkdir(parents=True, exist_ok=True)
            _write(path, [_panel(title, image, reference, crop) for title, image in pictures])
            written.append(path)
    return written


def _pictures(folder: Path, results: Results, row: Row, shown: Sequence[str]) -> list[tuple[str, Image]]:
    """The last kept frame by each method; the reference is last."""
    folders = {method.name: method.folder for method in results.methods}
    scene = next((scene for scene in results.scenes if scene.name == row.name), None)
    if scene is None or not scene.pictures:
        return []
    named = [(name, folders[name]) for name in shown if name in folders] + [("reference", "reference")]
    found = []
    for name, place in named:
        path = folder / IMAGES / row.name / place / f"{scene.pictures[-1]}.exr"
        if path.is_file():
            found.append((name, np.ascontiguousarray(read_exr(path)[0][..., :3])))
    return found


def _panel(title: str, image: Image, reference: Image, crop: Crop) -> tuple[list[str], Codes]:
    own, truth = np.ascontiguousarray(crop.of(image)), np.ascontiguousarray(crop.of(reference))
    factor = max(1, -(-_LEAST_WIDTH // own.shape[1]))
    pixels = to_srgb(own).repeat(factor, 0).repeat(factor, 1)
    # Show only the values of settings, because their names would not fit.
    title = re.sub(r"\w+=", "", title)
    if image is reference:
        return [title, ""], pixels
    psnr, smape = crop_errors(own, truth)
    return [title, f"{psnr:.2f} dB, SMAPE {smape:.3f}"], pixels


def _write(path: Path, panels: list[tuple[list[str], Codes]]) -> None:
    import PIL.Image
    import PIL.ImageDraw

    height, width, _ = panels[0][1].shape
    sheet = PIL.Image.new("RGB", ((width + _GAP) * len(panels) - _GAP, height + _TITLE), "white")
    draw = PIL.ImageDraw.Draw(sheet)
    for index, (lines, pixels) in enumerate(panels):
        left = index * (width + _GAP)
        for line, text in enumerate(lines):
            # Longer text would overlap the next panel.
            draw.text((left + 2, 1 + 12 * line), text[: width // 6], fill="black")
        sheet.paste(PIL.Image.fromarray(pixels), (left, _TITLE))
    sheet.save(path)
