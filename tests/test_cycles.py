"""Random scenes for Cycles: what they are translated to, how passes become buffers, and, where there is one, Blender.

The variable BLENDER_PYTHON names an interpreter with ``bpy``; without it nothing is rendered.
"""

import importlib.util
import json
import math
import os
import re
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from planes import pixel_rays, seen_at
from refusals import refused

from mcdenoise.cli.generate import generate
from mcdenoise.data import open_sequence
from mcdenoise.data.camera_path import Camera, view_projection
from mcdenoise.data.exr import read_exr
from mcdenoise.scenes.assets import Assets
from mcdenoise.scenes.assets import Mesh as Triangles
from mcdenoise.scenes.cycles import Blender, render_cycles
from mcdenoise.scenes.cycles.process import PYTHON_VARIABLE
from mcdenoise.scenes.cycles.sequence import _prolonged, buffers_of
from mcdenoise.scenes.cycles.translate import Mesh, tessellate, translate
from mcdenoise.scenes.random.builder import place, rgb, rotate
from mcdenoise.scenes.render import Film
from mcdenoise.scenes.takes.draw import Take, draw_take

PYTHON = os.environ.get(PYTHON_VARIABLE)
GRAY = {"type": "diffuse", "reflectance": rgb((0.5, 0.5, 0.5))}
CAMERA = Camera.look_at((0, 0, 4), (0, 0, 0), fov_x=40)


def take_of(scene: dict[str, Any], cameras: list[Camera], **changed: Any) -> Take:
    """A take of a scene, sampled at pixel centres through a pinhole."""
    drawn = draw_take(0, Assets(), frames=1, stills=False)
    plain = replace(drawn, scene=scene, cameras=cameras, moves={}, film=Film("centre"))
    return replace(plain, **changed)


def scene_of(**entries: dict[str, Any]) -> dict[str, Any]:
    return {"type": "scene", **entries}


def ball(bsdf: dict[str, Any], **more: Any) -> dict[str, Any]:
    return {"type": "sphere", "to_world": np.eye(4), "bsdf": bsdf, **more}


def material_of(bsdf: dict[str, Any], seed: int = 0) -> dict[str, Any]:
    (material,) = translate(scene_of(ball=ball(bsdf)), seed=seed).content["materials"]
    return dict(material)


def bitmap(image: np.ndarray[Any, Any], repeat: float = 1) -> dict[str, Any]:
    return {"type": "bitmap", "bitmap": image, "raw": True, "to_uv": np.diag((repeat, repeat, 1.0, 1.0))}


def normals_and_areas(mesh: Mesh) -> tuple[Any, Any]:
    a, b, c = (mesh.vertices[mesh.triangles[:, k]] for k in range(3))
    double = np.cross(b - a, c - a)
    length = np.linalg.norm(double, axis=1)
    return double / length[:, None], length / 2


@pytest.mark.parametrize(
    ("kind", "area", "outwards"),
    [
        ("cube", 24, lambda p: p),
        ("sphere", 4 * math.pi, lambda p: p),
        ("cylinder", 2 * math.pi, lambda p: p * (1, 1, 0)),
        ("disk", math.pi, lambda p: p * 0 + (0, 0, 1)),
        ("rectangle", 4, lambda p: p * 0 + (0, 0, 1)),
    ],
)
@pytest.mark.parametrize("mirrored", [False, True])
def test_triangles_make_the_shape_and_face_outwards(kind: str, area: float, outwards: Any, mirrored: bool) -> None:
    mesh = tessellate(kind)
    if mirrored:
        mesh = mesh.placed(np.diag((1.0, -1.0, 1.0, 1.0)))
    normals, areas = normals_and_areas(mesh)
    # A circle of 64 chords is shorter by 0.04 % and smaller by 0.16 %, a sphere of them by no more than the sum.
    assert area * 0.997 < areas.sum() <= area * (1 + 1e-12)
    middles = mesh.vertices[mesh.triangles].mean(1)
    assert ((normals * outwards(middles)).sum(1) > 0).all()
    assert mesh.uv.min() >= 0
    assert mesh.uv.max() <= 1


def test_closed_shapes_have_each_edge_twice() -> None:
    triangles = tessellate("sphere").triangles
    edges = Counter((int(a), int(b)) for t in triangles for a, b in zip(t, np.roll(t, -1), strict=True))
    assert set(edges.values()) == {1}
    assert all((b, a) in edges for a, b in edges)


def test_texture_coordinates_are_those_of_mitsuba() -> None:
    for kind, angle in (("sphere", 0), ("cylinder", 0), ("disk", 1)):
        mesh = tessellate(kind)
        points, uv = mesh.vertices[mesh.triangles], mesh.uv
        turn = uv[..., angle] - np.arctan2(points[..., 1], points[..., 0]) / (2 * math.pi)
        away = np.hypot(points[..., 0], points[..., 1]) > 1e-9
        np.testing.assert_allclose(turn[away], np.rint(turn[away]), atol=1e-12)
    sphere, cylinder, disk = (tessellate(kind) for kind in ("sphere", "cylinder", "disk"))
    np.testing.assert_allclose(
        np.cos(math.pi * sphere.uv[..., 1]), sphere.vertices[sphere.triangles][..., 2], atol=1e-12
    )
    np.testing.assert_allclose(cylinder.uv[..., 1], cylinder.vertices[cylinder.triangles][..., 2])
    np.testing.assert_allclose(disk.uv[..., 0], np.linalg.norm(disk.vertices[disk.triangles], axis=-1), atol=1e-12)


@pytest.mark.parametrize("seed", [0, 2, 4])
def test_random_scenes_are_translated_whole(seed: int, tmp_path: Path) -> None:
    made = draw_take(seed, Assets(), frames=2, stills=False)
    moves = made.moves.keys() - {"sky"}
    description = translate(made.scene, moves, seed=seed)
    objects = description.content["objects"]
    assert {each["id"] for each in objects if each["moves"]} == moves
    assert [each["index"] for each in objects] == list(range(len(objects)))
    faces = description.arrays["object0_material"]
    assert faces.max() < len(description.content["materials"])
    expected = {
        tuple(entry["emitter"]["radiance"]["value"])
        for entry in made.scene.values()
        if isinstance(entry, dict) and "emitter" in entry
    }
    assert {tuple(m["radiance"]) for m in description.content["materials"] if "radiance" in m} == expected
    assert (description.content["sky"] is not None) == ("sky" in made.scene)
    description.save(tmp_path)
    assert json.loads((tmp_path / "scene.json").read_text()) == description.content
    with np.load(tmp_path / "scene.npz", allow_pickle=False) as file:
        assert set(file) == set(description.arrays)


@pytest.mark.parametrize(
    ("bsdf", "expected"),
    [
        ({"type": "twosided", "bsdf": GRAY}, {"Base Color": [0.5] * 3, "Roughness": 1.0, "Metallic": 0.0}),
        (
            {"type": "roughconductor", "material": "Au", "alpha": 0.04, "specular_reflectance": rgb((0.5, 1, 1))},
            {"Base Color": [0.47, 0.78, 0.37], "Metallic": 1.0, "Roughness": [0.2] * 3},
        ),
        ({"type": "dielectric", "int_ior": 1.3}, {"Transmission Weight": 1.0, "IOR": 1.3, "Roughness": 0.0}),
        ({"type": "mask", "opacity": 0.25, "bsdf": GRAY}, {"Alpha": [0.25] * 3, "Base Color": [0.5] * 3}),
    ],
)
def test_materials_become_principled(bsdf: dict[str, Any], expected: dict[str, Any]) -> None:
    inputs = material_of(bsdf)["inputs"]
    for key, value in expected.items():
        assert inputs[key] == pytest.approx(value)


def test_lacquer_is_a_coat_or_a_specular_base() -> None:
    bsdf = {"type": "roughplastic", "diffuse_reflectance": rgb((0.1, 0.2, 0.3)), "alpha": 0.04}
    found = [material_of(bsdf, seed)["inputs"] for seed in range(40)]
    coats = [each for each in found if each["Coat Weight"]]
    assert all(each["Coat Roughness"] == pytest.approx(0.2) for each in coats)
    others = [each for each in found if not each["Coat Weight"]]
    assert all(each["Roughness"] == pytest.approx(0.2) and each["Specular IOR Level"] for each in others)
    # 40 throws of a coin: fewer than 5 of either side happen once in a million times.
    assert min(len(coats), len(others)) >= 5
    assert found[0] == material_of(bsdf, 0)["inputs"]


def test_textures_are_kept_once_and_even_ones_are_colors() -> None:
    image = np.random.default_rng(0).random((4, 4, 3))
    first, second = ({"type": "diffuse", "reflectance": bitmap(image, repeat)} for repeat in (1.0, 3.0))
    even = {"type": "diffuse", "reflectance": bitmap(np.full((2, 2, 3), 0.25))}
    description = translate(scene_of(a=ball(first), b=ball(second), c=ball(even)))
    assert [m["inputs"]["Base Color"] for m in description.content["materials"]] == [
        {"texture": "texture0", "scale": [1.0, 1.0]},
        {"texture": "texture0", "scale": [3.0, 3.0]},
        [0.25] * 3,
    ]
    np.testing.assert_array_equal(description.arrays["texture0"], image.astype(np.float32))


@pytest.mark.parametrize("entry", [ball({"type": "hair"}), {**ball(GRAY), "type": "obj"}], ids=["material", "shape"])
def test_what_cycles_cannot_be_given_is_named(entry: dict[str, Any]) -> None:
    assert re.search(r"Cycles can be given.*found '(hair|obj)'", refused(translate, scene_of(thing=entry)))


def passes(height: int, width: int) -> dict[str, Any]:
    return {
        "Combined": np.ones((height, width, 3), np.float32),
        "Denoising Albedo": np.zeros((height, width, 3), np.float32),
        "Denoising Normal": np.zeros((height, width, 3), np.float32),
        "Depth": np.full((height, width, 1), 1e10, np.float32),
        "Position": np.zeros((height, width, 3), np.float32),
        "IndexOB": np.zeros((height, width, 1), np.float32),
    }


def test_sky_is_far_along_the_rays_and_albedo_is_clamped() -> None:
    images = passes(4, 6)
    images["Denoising Albedo"][0, 0] = (7.0, np.nan, -0.1)
    images["Depth"][1, 2], images["Position"][1, 2] = 4.0, (0, 0, 0)
    camera = Camera.look_at((1, 2, 4), (0, 0.5, 0), fov_x=50)
    buffers = buffers_of(images, camera, {})
    assert list(buffers)[-1] == "color"
    np.testing.assert_array_equal(buffers["albedo"][0, 0], (1, 0, 0))
    assert np.isinf(buffers["depth"]).sum() == 4 * 6 - 1
    x, y, clip = seen_at(buffers["position"], view_projection(camera, 6, 4, 0.1, 1e5))
    sky = np.isinf(buffers["depth"][..., 0])
    rows, columns = np.nonzero(sky)
    np.testing.assert_allclose(x[sky] - 0.5, columns, atol=1e-9)
    np.testing.assert_allclose(y[sky] - 0.5, rows, atol=1e-9)
    np.testing.assert_allclose(clip[sky][:, 3], 4000.0)


def test_normals_are_turned_to_the_world() -> None:
    camera = Camera.look_at((1, 2, 4), (0, 0.5, 0), fov_x=50)
    left, up, forward = camera.to_world[:3, :3].T
    images = passes(1, 3)
    # These normals face the camera, the right and the top, in Blender's space of the camera.
    images["Denoising Normal"][0] = (0, 0, -1), (1, 0, 0), (0, 1, 0)
    normal = buffers_of(images, camera, {})["normal"]
    np.testing.assert_allclose(normal[0], (-forward, -left, up), atol=1e-12)


def test_moving_objects_are_led_back_by_their_index() -> None:
    images = passes(1, 3)
    images["Depth"][:] = 1
    images["Position"][0] = (1, 0, 0), (2, 0, 0), (3, 0, 0)
    images["IndexOB"][0, :, 0] = 0, 1, 2
    back = {1: place((0, 5, 0)), 2: rotate("y", 90)}
    before = buffers_of(images, CAMERA, back)["previous_position"]
    np.testing.assert_allclose(before[0], [(1, 0, 0), (2, 5, 0), (0, 0, -3)], atol=1e-12)


def test_motion_goes_on_before_and_after_the_frames() -> None:
    step = place((0.1, 0, 0.2), turn=7)
    poses = [np.eye(4)]
    for _ in range(4):
        poses.append(step @ poses[-1])
    np.testing.assert_allclose(_prolonged(np.stack(poses[1:4])), np.stack(poses), atol=1e-12)
    np.testing.assert_array_equal(_prolonged(np.stack(poses[:1])), np.stack([np.eye(4)] * 3))


def test_a_python_without_blender_is_told_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(PYTHON_VARIABLE, raising=False)
    if importlib.util.find_spec("bpy") is not None:
        pytest.skip("this Python has bpy")
    told = refused(generate, tmp_path, renderer="cycles", seeds="0", frames=1, assets="none")
    assert re.search(r"bpy.*BLENDER_PYTHON$", told)
    assert "nothing that runs" in refused(Blender, tmp_path / "python")
    assert not any(tmp_path.iterdir())


def test_a_blender_that_has_died_is_told_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "bpy.py").write_text("class app: version_string = 'none'")
    (tmp_path / "mathutils.py").write_text("Matrix = None")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with Blender(Path(sys.executable)) as running:
        running._process.kill()
        running._process.wait()
        assert "'render': it ended" in refused(running.ask, "render")


@pytest.fixture(scope="module")
def blender() -> Iterator[Blender]:
    if PYTHON is None:
        pytest.skip("no BLENDER_PYTHON")
    with Blender(Path(PYTHON)) as running:
        yield running


def rendered(blender: Blender, folder: Path, scene: dict[str, Any], camera: Camera = CAMERA, **options: Any) -> Any:
    options = {"size": (24, 16), "noise_seeds": 1, "reference_spp": 64, **options}
    return open_sequence(render_cycles(take_of(scene, [camera]), folder, blender, **options)).frame(0)


def image(buffer: Any) -> Any:
    return buffer[0].permute(1, 2, 0).double().numpy()


def test_a_gray_ball_in_an_even_sky_is_as_bright_as_it_is_gray(blender: Blender, tmp_path: Path) -> None:
    frame = rendered(blender, tmp_path, scene_of(ball=ball(GRAY), sky={"type": "constant", "radiance": 2.0}))
    rays = pixel_rays(CAMERA, 24, 16)
    # A ray meets the ball of radius 1 here, well inside of its outline, of which triangles cut off a little.
    along = -(rays.directions @ rays.origin)
    nearest = np.sqrt(rays.origin @ rays.origin - along**2)
    hit = (nearest < 0.9).reshape(16, 24)
    points = rays.origin + (along - np.sqrt(np.maximum(1 - nearest**2, 0)))[:, None] * rays.directions
    points = points.reshape(16, 24, 3)
    assert hit.sum() > 30
    # 64 chords around: 0.0012 within the sphere, and 3 times as far along a ray that meets it at a slant.
    np.testing.assert_allclose(image(frame.position)[hit], points[hit], atol=5e-3)
    np.testing.assert_allclose(image(frame.normal)[hit], points[hit], atol=0.02)
    np.testing.assert_allclose(image(frame.albedo)[hit], 0.5, atol=1e-3)
    # Every path but for those in the shadow of its own triangles leaves for the sky.
    np.testing.assert_allclose(image(frame.reference)[hit], 1.0, rtol=0.03)
    missed = (nearest > 1.01).reshape(16, 24)
    np.testing.assert_allclose(image(frame.color)[missed], 2.0, rtol=1e-3)
    assert np.isinf(image(frame.depth)[missed]).all()


def test_parts_add_up_to_each_noisy_color(blender: Blender, tmp_path: Path) -> None:
    shiny = {"type": "roughconductor", "material": "Ag", "alpha": 0.1}
    scene = scene_of(ball=ball(shiny), sky={"type": "constant", "radiance": 2.0}) | floor()
    made = take_of(scene, [CAMERA])
    options: dict[str, Any] = {"size": (24, 16), "noise_seeds": 2, "reference_spp": 0}
    render_cycles(made, tmp_path, blender, **options)
    before = pixels(tmp_path)
    # Buffers that are requested later are added, and the noise stays the same.
    sequence = open_sequence(render_cycles(made, tmp_path, blender, **options, parts=True))
    for name, values in before.items():
        np.testing.assert_array_equal(pixels(tmp_path)[name], values)
    assert {"diffuse", "specular"} <= sequence.buffers & sequence.noisy
    for noise_seed in range(2):
        frame = sequence.frame(0, noise_seed=noise_seed)
        total = image(frame.diffuse) + image(frame.specular)
        # Each is rounded to half floats.
        np.testing.assert_allclose(total, image(frame.color), rtol=2 * 2.0**-11, atol=3 * 2.0**-24)
        assert min(image(frame.diffuse).max(), image(frame.specular).max()) > 0


def floor(**more: Any) -> dict[str, Any]:
    return scene_of(floor={"type": "rectangle", "to_world": place((0, 0, 0), scale=(5, 5, 1)), "bsdf": GRAY}, **more)


def middle(buffer: Any) -> Any:
    return image(buffer)[7:9, 11:13].mean((0, 1))


def test_lights_are_as_bright_as_in_mitsuba(blender: Blender, tmp_path: Path) -> None:
    # Intensity / distance^2 falls on the wall, of which a half is sent on evenly: times albedo / pi.
    point = {"type": "point", "position": [0, 0, 2], "intensity": rgb((8, 4, 2))}
    # Mitsuba's spots shine along +z.
    spot = {"type": "spot", "to_world": place((0, 0, 2), rotation=rotate("x", 180)), "intensity": rgb((8, 4, 2))}
    for number, light in enumerate((point, {**spot, "cutoff_angle": 40.0})):
        frame = rendered(blender, tmp_path / str(number), floor(light=light))
        np.testing.assert_allclose(middle(frame.reference), np.array((8, 4, 2)) / 4 * 0.5 / math.pi, rtol=0.02)


def test_lamps_shine_to_one_side(blender: Blender, tmp_path: Path) -> None:
    black = {"type": "diffuse", "reflectance": rgb((0, 0, 0))}
    lamp = {"type": "rectangle", "bsdf": black, "emitter": {"type": "area", "radiance": rgb((6, 3, 1))}}
    for turn, expected in ((0, (6, 3, 1)), (180, (0, 0, 0))):
        frame = rendered(blender, tmp_path / str(turn), scene_of(lamp={**lamp, "to_world": place((0, 0, 0), turn)}))
        np.testing.assert_allclose(middle(frame.reference), expected, rtol=1e-3, atol=1e-6)


def test_sky_is_where_mitsuba_has_it(blender: Blender, tmp_path: Path) -> None:
    rows, columns = 32, 64
    polar = (np.arange(rows) + 0.5)[:, None] / rows * math.pi
    around = (np.arange(columns) + 0.5)[None] / columns * 2 * math.pi
    # Mitsuba's envmap in its own space, see mcdenoise.scenes.random.lights.sky.
    direction = np.stack(
        np.broadcast_arrays(np.sin(around) * np.sin(polar), np.cos(polar), -np.cos(around) * np.sin(polar)), -1
    )
    sky = {"type": "envmap", "bitmap": direction + 1.0}
    for number, target in enumerate(((1, 0.2, 0.3), (-0.4, -0.3, 1), (-1, 0.1, -0.5))):
        camera = Camera.look_at((0, 0, 0), target, fov_x=30)
        frame = rendered(blender, tmp_path / str(number), scene_of(sky=sky), camera)
        expected = pixel_rays(camera, 24, 16).directions.reshape(16, 24, 3) + 1
        # Between the pixels of the sky, 0.1 apart, it is interpolated: within an eighth of the square of that.
        np.testing.assert_allclose(image(frame.reference), expected, atol=4e-3)


def test_textures_lie_as_in_mitsuba(blender: Blender, tmp_path: Path) -> None:
    # Mitsuba's first row of a bitmap is where v is 0: at the bottom of a rectangle, whose u runs along x.
    rows, columns = (np.arange(16) + 0.5) / 16, (np.arange(16) + 0.5) / 16
    picture = np.stack(np.broadcast_arrays(columns[None], rows[:, None], np.float64(0.5)), -1)
    wall = {"type": "rectangle", "to_world": np.eye(4), "bsdf": {"type": "diffuse", "reflectance": bitmap(picture)}}
    frame = rendered(blender, tmp_path, scene_of(wall=wall, sky={"type": "constant", "radiance": 1.0}))
    position = image(frame.position)
    inside = (np.abs(position[..., :2]) < 0.9).all(-1) & np.isfinite(image(frame.depth)[..., 0])
    assert inside.sum() > 30
    # Half floats round by 0.0005 at most.
    np.testing.assert_allclose(image(frame.albedo)[inside][:, :2], (position[inside][:, :2] + 1) / 2, atol=2e-3)


def test_models_and_normal_maps_lie_as_in_mitsuba(blender: Blender, tmp_path: Path) -> None:
    corners = np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], np.float32)
    uv = (corners[:, :2] + 1) / 2
    square = Triangles(corners, np.array([(0, 1, 2), (0, 2, 3)], np.int32), uv, None)
    rows, columns = (np.arange(16) + 0.5) / 16, (np.arange(16) + 0.5) / 16
    picture = np.stack(np.broadcast_arrays(columns[None], rows[:, None], np.float64(0.5)), -1)
    # One half leans to +x, the other stands upright.
    bumps = np.full((16, 16, 3), (0.5, 0.5, 1.0))
    bumps[:, 8:] = (0.8, 0.5, 0.9)
    gray = {"type": "diffuse", "reflectance": bitmap(picture)}
    wall = {"type": "mesh", "to_world": np.eye(4), "mesh": square}
    wall["bsdf"] = {"type": "twosided", "bsdf": {"type": "normalmap", "normalmap": bitmap(bumps), "bsdf": gray}}
    frame = rendered(blender, tmp_path, scene_of(wall=wall, sky={"type": "constant", "radiance": 1.0}))
    position, normal = image(frame.position), image(frame.normal)
    inside = (np.abs(position[..., :2]) < 0.9).all(-1) & np.isfinite(image(frame.depth)[..., 0])
    # Images of models begin at the top.
    expected = (position[inside][:, :2] * (1, -1) + 1) / 2
    np.testing.assert_allclose(image(frame.albedo)[inside][:, :2], expected, atol=2e-3)
    for half, x in ((position[..., 0] < -0.1, 0.0), (position[..., 0] > 0.2, 0.6)):
        found = normal[inside & half]
        np.testing.assert_allclose(found, np.tile((x, 0, math.sqrt(1 - x * x)), (len(found), 1)), atol=0.02)


def pixels(folder: Path) -> dict[str, Any]:
    return {path.relative_to(folder).as_posix(): read_exr(path)[0] for path in folder.rglob("*.exr")}


def test_a_sequence_is_resumed_to_the_same_pixels(blender: Blender, tmp_path: Path) -> None:
    drawn = draw_take(4, Assets(), frames=2, stills=False)
    assert drawn.moves.keys() - {"sky"}
    made = replace(drawn, film=Film("gaussian"))
    options: dict[str, Any] = {"size": (24, 16), "noise_seeds": 2, "reference_spp": 8, "seed": 5}
    options |= {"spp": 2, "shutter": 0.0, "reference_frames": [1]}
    seen: list[tuple[int, int]] = []
    folder = render_cycles(made, tmp_path, blender, **options, progress=lambda *each: seen.append(each))
    assert seen[0] == (0, 2 * 2 * 2 + 8)
    assert seen[-1] == (16, 16)
    before = pixels(folder)
    sequence = open_sequence(tmp_path)
    assert (sequence.noise_seeds, sequence.reference_numbers) == (2, [1])
    assert {"previous_position", "view_projection"} <= sequence.buffers
    # Through a filter each noisy color has samples of its own, and so have its features; but for what Cycles takes from
    # the first sample alone, which it puts at the pixel centre.
    for name in ("color", "albedo", "shading_normal", "world_position", "depth", "previous_position"):
        own, other = (before[f"{part}{name}1.exr"] for part in ("", "noise_seed1/"))
        assert (own != other).any() == (name in ("color", "albedo", "shading_normal"))
    for path in (folder / "color1.exr", folder / "noise_seed1" / "color0.exr", folder / "reference1.exr"):
        path.unlink()
    render_cycles(made, tmp_path, blender, **options)
    after = pixels(folder)
    assert after.keys() == before.keys()
    for name, values in before.items():
        np.testing.assert_array_equal(after[name], values)
    assert "seed 5" in refused(render_cycles, made, tmp_path, blender, **{**options, "seed": 6})


def test_lens_and_shutter_blur(blender: Blender, tmp_path: Path) -> None:
    wall = {"type": "rectangle", "to_world": place((0, 0, -20), scale=(40, 20, 1)), "bsdf": GRAY}
    bar = {"type": "rectangle", "to_world": place((0, 0, 1), scale=(0.03, 2, 1)), "bsdf": GRAY}
    scene = scene_of(wall=wall, bar=bar, sky={"type": "constant", "radiance": 1.0})
    spread = []
    for aperture in (0.0, 1.0):
        take = take_of(scene, [CAMERA], film=Film("centre", aperture, focus=24.0))
        options: dict[str, Any] = {"size": (24, 16), "noise_seeds": 1, "reference_spp": 0, "shutter": 0.0}
        frame = open_sequence(render_cycles(take, tmp_path / f"{aperture}", blender, **options)).frame(0)
        near = image(frame.depth)[..., 0] < 10
        spread.append(np.unique(np.nonzero(near)[1]).size)
    # Focused on the wall behind it, the bar is seen over more columns than the one or two that it covers.
    assert spread[0] <= 2 < spread[1]
    cameras = [Camera.look_at((x, 0, 4), (x, 0, 0), 40) for x in (0.0, 1.0)]
    spread = []
    for shutter in (0.0, 0.5):
        take = take_of(scene, cameras)
        folder = render_cycles(take, tmp_path / f"shutter{shutter}", blender, **{**options, "shutter": shutter})
        near = image(open_sequence(folder).frame(0).depth)[..., 0] < 10
        spread.append(np.unique(np.nonzero(near)[1]).size)
    assert spread[0] <= 2 < spread[1]


@pytest.mark.parametrize("option", ["spp", "noise_seeds", "reference_spp", "threads", "seed"])
def test_numbers_below_the_least_are_told(blender: Blender, tmp_path: Path, option: str) -> None:
    assert f"{option}:" in refused(render_cycles, take_of(scene_of(), [CAMERA]), tmp_path, blender, **{option: -1})
