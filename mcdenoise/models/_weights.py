"""Weights that describe themselves: safetensors with architecture, training and licence in the header."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import nn

from mcdenoise.errors import InputError
from mcdenoise.models._registry import build_model, complete_settings, list_models, missing_settings

_SHIPPED = Path(__file__).parent / "weights"


def create_model(
    name: str, *, pretrained: bool = False, weights: Path | str | None = None, **settings: Any
) -> nn.Module:
    """A model of the zoo.

    Args:
        name: one of :func:`mcdenoise.models.list_models`.
        pretrained: load the weights that are shipped with the package.
        weights: a safetensors file written by :func:`save_weights`; its settings are used for the model.
        settings: for the model's constructor, such as ``width=32``.

    Returns:
        The model in evaluation mode, float32, on the CPU.

    Raises:
        InputError: the name is unknown, there are no shipped weights for it, or the file does not fit.
    """
    if weights is None and pretrained:
        weights = _SHIPPED / f"{name}.safetensors"
        if not weights.is_file():
            build_model(name)
            have = ", ".join(pretrained_models()) or "none"
            raise InputError(f"model '{name}': expected shipped weights, found them only for: {have}; train it first")
    if weights is None:
        return build_model(name, **settings).eval()
    return load_weights(Path(weights), name, **settings)


def pretrained_models() -> list[str]:
    """Names of the models that have shipped weights, sorted."""
    return sorted(path.stem for path in _SHIPPED.glob("*.safetensors"))


def load_weights(path: Path, name: str | None = None, **settings: Any) -> nn.Module:
    """The model that a weights file describes, with these weights.

    The header has every setting of the constructor, so that no default of a later version decides what a file means.

    Args:
        path: a file written by :func:`save_weights`, or one like it of any floating-point dtype.
        name: the model it must be; any by default.
        settings: override the settings in the file.

    Raises:
        InputError: no such file, not safetensors, another model, a header that lacks settings, or tensors that do not
            fit or are not finite; names the first of them.
    """
    description = describe_weights(path)
    found = description["architecture"]
    if name is not None and found != name:
        raise InputError(f"{path}: expected weights of model '{name}', found those of '{found}'")
    settings = {**description["settings"], **settings}
    missing = missing_settings(found, settings) if found in list_models() else []
    if missing:
        raise InputError(
            f"{path}: header 'settings': expected every setting of model '{found}', found no {', '.join(missing)}; "
            "such weights do not say what they mean: name these settings, or save the weights again"
        )
    try:
        model = build_model(found, **settings)
    except InputError:
        raise
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"{path}: expected settings of model '{found}', found {settings}") from error
    with safe_open(path, framework="pt") as file:
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - a safetensors handle is no dict
    own = model.state_dict()
    for key in sorted(own.keys() | tensors.keys()):
        expected = tuple(own[key].shape) if key in own else "no such layer"
        actual = tuple(tensors[key].shape) if key in tensors else "no such layer"
        if expected != actual:
            raise InputError(f"{path}: layer '{key}': model '{found}' expects {expected}, found {actual}")
    if description.get("sha256") != _digest(tensors):
        raise InputError(f"{path}: expected tensors that match the header's sha256, found others; the file is damaged")
    for key, tensor in sorted(tensors.items()):
        if not tensor.is_floating_point():
            raise InputError(f"{path}: layer '{key}': expected floating-point numbers, found {tensor.dtype}")
        # Eight bits have no such test of their own.
        if not tensor.float().isfinite().all():
            raise InputError(f"{path}: layer '{key}': expected finite weights, found NaN or infinite ones; train again")
    model.load_state_dict({key: tensor.float() for key, tensor in tensors.items()})
    return model.eval()


def describe_weights(path: Path) -> dict[str, Any]:
    """What a weights file says of itself: architecture, settings, training, data, licence.

    Raises:
        InputError: no such file, or not written by :func:`save_weights`.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
    except (OSError, SafetensorError) as error:
        raise InputError(f"{path}: expected a safetensors file, found: {str(error).splitlines()[0]}") from error
    if "architecture" not in metadata:
        raise InputError(f"{path}: expected weights saved by mcdenoise, found no 'architecture' in the header")
    try:
        settings = dict(json.loads(metadata.get("settings", "{}")))
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"{path}: header 'settings': expected a JSON object, found other text") from error
    return {
        "architecture": metadata["architecture"],
        "settings": settings,
        **{key: value for key, value in metadata.items() if key not in ("architecture", "settings")},
    }


def save_weights(model: nn.Module, architecture: str, settings: dict[str, Any], about: dict[str, str]) -> bytes:
    """A model's weights as the bytes of a safetensors file, half precision.

    Args:
        model: the model.
        architecture: the name under which it is registered.
        settings: what its constructor was given, where that is not what ``create_model`` was given; those at their
            defaults are added.
        about: how the weights came to be: config, data, steps, commit, licence; texts.

    Returns:
        The file's bytes; the header also has the ``sha256`` of the tensors' bytes.

    Raises:
        InputError: a weight is not finite in half precision.
    """
    tensors = {key: value.detach().cpu().to(torch.float16).contiguous() for key, value in model.state_dict().items()}
    for key, tensor in tensors.items():
        if not tensor.isfinite().all():
            raise InputError(f"layer '{key}': expected weights that fit half precision, found NaN or infinite ones")
    settings = {**getattr(model, "settings", {}), **settings}
    if architecture in list_models():
        settings = complete_settings(architecture, settings)
    header = {"architecture": architecture, "settings": json.dumps(settings), **about, "sha256": _digest(tensors)}
    return save(tensors, header)


def _digest(tensors: dict[str, torch.Tensor]) -> str:
    digest = hashlib.sha256()
    for key in sorted(tensors):
        # As bytes: numpy has no bfloat16.
        digest.update(key.encode() + tensors[key].contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()
