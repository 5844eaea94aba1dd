"""A recipe: a TOML file with all settings that determine trained weights, including the seeds of the data.

::

    [train]             # fields of TrainConfig; credits = "authors and licences"
    [[data]]            # options of `mcdenoise generate`; clean_references = true removes noise from references;
                        # folder = "NAME" is where they are rendered to, in the folder of all data
    [[validation]]      # the same options
    [expected]          # smape and tolerance: the error on the validation frames, and by how much a run may exceed it

A recipe of several runs on the same data also has a table for each run::

    [[run]]             # name; fields of TrainConfig that differ from [train]; expected = {smape=..., tolerance=...};
                        # seeds = [1, 2] makes two runs of it, NAME-1 and NAME-2
"""

from __future__ import annotations

import hashlib
import json
import re
import tomllib
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from mcdenoise.data.files import write_text
from mcdenoise.data.shards import find_shards
from mcdenoise.errors import InputError
from mcdenoise.methods import check_names_no_code
from mcdenoise.models import create_model
from mcdenoise.reading import read_text
from mcdenoise.train.cache import locked
from mcdenoise.train.config import TrainConfig, check_config
from mcdenoise.train.references import clean_references

_TABLES = ("train", "data", "validation", "expected", "run")
_BOUND = {"smape": float, "tolerance": float}
_CLEAN = "clean_references"
# Keys of a table of data that are no options of `mcdenoise generate`.
_OWN: dict[str, type] = {_CLEAN: bool, "folder": str}
# A run's name is also the name of its folder.
_NAME = re.compile(r"[A-Za-z0-9+_-]{1,64}")
_NO_PIXELS = ("workers", "threads")
# A file names neither a program to run, nor a machine to connect to, nor a place outside of the data.
_OF_CALLERS = {"workers", "assets"}
# But a recipe may do without assets.
_WITHOUT = ("assets", "none")
# Sequences had other scenes before, which are not those of the same options now.
_SCENES = 2
# Checksums use the first name of an option, so that those in headers of older weights still match their recipes.
_FIRST_NAMES = {"noise_seeds": "realisations"}


@dataclass(frozen=True)
class Rendering:
    """The sequences from one run of ``mcdenoise generate``.

    Args:
        where: file and table of the recipe, for messages.
        options: options of the command, with underscores.
        clean: whether remaining noise is removed from the references, see :func:`clean_references`.
        name: of the folder; empty for one that the options name.
    """

    where: str
    options: Mapping[str, Any]
    clean: bool
    name: str = ""

    def folder(self, data: Path) -> Path:
        """The folder to render to; without a name, the same options have the same folder in every recipe."""
        return data / (self.name or self.sha256[:16])

    @property
    def sha256(self) -> str:
        """Checksum of everything that determines the rendered images."""
        # The number of processes does not change the pixels.
        options = {key: value for key, value in self.options.items() if key not in _NO_PIXELS}
        options |= {} if options.get("takes") else {"scenes": _SCENES}
        return _digest({_FIRST_NAMES.get(key, key): value for key, value in options.items()})

    def make(self, data: Path, generate: Callable[[], object]) -> list[Path]:
        """Render missing sequences, and clean the references if requested.

        Args:
            data: folder for the sequences of all recipes.
            generate: renders to :meth:`folder`, and keeps finished files there.

        Returns:
            Folders of the sequences.

        Raises:
            InputError: the sequences cannot be rendered, cleaned or written.
        """
        place = self.folder(data)
        finished = place / "finished.json"
        try:
            with locked(place):
                if not finished.exists():
                    generate()
                    write_text(finished, json.dumps(dict(self.options), indent=2) + "\n")
                sequences = find_shards(place) or sorted(path for path in place.iterdir() if path.is_dir())
                if self.clean:
                    out = place.with_name(f"{place.name}-clean")
                    sequences = [clean_references(sequence, out) for sequence in sequences]
        except OSError as error:
            reason = error.strerror or type(error).__name__
            raise InputError(f"{place}: cannot be rendered to ({reason}); check permissions and free space") from error
        return sequences


@dataclass(frozen=True)
class Run:
    """One training run of a recipe.

    Args:
        name: name of its folder; empty for the only run of a recipe, which uses the recipe's folder.
        config: configuration of the run.
        expected: final SMAPE, and by how much a run may exceed it; ``None`` if the recipe does not state it.
        sha256: checksum of everything that determines the result.
    """

    name: str
    config: TrainConfig
    expected: tuple[float, float] | None
    sha256: str


@dataclass(frozen=True)
class Recipe:
    """The contents of a recipe.

    Args:
        runs: the runs, at least one.
        data: sequences to train on.
        validation: sequences that are used for validation only.
        credits: authors and licences of the training scenes.
    """

    runs: list[Run]
    data: list[Rendering]
    validation: list[Rendering]
    credits: str

    @staticmethod
    def read(path: Path, options: Collection[str]) -> Recipe:
        """Read a recipe, and check that its names exist.

        Args:
            path: the file.
            options: valid keys of a data table.

        Raises:
            InputError: the file cannot be read, a key is unknown, or a value is invalid.
        """
        content = _parse(path)
        kinds = {field.name: type(field.default) for field in fields(TrainConfig)}
        common = _checked(f"{path}: [train]", content.get("train", {}), {**kinds, "credits": str})
        made = {name: _renderings(path, name, content.get(name, []), options) for name in ("data", "validation")}
        if not made["data"]:
            raise InputError(f"{path}: expected at least one table [[data]] to render and train on, found none")
        rendered = [[(r.sha256, r.clean) for r in each] for each in made.values()]
        runs = []
        for where, own in _run_tables(path, content, kinds):
            name, expected = own.pop("name", ""), _expected(where, own.pop("expected", {}))
            settings = common | own
            sha256 = _digest([settings or None, *rendered])
            config = TrainConfig(**{key: value for key, value in settings.items() if key != "credits"})
            with naming(where):
                for key in ("model", "start_from"):
                    check_names_no_code(getattr(config, key), key)
                # Check settings before hours of rendering.
                check_config(config, 1)
                create_model(config.model, **config.model_settings)
            runs.append(Run(name, config, expected, sha256))
        if any(rendering.clean for each in made.values() for rendering in each):
            with naming(str(path)):
                create_model("oidn")
        return Recipe(runs, made["data"], made["validation"], common.get("credits", ""))

    def chosen(self, names: Collection[str]) -> list[Run]:
        """Select runs by name, in the order of the recipe; all if no name is given.

        Raises:
            InputError: the recipe has no run of this name.
        """
        known = [run.name for run in self.runs]
        for name in names:
            if name not in known:
                found = ", ".join(filter(None, known)) or "a single run without a name"
                raise InputError(f"--runs: expected names of the recipe's runs ({found}), found '{name}'")
        return [run for run in self.runs if not names or run.name in names]


def _run_tables(path: Path, content: dict[str, Any], kinds: Mapping[str, type]) -> list[tuple[str, dict[str, Any]]]:
    """The location of each run in the recipe, and its settings that differ from the common ones."""
    tables = content.get("run", [])
    if not isinstance(tables, list):
        raise InputError(f"{path}: expected tables [[run]], found [run]")
    if not tables:
        return [(str(path), {"expected": content.get("expected", {})})]
    if "expected" in content:
        raise InputError(f"{path}: expected what is expected in each [[run]], found [expected]")
    found: list[tuple[str, dict[str, Any]]] = []
    for number, table in enumerate(tables, start=1):
        where = f"{path}: [[run]] {number}"
        own = _checked(where, table, {**kinds, "name": str, "expected": dict, "seeds": list})
        name, seeds = own.get("name", ""), own.pop("seeds", None)
        if seeds is not None and not (seeds and all(type(seed) is int for seed in seeds)):
            raise InputError(f"{where}: seeds: expected a list of whole numbers, found {seeds}")
        every = [own] if seeds is None else [{**own, "name": f"{name}-{each}", "seed": each} for each in seeds]
        if not _NAME.fullmatch(name):
            raise InputError(f"{where}: name: expected letters, digits, '+', '-' and '_', found '{name}'")
        for each in every:
            if each["name"] in (other["name"] for _, other in found):
                raise InputError(f"{where}: name: expected each name once, found '{each['name']}' again")
            found.append((where, each))
    return found


def _expected(where: str, table: Any) -> tuple[float, float] | None:
    expected = _checked(f"{where}: [expected]", table, _BOUND)
    if expected and expected.keys() != _BOUND.keys():
        raise InputError(f"{where}: [expected]: expected smape and tolerance, found {', '.join(expected)} alone")
    return (float(expected["smape"]), float(expected["tolerance"])) if expected else None


@contextmanager
def naming(where: str) -> Iterator[None]:
    """Add the location in the recipe to errors."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {error}") from error


def _parse(path: Path) -> dict[str, Any]:
    try:
        content = tomllib.loads(read_text(path))
    except OSError as error:
        raise InputError(f"{path}: expected a recipe, found no file that can be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: expected a recipe in TOML, found: {error}") from error
    _check_keys(str(path), content, _TABLES)
    return content


def _renderings(path: Path, name: str, tables: Any, options: Collection[str]) -> list[Rendering]:
    if not isinstance(tables, list):
        raise InputError(f"{path}: expected tables [[{name}]], found [{name}]")
    made = []
    for number, table in enumerate(tables, start=1):
        where = f"{path}: [[{name}]] {number}"
        own = dict([item for item in table.items() if item != _WITHOUT]) if isinstance(table, dict) else table
        _check_keys(where, own, {*options, *_OWN} - _OF_CALLERS)
        own = _checked(where, {key: table[key] for key in _OWN.keys() & table.keys()}, _OWN)
        name = own.get("folder", "")
        if name and not _NAME.fullmatch(name):
            raise InputError(f"{where}: folder: expected letters, digits, '+', '-' and '_', found '{name}'")
        rest = {key: value for key, value in table.items() if key not in _OWN}
        made.append(Rendering(where, rest, own.get(_CLEAN, False), name))
    return made


def _checked(where: str, table: Any, kinds: Mapping[str, type]) -> dict[str, Any]:
    """Check the keys and the types of the values of a table."""
    _check_keys(where, table, kinds)
    for key, value in table.items():
        if type(value) is not kinds[key] and (type(value), kinds[key]) != (int, float):
            raise InputError(f"{where}: {key}: expected a value of type {kinds[key].__name__}, found {value!r}")
    return dict(table)


def _check_keys(where: str, table: Any, known: Collection[str]) -> None:
    if not isinstance(table, dict):
        raise InputError(f"{where}: expected a table, found {table!r}")
    for key in table:
        if key not in known:
            raise InputError(f"{where}: unknown key '{key}'; known are {', '.join(sorted(known))}")


def _digest(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()
