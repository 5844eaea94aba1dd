"""The pictures of one scene for the comparer, the close-ups and the temporal profiles."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from mcdenoise.data.color_space import to_rec709
from mcdenoise.data.exr import read_exr
from mcdenoise.errors import InputError
from mcdenoise.report.pictures import (
    Codes,
    Crop,
    Image,
    choose_crops,
    choose_row,
    crop_errors,
    data_uri,
    decode,
    encode,
    smaller,
    to_srgb,
)
from mcdenoise.results import IMAGES, Results, Scene

REFERENCE = "reference"
_THUMBNAIL_WIDTH = 480
_GRAY = 0.18


@dataclass(frozen=True)
class CloseUp:
    """A crop of one method's image.

    Args:
        crop: which part.
        picture: image file as a data URI.
        psnr: of the crop, as displayed, in decibels; ``None`` for the reference itself.
        smape: of the crop, scene-linear.
    """

    crop: Crop
    picture: str
    psnr: float | None = None
    smape: float | None = None


@dataclass(frozen=True)
class Gallery:
    """The pictures of one scene that were kept.

    Args:
        scene: whose.
        factor: by how much the pictures of the comparer are smaller than the frames.
        codes: by method (or ``"reference"``) and frame, see :func:`mcdenoise.report.pictures.encode`.
        frame: that of the close-ups; ``None`` if there is no reference to compare with.
        thumbnail: that frame's reference, as a data URI.
        close_ups: by method, the same crops for each.
        stripe: the row of pixels that temporal profiles show; ``None`` if fewer than two frames were kept.
        profiles: by method, as data URIs: one row of pixels for each frame.
        exposure: stops by which the reference is shown brighter, so that its typical pixel is a middle gray.
    """

    scene: Scene
    factor: int
    codes: dict[str, dict[int, Codes]]
    frame: int | None
    thumbnail: str
    close_ups: dict[str, list[CloseUp]]
    stripe: Crop | None
    profiles: dict[str, str]
    exposure: float = 0.0


def read_gallery(folder: Path, results: Results, scene: Scene, *, factor: int = 1) -> Gallery:
    """Read the pictures of a scene.

    Args:
        folder: of the benchmark.
        results: of it.
        scene: one of its scenes.
        factor: a power of two; the comparer's pictures are made smaller by it.

    Raises:
        InputError: a picture is damaged, or of another size than the scene.
    """
    files = kept_pictures(folder, results, scene)
    codes = {
        name: {number: encode(smaller(read_picture(path, scene), factor)) for number, path in own.items()}
        for name, own in files.items()
    }
    denoisers = {method.name for method in results.methods if method.kind != "baseline"}
    frame = max(files.get(REFERENCE, {}), default=None)
    close_ups, thumbnail = ({}, "") if frame is None else _close_ups(files, scene, frame, denoisers)
    stripe = _stripe(codes, factor, denoisers)
    whole = {name: own for name, own in codes.items() if list(own) == scene.pictures}
    return Gallery(
        scene,
        factor,
        codes,
        frame,
        thumbnail,
        close_ups,
        stripe,
        {} if stripe is None else {name: _profile(own, stripe, factor) for name, own in whole.items()},
        _exposure(codes.get(REFERENCE) or next(iter(codes.values()), {})),
    )


def kept_pictures(folder: Path, results: Results, scene: Scene) -> dict[str, dict[int, Path]]:
    """The files of the pictures that a benchmark in a folder kept, by method and frame, the reference last."""
    failed = {cell.method for cell in results.cells if cell.scene == scene.name and cell.failure}
    sources = {method.name: method.folder for method in results.methods if method.name not in failed}
    found = {
        name: {number: folder / IMAGES / scene.name / place / f"{number}.exr" for number in scene.pictures}
        for name, place in (sources | {REFERENCE: REFERENCE}).items()
    }
    existing = {name: {number: path for number, path in own.items() if path.exists()} for name, own in found.items()}
    return {name: own for name, own in existing.items() if own}


def read_picture(path: Path, scene: Scene) -> Image:
    """A kept picture, ``(H, W, 3)``, scene-linear, with the primaries of Rec. 709.

    Raises:
        InputError: it is damaged, or of another size than the scene.
    """
    pixels, channels, metadata = read_exr(path)
    if pixels.shape[:2] != (scene.height, scene.width) or len(channels) < 3:
        raise InputError(
            f"{path}: expected an RGB picture of {scene.width}x{scene.height}, found {len(channels)} channels of "
            f"{pixels.shape[1]}x{pixels.shape[0]}; run the benchmark again"
        )
    image = torch.from_numpy(np.ascontiguousarray(pixels[..., :3])).permute(2, 0, 1)
    return np.ascontiguousarray(to_rec709(image, metadata).permute(1, 2, 0).numpy())


def _close_ups(
    files: dict[str, dict[int, Path]], scene: Scene, frame: int, denoisers: set[str]
) -> tuple[dict[str, list[CloseUp]], str]:
    images = {name: read_picture(own[frame], scene) for name, own in files.items() if frame in own}
    reference = images[REFERENCE]
    crops = choose_crops([image for name, image in images.items() if name in denoisers], reference)
    close_ups = {}
    for name, image in images.items():
        shown = to_srgb(image)
        close_ups[name] = [
            CloseUp(
                crop,
                data_uri(crop.of(shown)),
                *(() if name == REFERENCE else crop_errors(crop.of(image), crop.of(reference))),
            )
            for crop in crops
        ]
    step = 1
    while scene.width // step > _THUMBNAIL_WIDTH:
        step *= 2
    return close_ups, data_uri(to_srgb(smaller(reference, step)), "jpeg", quality=88)


def _exposure(pictures: dict[int, Codes]) -> float:
    """Stops, in quarters, from the geometric mean of all lit pixels to a middle gray; 0 where all is black."""
    lit = [decode(codes[codes > 0]) for codes in pictures.values()]
    means = [np.log2(values).mean() for values in lit if values.size]
    return min(max(round(4 * float(np.log2(_GRAY) - np.mean(means))) / 4, -8.0), 8.0) if means else 0.0


def _stripe(codes: dict[str, dict[int, Codes]], factor: int, denoisers: set[str]) -> Crop | None:
    clips = [list(own.values()) for name, own in codes.items() if name in denoisers and len(own) > 1]
    if not clips:
        return None
    row, left, width = choose_row(clips)
    return Crop(left * factor, row * factor, width * factor, 1, "methods change most from frame to frame")


def _profile(pictures: dict[int, Codes], stripe: Crop, factor: int) -> str:
    top, left, width = (length // factor for length in (stripe.top, stripe.left, stripe.width))
    rows = np.stack([codes[top, left : left + width] for codes in pictures.values()])
    return data_uri(to_srgb(decode(rows).astype(np.float32)))
