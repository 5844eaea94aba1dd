"""Damaged files of every kind that a command or a reader of the API reads."""

from __future__ import annotations

import pytest
from attacker import Attacker
from mutations import PLACES
from table import KINDS

EVERY = [(kind, command, count) for kind, target in KINDS.items() for command, count in target.commands.items()]
READ = [(kind, command) for kind, command, _ in EVERY if command.startswith("reader")]
FIRST = [
    # A film starts processes for every case.
    pytest.param(kind, command, marks=[pytest.mark.slow] if command.startswith("film") else [])
    for kind, target in KINDS.items()
    for command in list(target.commands)[:1]
]


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "command"), FIRST)
def test_some_damage(attacker: Attacker, kind: str, command: str) -> None:
    failed = attacker.damaged(kind, command, range(len(PLACES), len(PLACES) + 3), "damaged files, some")
    assert not failed, "\n".join(failed)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "command"), READ)
def test_replaced_files(attacker: Attacker, kind: str, command: str) -> None:
    """Folders, pipes, devices, and links to nothing and to themselves instead of a file do not make a command hang."""
    failed = attacker.damaged(kind, command, range(len(PLACES)), "places, some")
    assert not failed, "\n".join(failed)


@pytest.mark.attack
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(("kind", "command", "count"), EVERY)
def test_damage(attacker: Attacker, kind: str, command: str, count: int) -> None:
    failed = attacker.damaged(kind, command, range(count), f"damaged files: {command.split()[0]}")
    assert not failed, "\n".join(failed)
