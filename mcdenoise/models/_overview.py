"""Size and cost of every model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

from mcdenoise.frame import BUFFERS, Frame
from mcdenoise.models._registry import build_model, describe_model, list_models
from mcdenoise.models._weights import pretrained_models

_SIDE = 64  # a multiple of every model's padding, so that no padded pixel is counted


@dataclass(frozen=True)
class ModelOverview:
    """What `mcdenoise models` prints of one model.

    Args:
        name: in the register.
        description: one line.
        parameters: number of weights.
        kmacs_per_pixel: thousands of multiply-adds a pixel in convolutions, which are nearly all of the work.
        pretrained: whether weights are shipped.
        needs: names of the buffers that it cannot do without.
        uses: names of those that it is better with.
        trainable: whether it learns.
    """

    name: str
    description: str
    parameters: int
    kmacs_per_pixel: float
    pretrained: bool
    needs: list[str]
    uses: list[str]
    trainable: bool


def overview() -> list[ModelOverview]:
    """An entry for every registered model, sorted by name."""
    # Imports Triton where it is installed, which takes a fifth of a second.
    from torch.utils.flop_counter import FlopCounterMode

    shipped = pretrained_models()
    entries = []
    for name in list_models():
        model = build_model(name)
        # The counter knows torch's convolutions, not those that are fused where nobody asks for derivatives.
        with FlopCounterMode(display=False) as counter, torch.enable_grad():
            model(_frame())
        macs = counter.get_total_flops() / 2 / _SIDE**2
        parameters = sum(parameter.numel() for parameter in model.parameters()) if isinstance(model, nn.Module) else 0
        needs = model.needs
        entries.append(
            ModelOverview(
                name,
                describe_model(name),
                parameters,
                macs / 1e3,
                name in shipped,
                sorted(needs.buffers),
                sorted(needs.uses),
                needs.trainable,
            )
        )
    return entries


def _frame() -> Frame:
    images: dict[str, Any] = {
        name: torch.rand(1, BUFFERS[name].channels, _SIDE, _SIDE) for name in ("color", "albedo", "normal", "depth")
    }
    return Frame(**images, motion=torch.zeros(1, 2, _SIDE, _SIDE))
