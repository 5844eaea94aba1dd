"""The dispatch of all ops: which implementation runs.

An op is a page with a contract and a plain implementation in torch, which is the truth. Where a fast backend can run
and saves time, ``@op`` calls the function of the same name in the file of the same name in ``_numba/``. That function
takes the arguments of the op by position, and may return ``NotImplemented`` for arguments that it does not support.

- Fast backends have no derivatives: where some are asked for, plain torch runs, and its derivatives are torch's own.
- The plain implementation also runs under ``torch.func``, ``vmap`` and forward mode, and while a model is compiled or
  exported, so that a graph needs no numba.
- Under autocast nothing is rounded except where a contract says so: the plain implementation consists of products and
  sums in place of matrix products.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import warnings
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from mcdenoise.ops._backend import Backend, choose_backend
from mcdenoise.ops._check import check_shapes

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def op(
    *backends: Backend, check: Callable[..., object] | None = None, **layouts: str
) -> Callable[[Callable[_Arguments, _Result]], Callable[_Arguments, _Result]]:
    """Make an op of its plain implementation.

    Args:
        backends: names of its fast backends.
        check: takes some arguments of the op, by name, and raises for those that its contract refuses; run before any
            backend.
        layouts: axes of its tensors by name, see :func:`mcdenoise.ops._check.check_shapes`; checked first.
    """

    def decorate(plain: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
        parameters = inspect.signature(plain).parameters.values()
        names = [each.name for each in parameters]
        placed = [each.name for each in parameters if each.kind is each.POSITIONAL_OR_KEYWORD]
        defaults = {each.name: each.default for each in parameters if each.default is not inspect.Parameter.empty}
        page = plain.__module__.rpartition(".")[2]
        checked = [] if check is None else list(inspect.signature(check).parameters)

        @functools.wraps(plain)
        def dispatched(*arguments: _Arguments.args, **settings: _Arguments.kwargs) -> _Result:
            given = {**defaults, **dict(zip(placed, arguments, strict=False)), **settings}
            twice = settings.keys() & set(placed[: len(arguments)])
            if twice or len(given) != len(names) or len(arguments) > len(placed):
                # Python says which argument is missing, unknown or one too many.
                return plain(*arguments, **settings)
            check_shapes(**{name: (given[name], layout) for name, layout in layouts.items()})
            if check is not None:
                check(**{name: given[name] for name in checked})
            # The compiler traces no choice; its graph is that of the plain implementation.
            if torch.compiler.is_compiling():
                return plain(*arguments, **settings)
            tensors = [each for each in pytree.tree_leaves(given) if isinstance(each, Tensor)]
            if choose_backend(backends, tensors) == "numba":
                result = fast_form(page, plain.__name__)(*[given[name] for name in names])
                if result is not NotImplemented:
                    return cast(_Result, result)
            return plain(*arguments, **settings)

        dispatched.plain = plain  # type: ignore[attr-defined]
        dispatched.backends = ("torch", *backends)  # type: ignore[attr-defined]
        return dispatched

    return decorate


def made_of(
    inner: Callable[..., Any],
) -> Callable[[Callable[_Arguments, _Result]], Callable[_Arguments, _Result]]:
    """Say that a function spends its time in an op, so that it has the backends of that."""

    def decorate(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
        function.backends = backends_of(inner)  # type: ignore[attr-defined]
        return function

    return decorate


def plain(function: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """The plain implementation of an op."""
    found: Callable[_Arguments, _Result] = getattr(function, "plain", function)
    return found


def backends_of(function: Callable[..., Any]) -> tuple[Backend, ...]:
    """Names of the backends of an op, with plain torch."""
    found: tuple[Backend, ...] = getattr(function, "backends", ("torch",))
    return found


@functools.cache
def fast_form(page: str, name: str) -> Callable[..., Any]:
    """The compiled implementation of an op, or one that supports nothing if there is too little memory to load it."""
    try:
        form: Callable[..., Any] = getattr(importlib.import_module(f"mcdenoise.ops._numba.{page}"), name)
    except MemoryError:
        warnings.warn(f"{name}: too little memory for numba; plain torch is used, which is slower", stacklevel=3)
        return lambda *arguments: NotImplemented
    return form
