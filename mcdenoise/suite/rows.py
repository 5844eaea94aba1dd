"""The suite as data: the shots to render, and the frames of each that make a row of the table."""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace
from fnmatch import fnmatchcase
from typing import Any, Literal

from mcdenoise.errors import InputError

Renderer = Literal["mitsuba", "cycles"]
# ``centre`` puts every sample at the pixel centre; ``default`` is Blender's filter, Blackman-Harris over 1.5 pixels.
Filter = Literal["centre", "box", "gaussian", "default"]


@dataclass(frozen=True)
class Shot:
    """One rendered shot.

    Args:
        name: of the shot and of its folder.
        renderer: ``mitsuba`` or ``cycles``.
        scene: ``parlour``, or ``take`` and the number of a take of unseen assets, for Mitsuba; a name in
            ``blender_scenes.py`` for Cycles.
        samples: samples per pixel.
        filter: reconstruction filter of the pixels.
        frames: number of frames; 1 for a still.
        size: width and height in pixels.
        reference_samples: samples per pixel of the references.
        lens: whether it has depth of field.
        blur: whether it has motion blur; Cycles only.
        curve: whether it is a point of the curve of error over samples instead of a row of the table.
    """

    name: str
    renderer: Renderer
    scene: str
    samples: int
    filter: Filter
    frames: int = 8
    size: tuple[int, int] = (320, 180)
    reference_samples: int = 512
    lens: bool = False
    blur: bool = False
    curve: bool = False

    @property
    def references(self) -> range:
        """Frames with a reference: the second half of a sequence, where methods have a history."""
        return range(self.frames // 2, self.frames)

    @property
    def picture(self) -> tuple[object, ...]:
        """The settings that its references depend on; shots with equal pictures have the same references."""
        return astuple(replace(self, name="", samples=0))


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Args:
        shot: the shot whose frames are denoised.
        still: whether only its last frame is denoised, as a still.
    """

    shot: Shot
    still: bool

    @property
    def name(self) -> str:
        """The row's name, unique in the suite."""
        return f"{self.shot.name}-still" if self.still and self.shot.frames > 1 else self.shot.name

    @property
    def frames(self) -> str | None:
        """The frames as :func:`mcdenoise.data.open_sequence` takes them; ``None`` for all."""
        return str(self.shot.frames - 1) if self.still else None


def choose_rows(patterns: str | None = None) -> list[Row]:
    """Rows of the suite. Every sequence is one row, and its last frame as a still is another.

    Args:
        patterns: names separated by commas, where ``*`` matches anything, such as
            ``"cycles-*,mitsuba-parlour-box-4"``; all rows by default.

    Raises:
        InputError: a pattern matches no row.

    Example:
        >>> [row.name for row in choose_rows("mitsuba-parlour-box-4*")]
        ['mitsuba-parlour-box-4', 'mitsuba-parlour-box-4-still']
    """
    rows = [Row(shot, still) for shot in SHOTS for still in ((False, True) if shot.frames > 1 else (True,))]
    if patterns is None:
        return rows
    chosen: set[str] = set()
    for pattern in (each.strip() for each in patterns.split(",")):
        fitting = {row.name for row in rows if fnmatchcase(row.name, pattern)}
        if not fitting:
            raise InputError(
                f"--rows: expected names of rows such as '{rows[0].name}' or 'cycles-*', found '{pattern}'"
            )
        chosen |= fitting
    return [row for row in rows if row.name in chosen]


def _curve(name: str, renderer: Renderer, scene: str, pixel_filter: Filter, reference_samples: int) -> list[Shot]:
    still: dict[str, Any] = {"frames": 1, "size": (240, 135), "reference_samples": reference_samples, "curve": True}
    samples = [2**power for power in range(11)]
    return [Shot(f"{name}-samples-{spp}", renderer, scene, spp, pixel_filter, **still) for spp in samples]


# Shots in the order of rendering, the most informative first. No training data have the assets of these takes.
SHOTS: tuple[Shot, ...] = (
    Shot("cycles-gallery-4", "cycles", "gallery", 4, "default"),
    Shot("mitsuba-parlour-centre-1", "mitsuba", "parlour", 1, "centre"),
    Shot("mitsuba-parlour-box-1", "mitsuba", "parlour", 1, "box"),
    Shot("mitsuba-parlour-box-4", "mitsuba", "parlour", 4, "box"),
    Shot("mitsuba-parlour-gaussian-16", "mitsuba", "parlour", 16, "gaussian"),
    Shot("cycles-gallery-1", "cycles", "gallery", 1, "default"),
    Shot("cycles-gallery-16", "cycles", "gallery", 16, "default"),
    Shot("mitsuba-take-950004-box-1", "mitsuba", "take 950004", 1, "box"),
    Shot("mitsuba-take-950003-gaussian-4", "mitsuba", "take 950003", 4, "gaussian", frames=1),
    Shot("mitsuba-take-950005-box-16", "mitsuba", "take 950005", 16, "box", frames=1),
    Shot("cycles-gallery-centre-1", "cycles", "gallery", 1, "centre"),
    Shot("cycles-garden-4", "cycles", "garden", 4, "default"),
    Shot("cycles-attic-1", "cycles", "attic", 1, "default"),
    Shot("mitsuba-parlour-lens-4", "mitsuba", "parlour", 4, "gaussian", frames=1, lens=True),
    Shot("cycles-gallery-lens-4", "cycles", "gallery", 4, "default", frames=1, lens=True),
    Shot("cycles-gallery-blur-4", "cycles", "gallery", 4, "default", frames=1, blur=True),
    Shot("mitsuba-parlour-360p-4", "mitsuba", "parlour", 4, "gaussian", frames=1, size=(640, 360)),
    Shot("mitsuba-parlour-720p-1", "mitsuba", "parlour", 1, "box", frames=1, size=(1280, 720)),
    *_curve("mitsuba-parlour", "mitsuba", "parlour", "gaussian", 4096),
    *_curve("cycles-gallery", "cycles", "gallery", "default", 2048),
    Shot("cycles-garden-360p-1", "cycles", "garden", 1, "default", frames=1, size=(640, 360)),
)
