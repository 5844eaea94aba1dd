"""Whether a step may read tensor values on the host, to skip work that they make unnecessary.

On a CPU, reading a value costs little compared with what it saves. On any other device, every read makes the host wait
for all queued work, so a step reads nothing there and computes everything, as a recorded graph does.
"""

from __future__ import annotations

import torch

from mcdenoise.ops._backend import is_transformed


def at_hand(device: torch.device) -> bool:
    """Whether the host may read values on a device while a step runs; a graph being recorded, or ``vmap``, has none."""
    return device.type == "cpu" and not torch.compiler.is_compiling() and not is_transformed()
