"""How a shot is denoised, as options of several commands."""

from __future__ import annotations

from dataclasses import dataclass

from mcdenoise.cli._options import Flag, Layers, Map
from mcdenoise.shot import ShotSettings


@dataclass(frozen=True)
class ShotOptions(ShotSettings):
    """As :class:`mcdenoise.shot.ShotSettings` says; here, how some of it is typed."""

    map: Map = ()
    color_without_albedo: Flag = False
    color_with_albedo: Flag = False
    layers: Layers = ()
    alpha: Flag = False
