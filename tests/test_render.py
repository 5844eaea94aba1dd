"""Rendering with the real Mitsuba: what the files promise about pixel centres, noise and references."""

import itertools
import json
import re
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from commands import refuses, succeeds
from planes import seen_at
from refusals import refused

from mcdenoise.data.exr import read_exr, write_exr
from mcdenoise.data.sequences import open_sequence
from mcdenoise.scenes.demo import demo_cameras, demo_scene
from mcdenoise.scenes.random.builder import place, rotate
from mcdenoise.scenes.render import Camera, render_sequence
from mcdenoise.scenes.render import frames as render_frames
from mcdenoise.scenes.render.loading import LLVM, first_working

WIDTH, HEIGHT = 32, 18
SCALAR: dict[str, Any] = {"size": (WIDTH, HEIGHT), "variant": "scalar_rgb"}


@pytest.fixture(autouse=True)
def _mitsuba(request: pytest.FixtureRequest) -> None:
    if "without_mitsuba" not in request.fixturenames:
        pytest.importorskip("mitsuba", reason="rendering needs Mitsuba: pip install 'mcdenoise[render]'")


@pytest.fixture
def without_mitsuba(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two different cameras, the second one twice: frame 2 is frame 1 with other noise."""
    pytest.importorskip("mitsuba")
    cameras = demo_cameras(9)
    out = tmp_path_factory.mktemp("sequence")
    return render_sequence(
        demo_scene(), [cameras[0], cameras[8], cameras[8]], out, reference_spp=2, reference_frames=[1], **SCALAR
    )


def read(folder: Path, name: str) -> np.ndarray[Any, Any]:
    return read_exr(folder / f"{name}.exr")[0]


def images(folder: Path) -> dict[str, bytes]:
    """Pixels of every image; not the files, whose headers hold the time of writing."""
    return {path.name: read_exr(path)[0].tobytes() for path in folder.glob("*.exr")}


def describe(folder: Path) -> dict[str, Any]:
    return dict(json.loads((folder / "camera.json").read_text()))


def test_positions_project_to_their_pixel_centres(sequence: Path) -> None:
    for number in range(3):
        position, matrix = read(sequence, f"world_position{number}"), describe(sequence)["camera_matrices"][number]
        column, row, clip = seen_at(position, matrix)
        assert np.abs(column - (np.arange(WIDTH) + 0.5)).max() < 1e-3
        assert np.abs(row - (np.arange(HEIGHT) + 0.5)[:, None]).max() < 1e-3
        depth = read(sequence, f"depth{number}")[..., 0]
        np.testing.assert_allclose(depth, clip[..., 3], rtol=2**-11)  # half floats
        assert ((clip[..., 2] / clip[..., 3] >= 0) & (clip[..., 2] / clip[..., 3] <= 1)).all()


def test_normals_are_unit_length_and_face_the_viewer(sequence: Path) -> None:
    normal = read(sequence, "shading_normal0").astype(np.float64)
    view = np.array(describe(sequence)["camera_to_world"][0])[:3, 3] - read(sequence, "world_position0")
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1, atol=1e-3)
    assert ((normal * view).sum(axis=-1) >= -1e-3).all()


def test_albedo_is_a_reflectance_and_zero_on_glass_mirrors_and_lights(sequence: Path) -> None:
    albedo = read(sequence, "albedo0")
    assert albedo.min() == 0
    assert 0.5 < albedo.max() <= 1


def test_a_static_camera_repeats_the_features_but_not_the_noise(sequence: Path) -> None:
    for name in ("albedo", "shading_normal", "world_position", "depth"):
        assert np.array_equal(read(sequence, f"{name}1"), read(sequence, f"{name}2"))
    lit = (read(sequence, "albedo1") > 0).any(axis=-1)
    first, second = (read(sequence, f"color{number}")[lit].mean(axis=-1) for number in (1, 2))
    assert (first != second).mean() > 0.8


def test_a_stopped_run_is_resumed(tmp_path: Path) -> None:
    def render(frames: int | None, **settings: Any) -> Path:
        return render_sequence(
            demo_scene(), demo_cameras(3), tmp_path, frames=frames, reference_spp=2, **{**SCALAR, **settings}
        )

    folder = render(None)
    whole, description = images(folder), describe(folder)
    kept = (folder / "color0.exr").stat().st_mtime_ns
    (folder / "color1.exr").unlink()
    (folder / "reference2.exr").unlink()
    calls: list[tuple[int, int]] = []
    render(None, progress=lambda done, total: calls.append((done, total)))
    assert images(folder) == whole
    assert (folder / "color0.exr").stat().st_mtime_ns == kept
    assert calls[-1] == (9, 9)
    render(2)
    assert images(folder) == whole
    assert describe(folder) == description
    assert re.search(r"seed 0, .*1", refused(render, None, seed=1))


def test_damaged_files_are_rendered_again(tmp_path: Path) -> None:
    """A file that is empty, cut short, garbage, of another size or elsewhere is not one of a finished frame."""

    def render() -> Path:
        return render_sequence(demo_scene(), demo_cameras(2), tmp_path, noise_seeds=2, reference_spp=2, **SCALAR)

    folder = render()
    paths = sorted(path for path in folder.rglob("*.exr") if path.stem[-1] == "1")
    assert {path.parent.name for path in paths} == {"inputs", "noise_seed1"}
    intact = {path: path.read_bytes() for path in folder.rglob("*.exr")}
    shown = {path: read_exr(path)[0] for path in intact}
    other = write_exr_bytes(tmp_path / "other.exr", np.zeros((3, 5, 3)))
    for number, path in enumerate(paths):
        content = intact[path]
        damaged = [b"", content[: len(content) // 2], content[:-1], b"garbage" * 99, other]
        path.write_bytes(damaged[number % len(damaged)])
    render()
    for path, image in shown.items():
        np.testing.assert_array_equal(read_exr(path)[0], image)
        # A whole file was not rendered again: the header holds the time.
        assert (path.read_bytes() == intact[path]) or path in paths


def write_exr_bytes(path: Path, image: np.ndarray[Any, Any]) -> bytes:
    write_exr(path, image, ["R", "G", "B"])
    content = path.read_bytes()
    path.unlink()
    return content


def test_another_scene_of_the_same_name_is_refused(tmp_path: Path) -> None:
    scene = demo_scene()
    settings = {**SCALAR, "reference_frames": []}
    render_sequence(scene, demo_cameras(1), tmp_path, **settings)
    scene["window"] = {**scene["window"], "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [1, 2, 3]}}}
    assert "scene_sha256" in refused(render_sequence, scene, demo_cameras(1), tmp_path, **settings)


@pytest.mark.parametrize("missing", [None, "frames", "camera_matrices", "end"])
def test_a_damaged_description_is_refused(sequence: Path, tmp_path: Path, missing: str | None) -> None:
    folder = tmp_path / "inputs"
    shutil.copytree(sequence, folder)
    about = {key: value for key, value in describe(folder).items() if key != missing}
    about |= {"frames": float("inf")} if missing == "end" else {}
    (folder / "camera.json").write_text(json.dumps(about) if missing else "{")
    settings = {**SCALAR, "reference_frames": []}
    assert "camera.json:" in refused(render_sequence, demo_scene(), demo_cameras(9)[:1], tmp_path, **settings)


def _furnace() -> dict[str, Any]:
    """A sphere inside a glowing one: the radiance of every pixel is known."""
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}}
    return {
        "type": "scene",
        "ball": {"type": "sphere", "radius": 1.0, "bsdf": grey},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 2.0}},
    }


def test_known_radiance_and_the_background(tmp_path: Path) -> None:
    camera = Camera.look_at((0, 0, 4), (0, 0, 0), fov_x=60)
    folder = render_sequence(_furnace(), [camera], tmp_path, reference_spp=64, **SCALAR)
    hit = (read(folder, "shading_normal0") != 0).any(axis=-1)
    assert 0.1 < hit.mean() < 0.5
    np.testing.assert_allclose(read(folder, "reference0")[hit].mean(), 1, rtol=0.02)
    assert (read(folder, "color0")[~hit] == 2).all()
    assert (read(folder, "albedo0")[hit] == 0.5).all()
    assert (read(folder, "albedo0")[~hit] == 0).all()
    # The reader turns the far point that stands for the background into infinite depth.
    depth = open_sequence(tmp_path).frame(0).depth
    assert torch.equal(torch.isinf(depth[0, 0]), torch.from_numpy(~hit))


def test_variants_agree(tmp_path: Path) -> None:
    if first_working(("llvm_ad_rgb",)) is None:
        pytest.skip(LLVM)
    folders = [
        render_sequence(
            demo_scene(), demo_cameras(1), tmp_path / variant, size=(WIDTH, HEIGHT), reference_spp=64, variant=variant
        )
        for variant in ("scalar_rgb", "llvm_ad_rgb")
    ]
    for name, tolerance in (("albedo", 2e-3), ("shading_normal", 2e-3), ("world_position", 1e-3), ("depth", 4e-3)):
        scalar, vector = (read(folder, f"{name}0") for folder in folders)
        # A ray along an edge may fall on either side.
        assert (np.abs(scalar - vector).max(axis=-1) > tolerance).mean() < 0.01, name
    scalar, vector = (np.minimum(read(folder, "reference0"), 4).mean() for folder in folders)
    np.testing.assert_allclose(scalar, vector, rtol=0.03)


def test_variants_agree_on_what_moves(moving: Path, tmp_path: Path) -> None:
    if first_working(("llvm_ad_rgb",)) is None:
        pytest.skip(LLVM)
    folder = _render_moving(tmp_path, variant="llvm_ad_rgb", reference_frames=[])
    for name in ("world_position2", "previous_position2", "albedo2"):
        different = np.abs(read(folder, name) - read(moving, name)).max(axis=-1) > 2e-3
        assert different.mean() < 0.01, name


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"noise_seeds": 0}, "noise_seeds: expected at least 1"),
        ({"workers": 0}, "workers: expected at least 1"),
        ({"noise_level": 0.0}, "noise_level: expected more than 0 and less than 1, found 0"),
        ({"moves": {"rug": np.eye(4)}}, "object 'rug': expected 1 matrices"),
        (
            {"moves": {"nothing": np.eye(4)[None]}},
            r"object 'nothing': expected the id of .*\(bench, .* and [0-9]+ more\)",
        ),
        ({"size": (0, 9)}, "size: expected"),
        ({"size": (16, 100000)}, "size: expected"),
        ({"frames": -1}, "at least one camera"),
        ({"frames": 0}, "at least one camera"),
        ({"spp": 0}, "spp: expected at least 1"),
        ({"seed": -1}, "seed: expected at least 0"),
        ({"reference_frames": [7]}, "expected numbers from 0 to 0, found 7"),
        ({"variant": "scalar_spectral"}, "expected one of scalar_rgb"),
    ],
)
def test_bad_settings(tmp_path: Path, settings: dict[str, Any], message: str) -> None:
    told = refused(render_sequence, demo_scene(), demo_cameras(1), tmp_path, **{**SCALAR, **settings})
    assert re.search(message, told)
    assert not list(tmp_path.iterdir())


def test_bad_scenes_and_folders(tmp_path: Path) -> None:
    def fails(scene: Any, message: str, out: Path = tmp_path / "out") -> None:
        assert message in refused(render_sequence, scene, demo_cameras(1), out, **SCALAR)

    broken = tmp_path / "broken.xml"
    broken.write_text("<scene version='3.0.0'><shape type='nonsense'/></scene>")
    file = tmp_path / "file"
    file.write_text("")
    fails(tmp_path / "no.xml", "no such file")
    fails(broken, "broken.xml: Mitsuba cannot load it")
    fails({"type": "scene", "a": {"type": "nonsense"}}, "scene dictionary: Mitsuba cannot load it")
    fails({"type": "sphere"}, "expected a Mitsuba scene")
    fails(_furnace(), "expected a folder", out=file)


@pytest.mark.usefixtures("without_mitsuba")
def test_without_mitsuba_the_error_says_what_to_install(tmp_path: Path) -> None:
    assert "pip install 'mcdenoise[render]'" in refused(render_sequence, demo_scene(), demo_cameras(1), tmp_path)


def test_passes_of_one_frame_do_not_reuse_the_noise_of_another(tmp_path: Path) -> None:
    camera = demo_cameras(1)[0]
    folder = render_sequence(demo_scene(), [camera] * 4, tmp_path, spp=16, reference_frames=[], **SCALAR)
    colors = [np.log1p(read(folder, f"color{number}").astype(np.float64)) for number in range(4)]
    neighbours = np.mean([np.abs(a - b).mean() for a, b in itertools.pairwise(colors)])
    # Frames that share one of two passes would differ by a factor of 0.7 less.
    np.testing.assert_allclose(neighbours, np.abs(colors[0] - colors[3]).mean(), rtol=0.15)


TINY: dict[str, Any] = {"size": (16, 9), "variant": "scalar_rgb"}


def test_noise_seeds_are_independent_and_have_one_expectation(tmp_path: Path) -> None:
    camera, count = demo_cameras(1)[0], 24
    settings = {**TINY, "reference_spp": 256}
    alone = render_sequence(demo_scene(), [camera], tmp_path / "alone", **{**settings, "reference_frames": []})
    folder = render_sequence(demo_scene(), [camera], tmp_path / "many", noise_seeds=count, **settings)
    assert np.array_equal(read(folder, "color0"), read(alone, "color0"))
    sequence = open_sequence(folder)
    assert sequence.noise_seeds == describe(folder)["noise_seeds"] == count
    frames = [sequence.frame(0, noise_seed=k) for k in range(count)]
    reference = frames[0].reference
    colors = torch.cat([frame.color for frame in frames]).double().flatten(1)
    # Single pixels are too skewed for it, whole images are not.
    whole = colors.mean(1)
    assert (whole.mean() - reference.double().mean()).abs() < 4 * whole.std() * (1 / count + 1 / 256) ** 0.5
    residual = torch.log1p(colors) - torch.log1p(colors).mean(0)
    assert ((residual[1:] * residual[:-1]).sum() / residual.square().sum()).abs() < 0.1


def test_noise_seeds_are_added_to_what_is_there(tmp_path: Path) -> None:
    settings = {**TINY, "reference_frames": []}
    folder = render_sequence(demo_scene(), demo_cameras(2), tmp_path, **settings)
    before = images(folder)
    render_sequence(demo_scene(), demo_cameras(2), tmp_path, noise_seeds=3, **settings)
    assert images(folder) == before
    assert open_sequence(folder).noise_seeds == 3
    (folder / "noise_seed2" / "color1.exr").unlink()
    assert open_sequence(folder).noise_seeds == 2
    render_sequence(demo_scene(), demo_cameras(1), tmp_path, **settings)
    assert describe(folder)["noise_seeds"] == 3


def test_a_reference_is_resumed_in_the_middle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = {**TINY, "reference_spp": 70}
    whole = render_sequence(demo_scene(), demo_cameras(1), tmp_path / "whole", **settings)
    monkeypatch.setattr(render_frames, "_SECONDS_BETWEEN_SAVES", -1)

    def interrupt(done: int, total: int) -> None:
        if done >= 48:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_sequence(demo_scene(), demo_cameras(1), tmp_path / "cut", progress=interrupt, **settings)
    folder = tmp_path / "cut" / "inputs"
    unfinished = folder / ".reference0.exr"
    content = unfinished.read_bytes()
    assert read_exr(unfinished)[2]["reference_spp"] == 32
    assert not (folder / "reference0.exr").exists()
    assert describe(folder)["reference_spp"] == {}
    calls: list[tuple[int, int]] = []
    render_sequence(demo_scene(), demo_cameras(1), folder.parent, progress=lambda *call: calls.append(call), **settings)
    assert images(folder) == images(whole)
    assert describe(folder)["reference_spp"] == describe(whole)["reference_spp"]
    assert {path.name for path in folder.iterdir()} == {path.name for path in whole.iterdir()}
    assert calls[-1] == (71, 71)
    (folder / "reference0.exr").unlink()
    unfinished.write_bytes(content[:-9])
    render_sequence(demo_scene(), demo_cameras(1), folder.parent, **settings)
    assert images(folder) == images(whole)


def test_refining_a_reference_continues_where_it_was(tmp_path: Path) -> None:
    def render_with(reference_spp: int, out: Path) -> Path:
        return render_sequence(demo_scene(), demo_cameras(1), out, reference_spp=reference_spp, **TINY)

    folder, at_once = render_with(32, tmp_path / "refined"), render_with(96, tmp_path / "at_once")
    color = (folder / "color0.exr").stat().st_mtime_ns
    render_with(96, folder.parent)
    assert (folder / "color0.exr").stat().st_mtime_ns == color
    # Half floats, twice.
    np.testing.assert_allclose(read(folder, "reference0"), read(at_once, "reference0"), rtol=2**-10)
    assert describe(folder)["reference_spp"] == {"0": 96}
    noise = [describe(place)["reference_noise"]["0"] for place in (folder, at_once)]
    np.testing.assert_allclose(*noise, rtol=0.3)
    before = images(folder)
    render_with(16, folder.parent)
    assert images(folder) == before
    assert describe(folder)["reference_spp"] == {"0": 96}


def test_references_end_at_a_noise_level(tmp_path: Path) -> None:
    calls: list[tuple[int, int]] = []

    def render_to(noise_level: float, **settings: Any) -> tuple[Path, int, float]:
        calls.clear()
        folder = render_sequence(
            demo_scene(),
            demo_cameras(1),
            tmp_path,
            noise_level=noise_level,
            progress=lambda *call: calls.append(call),
            **{**TINY, "reference_spp": 1024, **settings},
        )
        said = describe(folder)
        return folder, said["reference_spp"]["0"], said["reference_noise"]["0"]

    folder, spp, noise = render_to(0.1)
    assert 32 <= spp < 256
    assert noise <= 0.1
    assert calls[-1] == (1025, 1025)
    before = images(folder)
    assert render_to(0.11) == (folder, spp, noise)
    assert images(folder) == before
    _, more, less = render_to(0.06)
    assert spp < more < 1024
    assert less <= 0.06
    # The level is out of reach: all the paths there are.
    assert render_to(0.001, reference_spp=more + 24)[1] == more + 24


def test_a_noise_told_from_few_paths_ends_no_reference(tmp_path: Path) -> None:
    settings = {**TINY, "noise_level": 0.9}
    few = render_sequence(demo_scene(), demo_cameras(1), tmp_path, **{**settings, "reference_spp": 4})
    assert describe(few)["reference_spp"] == {"0": 4}
    render_sequence(demo_scene(), demo_cameras(1), tmp_path, **settings)
    assert 32 <= describe(few)["reference_spp"]["0"] < 64


FLIGHT = 3


def _moving_scene() -> dict[str, Any]:
    """A ball and a box fly above a floor; a lamp moves too, and something stands still."""
    colors = np.random.default_rng(1).uniform(0.2, 0.9, (8, 8, 3))

    def paint(nested: Any) -> dict[str, Any]:
        return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": nested}}

    spots = {"type": "bitmap", "bitmap": colors, "raw": True, "filter_type": "nearest"}
    grey = {"type": "rgb", "value": 0.5}
    lying = place((0, 0, 0), scale=(9, 9, 9), rotation=rotate("x", -90))
    box, post = place((1.3, 0.6, 0.2), scale=(0.5, 0.5, 0.5)), place((2.6, 1, -1), scale=(0.2, 1, 0.2))
    return {
        "type": "scene",
        "floor": {"type": "rectangle", "to_world": lying, "bsdf": paint(grey)},
        "ball": {"type": "sphere", "center": [-1.2, 0.8, 0.0], "radius": 0.8, "bsdf": paint(spots)},
        "box": {"type": "cube", "to_world": box, "bsdf": paint(spots)},
        "post": {"type": "cube", "to_world": post, "bsdf": paint(spots)},
        "lamp": {"type": "point", "position": [0.0, 5.0, 3.0], "intensity": {"type": "rgb", "value": 60.0}},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.3}},
    }


def _moves() -> dict[str, np.ndarray[Any, Any]]:
    moves = {name: np.tile(np.eye(4), (FLIGHT, 1, 1)) for name in ("ball", "box", "lamp")}
    for frame in range(FLIGHT):
        moves["ball"][frame, :3, 3] = 0.25 * frame, 0.1 * frame, 0.3 * frame
        moves["box"][frame] = place((-0.2 * frame, 0, 0), turn=6 * frame)
        moves["lamp"][frame, :3, 3] = frame, 0, 0
    return moves


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("mitsuba")
    return _render_moving(tmp_path_factory.mktemp("moving"))


def _render_moving(out: Path, **settings: Any) -> Path:
    cameras = [Camera.look_at((0.1 * n, 2, 6), (0.05 * n, 0.8, 0), fov_x=50) for n in range(FLIGHT)]
    usual: dict[str, Any] = {"moves": _moves(), "size": (36, 24), "variant": "scalar_rgb", "reference_spp": 4}
    return render_sequence(_moving_scene(), cameras, out, **{**usual, **settings})


def test_static_points_have_no_motion(moving: Path) -> None:
    for frame in range(FLIGHT):
        now, before = read(moving, f"world_position{frame}"), read(moving, f"previous_position{frame}")
        still = (now == before).all(axis=-1)
        if frame == 0:
            assert still.all()
        else:
            assert 0.1 < 1 - still.mean() < 0.4
    assert describe(moving)["moves"]["box"] == _moves()["box"].tolist()


def test_moving_points_stay_on_their_surface(moving: Path) -> None:
    moves = _moves()["ball"]
    for frame in range(1, FLIGHT):
        now, before = (
            read(moving, f"{name}{frame}").astype(np.float64) for name in ("world_position", "previous_position")
        )
        center = np.array([-1.2, 0.8, 0.0])
        on_ball = np.abs(np.linalg.norm(now - center - moves[frame, :3, 3], axis=-1) - 0.8) < 1e-3
        assert on_ball.sum() > 20
        radius = np.linalg.norm(before - center - moves[frame - 1, :3, 3], axis=-1)
        np.testing.assert_allclose(radius[on_ball], 0.8, atol=1e-4)


def test_several_workers_write_the_same_files(moving: Path, tmp_path: Path) -> None:
    calls: list[tuple[int, int]] = []
    folder = _render_moving(tmp_path, workers=2, progress=lambda *call: calls.append(call))
    assert images(folder) == images(moving)
    assert describe(folder) == describe(moving)
    assert calls[-1] == (15, 15)
    assert calls == sorted(calls)


def test_the_path_of_an_object_cannot_change(moving: Path, tmp_path: Path) -> None:
    folder = tmp_path / "inputs"
    shutil.copytree(moving, folder)
    moves = _moves()
    moves["ball"][1, 0, 3] += 1
    assert re.search(r"object 'ball' .*frame 1", refused(_render_moving, tmp_path, moves=moves))
    assert "ball, box, lamp" in refused(_render_moving, tmp_path, moves={})


def test_objects_move_like_a_scene_that_is_built_there(tmp_path: Path) -> None:
    """Analytic shapes, meshes, lights and the shadows of all."""
    moves = {name: path[2:] for name, path in _moves().items()}
    camera = Camera.look_at((0.2, 2, 6), (0.1, 0.8, 0), fov_x=50)
    settings: dict[str, Any] = {"size": (18, 12), "variant": "scalar_rgb", "reference_frames": [], "spp": 4}
    moved = render_sequence(_moving_scene(), [camera], tmp_path / "moved", moves=moves, **settings)
    scene = _moving_scene()
    scene["ball"]["center"] = (np.array(scene["ball"]["center"]) + moves["ball"][0, :3, 3]).tolist()
    scene["box"]["to_world"] = moves["box"][0] @ scene["box"]["to_world"]
    scene["lamp"]["position"] = (np.array(scene["lamp"]["position"]) + moves["lamp"][0, :3, 3]).tolist()
    built = render_sequence(scene, [camera], tmp_path / "built", **settings)
    for name, tolerance in (("albedo0", 1e-3), ("shading_normal0", 1e-3), ("world_position0", 1e-3), ("color0", 1e-2)):
        different = np.abs(read(moved, name) - read(built, name)).max(axis=-1) > tolerance
        assert different.mean() < 0.02, name


def test_tasks_that_cannot_be_sent_to_workers_are_refused(tmp_path: Path) -> None:
    scene = {**demo_scene(), "x": lambda: 0}
    assert "more than one worker" in refused(render_sequence, scene, demo_cameras(1), tmp_path, workers=2, **TINY)


XML = """<scene version="3.0.0">
<bsdf type="diffuse" id="grey"/>
<shape type="cube" id="still"><transform name="to_world"><translate x="-2"/></transform><ref id="grey"/></shape>
<shape type="cube" id="moving"><ref id="grey"/></shape>
<shape type="rectangle" id="lamp"><transform name="to_world"><translate z="9"/></transform>
<emitter type="area"><rgb name="radiance" value="5"/></emitter></shape>
</scene>"""


def test_the_command_line_moves_objects_of_a_scene_file(tmp_path: Path) -> None:
    scene, path, out = (tmp_path / name for name in ("scene.xml", "shot.json", "out"))
    scene.write_text(XML)
    camera = Camera.look_at((0, 1, 8), (-1, 0, 0), fov_x=60).to_world.tolist()
    moved = np.eye(4)
    moved[0, 3] = 0.5
    objects = {"moving": [np.eye(4).tolist(), moved.tolist()], "lamp": [np.eye(4).tolist(), moved.tolist()]}
    content: dict[str, Any] = {"fov": 60, "to_world": [camera] * 2, "objects": objects}
    path.write_text(json.dumps(content))
    command = ["render", str(scene), "--camera-path", str(path), "-o", str(out), "--size", "16x12"]
    command += ["--variant", "scalar_rgb", "--reference-spp", "32", "--noise-seeds", "2", "--noise-level", "0.5"]
    assert succeeds(*command).strip() == str(out / "inputs")
    sequence = open_sequence(out)
    assert (len(sequence), sequence.noise_seeds) == (2, 2)
    frame = sequence.frame(1)
    step = frame.position - frame.previous_position
    step = step[:, :, (step != 0).any(1)[0]]
    assert step.shape[2] > 5
    torch.testing.assert_close(step.mean(2), torch.tensor([[0.5, 0, 0]]))
    succeeds(*command[:5], tmp_path / "every", *command[6:], "--every", 2)
    assert len(open_sequence(tmp_path / "every")) == 1
    path.write_text(json.dumps({**content, "objects": {"teapot": objects["moving"]}}))
    message = refuses(*command[:5], tmp_path / "new", *command[6:])
    assert "object 'teapot': expected the id of a shape or a light that can move (lamp, moving, still)" in message


def test_kept_samples_have_the_color_for_their_mean(tmp_path: Path) -> None:
    cameras = demo_cameras(2)
    folder = render_sequence(
        demo_scene(), cameras, tmp_path, spp=3, noise_seeds=2, reference_frames=[], keep_samples=True, **SCALAR
    )
    sequence = open_sequence(tmp_path)
    assert not sequence.warnings
    assert not sequence.unused
    assert "samples" in sequence.buffers & sequence.noisy
    first, second = (sequence.frame(1, noise_seed=k) for k in range(2))
    for frame in (first, second):
        assert frame.samples.shape == (1, 3, 3, HEIGHT, WIDTH)
        # Each image is rounded to half floats.
        torch.testing.assert_close(frame.samples.mean(1), frame.color, rtol=2 * 2.0**-11, atol=2.0**-24)
    assert not torch.equal(first.samples, second.samples)
    # Samples of their own: no two are alike.
    assert not torch.equal(first.samples[:, 0], first.samples[:, 1])
    before = images(folder)
    again = {"spp": 3, "noise_seeds": 2, "reference_frames": [], **SCALAR}
    render_sequence(demo_scene(), cameras, tmp_path, keep_samples=True, **again)
    assert images(folder) == before
    assert re.search(r"samples_kept True, .*None", refused(render_sequence, demo_scene(), cameras, tmp_path, **again))
