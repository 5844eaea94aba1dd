"""The folder of a rendered sequence: its cameras, what it was rendered with, and which of its files are there."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from mcdenoise.data.camera_matrices import CameraMatrices, write_camera_matrices
from mcdenoise.data.exr import read_exr, read_exr_header
from mcdenoise.data.files import write_text
from mcdenoise.data.readers.bmfr import has_buffer, realisation_folder, write_buffer
from mcdenoise.errors import InputError
from mcdenoise.reading import read_text

_ADVICE = "choose another output folder, or delete this one"
_CONVENTIONS: dict[str, Any] = {
    "color_includes_albedo": True,
    "reference_includes_albedo": True,
    "noisy_seed": "numpy.random.SeedSequence((seed, frame, 0, pass)).generate_state(1)",
    "realisation_seed": "numpy.random.SeedSequence((seed, frame, 1 + realisation, pass)).generate_state(1), for the "
    "colors in realisation{1,2,...}",
    "reference_seed": "numpy.random.SeedSequence((seed, frame, 1, pass)).generate_state(1)",
    "reference_noise_meaning": "estimated mean(|R - T| / (R + T + 0.01)) of the reference R against the truth T, from "
    "the difference of two halves of its paths",
    "pixel_sampling": "colour, features and reference all at the pixel centre (no jitter, box filter)",
    "colour_space": "linear RGB, sRGB primaries",
    "shading_normal": "world space, turned to the side the camera sees",
    "depth": "linear view depth (along the viewing axis), scene units",
    "albedo": "Mitsuba eval_diffuse_reflectance where the BSDF has a diffuse lobe; directional albedo for rough "
    "conductors; 0 for mirrors, glass, background",
    "alpha_masks": "features look through surfaces whose opacity is below 0.5",
    "samples": "only where they were kept: samplesN.exr has the single paths whose mean is the noisy colour, as layers "
    "sample0, sample1, ...; on a film with the features of each",
    "previous_position": "only with moves: where the surface point seen now was in the previous frame, world space",
    "conventions": {
        "camera_matrices": "clip = [x,y,z,1] @ M (row vectors; M is the transpose of world_to_clip); "
        "u=(clip.x/clip.w+1)/2 left to right, v=(clip.y/clip.w+1)/2 top to bottom; clip.z/clip.w in [0,1]",
        "pixel": "index = (u*width - ox, v*height - (1-oy)), pixel_offsets = (ox, oy)",
        "reprojection": "frame i uses camera_matrices[i-1]",
        "camera_to_world": "column vectors; camera frame +x left, +y up, +z forward (Mitsuba)",
        "moves": "for each object that moves, one world-space matrix per frame (column vectors), applied after the "
        "transform that the scene gives it",
    },
}
# What differs on a film; see :mod:`mcdenoise.scenes.render.film`.
_ON_A_FILM: dict[str, Any] = {
    "pixel_sampling": "jittered samples through the pixel filter and the lens of 'film'; features are means over the "
    "samples of their color, and each folder realisation{1,2,...} has its own",
    "albedo": "Mitsuba's aov, clamped to [0, 1]",
    "alpha_masks": "features are of the first surface, be it see-through",
    "shading_normal": "world space, turned to the side the camera sees, averaged and not normalised",
}
# Frames rendered with different values of these do not belong into one folder.
_IDENTITY = (
    "scene",
    "scene_sha256",
    "renderer",
    "width",
    "height",
    "near",
    "far",
    "noisy_spp",
    "film",
    "samples_kept",
    "max_depth",
    "rr_depth",
    "seed",
)
# One entry per frame, by which the cameras of two runs are compared, and which the longer run contributes.
_POSES = ("camera_to_world", "camera_matrices")
_PER_FRAME = ("frames", *_POSES, "world_to_clip", "pixel_offsets", "moves")


@dataclass(frozen=True)
class ReferenceState:
    """How far a reference that is on disk has come.

    Args:
        spp: paths per pixel.
        passes: how many passes they took, which is the number of the next one's seed.
        noise: its estimated SMAPE against the truth; ``None`` where unknown.
    """

    spp: int
    passes: int
    noise: float | None


class SequenceFolder:
    """``out/inputs`` with its camera files.

    Args:
        out: the folder of the sequence; it is made if it does not exist.
        settings: what goes into ``camera.json`` beside the conventions. ``reference_spp`` and ``reference_noise`` are
            added here: they tell of the references that are on disk.

    Raises:
        InputError: the folder cannot be made, or what is there was rendered with other settings.
    """

    def __init__(self, out: Path, settings: dict[str, Any]) -> None:
        self.path = out / "inputs"
        try:
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(
                f"{self.path}: cannot be created ({error.strerror}); choose another output folder"
            ) from error
        self._description = self.path / "camera.json"
        before = self._read(settings) if self._description.is_file() else {}
        self._settings = {**_merged(before, settings), **_CONVENTIONS, **(_ON_A_FILM if settings["film"] else {})}
        self.references = self._find_references(before.get("reference_spp", {}))
        self._write()
        matrices = CameraMatrices(
            np.array(self._settings["camera_matrices"]),
            np.array(self._settings["pixel_offsets"]),
            self._settings["position_limit_squared"],
            self._settings["normal_limit_squared"],
        )
        write_camera_matrices(self.path / "camera_matrices.h", matrices, _CONVENTIONS["conventions"]["camera_matrices"])

    def note_reference(self, number: int, state: ReferenceState) -> None:
        """Say in ``camera.json`` how far a reference has come.

        Raises:
            InputError: the file cannot be written.
        """
        self.references[number] = state
        self._write()

    def _read(self, settings: dict[str, Any]) -> dict[str, Any]:
        described = self._description
        try:
            before: dict[str, Any] = json.loads(read_text(described))
            before["reference_spp"] = {int(number): int(spp) for number, spp in before["reference_spp"].items()}
            poses = list(zip(*(before[key] for key in _POSES), strict=True))
            before["frames"] = int(before["frames"])
            moves = {identity: list(matrices) for identity, matrices in before.get("moves", {}).items()}
        except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise InputError(f"{described}: cannot be read, so the run cannot be resumed; {_ADVICE}") from error
        for key in _IDENTITY:
            if before.get(key) != settings[key]:
                raise InputError(f"{described}: rendered with {key} {before.get(key)}, now {settings[key]}; {_ADVICE}")
        for number, pose in enumerate(zip(*(settings[key] for key in _POSES), strict=True)):
            if number < len(poses) and pose != poses[number]:
                raise InputError(f"{described}: frame {number} was rendered from another camera; {_ADVICE}")
        now = settings.get("moves", {})
        if moves.keys() != now.keys():
            names = (", ".join(sorted(ids)) or "nothing" for ids in (moves, now))
            raise InputError(f"{described}: rendered with {next(names)} moving, now {next(names)}; {_ADVICE}")
        for identity, matrices in moves.items():
            for number, pair in enumerate(zip(matrices, now[identity], strict=False)):
                if pair[0] != pair[1]:
                    raise InputError(
                        f"{described}: object '{identity}' was elsewhere when frame {number} was rendered; {_ADVICE}"
                    )
        return before

    def _find_references(self, known_spp: dict[int, int]) -> dict[int, ReferenceState]:
        """From the headers, which are written together with the pixels."""
        found: dict[int, ReferenceState] = {}
        for number in range(self._settings["frames"]):
            path = self.path / f"reference{number}.exr"
            # One that is damaged is rendered again, as any other file of a frame.
            if not has_buffer(self.path, number, "reference", (self._settings["width"], self._settings["height"])):
                continue
            header = read_exr_header(path).metadata
            spp, passes, noise = (header.get(f"reference_{name}") for name in ("spp", "passes", "noise"))
            if spp is None and number in known_spp:
                # Of an older version, without a header of its own: there were no more passes than paths.
                spp = passes = known_spp[number]
            if not isinstance(spp, int) or not isinstance(passes, int):
                raise InputError(f"{path}: expected a header that says how many paths it has, found none; remove it")
            found[number] = ReferenceState(spp, passes, noise if isinstance(noise, float) else None)
        return found

    def _write(self) -> None:
        states = sorted(self.references.items())
        spp = {str(number): state.spp for number, state in states}
        noise = {str(number): state.noise for number, state in states}
        content = {**self._settings, "reference_spp": spp, "reference_noise": noise}
        write_text(self._description, json.dumps(content, indent=1) + "\n")


def write_reference(folder: Path, number: int, image: Tensor, state: ReferenceState) -> None:
    """Write ``referenceN.exr``; how far it has come stands in its header, so that the two always belong together.

    Args:
        folder: ``inputs`` of a sequence.
        number: frame number.
        image: ``(1, 3, H, W)``.
        state: how far it has come.

    Raises:
        InputError: the file cannot be written.
    """
    noise = {} if state.noise is None else {"reference_noise": state.noise}
    header = {"reference_spp": state.spp, "reference_passes": state.passes, **noise}
    write_buffer(folder, number, "reference", image, metadata=header)


def read_reference(folder: Path, number: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """``(H*W, 3)`` pixels of ``referenceN.exr``.

    Raises:
        InputError: the file is damaged.
    """
    return read_exr(folder / f"reference{number}.exr")[0].astype(np.float64).reshape(-1, 3)


def write_realisation(folder: Path, number: int, realisation: int, buffers: Mapping[str, Tensor]) -> None:
    """Write what one realisation of the noise has of its own: its noisy color, and perhaps features.

    Args:
        folder: ``inputs`` of a sequence.
        number: frame number.
        realisation: of the noise.
        buffers: ``(1, C, H, W)`` by name, in the order of writing.

    Raises:
        InputError: a file cannot be written.
    """
    place = realisation_folder(folder, realisation)
    try:
        place.mkdir(exist_ok=True)
    except OSError as error:
        raise InputError(f"{place}: cannot be created ({error.strerror}); choose another output folder") from error
    for name, buffer in buffers.items():
        write_buffer(place, number, name, buffer)


def _merged(before: dict[str, Any], settings: dict[str, Any]) -> dict[str, Any]:
    """Rendering fewer frames or realisations than before must not make the folder forget the others."""
    longer = {key: before[key] for key in _PER_FRAME if key in before} if before else {}
    kept = longer if before and before["frames"] > settings["frames"] else {}
    return {**settings, **kept, "realisations": max(settings["realisations"], before.get("realisations", 1))}
