"""Rendering as Mitsuba's own renderer samples: filter, lens, and features with noise."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from planes import seen_at
from refusals import refused

from mcdenoise.data.exr import read_exr
from mcdenoise.scenes.demo import demo_cameras, demo_scene
from mcdenoise.scenes.render import FILTERS, Camera, Film, render_sequence
from mcdenoise.scenes.render import frames as render_frames

WIDTH, HEIGHT = 24, 16
SCALAR: dict[str, Any] = {"size": (WIDTH, HEIGHT), "variant": "scalar_rgb"}
FEATURES = ("albedo", "shading_normal", "world_position", "depth")
# Half floats of 11 bits.
ROUNDING = 2**-11


@pytest.fixture(autouse=True)
def _mitsuba() -> None:
    pytest.importorskip("mitsuba", reason="rendering needs Mitsuba: pip install 'mcdenoise[render]'")


def read(folder: Path, name: str) -> np.ndarray[Any, Any]:
    return read_exr(folder / f"{name}.exr")[0].astype(np.float64)


def wall() -> dict[str, Any]:
    """A checked wall at z = 0 in an even white light."""
    squares = np.indices((8, 8)).sum(axis=0) % 2 * 0.6 + 0.2
    texture = {
        "type": "bitmap",
        "bitmap": np.repeat(squares[..., None], 3, axis=2),
        "raw": True,
        "filter_type": "nearest",
    }
    return {
        "type": "scene",
        "wall": {"type": "rectangle", "to_world": np.eye(4), "bsdf": {"type": "diffuse", "reflectance": texture}},
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 1.0, 1.0]}},
    }


AT_WALL = [Camera.look_at((0.1, 0.2, 3), (0, 0, 0), fov_x=30)]


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two frames with two noise seeds on a film with a Gaussian filter and a lens."""
    pytest.importorskip("mitsuba")
    out = tmp_path_factory.mktemp("film")
    film = Film("gaussian", aperture=0.05, focus=3)
    return render_sequence(demo_scene(), demo_cameras(2), out, noise_seeds=2, reference_spp=2, film=film, **SCALAR)


@pytest.mark.parametrize(
    "name", [pytest.param(each, marks=[] if each == "gaussian" else [pytest.mark.slow]) for each in FILTERS]
)
def test_the_mean_of_noisy_colors_and_features_is_that_of_many_samples(tmp_path: Path, name: str) -> None:
    """Albedo and color of a wall in even light are one and the same image, filtered by the same filter.

    Each noisy color is a mean of 4 samples; 12 of them give the standard error. Filters wider than a pixel divide by
    the weight of the samples that were drawn: a quotient of random numbers, whose bias at 4 samples is below 0.02 here.
    """
    runs = 12
    folder = render_sequence(
        wall(), AT_WALL, tmp_path, spp=4, noise_seeds=runs, reference_spp=256, film=Film(name), max_depth=2, **SCALAR
    )
    places = [folder, *(folder / f"noise_seed{k}" for k in range(1, runs))]
    colors = np.array([read(place, "color0") for place in places])
    albedos = np.array([read(place, "albedo0") for place in places])
    reference = read(folder, "reference0")
    error = colors.std(axis=0, ddof=1) / np.sqrt(runs) + reference * ROUNDING + 1e-3
    away = (colors.mean(axis=0) - reference) / error
    if name == "box":
        # None of the independent errors of 384 pixels is beyond six deviations.
        assert np.abs(away).max() < 6
        assert abs(away.mean()) < 4 / np.sqrt(away[..., 0].size)
    else:
        assert np.abs(colors.mean(axis=0) - reference).max() < 0.02 + 6 * error.max()
    inside = reference < 0.99
    np.testing.assert_allclose(albedos.mean(axis=0)[inside], colors.mean(axis=0)[inside], atol=2 * error.max())


def test_every_noise_seed_has_features_of_its_own_samples(sequence: Path) -> None:
    for name in (*FEATURES, "color"):
        first, second = read(sequence, f"{name}1"), read(sequence / "noise_seed1", f"{name}1")
        assert (first != second).any(axis=-1).mean() > 0.5, name
        assert np.isfinite(first).all()
    assert not (sequence / "noise_seed1" / "reference0.exr").exists()
    assert read(sequence, "albedo0").min() >= 0
    assert read(sequence, "albedo0").max() <= 1
    assert np.linalg.norm(read(sequence, "shading_normal0"), axis=-1).max() < 1.001


def test_positions_are_seen_within_the_filter_of_their_pixels(tmp_path: Path) -> None:
    """Box and wall: the sample of a pixel lies in that pixel, and its depth is the distance along the axis."""
    folder = render_sequence(wall(), AT_WALL, tmp_path, reference_spp=1, film=Film("box"), **SCALAR)
    (matrix,) = json.loads((folder / "camera.json").read_text())["camera_matrices"]
    column, row, clip = seen_at(read(folder, "world_position0"), matrix)
    for offset in (column - np.arange(WIDTH), row - np.arange(HEIGHT)[:, None]):
        assert offset.min() > -1e-3
        assert offset.max() < 1 + 1e-3
        assert 0.2 < offset.std() < 0.4  # that of even numbers is 0.29
    np.testing.assert_allclose(read(folder, "depth0")[..., 0], clip[..., 3], rtol=ROUNDING)


def test_the_same_seed_gives_the_same_pixels_and_a_stopped_run_is_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def render(name: str, **settings: Any) -> Path:
        changed = {"seed": 5, "film": Film("box"), "noise_seeds": 2, "reference_spp": 2} | settings
        changed["reference_frames"] = [0]
        return render_sequence(demo_scene(), demo_cameras(2), tmp_path / name, **changed, **SCALAR)

    whole, other = render("a"), render("c", seed=6)
    render("b", frames=1)
    (tmp_path / "b" / "inputs" / "noise_seed1" / "albedo0.exr").unlink()
    again = render("b")
    for path in whole.rglob("*.exr"):
        same = path.relative_to(whole)
        np.testing.assert_array_equal(read_exr(path)[0], read_exr(again / same)[0])
        assert not np.array_equal(read_exr(path)[0], read_exr(other / same)[0])

    def fail(*_: Any) -> None:
        raise AssertionError("nothing is missing")

    for name in ("write_buffers", "write_reference"):
        monkeypatch.setattr(render_frames, name, fail)
    render("a")
    assert re.search(r"film .*'box'.*, .*None", refused(render, "a", film=None))
