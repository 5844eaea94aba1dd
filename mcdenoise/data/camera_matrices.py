"""``camera_matrices.h``: the cameras of a sequence as the C header that the BMFR data set uses."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mcdenoise.data.camera_path import Array
from mcdenoise.data.files import write_text
from mcdenoise.errors import InputError
from mcdenoise.reading import expecting, read_text

MATRICES = "camera_matrices.h"
_LARGEST_FILE = 50 * 2**20
# An unclosed comment hides the rest of the file, so that variables in it count as missing.
_COMMENT = re.compile(r"//[^\n]*|/\*.*?(?:\*/|\Z)", re.DOTALL)
# The patterns do not backtrack: the run time is linear in the length of any text.
_NUMBER = re.compile(r"([-+]?(?:[0-9]++(?:\.[0-9]*+)?+|\.[0-9]++)(?:[eE][-+]?[0-9]++)?+)[fF]?+(?![\w.])")
_INITIALISER = re.compile(rf"(?:\s++|[{{}},]|{_NUMBER.pattern})*+")


@dataclass(frozen=True)
class CameraMatrices:
    """The cameras of N frames.

    Args:
        matrices: float64 ``(N, 4, 4)`` row-vector world-to-clip matrices, ``clip = [x y z 1] @ M``, clip y down.
        pixel_offsets: float64 ``(N, 2)``, ``(ox, oy)`` in pixels: a point at (u, v) lies at pixel index
            ``(u W - ox, v H - (1 - oy))``. (0.5, 0.5) puts integers at pixel centres.
    """

    matrices: Array
    pixel_offsets: Array

    def __len__(self) -> int:
        return len(self.matrices)

    def view_projection(self, index: int, size: tuple[int, int]) -> Array:
        r"""One frame's matrix with a pixel offset folded in, so that ``u W - 0.5, v H - 0.5`` is the pixel index.

        The matrix serves to look up the frame after it, as in the published code, which takes this frame's matrix and
        the next frame's offset.

        .. math:: M'_{:,0} = M_{:,0} + \frac{1 - 2 o_x}{W} M_{:,3}, \quad
                  M'_{:,1} = M_{:,1} + \frac{2 o_y - 1}{H} M_{:,3}

        Args:
            index: number of the frame, from 0.
            size: height and width of the image in pixels.

        Returns:
            float64 ``(4, 4)``.
        """
        height, width = size
        offset_x, offset_y = self.pixel_offsets[min(index + 1, len(self) - 1)]
        matrix: Array = self.matrices[index].copy()
        matrix[:, 0] += (1 - 2 * offset_x) / width * matrix[:, 3]
        matrix[:, 1] += (2 * offset_y - 1) / height * matrix[:, 3]
        return matrix


def read_camera_matrices(path: Path) -> CameraMatrices:
    """Read a ``camera_matrices.h``.

    Args:
        path: the C header with ``camera_matrices[N][4][4]`` and ``pixel_offsets[N][2]``. Comments and the suffix ``f``
            are accepted; expressions are not. Other variables are not read.

    Raises:
        InputError: the file is missing, too large, incomplete, or contains something other than finite numbers.
    """
    with expecting(path, "a C header"):
        text = _COMMENT.sub(" ", read_text(path, _LARGEST_FILE, errors="replace"))
    matrices = _read_variable(path, text, "camera_matrices", (-1, 4, 4))
    return CameraMatrices(matrices, _read_variable(path, text, "pixel_offsets", (len(matrices), 2)))


def find_camera_matrices(folder: Path, last: int) -> CameraMatrices | None:
    """Read the ``camera_matrices.h`` of a folder; return ``None`` if there is none.

    Args:
        folder: folder of the frames.
        last: number of the last frame in use.

    Raises:
        InputError: see :func:`read_camera_matrices`; or there is no matrix for the last frame.
    """
    path = folder / MATRICES
    if not os.path.lexists(path):
        return None
    cameras = read_camera_matrices(path)
    if len(cameras) <= last:
        raise InputError(
            f"{path}: expected a matrix for frame {last}, found {len(cameras)} (frames 0 to "
            f"{len(cameras) - 1}); write all matrices, or choose fewer frames"
        )
    return cameras


def write_camera_matrices(path: Path, cameras: CameraMatrices, comment: str = "", **limits: float) -> None:
    """Write a ``camera_matrices.h`` atomically, in single precision.

    Args:
        path: the file. Its folder must exist.
        cameras: the cameras to write.
        comment: one line for the beginning of the file.
        limits: further numbers in it: the published code of BMFR needs ``position_limit_squared``, beyond which two
            points are not the same surface, in scene units, and ``normal_limit_squared``, the same for unit normals.

    Raises:
        InputError: the file cannot be written.
    """
    count = len(cameras)
    lines = [f"// {comment}"] if comment else []
    lines += [
        *(f"const float {name} = {_literal(value)};" for name, value in limits.items()),
        f"const float camera_matrices[{count}][4][4] = {_literal(cameras.matrices.tolist())};",
        f"const float pixel_offsets[{count}][2] = {_literal(cameras.pixel_offsets.tolist())};",
    ]
    write_text(path, "\n".join(lines) + "\n")


def _read_variable(path: Path, text: str, name: str, shape: tuple[int, ...]) -> Array:
    sides = "".join(f"[{n}]" if n >= 0 else "[N]" for n in shape)
    word = re.compile(rf"\b{name}\b")
    # A statement ends with a semicolon. Each statement is examined once, however often it contains the name.
    statements = (statement.partition("=") for statement in text.split(";")[:-1])
    initialiser = next((value for head, equals, value in statements if equals and word.search(head)), None)
    with expecting(path, f"'{name}', numbers {sides}"):
        if initialiser is None:
            raise ValueError("it is incomplete" if word.search(text) else "no such variable")
        if not _INITIALISER.fullmatch(initialiser):
            raise ValueError("something else")
        # As in C, inner braces may be left out.
        values = np.array([float(each) for each in _NUMBER.findall(initialiser)]).reshape(shape)
        # The header declares single precision, and frames store it.
        if not (np.abs(values) <= np.finfo(np.float32).max).all():
            raise ValueError("a number too large for single precision")
        return values


def _literal(value: float | list[Any]) -> str:
    if isinstance(value, list):
        separator = ", " if not value or not isinstance(value[0], list) else ",\n"
        return "{" + separator.join(_literal(item) for item in value) + "}"
    text = f"{value:.9g}"
    return f"{text}f" if any(mark in text for mark in ".e") else f"{text}.0f"
