"""The zoo's register: names to constructors, and where a model that is not in it comes from."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import inspect
import pkgutil
from collections.abc import Callable
from dataclasses import dataclass
from fnmatch import fnmatch
from importlib.metadata import entry_points
from typing import Any, Literal, get_args

from mcdenoise.errors import InputError
from mcdenoise.models._adapter import as_model
from mcdenoise.models._defaults import plain_defaults
from mcdenoise.models._interface import Model
from mcdenoise.own import in_one_line, load_own

GROUP = "mcdenoise.models"

# What makes a model's image, in the order in which they are listed: predicted kernels; predicted pixels; bilateral
# grids; a network with a memory of its own; a filter without weights; another denoiser; or nobody has said.
Kind = Literal["kernel", "pixel", "grid", "recurrent", "filter", "peer", "other"]


@dataclass(frozen=True)
class Entry:
    """A registered model.

    Args:
        construct: makes it, with fresh weights.
        settings: what ``construct`` is given under this name.
        description: one line.
        kind: what makes its image.
        paper: its authors and year; empty where there is none.
        requires: the optional package that it cannot be made without; empty if there is none.
    """

    construct: Callable[..., Any]
    settings: dict[str, Any]
    description: str
    kind: Kind = "other"
    paper: str = ""
    requires: str = ""

    @property
    def installed(self) -> bool:
        """Whether what it requires is installed."""
        return not self.requires or importlib.util.find_spec(self.requires) is not None

    @property
    def architecture(self) -> dict[str, Any]:
        """The settings that weights are of, with their defaults: the constructor's positional arguments."""
        parameters = inspect.signature(self.construct).parameters.values()
        own = {each.name: each.default for each in parameters if each.kind is each.POSITIONAL_OR_KEYWORD}
        return own | {name: value for name, value in self.settings.items() if name in own}


_MODELS: dict[str, Entry] = {}


def register_model(
    name: str, description: str = "", *, kind: Kind = "other", paper: str = "", requires: str = "", **settings: Any
) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator that enters a model's constructor under ``name``.

    The constructor's positional arguments are what weights are of (sizes), its keyword-only ones are not (how histories
    are kept, what is skipped).

    Args:
        name: in the register.
        description: one line; the first one of the constructor's docstring by default.
        kind: what makes its image.
        paper: its authors and year, such as "Schied et al. 2017".
        requires: the optional package that it cannot be made without.
        settings: for the constructor, under this name.

    Raises:
        ValueError: the name is taken, or there is no such kind.
    """
    if kind not in get_args(Kind):
        raise ValueError(f"kind: expected one of {', '.join(get_args(Kind))}, found '{kind}'")

    def enter(constructor: Callable[..., Any]) -> Callable[..., Any]:
        if name in _MODELS:
            raise ValueError(f"model '{name}' is registered twice")
        about = description or (constructor.__doc__ or "").strip().partition("\n")[0]
        _MODELS[name] = Entry(constructor, settings, about, kind, paper, requires)
        return constructor

    return enter


def list_models(pattern: str = "*") -> list[str]:
    """Names of all registered models that match a shell-style pattern, sorted; those of installed packages as well."""
    _import_pages()
    return sorted(name for name in {*_MODELS, *_installed()} if fnmatch(name, pattern))


def find_model(name: str) -> Entry:
    """The entry of a registered model, one that an installed package offers, or somebody's own.

    Args:
        name: of :func:`list_models`; or ``path/to/file.py:factory`` or ``package.module:factory``, whose factory is
            called for the model.

    Raises:
        InputError: there is no such model, file, module or factory.
    """
    _import_pages()
    if name in _MODELS:
        return _MODELS[name]
    if name in _installed():
        return _of_factory(name, _loaded_entry_point(name))
    if ":" in name:
        return _of_factory(name, load_own(name, "model", "factory")[0])
    raise InputError(
        f"model '{name}': expected one of {', '.join(list_models())}, or path/to/file.py:factory, or "
        "package.module:factory; see `mcdenoise models`"
    )


def build_model(name: str, **settings: Any) -> Model:
    """A model with fresh weights, float32 on the CPU whatever torch's defaults are.

    Raises:
        InputError: there is no such model, or it has no such setting.
    """
    with plain_defaults():
        return _build_model(name, settings)


def _build_model(name: str, settings: dict[str, Any]) -> Model:
    entry = find_model(name)
    try:
        inspect.signature(entry.construct).bind(**{**entry.settings, **settings})
    except TypeError as error:
        known = ", ".join(inspect.signature(entry.construct).parameters) or "no settings"
        raise InputError(f"model '{name}': {error}; it takes {known}") from error
    if ":" not in name:
        return as_model(entry.construct(**{**entry.settings, **settings}))
    try:
        return as_model(entry.construct(**settings))
    except InputError as error:
        if not str(error).startswith("model: "):
            raise
        raise InputError(f"model '{name}': {str(error).removeprefix('model: ')}") from error
    except Exception as error:
        raise InputError(f"model '{name}': the factory fails: {in_one_line(error)}") from error


def _of_factory(name: str, factory: Any) -> Entry:
    if not callable(factory):
        raise InputError(f"model '{name}': expected a factory that can be called, found {type(factory).__name__}")
    return Entry(factory, {}, (factory.__doc__ or "").strip().partition("\n")[0])


@functools.cache
def _import_pages() -> None:
    """Import every page of this room, so that a model is registered by its page alone."""
    room = __name__.rpartition(".")[0]
    for page in pkgutil.iter_modules(importlib.import_module(room).__path__):
        if not page.name.startswith("_"):
            importlib.import_module(f"{room}.{page.name}")


@functools.cache
def _installed() -> dict[str, Any]:
    """Entry points of installed packages in the group ``mcdenoise.models``."""
    return {point.name: point for point in entry_points(group=GROUP)}


def _loaded_entry_point(name: str) -> Any:
    try:
        return _installed()[name].load()
    except (ImportError, AttributeError) as error:
        raise InputError(f"model '{name}': its package offers it and cannot load it: {error}") from error
