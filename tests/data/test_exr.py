import errno
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

from mcdenoise.data.exr import read_exr, write_exr
from mcdenoise.data.files import atomic_path, write_text
from mcdenoise.data.images import read_image_header

RGB = ["R", "G", "B"]


@pytest.fixture
def image() -> np.ndarray:
    return np.random.default_rng(0).random((40, 50, 3), dtype=np.float32)


def test_half_clamps_to_its_largest_value(tmp_path: Path) -> None:
    image = np.array([[[65504, 65519, 65520], [1e30, np.inf, -np.inf]]], dtype=np.float32)
    write_exr(tmp_path / "a.exr", image, RGB)
    assert read_exr(tmp_path / "a.exr")[0].tolist() == [[[65504] * 3, [65504, 65504, -65504]]]
    write_exr(tmp_path / "a.exr", image, RGB, full_float=True)
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")[0], image)


def test_metadata_is_kept(tmp_path: Path, image: np.ndarray) -> None:
    metadata = {
        "owner of it": "someone",
        "samples": 3,
        "exposure": 0.5,
        "chromaticities": (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329),
        "worldToCamera": tuple(float(i) for i in range(16)),
        "smpte:TimeCode": (1, 2),
        "FramesPerSecond": (24, 1),
        "compression": "piz",
    }
    write_exr(tmp_path / "a.exr", image, RGB, metadata=metadata)
    _, _, found = read_exr(tmp_path / "a.exr")
    assert "compression" not in found
    assert not any(name.startswith(("oiio:", "openexr:")) for name in found)
    for name in metadata.keys() - {"compression"}:
        assert found[name] == pytest.approx(metadata[name]), name
    write_exr(tmp_path / "b.exr", image, RGB, metadata=found)
    assert read_image_header(tmp_path / "b.exr").metadata == found


def test_write_text_is_whole_or_not_at_all(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "eins, zwei, dreißig")
    assert (tmp_path / "a.txt").read_text(encoding="utf-8") == "eins, zwei, dreißig"
    assert "cannot be written" in refused(write_text, tmp_path / "missing" / "a.txt", "x")

    def broken_off(error: BaseException) -> None:
        with atomic_path(tmp_path / "a.txt") as temporary:
            temporary.write_text("half of i")
            raise error

    with pytest.raises(KeyboardInterrupt):
        broken_off(KeyboardInterrupt())
    assert "No space left" in refused(broken_off, OSError(errno.ENOSPC, "No space left on device"))
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text(encoding="utf-8") == "eins, zwei, dreißig"


def test_device_is_never_replaced() -> None:
    assert "a device" in refused(write_text, Path("/dev/null"), "x")
    assert not Path("/dev/null").is_file()


def test_attributes_of_a_texture_do_not_make_one_of_an_image(tmp_path: Path) -> None:
    """A texture has levels of detail: an image that says it is one and has a single level cannot be read."""
    image = np.full((5, 7, 3), 0.5, np.float32)
    write_exr(
        tmp_path / "out.exr", image, ["R", "G", "B"], metadata={"textureformat": "Plain Texture", "scene": "wall"}
    )
    found, _, metadata = read_exr(tmp_path / "out.exr")
    np.testing.assert_array_equal(found, image)
    assert metadata["scene"] == "wall"
    assert "textureformat" not in metadata
