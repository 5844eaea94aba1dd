"""Damaged files: no crash, no hang, no memory that the file does not need, and one clear line for each.

Images of every kind that renderers write are read whole and written whole again, so that no damage gets as far as the
library that writes; or refused. Files are read by ``fuzz_worker.py``, in processes that a fault may kill and with half
a gigabyte of memory; the generator is seeded, so that a failure can be seen again.
"""

import struct
import zlib
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from damage import DAMAGES, Generator, assert_clear, attribute, outcomes
from pictures import part_of, save

RENDERERS = Path(__file__).with_name("renderers")
COMPRESSIONS = ("NO", "RLE", "ZIPS", "ZIP", "PIZ", "PXR24", "B44", "B44A", "DWAA", "DWAB", "HTJ2K256", "HTJ2K32")
SIZE = 19, 23

pytestmark = pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="measures memory through /proc")


def drawn(channels: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((*SIZE, channels), dtype=np.float32)


def layers(kind: type = np.float16) -> dict[str, np.ndarray]:
    names = [f"View.Combined.{c}" for c in "RGBA"] + [f"View.Denoising Albedo.{c}" for c in "RGB"]
    names += [f"View.Denoising Normal.{c}" for c in "XYZ"] + ["View.Depth.Z", "View.Vector.X", "View.Vector.Y"]
    return {name: drawn(1, i)[..., 0].astype(kind) for i, name in enumerate(names)}


def write_exr(path: Path, *parts: dict[str, np.ndarray], compression: str = "ZIP", **header: object) -> None:
    header["compression"] = getattr(OpenEXR, f"{compression}_COMPRESSION")
    made = [part_of(each, f"part{i}" if len(parts) > 1 else "", **header) for i, each in enumerate(parts)]
    OpenEXR.File(made).write(str(path))


def write_picture(path: Path, channels: int, kind: str, *, tile: int = 0, **attributes: object) -> None:
    names = {1: "Y", 3: "RGB", 4: "RGBA"}[channels]
    images = dict(zip(names, np.moveaxis(drawn(channels), -1, 0), strict=True))
    save(path, images, kind, tile_width=tile, tile_height=tile, **attributes)


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("intact")
    for compression in COMPRESSIONS:
        # A few bytes of DWA may be a large black image, so that a larger file may ask for more than is allowed here.
        small = {c: drawn(1)[..., 0].astype(np.float16) for c in "RGB"}
        write_exr(folder / f"{compression}.exr", small if "DWA" in compression else layers(), compression=compression)
    write_exr(folder / "floats.exr", layers(np.float32))
    write_exr(folder / "parts.exr", layers(), {"X.R": drawn(1)[..., 0], "Y.Z": drawn(1)[..., 0]})
    write_exr(folder / "tiled.exr", layers(), type=OpenEXR.tiledimage, tiles=OpenEXR.TileDescription())
    write_picture(folder / "mips.exr", 3, "half", tile=16, textureformat="Plain Texture")
    for name, layer in (("color", "rgb"), ("grey", "y")):
        for endian in ("little", "big"):
            write_picture(folder / f"{name}_{endian}.pfm", len(layer), "float", pnm__bigendian=int(endian == "big"))
    write_picture(folder / "light.hdr", 3, "float")
    write_picture(folder / "float.tif", 3, "float", compression="none")
    write_picture(folder / "deflate.tif", 4, "uint16", compression="zip")
    write_picture(folder / "tiled.tif", 3, "float", tile=16, compression="lzw")
    for channels, name in ((1, "grey"), (3, "rgb"), (4, "rgba")):
        for bits in (8, 16):
            write_picture(folder / f"{name}{bits}.png", channels, f"uint{bits}")
    files = {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
    files["blender5.exr"] = (RENDERERS / "blender5" / "shot_0001.exr").read_bytes()
    files["palette.png"] = palette()
    return files


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def palette() -> bytes:
    rows = b"".join(b"\0" + bytes((x + y) % 4 for x in range(SIZE[1])) for y in range(SIZE[0]))
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", SIZE[1], SIZE[0], 8, 3, 0, 0, 0))
        + chunk(b"PLTE", bytes(range(12)))
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


def absurd_sides(g: Generator, content: bytes) -> bytes:
    w, h = (int(2 ** g.uniform(0, 31)) for _ in range(2))
    if g.random() < 0.3:
        w, h = 100_000, 100_000
    elif g.random() < 0.5:
        w, h = 2 ** int(g.integers(5, 15)), 2 ** int(g.integers(5, 14))
    if content.startswith(b"\x89PNG"):
        header = struct.pack(">II", w, h) + content[24:29]
        return content[:8] + chunk(b"IHDR", header) + content[33:]
    if content.startswith(b"II*"):
        damaged = bytearray(content)
        (start,) = struct.unpack_from("<I", content, 4)
        (count,) = struct.unpack_from("<H", content, start)
        for place in range(start + 2, start + 2 + 12 * count, 12):
            (tag,) = struct.unpack_from("<H", content, place)
            # These tags include tiles and strips as large as the image.
            if tag in (256, 257, 278, 322, 323) and g.random() < 0.7:
                struct.pack_into("<HHII", damaged, place, tag, 4, 1, w if tag in (256, 322) else h)
        return bytes(damaged)
    old = b"-Y %d +X %d" % SIZE if content.startswith(b"#?") else b"%d %d" % SIZE[::-1]
    new = b"-Y %d +X %d" % (h, w) if content.startswith(b"#?") else b"%d %d" % (w, h)
    return content.replace(old, new, 1)


def with_checksums(content: bytes) -> bytes:
    """A damaged PNG whose chunks have the checksums of what they hold now."""
    place, repaired = 8, content[:8]
    while place + 12 <= len(content):
        (length,) = struct.unpack_from(">I", content, place)
        if place + 12 + length > len(content):
            break
        repaired += chunk(content[place + 4 : place + 8], content[place + 8 : place + 8 + length])
        place += 12 + length
    return repaired + content[place:]


# Other formats have neither a list of channels nor the windows of EXR.
OTHER_DAMAGES = (*DAMAGES[:5], absurd_sides, absurd_sides, DAMAGES[-1])


def test_damaged_images(tmp_path: Path, intact: dict[str, bytes]) -> None:
    g, files, count = np.random.default_rng(0), {}, 160
    for i in range(count):
        name = sorted(intact)[i % len(intact)]
        damages = DAMAGES if name.endswith(".exr") else OTHER_DAMAGES
        way = damages[int(g.integers(len(damages)))]
        content = way(g, intact[name])
        if name.endswith(".png") and g.random() < 0.7:
            content = with_checksums(content)
        files[f"{way.__name__}_{i:04d}x_{name}"] = content
    found = outcomes(tmp_path / "damaged", files, tmp_path / "written")
    assert_clear(tmp_path / "damaged", found)
    refused = {name for name, outcome in found.items() if outcome}
    assert len(refused) > count / 3
    assert {name for name in files if name.startswith("noise")} <= refused
    for name in refused:
        assert not list((tmp_path / "written").glob(f"{name}/*")), name


def test_intact_files_come_out_as_they_went_in(tmp_path: Path, intact: dict[str, bytes]) -> None:
    found = outcomes(tmp_path / "intact", intact, tmp_path / "written")
    expected = dict.fromkeys(intact, "") | {"mips.exr": "found a texture of several resolutions"}
    assert all((words in found[name]) and bool(words) == bool(found[name]) for name, words in expected.items())


def test_a_hollow_file_takes_no_memory(tmp_path: Path, intact: dict[str, bytes]) -> None:
    """16384 x 16383 pixels are few enough for any image, but not in a kilobyte."""
    window = struct.pack("<4i", 0, 0, 2**14 - 1, 2**14 - 2)
    files = {
        name: attribute(attribute(content, b"dataWindow", b"box2i", window), b"displayWindow", b"box2i", window)
        for name, content in intact.items()
        if name.endswith(".exr") and name != "blender5.exr"
    }
    found = outcomes(tmp_path / "exr", files, tmp_path / "written")
    assert_clear(tmp_path / "exr", found)
    assert all(found.values())
