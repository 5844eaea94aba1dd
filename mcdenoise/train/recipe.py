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
import tomllib
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import GenericAlias
from typing import Annotated, Any, Literal, get_type_hints

import msgspec
from msgspec import UNSET, Meta

from mcdenoise.data.files import held, write_text, writing
from mcdenoise.data.sequences import parse_frames
from mcdenoise.data.shards import find_shards
from mcdenoise.errors import InputError, naming
from mcdenoise.methods import check_names_no_code
from mcdenoise.models import create_model
from mcdenoise.reading import read_text
from mcdenoise.train.config import TrainConfig, check_config, told
from mcdenoise.train.references import clean_references

_CLEAN = "clean_references"
# A run's name is also the name of its folder.
_Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9+_-]{1,64}$")]
# Keys of a table of data that are no options of `mcdenoise generate`.
_OWN = {"folder": _Name, _CLEAN: bool}
_NO_PIXELS = ("workers", "threads")
# A file names neither a program to run, nor a machine to connect to, nor a place outside of the data.
_OF_CALLERS = {"workers", "assets"}
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
        with held(place, "rendering", wait=True), writing(place):
            if finished.exists() and self.name:
                self._check_finished(finished)
            # A damaged one is to be removed, and rendered again.
            if not finished.exists() or len(_sequences(place)) < len(parse_frames(self.options.get("seeds", "0"))):
                generate()
                write_text(finished, json.dumps(dict(self.options), indent=2) + "\n")
            sequences = _sequences(place)
            if self.clean:
                out = place.with_name(f"{place.name}-clean")
                sequences = [clean_references(sequence, out) for sequence in sequences]
        return sequences

    def _check_finished(self, finished: Path) -> None:
        """Refuse a folder of this name that was rendered with other options."""
        try:
            found = json.loads(read_text(finished))
            same = replace(self, options=found).sha256 == self.sha256
        except (OSError, ValueError, AttributeError, RecursionError):
            found, same = "none that can be read", False
        if not same:
            raise InputError(
                f"{self.where}: expected {finished.parent} rendered with {dict(self.options)}, found {found}; choose "
                f"another folder, or remove {finished.name} to add to what is in it"
            )


def _sequences(folder: Path) -> list[Path]:
    """The takes or sequences in a folder."""
    return find_shards(folder) or sorted(path for path in folder.iterdir() if path.is_dir())


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
        content = _parsed(path, options)
        common = content.get("train", {})
        made = {name: _renderings(path, name, content.get(name, [])) for name in ("data", "validation")}
        rendered = [[(r.sha256, r.clean) for r in each] for each in made.values()]
        runs = []
        for where, own in _run_tables(path, content):
            name, bound = own.pop("name", ""), own.pop("expected", None)
            settings = common | own
            sha256 = _digest([settings or None, *rendered])
            config = TrainConfig(**{key: value for key, value in settings.items() if key != "credits"})
            with naming(where):
                for key in ("model", "start_from"):
                    check_names_no_code(getattr(config, key), key)
                # Check settings before hours of rendering.
                check_config(config, 1)
                create_model(config.model, **config.model_settings)
            expected = (float(bound["smape"]), float(bound["tolerance"])) if bound else None
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


def _run_tables(path: Path, content: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """The location of each run in the recipe, and its settings that differ from the common ones."""
    if not content.get("run"):
        return [(str(path), {"expected": content.get("expected")})]
    if "expected" in content:
        raise InputError(f"{path}: expected what is expected in each [[run]], found [expected]")
    found: dict[str, tuple[str, dict[str, Any]]] = {}
    for number, table in enumerate(content["run"], start=1):
        where, own = f"{path}: [[run]] {number}", {key: value for key, value in table.items() if key != "seeds"}
        every = [{**own, "name": f"{own['name']}-{seed}", "seed": seed} for seed in table.get("seeds", [])] or [own]
        for each in every:
            if each["name"] in found:
                raise InputError(f"{where}: name: expected each name once, found '{each['name']}' again")
            found[each["name"]] = where, each
    return list(found.values())


def _parsed(path: Path, options: Collection[str]) -> dict[str, Any]:
    """The tables of a recipe, with known keys and values of the right types only."""
    kinds = get_type_hints(TrainConfig, include_extras=True)
    settings = [(name, kind, UNSET) for name, kind in kinds.items()]
    expected = _table({"smape": float, "tolerance": float})
    run = _table({"name": _Name}, *settings, ("expected", expected, UNSET), ("seeds", _some(int), UNSET))
    # A recipe may do without assets.
    chosen = dict.fromkeys({*options} - _OF_CALLERS, Any) | {"assets": Literal["none"]} | _OWN
    data = _table({}, *((name, kind, UNSET) for name, kind in chosen.items()))
    file = _table(
        {"data": _some(data)},
        ("train", _table({}, *settings, ("credits", str, UNSET)), UNSET),
        ("validation", _some(data, 0), UNSET),
        ("expected", expected, UNSET),
        ("run", _some(run, 0), UNSET),
    )
    try:
        content = tomllib.loads(read_text(path))
        msgspec.convert(content, file)
    except OSError as error:
        raise InputError(f"{path}: expected a recipe, found no file that can be read ({error.strerror})") from error
    except msgspec.ValidationError as error:
        kinds = chosen if any(f"$.{each}[" in str(error) for each in ("data", "validation")) else kinds
        raise InputError(f"{path}: {told(error, kinds)}") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: expected a recipe in TOML, found: {error}") from error
    return content


def _table(required: Mapping[str, Any], *optional: tuple[str, Any, Any]) -> Any:
    return msgspec.defstruct("Table", [*required.items(), *optional], forbid_unknown_fields=True)


def _some(kind: Any, least: int = 1) -> Any:
    """The type of a list with as many elements at least."""
    return Annotated[GenericAlias(list, kind), Meta(min_length=least)]


def _renderings(path: Path, name: str, tables: list[dict[str, Any]]) -> list[Rendering]:
    made = []
    for number, table in enumerate(tables, start=1):
        options = {key: value for key, value in table.items() if key not in _OWN}
        about = table.get(_CLEAN, False), table.get("folder", "")
        made.append(Rendering(f"{path}: [[{name}]] {number}", options, *about))
    return made


def _digest(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()
