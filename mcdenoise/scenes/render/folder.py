"""The folder of a rendered sequence: cameras, settings, and the state of its files."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from mcdenoise.data.camera_matrices import CameraMatrices, write_camera_matrices
from mcdenoise.data.camera_path import Array, Camera, view_projection
from mcdenoise.data.exr import write_exr
from mcdenoise.data.files import make_folder, write_json
from mcdenoise.data.images import read_image_header
from mcdenoise.data.readers.bmfr import is_whole
from mcdenoise.errors import InputError
from mcdenoise.reading import read_text
from mcdenoise.scenes.render.halves import ReferenceState
from mcdenoise.scenes.render.loading import Scene, scene_digest, scene_name

_ADVICE = "choose another output folder, or delete this one"
_ALWAYS: dict[str, Any] = {
    "color_includes_albedo": True,
    "reference_includes_albedo": True,
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
BY_MITSUBA: dict[str, Any] = {
    "seeds": "numpy.random.SeedSequence((seed, frame, stream, pass, first row)).generate_state(1); stream 0 for the "
    "first noisy color, 1 for the reference, 1 + noise seed for the others; rows are traced in strips",
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
}
# Differences on a film; see :mod:`mcdenoise.scenes.render.film`.
ON_A_FILM: dict[str, Any] = {
    "pixel_sampling": "jittered samples through the pixel filter and the lens of 'film'; features are means over the "
    "samples of their color, and each folder noise_seed{1,2,...} has its own",
    "shading_normal": "world space, turned to the side the camera sees, averaged and not normalised",
}
# Frames rendered with different values of these settings must not be in one folder.
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
# Entries with one value per frame: two runs are compared by the common frames, and the longer run adds the others.
_PER_FRAME = ("frames", "camera_to_world", "camera_matrices", "world_to_clip", "pixel_offsets", "moves")


class SequenceFolder:
    """The folder ``out/inputs`` with its camera files, ``camera.json`` among them.

    Args:
        out: folder of the sequence; created if it does not exist.
        scene: what is rendered.
        cameras: one a frame.
        size: width and height in pixels.
        planes: distances of the near and the far plane.
        moves: see :class:`mcdenoise.data.camera_path.CameraPath`; may be of more frames.
        conventions: how the renderer makes what the files hold.
        settings: of the renderer. ``reference_spp`` and ``reference_noise`` are added here, for the references on disk.

    Raises:
        InputError: the folder cannot be created, or was rendered with other settings.
    """

    def __init__(
        self,
        out: Path,
        scene: Scene,
        cameras: Sequence[Camera],
        size: tuple[int, int],
        planes: tuple[float, float],
        moves: Mapping[str, Array],
        conventions: Mapping[str, Any],
        **settings: Any,
    ) -> None:
        self.path = out / "inputs"
        make_folder(self.path)
        self._description = self.path / "camera.json"
        matrices = np.stack([view_projection(camera, *size, *planes) for camera in cameras])
        moved = {name: path[: len(cameras)].tolist() for name, path in moves.items()}
        described = {
            "scene": scene_name(scene),
            "scene_sha256": scene_digest(scene),
            "frames": len(cameras),
            "width": size[0],
            "height": size[1],
            "fov_x_degrees": cameras[0].fov_x,
            "near": planes[0],
            "far": planes[1],
            "normal_limit_squared": 1.0,
            "pixel_offsets": [[0.5, 0.5]] * len(cameras),
            "camera_matrices": matrices.tolist(),
            "world_to_clip": matrices.transpose(0, 2, 1).tolist(),
            "camera_to_world": [camera.to_world.tolist() for camera in cameras],
            **({"moves": moved} if moved else {}),
            **settings,
        }
        before = self._read(described) if self._description.is_file() else {}
        self._settings = {**_merged(before, described), **_ALWAYS, **conventions}
        states = {n: reference_state(reference_file(self.path, n), size) for n in range(self._settings["frames"])}
        self.references = {number: state for number, state in states.items() if state is not None}
        self._write()
        header = CameraMatrices(*(np.array(self._settings[name]) for name in ("camera_matrices", "pixel_offsets")))
        limits = {name: self._settings[name] for name in ("position_limit_squared", "normal_limit_squared")}
        path = self.path / "camera_matrices.h"
        write_camera_matrices(path, header, _ALWAYS["conventions"]["camera_matrices"], **limits)

    def note_reference(self, number: int, state: ReferenceState | None) -> None:
        """Record the progress of a reference, if there is any, in ``camera.json``.

        Raises:
            InputError: the file cannot be written.
        """
        if state is not None:
            self.references[number] = state
            self._write()

    def _read(self, settings: dict[str, Any]) -> dict[str, Any]:
        described = self._description
        try:
            before: dict[str, Any] = json.loads(read_text(described))
            # What is where in each frame; the camera has no name.
            found, wanted = ({"": each["camera_matrices"], **each.get("moves", {})} for each in (before, settings))
            common, both = range(min(int(before["frames"]), settings["frames"])), found.keys() & wanted.keys()
            moved = [(each, name) for each in common for name in both if found[name][each] != wanted[name][each]]
        except (OSError, ValueError, LookupError, TypeError, OverflowError, RecursionError) as error:
            raise InputError(f"{described}: cannot be read, so the run cannot be resumed; {_ADVICE}") from error
        for key in _IDENTITY:
            if before.get(key) != settings.get(key):
                now = f"rendered with {key} {before.get(key)}, now {settings.get(key)}"
                raise InputError(f"{described}: {now}; {_ADVICE}")
        if found.keys() != wanted.keys():
            names = (", ".join(filter(None, sorted(each))) or "nothing" for each in (found, wanted))
            raise InputError(f"{described}: rendered with {next(names)} moving, now {next(names)}; {_ADVICE}")
        if moved:
            number, name = moved[0]
            what = f"object '{name}'" if name else "the camera"
            raise InputError(f"{described}: {what} was elsewhere when frame {number} was rendered; {_ADVICE}")
        return before

    def _write(self) -> None:
        states = sorted(self.references.items())
        spp = {str(number): state.spp for number, state in states}
        noise = {str(number): state.noise for number, state in states}
        content = {**self._settings, "reference_spp": spp, "reference_noise": noise}
        write_json(self._description, content)


def reference_file(folder: Path, number: int, *, unfinished: bool = False) -> Path:
    """The file of a reference, or of what there is of one that is being rendered, which no reader finds."""
    return folder / f"{'.' if unfinished else ''}reference{number}.exr"


def reference_state(path: Path, size: tuple[int, int]) -> ReferenceState | None:
    """The progress of a reference, from its header; ``None`` without one, or if it is damaged like any other file.

    Raises:
        InputError: its header does not say how many paths it has.
    """
    if not is_whole(path, size, 3):
        return None
    header = read_image_header(path).metadata
    spp, passes, noise = (header.get(f"reference_{name}") for name in ("spp", "passes", "noise"))
    if not isinstance(spp, int) or not isinstance(passes, int):
        raise InputError(f"{path}: expected a header that says how many paths it has, found none; remove it")
    return ReferenceState(spp, passes, noise if isinstance(noise, float) else None)


def write_reference(
    folder: Path, number: int, image: Tensor, state: ReferenceState, *, unfinished: bool = False
) -> None:
    """Write a reference with its progress in the header, so that both always match.

    Args:
        folder: ``inputs`` of a sequence.
        number: frame number.
        image: ``(1, 3, H, W)``.
        state: progress of the reference.
        unfinished: whether it is to be resumed: then it is stored as 32-bit floats, see :func:`reference_file`.

    Raises:
        InputError: the file cannot be written.
    """
    header = {f"reference_{name}": value for name, value in vars(state).items() if value is not None}
    path, pixels = reference_file(folder, number, unfinished=unfinished), image[0].permute(1, 2, 0).numpy()
    write_exr(path, pixels, ["R", "G", "B"], full_float=unfinished, metadata=header)


def _merged(before: dict[str, Any], settings: dict[str, Any]) -> dict[str, Any]:
    """Merge descriptions, so that rendering fewer frames or noise seeds than before keeps the others."""
    longer = before.get("frames", 0) > settings["frames"]
    kept = {key: before[key] for key in _PER_FRAME if key in before} if longer else {}
    return {**settings, **kept, "noise_seeds": max(settings["noise_seeds"], before.get("noise_seeds", 1))}
