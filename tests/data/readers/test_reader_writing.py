"""Files come back as they were: the radiance replaced, everything else bit for bit."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from pictures import channels_of, save, stored
from refusals import refused

from mcdenoise import Denoiser
from mcdenoise.data import open_sequence
from mcdenoise.data.exr import read_exr
from mcdenoise.data.readers.rewrite import records, write_like
from mcdenoise.folder import denoise_sequence

Image = np.ndarray[Any, Any]
SIZE = (12, 16)
# These keep every bit; B44 and DWA do not.
LOSSLESS = ("none", "rle", "zip", "zips", "piz")


def rainbow(height: int, width: int) -> Image:
    """Radiance that half floats hold exactly, unlike anything that a renderer writes."""
    rows, columns = np.mgrid[:height, :width]
    return np.stack([columns / 64, rows / 64, (rows + columns) / 128], -1).astype(np.float32)


def noise(*shape: int, seed: int = 0) -> Image:
    return np.random.default_rng(seed).random(shape, dtype=np.float32)


def header(entries: dict[str, Any]) -> dict[str, str]:
    return {name: str(value) for name, value in entries.items() if name not in ("channels", "chunkCount")}


def same_but_for(before: Path, after: Path, replaced: set[str]) -> None:
    old, new = stored(before), stored(after)
    assert len(old) == len(new)
    for (old_header, old_channels), (new_header, new_channels) in zip(old, new, strict=True):
        assert header(new_header) == header(old_header)
        assert list(new_channels) == list(old_channels)
        for name, pixels in old_channels.items():
            assert new_channels[name].dtype == pixels.dtype, name
            assert np.array_equal(new_channels[name].view(np.uint8), pixels.view(np.uint8)) == (name not in replaced)


@pytest.mark.parametrize(
    ("folder", "pattern", "layers"),
    [
        ("blender", "shot_%04d.exr", ["ViewLayer.Combined"]),
        # Blender has denoised what stands beside the noisy image: there the result belongs.
        ("blender_denoised", "shot_%04d.exr", ["ViewLayer.Combined"]),
        ("blender_blur", "shot_####.exr", ["ViewLayer.Combined"]),
        ("blender5", "shot_####.exr", ["ViewLayer.Combined"]),
        ("mitsuba", "frame.####.exr", ["", "image"]),
        ("luxcore", "RGB_####.exr", [""]),
    ],
)
def test_a_renderers_file_comes_back_with_other_radiance(
    folder: str, pattern: str, layers: list[str], rendered: Path, tmp_path: Path
) -> None:
    sequence = open_sequence(rendered / folder / pattern)
    image = rainbow(*sequence.size)
    for number in sequence.numbers:
        path = sequence.write(tmp_path, number, image)
        source = rendered / folder / path.name
        replaced = {f"{layer}.{each}" if layer else each for layer in layers for each in "RGB"}
        same_but_for(source, path, replaced)
        channels = channels_of(path)
        for layer in layers:
            found = np.stack([channels[f"{layer}.{each}" if layer else each] for each in "RGB"], -1)
            np.testing.assert_array_equal(found.astype(np.float32), image)
    assert len(list(tmp_path.iterdir())) == len(sequence)


def test_a_layer_can_be_added_instead(rendered: Path, tmp_path: Path) -> None:
    sequence = open_sequence(rendered / "blender")
    image = rainbow(*sequence.size)
    path = sequence.write(tmp_path, 2, image, output_layer="Clean")
    old, new = channels_of(rendered / "blender" / path.name), channels_of(path)
    added = ["ViewLayer.Clean.R", "ViewLayer.Clean.G", "ViewLayer.Clean.B"]
    assert set(new) == set(old) | set(added)
    assert all(np.array_equal(new[name].view(np.uint8), pixels.view(np.uint8)) for name, pixels in old.items())
    np.testing.assert_array_equal(np.stack([new[name] for name in added], -1).astype(np.float32), image)
    again = open_sequence(path, mapping=["color=Clean"], color_has_albedo=True)
    np.testing.assert_array_equal(again.frame(2).color[0].permute(1, 2, 0).numpy(), image)


def test_a_layer_that_is_there_already_is_not_added(rendered: Path, tmp_path: Path) -> None:
    sequence = open_sequence(rendered / "blender")
    image = rainbow(*sequence.size)
    for name, found in (
        ("Combined", "'ViewLayer.Combined.R'"),
        ("Depth", "'ViewLayer.Depth.Z'"),
        ("", "''"),
        ("a.b", "'a.b'"),
    ):
        assert f"found {found}" in refused(sequence.write, tmp_path, 1, image, output_layer=name)
        assert f"found {found}" in refused(sequence.check_output_layer, name)
    assert list(tmp_path.iterdir()) == []


def test_windows_attributes_and_whole_numbers_stay(tmp_path: Path) -> None:
    """A part of a larger picture, with identities of objects, in 16 and 32 bits, in every lossless codec."""
    for compression in LOSSLESS:
        source = tmp_path / compression / "render.0042.exr"
        kinds = {"A": "half", "B": "half", "G": "half", "R": "half", "Z": "float", "crypto00": "uint", "id": "uint"}
        place = {"x": 5, "y": -3, "full_x": -2, "full_y": 0, "full_width": 40, "full_height": 30}
        attributes = {"compression": compression, "owner": "Zoë", "framesPerSecond": 23.5}
        matrix = tuple(float(i) for i in range(16))
        images = dict(zip(kinds, noise(len(kinds), *SIZE), strict=True))
        save(source, images, [*kinds.values()], **place, **attributes, worldToCamera=matrix)
        sequence = open_sequence(source)
        out = tmp_path / f"{compression}_out"
        out.mkdir()
        path = sequence.write(out, 42, rainbow(*SIZE))
        assert path.name == "render.0042.exr"
        same_but_for(source, path, {"R", "G", "B"})
        ((written, channels),) = stored(path)
        assert [tuple(map(int, corner)) for corner in written["dataWindow"]] == [(5, -3), (20, 8)]
        assert [tuple(map(int, corner)) for corner in written["displayWindow"]] == [(-2, 0), (37, 29)]
        assert channels["id"].dtype == np.uint32
        assert written["owner"] == "Zoë"


@pytest.mark.parametrize("order", ["increasingY", "randomY"])
def test_tiles_stay(order: str, tmp_path: Path) -> None:
    tiles = {"tile_width": 16, "tile_height": 32, "tile_depth": 1, "openexr__lineOrder": order}
    source = save(tmp_path / "tiles.exr", {name: noise(40, 50) for name in "RGBZ"}, "half", **tiles)
    (tmp_path / "out").mkdir()
    path = open_sequence(source).write(tmp_path / "out", 0, rainbow(40, 50))
    same_but_for(source, path, {"R", "G", "B"})
    ((written, _),) = stored(path)
    assert (written["tiles"].xSize, written["tiles"].ySize) == (16, 32)


def test_a_firefly_beyond_half_is_the_largest_half(tmp_path: Path) -> None:
    source = save(tmp_path / "a" / "still.exr", {name: noise(*SIZE) for name in "RGB"}, "half")
    (tmp_path / "out").mkdir()
    path = open_sequence(source).write(tmp_path / "out", 0, np.full((*SIZE, 3), 1e6, np.float32))
    assert all(np.all(pixels == 65504) for pixels in channels_of(path).values())


def with_attribute(content: bytes, name: bytes, kind: bytes, value: bytes) -> bytes:
    """The bytes of an EXR of one part with one more attribute, and so with all its pixels farther back."""
    place = 8
    while content[place]:
        start = content.index(b"\0", content.index(b"\0", place) + 1) + 1
        place = start + 4 + int.from_bytes(content[start : start + 4], "little")
    record = name + b"\0" + kind + b"\0" + len(value).to_bytes(4, "little") + value
    first = int.from_bytes(content[place + 1 : place + 9], "little")
    offsets = np.frombuffer(content[place + 1 : first], "<u8") + len(record)
    return content[:place] + record + b"\0" + offsets.astype("<u8").tobytes() + content[first:]


ATTRIBUTES = {
    "Latin-1": (b"thing", b"string", "Müller".encode("latin-1")),
    "Shift-JIS": (b"thing", b"stringvector", (4).to_bytes(4, "little") + "山田".encode("shift-jis")),
    "own type": (b"thing", b"somebodys own", b"\1\2\3"),
    "24/0": (b"framesPerSecond", b"rational", (24).to_bytes(4, "little") + bytes(4)),
    "type of the format": (b"thing", b"compression", b"\7"),
    "preview of nothing": (b"preview", b"preview", bytes(8)),
    **{
        f"text as {name.decode()}": (name, b"string", b"words of text")
        for name in (b"chromaticities", b"chunkCount", b"tiles", b"version", b"worldToCamera")
    },
}


@pytest.mark.parametrize("case", ATTRIBUTES)
def test_an_attribute_of_any_kind_stays(case: str, tmp_path: Path) -> None:
    name, kind, value = ATTRIBUTES[case]
    source = save(tmp_path / "a" / "still.exr", {name: noise(*SIZE) for name in "RGBZ"}, "half", owner="Zoë")
    source.write_bytes(with_attribute(source.read_bytes(), name, kind, value))
    (tmp_path / "out").mkdir()
    sequence = open_sequence(source)
    sequence.frame(0).validate()
    assert read_exr(source)[0].shape == (*SIZE, 4)
    path = sequence.write(tmp_path / "out", 0, rainbow(*SIZE))
    # All headers are those of before, byte for byte; the type of the part may be missing in a file of one.
    attributes = [
        {(each.part, each.name): content[each.start : each.end] for each in records(content) if each.name != b"type"}
        for content in (source.read_bytes(), path.read_bytes())
    ]
    assert attributes[0] == attributes[1]
    assert attributes[1][0, name].endswith(value)
    np.testing.assert_array_equal(open_sequence(path).frame(0).color[0].permute(1, 2, 0).numpy(), rainbow(*SIZE))
    assert [each.name for each in (tmp_path / "out").iterdir()] == ["still.exr"]


def test_attributes_of_several_parts_stay(rendered: Path, tmp_path: Path) -> None:
    source = tmp_path / "shot_0001.exr"
    content = (rendered / "blender5" / source.name).read_bytes()
    texts = [each for each in records(content) if each.kind == b"string" and each.name not in (b"name", b"type")]
    assert {each.part for each in texts} > {0, 1}
    changed = bytearray(content)
    for each in texts[::3]:
        changed[each.value] = 0xFC
    content = bytes(changed)
    source.write_bytes(content)
    (tmp_path / "out").mkdir()
    sequence = open_sequence(source)
    path = sequence.write(tmp_path / "out", 1, rainbow(*sequence.size))
    written = path.read_bytes()
    found = {(each.part, each.name): written[each.start : each.end] for each in records(written)}
    assert found == {(each.part, each.name): content[each.start : each.end] for each in records(content)}


@pytest.mark.parametrize("scale", [b"-1.0", b"1.0"])
def test_a_pfm_begins_with_its_last_row(scale: bytes, tmp_path: Path) -> None:
    source, image = tmp_path / "render.pfm", noise(*SIZE, 3)
    start = b"PF\n%d %d\n" % (SIZE[1], SIZE[0])
    order = "<f4" if scale.startswith(b"-") else ">f4"
    source.write_bytes(start + scale + b"\n" + image[::-1].astype(order).tobytes())
    sequence = open_sequence(source)
    np.testing.assert_array_equal(sequence.frame(0).color[0].permute(1, 2, 0).numpy(), image)
    (tmp_path / "out").mkdir()
    other = noise(*SIZE, 3, seed=1)
    written = sequence.write(tmp_path / "out", 0, other).read_bytes()
    assert written.startswith(start)
    order = "<f4" if written.splitlines()[2].startswith(b"-") else ">f4"
    found = np.frombuffer(written[-other.nbytes :], order).reshape(*SIZE, 3)
    np.testing.assert_array_equal(found[::-1], other)


def test_the_input_folder_is_no_output(rendered: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(rendered / "blender", tmp_path / "shot")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    (tmp_path / "link").symlink_to(folder)
    for given in (folder, folder / "shot_####.exr", folder / "shot_0001.exr"):
        for out in (folder, tmp_path / "link", folder / ".." / "shot"):
            sequence = open_sequence(given)
            message = refused(denoise_sequence, sequence, out, Denoiser(lambda color: color), "nothing")
            assert "expected another folder than that of the input" in message
    several = open_sequence([folder / "shot_0001.exr", folder / "shot_0002.exr"])
    refused(denoise_sequence, several, folder, Denoiser(lambda color: color), "nothing")
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@pytest.mark.parametrize(
    ("compression", "level", "kind"),
    [(OpenEXR.DWAA_COMPRESSION, None, np.float16), (OpenEXR.DWAB_COMPRESSION, 1000.0, np.float32)],
    ids=["half", "float"],
)
def test_bright_pixels_stay_finite_under_dwa(tmp_path: Path, compression: Any, level: float | None, kind: Any) -> None:
    source, target = tmp_path / "in.exr", tmp_path / "out.exr"
    rows = np.zeros((64, 64), kind)
    header = {"compression": compression, "type": OpenEXR.scanlineimage}
    header |= {} if level is None else {"dwaCompressionLevel": level}
    depth = np.full((64, 64), 1e7, np.float32)
    OpenEXR.File(header, {"R": rows, "G": rows, "B": rows, "Z": depth}).write(str(source))
    for seed, bright in enumerate((0.1, 0.5, 1.0)):
        image = np.where(np.random.default_rng(seed).random((64, 64, 3)) < bright, 1e5, 0.01).astype(np.float32)
        with pytest.warns(UserWarning, match="DWA"):
            write_like(source, target, {(0, name): image[..., i] for i, name in enumerate("RGB")})
        ((_, channels),) = stored(target)
        written = np.stack([channels[name] for name in "RGB"], -1).astype(np.float64)
        assert np.isfinite(written).all()
        assert written[image > 1].mean() > 25_000
        np.testing.assert_array_equal(channels["Z"], depth)
