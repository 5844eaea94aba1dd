import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from attacker import Attacker
from server import Server

# Numbers of cases and of failed cases, by group.
COUNTS: Counter[tuple[str, str]] = Counter()


@pytest.fixture(scope="session")
def attacker() -> Iterator[Attacker]:
    """Intact files, and a server that runs commands on copies of them."""
    if sys.platform != "linux":
        pytest.skip("forks, and reads /proc")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as base, Server() as server:
        # Cases that run as another user need access.
        Path(base).chmod(0o755)
        yield Attacker(server, Path(base), COUNTS)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if not COUNTS:
        return
    terminalreporter.section("attack: cases by group")
    groups = sorted({group for group, _ in COUNTS})
    for group in [*groups, "all"]:
        cases, failed = (
            sum(n for (each, what), n in COUNTS.items() if group in (each, "all") and what == counted)
            for counted in ("cases", "failed")
        )
        terminalreporter.line(f"{group:<24} {cases:>6} cases, {failed} failed")
