"""Facts about files that renderers wrote, measured on the files kept here; the readers rely on them."""

from __future__ import annotations

import importlib.util
import types
from pathlib import Path

import numpy as np
import OpenImageIO
import pytest
from numpy.typing import NDArray

FILES = Path(__file__).parent / "renderers"
# Values of `examples/blender/render.py`: focal length over sensor width, near clipping plane, the wall's y.
FOCAL, NEAR, WALL = 30 / 36, 0.1, 3.5

Image = NDArray[np.float32]


def parts(path: Path) -> list[tuple[str, dict[str, Image]]]:
    """Every part of a file: its name and its channels."""
    source = OpenImageIO.ImageInput.open(str(path))
    assert source is not None, OpenImageIO.geterror()
    found = []
    while source.seek_subimage(len(found), 0):
        spec = source.spec()
        pixels = np.asarray(source.read_image(len(found), 0, 0, spec.nchannels, "float"))
        channels = {name: pixels[..., index] for index, name in enumerate(spec.channelnames)}
        found.append((spec.getattribute("oiio:subimagename") or "", channels))
    source.close()
    return found


def layer(channels: dict[str, Image], name: str, components: str) -> Image:
    return np.stack([channels[f"{name}.{component}" if name else component] for component in components], -1)


def blender(path: str) -> dict[str, Image]:
    """All parts of a file of Blender together."""
    return {name: values for _, part in parts(FILES / path) for name, values in part.items()}


def camera(step: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where the camera of a frame stands, and its axes as rows: right, up, into the scene."""
    others = load_others()
    place = others.CAMERA + step * others.STEP
    forward = (others.TARGET - place) / np.linalg.norm(others.TARGET - place)
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right)
    return place, np.stack([right, np.cross(right, forward), forward])


def project(position: Image, step: int) -> NDArray[np.float64]:
    """Columns and rows of pixel centres at which the camera of a frame sees world positions."""
    place, axes = camera(step)
    height, width = position.shape[:2]
    x, y, z = np.moveaxis((position - place) @ axes.T, -1, 0)
    return np.stack([width / 2 + FOCAL * width * x / z, height / 2 - FOCAL * width * y / z], -1) - 0.5


def load_others() -> types.ModuleType:
    spec = importlib.util.spec_from_file_location("others", FILES / "others.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("frame", [1, 2, 3, 4])
def test_blender_depth_is_along_the_axis_and_normals_are_in_the_world(frame: int) -> None:
    channels = blender(f"blender/shot_{frame:04d}.exr")
    place, axes = camera(frame - 1)
    position, depth = layer(channels, "ViewLayer.Position", "XYZ"), channels["ViewLayer.Depth.Z"]
    hit = depth < 1e9
    assert 0.1 < np.mean(~hit) < 0.3
    assert np.all(depth[~hit] == np.float32(1e10))
    # Positions are 32-bit numbers up to 13: 5e-7 of rounding in each of a few terms.
    np.testing.assert_allclose(depth[hit], ((position - place) @ axes[2])[hit], atol=1e-5)
    for name in ("Position.XYZ", "Normal.XYZ", "Vector.XYZW", "Denoising Depth.Z", "Denoising Normal.XYZ"):
        assert not np.any(layer(channels, *f"ViewLayer.{name}".rsplit(".", 1))[~hit]), name

    wall = hit & (np.abs(position[..., 1] - WALL) < 1e-4)
    assert np.count_nonzero(wall) > 200
    np.testing.assert_allclose(layer(channels, "ViewLayer.Normal", "XYZ")[wall] - (0, -1, 0), 0, atol=1e-6)
    # The denoiser's normal is in the camera's axes, its depth is a distance from the near plane.
    np.testing.assert_allclose(
        layer(channels, "ViewLayer.Denoising Normal", "XYZ")[wall] - axes @ (0, -1, 0), 0, atol=1e-5
    )
    ray = (position - place)[wall]
    distance = np.linalg.norm(ray, axis=-1)
    np.testing.assert_allclose(
        channels["ViewLayer.Denoising Depth.Z"][wall], distance - NEAR * distance / (ray @ axes[2]), atol=1e-5
    )


@pytest.mark.parametrize("frame", [1, 2, 3, 4])
def test_blender_vector_is_previous_minus_current_with_y_up(frame: int) -> None:
    channels = blender(f"blender/shot_{frame:04d}.exr")
    position, vector = layer(channels, "ViewLayer.Position", "XYZ"), layer(channels, "ViewLayer.Vector", "XYZW")
    # The wall and the floor stand still.
    still = (np.abs(position[..., 1] - WALL) < 1e-4) | (np.abs(position[..., 2]) < 1e-5)
    still &= channels["ViewLayer.Depth.Z"] < 1e9
    here = project(position, frame - 1)
    rows, columns = np.indices(here.shape[:2])
    np.testing.assert_allclose(here[still], np.stack([columns, rows], -1)[still], atol=1e-3)
    np.testing.assert_allclose((project(position, frame - 2) - here)[still], vector[still][:, :2] * (1, -1), atol=1e-3)
    np.testing.assert_allclose((here - project(position, frame))[still], vector[still][:, 2:] * (1, -1), atol=1e-3)
    assert np.max(np.abs(vector)) > 0.5


@pytest.mark.parametrize(
    ("path", "beauty", "kinds", "direct", "indirect", "color", "emission", "environment"),
    [
        ("blender/shot_0001.exr", "Combined", ("Diff", "Gloss", "Trans"), "Dir", "Ind", "Col", "Emit", "Env"),
        (
            "blender5/shot_0001.exr",
            "Noisy Image",
            ("Diffuse", "Glossy", "Transmission"),
            " Direct",
            " Indirect",
            " Color",
            "Emission",
            "Environment",
        ),
    ],
)
def test_blender_light_passes_add_up(
    path: str,
    beauty: str,
    kinds: tuple[str, ...],
    direct: str,
    indirect: str,
    color: str,
    emission: str,
    environment: str,
) -> None:
    channels = blender(path)

    def take(name: str) -> Image:
        return layer(channels, f"ViewLayer.{name}", "RGB")

    total = take(emission) + take(environment)
    for kind in kinds:
        total = total + take(kind + color) * (take(kind + direct) + take(kind + indirect))
    # Each of up to five terms was rounded to 11 bits, or to 6e-8 near zero.
    np.testing.assert_allclose(total, take(beauty), rtol=3e-3, atol=1e-4)


def test_blender_denoised_has_the_noisy_image_beside_it() -> None:
    channels = blender("blender_denoised/shot_0001.exr")
    clean, noisy = (layer(channels, f"ViewLayer.{name}", "RGB") for name in ("Combined", "Noisy Image"))
    roughness = [np.mean(np.abs(np.diff(np.log1p(image), axis=1))) for image in (clean, noisy)]
    assert roughness[0] < 0.8 * roughness[1]


def test_blender_with_motion_blur_has_vectors_of_zeros() -> None:
    channels = blender("blender_blur/shot_0001.exr")
    assert not np.any(layer(channels, "ViewLayer.Vector", "XYZW"))
    alpha = channels["ViewLayer.Combined.A"]
    assert set(np.unique(alpha)) == {0, 0.25, 0.5, 0.75, 1}
    assert np.all(layer(channels, "ViewLayer.Combined", "RGB")[alpha == 0] == 0)


def test_blender_adds_what_is_emitted_to_the_denoisers_albedo() -> None:
    channels = blender("blender/shot_0001.exr")
    albedo, depth = layer(channels, "ViewLayer.Denoising Albedo", "RGB"), channels["ViewLayer.Depth.Z"]
    emitting = channels["ViewLayer.Emit.R"] > 20
    assert np.all(albedo[emitting][:, 0] > 20)
    sky = layer(channels, "ViewLayer.Env", "RGB")
    np.testing.assert_allclose(albedo[depth > 1e9], sky[depth > 1e9], rtol=1e-3)


def test_blender_stereo_names_views_in_the_channel_or_in_the_part() -> None:
    ((_, channels),) = parts(FILES / "blender_stereo" / "shot_0001.exr")
    assert "ViewLayer.Combined.left.R" in channels
    assert "ViewLayer.Combined.right.R" in channels
    views = parts(FILES / "blender5_stereo" / "shot_0001.exr")
    assert [name for name, _ in views[:2]] == ["ViewLayer.Combined-left", "ViewLayer.Combined-right"]
    assert list(views[0][1]) == list(views[1][1])


def test_mitsuba_writes_the_beauty_twice_and_zeros_where_nothing_is_hit() -> None:
    ((_, channels),) = parts(FILES / "mitsuba" / "frame.0002.exr")
    np.testing.assert_array_equal(layer(channels, "", "RGB"), layer(channels, "image", "RGB"))
    empty, full = channels["image.A"] == 0, channels["image.A"] == 1
    for name in ("dd.y.T", "nn.XYZ", "pos.XYZ", "albedo.RGB"):
        assert not np.any(layer(channels, *name.rsplit(".", 1))[empty])
    assert layer(channels, "albedo", "RGB").max() > 10
    position = layer(channels, "pos", "XYZ")
    distance = np.linalg.norm(position - (-0.2, 1.5, 5.0), axis=-1)
    # A mean of distances is no less than the distance of the mean; both are 16-bit numbers up to 8.
    assert np.all(channels["dd.y.T"][full] > distance[full] - 0.02)
    assert np.median(channels["dd.y.T"][full] - distance[full]) < 0.02


def test_luxcore_writes_three_channels_and_infinity() -> None:
    read = {kind: parts(FILES / "luxcore" / f"{kind}_0002.exr")[0][1] for kind in ("DEPTH", "POSITION", "ALBEDO")}
    depth = read["DEPTH"]["R"]
    np.testing.assert_array_equal(depth, read["DEPTH"]["B"])
    hit = np.isfinite(depth)
    assert 0.1 < np.mean(~hit) < 0.3
    assert np.all(np.isinf(read["POSITION"]["R"][~hit]))
    distance = np.linalg.norm(layer(read["POSITION"], "", "RGB")[hit] - (-0.2, -5.0, 1.5), axis=-1)
    # LuxCore measures from its near plane, a thousandth in front of the camera.
    np.testing.assert_allclose(depth[hit], distance, atol=2e-3)


@pytest.mark.parametrize("renderer", sorted(load_others().RENDERERS))
def test_files_with_names_of_other_renderers_have_the_original_pixels(renderer: str, tmp_path: Path) -> None:
    others = load_others()
    written = others.write(renderer, tmp_path, frames=(2,))
    assert sorted(written) == sorted(tmp_path.iterdir())
    channels = {name: values for path in written[:1] for name, values in parts(path)[0][1].items()}
    beauty = {"renderman": "Ci.r", "octane": "Beauty_Noisy.R"}.get(renderer, "R")
    np.testing.assert_array_equal(channels[beauty], others.read(2)["color"][..., 0])
