"""A cascade that is small enough for tests of what surrounds it."""

import torch
from torch import nn

from mcdenoise import create_model
from mcdenoise.models._wrapper import parts_of
from mcdenoise.models.cascaded_v2 import PixelNetwork


def small_model() -> nn.Module:
    """A cascade of width 8 with random weights, also in the heads that start at zero."""
    torch.manual_seed(0)
    model = create_model("cascaded_v2", width=8)
    assert isinstance(model, nn.Module)
    for head in next(parts_of(model, PixelNetwork)).heads:
        nn.init.normal_(head.weight, std=0.02)
    return model
