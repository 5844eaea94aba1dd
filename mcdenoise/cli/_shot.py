"""Options for reading, denoising and writing a shot, shared by several commands."""

from __future__ import annotations

from dataclasses import dataclass

from mcdenoise.cli._options import Flag, Layers, Map
from mcdenoise.shot import ShotSettings


@dataclass(frozen=True)
class ShotOptions(ShotSettings):
    """:class:`mcdenoise.shot.ShotSettings` as command-line options; overrides the parsing of some fields."""

    map: Map = ()
    color_without_albedo: Flag = False
    color_with_albedo: Flag = False
    input_linear: Flag = False
    layers: Layers = ()
    alpha: Flag = False
