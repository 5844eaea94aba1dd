"""Diffuse and specular light from files: used where it adds up to the color, refused in words where it does not."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pictures import as_channels, save
from refusals import refused

from mcdenoise.data import open_sequence
from mcdenoise.data.images import read_channels, read_image_header
from mcdenoise.frame import Frame

SIZE = (12, 16)
Image = np.ndarray[Any, Any]

# Blender's passes, and which buffer each belongs to.
BLENDER = {
    "diffuse": ("DiffDir", "DiffInd"),
    "specular": ("GlossDir", "GlossInd", "TransDir", "TransInd", "VolumeDir", "VolumeInd", "Emit", "Env"),
}


def drawn(seed: int) -> Image:
    return np.random.default_rng(seed).uniform(0.1, 2, (*SIZE, 3)).astype(np.float32)


def blender(*without: str) -> tuple[dict[str, Image], dict[str, Image]]:
    """Channels of a file with Blender's passes but for some, and what each buffer is."""
    images, truth = {}, {}
    for seed, (buffer, names) in enumerate(BLENDER.items()):
        total = np.zeros((*SIZE, 3), np.float32)
        for number, name in enumerate(names):
            light, kind = drawn(20 * seed + number), name.removesuffix("Dir").removesuffix("Ind")
            color: Any = 1.0
            if kind in ("Diff", "Gloss", "Trans"):
                color = drawn(100 + len(kind)) / 2
                images[f"{kind}Col"] = color
            images[name] = light
            total += light * color
        truth[buffer] = total
    truth["color"] = truth["diffuse"] + truth["specular"]
    truth["specular_albedo"] = images["GlossCol"]
    layers = {"Combined": truth["color"], **images}
    return as_channels({f"View.{name}": image for name, image in layers.items() if name not in without}), truth


def image_of(frame: Frame, buffer: str) -> Image:
    found = frame.buffer(buffer)
    return found[0].permute(1, 2, 0).numpy()


@pytest.mark.parametrize("kind", ["float", "half"])
def test_blenders_passes_are_added_with_their_colors(tmp_path: Path, kind: str) -> None:
    channels, truth = blender()
    sequence = open_sequence(save(tmp_path / "shot_0001.exr", channels, kind))
    assert sequence.buffers >= {"diffuse", "specular", "specular_albedo"}
    assert not sequence.warnings
    frame = sequence.frame(1)
    # Light and color are rounded to half floats, 2^-11 each, and so may be the color of the whole.
    bound = 2.5 * 2.0**-11 if kind == "half" else 1e-6
    for name in ("diffuse", "specular", "specular_albedo"):
        np.testing.assert_allclose(image_of(frame, name), truth[name], rtol=bound)
    assert frame.emission is None


@pytest.mark.parametrize("absent", [["Emit"], ["TransInd", "Env"], ["GlossDir"], ["DiffInd"]])
def test_missing_passes_are_named_and_no_part_is_used(tmp_path: Path, absent: list[str]) -> None:
    channels, _ = blender(*absent)
    sequence = open_sequence(save(tmp_path / "shot_0001.exr", channels, "half"))
    assert not sequence.buffers & {"diffuse", "specular", "specular_albedo"}
    (warning,) = sequence.warnings
    assert warning.startswith("'diffuse', 'specular': ")
    assert warning.endswith(f"not used; render {', '.join(absent)}, too, where the scene has such light")
    frame = sequence.frame(1)
    assert frame.diffuse is None
    assert frame.specular is None


def test_a_color_that_has_been_denoised_is_not_the_sum(tmp_path: Path) -> None:
    channels, truth = blender()
    smooth = truth["color"].mean((0, 1), keepdims=True) + 0 * truth["color"]
    clean = channels | as_channels({"View.Combined": smooth})
    sequence = open_sequence(save(tmp_path / "shot_0001.exr", clean))
    (warning,) = sequence.warnings
    assert "100.0% of the light" in warning
    assert warning.endswith("or the color has been denoised")
    # A color that is not denoised yet is the sum: it is preferred to the other.
    both = clean | as_channels({"View.Noisy Image": truth["color"]})
    assert not open_sequence(save(tmp_path / "both_0001.exr", both)).warnings


@pytest.mark.parametrize("layout", ["layers", "files", "files of a shot"])
@pytest.mark.parametrize("emits", [False, True])
def test_layers_named_diffuse_and_specular_are_used(tmp_path: Path, layout: str, emits: bool) -> None:
    images = {"diffuse": drawn(0), "specular": drawn(1), "specular_albedo": drawn(2) / 2}
    images |= {"emission": drawn(3)} if emits else {}
    images["color"] = sum(
        (images[name] for name in ("diffuse", "specular", "emission") if name in images), 0 * drawn(0)
    )
    if layout == "layers":
        channels = as_channels({"": images["color"]} | {k: v for k, v in images.items() if k != "color"})
        save(tmp_path / "in" / "frame_0007.exr", channels)
    else:
        shot = "kitchen_" if layout == "files of a shot" else ""
        for name, image in images.items():
            save(tmp_path / "in" / f"{shot}{name}_0007.exr", as_channels({"": image}))
    sequence = open_sequence(tmp_path / "in")
    frame = sequence.frame(7)
    assert not sequence.warnings
    assert not sequence.unused
    for name in images:
        np.testing.assert_array_equal(image_of(frame, name), images[name])
    assert (frame.emission is not None) == emits


def test_a_frame_that_does_not_add_up_is_told_and_goes_without(tmp_path: Path) -> None:
    channels, _ = blender()
    save(tmp_path / "shot_0001.exr", channels)
    save(tmp_path / "shot_0002.exr", channels | as_channels({"View.Emit": 5 * drawn(9)}))
    sequence = open_sequence(tmp_path)
    assert sequence.frame(1).diffuse is not None
    with pytest.warns(UserWarning, match="frame 2: diffuse, specular do not add up"):
        assert sequence.frame(2).diffuse is None


def shares(count: int) -> list[Any]:
    """Layers of noisy light with edges in different places."""
    random = np.random.default_rng(0)
    places = (random.random((count, 24, 32, 1)) < 0.7).repeat(2, 1).repeat(2, 2)
    return list((places * random.gamma(1, 1, (count, 48, 64, 3))).astype(np.float32))


@pytest.mark.parametrize("kind", ["float", "half"])
def test_all_layers_are_those_that_complete_the_sum(kind: str, tmp_path: Path) -> None:
    diffuse, glossy, coat, sky, lamp = shares(5)
    copy = diffuse + glossy + coat
    color = copy + 0
    random = np.random.default_rng(1)
    layers = {
        "": color,
        "diffuse_direct": diffuse,
        "specular_indirect": glossy,
        "coat": 0.1 * coat,
        # In the file, but not in the color: a transparent film has no sky.
        "background": sky,
        "emission": 0 * lamp,
        # No light.
        "copy": copy,
        "clean": color * random.uniform(0.98, 1.02, color.shape),
        "occlusion": random.random(color.shape),
        "nothing": 0 * color,
        "faint": 1e-3 * random.random(color.shape),
        "crypto_object00": random.random(color.shape),
        "broken": np.where(sky > 1, np.nan, color),
    }
    layers[""] = diffuse + glossy + 0.1 * coat
    path = save(tmp_path / "a.exr", as_channels(layers), kind)
    sequence = open_sequence(path, lights=("all",))
    assert sorted(sequence.lights) == ["coat", "diffuse_direct", "emission", "specular_indirect"]
    assert not any("--layers" in warning for warning in sequence.warnings)
    frame = sequence.frame(0)
    torch.testing.assert_close(sum(frame.layers.values()), frame.color, rtol=4e-3, atol=1e-3)


def test_what_no_layer_holds_is_said(tmp_path: Path) -> None:
    diffuse, glossy, coat = shares(3)
    channels = as_channels({"": diffuse + glossy + coat, "DiffuseThing": diffuse, "diffuse_direct": diffuse})
    sequence = open_sequence(save(tmp_path / "a.exr", channels), lights=("all",))
    assert list(sequence.lights) == ["diffuse_direct"]
    left = (glossy + coat).sum() / (diffuse + glossy + coat).sum()
    (warning,) = [each for each in sequence.warnings if "--layers" in each]
    assert f"{left:.1%}" in warning
    # One that is named is taken, and the remainder is in the table.
    sequence = open_sequence(tmp_path / "a.exr", lights=("DiffuseThing",))
    assert not any("--layers" in each for each in sequence.warnings)
    assert any(row.buffer == "layers" and f"{left:.1%}" in row.reading for row in sequence.table)
    # Names that nobody knows, and values that do not add up.
    channels = as_channels({"": diffuse + glossy + coat, "one": diffuse, "two": glossy})
    assert "found none; name them: --layers one.RGB two.RGB" in refused(
        open_sequence, save(tmp_path / "b" / "b.exr", channels), lights=("all",)
    )


def test_a_transparent_film_has_no_sky(rendered: Path, tmp_path: Path) -> None:
    path = rendered / "blender" / "shot_0001.exr"
    names = read_image_header(path).parts[0].channels
    pixels = dict(zip(names, np.moveaxis(read_channels(path, {0: names})[0], -1, 0), strict=True))
    whole = open_sequence(path, lights=("all",)).lights
    assert "ViewLayer.Env" in whole
    for each in "RGB":
        seen = pixels[f"ViewLayer.Env.{each}"] == 0
        pixels[f"ViewLayer.Combined.{each}"] = np.where(seen, pixels[f"ViewLayer.Combined.{each}"], 0)
    sequence = open_sequence(save(tmp_path / "shot_0001.exr", pixels), lights=("all",))
    assert sorted(sequence.lights) == sorted({*whole} - {"ViewLayer.Env"})
    assert {"diffuse", "specular"} <= sequence.buffers
    assert list(sequence.warnings) == []
