"""A cascade that is small enough for tests of what surrounds it."""

import torch
from torch import nn

from mcdenoise import create_model


def small_model() -> nn.Module:
    torch.manual_seed(0)
    return create_model("cascaded", width=8)
