"""The options of a shot, which several commands have."""

from __future__ import annotations

from dataclasses import dataclass

from mcdenoise.cli._options import Flag, Layers, Map
from mcdenoise.shot import ShotSettings


@dataclass(frozen=True)
class ShotOptions(ShotSettings):
    """The options for :class:`mcdenoise.shot.ShotSettings`, with types for the command line."""

    map: Map = ()
    color_without_albedo: Flag = False
    color_with_albedo: Flag = False
    layers: Layers = ()
    alpha: Flag = False
