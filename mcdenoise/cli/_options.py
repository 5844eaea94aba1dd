"""Types of options that several commands share."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, get_args

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    UnsupportedTypeAnnotationError,
)

from mcdenoise.errors import InputError

Out = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
Json = Path | None
# Frames of a shot: folders, files or patterns.
Inputs = tyro.conf.Positional[
    Annotated[tuple[Path, ...], tyro.conf.arg(metavar="INPUT [INPUT ...]", help_behavior_hint="(required)")]
]
Layers = Annotated[tuple[str, ...], tyro.conf.arg(metavar="LAYER [LAYER ...]", help_behavior_hint="")]
Map = tyro.conf.UseAppendAction[Annotated[tuple[str, ...], tyro.conf.arg(metavar="BUFFER=LAYER")]]
Workers = Annotated[str, tyro.conf.arg(metavar="N|ADDRESS")]
# A flag without its negative option --no-FLAG.
Flag = tyro.conf.FlagCreatePairsOff[bool]


def optional_values() -> ConstructorRegistry:
    """Parse an option that may be left out, ``int | None``, as its type: nobody types "None"."""
    registry = ConstructorRegistry()

    @registry.primitive_rule
    def optional(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | UnsupportedTypeAnnotationError | None:
        kinds = [kind for kind in get_args(info.type) if kind is not NoneType]
        if len(kinds) != 1 or NoneType not in get_args(info.type):
            return None
        found = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(kinds[0], info.markers))
        if not isinstance(found, PrimitiveConstructorSpec):
            return found
        return replace(
            found,
            is_instance=lambda value: value is None or found.is_instance(value),
            str_from_instance=lambda value: ["None"] if value is None else found.str_from_instance(value),
        )

    return registry


def parse_size(text: str) -> tuple[int, int]:
    """Parse the width and height of ``--size``.

    Raises:
        InputError: the text is not of the form WIDTHxHEIGHT.
    """
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise InputError(f"--size: expected WIDTHxHEIGHT such as 1280x720, found '{text}'")
    return int(width), int(height)
