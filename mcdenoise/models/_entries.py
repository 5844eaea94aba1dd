"""The entries of the register of the zoo: each method's page makes its own."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from mcdenoise.errors import check_choice

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
