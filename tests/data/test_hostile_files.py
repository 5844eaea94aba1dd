"""Files that are whole and yet no image of a frame, or that have names to trip over: refused in one line, or read."""

import os
import shutil
import struct
from pathlib import Path

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest
from damage import assert_clear, outcomes_of
from pictures import part_of, save
from refusals import full_disk

from mcdenoise.cli.inspect import print_sequence
from mcdenoise.data import open_sequence
from mcdenoise.errors import InputError, printable

SIZE = 11, 13
# All that a terminal, a table, a path, `--map` or this project's own reading of names could trip over.
NAMES = (
    *("a\nb", "a\rb", "\x1b[31mred", "x\ty", "\x7f", "\x9b", "\u202eabc", "\u2028", "ä€𝄞", " ", "a,b", "a=b", "%s%n"),
    *(".", "..", ".R", "R.", "R..G", "[bold]", "/", "\\", "'", '"', "$(id)", "*", "a" * 31, "b" * 32, "c" * 240),
)


def pixels(kind: type = np.float16) -> np.ndarray:
    values = np.random.default_rng(0).random(SIZE)
    return (values * 4e9).astype(kind) if kind is np.uint32 else values.astype(kind)


def part(channels: object, name: str = "", **header: object) -> OpenEXR.Part:
    made = channels if isinstance(channels, dict) else {each: pixels() for each in channels}
    return part_of(made, name, **header)


def write(path: Path, *parts: OpenEXR.Part) -> Path:
    OpenEXR.File(list(parts)).write(str(path))
    return path


def deep() -> dict[str, np.ndarray]:
    samples = np.empty(SIZE, object)
    for place in np.ndindex(SIZE):
        samples[place] = np.ones(2, np.float16)
    return {each: samples for each in "RGB"}


def subsampled(path: Path) -> None:
    """Only the header says so: the list of channels has the sampling at the end of each."""
    content = write(path, part("RGB")).read_bytes()
    start = content.index(b"B\0" + struct.pack("<i4B2i", 1, 0, 0, 0, 0, 1, 1)) + 2 + 8
    path.write_bytes(content[:start] + struct.pack("<2i", 2, 2) + content[start + 8 :])


def test_a_file_that_is_no_picture_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "files"
    folder.mkdir()
    whole = {each: pixels(kind=np.uint32) for each in "RGB"}
    write(folder / "whole.exr", part(whole))
    write(folder / "chroma.exr", part(["Y", "RY", "BY"]))
    write(folder / "chroma_layer.exr", part(["View.color.Y", "View.color.RY", "View.color.BY"]))
    write(folder / "deep.exr", part(deep(), type=OpenEXR.deepscanline))
    write(folder / "deep_beside.exr", part("RGB", "flat"), part(deep(), "deep", type=OpenEXR.deepscanline))
    write(folder / "twice.exr", part("RGB", "one"), part("RGB", "two"))
    write(folder / "many.exr", part([f"{i}.{each}" for i in range(1400) for each in "RGB"]))
    subsampled(folder / "subsampled.exr")
    picture = oiio.ImageBuf(oiio.ImageSpec(*SIZE, 3, "half"))
    assert oiio.ImageBufAlgo.make_texture(oiio.MakeTxTexture, picture, str(folder / "mips.exr"))
    write(folder / "exr.png", part("RGB"))
    for suffix in ("exr", "png", "hdr", "pfm", "tif"):
        (folder / f"empty.{suffix}").touch()
    (folder / "folder.exr").mkdir()
    (folder / "nowhere.exr").symlink_to("nothing")
    (folder / "loop.exr").symlink_to("loop.exr")
    os.mkfifo(folder / "pipe.exr")
    (folder / "endless.exr").symlink_to("/dev/zero")
    shutil.copy(write(tmp_path / "intact.exr", part("RGB")), os.fsencode(folder) + b"/not\xff.exr")
    found = outcomes_of(folder, tmp_path / "written")
    # Another reason would be none of these files' own.
    expected = {
        "whole.exr": "found no layers of floats",
        "chroma.exr": "found luminance and chroma",
        "chroma_layer.exr": "found luminance and chroma",
        "deep.exr": "found a deep image",
        "deep_beside.exr": "found a deep image",
        "twice.exr": "found one.RGB, two.RGB;",
        "many.exr": "does not support 4200-channel images",
        "subsampled.exr": "cannot be opened",
        "mips.exr": "found a texture of several resolutions",
        "exr.png": "found a file of the format openexr",
        "folder.exr": "a folder",
        "nowhere.exr": "a link to nothing",
        "loop.exr": "a link to nothing",
        "pipe.exr": "a device or a pipe",
        "endless.exr": "a device or a pipe",
        "not\udcff.exr": "expected a name in UTF-8",
        **{f"empty.{suffix}": "cannot be opened" for suffix in ("exr", "png", "hdr", "pfm", "tif")},
    }
    assert found.keys() == expected.keys()
    for name, words in expected.items():
        assert words in found[name], f"{name}: {found[name]}"
    assert_clear(folder, {name: each for name, each in found.items() if "\udcff" not in name})
    assert all(each.isprintable() for each in found.values())
    assert not list((tmp_path / "written").glob("*/*"))


def test_names_of_every_kind_are_read_written_and_spelled_out(tmp_path: Path) -> None:
    folder = tmp_path / "files"
    folder.mkdir()
    for i, name in enumerate(NAMES):
        write(folder / f"beside{i}.exr", part(["R", "G", "B", name, f"{name}.q"]))
        write(folder / f"layer{i}.exr", part([f"{name}.Combined.{each}" for each in "RGB"]))
        # Two that might be it: the message has their names.
        write(folder / f"part{i}.exr", part("RGB", f"{name}1"), part("RGB", f"{name}2"))
    for name in ("line\nbreak.exr", "\x1b[2J.exr", "%d####.exr", f"{'n' * 200}.exr", "-o.exr", " .exr"):
        write(folder / name, part("RGB"))
    found = outcomes_of(folder, tmp_path / "written")
    assert_clear(folder, found)
    # `.R` beside R, G, B is another red of theirs.
    refused = {f"beside{NAMES.index('.R')}.exr", *(f"part{i}.exr" for i in range(len(NAMES)))}
    assert {name for name, each in found.items() if each} == refused
    for i, name in enumerate(NAMES):
        assert f"{printable(name)}1.RGB" in found[f"part{i}.exr"]


def test_the_screen_shows_names_as_they_are(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = [f"{name}.{each}" for name in ("[/x]", "[red]\x1b[2J", "[/x].Denoising Albedo") for each in "RGB"]
    write(tmp_path / "shot.exr", part(["R", "G", "B", *names, "[red]\n.Depth.Z"]))
    print_sequence(open_sequence([tmp_path / "shot.exr"], mapping=["albedo=[/x].Denoising Albedo"]))
    shown = capsys.readouterr().out
    assert "[/x].Denoising Albedo.RGB" in shown
    assert r"[red]\n.Depth.Z" in shown
    assert "\x1b" not in shown


@pytest.mark.parametrize("seed", range(2))
def test_any_values_are_read_and_written_without_a_warning(tmp_path: Path, seed: int) -> None:
    """Infinite ones and none at all too; more of them in some layers than in others, and in some all alike."""
    g, size = np.random.default_rng(seed), (40, 48)
    wild = np.array([np.nan, np.inf, -np.inf, 3e38, -3e38, 1e-45, 0, -1, 65504], np.float32)
    names = {"Combined": "RGBA", "Denoising Albedo": "RGB", "Normal": "XYZ", "Depth": "Z", "Position": "XYZ"}
    names |= {"Vector": "XYZW", "Noisy Image": "RGB", "own": "XYZ"}
    for number in range(3):
        channels = {}
        for name, letters in names.items():
            amount = g.choice([0, 0.01, 0.5, 1])
            chosen = wild if g.random() < 0.7 else wild[g.integers(len(wild))][None]
            for letter in letters:
                values = g.normal(size=size).astype(np.float32)
                where = g.random(size) < amount
                values[where] = g.choice(chosen, int(where.sum()))
                channels[f"View.{name}.{letter}"] = values
        write(tmp_path / f"shot{number}.exr", part(channels))
    sequence = open_sequence(tmp_path)
    (tmp_path / "out").mkdir()
    for number in sequence.numbers:
        assert sequence.frame(number).size == size
        sequence.write(tmp_path / "out", number, np.zeros((*size, 3), np.float32))


@pytest.mark.skipif(
    not Path("/proc/self/statm").exists(), reason="limits the file size through the POSIX resource limit"
)
@pytest.mark.parametrize(
    ("name", "kind"),
    [("pic.exr", "half"), ("pic.png", "uint8"), ("pic.tif", "float"), ("pic.hdr", "float"), ("pic.pfm", "float")],
)
def test_a_full_disk_is_told_to_the_last_byte(tmp_path: Path, name: str, kind: str) -> None:
    """The libraries say nothing of what they still hold back when the disk is full, of a small file all of it."""
    size = (70, 90) if kind == "half" else (6, 8)
    noise = np.random.default_rng(0).random((*size, 3), dtype=np.float32)
    save(tmp_path / name, dict(zip("RGB", np.moveaxis(noise, -1, 0), strict=True)), kind)
    sequence, out = open_sequence([tmp_path / name]), tmp_path / "out"
    out.mkdir()
    # The length is that of the file as it will be.
    length = sequence.write(out, 0, noise).stat().st_size
    (out / name).unlink()
    rooms = {100, length // 2, length - 5000, length - 100, length - 1, *range(1, length, max(length // 40, 1))}
    for room in sorted(room for room in rooms if 0 < room < length):
        with full_disk(room), pytest.raises(InputError, match="cannot be written"):
            sequence.write(out, 0, noise)
        assert not list(out.iterdir()), room
