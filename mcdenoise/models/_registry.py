"""The register of models, and making them by name: those of the zoo, of installed packages, and a user's own."""

from __future__ import annotations

import functools
import importlib
import inspect
import pkgutil
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from fnmatch import fnmatch
from importlib.metadata import Distribution, EntryPoint, distributions
from types import BuiltinFunctionType
from typing import Any, Literal

from torch import nn

from mcdenoise.errors import InputError, check_choice, did_you_mean, in_one_line
from mcdenoise.models._defaults import outlined, plain_defaults, without_draws
from mcdenoise.models._interface import Model, Needs
from mcdenoise.models._wrapper import as_model
from mcdenoise.own import load_own, refused

GROUP = "mcdenoise.models"
_FACTORY = "expected a factory, a function without required arguments that returns a model"

# How a model makes its image, in listing order: predicted kernels; predicted pixels; bilateral grids; a recurrent
# network; a filter without weights; another denoiser; or unspecified.
Kind = Literal["kernel", "pixel", "grid", "recurrent", "filter", "peer", "other"]


@dataclass(frozen=True)
class Entry:
    """A registered model.

    Args:
        construct: makes the model, with fresh weights.
        settings: arguments for ``construct`` under this name.
        description: one line.
        kind: how the model makes its image.
        paper: authors and year; empty if there is none.
    """

    construct: Callable[..., Any]
    settings: dict[str, Any]
    description: str
    kind: Kind = "other"
    paper: str = ""

    @property
    def of_zoo(self) -> bool:
        """Whether it is a model of this package."""
        return str(getattr(self.construct, "__module__", "")).startswith("mcdenoise.models.")

    @property
    def architecture(self) -> dict[str, Any]:
        """The settings that determine the weights, with their defaults: the constructor's positional arguments."""
        parameters = inspect.signature(self.construct).parameters.values()
        own = {each.name: each.default for each in parameters if each.kind is each.POSITIONAL_OR_KEYWORD}
        return own | {name: value for name, value in self.settings.items() if name in own}


MODELS: dict[str, Entry] = {}


def register_model(
    name: str, description: str = "", *, kind: Kind = "other", paper: str = "", **settings: Any
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator that registers a model's constructor under ``name``.

    The constructor's positional arguments determine the weights (sizes); its keyword-only arguments do not (history,
    skipping).

    Args:
        name: the registered name.
        description: one line; by default the first line of the constructor's docstring.
        kind: how the model makes its image.
        paper: authors and year, such as "Schied et al. 2017".
        settings: arguments for the constructor under this name.

    Raises:
        ValueError: the name is taken, or the kind is unknown.
    """
    check_choice("kind", kind, Kind)

    def enter(constructor: Callable[..., Any]) -> Callable[..., Any]:
        if name in MODELS:
            raise ValueError(f"model '{name}' is registered twice")
        about = description or (constructor.__doc__ or "").strip().partition("\n")[0]
        MODELS[name] = Entry(constructor, settings, about, kind, paper)
        return constructor

    return enter


def list_models(pattern: str = "*") -> list[str]:
    """Sorted names of all registered models that match a shell-style pattern, including those of installed packages."""
    _import_pages()
    return sorted(name for name in {*MODELS, *_offered()[0]} if fnmatch(name, pattern))


def troubles() -> list[str]:
    """One line for each installed package whose offer of models cannot be read, or is of a name that is taken."""
    _import_pages()
    offers, wrong = _offered()
    taken = [
        f"{_named(point.dist)}: expected a name for its model that is not taken, found '{name}', which is not used"
        for name, point in offers.items()
        if name in MODELS and MODELS[name].of_zoo
    ]
    return taken + wrong


def find_model(name: str) -> Entry:
    """The entry of a registered model, of one that an installed package offers, or of a user's own model.

    Args:
        name: one of :func:`list_models`, or ``path/to/file.py:factory`` or ``package.module:factory``; the factory is
            called to make the model.

    Raises:
        InputError: there is no such model, file, module or factory.
    """
    _import_pages()
    if name in MODELS:
        return MODELS[name]
    if point := _offered()[0].get(name):
        with refused(f"model '{name}': the package {_named(point.dist)} offers it and cannot load it"):
            return _of_factory(name, point.load())
    known = list_models()
    if (match := re.fullmatch(r"([^()]+)\((.*)\)", name)) and (match[1] in known or ":" in match[1]):
        # On the command line, texts have no quotes.
        settings = re.sub(r"=\s*(?!(?:True|False|None)\b)([A-Za-z]\w*)", r'="\1"', match[2])
        raise InputError(
            f"model '{name}': expected a name without settings, found some in parentheses; in Python settings are "
            f'keyword arguments: Denoiser("{match[1]}", {settings})'
        )
    if ":" in name or name.endswith(".py"):
        return _of_factory(name, load_own(name, "model", "factory")[0])
    if near := did_you_mean(name, known):
        raise InputError(f"model '{name}': found no model of this name; {near} `mcdenoise models` lists all models")
    raise InputError(
        f"model '{name}': expected one of {', '.join(known)}, or path/to/file.py:factory, or "
        "package.module:factory; see `mcdenoise models`"
    )


def needs_of_models() -> dict[str, Needs]:
    """The needs of every registered model that can be made, by sorted name."""
    found = {}
    # Constructing a network draws random numbers: keep the caller's generator unchanged.
    with without_draws():
        for name in list_models():
            # A model of an installed package may raise anything; such a model is left out.
            with suppress(InputError), refused(name):
                found[name] = build_model(name).needs
    return found


def build_model(name: str, **settings: Any) -> Model:
    """Make a model with fresh weights, in float32 on the CPU whatever torch's defaults are.

    Raises:
        InputError: there is no such model, or it has no such setting.
    """
    with plain_defaults():
        return _build_model(name, settings)


def outline_model(name: str, settings: dict[str, Any]) -> Model:
    """A model of the zoo whose tensors have shapes and take no memory; see :func:`build_model` for the errors."""
    with outlined():
        return _build_model(name, settings)


def _build_model(name: str, settings: dict[str, Any]) -> Model:
    entry = find_model(name)
    arguments = {**entry.settings, **settings}
    try:
        parameters = inspect.signature(entry.construct).parameters
    except (TypeError, ValueError) as error:
        raise InputError(f"model '{name}': {_FACTORY}, found one without a signature: {error}") from error
    try:
        inspect.signature(entry.construct).bind(**arguments)
    except TypeError as error:
        required = [each.name for each in parameters.values() if _is_required(each) and each.name not in settings]
        if ":" in name and required:
            raise InputError(
                f"model '{name}': {_FACTORY}, found one that requires {', '.join(required)}; if it is the model, add "
                f"a function that returns it, or else default values, or settings: '{name}({required[0]}=...)'"
            ) from error
        raise InputError(f"model '{name}': {error}; it takes {', '.join(parameters) or 'no settings'}") from error
    for key, value in arguments.items() if entry.of_zoo else ():
        # Any text counts as true.
        if isinstance(getattr(parameters.get(key), "default", None), bool) and isinstance(value, str):
            raise InputError(f"model '{name}': {key}: expected True or False, found '{value}'")
        # Layers without features are possible in torch.
        if key.endswith("width") and isinstance(value, int) and value < 1:
            raise InputError(f"model '{name}': {key}: expected at least 1, found {value}")
    given = ", ".join(f"{key}={value}" for key, value in settings.items())
    reason = f"expected settings that fit, found {given or 'none'}" if entry.of_zoo else "the factory fails"
    try:
        with refused(f"model '{name}': {reason}"):
            return as_model(entry.construct(**arguments))
    except InputError as error:
        if not str(error).startswith("model: "):
            raise
        raise InputError(f"model '{name}': {str(error).removeprefix('model: ')}") from error


def _is_required(parameter: inspect.Parameter) -> bool:
    various = (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
    return parameter.default is parameter.empty and parameter.kind not in various


def _of_factory(name: str, factory: Any) -> Entry:
    # A module can be called, but with images; a function of the interpreter returns no model.
    if isinstance(factory, nn.Module | BuiltinFunctionType) or not callable(factory):
        found = type(factory).__name__
        raise InputError(f"model '{name}': {_FACTORY}, found an object of type {found}; add a function that returns it")
    return Entry(factory, {}, (factory.__doc__ or "").strip().partition("\n")[0])


@functools.cache
def _import_pages() -> None:
    """Import every module of this package, so that a model is registered by its file alone."""
    room = __name__.rpartition(".")[0]
    for page in pkgutil.iter_modules(importlib.import_module(room).__path__):
        if not page.name.startswith("_"):
            importlib.import_module(f"{room}.{page.name}")


@functools.cache
def _offered() -> tuple[dict[str, EntryPoint], list[str]]:
    """The entry points of installed packages in the group ``mcdenoise.models`` by name, and what is wrong with them."""
    offers: dict[str, EntryPoint] = {}
    wrong: list[str] = []
    for package in distributions():
        # A package that cannot be read is in the way of no other, so each is read by itself.
        try:
            points = [point for point in package.entry_points if point.group == GROUP]
        except Exception as error:
            wrong.append(f"{_named(package)}: entry points cannot be read: {in_one_line(error)}")
            continue
        for point in points:
            # If there are two versions of a package, the one that Python finds first counts.
            offers.setdefault(point.name, point)
    return offers, wrong


def _named(package: Distribution | None) -> str:
    """The name of an installed package, or the place of one whose metadata is damaged."""
    try:
        name = None if package is None else package.metadata["Name"]
    except Exception:
        name = None
    return str(name or getattr(package, "_path", "that"))
