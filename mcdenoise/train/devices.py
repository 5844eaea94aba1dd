"""The devices of a run: one, or those of ``torchrun``."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

from mcdenoise.errors import InputError, first_line
from mcdenoise.models._precision import Precision

if TYPE_CHECKING:
    from lightning_fabric import Fabric


def is_first_process() -> bool:
    """Whether this process writes the files of the run: it is the only one, or the first one."""
    return not _launched() or os.environ["RANK"] == "0"


def open_fabric(accelerator: str, precision: Precision, batch: int) -> Fabric:
    """Connect this process with the other processes of its run: one device each, on one or several machines.

    Args:
        accelerator: ``"cpu"`` or ``"cuda"``.
        precision: precision of convolutions.
        batch: clips in a step, which are divided evenly between the processes.

    Raises:
        InputError: the training packages are missing, the accelerator is not available, or the batch cannot be divided.
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
        """Runs convolutions in bfloat16 on float32 radiance; Fabric's own class would also round every input."""

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
        raise InputError(
            f"accelerator '{accelerator}': expected one that works here, such as cpu or cuda, found: "
            f"{first_line(error)}"
        ) from error
    return fabric


def _launched() -> bool:
    # torchrun sets the number of processes, and only torchrun sets the id of the run.
    return "TORCHELASTIC_RUN_ID" in os.environ
