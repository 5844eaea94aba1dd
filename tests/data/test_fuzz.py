"""Damaged and hostile files: no crash, no hang, no memory that the file does not need, and one clear line for each.

Whatever the bytes are, a file is read or refused. Files are read by ``fuzz_worker.py``, in processes that a fault may
kill and with half a gigabyte of memory; the generator is seeded, so that a failure can be seen again.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from damage import DAMAGES, Generator, assert_clear, attribute, flipped, outcomes, spliced, truncated

from mcdenoise.data.camera_matrices import CameraMatrices, write_camera_matrices

COMPRESSIONS = ("none", "rle", "zips", "zip", "piz", "pxr24", "b44", "b44a", "dwaa", "dwab")

pytestmark = pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="measures memory through /proc")


def write(path: Path, pixels: np.ndarray, kind: str = "half", **attributes: object) -> None:
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    for name, value in attributes.items():
        if name == "tile":
            spec.tile_width = spec.tile_height = int(str(value))
        else:
            spec.attribute(name, value)
    file = oiio.ImageOutput.create("openexr")
    assert file.open(str(path), spec), file.geterror()
    assert file.write_image(pixels)
    assert file.close()


def write_parts(path: Path, pixels: np.ndarray) -> None:
    """A file of two parts."""
    specs = []
    for name in ("first", "second"):
        spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], "half")
        spec.attribute("oiio:subimagename", name)
        specs.append(spec)
    file = oiio.ImageOutput.create("openexr")
    assert file.open(str(path), tuple(specs)), file.geterror()
    assert file.write_image(pixels)
    assert file.open(str(path), specs[1], "AppendSubimage"), file.geterror()
    assert file.write_image(pixels)
    assert file.close()


def write_deep(path: Path, size: int) -> None:
    spec = oiio.ImageSpec(size, size, 3, "half")
    spec.deep = True
    data = oiio.DeepData()
    data.init(spec)
    for pixel in range(size * size):
        data.set_samples(pixel, pixel % 3)
    file = oiio.ImageOutput.create("openexr")
    assert file.open(str(path), spec), file.geterror()
    assert file.write_deep_image(data)
    assert file.close()


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Contents of small files of every kind that OpenImageIO writes."""
    folder, g = tmp_path_factory.mktemp("intact"), np.random.default_rng(0)
    pixels = g.random((21, 17, 3), dtype=np.float32)
    for compression in COMPRESSIONS:
        write(folder / f"{compression}.exr", pixels, compression=compression)
    write(folder / "float.exr", pixels, "float")
    write(folder / "uint.exr", pixels, "uint")
    write(folder / "tiled.exr", pixels, tile=8)
    write(folder / "mips.exr", pixels, tile=8, textureformat="Plain Texture")
    write(folder / "single.exr", pixels[..., :1])
    write(folder / "many.exr", g.random((5, 4, 40), dtype=np.float32))
    write(folder / "attributes.exr", pixels, **{f"name{i}": "text " * i for i in range(9)})
    write_parts(folder / "parts.exr", pixels)
    write_deep(folder / "deep.exr", 9)
    return {path.stem: path.read_bytes() for path in sorted(folder.iterdir())}


MATRICES_TEXT = (
    b"{",
    b"}",
    b",",
    b";",
    b"=",
    b"[",
    b"]",
    b"nan",
    b"1e999",
    b"-",
    b"0x",
    b"//",
    b"/*",
    b"\0",
    b"\xff",
    b"9" * 400,
)


def damaged_matrices(g: Generator, content: bytes) -> bytes:
    """Damage as of any file, pieces of C thrown in, and very deep and very long initialisers."""
    choice = int(g.integers(0, 6))
    if choice == 0:
        return truncated(g, content)
    if choice == 1:
        return flipped(g, content)
    if choice == 2:
        return spliced(g, content)
    if choice == 3:
        depth = int(10 ** g.uniform(1, 5))
        return content.replace(b"= {", b"= " + b"{" * depth, 1)
    if choice == 4:
        count = int(10 ** g.uniform(1, 5))
        return content.replace(b"= {", b"= {" + b"{1.0f}, " * count, 1)
    for _ in range(int(g.integers(1, 20))):
        start = int(g.integers(0, len(content)))
        content = content[:start] + MATRICES_TEXT[int(g.integers(0, len(MATRICES_TEXT)))] + content[start:]
    return content


def fuzz(tmp_path: Path, intact: dict[str, bytes], count: int, seed: int) -> None:
    g, folder = np.random.default_rng(seed), tmp_path / "exr"
    files = {}
    for i in range(count):
        damage, kind = DAMAGES[i % len(DAMAGES)], str(g.choice(list(intact)))
        files[f"{i:05d}_{damage.__name__}_{kind}.exr"] = damage(g, intact[kind])
    found = outcomes(folder, files)
    assert_clear(folder, found)
    # Damaged pixels may still be pixels, but noise is no image, nor is a file that is cut short (in its first part).
    refused = {name for name, outcome in found.items() if outcome}
    assert len(refused) > count / 3
    assert {name for name in files if "noise" in name} <= refused
    assert {name for name in files if "truncated" in name and "parts" not in name} <= refused


def fuzz_matrices(tmp_path: Path, count: int, seed: int) -> None:
    g, folder = np.random.default_rng(seed), tmp_path / "matrices"
    cameras = CameraMatrices(g.normal(size=(5, 4, 4)), np.full((5, 2), 0.5), 0.01, 0.25)
    write_camera_matrices(tmp_path / "camera_matrices.h", cameras, "scene")
    content = (tmp_path / "camera_matrices.h").read_bytes()
    found = outcomes(folder, {f"{i:05d}.h": damaged_matrices(g, content) for i in range(count)})
    assert_clear(folder, found)
    assert sum(bool(outcome) for outcome in found.values()) > count / 3


def test_intact_files_are_read_or_refused_for_what_they_are(tmp_path: Path, intact: dict[str, bytes]) -> None:
    found = outcomes(tmp_path / "exr", {f"{kind}.exr": content for kind, content in intact.items()})
    assert {name: outcome.partition("found ")[2] for name, outcome in found.items() if outcome} == {
        "deep.exr": "a deep image; render a flat EXR of at most 2^28 pixels",
        "mips.exr": "a texture of several resolutions; render a flat EXR of at most 2^28 pixels",
        "uint.exr": "whole numbers; render a flat EXR of at most 2^28 pixels",
    }


def test_a_hollow_file_takes_no_memory(tmp_path: Path, intact: dict[str, bytes]) -> None:
    """16384 x 16383 pixels are few enough for any image, but not in a kilobyte."""
    window = struct.pack("<4i", 0, 0, 2**14 - 1, 2**14 - 2)
    files = {
        f"{kind}.exr": attribute(
            attribute(content, b"dataWindow", b"box2i", window), b"displayWindow", b"box2i", window
        )
        for kind, content in intact.items()
    }
    found = outcomes(tmp_path / "exr", files)
    assert_clear(tmp_path / "exr", found)
    assert all(found.values())


def test_damaged_exrs(tmp_path: Path, intact: dict[str, bytes]) -> None:
    fuzz(tmp_path, intact, 320, seed=0)


def test_damaged_camera_matrices(tmp_path: Path) -> None:
    fuzz_matrices(tmp_path, 120, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 9))
def test_damaged_exrs_at_length(tmp_path: Path, intact: dict[str, bytes], seed: int) -> None:
    fuzz(tmp_path, intact, 400, seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 5))
def test_damaged_camera_matrices_at_length(tmp_path: Path, seed: int) -> None:
    fuzz_matrices(tmp_path, 400, seed)
