"""The manifest of a film: its shots and how each is denoised, as a TOML file or a pattern of folders."""

from __future__ import annotations

import glob
import os
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from mcdenoise.data.sequences import parse_frames
from mcdenoise.errors import InputError, did_you_mean, is_unicode
from mcdenoise.methods import WEIGHTS, check_names_no_code
from mcdenoise.reading import expecting, read_text
from mcdenoise.shot import ShotSettings

# Folders of the thumbnails and of the records, beside the shots.
PICTURES, RECORDS = "film_pictures", ".film"
_TAKEN = {"film.json", "film.html", PICTURES}
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
    settings = _absolute(settings or ShotSettings(), Path.cwd())
    shots = _of_file(manifest, settings) if manifest.suffix == ".toml" else _of_pattern(manifest, settings)
    names: dict[str, Shot] = {}
    for shot in shots:
        # Some file systems do not tell upper case from lower case.
        if names.setdefault(shot.name.casefold(), shot) is not shot:
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


class _Manifest(msgspec.Struct, forbid_unknown_fields=True):
    every: dict[str, Any] = {}
    shot: list[dict[str, Any]] = []
    shots: str = ""


def _of_file(path: Path, settings: ShotSettings) -> list[Shot]:
    tables = "tables [[shot]] of name and input, or shots = 'a pattern of folders', and perhaps [every]"
    with expecting(path, f"the manifest of a film, TOML with {tables}"):
        manifest = msgspec.convert(tomllib.loads(read_text(path)), _Manifest)
        if bool(manifest.shot) is bool(manifest.shots):
            misplaced = "shots" in manifest.every
            raise ValueError("'shots' in [every]; write it above" if misplaced else "both or none of them")
    settings = _settings(manifest.every, settings, f"{path}, [every]", path.parent)
    if manifest.shots:
        return _of_pattern(path.parent / manifest.shots, settings)
    shots = []
    for number, table in enumerate(manifest.shot, 1):
        where = f"{path}, shot {number}"
        name, inputs = table.pop("name", None), table.pop("input", None)
        inputs = [inputs] if isinstance(inputs, str) else inputs
        texts = [name, *inputs] if isinstance(inputs, list) else [None]
        if not inputs or not all(isinstance(text, str) and text and "\0" not in text for text in texts):
            raise InputError(
                f"{where}: expected 'name', a text, and 'input', a folder, a file, a pattern, or a list of these"
            )
        where = f"{where} '{name}'"
        paths = tuple(path.parent / each for each in inputs)
        shots.append(_shot(name, paths, _settings(table, settings, where, path.parent), where))
    return shots


def _shot(name: str, inputs: tuple[Path, ...], settings: ShotSettings, where: str) -> Shot:
    plain = name.strip() and not name.startswith(".") and not {"/", "\\", "\0"} & set(name) and is_unicode(name)
    if not plain or name.casefold() in _TAKEN or len(os.fsencode(name)) > _LONGEST_NAME:
        raise InputError(
            f"{where}: expected a name that a folder can have, in UTF-8, without slashes or a dot before it, not "
            f"one of {', '.join(sorted(_TAKEN))}, found {name[:80]!r}; choose another"
        )
    return Shot(name, tuple(Path(os.path.abspath(path)) for path in inputs), settings)


def _settings(table: Mapping[str, Any], settings: ShotSettings, where: str, base: Path) -> ShotSettings:
    """The settings, overridden by those of a table."""
    # Both spellings are accepted, that of the command line and that of Python.
    table = {key.replace("-", "_"): value for key, value in table.items()}
    known = asdict(settings)
    for name in table.keys() - known:
        meant = did_you_mean(name, [*known, "name", "input"]) or "see `mcdenoise denoise --help`"
        raise InputError(f"{where}: expected a setting of `mcdenoise denoise`, found '{name}'; {meant}")
    texts = {name: [table[name]] for name in ("map", "layers") if isinstance(table.get(name), str)}
    try:
        for name, value in table.items():
            # Written so that NaN is out of range.
            if isinstance(value, int | float) and not abs(value) < _LIMIT:
                raise ValueError(f"{name}: expected a number below 2^63")
        made = msgspec.convert({**known, **table, **texts}, ShotSettings, dec_hook=lambda kind, value: kind(value))
        made.check()
        if made.frames is not None:
            parse_frames(made.frames)
    except ValueError as error:
        raise InputError(f"{where}: {str(error)[:300]}; see `mcdenoise denoise --help`") from error
    if made.model is not None and "model" in table:
        check_names_no_code(made.model, f"{where}, model")
    return _absolute(made, base)


def _absolute(settings: ShotSettings, base: Path) -> ShotSettings:
    """The settings with absolute paths, because workers may have other working folders."""
    paths = {name: getattr(settings, name) for name in ("weights", "results")}
    changed: dict[str, Any] = {name: Path(os.path.abspath(base / path)) for name, path in paths.items() if path}
    name = (settings.model or "").partition("(")[0].strip()
    if settings.model and (name.endswith(WEIGHTS) or ".py:" in name):
        changed["model"] = os.path.abspath(base / settings.model)
    return replace(settings, **changed)
