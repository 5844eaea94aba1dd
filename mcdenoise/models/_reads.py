"""Whether a step may look at values on its way, to leave out what they make needless.

On a processor a look costs nothing beside what it saves. On any other device the host would wait for all that it has
asked for so far, at every look; so a step makes none there, and computes what a recorded graph computes.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

_out_of_reach = False


def at_hand(device: torch.device) -> bool:
    """Whether values on a device may be read while a step runs; of a graph that is recorded there are none."""
    return device.type == "cpu" and not _out_of_reach and not torch.compiler.is_compiling()


@contextmanager
def out_of_reach() -> Iterator[None]:
    """Within it, in all threads, steps on a processor look at no values, as on a GPU."""
    global _out_of_reach
    before, _out_of_reach = _out_of_reach, True
    try:
        yield
    finally:
        _out_of_reach = before
