"""Files to read: those of real renderers, and those with the names of others."""

import importlib.util
from pathlib import Path
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
    spec = importlib.util.spec_from_file_location("others", rendered / "others.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
