"""Files come back as they were: the radiance replaced, everything else bit for bit."""

from __future__ import annotations

import shutil
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest

from mcdenoise import Denoiser
from mcdenoise.data import open_sequence
from mcdenoise.data.exr import read_exr
from mcdenoise.data.readers.attributes import records
from mcdenoise.data.readers.rewrite import write_like
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


def stored(path: Path) -> list[tuple[dict[str, Any], dict[str, Image]]]:
    """Header and channels of every part, as the library of the format reads them."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        return [
            (dict(part.header), {name: channel.pixels.copy() for name, channel in part.channels.items()})
            for part in file.parts
        ]


def header(entries: dict[str, Any]) -> dict[str, str]:
    """Return the entries of a header, comparable; the list of its channels is compared by itself."""
    return {name: str(value) for name, value in entries.items() if name not in ("channels", "chunkCount")}


def same_but_for(before: Path, after: Path, replaced: set[str]) -> None:
    """All parts, headers and channels are those of before, but for the pixels of some channels."""
    old, new = stored(before), stored(after)
    assert len(old) == len(new)
    for (old_header, old_channels), (new_header, new_channels) in zip(old, new, strict=True):
        assert header(new_header) == header(old_header)
        assert list(new_channels) == list(old_channels)
        for name, pixels in old_channels.items():
            assert new_channels[name].dtype == pixels.dtype, name
            assert np.array_equal(new_channels[name].view(np.uint8), pixels.view(np.uint8)) == (name not in replaced)


def channels_of(path: Path) -> dict[str, Image]:
    return {name: pixels for _, channels in stored(path) for name, pixels in channels.items()}


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
    # Nothing lies beside them.
    assert len(list(tmp_path.iterdir())) == len(sequence)


def test_lossy_compression_stays_and_loses_little(rendered: Path, tmp_path: Path) -> None:
    sequence = open_sequence(rendered / "blender_filtered")
    path = sequence.write(tmp_path, 7, rainbow(*sequence.size))
    (old_header, old), (new_header, new) = stored(rendered / "blender_filtered" / path.name)[0], stored(path)[0]
    assert header(new_header) == header(old_header)
    assert "DWAA" in str(new_header["compression"])
    for name, pixels in old.items():
        if "Combined" not in name:
            # Compressing again what was compressed loses about as little as the first time.
            np.testing.assert_allclose(new[name].astype(float), pixels.astype(float), rtol=0.1, atol=0.05)


def test_a_layer_can_be_added_instead(rendered: Path, tmp_path: Path) -> None:
    sequence = open_sequence(rendered / "blender")
    image = rainbow(*sequence.size)
    path = sequence.write(tmp_path, 2, image, output_layer="Clean")
    old, new = channels_of(rendered / "blender" / path.name), channels_of(path)
    added = ["ViewLayer.Clean.R", "ViewLayer.Clean.G", "ViewLayer.Clean.B"]
    assert set(new) == set(old) | set(added)
    assert all(np.array_equal(new[name].view(np.uint8), pixels.view(np.uint8)) for name, pixels in old.items())
    np.testing.assert_array_equal(np.stack([new[name] for name in added], -1).astype(np.float32), image)
    # It is a layer like any other.
    again = open_sequence(path, mapping=["color=Clean"], color_has_albedo=True)
    np.testing.assert_array_equal(again.frame(2).color[0].permute(1, 2, 0).numpy(), image)


def test_a_layer_that_is_there_already_is_not_added(
    rendered: Path, tmp_path: Path, refused: Callable[..., str]
) -> None:
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


def test_alpha_stays_or_is_replaced(rendered: Path, tmp_path: Path) -> None:
    sequence = open_sequence(rendered / "blender_blur")
    image, alpha = rainbow(*sequence.size), rainbow(*sequence.size)[..., :1]
    path = sequence.write(tmp_path, 1, image, alpha=alpha)
    channels = channels_of(path)
    np.testing.assert_array_equal(channels["ViewLayer.Combined.A"], alpha[..., 0])
    same_but_for(rendered / "blender_blur" / path.name, path, {f"ViewLayer.Combined.{each}" for each in "RGBA"})


def test_windows_attributes_and_whole_numbers_stay(tmp_path: Path) -> None:
    """A part of a larger picture, with identities of objects, in 16 and 32 bits, in every lossless codec."""
    for compression in LOSSLESS:
        source = tmp_path / compression / "render.0042.exr"
        source.parent.mkdir()
        kinds = {"A": "half", "B": "half", "G": "half", "R": "half", "Z": "float", "crypto00": "uint", "id": "uint"}
        spec = oiio.ImageSpec(SIZE[1], SIZE[0], len(kinds), "float")
        spec.channelnames = tuple(kinds)
        spec.channelformats = tuple(oiio.TypeDesc(kind) for kind in kinds.values())
        spec.x, spec.y, spec.full_x, spec.full_y, spec.full_width, spec.full_height = 5, -3, -2, 0, 40, 30
        for name, value in (("compression", compression), ("owner", "Zoë"), ("framesPerSecond", 23.5)):
            spec.attribute(name, value)
        spec.attribute("worldToCamera", "matrix", tuple(float(i) for i in range(16)))
        pixels = noise(*SIZE, len(kinds))
        output = oiio.ImageOutput.create(str(source))
        assert output.open(str(source), spec)
        assert output.write_image(pixels)
        assert output.close()

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
    source = tmp_path / "tiles.exr"
    spec = oiio.ImageSpec(50, 40, 4, "half")
    spec.channelnames = tuple("RGBZ")
    spec.tile_width, spec.tile_height, spec.tile_depth = 16, 32, 1
    spec.attribute("openexr:lineOrder", order)
    output = oiio.ImageOutput.create(str(source))
    assert output.open(str(source), spec)
    assert output.write_image(noise(40, 50, 4))
    assert output.close()
    (tmp_path / "out").mkdir()
    path = open_sequence(source).write(tmp_path / "out", 0, rainbow(40, 50))
    same_but_for(source, path, {"R", "G", "B"})
    ((written, _),) = stored(path)
    assert (written["tiles"].xSize, written["tiles"].ySize) == (16, 32)


def test_a_texture_is_no_frame(tmp_path: Path, refused: Callable[..., str]) -> None:
    picture = oiio.ImageBuf(oiio.ImageSpec(64, 64, 3, "half"))
    path = tmp_path / "texture.exr"
    assert oiio.ImageBufAlgo.make_texture(oiio.MakeTxTexture, picture, str(path), oiio.ImageSpec())
    assert "found a texture of several resolutions" in refused(open_sequence, path)


def test_other_threads_print_while_a_file_is_written(
    save: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = save(tmp_path / "a.exr", dict(zip("RGB", noise(3, 1024, 1024), strict=True)), "half")
    writers = [
        threading.Thread(target=write_like, args=(source, tmp_path / f"{i}.exr", {}), kwargs={"added": {}})
        for i in range(2)
    ]
    shown = sys.stdout
    for writer in writers:
        writer.start()
    count = 0
    while any(writer.is_alive() for writer in writers):
        print("here")
        count += 1
    assert sys.stdout is shown
    assert capsys.readouterr().out.count("here") == count


def test_full_float_applies_to_replaced_channels_only(save: Callable[..., Path], tmp_path: Path) -> None:
    source = save(tmp_path / "a" / "still.exr", {name: noise(*SIZE) for name in "RGBAZ"}, "half")
    (tmp_path / "out").mkdir()
    image = noise(*SIZE, 3, seed=1)
    path = open_sequence(source).write(tmp_path / "out", 0, image, full_float=True)
    channels = channels_of(path)
    assert {name: pixels.dtype.name for name, pixels in channels.items()} == {
        **dict.fromkeys("RGB", "float32"),
        **dict.fromkeys("AZ", "float16"),
    }
    np.testing.assert_array_equal(np.stack([channels[name] for name in "RGB"], -1), image)


def test_a_firefly_beyond_half_is_the_largest_half(save: Callable[..., Path], tmp_path: Path) -> None:
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


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        (b"string", "Müller".encode("latin-1")),
        (b"string", "山田".encode("shift-jis")),
        (b"stringvector", (5).to_bytes(4, "little") + "grün".encode("latin-1") + b"!"),
        (b"deepImageState", b"\2"),
        (b"bytes", b"\0\0\0\0\xff\xfe\1\2"),
        (b"floatvector", np.float32([1, 2, 3]).tobytes()),
        (b"somebodys own", b"\1\2\3"),
    ],
    ids=["latin-1", "shift-jis", "stringvector", "deepImageState", "bytes", "floatvector", "own"],
)
def test_an_attribute_of_any_kind_stays(kind: bytes, value: bytes, save: Callable[..., Path], tmp_path: Path) -> None:
    check_attribute_stays(b"thing", kind, value, save, tmp_path)


INVALID = [
    (b"framesPerSecond", b"rational", (24).to_bytes(4, "little") + bytes(4)),
    (b"keyCode", b"keycode", b"\xff" * 28),
    (b"timeCode", b"timecode", b"\xff" * 8),
    (b"thing", b"envmap", b"\7"),
    (b"thing", b"compression", b"\7"),
    (b"thing", b"stringvector", b""),
    (b"preview", b"preview", bytes(8)),
    *(
        (name, kind, value)
        for kind, value in ((b"string", b"words of text"), (b"float", b"\0\0\xc0\x7f"), (b"m33f", bytes(36)))
        for name in (b"chromaticities", b"chunkCount", b"keyCode", b"preview", b"tiles", b"version", b"worldToCamera")
    ),
]


@pytest.mark.parametrize(("name", "kind", "value"), INVALID)
def test_an_attribute_that_is_invalid_stays_and_its_pixels_are_read(
    name: bytes, kind: bytes, value: bytes, save: Callable[..., Path], tmp_path: Path
) -> None:
    source = check_attribute_stays(name, kind, value, save, tmp_path)
    assert read_exr(source)[0].shape == (*SIZE, 4)


def check_attribute_stays(name: bytes, kind: bytes, value: bytes, save: Callable[..., Path], tmp_path: Path) -> Path:
    source = save(tmp_path / "a" / "still.exr", {name: noise(*SIZE) for name in "RGBZ"}, "half", owner="Zoë")
    source.write_bytes(with_attribute(source.read_bytes(), name, kind, value))
    (tmp_path / "out").mkdir()
    sequence = open_sequence(source)
    sequence.frame(0).validate()
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
    return source


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


# Pictures that hold one image


def write_picture(path: Path, pixels: Image, kind: str, **attributes: Any) -> None:
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], kind)
    for name, value in attributes.items():
        spec.attribute(name, value)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec), output.geterror()
    assert output.write_image(np.ascontiguousarray(pixels))
    assert output.close()


def raw(path: Path) -> tuple[Image, str]:
    """Samples as they are stored, and their type."""
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)
    picture = oiio.ImageBuf(str(path), 0, 0, config)
    return np.asarray(picture.get_pixels(picture.spec().format)), str(picture.spec().format)


@pytest.mark.parametrize(("suffix", "kind"), [("hdr", "float"), ("tif", "float"), ("tif", "half")])
def test_radiance_in_other_formats_comes_back(suffix: str, kind: str, tmp_path: Path) -> None:
    source = tmp_path / f"render_0003.{suffix}"
    # These values have eight bits and a common exponent, as .hdr has them, and so are exact in all formats.
    radiance = np.broadcast_to(np.float32(2.0) ** np.arange(-4, SIZE[1] - 4)[:, None], (*SIZE, 3)).copy()
    radiance[..., 1] *= 0.75
    radiance[0] = 0.5
    write_picture(source, radiance, kind)
    sequence = open_sequence(source)
    assert list(sequence.warnings) == []
    np.testing.assert_array_equal(sequence.frame(3).color[0].permute(1, 2, 0).numpy(), radiance)
    (tmp_path / "out").mkdir()
    path = sequence.write(tmp_path / "out", 3, radiance[::-1].copy())
    found, found_kind = raw(path)
    assert (path.name, found_kind) == (source.name, raw(source)[1])
    np.testing.assert_array_equal(found.astype(np.float32), radiance[::-1])


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


@pytest.mark.parametrize(
    ("suffix", "kind", "white"), [("png", "uint8", 255), ("png", "uint16", 65535), ("tif", "uint16", 65535)]
)
def test_display_values_go_through_their_transfer_function(suffix: str, kind: str, white: int, tmp_path: Path) -> None:
    source = tmp_path / f"render_0003.{suffix}"
    # Known codes: 0, the end of the straight piece (10 of 255 or 0.04045), middle grey, white.
    codes = np.array([0, 10, 55, 118, 188, 255]) * (white // 255)
    pixels = np.zeros((6, 8, 4), kind)
    pixels[..., :3] = codes[:, None, None]
    pixels[..., 3] = 100 * (white // 255)
    write_picture(source, pixels, kind, **{"oiio:UnassociatedAlpha": 1})
    sequence = open_sequence(source)
    values = codes / white
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    found = sequence.frame(3).color[0, 0, :, 0].numpy()
    np.testing.assert_allclose(found, linear, rtol=1e-5, atol=1e-7)
    assert any("display values" in warning for warning in sequence.warnings)
    (tmp_path / "out").mkdir()
    # Upside down, and brighter than white at the top.
    image = np.repeat(np.repeat(linear[::-1].astype(np.float32)[:, None, None], 8, 1), 3, 2)
    image[0] *= 5
    path = sequence.write(tmp_path / "out", 3, image)
    again, found_kind = raw(path)
    assert found_kind == kind
    np.testing.assert_array_equal(again[..., :3], pixels[::-1, :, :3])
    np.testing.assert_array_equal(again[..., 3], pixels[..., 3])


def test_a_picture_takes_no_layer(tmp_path: Path, refused: Callable[..., str]) -> None:
    write_picture(tmp_path / "render.hdr", noise(*SIZE, 3), "float")
    (tmp_path / "out").mkdir()
    sequence = open_sequence(tmp_path / "render.hdr")
    message = refused(sequence.write, tmp_path / "out", 0, rainbow(*SIZE), output_layer="Clean")
    assert "expected an EXR to add a layer to, found '.hdr'" in message
    assert list((tmp_path / "out").iterdir()) == []


# Files that cannot be written


def test_the_input_folder_is_no_output(rendered: Path, tmp_path: Path, refused: Callable[..., str]) -> None:
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


def test_none_of_several_input_folders_may_be_the_output(
    rendered: Path, tmp_path: Path, refused: Callable[..., str]
) -> None:
    """Files of one shot may lie in several folders; none of them is overwritten."""
    for number in (1, 2, 3, 4):
        for kind in ("color", "albedo"):
            (tmp_path / kind).mkdir(exist_ok=True)
        shutil.copy(rendered / "luxcore" / "ALBEDO_0001.exr", tmp_path / "albedo" / f"albedo_{number:04d}.exr")
        shutil.copy(rendered / "luxcore" / "RGB_0001.exr", tmp_path / "color" / f"color_{number:04d}.exr")
    sequence = open_sequence([tmp_path / "albedo", tmp_path / "color"])
    assert sequence.buffers == {"color", "albedo"}
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.exr")}
    refused(denoise_sequence, sequence, tmp_path / "color", Denoiser(lambda color: color), "nothing")
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.exr")} == before


def test_a_path_that_cannot_be_written_is_named(rendered: Path, tmp_path: Path, refused: Callable[..., str]) -> None:
    sequence = open_sequence(rendered / "mitsuba" / "frame.####.exr")
    (tmp_path / "frame.0002.exr").mkdir()
    image = rainbow(*sequence.size)
    assert "expected a file to write, found a folder" in refused(sequence.write, tmp_path, 2, image)
    assert "cannot be written" in refused(sequence.write, tmp_path / "nowhere", 1, image)
    assert [path.name for path in tmp_path.iterdir()] == ["frame.0002.exr"]


_FULL_DISK = """
import resource, signal, sys
from pathlib import Path

import numpy as np

from mcdenoise import InputError
from mcdenoise.data import open_sequence

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
sequence, out = open_sequence(Path(sys.argv[1])), Path(sys.argv[2])
number, image = sequence.numbers[0], np.ones((*sequence.size, 3), np.float32)
path = sequence.write(out, number, image)
before = path.read_bytes()
unlimited = resource.getrlimit(resource.RLIMIT_FSIZE)
for room in [*range(0, len(before), max(len(before) // 8, 1)), len(before) - 1]:
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, unlimited[1]))
    try:
        sequence.write(out, number, image)
        message = "no error"
    except InputError as error:
        message = str(error)
    resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)
    assert "cannot be written" in message and "\\n" not in message, (room, message)
    assert [each.name for each in out.iterdir()] == [path.name], room
    assert path.read_bytes() == before, room
print("done")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="limits the file size through the POSIX resource limit")
@pytest.mark.parametrize("source", ["blender5/shot_0001.exr", "render.hdr", "render.png"])
def test_a_full_disk_is_told_and_the_old_file_stays(source: str, rendered: Path, tmp_path: Path) -> None:
    path = rendered / source
    if not path.exists():
        path = tmp_path / source
        write_picture(path, noise(64, 64, 3), "uint8" if path.suffix == ".png" else "float")
    (tmp_path / "out").mkdir()
    command = [sys.executable, "-c", _FULL_DISK, str(path), str(tmp_path / "out")]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout) == (0, "done\n"), result.stderr


def test_a_file_that_changed_meanwhile_is_told(
    save: Callable[..., Path], tmp_path: Path, refused: Callable[..., str]
) -> None:
    source = save(tmp_path / "a.exr", {name: noise(*SIZE) for name in "RGB"})
    target = tmp_path / "b.exr"
    replaced = {(0, "R"): noise(*SIZE)}
    source.write_bytes(source.read_bytes()[:-40])
    assert "a.exr has changed meanwhile" in refused(write_like, source, target, replaced, added={})
    whole = source.read_bytes()
    for content in (b"", whole[:20], whole[:100], whole[:30] + b"\xff" * 300 + whole[300:]):
        source.write_bytes(content)
        assert "b.exr: cannot be written" in refused(write_like, source, target, replaced, added={})
    source.unlink()
    assert "b.exr: cannot be written" in refused(write_like, source, target, replaced, added={})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("level", [None, 1000.0])
@pytest.mark.parametrize("compression", [OpenEXR.DWAA_COMPRESSION, OpenEXR.DWAB_COMPRESSION])
@pytest.mark.parametrize("kind", [np.float16, np.float32])
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
            write_like(source, target, {(0, name): image[..., i] for i, name in enumerate("RGB")}, added={})
        ((_, channels),) = stored(target)
        written = np.stack([channels[name] for name in "RGB"], -1).astype(np.float64)
        assert np.isfinite(written).all()
        assert written[image > 1].mean() > 25_000
        np.testing.assert_array_equal(channels["Z"], depth)


def test_what_is_not_bright_is_not_clamped(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    source, target = tmp_path / "in.exr", tmp_path / "out.exr"
    image = np.full((64, 64), 60_000, np.float32)
    OpenEXR.File({"compression": OpenEXR.DWAA_COMPRESSION, "type": OpenEXR.scanlineimage}, {"R": image}).write(
        str(source)
    )
    write_like(source, target, {(0, "R"): image}, added={})
    assert not recwarn
    np.testing.assert_allclose(stored(target)[0][1]["R"], 60_000, rtol=0.01)
