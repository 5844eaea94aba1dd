"""Weights files that describe themselves: safetensors with architecture, training and licence in the header."""

from __future__ import annotations

import hashlib
import inspect
import json
import operator
import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from mcdenoise.errors import InputError, first_line, naming
from mcdenoise.models._defaults import without_draws
from mcdenoise.models._interface import Model
from mcdenoise.models._registry import Entry, build_model, find_model, list_models, outline_model
from mcdenoise.reading import check_file

_SHIPPED = Path(__file__).parent / "weights"
# Folder of weights for comparisons: all methods were trained with the same short recipe.
_COMPARED = _SHIPPED / "compared"
# The largest number in a header's settings: of a model of the zoo, whose constructors repeat layers, and of any other.
_LARGEST, _LARGEST_OF_OWN = 1 << 12, 1 << 24
_LONGEST = 200


def create_model(name: str, *, pretrained: bool = False, weights: Path | str | None = None, **settings: Any) -> Model:
    """Create a model of the zoo or a user's own model.

    Args:
        name: one of :func:`mcdenoise.models.list_models`, ``path/to/file.py:factory`` or ``package.module:factory``.
        pretrained: load the weights that are shipped with the package. Has no effect on a model without weights or on
            a user's own model.
        weights: a safetensors file written by :func:`save_weights`; the model gets the settings in the file.
        settings: arguments for the model's constructor, such as ``width=32``.

    Returns:
        The model in evaluation mode, float32, on the CPU.

    Raises:
        InputError: the name is unknown, there are no shipped weights for it, or the file does not fit.
    """
    if weights is not None:
        return load_weights(Path(weights), name, **settings)
    if pretrained and (shipped := find_weights(name)) is not None:
        return load_weights(shipped, name, **settings)
    model = build_model(name, **settings)
    if pretrained and model.needs.trainable and ":" not in name:
        have = ", ".join([*pretrained_models(), *compared_models()]) or "none"
        raise InputError(f"model '{name}': expected shipped weights, found them only for: {have}; train it first")
    return model.eval() if isinstance(model, nn.Module) else model


def find_weights(name: str) -> Path | None:
    """The file of a model's shipped weights, or ``None``."""
    files = [folder / f"{name}.safetensors" for folder in (_SHIPPED, _COMPARED)]
    return next((path for path in files if path.is_file()), None)


def pretrained_models() -> list[str]:
    """Sorted names of the models with shipped weights for denoising."""
    return sorted(path.stem for path in _SHIPPED.glob("*.safetensors"))


def compared_models() -> list[str]:
    """Sorted names of the models with shipped weights for comparisons only.

    ``recipes/zoo.toml`` trains each of them in the same way for some minutes.
    """
    return sorted(path.stem for path in _COMPARED.glob("*.safetensors"))


def load_weights(path: Path, name: str | None = None, **settings: Any) -> Model:
    """Load the model that a weights file describes.

    Only registered models are made from a file alone: a file names no code that is imported or called.

    Args:
        path: a file written by :func:`save_weights`.
        name: registered model that the file must hold, or a user's own model to load it into; by default the registered
            model that the file names.
        settings: arguments for the model's constructor; those of a registered model that determine the weights must be
            as in the file.

    Raises:
        InputError: the file does not exist, is not safetensors, holds another model or, without ``name``, a user's own,
            has other settings than the model or settings out of range, has tensors that do not fit (the message names
            the first one), or has weights that are not finite; or the model has no such setting.
    """
    description = describe_weights(path)
    found = description["architecture"]
    if name is None:
        name = model_of(path)
    elif found != name and ":" not in name:
        raise InputError(f"{path}: expected weights of model '{name}', found those of '{found}'")
    entry, own = find_model(name), ":" in name
    _check_header(path, entry, description["settings"], found)
    if not own:
        _check_settings(name, settings, description["settings"])
    # The settings come from the file, so that a change of defaults in the code cannot change what a file means.
    every = {**description["settings"], **settings}
    with safe_open(path, framework="pt") as file:
        keys = set(file.keys())
        # Older files also hold the ranges of U-Nets for 8-bit integers.
        ranges = {
            f"{key.removesuffix('encoder.0.0.weight')}ranges" for key in keys if key.endswith(".encoder.0.0.weight")
        }
        shapes = {key: tuple(file.get_slice(key).get_shape()) for key in keys - ranges}
        try:
            if entry.of_zoo and description["settings"] != entry.architecture:
                # Shapes are compared before memory is taken, of which a header can ask for any amount.
                _check_shapes(path, found, _shapes(outline_model(name, every)), shapes)
            with without_draws():
                model = build_model(name, **every)
        except InputError as error:
            # Settings that are given are not the file's mistake.
            if settings or str(error).startswith(f"{path}: "):
                raise
            raise InputError(f"{path}: {error}") from error
        _check_shapes(path, found, _shapes(model), shapes)
        tensors = {key: file.get_tensor(key) for key in keys}
    if description.get("sha256") != _digest(tensors):
        raise InputError(f"{path}: expected tensors that match the header's sha256, found others; the file is damaged")
    _copy(path, {key: tensors[key] for key in shapes}, _named(model))
    return model.eval() if isinstance(model, nn.Module) else model


def _copy(path: Path, tensors: Mapping[str, Tensor], weights: Mapping[str, Tensor]) -> None:
    for key, tensor in tensors.items():
        if weights[key].is_floating_point() and not tensor.is_floating_point():
            raise InputError(f"{path}: layer '{key}': expected floating-point weights, found {tensor.dtype}")
        if not tensor.isfinite().all():
            raise InputError(f"{path}: layer '{key}': expected finite weights, found NaN or infinite ones")
        with torch.no_grad():
            weights[key].copy_(tensor)


def model_of(path: Path) -> str:
    """The name of the registered model that a weights file is for.

    Raises:
        InputError: the file was not written by :func:`save_weights`, or it is for a model of the user, which only the
            caller can name.
    """
    found = str(describe_weights(path)["architecture"])
    # To look a name up imports no code that it could point to.
    if found in list_models():
        return found
    if ":" in found:
        raise InputError(
            f"{path}: expected weights of a model that `mcdenoise models` lists, found those of a user's own, "
            f"'{found}'; a file names no code to run, so name the model yourself: 'path/to/file.py:factory(weights="
            f"{path})', or in Python load_weights(path, 'path/to/file.py:factory')"
        )
    raise InputError(f"{path}: expected weights of a model that `mcdenoise models` lists, found those of '{found}'")


def _shapes(model: Model) -> dict[str, tuple[int, ...]]:
    return {key: tuple(tensor.shape) for key, tensor in _named(model).items()}


def _check_shapes(
    path: Path, model: str, own: Mapping[str, tuple[int, ...]], found: Mapping[str, tuple[int, ...]]
) -> None:
    for key in sorted(own.keys() | found.keys()):
        expected, actual = own.get(key, "no such layer"), found.get(key, "no such layer")
        if expected != actual:
            raise InputError(f"{path}: layer '{key}': model '{model}' expects {expected}, found {actual}")


def _check_header(path: Path, entry: Entry, settings: dict[str, Any], model: str) -> None:
    """Raise ``InputError`` unless the settings of a header are those of the model, and plain values in range."""
    where, known = f"{path}: header 'settings':", entry.architecture
    if lacking := sorted(known.keys() - settings.keys()):
        raise InputError(
            f"{where} expected every setting of model '{model}', found no {', '.join(lacking)}; save the weights again"
        )
    if wrong := sorted(settings.keys() - known.keys()):
        expected = ", ".join(known) or "none"
        raise InputError(f"{where} expected settings of model '{model}' ({expected}), found '{wrong[0]}'")
    largest = _LARGEST if entry.of_zoo else _LARGEST_OF_OWN
    for name, value in settings.items():
        if not all(_is_plain(each, largest) for each in (value if isinstance(value, list) else [value])):
            raise InputError(
                f"{where} expected for '{name}' true, false, null, a short text or a number of at most {largest}, "
                f"found {reprlib.repr(value)}"
            )


def _is_plain(value: object, largest: int) -> bool:
    # NaN is in no range.
    number = isinstance(value, int | float) and abs(value) <= largest
    return value is None or number or (isinstance(value, str) and len(value) <= _LONGEST)


def _check_settings(name: str, given: dict[str, Any], fixed: dict[str, Any]) -> None:
    """Raise ``InputError`` for a setting that a registered model does not take beside weights with fixed settings."""
    entry = find_model(name)
    parameters = inspect.signature(entry.construct).parameters.values()
    if any(each.kind is each.VAR_KEYWORD for each in parameters):
        return
    free = [each.name for each in parameters if each.name not in entry.architecture]
    wrong = [each for each in given if each not in free and (each not in fixed or given[each] != fixed[each])]
    if wrong:
        shipped = (*pretrained_models(), *compared_models())
        family = [each for each in shipped if each != name and find_model(each).construct is entry.construct]
        allowed = f"no settings but {', '.join(free)}" if free else "no settings"
        others = f", or take another model: {', '.join(family)}" if family else ""
        raise InputError(
            f"model '{name}': expected {allowed} beside its weights, found {wrong[0]}={given[wrong[0]]}; the weights "
            f"fix {', '.join(fixed)}; for other values train it{others}"
        )


def has_random_weights(name: str, settings: dict[str, Any]) -> bool:
    """Whether a model that is not of the zoo has other weights each time that it is made, so that it was not trained.

    Raises:
        InputError: see :func:`build_model`.
    """
    if find_model(name).of_zoo:
        return False
    made = []
    with torch.random.fork_rng(devices=[]):
        for seed in range(2):
            torch.manual_seed(seed)
            model = build_model(name, **settings)
            made.append(model.state_dict() if isinstance(model, nn.Module) else {})
    first, second = made
    return first.keys() != second.keys() or not all(torch.equal(first[key], second[key]) for key in first)


def start_with(model: Model, name: str, **settings: Any) -> str:
    """Copy the weights of another model to the layers of the same names.

    A layer may have more channels than the other model's: its first channels then take the weights, and the rest start
    with zeros, so that they have no effect at first.

    Args:
        model: changed in place; its other layers keep their weights.
        name: a model with shipped weights, or one that brings its own, such as ``oidn_open``.
        settings: arguments for its constructor.

    Returns:
        The checksum of the other model's weights.

    Raises:
        InputError: there are no weights of this name, a layer of theirs is missing or smaller, or a package that the
            other model needs is missing.
    """
    with naming("start_from"):
        other = create_model(name, pretrained=True, **settings)
    own = _named(model)
    tensors = _named(other)
    if not tensors:
        raise InputError(f"start_from: expected a model with weights, found '{name}'")
    for key, tensor in tensors.items():
        shape = own[key].shape if key in own else ()
        if len(shape) != tensor.dim() or any(map(operator.lt, shape, tensor.shape)):
            found = f"shape {tuple(shape)}" if key in own else "no such layer"
            raise InputError(f"start_from: expected layer '{key}' of '{name}', {tuple(tensor.shape)}, found {found}")
        with torch.no_grad():
            own[key].zero_()[tuple(map(slice, tensor.shape))].copy_(tensor)
    shipped = find_weights(name)
    return _digest(tensors) if shipped is None else str(describe_weights(shipped)["sha256"])


def describe_weights(path: Path) -> dict[str, Any]:
    """The header of a weights file: architecture, settings, training, data, licence.

    Raises:
        InputError: the file does not exist, or was not written by :func:`save_weights`.
    """
    try:
        check_file(path)
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
    except (OSError, SafetensorError) as error:
        found = getattr(error, "strerror", None) or first_line(error)
        raise InputError(f"{path}: expected a safetensors file, found: {found}") from error
    if "architecture" not in metadata:
        raise InputError(f"{path}: expected weights saved by mcdenoise, found no 'architecture' in the header")
    try:
        settings = dict(json.loads(metadata.get("settings", "{}")))
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: header 'settings': expected a JSON object, found other text") from error
    return {**metadata, "settings": settings}


def save_weights(model: Model, architecture: str, settings: dict[str, Any], about: dict[str, str]) -> bytes:
    """Encode a model's weights as the bytes of a safetensors file, in half precision.

    Args:
        model: the model.
        architecture: the registered name, or that of a user's own model, of which the file has no folders.
        settings: arguments given to the constructor in addition to the registered ones. The file holds every setting
            that determines the weights, so that a change of defaults in the code cannot change what a file means.
        about: provenance as texts: config, data, steps, commit, licence.

    Returns:
        The bytes of the file; the header also holds the ``sha256`` of the tensors' bytes.

    Raises:
        InputError: a weight is not finite in half precision.
    """
    tensors = {key: value.detach().cpu().to(torch.float16).contiguous() for key, value in _named(model).items()}
    for key, tensor in tensors.items():
        if not tensor.isfinite().all():
            raise InputError(f"layer '{key}': expected weights that fit half precision, found NaN or infinite ones")
    known = find_model(architecture).architecture
    if ":" in architecture:
        # For people to read only: the folder says nothing elsewhere.
        place, _, factory = architecture.rpartition(":")
        architecture = f"{Path(place).name}:{factory}"
    every = json.dumps({**known, **{name: value for name, value in settings.items() if name in known}})
    return save(tensors, {"architecture": architecture, "settings": every, **about, "sha256": _digest(tensors)})


def _named(model: Model) -> dict[str, Tensor]:
    """The weights of a model by name.

    Names do not include wrappers, so that a file fits the model with and without them.
    """
    if not isinstance(model, nn.Module):
        return {}
    own = {_bare(key): value for key, value in model.state_dict().items()}
    if len(own) < len(model.state_dict()):
        raise InputError("model: expected weights that differ by name without 'inner', found two of one name")
    return own


def _bare(key: str) -> str:
    return ".".join(part for part in key.split(".") if part not in ("inner", "function"))


def _digest(tensors: dict[str, Tensor]) -> str:
    digest = hashlib.sha256()
    for key in sorted(tensors):
        # numpy has no bfloat16.
        digest.update(key.encode() + tensors[key].contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()
