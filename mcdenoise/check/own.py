"""A user's function as an op: loading it, and its example inputs.

The function takes floating-point tensors as positional arguments, and returns one or several. Its example inputs are

- ``function.example_inputs``, or else
- ``inputs`` in the same file, for all functions there that have no ``example_inputs``.

Either is a value, or a function without arguments that returns it: a tuple of tensors, or several tuples by name, each
of which is a case: ``{"ordinary": (image, albedo), "black": (0 * image, albedo)}``. The function is called with a fixed
random seed. If some of the tensors require gradients, derivatives are checked in these only, otherwise in all. Every
element is perturbed separately, so the tensors must be small, and away from points without a derivative.

A function without example inputs is checked on small images of positive radiance, one for each argument that has no
default: derivatives on ordinary images, stability also on dark, bright and black images, on fireflies in all arguments
and in each alone, and at the ends of the range of half precision and of float32.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from mcdenoise.check.case import Case, Op, between, constant, map_tensors, tensors_in, times
from mcdenoise.check.cases import OPS, STEPS
from mcdenoise.check.regimes import Argument, checked, extreme, stiff
from mcdenoise.errors import InputError, did_you_mean
from mcdenoise.methods import parse_method
from mcdenoise.own import load_own, refused

ATTRIBUTE, BESIDE = "example_inputs", "inputs"
# A Jacobian of this many results and inputs takes 128 MiB.
LARGEST = 4096
# Shape of the default images: small, because each element is perturbed separately, with one odd and one even side.
IMAGE = (1, 3, 5, 6)
_PLAIN = between(0.1, 1.1)


def find_ops(names: Sequence[str] | None, table: Sequence[Op] = OPS + STEPS) -> list[Op]:
    """Find ops by name.

    Args:
        names: names of ops in the table, or ``path/to/file.py:function``, ``package.module:function``, which may have
            settings as in :func:`mcdenoise.methods.parse_method`; ``None`` means the whole table.
        table: the known ops.

    Raises:
        InputError: there is no such op or function, or the function runs on none of its example inputs.
    """
    if names is None:
        return list(table)
    known = {op.name: op for op in table}
    unknown = [name for name in names if name not in known and ":" not in name and not name.endswith(".py")]
    if unknown:
        if near := did_you_mean(unknown[0], known):
            raise InputError(f"op: found no {unknown[0]}; {near} `mcdenoise models --ops` lists all")
        raise InputError(
            f"op: expected one of {', '.join(known)}, or path/to/file.py:function, or package.module:function, "
            f"found {', '.join(unknown)}"
        )
    return [known[name] if name in known else _load(name) for name in names]


def op_of(function: Callable[..., Any], inputs: Sequence[Tensor] = ()) -> Op:
    """Describe a function as an op.

    Args:
        function: takes floating-point tensors, and returns one or several.
        inputs: example inputs; by default those of the function, see the docstring of this module.

    Raises:
        InputError: ``function`` is not such a function, it fails on its example inputs, or it has none and fails on the
            default images.
    """
    name = getattr(function, "__name__", type(function).__name__)
    return _op(
        name, function, inputs or _examples(name, function, sys.modules.get(getattr(function, "__module__", "")))
    )


def note_of(op: Op) -> str:
    """One line that says that example inputs replace the images drawn by default; empty if there are none."""
    if not op.own or any(case.kind != "ordinary" for case in op.cases):
        return ""
    cases = ", ".join(case.name for case in op.cases)
    return f"{op.name}: its example inputs ({cases}) replace the stiff and extreme images that are tried without them"


def _load(name: str) -> Op:
    spelling = parse_method(name)
    function, module = load_own(spelling.model, "function", "function", other=BESIDE)
    return _op(name, _with_settings(name, function, spelling.settings), _examples(name, function, module))


def _with_settings(name: str, function: Any, settings: dict[str, Any]) -> Any:
    if not settings or not callable(function):
        return function
    try:
        inspect.signature(function).bind_partial(**settings)
    except (TypeError, ValueError) as error:
        raise InputError(f"function '{name}': {error}") from error
    return partial(function, **settings)


def _examples(name: str, function: Any, module: Any) -> Any:
    """The example inputs of a function, or ``None``."""
    found = getattr(function, ATTRIBUTE, None)
    if found is None:
        found = getattr(module, BESIDE, None)
    if not callable(found):
        return found
    with refused(f"function '{name}': its example inputs fail"), torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return found()


def _op(name: str, function: Any, examples: Any) -> Op:
    if not callable(function) or isinstance(function, type):
        found = "a class; name an object of it" if isinstance(function, type) else type(function).__name__
        raise InputError(f"function '{name}': expected a function of tensors, found {found}")
    if examples is None:
        return _on_images(name, function)
    given = examples if isinstance(examples, Mapping) else {"example": examples}
    if not given:
        raise InputError(f"function '{name}': expected example inputs by name, found none")
    for case, tensors in given.items():
        where = f"function '{name}', {case}"
        _check_tensors(where, tensors)
        _check_results(where, function, tensors)
    cases = tuple(_case(str(case), function, tensors) for case, tensors in given.items())
    return Op(_by_name(name, function), cases, own=True)


def _on_images(name: str, function: Any) -> Op:
    """A function without example inputs, on default images."""
    names = [each.name for each in _parameters(function) if each.default is each.empty]
    # The ends of the range are those of the ops of this package; numbers beyond that of a dtype are clamped to it.
    regimes = [
        *(stiff(case, IMAGE, times(value, _PLAIN), ()) for case, value in (("dark", 1e-3), ("bright", 1e3))),
        stiff("firefly", IMAGE, _PLAIN, (), change=partial(_add_firefly, names)),
        extreme("black", IMAGE, constant(0)),
        *(extreme(f"radiance {value:g}", IMAGE, times(value, _PLAIN)) for value in (6e4, 1e30, 1e-30)),
    ]
    if len(names) > 1:
        regimes += [stiff(f"firefly in {x}", IMAGE, _PLAIN, (), change=partial(_add_firefly, [x])) for x in names]
    # For the other images the step of the finite differences is too large or too small.
    only: dict[str, Any] = {"sizes": {"ordinary image": IMAGE}, "image": _PLAIN, "limits": {}, "fireflies": None}
    op = checked(_by_name(name, function), dict.fromkeys(names, Argument()), *regimes, own=True, **only)
    try:
        if not names:
            raise InputError("it names no argument without a default")
        _check_results(f"function '{name}'", function, tensors_in(op.cases[0].inputs()))
    except InputError as error:
        reason = str(error).removeprefix(f"function '{name}': ")
        raise InputError(
            f"function '{name}': it has no example inputs, and cannot be tried on images of {IMAGE}: {reason}; give it "
            f"an attribute {ATTRIBUTE}, or its file a function {BESIDE}(), that returns a tuple of tensors"
        ) from error
    return op


def _add_firefly(names: Sequence[str], images: dict[str, Tensor]) -> None:
    for name in names:
        images[name][..., 2, 3] *= 1e4


def _check_tensors(where: str, tensors: Any) -> None:
    if not isinstance(tensors, tuple | list) or not tensors:
        raise InputError(
            f"{where}: expected a tuple of tensors as example inputs, or several by name, found "
            f"{'none' if isinstance(tensors, tuple | list) else type(tensors).__name__}"
        )
    for i, tensor in enumerate(tensors, start=1):
        if not isinstance(tensor, Tensor) or not tensor.is_floating_point() or not tensor.numel():
            found = f"{tensor.dtype} of {tuple(tensor.shape)}" if isinstance(tensor, Tensor) else type(tensor).__name__
            raise InputError(f"{where}: expected a floating-point tensor as example input {i}, found {found}")
        if tensor.device.type != "cpu":
            raise InputError(f"{where}: expected example input {i} on cpu, found it on {tensor.device}")
    numbers = sum(tensor.numel() for tensor in tensors)
    if numbers > LARGEST:
        raise InputError(
            f"{where}: expected at most {LARGEST} numbers in the example inputs, found {numbers}; every one is "
            "perturbed separately, so use smaller tensors"
        )


def _check_results(where: str, function: Any, tensors: Sequence[Tensor]) -> None:
    with refused(f"{where}: it fails in float64"), torch.no_grad():
        results = function(*map(_copy, tensors))
    parts = results if isinstance(results, tuple | list) else (results,)
    wrong = [part for part in parts if not isinstance(part, Tensor) or not part.is_floating_point()]
    if wrong or not parts:
        kinds = ", ".join(str(part.dtype) if isinstance(part, Tensor) else type(part).__name__ for part in wrong)
        raise InputError(f"{where}: expected one or several floating-point tensors of it, found {kinds or 'none'}")


def _by_name(name: str, function: Any) -> Callable[..., Any]:
    """The function with arguments by name instead of by position."""

    def called(**given: Tensor) -> Tensor | tuple[Tensor, ...]:
        results = function(*given.values())
        return results if isinstance(results, Tensor) else tuple(results)

    called.__name__ = name
    return called


def _case(name: str, function: Any, tensors: Sequence[Tensor]) -> Case:
    parameters = [each.name for each in _parameters(function)]
    # Numbered names for arguments without a name.
    names = (parameters + [f"input {i + 1}" for i in range(len(parameters), len(tensors))])[: len(tensors)]
    given = dict(zip(names, tensors, strict=True))
    chosen = tuple(each for each in given if given[each].requires_grad)
    return Case(name, "ordinary", lambda g: map_tensors(_copy, {**given}), chosen or tuple(names))


def _copy(tensor: Tensor) -> Tensor:
    return tensor.detach().double().clone()


def _parameters(function: Any) -> list[inspect.Parameter]:
    """The positional parameters of a function, or of the forward of a Module."""
    try:
        function = function.forward if isinstance(function, torch.nn.Module) else function
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # functions of torch written in C++ have no signature
        return []
    return [each for each in parameters if each.kind in (each.POSITIONAL_ONLY, each.POSITIONAL_OR_KEYWORD)]
