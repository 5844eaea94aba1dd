from pathlib import Path

import pytest
from small_benchmark import write_benchmark

from mcdenoise.report import write_report


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished benchmark."""
    root = tmp_path_factory.mktemp("benchmark")
    write_benchmark(root)
    return root


@pytest.fixture(scope="session")
def page(folder: Path) -> Path:
    """The report of it."""
    return write_report(folder)
