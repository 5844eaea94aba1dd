"""The way random scenes are photographed, and the materials and lights in them."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import numpy as np
import pytest

from mcdenoise.scenes.random import random_scene
from mcdenoise.scenes.random.takes import Take, random_takes
from mcdenoise.scenes.render.tracer import scene_digest

SEEDS = range(30)


def wild(seed: int, **changes: Any) -> list[Take]:
    settings: dict[str, Any] = {"sampling": "mixed", "spp": None, "stills": 0.5, "shiny": True, **changes}
    return random_takes(seed, 4, **settings)


@pytest.fixture(scope="module")
def survey() -> list[Take]:
    return [take for seed in SEEDS for take in wild(seed)]


def described(take: Take) -> list[Any]:
    poses = [[camera.to_world.tolist(), camera.fov_x] for camera in take.made.cameras]
    return [take.name, scene_digest(take.made.scene), poses, take.film, take.spp, sorted(take.made.moves)]


def kinds(scene: dict[str, Any]) -> Counter[str]:
    """Return how many shapes have which kind of material."""
    found: Counter[str] = Counter()
    for name, entry in scene.items():
        reference = entry.get("bsdf") if isinstance(entry, dict) else None
        if reference and reference["type"] == "ref" and not name.startswith("spare"):
            bsdf = scene[reference["id"]]
            found[bsdf["bsdf"]["type"] if bsdf["type"] == "twosided" else bsdf["type"]] += 1
    return found


def test_by_default_a_take_is_the_scene_of_its_seed() -> None:
    (take,) = random_takes(5, 3)
    made = random_scene(5, 3)
    assert (take.name, take.film, take.spp) == ("random0005", None, 1)
    assert scene_digest(take.made.scene) == scene_digest(made.scene)
    assert [camera.to_world.tolist() for camera in take.made.cameras] == [
        camera.to_world.tolist() for camera in made.cameras
    ]


def test_the_same_seed_gives_the_same_takes() -> None:
    for seed in (0, 1, 2):
        assert [described(take) for take in wild(seed)] == [described(take) for take in wild(seed)]


def test_one_option_does_not_change_what_another_draws() -> None:
    for seed in range(6):
        first, second = wild(seed, shiny=False)[0], wild(seed, spp=3)[0]
        assert (first.spp, second.spp) == (wild(seed)[0].spp, 3)
        assert (first.film is None) == (second.film is None)
        assert [camera.to_world.tolist() for camera in wild(seed, sampling="centre")[0].made.cameras] == [
            camera.to_world.tolist() for camera in second.made.cameras
        ]


def test_fractions_of_the_options_that_are_drawn(survey: list[Take]) -> None:
    """Every fraction within four deviations of what it is drawn with."""

    def within(found: list[bool], fraction: float) -> bool:
        return abs(np.mean(found) - fraction) < 4 * math.sqrt(fraction * (1 - fraction) / len(found))

    stills = {take.name[:10]: "_" in take.name for take in survey}
    assert within(list(stills.values()), 0.5)
    assert all(len(take.made.cameras) == (1 if "_" in take.name else 4) for take in survey)
    assert not any(take.made.moves for take in survey if "_" in take.name)
    assert within([take.film is None for take in survey], 1 / 3)
    assert within([take.spp == 1 for take in survey], 0.5)
    assert {take.spp for take in survey} <= {1, 2, 4, 8, 16, 32, 64}
    films = [take.film for take in survey if take.film is not None]
    assert within([film.filter == "box" for film in films], 0.5)
    assert within([film.aperture > 0 for film in films], 0.2)
    assert all(take.film is not None for seed in range(5) for take in wild(seed, sampling="filtered"))
    assert all(take.film is None for seed in range(5) for take in wild(seed, sampling="centre"))


def test_a_lens_blurs_by_one_to_eight_pixels_at_twice_the_distance(survey: list[Take]) -> None:
    lenses = [take for take in survey if take.film is not None and take.film.aperture > 0]
    assert len(lenses) > 3
    for take in lenses:
        assert take.film is not None
        pixel = 2 * take.film.focus * math.tan(math.radians(take.made.cameras[0].fov_x) / 2) / 160
        assert 1 - 1e-9 <= take.film.aperture / pixel <= 8 + 1e-9
        assert 0.3 <= take.film.focus < 30


def test_views_are_other_cameras_in_one_place() -> None:
    first, second = (random_scene(4, 1, view=view) for view in (0, 1))
    assert scene_digest(first.scene) == scene_digest(second.scene)
    assert not np.allclose(first.cameras[0].to_world, second.cameras[0].to_world)


def test_shiny_places_are_the_same_places_with_more_that_shines() -> None:
    coats, matt = 0, 0
    for seed in range(12):
        plain, shiny = (kinds(random_scene(seed, 1, shiny=flag).scene) for flag in (False, True))
        gloss = ("plastic", "roughplastic", "roughconductor", "conductor", "dielectric", "thindielectric")
        bright = sum(shiny[kind] for kind in gloss) / sum(shiny.values())
        before = sum(plain[kind] for kind in gloss) / sum(plain.values())
        coats += bright > before
        matt += shiny["diffuse"] > 0
        assert sum(shiny.values()) > sum(plain.values())
    assert coats >= 10
    assert matt >= 8


def test_reflectances_of_shiny_places_are_some() -> None:
    for seed in range(6):
        for entry in random_scene(seed, 1, shiny=True).scene.values():
            inner = entry.get("bsdf", {}) if isinstance(entry, dict) and entry["type"] == "twosided" else {}
            for key in ("reflectance", "diffuse_reflectance"):
                if key in inner:
                    image = inner[key]["bitmap"]
                    assert image.min() >= 0.002
                    assert image.max() <= 0.9
