"""Rendering with the real Mitsuba: what the files promise about pixel centres, noise and references."""

from __future__ import annotations

import importlib
import itertools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mcdenoise.buffers import Frame
from mcdenoise.data.exr import read_exr
from mcdenoise.data.sequences import open_sequence
from mcdenoise.demo_scene import demo_cameras, demo_scene
from mcdenoise.errors import InputError
from mcdenoise.render import Camera, load_camera_path, render_sequence, view_projection

WIDTH, HEIGHT = 32, 18
SCALAR: dict[str, Any] = {"size": (WIDTH, HEIGHT), "variant": "scalar_rgb"}


@pytest.fixture(autouse=True)
def _mitsuba(request: pytest.FixtureRequest) -> None:
    if "without_mitsuba" not in request.fixturenames:
        pytest.importorskip("mitsuba", reason="rendering needs Mitsuba: pip install 'mcdenoise[render]'")


@pytest.fixture
def without_mitsuba(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether Mitsuba is installed or not."""
    original = importlib.import_module

    def refuse(name: str, package: str | None = None) -> Any:
        if name == "mitsuba":
            raise ImportError(name)
        return original(name, package)

    monkeypatch.setattr(importlib, "import_module", refuse)


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
        matrix = np.array(describe(sequence)["camera_matrices"][number])
        position = read(sequence, f"world_position{number}").astype(np.float64)
        clip = np.concatenate((position, np.ones((HEIGHT, WIDTH, 1))), axis=-1) @ matrix
        column = (clip[..., 0] / clip[..., 3] + 1) / 2 * WIDTH
        row = (clip[..., 1] / clip[..., 3] + 1) / 2 * HEIGHT
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


def test_the_reader_understands_the_folder(sequence: Path) -> None:
    found = open_sequence(sequence.parent)
    assert describe(sequence)["color_includes_albedo"] is True
    frame = found.frame(1)
    assert isinstance(frame, Frame)
    frame.validate()
    assert frame.reference is not None
    assert torch.equal(frame.color[0].permute(1, 2, 0), torch.from_numpy(read(sequence, "color1")))


def test_the_same_seed_gives_the_same_files_and_another_seed_does_not(tmp_path: Path) -> None:
    folders = [
        render_sequence(demo_scene(), demo_cameras(2), tmp_path / name, seed=seed, reference_spp=2, **SCALAR)
        for name, seed in (("a", 5), ("b", 5), ("c", 6))
    ]
    first, again, other = (images(folder) for folder in folders)
    assert first == again
    assert describe(folders[0]) == describe(folders[1])
    assert {name for name in first if first[name] != other[name]} == {
        f"{kind}{number}.exr" for kind in ("color", "reference") for number in range(2)
    }


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
    with pytest.raises(InputError, match=r"rendered with seed 0, now 1"):
        render(None, seed=1)


def test_another_scene_of_the_same_name_is_refused(tmp_path: Path) -> None:
    scene = demo_scene()
    settings = {**SCALAR, "reference_frames": []}
    render_sequence(scene, demo_cameras(1), tmp_path, **settings)
    scene["window"] = {**scene["window"], "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [1, 2, 3]}}}
    with pytest.raises(InputError, match="rendered with scene_sha256"):
        render_sequence(scene, demo_cameras(1), tmp_path, **settings)


def _furnace(albedo: float = 0.5) -> dict[str, Any]:
    """A sphere inside a glowing one: the radiance of every pixel is known."""
    grey = {"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo}}
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
    # What the reader makes of the far point that stands for the background.
    depth = open_sequence(tmp_path).frame(0).depth
    assert depth is not None
    assert torch.equal(torch.isinf(depth[0, 0]), torch.from_numpy(~hit))


def test_noisy_frames_are_independent_and_their_mean_is_the_reference(tmp_path: Path) -> None:
    frames, blocks = 96, (3, 4)
    camera = demo_cameras(1)[0]
    folder = render_sequence(
        demo_scene(),
        [camera] * frames,
        tmp_path,
        size=(16, 9),
        variant="scalar_rgb",
        reference_spp=768,
        reference_frames=[0],
    )

    def block_means(image: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        rows, columns = blocks
        return np.asarray(image.reshape(rows, 9 // rows, columns, 16 // columns, 3).mean(axis=(1, 3)))

    noisy = np.stack([block_means(read(folder, f"color{number}").astype(np.float64)) for number in range(frames)])
    reference = block_means(read(folder, "reference0").astype(np.float64))
    error = noisy.std(axis=0, ddof=1) * np.sqrt(1 / frames + 1 / 768)
    z = (noisy.mean(axis=0) - reference) / error
    assert np.abs(z).max() < 5
    assert np.abs(z.mean()) < 1
    residual = np.log1p(noisy) - np.log1p(noisy).mean(axis=0)
    assert abs((residual[1:] * residual[:-1]).sum() / (residual**2).sum()) < 0.12


def test_variants_agree(tmp_path: Path) -> None:
    from mcdenoise.render import _llvm_works

    if not _llvm_works():
        pytest.skip("no usable LLVM library: Mitsuba's llvm_ad_rgb does not run here")
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


def test_view_projection_of_a_point_to_the_right_and_above() -> None:
    camera = Camera.look_at((0, 0, 5), (0, 0, 0), fov_x=90)
    clip = np.array((1.0, 0.5, 3.0, 1.0)) @ view_projection(camera, 200, 100, near=1, far=9)
    u, v = (clip[:2] / clip[3] + 1) / 2
    np.testing.assert_allclose((u, v, clip[3]), (0.75, 0.25, 2.0))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "expected JSON"),
        ("[]", "expected a list 'to_world'"),
        ('{"fov": 70, "to_world": []}', "at least one camera"),
        ('{"to_world": [[]]}', "'fov' is unusable"),
        ('{"fov": 270, "to_world": [[]]}', "between 0 and 180"),
        ('{"fov": 70, "to_world": [[[1, 0], [0, 1]]]}', "frame 0 is unusable: expected a finite 4x4"),
        ('{"fov": 70, "to_world": [[[2,0,0,0],[0,2,0,0],[0,0,2,0],[0,0,0,1]]]}', "without scaling"),
        ('{"fov": 70, "frames": [{"position": [0, 0, 0]}]}', "frame 0 is unusable: nothing under 'look_at'"),
        ('{"fov": 70, "frames": [{"position": [0, 0, 0], "look_at": [0, 0, 0]}]}', "frame 0 is unusable"),
        ('{"fov": 70, "frames": [5]}', "frame 0 is unusable"),
    ],
)
def test_bad_camera_paths(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "camera_path.json"
    path.write_text(content)
    with pytest.raises(InputError, match=message) as caught:
        load_camera_path(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_camera_paths_of_both_layouts(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No such file"):
        load_camera_path(tmp_path / "nothing.json")
    camera = Camera.look_at((1, 2, 3), (0, 1, 0), fov_x=65)
    matrices, looks = tmp_path / "matrices.json", tmp_path / "looks.json"
    matrices.write_text(json.dumps({"fov": 65, "to_world": [camera.to_world.tolist()]}))
    looks.write_text(
        json.dumps({"fov": 65, "frames": [{"position": [1, 2, 3], "look_at": [0, 1, 0], "up": [0, 1, 0]}]})
    )
    for path in (matrices, looks):
        (found,) = load_camera_path(path)
        assert found.fov_x == 65
        np.testing.assert_allclose(found.to_world, camera.to_world)
    matrices.write_text(json.dumps({"fov": 90, "fov_axis": "y", "aspect": "2:1", "to_world": [np.eye(4).tolist()]}))
    np.testing.assert_allclose(load_camera_path(matrices)[0].fov_x, 126.8698976)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
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
    with pytest.raises(InputError, match=message):
        render_sequence(demo_scene(), demo_cameras(1), tmp_path, **{**SCALAR, **settings})
    assert not list(tmp_path.iterdir())


def test_bad_scenes_and_folders(tmp_path: Path) -> None:
    def fails(scene: Any, message: str, out: Path = tmp_path / "out") -> None:
        with pytest.raises(InputError, match=message) as caught:
            render_sequence(scene, demo_cameras(1), out, **SCALAR)
        assert "\n" not in str(caught.value)

    broken = tmp_path / "broken.xml"
    broken.write_text("<scene version='3.0.0'><shape type='nonsense'/></scene>")
    file = tmp_path / "file"
    file.write_text("")
    fails(tmp_path / "no.xml", "no such file")
    fails(broken, r"broken\.xml: Mitsuba cannot load it")
    fails({"type": "scene", "a": {"type": "nonsense"}}, "scene dictionary: Mitsuba cannot load it")
    fails({"type": "sphere"}, "expected a Mitsuba scene")
    fails(_furnace(), "cannot be created", out=file)


@pytest.mark.usefixtures("without_mitsuba")
def test_without_mitsuba_the_error_says_what_to_install(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"pip install 'mcdenoise\[render\]'"):
        render_sequence(demo_scene(), demo_cameras(1), tmp_path)


def test_passes_of_one_frame_do_not_reuse_the_noise_of_another(tmp_path: Path) -> None:
    camera = demo_cameras(1)[0]
    folder = render_sequence(demo_scene(), [camera] * 4, tmp_path, spp=16, reference_frames=[], **SCALAR)
    colors = [np.log1p(read(folder, f"color{number}").astype(np.float64)) for number in range(4)]
    neighbours = np.mean([np.abs(a - b).mean() for a, b in itertools.pairwise(colors)])
    # Frames that share one of two passes would differ by a factor of 0.7 less.
    np.testing.assert_allclose(neighbours, np.abs(colors[0] - colors[3]).mean(), rtol=0.15)
