"""The zoo's register: names to constructors."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from fnmatch import fnmatch
from typing import Any

from torch import nn

from mcdenoise.errors import InputError

_MODELS: dict[str, Callable[..., nn.Module]] = {}


def register_model(name: str) -> Callable[[Callable[..., nn.Module]], Callable[..., nn.Module]]:
    """Decorator that enters a model's constructor under ``name``."""

    def enter(constructor: Callable[..., nn.Module]) -> Callable[..., nn.Module]:
        if name in _MODELS:
            raise ValueError(f"model '{name}' is registered twice")
        _MODELS[name] = constructor
        return constructor

    return enter


def list_models(pattern: str = "*") -> list[str]:
    """Names of all registered models that match a shell-style pattern, sorted."""
    return sorted(name for name in _MODELS if fnmatch(name, pattern))


def build_model(name: str, **settings: Any) -> nn.Module:
    """A registered model with fresh weights."""
    if name not in _MODELS:
        raise InputError(f"model '{name}': expected one of {', '.join(list_models())}; see `mcdenoise models`")
    model = _MODELS[name](**settings)
    # What weights are saved with.
    model.settings = complete_settings(name, settings)  # type: ignore[assignment]
    return model


def complete_settings(name: str, settings: dict[str, Any]) -> dict[str, Any]:
    """The settings of a registered model's constructor, those that are not given at their defaults."""
    return {
        **{key: value for key, value in _arguments(name).items() if value is not inspect.Parameter.empty},
        **settings,
    }


def missing_settings(name: str, settings: dict[str, Any]) -> list[str]:
    """Names of the constructor's arguments that are not among the settings."""
    return [argument for argument in _arguments(name) if argument not in settings]


def _arguments(name: str) -> dict[str, Any]:
    """Name and default of what a constructor takes by name."""
    parameters = inspect.signature(_MODELS[name]).parameters.values()
    named = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    return {parameter.name: parameter.default for parameter in parameters if parameter.kind in named}


def describe_model(name: str) -> str:
    """The first line of the docstring of a registered model's constructor."""
    return (_MODELS[name].__doc__ or "").strip().partition("\n")[0]
