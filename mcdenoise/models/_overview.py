"""Needs, size and cost of every model."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import nn

from mcdenoise.errors import InputError
from mcdenoise.frame import BUFFERS, Frame
from mcdenoise.models._registry import build_model, describe_model, list_models
from mcdenoise.models._weights import pretrained_models

_SIDE = 64  # a multiple of every model's padding, so that no padded pixel is counted
# In the order in which they are listed.
GROUPS = ("networks with weights", "networks to train", "without weights", "not available")


@dataclass(frozen=True)
class ModelOverview:
    """What `mcdenoise models` prints of one model.

    Args:
        name: in the register.
        description: one line.
        group: one of :data:`GROUPS`.
        parameters: number of weights.
        kmacs_per_pixel: thousands of multiply-adds a pixel in convolutions, which are nearly all of a network's work;
            ``None`` for what is no network, whose work is elsewhere.
        pretrained: whether weights are shipped.
        needs: names of the buffers that it cannot do without.
        uses: names of those that it is better with.
        trainable: whether it learns.
        reason: why it is not available, such as an optional package that is not installed; empty if it is.
    """

    name: str
    description: str
    group: str
    parameters: int = 0
    kmacs_per_pixel: float | None = None
    pretrained: bool = False
    needs: list[str] = field(default_factory=list)
    uses: list[str] = field(default_factory=list)
    trainable: bool = False
    reason: str = ""


def overview() -> list[ModelOverview]:
    """An entry for every registered model, by group and then by name; one that cannot be made says why."""
    shipped = pretrained_models()
    entries = [_overview(name, pretrained=name in shipped) for name in list_models()]
    return sorted(entries, key=lambda entry: GROUPS.index(entry.group))


def _overview(name: str, *, pretrained: bool) -> ModelOverview:
    # Imports Triton where it is installed, which takes a fifth of a second.
    from torch.utils.flop_counter import FlopCounterMode

    try:
        description = describe_model(name)
        model = build_model(name)
    except InputError as error:
        return ModelOverview(name, "", "not available", reason=str(error))
    needs, macs = model.needs, None
    parameters = sum(each.numel() for each in model.parameters()) if isinstance(model, nn.Module) else 0
    ready = "networks with weights" if pretrained or not needs.trainable else "networks to train"
    if parameters:
        # The counter knows torch's convolutions, not those that are fused where nobody asks for derivatives.
        with FlopCounterMode(display=False) as counter, torch.enable_grad():
            model(_frame())
        macs = counter.get_total_flops() / 2 / _SIDE**2 / 1e3
    return ModelOverview(
        name,
        description,
        ready if parameters else "without weights",
        parameters,
        macs,
        pretrained,
        sorted(needs.buffers),
        sorted(needs.uses),
        needs.trainable,
    )


def _frame() -> Frame:
    images: dict[str, Any] = {
        name: torch.rand(1, BUFFERS[name].channels, _SIDE, _SIDE) for name in ("color", "albedo", "normal", "depth")
    }
    return Frame(**images, motion=torch.zeros(1, 2, _SIDE, _SIDE))
