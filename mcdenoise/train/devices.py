"""The devices a run uses: one, or those that ``torchrun`` gives it."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from mcdenoise.errors import InputError
from mcdenoise.models import FloatPrecision

if TYPE_CHECKING:
    from lightning_fabric import Fabric


def is_first_process() -> bool:
    """Whether this process is the only one of its run, or the one among several that writes."""
    return not _launched() or os.environ["RANK"] == "0"


def open_fabric(accelerator: str, precision: FloatPrecision, batch: int) -> Fabric:
    """Connect this process with the others of its run: one device each, on one machine or several.

    Args:
        accelerator: ``"cpu"`` or ``"cuda"``.
        precision: of the convolutions.
        batch: clips in a step, to be shared out evenly.

    Raises:
        InputError: the training packages are missing, there is no such accelerator, or the batch cannot be shared out.
    """
    try:
        from lightning_fabric import Fabric
        from lightning_fabric.plugins import MixedPrecision
    except ImportError as error:
        raise InputError(
            f"training: expected the optional packages of mcdenoise[train], found no '{error.name}'; "
            "install them with pip install 'mcdenoise[train]'"
        ) from error

    class Autocast(MixedPrecision):
        """Convolutions in bfloat16 of radiance that keeps all its digits: Fabric would round every input, too."""

        def convert_input(self, data: Any) -> Any:
            return data

    processes, here = (int(os.environ[name]) if _launched() else 1 for name in ("WORLD_SIZE", "LOCAL_WORLD_SIZE"))
    if batch % processes:
        raise InputError(f"batch: expected a multiple of the {processes} processes, found {batch}")
    try:
        fabric = Fabric(
            accelerator=accelerator,
            devices=here,
            num_nodes=processes // here,
            strategy="ddp" if processes > 1 else "auto",
            plugins=Autocast("bf16-mixed", accelerator) if precision == "bfloat16" else None,
        )
        fabric.launch()
    except (RuntimeError, ValueError, ImportError) as error:
        reason = next(iter(str(error).splitlines()), type(error).__name__)
        raise InputError(
            f"accelerator '{accelerator}': expected one that works here, such as cpu or cuda, found: {reason}"
        ) from error
    return fabric


def _launched() -> bool:
    # torchrun says how many processes there are, and only torchrun says which run it is.
    return "TORCHELASTIC_RUN_ID" in os.environ
