"""The zoo's register: names to constructors."""

from __future__ import annotations

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
    return _MODELS[name](**settings)


def describe_model(name: str) -> str:
    """The first line of the docstring of a registered model's constructor."""
    return (_MODELS[name].__doc__ or "").strip().partition("\n")[0]
