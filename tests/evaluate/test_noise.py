"""Noise of references."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from mcdenoise.data import open_sequence
from mcdenoise.evaluate import reference_noise


def noted(write: Callable[[str], object], noise: object) -> None:
    write(json.dumps({"color_includes_albedo": True, "reference_noise": noise}))


def test_the_noise_of_the_references_is_read_from_the_renderers_file(small_sequence: Path) -> None:
    described = small_sequence / "inputs" / "camera.json"
    assert reference_noise(open_sequence(small_sequence)) is None
    # A reference without an estimate is skipped.
    noted(described.write_text, {"0": 0.01, "1": 0.03, "2": None})
    for path in (small_sequence, small_sequence / "inputs"):
        assert reference_noise(open_sequence(path)) == pytest.approx(0.02)
    assert reference_noise(open_sequence(small_sequence, "1-3")) == pytest.approx(0.03)
    described.unlink()
    assert reference_noise(open_sequence(small_sequence)) is None
