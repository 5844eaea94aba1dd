"""A decorator that changes nothing, until no page has it."""

from collections.abc import Callable
from typing import Any, TypeVar

_Function = TypeVar("_Function", bound=Callable[..., Any])


class _Form:
    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function

    def __call__(self, *arguments: Any) -> Any:
        return self._function(*arguments)

    def register_fake(self, fake: _Function) -> _Function:
        return fake


def custom_op(*_: Any, **__: Any) -> Callable[[Callable[..., Any]], _Form]:
    """Call the function as it is."""
    return _Form
