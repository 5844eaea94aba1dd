"""Values: what they say of themselves, on frames whose truth is known."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from kornia.filters import gaussian_blur2d
from pictures import as_channels, save
from test_correlated_noise import light as sampled
from test_correlated_noise import texture as checks

from mcdenoise.data import open_sequence
from mcdenoise.data.readers.values import albedo_included, is_direction, normal_is_encoded, nothing_hit, read_radiance
from mcdenoise.motion import USUAL_MOTION, Convention, match_cameras, match_motion

Image = np.ndarray[Any, Any]
HEIGHT, WIDTH = 96, 160


def texture(kind: str) -> Image:
    return checks(kind)[0, :, :HEIGHT, :WIDTH].permute(1, 2, 0).numpy()


def light(seed: int) -> Image:
    """One sample a pixel of smooth light, in which each check of the texture is lit or in shadow."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    shadow = np.random.default_rng(seed).choice([0.1, 1], (HEIGHT, WIDTH))[rows // 5 * 5, columns // 7 * 7]
    noise = sampled(seed)[0, :, :HEIGHT, :WIDTH].permute(1, 2, 0).numpy()
    return noise * shadow[..., None].astype(np.float32)


def blurred(image: Image, sigma: float) -> Image:
    size = 2 * int(3 * sigma) + 1
    lens = gaussian_blur2d(torch.from_numpy(image).movedim(-1, 0)[None], (size, size), (sigma, sigma))
    return lens[0].movedim(0, -1).numpy()


@pytest.mark.parametrize(("kind", "seed"), [("colored", 0), ("grey", 1)])
def test_one_noisy_frame_tells_whether_the_albedo_is_in(kind: str, seed: int) -> None:
    albedo, irradiance = texture(kind), light(seed)
    with_it, without = albedo_included(albedo * irradiance, albedo), albedo_included(irradiance, albedo)
    assert with_it.included is True
    assert without.included is False
    # Light grows with albedo by 1 or 0 percent for each percent, up to a few of its errors.
    assert with_it.elasticity == pytest.approx(1, abs=5 * with_it.error + 0.02)
    assert without.elasticity == pytest.approx(0, abs=5 * without.error + 0.02)
    # Without edges in the light, a lens may have taken those of the albedo away.
    assert albedo_included(blurred(irradiance.astype(np.float32), 3), albedo).included is not False
    # A frame of zeros and NaN in places says the same.
    spoilt = np.where(np.random.default_rng(seed).random((HEIGHT, WIDTH, 1)) < 0.02, np.nan, albedo * irradiance)
    assert albedo_included(spoilt, albedo).included is True


@pytest.mark.parametrize("sigma", [2, 12])
@pytest.mark.parametrize("kind", ["colored", "grey"])
def test_a_blurred_color_is_never_taken_for_light_without_albedo(kind: str, sigma: float) -> None:
    albedo, random = texture(kind), np.random.default_rng(0)
    through_lens = blurred(albedo, sigma)
    for noise in (0, 1):
        color = through_lens * (1 + noise * (random.gamma(2, 0.5, (HEIGHT, WIDTH, 1)) - 1)).astype(np.float32)
        assert albedo_included(color, albedo).included is not False
        included, _, warnings = read_radiance(color, albedo, None, None)
        assert included is True
        # If the texture is nearly gone, it is said that the color may be light alone.
        assert bool(warnings) is (albedo_included(color, albedo).elasticity < 0.5)
    # Blurred in the background and sharp in front, before which the light is another.
    front = np.arange(WIDTH)[None, :, None] < WIDTH // 4
    color = np.where(front, albedo * light(0), through_lens * light(1).mean())
    assert albedo_included(color, albedo).included is not False


@pytest.mark.parametrize("seen_through", [0.02, 0.3])
@pytest.mark.parametrize("kind", ["colored", "grey"])
def test_fog_and_glass_are_never_taken_for_light_without_albedo(kind: str, seen_through: float) -> None:
    albedo = texture(kind)
    for seed in range(2):
        irradiance = light(seed)
        fog = seen_through * albedo * irradiance + (1 - seen_through) * 0.3
        assert albedo_included(fog, albedo).included is not False
        # A mirror image, which has other edges than the surface.
        assert albedo_included(seen_through * albedo * irradiance + light(9)[::-1, ::-1], albedo).included is not False


@pytest.mark.parametrize("included", [True, False])
def test_a_constant_albedo_does_not_decide_whether_it_is_included(included: bool) -> None:
    albedo, irradiance = texture("plain"), light(0)
    color = albedo * irradiance if included else irradiance
    assert albedo_included(color, albedo).included is None
    assert read_radiance(color, albedo, None, None)[0] is True
    # Neither do pixels without a hit.
    assert albedo_included(color, np.zeros_like(albedo)).included is None
    assert albedo_included(np.zeros_like(color), texture("colored")).included is None


@pytest.mark.parametrize(
    ("folder", "color", "albedo", "number"),
    [
        ("blender", "ViewLayer.Combined", "ViewLayer.Denoising Albedo", 2),
        ("blender_filtered", "Main Layer v1.2.Combined", "Main Layer v1.2.Denoising Albedo", 7),
        ("blender5", "ViewLayer.Noisy Image", "ViewLayer.Denoising Albedo", 1),
        ("luxcore", "RGB", "ALBEDO", 1),
        ("mitsuba", "", "albedo", 2),
    ],
)
def test_the_data_of_renderers_with_and_without_albedo(
    folder: str, color: str, albedo: str, number: int, rendered: Path, tmp_path: Path
) -> None:
    frame = open_sequence(
        rendered / folder / "frame.####.exr" if folder == "mitsuba" else rendered / folder, str(number)
    ).frame(number)
    radiance, reflected = (image[0].permute(1, 2, 0).numpy() for image in (frame.color, frame.albedo))
    for divided in (False, True):
        stored = np.where(reflected > 0, radiance / np.maximum(reflected, 1e-6), 0) if divided else radiance
        path = save(tmp_path / str(divided) / "still.exr", as_channels({"": stored, "albedo": reflected}))
        opened = open_sequence(path)
        if folder == "mitsuba" and divided:
            # Matt checks far away, gold and glass: these 2304 pixels do not tell, and it is said what to do if so.
            assert opened.color_has_albedo
            assert any("--color-without-albedo" in warning for warning in opened.warnings)
            continue
        assert opened.color_has_albedo is not divided
        assert any("multiplied back" in warning for warning in opened.warnings) is divided
        # The other way round, if it is stated.
        assert open_sequence(path, color_has_albedo=divided).color_has_albedo is divided


def directions(seed: int) -> Image:
    vectors = np.random.default_rng(seed).standard_normal((40, 50, 3))
    return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).astype(np.float32)


@pytest.mark.parametrize("noise", [0, 0.1])
def test_normals_signed_or_encoded(noise: float) -> None:
    random = np.random.default_rng(1)
    # A filter makes means of several normals at edges.
    normal = directions(0) * np.where(random.random((40, 50, 1)) < 0.3, 0.5, 1)
    signed = (normal + noise * random.standard_normal(normal.shape)).astype(np.float32)
    encoded = (signed / 2 + 0.5).clip(0, 1)
    for sky in (0, 8):
        signed[:sky], encoded[:sky] = 0, 0
        assert not normal_is_encoded(signed)
        assert normal_is_encoded(encoded)


def test_normals_that_all_point_to_one_side() -> None:
    # A view of a floor and two walls, in which nothing is negative: signed all the same.
    signed = np.zeros((30, 30, 3), np.float32)
    signed[:10, :, 0], signed[10:20, :, 1], signed[20:, :, 2] = 1, 1, 1
    assert not normal_is_encoded(signed)
    assert normal_is_encoded(signed / 2 + 0.5)
    towards = np.broadcast_to(np.float32([0.6, 0.64, 0.48]), (8, 8, 3))
    assert not normal_is_encoded(towards)
    assert normal_is_encoded(towards / 2 + 0.5)
    assert not normal_is_encoded(np.zeros((8, 8, 3), np.float32))
    assert is_direction(signed)
    assert not is_direction(signed * 3)
    assert not is_direction(np.zeros((8, 8, 3), np.float32))


@pytest.mark.parametrize("background", [0.0, -1.0, 65504.0, 1e10, 1e30, 3.4e38, np.inf, -np.inf, np.nan])
def test_every_background_of_depth_is_infinity(background: float, tmp_path: Path) -> None:
    depth = np.full((12, 16), 7.5, np.float32)
    depth[:4] = background
    depth[5, 5] = 9e8
    np.testing.assert_array_equal(nothing_hit(depth), np.arange(12)[:, None] < np.full(16, 4))
    path = save(tmp_path / "a.exr", {**dict.fromkeys("RGB", np.ones((12, 16))), "Z": depth})
    sequence = open_sequence(path)
    frame = sequence.frame(0)
    frame.validate()
    assert frame.depth[0, 0, :4].isinf().all()
    np.testing.assert_array_equal(frame.depth[0, 0, 4:].numpy(), depth[4:])
    (row,) = [row for row in sequence.table if row.buffer == "depth"]
    assert "background: 33%" in row.reading


def test_depths_that_are_all_negative_are_negated(tmp_path: Path) -> None:
    depth = np.linspace(2, 7, 12 * 16, dtype=np.float32).reshape(12, 16)
    depth[:4] = 1e10
    path = save(tmp_path / "a.exr", {**dict.fromkeys("RGB", np.ones((12, 16))), "Z": -depth})
    frame = open_sequence(path).frame(0)
    np.testing.assert_array_equal(frame.depth[0, 0].numpy(), np.where(depth < 1e9, depth, np.inf))
    path = save(tmp_path / "sky.exr", {**dict.fromkeys("RGB", np.ones((12, 16))), "Z": np.full((12, 16), -1)})
    assert open_sequence(path).frame(0).depth.isinf().all()


def moving(shift: tuple[float, float], size: tuple[int, int] = (60, 100)) -> tuple[dict[str, Image], dict[str, Image]]:
    """Features of a frame and of the one before, in which every point was (x, y) pixels farther; y down."""

    def pattern(x: Image, y: Image) -> Image:
        waves = [np.sin(x / 3.1 + y / 7.3), np.sin(x / 5.7 - y / 4.1), np.sin(x / 8.9 + y / 2.9)]
        return (np.stack(waves, -1) / 2 + 0.5).astype(np.float32)

    rows, columns = np.mgrid[: size[0], : size[1]].astype(np.float64)
    return {"albedo": pattern(columns, rows)}, {"albedo": pattern(columns - shift[0], rows - shift[1])}


SHIFT = (5.0, 3.0)
UNITS = {"pixels": (1.0, 1.0), "parts of the image": (100.0, 60.0), "parts of half the image": (50.0, 30.0)}


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("signs", [(1, 1), (1, -1), (-1, 1), (-1, -1)])
def test_two_frames_tell_sign_and_unit(unit: str, signs: tuple[int, int]) -> None:
    given = Convention(1, -1, "previous - current, y up, pixels")
    now, before = moving(SHIFT)
    scale = np.multiply(signs, UNITS[unit])
    stored = np.broadcast_to((SHIFT / scale).astype(np.float32), (60, 100, 2))
    found, told = match_motion([(now, before, stored)], given)
    assert found is not None
    assert told
    assert (found.scale_x, found.scale_y) == tuple(scale)
    np.testing.assert_allclose(found.apply(stored), np.broadcast_to(SHIFT, stored.shape), rtol=1e-6)
    first, second, last = found.words.split(", ")
    assert (first == "previous - current") is (signs[0] > 0)
    assert (second == "y down") is (signs[0] == signs[1])
    assert last == unit
    # Cameras that see the points say the same.
    seen = np.broadcast_to(np.array(SHIFT), stored.shape)
    assert match_cameras([(stored, seen)], given)[:2] == tuple(scale)


@pytest.mark.parametrize(("nothing", "horizon"), [(np.inf, 12), (np.nan, 50), (1e10, 50)])
def test_motion_is_compared_where_there_is_one(nothing: float, horizon: int) -> None:
    """A camera that moves over a floor: the sky above has no motion, and matches itself at rest."""
    now, before = moving(SHIFT)
    for image in (now["albedo"], before["albedo"]):
        image[:horizon] = 0
    for signs in ((1, 1), (-1, 1), (-1, -1)):
        stored = np.array(SHIFT * np.ones((60, 100, 2)) * signs, np.float32)
        stored[:horizon] = nothing
        assert match_motion([(now, before, stored)], USUAL_MOTION)[0][:2] == signs
        seen = np.full(stored.shape, SHIFT, np.float64)
        seen[:horizon] = np.nan
        assert match_cameras([(stored, seen)], USUAL_MOTION)[:2] == signs
    # Motion of few pixels tells nothing, and wrong motion is found out under any sky.
    few = np.full(stored.shape, nothing, np.float32)
    assert match_motion([(now, before, few)], USUAL_MOTION) == (USUAL_MOTION, False)
    stored[horizon:] = np.random.default_rng(0).uniform(-20, 20, stored[horizon:].shape)
    assert match_motion([(now, now, stored)], USUAL_MOTION) == (None, True)


@pytest.mark.parametrize("layout", ["files", "bmfr"])
def test_a_moving_camera_under_an_infinite_sky(layout: str, others: Any, tmp_path: Path) -> None:
    for number in (1, 2, 3):
        truth = others.read(number)
        hit = truth["hit"]
        buffers = {
            "color": ("RGB", truth["color"]),
            "albedo": ("RGB", truth["albedo"]),
            "shading_normal": ("XYZ", truth["normal"]),
            "depth": ("Y" if layout == "bmfr" else "Z", np.where(hit, truth["depth"], np.inf)[..., None]),
            "motion": ("XY", np.where(hit[..., None], truth["motion"], np.inf)),
            "world_position": ("XYZ", np.where(hit[..., None], truth["position"], np.inf)),
        }
        channels = {name: as_channels({"": image}, letters) for name, (letters, image) in buffers.items()}
        if layout == "bmfr":
            for name, own in channels.items():
                save(tmp_path / f"{name}{number}.exr", own)
        else:
            layers = {f"{name}.{each}": image for name, own in channels.items() for each, image in own.items()}
            save(tmp_path / f"shot_{number}.exr", layers)
    sequence = open_sequence(tmp_path)
    assert sequence.layout == layout
    assert list(sequence.warnings) == []
    assert {"motion", "depth"} <= sequence.buffers
    for number in (2, 3):
        frame, truth = sequence.frame(number), others.read(number)
        frame.validate()
        hit = torch.from_numpy(truth["hit"])
        motion = torch.from_numpy(truth["motion"].astype(np.float32)).movedim(-1, 0)
        torch.testing.assert_close(frame.motion[0, :, hit], motion[:, hit])
        assert frame.depth[0, 0, ~hit].isinf().all()


def test_motion_in_files_is_told_by_the_frames(tmp_path: Path) -> None:
    """A shot of three frames that pans by 5 and 3 pixels, stored as current - previous in parts of the image."""
    for number in range(3):
        albedo = moving((-SHIFT[0] * number, -SHIFT[1] * number))[1]["albedo"]
        channels = as_channels({"": albedo, "albedo": albedo})
        channels |= {"mv.X": np.full((60, 100), -SHIFT[0] / 100), "mv.Y": np.full((60, 100), -SHIFT[1] / 60)}
        # Blender's name, and not what Blender writes.
        save(tmp_path / "parts" / f"a.{number}.exr", channels)
        vector = {"Vector.X": np.full((60, 100), SHIFT[0]), "Vector.Y": np.full((60, 100), SHIFT[1])}
        save(tmp_path / "vector" / f"a.{number}.exr", {k: v for k, v in channels.items() if k[:2] != "mv"} | vector)
        wrong = np.random.default_rng(number).uniform(-20, 20, (2, 60, 100))
        save(tmp_path / "wrong" / f"a.{number}.exr", channels | {"mv.X": wrong[0], "mv.Y": wrong[1]})
        # Redshift's, where vectors are not raw, of at most 64 pixels.
        picture = {f"mv.{name}": np.full((60, 100), each / 128 + 0.5) for name, each in zip("XY", SHIFT, strict=True)}
        save(tmp_path / "picture" / f"a.{number}.exr", channels | picture)
    for folder, words in (
        ("parts", "current - previous, y down, parts of the image"),
        ("vector", "previous - current, y down, pixels"),
    ):
        sequence = open_sequence(tmp_path / folder)
        assert list(sequence.warnings) == [
            f"'motion': read as {words}, since only so frames match the ones before them"
        ]
        for number in sequence.numbers:
            motion = sequence.frame(number).motion[0].permute(1, 2, 0).numpy()
            np.testing.assert_allclose(motion, np.broadcast_to(SHIFT, motion.shape), rtol=1e-6)
    sequence = open_sequence(tmp_path / "wrong")
    assert "motion" not in sequence.buffers
    assert sequence.frame(1).motion is None
    assert any("does not lead to what looks alike" in warning for warning in sequence.warnings)
    assert any("where 0.5 stands for no motion" in warning for warning in open_sequence(tmp_path / "picture").warnings)


def test_zero_motion_is_dropped_where_the_camera_moves(others: Any, tmp_path: Path) -> None:
    """Blender writes such motion with motion blur."""
    first: dict[str, Any] = {}
    for number in (1, 2, 3):
        truth = others.read(number)
        channels = as_channels({"": truth["color"]}) | as_channels({"Position": truth["position"]}, "XYZ")
        channels |= {f"Vector.{name}": np.zeros((36, 64)) for name in "XYZW"}
        channels["Depth.Z"] = truth["depth"]
        save(tmp_path / "moves" / f"a_{number}.exr", channels)
        # The first frame again and again: nothing moves, and zeros are right.
        first = first or channels
        save(tmp_path / "stays" / f"a_{number}.exr", first)
    sequence = open_sequence(tmp_path / "moves")
    assert "motion" not in sequence.buffers
    assert any("all zeros although the camera moves" in warning for warning in sequence.warnings)
    assert sequence.frame(2).motion is None
    still = open_sequence(tmp_path / "stays")
    assert "motion" in still.buffers
    assert list(still.warnings) == []
    assert not still.frame(2).motion.any()


@pytest.mark.parametrize("black", [0, 1])
def test_a_shot_that_fades_in_is_read_by_a_frame_that_shows_something(black: int, tmp_path: Path) -> None:
    """An empty frame looks like signed normals and radiance without albedo."""
    albedo, towards = texture("colored"), np.random.default_rng(0).normal(size=(HEIGHT, WIDTH, 3)).astype(np.float32)
    towards[..., 2] = -np.abs(towards[..., 2])
    normal = towards / np.linalg.norm(towards, axis=-1, keepdims=True)
    for number in range(4):
        seen = float(number >= black)
        channels = as_channels({"": light(number) * albedo * seen, "albedo": albedo * seen})
        channels |= as_channels({"N": (normal / 2 + 0.5) * seen}, "XYZ")
        save(tmp_path / f"shot_{number}.exr", channels)
    sequence = open_sequence(tmp_path)
    assert {row.buffer: row.reading for row in sequence.table}["normal"] == "stored as n/2 + 1/2, decoded"
    frame = sequence.frame(2)
    assert frame.normal is not None
    np.testing.assert_allclose(frame.normal[0].permute(1, 2, 0).numpy(), normal, atol=1e-3)
    assert sequence.color_has_albedo


@pytest.mark.parametrize("names", ["RGBA", ("Ci.r", "Ci.g", "Ci.b", "a")])
def test_alpha_of_pixel_filters_and_bad_samples_of_all_buffers_are_read(names: Sequence[str], tmp_path: Path) -> None:
    """Lobes of a filter are negative at an edge, and a sample that is NaN is so in all channels."""
    pixels = np.full((8, 12), 0.5, np.float32)
    pixels[2, 3:6] = np.nan, -0.02, 1.05
    others = {"roughness": np.clip(pixels, 0, 1), "variance": np.where(pixels < 0, np.inf, pixels)}
    sequence = open_sequence(save(tmp_path / "a.exr", dict.fromkeys(names, pixels) | others))
    found = sequence.frame(0)
    assert found.alpha is not None
    assert {"roughness", "variance"} <= found.buffers
    assert found.alpha[0, 0, 2, 3:6].tolist() == [1, 0, 1]
    found.inspect()
