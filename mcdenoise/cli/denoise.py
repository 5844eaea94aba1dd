"""`mcdenoise denoise`."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from collections.abc import Sequence as Sequential
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro
from torch import Tensor

from mcdenoise import ops
from mcdenoise.cli._options import Flag, Inputs, Json, Layers, Map, Out
from mcdenoise.cli._output import frames_of, print_times, say, stages, steps_of, warn, write_json
from mcdenoise.cli.inspect import print_sequence
from mcdenoise.data import Sequence
from mcdenoise.data.color_space import to_rec709
from mcdenoise.data.files import folder_beside, listed
from mcdenoise.data.images import FORMATS, Metadata, read_image_header
from mcdenoise.data.radiance import write_radiance
from mcdenoise.data.readers.names import find_files
from mcdenoise.errors import InputError
from mcdenoise.folder import denoise_sequence, prepare_folder
from mcdenoise.frame import MOTION
from mcdenoise.heap import keep_heap, return_heap
from mcdenoise.models._weights import pretrained_models
from mcdenoise.shot import ShotSettings

# Formats in which nothing is written: such a name is meant as that of a file, and would become a folder's.
_NOT_WRITTEN = {".jpg", ".jpeg", ".bmp", ".tga", ".gif", ".webp", ".jp2", ".dpx", ".psd", ".mp4", ".mov"}
# Loading numba takes 0.9 s, which is what the shipped networks gain from it on a still of three million pixels.
_SMALL_STILL = 1920 * 1080


@dataclass(frozen=True)
class ShotOptions(ShotSettings):
    """:class:`mcdenoise.shot.ShotSettings` as command-line options; overrides the parsing of some fields."""

    map: Map = ()
    color_without_albedo: Flag = False
    color_with_albedo: Flag = False
    input_linear: Flag = False
    layers: Layers = ()
    alpha: Flag = False


def denoise(
    inputs: Inputs,
    out: Out,
    shot: tyro.conf.OmitArgPrefixes[ShotOptions],
    albedo: Path | None = None,
    normal: Path | None = None,
    json: Json = None,
) -> None:
    """Denoise a frame to a file, or the frames of a shot to a folder.

    Args:
        inputs: a folder; files; or a pattern such as 'shot_####.exr', 'shot_%04d.exr' or 'shot_*.exr'. Each frame may
            be an EXR with layers, or one file per buffer; `mcdenoise inspect` shows which layer each buffer is read
            from.
        out: for one frame, a file such as clean.exr, .pfm, .hdr, .tif or .png: a copy of the input with denoised
            radiance, or the radiance alone in another format, without overscan. Or a folder to write to: files of the
            same names, with denoised radiance and all other layers unchanged (for the BMFR layout: denoisedN.exr), and
            denoise.json.
        shot: options for reading, denoising and writing the shot.
        albedo: file of the albedo of a single frame, if it is not a layer of the input.
        normal: likewise, of the normals.
        json: write the run times to this file too.
    """
    shot.check()
    if out.suffix.lower() in _NOT_WRITTEN and not os.path.isdir(out):
        formats = f"a folder, or a file of {', '.join(FORMATS)}"
        raise InputError(f"{out}: expected {formats}, found '{out.suffix}'; choose one of these")
    # Otherwise memory that is freed after opening the frames would count as memory in use.
    (keep_heap if shot.max_memory is None else return_heap)()
    if shot.threads is not None:
        torch.set_num_threads(shot.threads)
    opened = shot.open(_by_buffer(inputs, albedo, normal))
    if out.suffix.lower() not in FORMATS or os.path.isdir(out):
        _denoise(opened, out, shot, json)
        return
    if len(opened) > 1 or shot.preview:
        found = f"{len(opened)} frames" if len(opened) > 1 else "--preview"
        raise InputError(f"{out}: expected a single frame for a file, and no preview, found {found}; name a folder")
    read = [*opened.files(opened.numbers[0]), *find_files([*inputs, *filter(None, (albedo, normal))])]
    if os.path.realpath(out) in map(os.path.realpath, read):
        raise InputError(f"{out}: expected another file than the input, found the same; choose one to write to")
    with folder_beside(out) as folder:
        images: list[tuple[Tensor, Metadata]] = []

        def keep(name: str, image: Tensor, metadata: Metadata) -> None:
            images.append((image, metadata))
            if len(names := [each.name for each in listed(folder) if each.suffix.lower() in FORMATS]) > 1:
                raise InputError(f"{out}: expected one file to write, found {', '.join(names)}; name a folder for them")

        written = _denoise(opened, folder, shot, json, out, keep)
        if FORMATS.get(written.suffix.lower()) == FORMATS[out.suffix.lower()]:
            written.replace(out)
        else:
            # Not what the copy of the input holds, which may have been rounded to its type. No primaries are stated.
            ((image, metadata),) = images
            pixels = to_rec709(image[0].float(), metadata).permute(1, 2, 0).cpu().numpy()
            for part in read_image_header(written).parts:
                # Overscan is there for filters, and not shown; other formats have no windows.
                if part.window.size == pixels.shape[:2] and part.window.holds(part.display):
                    pixels = part.display.of(pixels, part.window)
                    break
            clamped = write_radiance(out, pixels)
            if clamped:
                warn(f"{out}: {clamped:.1%} of the pixels are brighter than white, and were clamped; .exr keeps them")
            if shot.alpha:
                warn(f"{out}: the radiance alone, without the alpha; the format of the input keeps it")


def _by_buffer(
    inputs: tuple[Path, ...], albedo: Path | None, normal: Path | None
) -> Sequential[Path] | dict[str, Path]:
    """The file of each buffer, where the options name them."""
    features = {name: path for name, path in (("albedo", albedo), ("normal", normal)) if path is not None}
    if not features:
        return inputs
    if len(inputs) != 1:
        raise InputError(f"--{next(iter(features))}: expected one file of noisy radiance, found {len(inputs)} inputs")
    return {"color": inputs[0], **features}


def _denoise(
    opened: Sequence,
    out: Path,
    shot: ShotSettings,
    json: Path | None,
    shown: Path | None = None,
    on_written: Callable[[str, Tensor, Metadata], None] | None = None,
) -> Path:
    """Denoise a shot to a folder, and print the report; returns the last file, which is called ``shown`` there."""
    preview = shot.preview_in(out, video=len(opened) > 1) if shot.preview else None
    if shot.is_budgeted:
        with steps_of("measure models") as on_step:
            resolved, choice = shot.chosen(opened, on_step)
    else:
        resolved, choice = shot.chosen(opened)
    if choice:
        say(f"picked {choice}")
    denoiser, spelling = resolved.denoiser(), resolved.spelling
    # Before anything is printed about a shot that cannot be written.
    prepare_folder(opened, out)
    print_sequence(opened)
    warn(spelling.doubt)
    began = time.perf_counter()
    with frames_of("denoise", len(opened)) as on_frame, _backend(opened, resolved):
        report = denoise_sequence(
            opened,
            out,
            denoiser,
            str(spelling.weights or spelling.name),
            full_float=shot.full_float,
            output_layer=shot.output_layer,
            picked=choice,
            on_frame=on_frame,
            on_written=preview.add if preview else on_written,
        )
    taken = time.perf_counter() - began
    if preview:
        with frames_of("preview", len(opened)) as on_frame:
            preview.close(on_frame=on_frame)
    for row in report.plan:
        say(f"  {row['stage']}: {_kept(row)} ({row['reason']}){'' if row['exact'] else ', up to the tolerance'}")
    if report.replaced_pixels:
        print(f"replaced {report.replaced_pixels} NaN, infinite, negative or absurdly bright pixels of the noisy color")
    print(f"  tiles: {report.tiles}")
    print(f"  precision: {denoiser.precision}, {report.precision}")
    print_times(report.milliseconds)
    print(f"{'beside that' if denoiser.has_room_ahead else 'of the waiting'}: {stages(report.beside)}")
    features = {"albedo", "normal", "depth"} & opened.buffers
    # Behind a gap a frame has no motion, as a warning says.
    missing = {name for done in report.frames.values() for name in done.missing} - opened.buffers
    missing -= MOTION if len(opened) == 1 else set()
    if missing and features:
        those = "it" if len(missing) == 1 else "them"
        say(f"read without {', '.join(sorted(missing))}: {report.model} is better with {those}")
    if not features:
        # Said last but for warnings, where it is seen.
        say("NO FEATURES: turn on the passes albedo, normal and depth in the renderer; with them it is far better")
    warn(*report.warnings)
    files = list(report.files.values())
    names = files[0].name if len(files) == 1 else f"{files[0].name} to {files[-1].name}"
    write_json(json, {"model": report.model, "milliseconds": report.milliseconds, "beside": report.beside})
    if preview:
        say(f"preview: {preview.written[-1]}")
    say(f"{len(files)} {'frame' if len(files) == 1 else 'frames'} in {taken:.1f} s: {shown or out / names}")
    return files[-1]


def _backend(opened: Sequence, shot: ShotSettings) -> AbstractContextManager[None]:
    """Use the reference implementations for a small still, where compiled ones take longer to load than they save."""
    height, width = opened.size
    small = len(opened) == 1 and height * width <= _SMALL_STILL and shot.max_memory is None
    return ops.use("torch") if small and shot.spelling.name in pretrained_models() else nullcontext()


def _kept(row: dict[str, Any]) -> str:
    fraction = row["skipped"]
    return "kept" if fraction == 0 else "skipped" if fraction == 1 else f"{fraction:.1%} skipped"
