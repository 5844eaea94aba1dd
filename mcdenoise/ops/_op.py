"""The dispatch of all ops: which implementation runs, and how it is differentiated.

An op is a page with a contract and a reference implementation in torch, which is the truth. Where a fast backend can
run and saves time, ``@op`` calls the function of the same name in the file of the same name in ``_numba/``. That
function takes the arguments of the op by position, and may return ``NotImplemented`` for arguments that it does not
support.

- Derivatives: a fast backend ``NAME`` beside which there is ``NAME_gradients`` is an operator with derivatives; or it
  calls ``NAME_gradients.operator``, which has them, and whose arguments ``NAME_gradients.adapted(plain)`` takes. Those
  are differentiated again by way of the reference. Any other is chosen only where no derivatives are asked for.
- Under ``torch.func``, ``vmap`` and forward mode the reference runs: no fast backend has rules for them.
- While a model is exported the reference runs, so that the exported graph does not need numba.
- Under autocast nothing is rounded except where a contract says so: the reference consists of products and sums in
  place of matrix products.
"""

from __future__ import annotations

import functools
import importlib
import inspect
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, ParamSpec, TypeVar, cast

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from mcdenoise.ops._backend import Backend, choose_backend
from mcdenoise.ops._operator import Operator

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")

# The fast backends that have been loaded, by backend and op.
_loaded: dict[tuple[str, str], Callable[..., Any]] = {}
# Torch takes the derivatives of an operator once. Loading one may load another.
_loading = threading.RLock()


def op(
    *backends: Backend, check: Callable[..., None] | None = None, differentiable: bool = False
) -> Callable[[Callable[_Arguments, _Result]], Callable[_Arguments, _Result]]:
    """Make an op of its reference implementation.

    Args:
        backends: names of its fast backends.
        check: takes the arguments of the op, and raises for those that its contract refuses; run before any backend.
        differentiable: whether the fast backends have derivatives.
    """
    of_these = backends if differentiable else ()

    def decorate(plain: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
        parameters = inspect.signature(plain).parameters.values()
        names = [parameter.name for parameter in parameters]
        defaults = {each.name: each.default for each in parameters if each.default is not inspect.Parameter.empty}
        page = plain.__module__.rpartition(".")[2]

        @functools.wraps(plain)
        def dispatched(*arguments: _Arguments.args, **settings: _Arguments.kwargs) -> _Result:
            if check is not None:
                check(*arguments, **settings)
            tensors = list(_tensors((*arguments, *settings.values())))
            chosen = choose_backend(backends, tensors, differentiable=of_these)
            if chosen != "torch":
                given = {**defaults, **dict(zip(names, arguments, strict=False)), **settings}
                _load(chosen, page, plain)
                result = _loaded[chosen, plain.__name__](*[given[name] for name in names])
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
    """The reference implementation of an op."""
    reference: Callable[_Arguments, _Result] = getattr(function, "plain", function)
    return reference


def backends_of(function: Callable[..., Any]) -> tuple[Backend, ...]:
    """Names of the backends of an op, with the reference."""
    found: tuple[Backend, ...] = getattr(function, "backends", ("torch",))
    return found


def _tensors(values: Iterable[Any]) -> Iterator[Tensor]:
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, (list, tuple)):
            yield from _tensors(value)


def _load(backend: str, page: str, plain: Callable[..., Any]) -> None:
    """Make sure that the fast backend of an op is there."""
    name = plain.__name__
    if (backend, name) in _loaded:
        return
    with _loading:
        if (backend, name) in _loaded:
            return
        try:
            module = importlib.import_module(f"mcdenoise.ops._{backend}.{page}")
        except MemoryError:
            warnings.warn(
                f"{name}: too little memory for {backend}; plain torch is used, which is slower", stacklevel=3
            )
            _loaded[backend, name] = lambda *arguments: NotImplemented
            return
        function: Callable[..., Any] = getattr(module, name)
        gradients = getattr(module, f"{name}_gradients", None)
        operator = getattr(gradients, "operator", function)
        if gradients is not None and isinstance(operator, Operator):
            adapted = getattr(gradients, "adapted", _by_position)
            _differentiate(operator, gradients, adapted(plain))
        _loaded[backend, name] = function


# The compiler calls this while it traces, and does not trace into it.
_load._dynamo_marked_constant = True  # type: ignore[attr-defined]


def _by_position(plain: Callable[..., Any]) -> Callable[..., Any]:
    """The reference implementation, which takes some of its arguments by name only."""
    names = list(inspect.signature(plain).parameters)
    return lambda *arguments: plain(**dict(zip(names, arguments, strict=True)))


def _differentiate(operator: Operator, gradients: Callable[..., Any], plain: Callable[..., Any]) -> None:
    """Give an operator its gradients, and gradients of those by way of the reference implementation.

    Of several results the first has derivatives, and the others have none; unless ``gradients.of_all`` says that all
    have them, and it takes a gradient of each.
    """
    of_all = getattr(gradients, "of_all", False)

    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor | tuple[Tensor, ...]) -> None:
        if isinstance(output, tuple) and not of_all:
            ctx.mark_non_differentiable(*output[1:])
        leaves, ctx.structure = pytree.tree_flatten(inputs)
        ctx.others = [None if isinstance(leaf, Tensor) else leaf for leaf in leaves]
        ctx.save_for_backward(*(leaf if isinstance(leaf, Tensor) else None for leaf in leaves))

    def first(*tensors: Tensor | None, arguments: Callable[..., Any]) -> tuple[Tensor, ...]:
        results: Any = plain(*arguments(tensors))
        results = (results,) if isinstance(results, Tensor) else tuple(results)
        return cast(tuple[Tensor, ...], results if of_all else results[:1])

    def backward(ctx: Any, *given: Any) -> tuple[Any, ...]:
        gradient = given if of_all else given[:1]
        tensors = ctx.saved_tensors
        needed = ctx.needs_input_grad

        def arguments(tensors: Sequence[Tensor | None]) -> Any:
            leaves = [other if tensor is None else tensor for tensor, other in zip(tensors, ctx.others, strict=True)]
            return pytree.tree_unflatten(leaves, ctx.structure)

        if not torch.is_grad_enabled():
            return tuple(gradients(needed, *gradient, *arguments(tensors)))
        function = functools.partial(first, arguments=arguments)
        # For a list of numbers torch says once that it needs no gradient, and expects none.
        counts = [child.num_leaves for child in ctx.structure.children()]
        of_leaves = [own for need, count in zip(needed, counts, strict=True) for own in _spread(need, count)]
        wanted = pytree.tree_unflatten(_plain_gradients(function, tensors, of_leaves, gradient), ctx.structure)
        return tuple(own if need is not False else None for own, need in zip(wanted, needed, strict=True))

    operator.register_autograd(backward, setup_context=setup_context)


def _spread(need: bool | Sequence[bool], count: int) -> Sequence[bool]:
    """Whether each leaf of an argument needs a gradient."""
    return [need] * count if isinstance(need, bool) else need


def _plain_gradients(
    function: Callable[..., tuple[Tensor, ...]],
    tensors: Sequence[Tensor | None],
    needed: Sequence[bool],
    gradient: Sequence[Tensor],
) -> list[Tensor | None]:
    """The derivatives of ``function(*tensors)``, times ``gradient``, in the tensors that need one; with a graph."""
    with torch.enable_grad():
        # An argument may be computed from another one, and only its direct part is asked for: hence the aliases.
        aliases = [None if tensor is None else tensor.view_as(tensor) for tensor in tensors]
        wanted = [alias for alias, need in zip(aliases, needed, strict=True) if alias is not None and need]
        # A result may depend on nothing that needs a derivative, as a rounded length does.
        results = [(one, own) for one, own in zip(function(*aliases), gradient, strict=True) if one.requires_grad]
        outputs, of_outputs = [one for one, _ in results], [own for _, own in results]
        found = iter(torch.autograd.grad(outputs, wanted, of_outputs, create_graph=True, materialize_grads=True))
        return [
            next(found) if alias is not None and need else None for alias, need in zip(aliases, needed, strict=True)
        ]
