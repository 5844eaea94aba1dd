"""The manifest of a film: its shots and how each is denoised, as a TOML file or a pattern of folders."""

from __future__ import annotations

import glob
import os
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_type_hints

import msgspec

from mcdenoise.data.sequences import parse_frames
from mcdenoise.errors import InputError, did_you_mean, is_unicode, printable
from mcdenoise.methods import WEIGHTS, check_names_no_code
from mcdenoise.reading import read_text
from mcdenoise.shot import ShotSettings

# Folder of the thumbnails, beside the shots.
PICTURES = "film_pictures"
_TAKEN = {"film.json", "film.html", PICTURES}
_OWN = ("name", "input")
_LONGEST_NAME = 200
_LIMIT = 2**63


@dataclass(frozen=True)
class Shot:
    """A shot of a film.

    Args:
        name: of its folder in the output.
        inputs: folders, files or patterns, as absolute paths.
        settings: how it is denoised, with absolute paths.
        picked: the model that limits of run time or error have picked, and why; empty without them or before the scan.
    """

    name: str
    inputs: tuple[Path, ...]
    settings: ShotSettings
    picked: str = ""


def read_film(manifest: Path, settings: ShotSettings | None = None) -> list[Shot]:
    """Read the shots of a film.

    Args:
        manifest: a TOML file with a table ``[[shot]]`` for each shot, which has ``name``, ``input`` (a folder, a file,
            a pattern, or a list of these, beside the manifest where they are not absolute), and any setting of
            :class:`mcdenoise.shot.ShotSettings`, but no model of one's own, which is code and named by ``settings``; a
            table ``[every]`` has settings of all shots. In place of the tables, ``shots`` may be a pattern of folders.
            Or a pattern of folders alone, such as ``renders/*/beauty``: each folder is a shot, and is named by the
            parts that match wildcards.
        settings: of all shots; the manifest overrides them.

    Raises:
        InputError: the manifest cannot be read, has no shots, or has an unknown key or a wrong value.
    """
    settings = _absolute(settings or ShotSettings(), Path.cwd(), ("model", "weights", "results"))
    shots = _of_file(manifest, settings) if manifest.suffix == ".toml" else _of_pattern(manifest, settings)
    names: dict[str, Shot] = {}
    for shot in shots:
        # Some file systems do not tell upper case from lower case.
        other = names.setdefault(shot.name.casefold(), shot)
        if other is not shot:
            raise InputError(
                f"{manifest}: expected a name of its own for each shot, found '{shot.name}' twice; rename one"
            )
    return shots


def _of_pattern(pattern: Path, settings: ShotSettings) -> list[Shot]:
    found = sorted(Path(path) for path in glob.glob(str(pattern)) if os.path.isdir(path))
    # The working folder has no part that could name its shot.
    if not found or not pattern.parts:
        raise InputError(
            f"{pattern}: expected a manifest (.toml), or a pattern of folders such as 'renders/*', found neither; "
            "check the path, and put the pattern into quotes"
        )
    parts = pattern.parts
    wildcards = [place for place, part in enumerate(parts) if glob.has_magic(part)] or [len(parts) - 1]
    return [_shot("_".join(path.parts[p] for p in wildcards), (path,), settings, str(pattern)) for path in found]


class _Entry(msgspec.Struct):
    """What a table of a shot has beside settings."""

    name: str
    input: str | list[str]


class _Manifest(msgspec.Struct, forbid_unknown_fields=True):
    every: dict[str, Any] = {}
    shot: list[_Entry] = []
    shots: str = ""


def _of_file(path: Path, settings: ShotSettings) -> list[Shot]:
    try:
        content = tomllib.loads(read_text(path))
        manifest = msgspec.convert(content, _Manifest)
        if bool(manifest.shot) is bool(manifest.shots):
            raise ValueError("both or none of them")
    except OSError as error:
        raise InputError(f"{path}: expected a manifest of a film, found: {error.strerror}; check the path") from error
    # An integer of too many digits is a ValueError, as are all others.
    except (ValueError, RecursionError) as error:
        raise InputError(
            f"{path}: expected TOML with tables [[shot]] of name and input, or shots = 'a pattern of folders', and "
            f"perhaps [every], found: {printable(str(error))[:300]}; mend it there"
        ) from error
    settings = _settings(manifest.every, settings, f"{path}, [every]", path.parent)
    if manifest.shots:
        return _of_pattern(path.parent / manifest.shots, settings)
    shots = []
    for number, (entry, table) in enumerate(zip(manifest.shot, content["shot"], strict=True), 1):
        where = f"{path}, shot {number} '{entry.name}'"
        own = {key: value for key, value in table.items() if key not in _OWN}
        inputs = [entry.input] if isinstance(entry.input, str) else entry.input
        if not all(inputs) or "\0" in "".join(inputs) or not inputs:
            raise InputError(f"{where}: expected 'input', folders, files or patterns, found {_found(entry.input)}")
        paths = tuple(path.parent / each for each in inputs)
        shots.append(_shot(entry.name, paths, _settings(own, settings, where, path.parent), where))
    return shots


def _shot(name: str, inputs: tuple[Path, ...], settings: ShotSettings, where: str) -> Shot:
    plain = name.strip() and not name.startswith(".") and not {"/", "\\", "\0"} & set(name) and is_unicode(name)
    if not plain or name.casefold() in _TAKEN or len(os.fsencode(name)) > _LONGEST_NAME:
        raise InputError(
            f"{where}: expected a name that a folder can have, in UTF-8, without slashes or a dot before it, not "
            f"one of {', '.join(sorted(_TAKEN))}, found {printable(repr(name[:80]))}; choose another"
        )
    return Shot(name, tuple(Path(os.path.abspath(path)) for path in inputs), settings)


def _settings(table: Mapping[str, Any], settings: ShotSettings, where: str, base: Path) -> ShotSettings:
    """The settings, overridden by those of a table."""
    kinds = get_type_hints(ShotSettings)
    changed = {}
    for key, value in table.items():
        # Both spellings are accepted, that of the command line and that of Python.
        name = key.replace("-", "_")
        if name not in kinds:
            meant = did_you_mean(name, [*kinds, *_OWN]) or "see `mcdenoise denoise --help`"
            raise InputError(f"{where}: expected a setting of `mcdenoise denoise`, found '{key}'; {meant}")
        try:
            changed[name] = _typed(kinds[name], value)
        except ValueError as error:
            raise InputError(
                f"{where}, {key}: {error}, found {_found(value)}; see `mcdenoise denoise --help`"
            ) from error
        if name == "model":
            check_names_no_code(value, f"{where}, {key}")
    made = _absolute(replace(settings, **changed), base, changed)
    try:
        made.check()
        if made.frames is not None:
            parse_frames(made.frames)
    except InputError as error:
        raise InputError(f"{where}: {error}") from error
    return made


def _typed(kind: Any, value: Any) -> Any:
    """Convert a value of TOML to the type of a setting."""
    # Written so that NaN is out of range.
    if isinstance(value, int | float) and not abs(value) < _LIMIT:
        raise ValueError("expected a number below 2^63")
    if kind == tuple[str, ...] and isinstance(value, str):
        value = [value]
    return msgspec.convert(value, kind, dec_hook=lambda kind, value: kind(value))


def _absolute(settings: ShotSettings, base: Path, chosen: Iterable[str]) -> ShotSettings:
    """The settings with absolute paths in the chosen ones, because workers may have other working folders."""
    changed: dict[str, Any] = {}
    for name in {"weights", "results"} & set(chosen):
        if (path := getattr(settings, name)) is not None:
            changed[name] = Path(os.path.abspath(base / path))
    if "model" in chosen and (model := settings.model) is not None:
        name = model.partition("(")[0].strip()
        if name.endswith(WEIGHTS) or ".py:" in name:
            changed["model"] = os.path.abspath(base / model)
    return replace(settings, **changed)


def _found(value: Any) -> str:
    try:
        text = printable(repr(value))
    except ValueError:
        # A hexadecimal integer may have more digits than Python prints.
        text = "a number of thousands of digits"
    return "nothing" if value is None else text if len(text) <= 80 else f"{text[:77]}..."
