"""Commands that are killed at random moments, or run twice at once."""

import signal

import numpy as np
import pytest
from attacker import Attacker, aged, unreadable
from server import Process
from table import COMMANDS

pytestmark = [pytest.mark.attack, pytest.mark.timeout(1800)]

KILLED = {"denoise": 18, "denoise layers": 9, "denoise again": 9, "film": 9, "film again": 6, "train": 6}


@pytest.mark.parametrize(("name", "count"), KILLED.items())
def test_killed(attacker: Attacker, name: str, count: int) -> None:
    """No incomplete file has a final name, and the result of running the command again is as without the kill."""
    failed, command, g = [], COMMANDS[name], np.random.default_rng(1)
    attacker.expected(name)
    folder = attacker.fresh(command.needs)
    longest = attacker.run(command.command, folder).seconds
    for seed in range(count):
        folder = attacker.fresh(command.needs)
        how = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM)[seed % 3]
        attacker.run(command.command, folder, kill_after=float(g.uniform(0, 1.1 * longest)), signal=how)
        problem = unreadable(folder / command.out)
        aged(folder)
        if not problem:
            ended = attacker.run(command.command, folder)
            problem = attacker.judge(name, folder, ended, same=True, needed=True)
        failed += attacker.count("killed", problem, f"{name}, kill {seed}", folder)
    assert not failed, "\n".join(failed)


@pytest.mark.parametrize(("name", "count"), KILLED.items())
def test_two_at_once(attacker: Attacker, name: str, count: int) -> None:
    """Two runs in one folder: each succeeds or is rejected in one line, and the final files are complete."""
    failed, command, g = [], COMMANDS[name], np.random.default_rng(2)
    attacker.expected(name)
    for seed in range(count // 2):
        folder = attacker.fresh(command.needs)
        one = Process(command.command, str(folder))
        other = Process(command.command, str(folder), delay=float(g.uniform(0, 0.2)))
        ended = attacker.server.run(one, other)
        needed = name != "train" and not name.startswith("film")
        problems = [attacker.judge(name, folder, each, same=True, needed=needed) for each in ended]
        if not any(each.status == 0 for each in ended):
            problems.append("neither is done")
        failed += attacker.count("two at once", next(filter(None, problems), ""), f"{name}, {seed}", folder)
    assert not failed, "\n".join(failed)
