"""Cameras and shots: the camera and the placement of moving objects for each frame of a sequence."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mcdenoise.errors import InputError, naming
from mcdenoise.reading import expecting, read_text

Array: TypeAlias = NDArray[np.float64]

# A string, which is kept, or a trailing comma, which is removed.
_LAST_COMMA = re.compile(r'("(?:[^"\\]|\\.?)*+(?:"|\Z))|,(?=\s*+[}\]])', re.DOTALL)
_SMALLEST_VOLUME = 1e-12


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera.

    Args:
        to_world: ``(4, 4)`` camera-to-world matrix for column vectors; camera frame +x left, +y up, +z forward.
        fov_x: angle between the left and right image edge, degrees.
    """

    to_world: Array
    fov_x: float

    @classmethod
    def look_at(
        cls, origin: Sequence[float], target: Sequence[float], fov_x: float, up: Sequence[float] = (0, 1, 0)
    ) -> Camera:
        """A camera at ``origin`` that looks at ``target``, all in world space.

        Raises:
            InputError: the viewing direction is zero or parallel to ``up``.

        Example:
            >>> Camera.look_at((0, 0, 4), (0, 0, 0), fov_x=40).to_world[:3, 2]
            array([ 0.,  0., -1.])
        """
        forward = np.subtract(target, origin, dtype=np.float64)
        left = np.cross(np.asarray(up, dtype=np.float64), forward)
        if not np.linalg.norm(left) > 1e-9 * np.linalg.norm(forward) * np.linalg.norm(up):
            raise InputError(
                f"camera: expected a viewing direction that is not parallel to up {list(up)}, found {forward.tolist()}"
            )
        forward = forward / np.linalg.norm(forward)
        left /= np.linalg.norm(left)
        to_world = np.eye(4)
        to_world[:3] = np.stack((left, np.cross(forward, left), forward, np.asarray(origin, dtype=np.float64)), axis=1)
        return cls(to_world + 0.0, float(fov_x))  # + 0.0 turns -0 into 0


@dataclass(frozen=True, eq=False)
class CameraPath:
    """The values that change from frame to frame.

    Args:
        cameras: one camera per frame.
        moves: for each moving object of the scene, by id, ``(T, 4, 4)`` float64: for each of T frames the world-space
            transform (column vectors) to apply to the object after the scene has placed it.
    """

    cameras: list[Camera]
    moves: dict[str, Array] = field(default_factory=dict)


def load_camera_path(path: Path) -> CameraPath:
    """Read a camera path, including the paths of objects.

    The following JSON layouts are supported; a trailing comma after the last element is accepted:

    - ``{"fov": ..., "to_world": [4x4, ...]}``, with matrices as in :class:`Camera`;
    - ``{"fov": ..., "frames": [{"position": ..., "look_at": ..., "up": ...}, ...]}``; a frame may have its own
      ``fov``;
    - scenes of the Tungsten renderer, which hold ``"camera": {"transform": {"position": ..., "look_at": ..., "up":
      ...}, "fov": ...}``: one, a list of them, ``frames`` as above, or a folder with one file per frame.

    ``fov`` is in degrees and across the image width; with ``"fov_axis": "y"`` it is across the height, and
    ``"aspect": "16:9"`` converts it. Beside the cameras, ``"objects": {"ID": [4x4 or 3x4, ...], ...}`` moves objects:
    one matrix per frame, as in :class:`CameraPath`.

    Args:
        path: the file, or a folder of ``*.json`` files, which are sorted by the last number in their names.

    Raises:
        InputError: the file is missing or not JSON, or a camera or object in it is invalid.
    """
    path = Path(path)
    files = sorted(path.glob("*.json"), key=_last_number) if path.is_dir() else []
    content: Any = [_read_json(file) for file in files] if path.is_dir() else _read_json(path)
    if isinstance(content, list) and content:
        content = {"frames": content}
    elif isinstance(content, dict) and isinstance(content.get("camera"), dict):
        content = {"frames": [content]}
    if not isinstance(content, dict) or not any(isinstance(content.get(key), list) for key in ("to_world", "frames")):
        raise InputError(f"{path}: expected a list 'to_world' (matrices) or 'frames' (look_at), found neither")
    if isinstance(content.get("to_world"), list):
        content["frames"] = [{"to_world": matrix} for matrix in content["to_world"]]
    cameras = []
    for number, entry in enumerate(content["frames"]):
        try:
            cameras.append(_camera(entry.get("camera", entry), content))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            missing = f"nothing under {error}" if isinstance(error, KeyError) else str(error)
            raise InputError(f"{path}: camera of frame {number} is unusable: {missing}") from error
    if not cameras:
        raise InputError(f"{path}: expected at least one camera, found none")
    with naming(str(path)):
        return CameraPath(cameras, check_moves(content.get("objects", {}), len(cameras)))


def check_moves(moves: Mapping[str, Any], frames: int) -> dict[str, Array]:
    """Check transforms of objects, and convert them to the form in :class:`CameraPath`.

    Args:
        moves: for each id, ``frames`` matrices of shape ``(4, 4)`` or ``(3, 4)``.
        frames: the required number of matrices.

    Raises:
        InputError: a matrix is missing, not finite, not affine or cannot be inverted.
    """
    if not isinstance(moves, Mapping):
        raise InputError(f"expected 'objects' to map ids to lists of matrices, found {type(moves).__name__}")
    checked: dict[str, Array] = {}
    for identity, matrices in moves.items():
        try:
            given = np.array(matrices, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise InputError(f"object '{identity}': expected matrices, found something else ({error})") from error
        if given.ndim != 3 or given.shape[1:] not in ((4, 4), (3, 4)) or len(given) != frames:
            raise InputError(
                f"object '{identity}': expected {frames} matrices of 4x4 or 3x4, one per camera, found shape "
                f"{given.shape}"
            )
        whole = np.tile(np.eye(4), (frames, 1, 1))
        whole[:, : given.shape[1]] = given
        for number, matrix in enumerate(whole):
            usable = np.isfinite(matrix).all() and np.allclose(matrix[3], (0, 0, 0, 1))
            if not usable or abs(np.linalg.det(matrix[:3, :3])) < _SMALLEST_VOLUME:
                raise InputError(
                    f"object '{identity}': expected a finite affine transform that can be inverted, found something "
                    f"else in frame {number}"
                )
        checked[str(identity)] = whole
    return checked


def view_projection(camera: Camera, width: int, height: int, near: float, far: float) -> Array:
    """The world-to-clip matrix of a camera.

    ``clip = [x y z 1] @ M``. ``u = (clip.x / clip.w + 1) / 2`` runs from left to right and
    ``v = (clip.y / clip.w + 1) / 2`` from top to bottom. ``clip.z / clip.w`` is 0 at ``near`` and 1 at ``far``;
    ``clip.w`` is the linear view depth.

    Args:
        camera: the camera.
        width: image width in pixels.
        height: image height in pixels; pixels are square.
        near: distance of the near plane, scene units.
        far: distance of the far plane, scene units.

    Returns:
        ``(4, 4)`` matrix for row vectors.
    """
    tan_x = math.tan(math.radians(camera.fov_x) / 2)
    tan_y = tan_x * height / width
    projection = np.zeros((4, 4))
    projection[0, 0] = -1 / tan_x
    projection[1, 1] = -1 / tan_y
    projection[2, 2:] = far / (far - near), -far * near / (far - near)
    projection[3, 2] = 1
    return np.asarray((projection @ np.linalg.inv(camera.to_world)).T)


def _camera(entry: dict[str, Any], content: dict[str, Any]) -> Camera:
    """The camera of a frame, by its matrix or by what it looks at."""
    fov, pose = _fov_x(entry if "fov" in entry else content, content), entry.get("transform", entry)
    if "to_world" in pose:
        matrix = np.array(pose["to_world"], dtype=np.float64)
    else:
        matrix = Camera.look_at(pose["position"], pose["look_at"], fov, pose.get("up", (0, 1, 0))).to_world
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError(f"expected a finite 4x4 matrix, found shape {matrix.shape}")
    rotation = matrix[:3, :3]
    straight = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) and np.linalg.det(rotation) > 0
    if not straight or not np.allclose(matrix[3], (0, 0, 0, 1)):
        raise ValueError("expected a rotation and a translation, without scaling or mirroring")
    return Camera(matrix, fov)


def _fov_x(holder: dict[str, Any], conventions: dict[str, Any]) -> float:
    fov = float(holder["fov"])
    if not 0 < fov < 180:
        raise ValueError(f"expected an angle between 0 and 180 degrees, found {fov:g}")
    if conventions.get("fov_axis", "x") == "x":
        return fov
    if conventions["fov_axis"] != "y":
        raise ValueError(f"expected fov_axis 'x' or 'y', found '{conventions['fov_axis']}'")
    across, down = (float(part) for part in conventions["aspect"].split(":"))
    return math.degrees(2 * math.atan(math.tan(math.radians(fov) / 2) * across / down))


def _read_json(path: Path) -> Any:
    with expecting(path, "a camera path in JSON"):
        return json.loads(_LAST_COMMA.sub(lambda match: match[1] or "", read_text(path)))


def _last_number(path: Path) -> tuple[int, str]:
    numbers = re.findall(r"[0-9]+", path.stem)
    return (int(numbers[-1]) if numbers else -1), path.name
