"""What the options of several commands have in common."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from mcdenoise.errors import InputError

Out = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
Json = Path | None
# Frames of a shot: folders, files, patterns.
Inputs = tyro.conf.Positional[
    Annotated[tuple[Path, ...], tyro.conf.arg(metavar="INPUT [INPUT ...]", help_behavior_hint="(required)")]
]
Layers = Annotated[tuple[str, ...], tyro.conf.arg(metavar="LAYER [LAYER ...]", help_behavior_hint="")]
Map = tyro.conf.UseAppendAction[Annotated[tuple[str, ...], tyro.conf.arg(metavar="BUFFER=LAYER")]]
# On or off, and off without a word: that needs no second option which says so.
Flag = tyro.conf.FlagCreatePairsOff[bool]


def parse_size(text: str) -> tuple[int, int]:
    """Width and height of a ``--size``.

    Raises:
        InputError: the text is something else.
    """
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise InputError(f"--size: expected WIDTHxHEIGHT such as 1280x720, found '{text}'")
    return int(width), int(height)
