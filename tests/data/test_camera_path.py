"""Camera paths: the layouts that are read, and the one line for those that are not."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

from mcdenoise.data.camera_path import Camera, load_camera_path

EYE = np.eye(4)
SCALED = [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]


def written(path: Path, **content: object) -> Path:
    path.write_text(json.dumps(content, default=np.ndarray.tolist))
    return path


def moving(objects: object) -> str:
    return json.dumps({"fov": 60, "to_world": [EYE, EYE], "objects": objects}, default=np.ndarray.tolist)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "in JSON, found"),
        ("[]", "expected a list 'to_world'"),
        ('{"fov": 70, "to_world": []}', "at least one camera"),
        ('{"to_world": [[]]}', "unusable: nothing under 'fov'"),
        ('{"fov": 270, "to_world": [[]]}', "between 0 and 180"),
        ('{"fov": 70, "to_world": [[[1, 0], [0, 1]]]}', "frame 0 is unusable: expected a finite 4x4"),
        (json.dumps({"fov": 70, "to_world": [SCALED]}), "without scaling"),
        ('{"fov": 70, "frames": [{"position": [0, 0, 0]}]}', "frame 0 is unusable: nothing under 'look_at'"),
        ('{"fov": 70, "frames": [{"position": [0, 0, 0], "look_at": [0, 0, 0]}]}', "frame 0 is unusable"),
        ('{"fov": 70, "frames": [5]}', "frame 0 is unusable"),
        (moving([]), "'objects' .* found list"),
        (moving({"ball": [EYE]}), r"'ball': expected 2 matrices .* found shape \(1, 4, 4\)"),
        (moving({"ball": [[1, 2], [3]]}), "'ball': expected matrices"),
        (moving({"ball": [np.eye(3)] * 2}), "'ball': expected 2 matrices of 4x4 or 3x4"),
        (moving({"ball": [EYE, 0 * EYE]}), "found something else in frame 1"),
    ],
    ids=lambda text: text[:20],
)
def test_bad_camera_paths(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "camera_path.json"
    path.write_text(content)
    told = refused(load_camera_path, path)
    assert told.startswith(str(path))
    assert re.search(message, told)


def test_both_layouts(tmp_path: Path) -> None:
    assert "No such file" in refused(load_camera_path, tmp_path / "nothing.json")
    camera = Camera.look_at((1, 2, 3), (0, 1, 0), fov_x=65)
    matrices = written(tmp_path / "matrices.json", fov=65, to_world=[camera.to_world])
    frames = [{"position": [1, 2, 3], "look_at": [0, 1, 0], "up": [0, 1, 0]}]
    for path in (matrices, written(tmp_path / "looks.json", fov=65, frames=frames)):
        (found,) = load_camera_path(path).cameras
        assert found.fov_x == 65
        np.testing.assert_allclose(found.to_world, camera.to_world)
    high = written(tmp_path / "high.json", fov=90, fov_axis="y", aspect="2:1", to_world=[EYE])
    np.testing.assert_allclose(load_camera_path(high).cameras[0].fov_x, 126.8698976)
    assert load_camera_path(high).moves == {}


def test_paths_of_objects(tmp_path: Path) -> None:
    moved = EYE.copy()
    moved[:3, 3] = 1, 2, 3
    path = tmp_path / "shot.json"
    path.write_text(moving({"ball": [EYE[:3], moved[:3]]}))
    (found,) = load_camera_path(path).moves.values()
    np.testing.assert_array_equal(found, [EYE, moved])


TUNGSTEN = """{"bsdfs": [{"name": "odd, ]"},], "camera": {"resolution": [1280, 720], "transform":
{"position": [%d, 2, 3,], "look_at": [0, 1, 0], "up": [0, 1, 0]}, "type": "pinhole", "fov": 65.0,},}"""


def test_tungsten_scenes(tmp_path: Path) -> None:
    """The scenes are written as published: a file per frame, with commas that JSON does not allow."""
    expected = [Camera.look_at((x, 2, 3), (0, 1, 0), fov_x=65).to_world for x in (1, 2, 10)]
    scenes = tmp_path / "scenes"
    scenes.mkdir()
    for name, x in (("0", 1), ("2", 2), ("10", 10)):
        (scenes / f"spp_4096_scene_{name}.json").write_text(TUNGSTEN % x)
    together = tmp_path / "together.json"
    together.write_text("[" + ",".join(TUNGSTEN % x for x in (1, 2, 10)) + ",]")
    for path in (scenes, together):
        cameras = load_camera_path(path).cameras
        assert [camera.fov_x for camera in cameras] == [65, 65, 65]
        np.testing.assert_allclose([camera.to_world for camera in cameras], expected)
    (one,) = load_camera_path(scenes / "spp_4096_scene_2.json").cameras
    np.testing.assert_allclose(one.to_world, expected[1])
