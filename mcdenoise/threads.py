"""How OpenMP's threads wait for one another."""

from __future__ import annotations

import os

# Variables by which a user chooses the behaviour.
_SAID = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")


def wait_passively() -> None:
    """Make OpenMP's threads sleep while they wait, instead of spinning.

    Spinning threads take processor time from a renderer that runs at the same time, and from the threads that they wait
    for: on two cores, one of them busy, single frames took up to eight times as long. On an idle machine there is no
    loss.

    OpenMP reads the setting when torch is imported, so call this before. The setting applies to the whole process, so
    commands and ``mcdenoise.integrations`` call this function, and the rest of the library does not. It has no effect
    if one of the environment variables OMP_WAIT_POLICY, GOMP_SPINCOUNT and KMP_BLOCKTIME is set.
    """
    if not any(name in os.environ for name in _SAID):
        os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
