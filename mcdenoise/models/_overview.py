"""Needs, size and cost of every model."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, get_args

import torch
from torch import nn

from mcdenoise.errors import InputError
from mcdenoise.frame import Frame
from mcdenoise.models._interface import Model
from mcdenoise.models._registry import Kind, build_model, find_model, list_models, needs_of_models
from mcdenoise.models._weights import compared_models, pretrained_models
from mcdenoise.own import refused

_SIDE = 64  # a multiple of every model's padding, so that no padded pixel is counted


@dataclass(frozen=True)
class ModelOverview:
    """One row of `mcdenoise models`.

    Args:
        name: the registered name.
        description: one line.
        kind: how the model makes its image.
        paper: authors and year; empty if there is none.
        parameters: number of weights.
        kmacs_per_pixel: thousands of multiply-adds per pixel in convolutions, which are nearly all of a network's work,
            for features without noise; ``None`` for a method that is not a network.
        weights: "shipped"; "compared", shipped for comparisons only; "its own", found by the model itself; "to train";
            or "none" for a model without weights.
        needs: names of the required buffers.
        uses: names of optional buffers that improve the result.
        trainable: whether the model can be trained.
        reason: why the model is not available, such as an optional package that is not installed; empty if it is.
    """

    name: str
    description: str
    kind: Kind
    paper: str
    parameters: int = 0
    kmacs_per_pixel: float | None = None
    weights: str = "none"
    needs: list[str] = field(default_factory=list)
    uses: list[str] = field(default_factory=list)
    trainable: bool = False
    reason: str = ""


def overview(pattern: str = "*") -> list[ModelOverview]:
    """One entry per registered model, sorted by kind and name; a model that cannot be made states the reason.

    Args:
        pattern: see :func:`list_models`.
    """
    weights = dict.fromkeys(compared_models(), "compared") | dict.fromkeys(pretrained_models(), "shipped")
    entries = [_overview(name, weights.get(name, "")) for name in list_models(pattern)]
    return sorted(entries, key=lambda entry: get_args(Kind).index(entry.kind))


def users_of(buffers: Iterable[str]) -> dict[str, list[str]]:
    """For each given buffer, the sorted names of the models that need or use it."""
    models = needs_of_models()
    return {
        buffer: [name for name, needs in models.items() if buffer in needs.buffers | needs.uses] for buffer in buffers
    }


def _overview(name: str, weights: str) -> ModelOverview:
    listed = partial(ModelOverview, name, "", "other", "")
    try:
        entry = find_model(name)
        listed = partial(ModelOverview, name, entry.description, entry.kind, entry.paper)
        with refused(f"model '{name}': it fails"):
            model = build_model(name)
            needs = model.needs
            parameters = sum(each.numel() for each in model.parameters()) if isinstance(model, nn.Module) else 0
            weights = weights or ("to train" if needs.trainable else "its own")
            return listed(
                parameters=parameters,
                kmacs_per_pixel=_kmacs_per_pixel(model) if parameters else None,
                weights=weights if parameters else "none",
                needs=sorted(needs.buffers),
                uses=sorted(needs.uses),
                trainable=needs.trainable,
            )
    except InputError as error:
        return listed(reason=str(error))


def _kmacs_per_pixel(model: Model) -> float:
    # The import takes 0.2 s.
    from torch.utils.flop_counter import FlopCounterMode

    images: dict[str, Any] = {name: torch.rand(1, 3, _SIDE, _SIDE) for name in ("color", "albedo")}
    # A normal and a depth without noise, which no method filters first.
    images |= {"normal": torch.zeros(1, 3, _SIDE, _SIDE), "depth": torch.ones(1, 1, _SIDE, _SIDE)}
    # The counter knows torch's convolutions but not the fused ones, which run only without derivatives.
    with FlopCounterMode(display=False) as counter, torch.enable_grad():
        model(Frame(**images, motion=torch.zeros(1, 2, _SIDE, _SIDE)))
    return float(counter.get_total_flops()) / 2 / _SIDE**2 / 1e3
