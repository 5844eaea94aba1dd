"""Files to read: those of real renderers, and those with the names of others."""

import runpy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

Image = np.ndarray[Any, Any]


@pytest.fixture(scope="session")
def rendered() -> Path:
    return Path(__file__).parents[1] / "renderers"


@pytest.fixture(scope="session")
def others(rendered: Path) -> Any:
    """The script that writes files with the channel names of renderers which did not run here."""
    return SimpleNamespace(**runpy.run_path(str(rendered / "others.py")))
