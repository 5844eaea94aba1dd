"""Module twins: an op with its settings stored."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from torch import nn


def module_of(function: Callable[..., Any], check: Callable[..., None] | None = None) -> type[nn.Module]:
    """``KernelConv`` of ``kernel_conv``: a module that stores the keyword arguments and calls the function with them.

    Args:
        function: its keyword-only arguments become those of the class, in order and with their defaults.
        check: takes the settings by name, and raises for those that the function would refuse.
    """
    parameters = list(inspect.signature(function).parameters.values())
    settings = [each for each in parameters if each.kind is inspect.Parameter.KEYWORD_ONLY]
    signature = inspect.Signature([each.replace(kind=inspect.Parameter.POSITIONAL_OR_KEYWORD) for each in settings])

    def __init__(self: nn.Module, *given: Any, **named: Any) -> None:
        nn.Module.__init__(self)
        bound = signature.bind(*given, **named)
        bound.apply_defaults()
        if check is not None:
            check(**bound.arguments)
        for setting, value in bound.arguments.items():
            setattr(self, setting, value)

    def forward(self: nn.Module, *arguments: Any, **named: Any) -> Any:
        return function(*arguments, **named, **{each.name: getattr(self, each.name) for each in settings})

    forward.__doc__ = f"See :func:`mcdenoise.ops.{function.__name__}`."
    return type(
        function.__name__.title().replace("_", ""),
        (nn.Module,),
        {
            "__doc__": f":func:`mcdenoise.ops.{function.__name__}` with its settings stored.",
            "__module__": function.__module__,
            "__signature__": signature,
            "__init__": __init__,
            "forward": forward,
        },
    )
