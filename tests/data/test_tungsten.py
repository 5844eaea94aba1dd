"""One file a buffer, with the variance and the halves of each, as Tungsten writes them."""

from pathlib import Path

import numpy as np
import pytest

from mcdenoise.data import open_sequence, write_exr

SIZE = 9, 10


@pytest.mark.parametrize("pattern", ["{}.exr", "{}0001.exr", "kitchen-{}-0012.exr"])
def test_the_whole_comes_before_its_halves_and_the_rest_is_named(tmp_path: Path, pattern: str) -> None:
    g, written = np.random.default_rng(0), {}
    for buffer in ("color", "albedo", "normal", "depth"):
        for suffix in ("", "Variance", "A", "B"):
            count = 1 if buffer == "depth" else 3
            written[buffer + suffix] = image = g.random((*SIZE, count)).astype(np.float32)
            channels = ["Y"] if count == 1 else ["R", "G", "B"]
            write_exr(tmp_path / pattern.format(buffer + suffix), image, channels, full_float=True)
    sequence = open_sequence(tmp_path)
    assert sequence.buffers == {"color", "albedo", "normal", "depth", "variance"}
    frame = sequence.frame(sequence.numbers[0])
    for name, source in {"color": "color", "variance": "colorVariance", "depth": "depth"}.items():
        np.testing.assert_array_equal(getattr(frame, name)[0].permute(1, 2, 0), written[source])
    taken = {"color", "albedo", "normal", "depth", "colorVariance"}
    assert sorted(sequence.unused) == sorted(pattern.format(name) for name in written.keys() - taken)
