"""Damaged files of every kind that a command or a reader of the API reads."""

import pytest
from attacker import Attacker
from mutations import DAMAGES, PLACES
from table import KINDS, rounds

pytestmark = [pytest.mark.attack, pytest.mark.timeout(1800)]

EVERY = [(kind, command) for kind, target in KINDS.items() for command in target.commands]


@pytest.mark.parametrize(("kind", "command"), EVERY)
def test_damage(attacker: Attacker, kind: str, command: str) -> None:
    seeds = range(len(PLACES) + rounds(command) * len(DAMAGES))
    failed = attacker.damaged(kind, command, seeds, f"damaged files: {command.split()[0]}")
    assert not failed, "\n".join(failed)
