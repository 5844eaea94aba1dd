"""Damaged files of every kind that a command or a reader of the API reads."""

import pytest
from attacker import Attacker
from table import KINDS

EVERY = [(kind, command, count) for kind, target in KINDS.items() for command, count in target.commands.items()]


@pytest.mark.attack
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(("kind", "command", "count"), EVERY)
def test_damage(attacker: Attacker, kind: str, command: str, count: int) -> None:
    failed = attacker.damaged(kind, command, range(count), f"damaged files: {command.split()[0]}")
    assert not failed, "\n".join(failed)
