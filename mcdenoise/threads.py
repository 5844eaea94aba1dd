"""How threads wait for one another."""

from __future__ import annotations

import os

# Whatever of these a user has set is what the user wants.
_SAID = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "KMP_BLOCKTIME")


def wait_passively() -> None:
    """Let OpenMP's threads sleep where they have to wait, instead of spinning.

    Spinning threads take the processor from a renderer beside them, and wait for threads that cannot run meanwhile: on
    two cores, one of them busy, single frames took up to eight times as long. On a quiet machine nothing is lost.

    OpenMP reads this when torch is imported, so that it is to be said before. It is a setting of the whole process and
    so a decision of whoever owns it: commands make it, the library does not. Does nothing where one of the environment
    variables OMP_WAIT_POLICY, GOMP_SPINCOUNT and KMP_BLOCKTIME is set.
    """
    if not any(name in os.environ for name in _SAID):
        os.environ["OMP_WAIT_POLICY"] = "PASSIVE"
