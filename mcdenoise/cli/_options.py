"""Types of options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from mcdenoise.errors import InputError

Out = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
Json = Path | None
# Inputs of a shot: folders, files, patterns.
Inputs = tyro.conf.Positional[
    Annotated[tuple[Path, ...], tyro.conf.arg(metavar="INPUT [INPUT ...]", help_behavior_hint="(required)")]
]
Layers = Annotated[tuple[str, ...], tyro.conf.arg(metavar="LAYER [LAYER ...]", help_behavior_hint="")]
Map = tyro.conf.UseAppendAction[Annotated[tuple[str, ...], tyro.conf.arg(metavar="BUFFER=LAYER")]]
# A flag that is off by default, without a second option for switching it off.
Flag = tyro.conf.FlagCreatePairsOff[bool]


def parse_size(text: str) -> tuple[int, int]:
    """Parse width and height of a ``--size``.

    Raises:
        InputError: the text has another form.
    """
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise InputError(f"--size: expected WIDTHxHEIGHT such as 1280x720, found '{text}'")
    return int(width), int(height)
