"""Checks of a denoiser's arguments."""

from __future__ import annotations

import inspect
import reprlib
from collections.abc import Collection, Iterable, Sequence

import torch

from mcdenoise.errors import InputError, did_you_mean, first_line
from mcdenoise.models._registry import find_model


def check_settings(model: object, given: Iterable[str], *, of: type, also: Collection[str] = ()) -> None:
    """Refuse an argument by its name if nothing takes it; its value, which may be a large array, is not shown.

    Args:
        model: see :class:`Denoiser`. The settings of a model by the user are checked when it is created.
        given: names of arguments that should be settings of the model.
        of: the class that takes them, a denoiser.
        also: names of buffers and arguments that the caller takes, too.
    """
    settings: Sequence[str] = ()
    if isinstance(model, str):
        if ":" in model:
            return
        parameters = inspect.signature(find_model(model).construct).parameters
        if any(each.kind is each.VAR_KEYWORD for each in parameters.values()):
            return
        settings = list(parameters)
    arguments = inspect.signature(of).parameters.keys() - {"settings"}
    places = [*(["a buffer"] if also else []), "an argument of Denoiser"]
    places += [f"a setting of model '{model}' ({', '.join(settings)})"] if settings else []
    for name in given:
        if name not in settings and name not in arguments:
            near = did_you_mean(name, {*also, *arguments, *settings})
            raise InputError(
                f"argument '{name}': expected {' or '.join(places)}, found none of this name{near and '; '}{near}"
            )


def check_kind(name: str, value: object, kinds: tuple[type, ...], expected: str) -> None:
    """Refuse an argument of another type."""
    # Python counts True and False as integers; here they are not.
    if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
        raise InputError(f"{name}: expected {expected}, found {type(value).__name__} {reprlib.repr(value)}")


def usable_device(device: torch.device | str) -> torch.device:
    """The device, if torch can use it."""
    try:
        device = torch.device(device)
        torch.zeros((), device=device).item()
    except (RuntimeError, AssertionError, ImportError, TypeError) as error:
        raise InputError(f"device '{device}': expected one that torch can use, found: {first_line(error)}") from error
    return device
