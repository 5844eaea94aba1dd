"""Rendering of the suite into a folder; it can be interrupted at any time, and resumes."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mcdenoise.data import Sequence, open_sequence, read_exr, write_exr
from mcdenoise.data.camera_path import Array, Camera
from mcdenoise.data.files import atomic_path, make_folder, write_json
from mcdenoise.errors import InputError
from mcdenoise.scenes.assets import open_assets
from mcdenoise.scenes.cycles import Blender
from mcdenoise.scenes.parlour import parlour_cameras, parlour_moves, parlour_scene
from mcdenoise.scenes.render import Film, render_sequence
from mcdenoise.scenes.render.halves import ReferenceHalves
from mcdenoise.scenes.takes.draw import draw_take
from mcdenoise.suite.rows import SHOTS, Row, Shot

_SCRIPT = Path(__file__).with_name("blender_scenes.py")
# Names of the files of a frame and of its reference, by renderer.
_FILES = {
    "mitsuba": ("inputs/color{}.exr", "inputs/reference{}.exr"),
    "cycles": ("shot_{:04d}.exr", "reference_{:04d}.exr"),
}
# Each reference is the mean of this many renderings; the difference of its two halves estimates its noise.
_PARTS = 8
# All references get a quarter of their samples before any gets the rest, so that the suite can be used early.
_FRACTIONS = (0.25, 1.0)
_SEED, _REFERENCE_SEED = 77, 1_000_000
_LENS, _FOCUS = 0.03, 3.4
# Passes of the noisy images in Cycles, by their names in Blender's Python; references need none.
_PASSES = ["z", "position", "normal", "vector", "emit", "environment"]
_PASSES += [f"{kind}_{part}" for kind in ("diffuse", "glossy") for part in ("direct", "indirect", "color")]


def render_suite(
    shots: Iterable[Shot],
    data: Path,
    *,
    threads: int = 0,
    on_step: Callable[[str, float, int, int], None] = lambda shot, fraction, done, total: None,
) -> None:
    """Render the missing files of shots; a file gets its final name once it is complete.

    Args:
        shots: shots in the order of rendering. All references get a quarter of their samples first, and then the rest.
        data: the folder; a shot's files go to ``data/NAME``.
        threads: number of threads for Cycles; 0 uses all processors.
        on_step: called before each step with the name of the shot, the fraction of its reference samples that will be
            there, and the numbers of finished and of all steps.

    Raises:
        InputError: a renderer is missing or failed, or the folder cannot be written or holds other files.
    """
    shots = list(shots)
    steps = [(fraction, shot) for fraction in _FRACTIONS for shot in shots]
    with ExitStack() as stack:
        blender = None
        if any(shot.renderer == "cycles" and not _is_whole(shot, data) for shot in shots):
            # Before the hours that Mitsuba takes.
            blender = stack.enter_context(Blender())
        make_folder(data)
        for number, (fraction, shot) in enumerate(steps):
            on_step(shot.name, fraction, number, len(steps))
            if shot.renderer == "mitsuba":
                _render_mitsuba(shot, data, fraction)
            else:
                _render_cycles(shot, data, fraction, blender, threads)


def rows_there(rows: Iterable[Row], data: Path) -> list[Row]:
    """The rows whose frames and references exist; the references may be unfinished."""
    return [row for row in rows if _is_there(row.shot, data)]


def open_row(row: Row, data: Path) -> Sequence:
    """Open the frames of a row, under its name.

    Raises:
        InputError: the files are missing or damaged.
    """
    return replace(open_sequence(data / row.shot.name, row.frames), name=row.name)


def _is_there(shot: Shot, data: Path) -> bool:
    frame, reference = _FILES[shot.renderer]
    names = [*map(frame.format, range(shot.frames)), *map(reference.format, shot.references)]
    return all((data / shot.name / name).is_file() for name in names)


def _is_whole(shot: Shot, data: Path) -> bool:
    """Whether a shot of Cycles is completely rendered."""
    parts = _parts_of(shot, data)
    return _is_there(shot, data) and all(_part(parts, k, n).is_file() for k in range(_PARTS) for n in shot.references)


def _render_mitsuba(shot: Shot, data: Path, fraction: float) -> None:
    scene, cameras, moves = _mitsuba_scene(shot)
    folder = data / shot.name
    _take_references(shot, data)
    film = None
    if shot.filter != "centre":
        film = Film(filter=shot.filter, aperture=_LENS if shot.lens else 0.0, focus=_FOCUS if shot.lens else 1.0)
    render_sequence(
        scene,
        cameras,
        folder,
        size=shot.size,
        spp=shot.samples,
        reference_spp=max(round(shot.reference_samples * fraction), 2),
        reference_frames=shot.references,
        moves=moves,
        seed=_SEED,
        film=film,
    )


def _mitsuba_scene(shot: Shot) -> tuple[dict[str, Any], list[Camera], dict[str, Array]]:
    _, _, number = shot.scene.partition(" ")
    if number:
        missing: list[str] = []
        assets = open_assets(None, missing.append)
        if missing:
            raise InputError(f"{shot.name}: {missing[0]}; expected all models and images, which it is made of")
        take = draw_take(int(number), assets.part(unseen=True), frames=shot.frames, size=shot.size, stills=False)
        return take.scene, take.cameras, take.moves
    return parlour_scene(), parlour_cameras(shot.frames), parlour_moves(shot.frames)


def _take_references(shot: Shot, data: Path) -> None:
    """Copy the references of the first shot with the same picture, instead of rendering them again."""
    first = _first(shot)
    if first == shot:
        return
    for name in map(_FILES["mitsuba"][1].format, shot.references):
        source, target = data / first.name / name, data / shot.name / name
        if source.is_file():
            make_folder(target.parent)
            with atomic_path(target) as unfinished:
                shutil.copyfile(source, unfinished)


def _render_cycles(shot: Shot, data: Path, fraction: float, blender: Blender | None, threads: int) -> None:
    folder, parts = data / shot.name, _parts_of(shot, data)
    for each in (folder, parts):
        make_folder(each)
    frame, reference = _FILES["cycles"]
    noisy = {folder / frame.format(n): (n, shot.samples, _SEED + n) for n in range(shot.frames)}
    samples = max(shot.reference_samples // _PARTS, 1)
    clean = {
        _part(parts, part, n): (n, samples, _REFERENCE_SEED + 1000 * part + n)
        for part in range(max(round(_PARTS * fraction), 2))
        for n in shot.references
    }
    _render_missing(shot, noisy, blender, threads, _PASSES)
    _render_missing(shot, clean, blender, threads, [])
    noise = {}
    for n in shot.references:
        found = [path for k in range(_PARTS) if (path := _part(parts, k, n)).is_file()]
        noise[str(n)] = _write_reference(folder / reference.format(n), found, samples)
    write_json(folder / "camera.json", {"reference_noise": noise})


def _render_missing(
    shot: Shot, images: dict[Path, tuple[int, int, int]], blender: Blender | None, threads: int, passes: list[str]
) -> None:
    """Render the images that are missing, each of a frame, with a number of samples and a seed."""
    missing = {path: image for path, image in images.items() if not path.is_file()}
    if not missing or blender is None:
        return
    settings = {"size": shot.size, "threads": threads, "box": False, "passes": passes, "clamped": True}
    # In Cycles the width does not apply to a box filter, so the narrow filter is a Blackman-Harris filter too.
    settings |= {"filter_width": 0.01 if shot.filter == "centre" else 1.5, "shutter": 0.5 if shot.blur else 0.0}
    settings |= {} if shot.lens else {"aperture": 0.0}
    blender.ask("script", script=str(_SCRIPT), name=shot.scene, frames=shot.frames, settings=settings)
    for path, (frame, samples, seed) in missing.items():
        with atomic_path(path) as unfinished:
            blender.ask("render", frame=frame, samples=samples, seed=seed, out=str(unfinished.absolute()))


def _write_reference(path: Path, parts: list[Path], samples: int) -> float:
    """Write the mean of the parts, and return the estimate of its noise."""
    images = []
    for part in parts:
        pixels, channels, _ = read_exr(part)
        images.append(pixels[..., [name.rpartition(".")[2] in ("R", "G", "B") for name in channels]])
    halves = ReferenceHalves(np.zeros((images[0][..., 0].size, 3)))
    for image in images:
        halves.add(image.reshape(-1, 3).astype(np.float64), samples)
    write_exr(path, halves.mean().astype(np.float32).reshape(images[0].shape), ["R", "G", "B"])
    return halves.noise() or 0.0


def _parts_of(shot: Shot, data: Path) -> Path:
    """Folder with the parts of the references, which shots with the same picture share."""
    return data / ".parts" / _first(shot).name


def _first(shot: Shot) -> Shot:
    """The first shot with the same picture."""
    return next((other for other in SHOTS if other.picture == shot.picture), shot)


def _part(folder: Path, part: int, frame: int) -> Path:
    return folder / f"part{part}_{frame:04d}.exr"
