"""Layers: groups of channels, which buffer their names denote, and the user's mapping."""

from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from commands import refuses
from pictures import part_of, save
from refusals import refused

from mcdenoise.data import open_sequence
from mcdenoise.data.images import Part, Window, read_channels
from mcdenoise.data.readers.layers import layers_of, recognise

SIZE = (24, 32)


def part(channels: str) -> Part:
    names = tuple(each.replace("~", " ") for each in channels.split())
    return Part("", Window(0, 0, *SIZE), Window(0, 0, *SIZE), names, frozenset())


def found(channels: str) -> dict[str, str]:
    layers = layers_of(0, "render", [part(channels)])
    return {str(layer): recognised[0] for layer in layers if (recognised := recognise(layer)) is not None}


def three(name: str, components: str = "RGB") -> str:
    return " ".join(f"{name}.{each}" for each in components)


# The layers have these names in the files of each renderer; ~ stands for a blank.
TABLE = {
    "blender": [
        (three("ViewLayer.Combined", "BGRA"), "ViewLayer.Combined.RGBA", "color"),
        (three("ViewLayer.Noisy~Image"), "ViewLayer.Noisy Image.RGB", "color"),
        ("ViewLayer.Depth.V", "ViewLayer.Depth.V", "depth"),
        (three("ViewLayer.Vector", "WXYZ"), "ViewLayer.Vector.XYZW", "motion"),
        (three("ViewLayer.GlossDir"), "ViewLayer.GlossDir.RGB", None),
        (three("ViewLayer.Shadow~Catcher"), "ViewLayer.Shadow Catcher.RGB", None),
        ("ViewLayer.Debug~Sample~Count.X", "ViewLayer.Debug Sample Count.X", None),
        (three("ViewLayer.CryptoObject00", "RGBA"), "ViewLayer.CryptoObject00.RGBA", None),
        (three("Main~Layer~v1.2.Combined"), "Main Layer v1.2.Combined.RGB", "color"),
        (three("a.b.c.Denoising~Albedo"), "a.b.c.Denoising Albedo.RGB", "albedo"),
        (three("Depth.Normal", "XYZ"), "Depth.Normal.XYZ", "normal"),
        (three("ViewLayer.Combined.left"), "ViewLayer.Combined.left.RGB", "color"),
        ("ViewLayer.Depth.right.Z", "ViewLayer.Depth.right.Z", "depth"),
    ],
    "mitsuba": [
        ("B G R", "render.RGB", "color"),
        ("dd.y.T R G B", "dd.y.T", None),
        (three("nn", "XYZ"), "nn.XYZ", None),
    ],
    "pbrt": [
        ("Nsx Nsy Nsz Nx Ny Nz", "Nsx", None),
        (three("RelativeVariance"), "RelativeVariance.RGB", None),
        ("dzdx dzdy", "dzdx", None),
    ],
    "arnold": [
        ("A B G R Z", "RGBA", "color"),
        ("A B G R Z", "Z", "depth"),
        (three("specular_albedo"), "specular_albedo.RGB", None),
        (three("motionvector", "RG"), "motionvector.RG", "motion"),
        (three("diffuse_direct"), "diffuse_direct.RGB", None),
    ],
    "renderman": [
        ("Ci.r Ci.g Ci.b a", "Ci.RGB", "color"),
        ("Ci.r Ci.g Ci.b a", "a", "alpha"),
        (three("albedo_var", "rgb"), "albedo_var.RGB", None),
        (three("albedo_mse", "rgb"), "albedo_mse.RGB", None),
        ("zfiltered_var R G B", "zfiltered_var", None),
        (three("forward", "xyz"), "forward.XYZ", None),
        ("sampleCount R G B", "sampleCount", None),
    ],
    "others": [
        (three("VRayZDepth"), "VRayZDepth.RGB", "depth"),
        (three("effectsResult"), "effectsResult.RGB", None),
        (three("normalVariance"), "normalVariance.RGB", None),
        ("R G B N_X N_Y N_Z", "N.XYZ", "normal"),
        ("R G B albedo_R albedo_G albedo_B albedo_A", "albedo.RGBA", "albedo"),
        ("R G B motion_x motion_y", "motion.XY", "motion"),
    ],
}
ROWS = [(renderer, *row) for renderer, rows in TABLE.items() for row in rows]


@pytest.mark.parametrize(("renderer", "channels", "layer", "buffer"), ROWS, ids=[f"{r[0]}: {r[2]}" for r in ROWS])
def test_the_names_of_every_renderer(renderer: str, channels: str, layer: str, buffer: str | None) -> None:
    # The layer is beside others, and so one of its own, unless the file holds nothing else.
    given = channels if layer == "render.RGB" else f"{channels} other.R other.T"
    layers = layers_of(0, "render", [part(given)])
    assert found(given).get(layer) == buffer
    assert sum(len(each.channels) for each in layers) >= len(channels.split())


@pytest.fixture
def layered(tmp_path: Path) -> Path:
    """A still with two layers of color in one view, a normal of another name, and a depth."""
    random = np.random.default_rng(0)
    names = (
        "View.Combined.R View.Combined.G View.Combined.B View.Combined.A View.RGBA tint.R View.RGBA tint.G "
        "View.RGBA tint.B View.N1.X View.N1.Y View.N1.Z View.Depth.Z a.R b.R c.R"
    ).replace("RGBA tint", "RGBA~tint")
    channels = {name.replace("~", " "): random.random(SIZE, np.float32) for name in names.split()}
    return save(tmp_path / "shot" / "still.0007.exr", channels)


@pytest.mark.parametrize(
    "text",
    [
        "RGBA tint",
        "View.RGBA tint",
        "View.RGBA tint.RGB",
        "RGBA tint.RGB",
        "View.RGBA tint.R,View.RGBA tint.G,View.RGBA tint.B",
        " View.RGBA tint.R , View.RGBA tint.G, View.RGBA tint.B ",
    ],
)
def test_a_layer_is_asked_for_in_any_of_its_forms(text: str, layered: Path) -> None:
    sequence = open_sequence(layered, mapping=[f"albedo={text}"])
    names = [f"View.RGBA tint.{each}" for each in "RGB"]
    expected = read_channels(layered, {0: names})[0]
    np.testing.assert_array_equal(sequence.frame(7).albedo[0].permute(1, 2, 0).numpy(), expected)
    (row,) = [row for row in sequence.table if row.buffer == "albedo"]
    assert row.reading.startswith("as asked for")


@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        (["albedo=DiffCol"], "expected one layer for --map albedo=DiffCol, found none; there are View.Combined.RGBA"),
        (["normal=Depth"], "expected 3 channels for --map normal=Depth, found 1"),
        (["motion=View.Depth.Z"], "expected 2 channels for --map motion=View.Depth.Z, found 1"),
        (["albedo=a.R,nothing.R,b.R"], "expected one layer for --map albedo=a.R,nothing.R,b.R, found none"),
        (["albdeo=N1"], "expected BUFFER=LAYER with a buffer of albedo, alpha"),
        (["albedo"], "found 'albedo'"),
        (["=N1"], "found '=N1'"),
        (["color="], "expected a layer for 'color', found none"),
        (["albedo=N1", "albedo=Combined"], "expected BUFFER=LAYER"),
        (["length=N1"], "expected BUFFER=LAYER"),
    ],
)
def test_layers_that_cannot_be_requested(texts: list[str], expected: str, layered: Path) -> None:
    assert expected in refuses("inspect", layered, *[each for text in texts for each in ("--map", text)])


@pytest.mark.parametrize(
    ("channels", "flags"),
    [
        ("Beauty.R Beauty.G Beauty.B Combined.R Combined.G Combined.B", ["color=Beauty", "color=Combined"]),
        ("A.Combined.R A.Combined.G A.Combined.B B.Combined.R B.Combined.G B.Combined.B", ["color=A.Combined"]),
    ],
)
def test_two_colors_are_refused_with_the_option_that_decides(channels: str, flags: list[str], tmp_path: Path) -> None:
    path = save(tmp_path / "a.exr", {name: np.ones(SIZE) for name in channels.split()})
    assert f"--map {flags[0]}" in refused(open_sequence, path)
    for flag in flags:
        assert open_sequence(path, mapping=[flag]).size == SIZE


@pytest.mark.parametrize("names", [("depth.Z", "Z"), ("Z", "ZDepth")], ids=["depth, Z", "Z, ZDepth"])
def test_of_two_depths_that_of_the_positions_is_taken(names: tuple[str, str], rendered: Path, tmp_path: Path) -> None:
    path = rendered / "blender" / "shot_0001.exr"
    wanted = [*(f"ViewLayer.Combined.{each}" for each in "RGB"), *(f"ViewLayer.Position.{each}" for each in "XYZ")]
    pixels = read_channels(path, {0: [*wanted, "ViewLayer.Depth.Z"]})[0]
    color = {each: pixels[..., i] for i, each in enumerate("RGB")}
    position = {f"Position.{each}": pixels[..., 3 + i] for i, each in enumerate("XYZ")}
    depth, nonsense = pixels[..., 6], np.random.default_rng(0).uniform(1, 9, pixels.shape[:2])
    distance = np.linalg.norm(pixels[..., 3:6] - np.array((-0.6, -5.2, 1.7)), axis=-1)
    for right in (depth, distance):
        for first, second in ((right, nonsense), (nonsense, right), (right, right)):
            channels = {**color, **position, names[0]: first, names[1]: second}
            sequence = open_sequence(save(tmp_path / "a.exr", channels))
            assert list(sequence.warnings) == []
            frame = sequence.frame(0)
            hit = depth < 1e9
            np.testing.assert_allclose(frame.depth[0, 0].numpy()[hit], right[hit], rtol=1e-6)
    # That along the axis is usual.
    for first, second in ((depth, distance), (distance, depth)):
        sequence = open_sequence(save(tmp_path / "a.exr", {**color, **position, names[0]: first, names[1]: second}))
        np.testing.assert_allclose(sequence.frame(0).depth[0, 0].numpy()[hit], depth[hit], rtol=1e-6)
    # Without positions the usual one is taken, with a word on how to take the other.
    sequence = open_sequence(save(tmp_path / "b.exr", {**color, names[0]: depth, names[1]: nonsense}))
    (warning,) = sequence.warnings
    assert "--map depth=" in warning
    assert "depth" in sequence.buffers
    assert list(open_sequence(tmp_path / "b.exr", mapping=[f"depth={names[1]}"]).warnings) == []


@pytest.mark.parametrize("folder", ["blender_stereo", "blender5_stereo"])
def test_each_eye_is_an_image_of_its_own(folder: str, rendered: Path, tmp_path: Path) -> None:
    path = rendered / folder / "shot_0001.exr"
    message = refused(open_sequence, path)
    assert "ViewLayer.Combined.left.RGBA, shot_0001.exr ViewLayer.Combined.right.RGBA; choose" in message
    assert "choose with --map color=ViewLayer.Combined.left" in message
    images = {}
    for eye in ("left", "right"):
        sequence = open_sequence(path, mapping=[f"color=Combined.{eye}"])
        sources = {row.buffer: row.source for row in sequence.table}
        assert sources == {
            "color": f"shot_0001.exr ViewLayer.Combined.{eye}.RGBA",
            "albedo": f"shot_0001.exr ViewLayer.Denoising Albedo.{eye}.RGB",
            "normal": f"shot_0001.exr ViewLayer.Denoising Normal.{eye}.XYZ",
            "depth": f"shot_0001.exr ViewLayer.Denoising Depth.{eye}.Z",
        }
        frame = sequence.frame(1)
        frame.validate()
        images[eye] = frame.color
        # Its own eye is written, and the other one stays.
        (tmp_path / eye).mkdir()
        written = sequence.write(tmp_path / eye, 1, np.zeros((*sequence.size, 3), np.float32))
        other = {"left": "right", "right": "left"}[eye]
        again = {
            each: open_sequence(written, mapping=[f"color=Combined.{each}"]).frame(1).color for each in (eye, other)
        }
        assert not again[eye].any()
        assert again[other].any()
    assert not images["left"].equal(images["right"])


def test_a_layer_that_is_asked_for_is_no_copy_of_itself(rendered: Path) -> None:
    sequence = open_sequence(rendered / "blender", mapping=["color=DiffDir"])
    (row,) = [row for row in sequence.table if row.buffer == "color"]
    assert row.source.endswith("DiffDir.RGB")
    assert "the same as" not in row.reading


def test_layers_of_no_known_name_are_told_by_their_values(rendered: Path, tmp_path: Path) -> None:
    names = [f"{layer}.{each}" for layer in ("nn", "pos", "albedo") for each in ("RGB" if layer == "albedo" else "XYZ")]
    pixels = read_channels(rendered / "mitsuba" / "frame.0001.exr", {0: ["R", "G", "B", *names]})[0]
    called: dict[str, Any] = dict(zip(["R", "G", "B", *names], np.moveaxis(pixels, -1, 0), strict=True))
    renamed = {name.replace("nn.", "first.").replace("pos.", "second."): image for name, image in called.items()}
    sequence = open_sequence(save(tmp_path / "a.exr", renamed))
    sources = {row.buffer: row.source for row in sequence.table}
    assert sources["normal"] == "a.exr first.XYZ"
    assert sources["position"] == "a.exr second.XYZ"
    # The user's exclusion takes precedence.
    assert "normal" not in open_sequence(tmp_path / "a.exr", mapping=["normal="]).buffers


def test_parts_in_another_order_are_refused(tmp_path: Path) -> None:
    """They have the same channels, and the albedo would be denoised as the image."""
    pixels = dict.fromkeys("RGB", np.ones(SIZE, np.float32))
    for number, order in enumerate((("rgba", "albedo"), ("albedo", "rgba"))):
        OpenEXR.File([part_of(pixels, name) for name in order]).write(str(tmp_path / f"a.{number}.exr"))
    message = refused(open_sequence, tmp_path)
    assert "a.1.exr: expected 'rgba' as part 1" in message
    assert "found 'albedo'" in message


def test_no_radiance_at_all(tmp_path: Path) -> None:
    path = save(tmp_path / "a.exr", {"Depth.Z": np.ones(SIZE), "N.X": np.ones(SIZE)})
    assert "expected noisy radiance, found" in refused(open_sequence, path)
    assert "name it with --map color=LAYER" in refused(open_sequence, path)
