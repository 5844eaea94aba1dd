"""Interactive Monte Carlo denoising you can open up: differentiable operators, and denoisers assembled from them."""

from __future__ import annotations

import importlib

# `python -m mcdenoise` runs this file while modules of the working folder still come first, so it imports no `typing`.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from mcdenoise import ops
    from mcdenoise.denoiser import Denoiser, denoise
    from mcdenoise.errors import InputError
    from mcdenoise.frame import Frame
    from mcdenoise.models import create_model, list_models

__all__ = ["Denoiser", "Frame", "InputError", "create_model", "denoise", "list_models", "ops"]

_PAGES = {
    "Denoiser": "denoiser",
    "Frame": "frame",
    "InputError": "errors",
    "create_model": "models",
    "denoise": "denoiser",
    "list_models": "models",
}


def __getattr__(name: str) -> Any:
    # Import torch only when it is used: a command has to decide first how threads wait, and commands without torch
    # start at once.
    if name == "ops":
        return importlib.import_module("mcdenoise.ops")
    if name == "__version__":
        # Looking up the version takes longer than everything else here.
        return importlib.import_module("importlib.metadata").version("mcdenoise")
    if name not in _PAGES:
        raise AttributeError(f"module 'mcdenoise' has no attribute '{name}'")
    return getattr(importlib.import_module(f"mcdenoise.{_PAGES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
