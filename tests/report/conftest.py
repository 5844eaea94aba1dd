from pathlib import Path

import pytest
from small_benchmark import write_benchmark

from mcdenoise.report import write_report


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("benchmark")
    write_benchmark(root)
    return root


@pytest.fixture(scope="session")
def page(folder: Path) -> Path:
    return write_report(folder)
