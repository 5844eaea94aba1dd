"""Places of takes: the same again for the same seed, fit to be rendered, and seen from free space."""

import functools
import hashlib
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mcdenoise.data.camera_path import Camera, check_moves
from mcdenoise.scenes.assets import Assets
from mcdenoise.scenes.random.builder import SceneBuilder, bounds
from mcdenoise.scenes.random.cameras import shoot
from mcdenoise.scenes.render.features import SequenceTracer
from mcdenoise.scenes.render.loading import scene_digest
from mcdenoise.scenes.takes.draw import Take, draw_take

SEEDS = range(24)
FRAMES = 12
# Cameras keep further away from the box around anything.
CLOSE = 0.05


def drawn(seed: int, frames: int = FRAMES) -> Take:
    return draw_take(seed, Assets(), frames=frames, stills=False)


@functools.cache
def survey() -> list[Take]:
    """Return the take of each seed, with the smallest and the largest number of each image in place of the image."""
    return [replace(made, scene=without_images(made.scene)) for made in map(drawn, SEEDS)]


def without_images(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: without_images(item) for key, item in value.items()}
    if isinstance(value, np.ndarray) and value.ndim == 3:
        return np.array([value.min(), value.max()])
    return value


def digest(seed: int, frames: int = FRAMES) -> str:
    made = drawn(seed, frames)
    numbers = np.array([[*camera.to_world.ravel(), camera.fov_x] for camera in made.cameras])
    parts = (scene_digest(made.scene), scene_digest({"cameras": numbers}), scene_digest(made.moves))
    return hashlib.sha256("".join(parts).encode()).hexdigest()


def poses(shot: list[Camera]) -> list[list[Any]]:
    return [[camera.to_world.tolist(), camera.fov_x] for camera in shot]


def entries(value: Any) -> Iterator[dict[str, Any]]:
    if isinstance(value, dict):
        yield value
        for item in value.values():
            yield from entries(item)


def test_the_same_seed_is_the_same_scene_in_any_process_without_mitsuba() -> None:
    seeds = [0, 1, 2]
    here = [digest(seed) for seed in seeds]
    assert len(set(here)) == len(seeds)
    code = f"import sys\nfrom test_places import digest\nprint(*(digest(seed) for seed in {seeds}))"
    code += "\nprint(*{'mitsuba', 'drjit'} & set(sys.modules))"
    command = [sys.executable, "-c", code]
    child = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=False, timeout=120)
    assert child.stdout == " ".join(here) + "\n\n", child.stderr


def test_a_longer_shot_begins_like_a_shorter_one() -> None:
    assert drawn(0).moves
    for seed in (0, 1):
        short, long = drawn(seed, 5), drawn(seed, 40)
        assert (len(short.cameras), len(long.cameras)) == (5, 40)
        assert scene_digest(short.scene) == scene_digest(long.scene)
        assert poses(short.cameras) == poses(long.cameras[:5])
        # Back and forth on a path of 17 frames.
        assert poses(long.cameras[:16]) == poses(long.cameras[32:16:-1])
        assert short.moves.keys() == long.moves.keys()
        for name, moved in short.moves.items():
            np.testing.assert_array_equal(moved, long.moves[name][:5])


def test_moves_are_rigid_and_of_objects_in_the_scene() -> None:
    turned = False
    for made in survey():
        assert set(made.moves) <= set(made.scene)
        check_moves(made.moves, FRAMES)
        for moved in made.moves.values():
            assert moved.shape == (FRAMES, 4, 4)
            np.testing.assert_allclose(moved[0], np.eye(4), atol=1e-12)
            np.testing.assert_array_equal(moved[:, 3], np.tile((0, 0, 0, 1), (FRAMES, 1)))
            rotation = moved[:, :3, :3]
            np.testing.assert_allclose(
                rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (FRAMES, 1, 1)), atol=1e-12
            )
            np.testing.assert_allclose(np.linalg.det(rotation), 1)
            turned |= not np.allclose(rotation, np.eye(3))
            assert (moved[1:] != moved[:-1]).any(axis=(1, 2)).all()
    assert turned


def test_textures_are_reflectances_opacities_or_roughnesses() -> None:
    count = 0
    for made in survey():
        for entry in entries(made.scene):
            if entry.get("type") == "bitmap":
                smallest, largest = entry["bitmap"]
                assert 0 <= smallest <= largest <= 1
                count += 1
    assert count > 10 * len(SEEDS)


def test_every_light_shines() -> None:
    for made in survey():
        lights = [entry for entry in entries(made.scene) if "sampling_weight" in entry]
        assert lights
        for entry in lights:
            values = entry.get("bitmap", entry.get("radiance", entry.get("intensity")))
            values = np.array(values["value"] if isinstance(values, dict) else values)
            assert np.isfinite(values).all()
            # A sky may have black pixels.
            assert values.min() >= 0 if entry["type"] == "envmap" else values.min() > 0
            assert values.max() > 0


def test_cameras_are_outside_the_boxes_of_all_shapes() -> None:
    for seed, made in zip(SEEDS, survey(), strict=True):
        shapes = {name: shape for name, shape in made.scene.items() if "to_world" in shape and "bsdf" in shape}
        boxes = np.array([bounds(shape["type"], shape["to_world"]) for shape in shapes.values()])
        for camera in made.cameras:
            eye = camera.to_world[:3, 3]
            assert not ((eye > boxes[:, 0] - CLOSE) & (eye < boxes[:, 1] + CLOSE)).all(axis=-1).any(), seed


def test_scenes_can_be_traced_from_free_space_and_are_not_black() -> None:
    pytest.importorskip("mitsuba", reason="rendering needs Mitsuba: pip install 'mcdenoise[render]'")
    for seed in range(3):
        made = drawn(seed)
        tracer = SequenceTracer(made.scene, "scalar_rgb", made.moves, made.cameras, (8, 8), None, 8)
        found = tracer.features(FRAMES - 1)
        distance = np.linalg.norm(found["position"] - made.cameras[-1].to_world[:3, 3], axis=1)
        assert (distance < CLOSE).mean() < 0.1, seed
        assert found["normal"].any(1).mean() > 0.1, seed
        radiance = tracer.radiance(FRAMES - 1, 4, (seed, 0))
        assert np.isfinite(radiance).all(), seed
        assert radiance.mean() > 0, seed


def test_a_place_without_things_has_a_camera_path() -> None:
    cameras = shoot(SceneBuilder((-5, 0, -5), (5, 3, 5)), np.random.default_rng(0), 3)

    assert len(cameras) == 3
    assert np.isfinite([camera.to_world for camera in cameras]).all()
