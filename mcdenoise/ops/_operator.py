"""``torch.library.custom_op`` for short processes: that imports torch's compiler when an operator is first called."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import torch

_Function = TypeVar("_Function", bound=Callable[..., Any])


class Operator:
    """An operator of torch with its registrations, as ``torch.library.custom_op`` returns it.

    Args:
        name: such as ``"mcdenoise::accumulate"``.
        function: computes it, returns no argument, and changes none that the schema does not say is changed.
        device_types: where, such as ``"cpu"``; everywhere by default.
        schema: its arguments and results.
    """

    def __init__(self, name: str, function: Callable[..., Any], device_types: str | None, schema: str) -> None:
        self._name = name
        # The tag says that compiled graphs may hold it.
        torch.library.define(name, schema, tags=torch.Tag.pt2_compliant_tag)
        torch.library.impl(name, device_types or "default")(function)
        namespace, _, own = name.partition("::")
        self._overload = getattr(getattr(torch.ops, namespace), own).default

    def __call__(self, *arguments: Any) -> Any:
        """Run the operator."""
        return self._overload(*arguments)

    def register_fake(self, function: _Function) -> _Function:
        """See ``torch.library.register_fake``."""
        torch.library.register_fake(self._name, function)
        return function

    def register_autograd(self, backward: Callable[..., Any], *, setup_context: Callable[..., None]) -> None:
        """See ``torch.library.register_autograd``."""
        torch.library.register_autograd(self._name, backward, setup_context=setup_context)


def custom_op(name: str, *, schema: str, device_types: str | None = None) -> Callable[[Callable[..., Any]], Operator]:
    """Make an :class:`Operator` of a function."""
    return lambda function: Operator(name, function, device_types, schema)
