"""Importing a user's own object, given as ``path/to/file.py:attribute`` or ``package.module:attribute``."""

from __future__ import annotations

import ast
import importlib
import importlib.util
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.abc import Loader
from pathlib import Path
from types import ModuleType
from typing import Any

from mcdenoise.errors import InputError, in_one_line

# Modules beside the file that was executed last, which it has imported.
_beside: list[str] = []


def load_own(name: str, kind: str, thing: str, *, other: str = "") -> tuple[Any, ModuleType]:
    """Import an object from outside the package.

    A file is executed at each call, as a new module, and so are the modules beside it that it imports.

    Args:
        name: ``path/to/file.py:attribute`` or ``package.module:attribute``; for a file without an attribute, the
            error names those that it has.
        kind: use of the object, such as ``"model"``; for messages.
        thing: kind of attribute that is expected, such as ``"factory"``; for messages.
        other: name of an attribute that is no such thing; for messages.

    Returns:
        The attribute, and the module that defines it.

    Raises:
        InputError: the file or module does not exist, is of the standard library, cannot be imported, or has no such
            attribute.
    """
    if name.endswith(".py"):
        functions = [each for each in _functions_in(Path(name), kind, thing) if each != other]
        choice = " or ".join(f":{each}" for each in functions or [thing])
        raise InputError(f"{kind} '{name}': expected {name}:{thing}, found only the file; add {choice}")
    place, _, attribute = name.rpartition(":")
    if place.partition(".")[0] in sys.stdlib_module_names:
        raise InputError(
            f"{kind} '{name}': expected a {thing} of a file or a package, found the standard library's {place}, which "
            f"has none; write ./{place}.py:{attribute} if it is a file"
        )
    with refused(f"{kind} '{name}': {place} cannot be imported"):
        module = _module_of_file(Path(place), kind, thing) if place.endswith(".py") else importlib.import_module(place)
        if hasattr(module, attribute):
            return getattr(module, attribute), module
    offered = ", ".join(key for key, value in vars(module).items() if callable(value) and not key.startswith("_"))
    raise InputError(f"{kind} '{name}': expected a {thing} '{attribute}' in {place}, found {offered or 'none'}")


@contextmanager
def refused(what: str) -> Iterator[None]:
    """Turn whatever a user's code raises inside this block, its wish to exit included, into an ``InputError``."""
    try:
        yield
    except (InputError, KeyboardInterrupt):
        raise
    except BaseException as error:
        raise InputError(f"{what}: {in_one_line(error)}") from error


def _check_file(path: Path, kind: str, thing: str) -> None:
    if not path.is_file():
        wanted = f"a {thing}" if thing == kind else f"a {thing} of a {kind}"
        raise InputError(f"{path}: expected a Python file with {wanted}, found no such file")


def _functions_in(path: Path, kind: str, thing: str) -> list[str]:
    """The names of the functions and classes in a file, which is not executed; none if it cannot be read."""
    _check_file(path, kind, thing)
    # A syntax error is a SyntaxError or, for a null byte, a ValueError.
    with suppress(OSError, SyntaxError, ValueError, RecursionError):
        body = ast.parse(path.read_bytes()).body
        names = [each.name for each in body if isinstance(each, ast.FunctionDef | ast.ClassDef)]
        return [name for name in names if not name.startswith("_")]
    return []


def _module_of_file(path: Path, kind: str, thing: str) -> ModuleType:
    _check_file(path, kind, thing)
    # A unique name, so that files of the same name are different modules.
    module_name = f"mcdenoise_own_{path.stem}_{abs(hash(path.resolve()))}"
    spec = importlib.util.spec_from_file_location(module_name, path)
    if spec is None or spec.loader is None:
        raise InputError(f"{path}: expected a Python file, found something else")
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look up their module in ``sys.modules``.
    sys.modules[module_name] = module
    _execute(module, spec.loader, path.resolve().parent)
    return module


def _execute(module: ModuleType, loader: Loader, folder: Path) -> None:
    """Execute a file that may import modules of its folder, as Python does with a script."""
    # Files of several folders may import different modules of the same name.
    for name in _beside:
        sys.modules.pop(name, None)
    before = set(sys.modules)
    sys.path.insert(0, str(folder))
    try:
        loader.exec_module(module)
    finally:
        sys.path.remove(str(folder))
        new = {name: name.partition(".")[0] for name in set(sys.modules) - before}
        _beside[:] = [
            name
            for name, top in new.items()
            if top not in before and ((folder / f"{top}.py").exists() or (folder / top).is_dir())
        ]
