"""Cameras and camera paths: where each frame of a sequence is seen from."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mcdenoise.errors import InputError

Array: TypeAlias = NDArray[np.float64]


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


def load_camera_path(path: Path) -> list[Camera]:
    """Read a camera path, one camera per frame.

    Two JSON layouts are known: ``{"fov": ..., "to_world": [4x4, ...]}``, with matrices as in :class:`Camera`, and
    ``{"fov": ..., "frames": [{"position": ..., "look_at": ..., "up": ...}, ...]}``. ``fov`` is in degrees and across
    the image width; with ``"fov_axis": "y"`` it is across the height, and ``"aspect": "16:9"`` converts it.

    Raises:
        InputError: the file is missing, no JSON, or a camera in it is unusable.
    """
    path = Path(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(
            f"{path}: expected a camera path, found nothing readable ({error.strerror}); check the path"
        ) from error
    except ValueError as error:
        raise InputError(
            f"{path}: expected JSON, found something else ({error}); check that it is a camera path"
        ) from error
    if not isinstance(content, dict) or not any(isinstance(content.get(key), list) for key in ("to_world", "frames")):
        raise InputError(f"{path}: expected a list 'to_world' (matrices) or 'frames' (look_at), found neither")
    where = "'fov'"
    try:
        fov = _fov_x(content)
        cameras = []
        if isinstance(content.get("to_world"), list):
            for number, matrix in enumerate(content["to_world"]):
                where = f"'to_world' of frame {number}"
                cameras.append(Camera(_check_pose(np.array(matrix, dtype=np.float64)), fov))
        else:
            for number, entry in enumerate(content["frames"]):
                where = f"camera of frame {number}"
                camera = Camera.look_at(entry["position"], entry["look_at"], fov, entry.get("up", (0, 1, 0)))
                cameras.append(Camera(_check_pose(camera.to_world), fov))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        missing = f"nothing under {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(f"{path}: {where} is unusable: {missing}") from error
    if not cameras:
        raise InputError(f"{path}: expected at least one camera, found none")
    return cameras


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
    tan_x, tan_y = _half_extent(camera, width, height)
    projection = np.zeros((4, 4))
    projection[0, 0] = -1 / tan_x
    projection[1, 1] = -1 / tan_y
    projection[2, 2:] = far / (far - near), -far * near / (far - near)
    projection[3, 2] = 1
    return np.asarray((projection @ np.linalg.inv(camera.to_world)).T)


@dataclass(frozen=True, eq=False)
class PixelRays:
    """Rays through the pixel centres, row by row from the top left, in world space.

    Args:
        origin: ``(3,)`` where they all start.
        directions: ``(H*W, 3)`` unit vectors.
    """

    origin: Array
    directions: Array


def pixel_rays(camera: Camera, width: int, height: int) -> PixelRays:
    """The rays that a camera sees along, one for each of ``width`` x ``height`` pixels."""
    tan_x, tan_y = _half_extent(camera, width, height)
    x = (1 - (2 * np.arange(width) + 1) / width) * tan_x  # camera x points left, camera y up
    y = (1 - (2 * np.arange(height) + 1) / height) * tan_y
    directions = np.ones((height, width, 3))
    directions[..., 0], directions[..., 1] = x, y[:, None]
    directions = directions.reshape(-1, 3) @ camera.to_world[:3, :3].T
    return PixelRays(camera.to_world[:3, 3], directions / np.linalg.norm(directions, axis=1, keepdims=True))


def _half_extent(camera: Camera, width: int, height: int) -> tuple[float, float]:
    tan_x = math.tan(math.radians(camera.fov_x) / 2)
    return tan_x, tan_x * height / width


def _check_pose(matrix: Array) -> Array:
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise ValueError(f"expected a finite 4x4 matrix, found shape {matrix.shape}")
    rotation = matrix[:3, :3]
    straight = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) and np.linalg.det(rotation) > 0
    if not straight or not np.allclose(matrix[3], (0, 0, 0, 1)):
        raise ValueError("expected a rotation and a translation, without scaling or mirroring")
    return matrix


def _fov_x(content: dict[str, Any]) -> float:
    fov = float(content["fov"])
    if not 0 < fov < 180:
        raise ValueError(f"expected an angle between 0 and 180 degrees, found {fov:g}")
    if content.get("fov_axis", "x") == "x":
        return fov
    if content["fov_axis"] != "y":
        raise ValueError(f"expected fov_axis 'x' or 'y', found '{content['fov_axis']}'")
    across, down = (float(part) for part in content["aspect"].split(":"))
    return math.degrees(2 * math.atan(math.tan(math.radians(fov) / 2) * across / down))
