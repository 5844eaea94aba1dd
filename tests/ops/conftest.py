from collections.abc import Iterator

import pytest
import torch


@pytest.fixture
def nan_in_fresh_memory() -> Iterator[None]:
    """What is left to be written is filled with NaN, so that what was forgotten shows."""
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)
