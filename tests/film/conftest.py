import pytest
from shots import Inline


@pytest.fixture
def inline(monkeypatch: pytest.MonkeyPatch) -> None:
    """`mcdenoise film` makes its pieces in this process, which starts at once."""
    monkeypatch.setattr("mcdenoise.cli.film.LocalEngine", lambda workers: Inline())
