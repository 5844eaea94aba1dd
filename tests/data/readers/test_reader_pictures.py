"""Pictures that are no EXR, and those of one channel: read in the color space that they state, and written in it."""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import torch
from commands import silently, succeeds
from pictures import save

from mcdenoise.data import open_sequence
from mcdenoise.data.readers.opening import open_result

Image = np.ndarray[Any, Any]
SIZE = (12, 16)


def picture(path: Path, kind: str, channels: int = 3, **attributes: Any) -> Image:
    pixels = np.random.default_rng(0).integers(1, 200, (*SIZE, channels)) / 255
    save(path, dict(zip("RGB" if channels > 1 else "Y", np.moveaxis(pixels, -1, 0), strict=True)), kind, **attributes)
    return stored(path)


def stored(path: Path) -> Image:
    config = oiio.ImageSpec()
    config.attribute("oiio:RawColor", 1)
    config.attribute("oiio:UnassociatedAlpha", 1)
    file = oiio.ImageInput.open(str(path), config)
    pixels = np.asarray(file.read_image("float")).reshape(*SIZE, -1)
    assert str(file.spec().format) == str(file.spec().channelformat(0))
    file.close()
    return pixels


def profile(layout: str, *values: Any) -> dict[str, bytes]:
    """The attribute for an ICC profile of display colors with a curve of these values."""
    curve = struct.pack(layout, *values)
    tags = [(name, curve) for name in (b"rTRC", b"gTRC", b"bTRC")]
    start = 128 + 4 + 12 * len(tags)
    table = b"".join(struct.pack(">4sII", name, start, len(curve)) for name, _ in tags)
    body = struct.pack(">I", len(tags)) + table + curve
    head = struct.pack(">I4sI4s4s4s", 128 + len(body), b"none", 0x02400000, b"mntr", b"RGB ", b"XYZ ")
    return {"ICCProfile": head.ljust(36, b"\0") + b"acsp".ljust(92, b"\0") + body}


def srgb(values: Image) -> Image:
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


CURVES: dict[str, Callable[[Image], Image]] = {
    "linear": lambda values: values,
    "srgb": srgb,
    "gamma": lambda values: values**2.2,
}


@pytest.mark.parametrize(
    ("name", "kind", "attributes", "option", "curve"),
    [
        ("a.png", "uint8", {}, "auto", "srgb"),
        ("a.png", "uint16", {}, "auto", "srgb"),
        ("a.png", "uint16", {}, "linear", "linear"),
        ("a.png", "uint16", {"oiio__ColorSpace": "Linear"}, "auto", "linear"),
        ("a.png", "uint16", {"oiio__ColorSpace": "Linear"}, "srgb", "srgb"),
        ("a.png", "uint16", {"oiio__ColorSpace": "Gamma2.2"}, "auto", "gamma"),
        ("a.png", "uint8", {"oiio__ColorSpace": "sRGB"}, "auto", "srgb"),
        ("a.tif", "uint16", {}, "auto", "srgb"),
        ("a.tif", "uint16", {}, "linear", "linear"),
        ("a.tif", "float", {}, "auto", "linear"),
        ("a.tif", "float", {}, "srgb", "srgb"),
        ("a.tif", "uint16", profile(">4sII", b"curv", 0, 0), "auto", "linear"),
        ("a.tif", "uint16", profile(">4sIIH", b"curv", 0, 1, 256), "auto", "linear"),
        ("a.tif", "uint16", profile(">4sIIH", b"curv", 0, 1, 563), "auto", "gamma"),
        ("a.tif", "uint16", profile(">4sII3H", b"curv", 0, 3, 0, 9000, 65535), "auto", "srgb"),
        ("a.tif", "uint16", profile(">4sIHHi", b"para", 0, 0, 0, 1 << 16), "auto", "linear"),
        ("a.tif", "float", profile(">4sIHHi", b"para", 0, 3, 0, 157286), "auto", "srgb"),
        ("a.tif", "uint16", {"ICCProfile": b"damaged" * 30}, "auto", "srgb"),
        ("a.pfm", "float", {}, "auto", "linear"),
        ("a.hdr", "float", {}, "auto", "linear"),
    ],
)
@pytest.mark.parametrize("channels", [1, 3])
def test_the_color_space_of_a_picture_is_kept(
    name: str, kind: str, attributes: dict[str, Any], option: Any, curve: str, channels: int, tmp_path: Path
) -> None:
    if name == "a.hdr" and channels == 1:
        return
    before = picture(tmp_path / name, kind, channels, **attributes)
    sequence = open_sequence(tmp_path / name, color_space=option)
    color = sequence.frame(0).color[0].movedim(0, -1).numpy()
    assert color.shape == (*SIZE, 3)
    np.testing.assert_allclose(color, np.broadcast_to(CURVES[curve](before), color.shape), rtol=3e-3, atol=1e-5)
    assert any("brighter than white" in warning for warning in sequence.warnings) is (curve != "linear")
    (tmp_path / "out").mkdir()
    after = stored(sequence.write(tmp_path / "out", 0, color))
    assert after.shape == before.shape
    np.testing.assert_allclose(after, before, rtol=2e-3, atol=1e-5)


@pytest.mark.parametrize("names", ["Y", "Y A", "beauty.Y depth.Z"])
def test_one_channel_is_denoised_and_written_as_one(names: str, tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    channels = {name: np.ones(SIZE, np.float32) for name in names.split()}
    first = next(iter(channels))
    channels[first] = random.gamma(3, 1 / 6, SIZE).astype(np.float32)
    path = save(tmp_path / "ao_0001.exr", channels)
    text = silently("denoise", path, "-o", tmp_path / "out", "--model", "wild_small", "--threads", "1")
    assert text.count("NO FEATURES") == ("Z" not in names)
    assert ("without albedo" in text) is ("Z" in names)
    after = oiio.ImageBuf(str(tmp_path / "out" / path.name))
    assert list(after.spec().channelnames) == list(channels)
    pixels = after.get_pixels("float")
    found = pixels[..., list(channels).index(first)]
    assert found.std() < 0.4 * channels[first].std()
    assert found.mean() == pytest.approx(0.5, rel=0.1)
    for place, name in enumerate(channels):
        if name != first:
            np.testing.assert_array_equal(pixels[..., place], channels[name])


@pytest.mark.parametrize("names", ["XYZA", "Y"])
def test_the_color_in_another_space_is_written_too(names: str, tmp_path: Path) -> None:
    """Mitsuba's films write XYZ or luminance beside the RGB of the nested integrator: never half of a file."""
    to_xyz = np.array([[0.412453, 0.35758, 0.180423], [0.212671, 0.71516, 0.072169], [0.019334, 0.119193, 0.950227]])
    color = np.random.default_rng(0).gamma(1, 1, (*SIZE, 3)).astype(np.float32)
    light = color @ to_xyz.T
    channels = {name: light[..., "XYZ".index(name)] for name in names.removesuffix("A")}
    channels |= {f"image.{each}": color[..., i] for i, each in enumerate("RGB")}
    channels |= {"A": np.full(SIZE, 0.5)} if names.endswith("A") else {}
    channels |= {f"other.{each}": light[..., i] * 1.1 for i, each in enumerate("XYZ")}
    sequence = open_sequence(save(tmp_path / "a.exr", channels))
    np.testing.assert_allclose(sequence.frame(0).color[0].movedim(0, -1).numpy(), color, rtol=1e-6)
    (tmp_path / "out").mkdir()
    path = sequence.write(tmp_path / "out", 0, color * np.float32(0.5))
    after = oiio.ImageBuf(str(path))
    pixels = dict(zip(after.spec().channelnames, np.moveaxis(after.get_pixels("float"), -1, 0), strict=True))
    for name, image in channels.items():
        expected = image if name == "A" or name.startswith("other") else image * 0.5
        np.testing.assert_allclose(pixels[name], expected, rtol=1e-5)


@pytest.mark.parametrize("name", ["a.png", "a.tif"])
def test_colors_that_are_not_multiplied_by_alpha_are_light_that_is(name: str, tmp_path: Path) -> None:
    """What a transparent pixel hides is no light, and stays in the file."""
    random = np.random.default_rng(0)
    alpha = np.repeat([0.0, 0.25, 1.0], 4)[:, None] * np.ones(SIZE)
    channels = {each: random.uniform(0.1, 0.9, SIZE) for each in "RGB"} | {"A": alpha}
    path = save(tmp_path / name, channels, "uint16", oiio__UnassociatedAlpha=1)
    before, sequence = stored(path), open_sequence(path)
    color = sequence.frame(0).color[0].movedim(0, -1).numpy()
    np.testing.assert_allclose(color, srgb(before[..., :3]) * before[..., 3:], rtol=3e-3, atol=1e-5)
    (tmp_path / "out").mkdir()
    halved = before[..., 3:].astype(np.float32) / 2
    result = sequence.write(tmp_path / "out", 0, color / 2, alpha=halved)
    after = stored(result)
    np.testing.assert_allclose(after[..., 3:], halved, atol=1e-5)
    np.testing.assert_allclose(after[..., :3], before[..., :3], rtol=2e-3, atol=1e-5)
    np.testing.assert_allclose(open_result(result).read()[0].movedim(0, -1), color / 2, rtol=5e-3, atol=1e-5)


def test_straight_colors_stay_the_same_to_the_rim(tmp_path: Path) -> None:
    rows, columns = np.mgrid[:32, :32] - 15.5
    alpha = np.clip(10 - np.hypot(rows, columns), 0, 1)
    channels = {each: np.where(alpha > 0, 0.1 * place, 1) for place, each in enumerate("RGB", 1)} | {"A": alpha}
    path = save(tmp_path / "a.png", channels, "uint16", oiio__UnassociatedAlpha=1, oiio__ColorSpace="Linear")
    succeeds("denoise", path, "-o", tmp_path / "out.png", "--model", "joint_bilateral", "--threads", "1")
    before, after = (open_sequence(each).frame(0) for each in (path, tmp_path / "out.png"))
    assert before.alpha is not None
    torch.testing.assert_close(after.alpha, before.alpha)
    torch.testing.assert_close(after.color, before.color, rtol=1e-2, atol=1e-4)


def test_a_picture_of_several_pages_is_told(tmp_path: Path) -> None:
    """A result has the first one only."""
    output, specs = oiio.ImageOutput.create("tiff"), [oiio.ImageSpec(*SIZE[::-1], 3, "float")] * 2
    assert output.open(str(tmp_path / "a.tif"), specs)
    assert output.write_image(np.ones((*SIZE, 3), np.float32))
    assert output.open(str(tmp_path / "a.tif"), specs[1], "AppendSubimage")
    assert output.write_image(np.zeros((*SIZE, 3), np.float32))
    assert output.close()
    with pytest.warns(UserWarning, match="several images"):
        color = open_sequence(tmp_path / "a.tif").frame(0).color
    assert torch.equal(color, torch.ones_like(color))
