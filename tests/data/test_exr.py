from __future__ import annotations

import errno
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from mcdenoise.data.exr import read_exr, write_exr
from mcdenoise.data.files import atomic_path, write_text
from mcdenoise.data.images import read_image_header
from mcdenoise.errors import InputError

RGB = ["R", "G", "B"]


@pytest.fixture
def image() -> np.ndarray:
    return np.random.default_rng(0).random((40, 50, 3), dtype=np.float32)


def one_line(error: pytest.ExceptionInfo[InputError]) -> str:
    message = str(error.value)
    assert message.count("\n") == 0, message
    return message


def test_round_trip_half_and_zip(tmp_path: Path, image: np.ndarray) -> None:
    write_exr(tmp_path / "a.exr", image, RGB)
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr")[0], image.astype(np.float16).astype(np.float32))
    spec = oiio.ImageInput.open(str(tmp_path / "a.exr")).spec()
    assert str(spec.format) == "half"
    assert spec.getattribute("compression") == "zip"


@pytest.mark.parametrize("channels", [["Y"], ["X", "Y"], ["R", "G", "B", "A"], [f"c{i}" for i in range(9)]])
def test_any_number_of_channels(tmp_path: Path, channels: list[str]) -> None:
    image = np.arange(6 * len(channels), dtype=np.float32).reshape(2, 3, -1)
    for missing in ("missing.exr", "long" * 100 + ".exr", "."):
        with pytest.raises(InputError, match=r"found no such file|found a folder"):
            read_exr(tmp_path / missing)
    write_exr(tmp_path / "a.exr", image, channels)
    pixels, names, _ = read_exr(tmp_path / "a.exr")
    assert names == channels
    np.testing.assert_array_equal(pixels, image)


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


@pytest.mark.parametrize("tiled", [False, True])
def test_truncated_file_is_refused_wherever_it_is_cut(tmp_path: Path, image: np.ndarray, tiled: bool) -> None:
    whole, cut = tmp_path / "a.exr", tmp_path / "cut.exr"
    if tiled:
        spec = oiio.ImageSpec(50, 40, 3, "half")
        spec.tile_width = spec.tile_height = 16
        file = oiio.ImageOutput.create("openexr")
        assert file.open(str(whole), spec)
        assert file.write_image(image)
        assert file.close()
    else:
        write_exr(whole, image, RGB)
    content = whole.read_bytes()
    for length in [*range(0, len(content), 401), *range(len(content) - 8, len(content))]:
        cut.write_bytes(content[:length])
        with pytest.raises(InputError) as error:
            read_exr(cut)
        assert str(cut) in one_line(error)


def test_folder_that_cannot_be_written(tmp_path: Path, image: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"b\.exr: cannot be written") as error:
        write_exr(tmp_path / "missing" / "b.exr", image, RGB)
    assert ".tmp." not in one_line(error)
    (tmp_path / "folder.exr").mkdir()
    with pytest.raises(InputError, match="found a folder"):
        write_exr(tmp_path / "folder.exr", image, RGB)
    assert [path.name for path in tmp_path.iterdir()] == ["folder.exr"]


def test_wrong_shape_is_a_programming_error(tmp_path: Path, image: np.ndarray) -> None:
    with pytest.raises(ValueError, match="expected shape"):
        write_exr(tmp_path / "a.exr", image, ["R", "G"])
    assert list(tmp_path.iterdir()) == []


_FULL_DISK = """
import resource, sys
from pathlib import Path
import numpy as np
from mcdenoise.data.exr import write_exr
from mcdenoise.errors import InputError
folder, size = Path(sys.argv[1]), int(sys.argv[2])
image = np.random.default_rng(0).random((size, size, 3), dtype=np.float32)
write_exr(folder / "a.exr", image, ["R", "G", "B"])
before = (folder / "a.exr").read_bytes()
unlimited = resource.getrlimit(resource.RLIMIT_FSIZE)
for room in [*range(0, len(before), max(len(before) // 8, 1)), len(before) - 1]:
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, unlimited[1]))
    try:
        write_exr(folder / "a.exr", image, ["R", "G", "B"])
        message = "no error"
    except InputError as error:
        message = str(error)
    resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)
    assert "cannot be written" in message and "\\n" not in message, (room, message)
    assert [path.name for path in folder.iterdir()] == ["a.exr"], room
    assert (folder / "a.exr").read_bytes() == before, room
print("done")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="limits the file size through the POSIX resource limit")
@pytest.mark.parametrize("size", [100])
def test_full_disk_is_told_and_the_old_file_stays(tmp_path: Path, size: int) -> None:
    command = [sys.executable, "-c", _FULL_DISK, str(tmp_path), str(size)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout) == (0, "done\n"), result.stderr


def test_write_text_is_whole_or_not_at_all(tmp_path: Path) -> None:
    write_text(tmp_path / "a.txt", "eins, zwei, dreißig")
    assert (tmp_path / "a.txt").read_text(encoding="utf-8") == "eins, zwei, dreißig"
    with pytest.raises(InputError, match="cannot be written"):
        write_text(tmp_path / "missing" / "a.txt", "x")

    def interrupted() -> None:
        with atomic_path(tmp_path / "a.txt") as temporary:
            temporary.write_text("half of i")
            raise KeyboardInterrupt

    def full() -> None:
        with atomic_path(tmp_path / "a.txt") as temporary:
            temporary.write_text("half of i")
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    with pytest.raises(InputError, match="No space left"):
        full()
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]
    assert (tmp_path / "a.txt").read_text(encoding="utf-8") == "eins, zwei, dreißig"


def test_device_is_never_replaced() -> None:
    with pytest.raises(InputError, match="a device"):
        write_text(Path("/dev/null"), "x")
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
