"""Takes: what a number draws, where samples lie, what frames of a known scene hold, and training on the files."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refused

from mcdenoise.cli import main
from mcdenoise.data.camera_path import Camera
from mcdenoise.data.shards import find_shards, open_shard, write_shard
from mcdenoise.errors import InputError
from mcdenoise.scenes.assets import Assets
from mcdenoise.scenes.generation import TakePlan
from mcdenoise.scenes.random.materials import diffuse, glass
from mcdenoise.scenes.render.film import Film, curve, offsets, splat
from mcdenoise.scenes.takes.draw import Take, draw_take

NOTHING = Assets()
SIZE = 24, 16
FOV = 50.0


def test_numbers_draw_stills_clips_and_every_kind_of_sampling(monkeypatch: pytest.MonkeyPatch) -> None:
    # Whatever may have a lens has one.
    monkeypatch.setattr("mcdenoise.scenes.takes.draw._LENS", 1.0)
    takes = [draw_take(number, NOTHING, size=SIZE) for number in range(14)]
    assert {len(take.cameras) for take in takes} == {1, 16}
    assert len({take.film.filter for take in takes}) >= 4
    assert {take.features for take in takes} == {"noisy", "exact", "clean"}
    assert all((take.film.aperture == 0) is (take.film.filter == "centre") for take in takes)


@pytest.mark.parametrize(("name", "variance"), [("centre", 0), ("box", 1 / 12), ("tent", 1 / 6)])
def test_samples_lie_as_the_filter_says(name: str, variance: float) -> None:
    drawn = offsets(name)
    assert abs(drawn.mean()) < 1e-3
    assert drawn.var() == pytest.approx(variance, rel=0.02)


@pytest.mark.parametrize("name", ["box", "tent", "gaussian", "blackman_harris"])
def test_drawn_and_weighed_samples_have_one_variance(name: str) -> None:
    x = np.linspace(-2, 2, 4001)
    weights = curve(name, x)
    assert offsets(name).var() == pytest.approx(float((weights * x**2).sum() / weights.sum()), rel=0.02)


def test_splatting_keeps_a_constant_and_spreads_a_point() -> None:
    rng = np.random.default_rng(0)
    width, height = SIZE
    x, y = rng.random((2, width * height, 3))
    constant = splat("gaussian", np.full((width * height, 3, 2), 0.7), x, y, SIZE)
    assert np.allclose(constant, 0.7)
    values = np.zeros((width * height, 3, 1))
    values[5 * width + 9] = 1
    lit = splat("tent", values, x, y, SIZE).reshape(height, width) > 0
    assert lit[4:7, 8:11].any()
    lit[4:7, 8:11] = False
    assert not lit.any()


def known(**changed: Any) -> Take:
    """A gray wall at distance 2 before a white sky, with a camera that moves by 0.1 to the right."""
    wall = {"type": "rectangle", "to_world": np.diag((9.0, 9, 1, 1)), "bsdf": {"type": "ref", "id": "material_0"}}
    wall["to_world"][2, 3] = -2
    take = Take(
        number=1,
        attempt=0,
        scene={"type": "scene", "material_0": diffuse((0.5, 0.5, 0.5)), "wall": wall, "sky": {"type": "constant"}},
        cameras=[Camera.look_at((x, 0, 0), (x, 0, -1), FOV) for x in (0, 0.1)],
        moves={},
        void=False,
        size=SIZE,
        spp=4,
        film=Film("box", splat=False),
        features="noisy",
        glossy="white",
        white_lamps=True,
        credits=(),
    )
    return replace(take, **changed)


def traced(take: Take) -> tuple[dict[str, Any], Any]:
    pytest.importorskip("mitsuba", reason="rendering needs Mitsuba: pip install 'mcdenoise[render]'")
    from mcdenoise.scenes.takes.tracing import TakeTracer

    tracer = TakeTracer(take, "scalar_rgb", half=20)
    return tracer.noisy(1), tracer.halves(1)


# Pixels of a way of 0.1 at distance 2.
SHIFT = 0.1 / (2 * math.tan(math.radians(FOV / 2))) * SIZE[0] / 2


@pytest.mark.parametrize("splatted", [False, True])
def test_frames_of_a_known_scene_are_known(splatted: bool) -> None:
    frame, halves = traced(known(film=Film("tent", splat=splatted)))
    for name, value in {"albedo": 0.5, "depth": 2.0, "alpha": 1.0, "roughness": 1.0}.items():
        assert np.allclose(frame[name], value, atol=1e-4), name
    assert np.allclose(frame["normal"].reshape(3, -1).T, (0, 0, 1), atol=1e-5)
    # What is seen now was further to the right before.
    assert np.allclose(frame["motion"][0], SHIFT, atol=1e-3)
    assert np.allclose(frame["motion"][1], 0, atol=1e-3)
    # A wall under an even sky: the reflectance times the radiance, but for noise.
    assert frame["color"].mean() == pytest.approx(0.5, abs=0.05)
    assert [half.mean() for half in halves] == pytest.approx([0.5, 0.5], abs=0.05)
    assert not np.array_equal(*halves)


def test_references_have_as_many_samples_as_can_be_stratified() -> None:
    mi = pytest.importorskip("mitsuba")
    from mcdenoise.scenes.takes.tracing import stratified

    mi.set_variant("scalar_rgb")
    for samples in (1, 5, 48, 127, 128, 133):
        sampler = mi.load_dict({"type": "multijitter", "sample_count": samples})
        assert stratified(samples) == sampler.sample_count()


def test_motion_follows_what_moves() -> None:
    moved = np.stack([np.eye(4), np.eye(4)])
    moved[1, 0, 3] = 0.1
    still = [Camera.look_at((0, 0, 0), (0, 0, -1), FOV)] * 2
    frame, _ = traced(known(cameras=still, moves={"wall": moved}))
    assert np.allclose(frame["motion"][0], -SHIFT, atol=1e-3)


def test_noise_is_none_in_plain_light_and_all_where_samples_find_no_light() -> None:
    pytest.importorskip("mitsuba", reason="rendering needs Mitsuba: pip install 'mcdenoise[render]'")
    from mcdenoise.scenes.takes.tracing import TakeTracer

    dark = {key: value for key, value in known().scene.items() if key != "sky"}
    empty = {key: value for key, value in known().scene.items() if key != "wall"}
    assert TakeTracer(known(scene=empty), "scalar_rgb").noise(1) == pytest.approx(0)
    assert TakeTracer(known(), "scalar_rgb").noise(1) < 0.3
    assert TakeTracer(known(scene=dark), "scalar_rgb").noise(1) == 1


@pytest.mark.parametrize(("glossy", "albedo"), [("black", 0.0), ("white", 1.0)])
def test_glass_has_the_albedo_that_the_take_says(glossy: str, albedo: float) -> None:
    scene = {**known().scene, "material_0": glass(1.5)}
    frame, _ = traced(known(scene=scene, glossy=glossy))
    assert np.allclose(frame["albedo"], albedo)
    assert np.allclose(frame["roughness"], 0)


def test_a_void_is_black_and_transparent() -> None:
    scene = {key: value for key, value in known().scene.items() if key != "wall"}
    frame, halves = traced(known(scene=scene, void=True))
    assert not frame["color"].any()
    assert not frame["alpha"].any()
    assert np.isinf(frame["depth"]).all()
    assert not np.any(halves)


@pytest.mark.parametrize("splatted", [False, True])
@pytest.mark.parametrize("void", [False, True])
def test_references_have_the_filter_of_the_frames(void: bool, splatted: bool) -> None:
    # A shining wall that ends in the middle of the image: its edge is the integral of the filter.
    shine = {"type": "area", "radiance": {"type": "rgb", "value": [1.0, 1.0, 1.0]}}
    wall = {**known().scene["wall"], "emitter": shine, "to_world": known().scene["wall"]["to_world"].copy()}
    wall["to_world"][0, 3] = -9
    scene = {"type": "scene", "material_0": diffuse((0.0, 0.0, 0.0)), "wall": wall}
    still = [Camera.look_at((0, 0, 0), (0, 0, -1), FOV)] * 2
    take = known(scene=scene, cameras=still, void=void, film=Film("gaussian", splat=splatted), spp=36)
    frame, halves = traced(take)
    inside = 0.5 * (1 + math.erf(1 / math.sqrt(2)))
    for image in (frame["color"], sum(halves) / 2):
        columns = image.mean((0, 1))
        assert columns[[10, 11, 12]] == pytest.approx([1, inside, 1 - inside], abs=0.05)


def test_exact_features_behind_a_lens_are_those_of_a_pinhole() -> None:
    sharp, _ = traced(known(film=Film("box", aperture=0.3, splat=False), features="exact"))
    assert np.allclose(sharp["motion"][0], SHIFT, atol=1e-4)
    assert np.allclose(sharp["depth"], 2, atol=1e-5)


def test_a_folder_of_takes_is_of_one_variant(tmp_path: Path) -> None:
    image = np.zeros((1, 3, 4, 4), np.float32)
    header = {"renderer": "mitsuba 3.9.1 (llvm_ad_rgb, drjit 1.5.0), path integrator"}
    write_shard(tmp_path / "000007.take.npz", header, {"color": image, "reference": image})
    same, other = (
        TakePlan(out=tmp_path, assets=NOTHING, unseen=False, variant=variant)
        for variant in ("llvm_ad_rgb", "scalar_rgb")
    )
    # Folders did not say it before.
    older = {name: value for name, value in same.identity.items() if name != "variant"}
    (tmp_path / "takes.json").write_text(json.dumps(older))
    for found in ("mitsuba .*llvm_ad_rgb", "llvm_ad_rgb;"):
        with pytest.raises(InputError, match=f"expected takes with variant scalar_rgb, found {found}"):
            other.render(7)
        assert same.render(7).name == "000007.take.npz"


@pytest.mark.parametrize("content", ["[]", "5", "{", '{"takes": 2}'])
def test_a_folder_of_something_else_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "takes.json").write_text(content)
    plan = TakePlan(out=tmp_path, assets=NOTHING, unseen=False, variant="scalar_rgb")
    assert str(tmp_path) in refused(plan.render, 7)


def test_takes_are_generated_resumed_and_trained_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("mitsuba", reason="rendering needs Mitsuba: pip install 'mcdenoise[render]'")
    pytest.importorskip("lightning_fabric", reason="training needs the packages of mcdenoise[train]")
    pytest.importorskip("tensorboard", reason="training needs the packages of mcdenoise[train]")
    from mcdenoise.train import TrainConfig, train

    out = tmp_path / "takes"
    # An empty folder instead of the packages, so that nothing is fetched.
    (tmp_path / "assets/images").mkdir(parents=True)
    (tmp_path / "assets/usr/share/sweethome3d/furniture").mkdir(parents=True)
    command = ["generate", "-o", str(out), "--takes", "--seeds", "2", "--frames", "4", "--size", "24x16"]
    command += ["--reference-spp", "2", "--variant", "scalar_rgb", "--assets", str(tmp_path / "assets")]

    def run(*arguments: str) -> int:
        with pytest.raises(SystemExit) as done:
            main([*command, *arguments])
        return int(done.value.code or 0)

    assert run() == 0
    (path,) = find_shards(out)
    shard = open_shard(path)
    assert shard.size == (16, 24)
    assert shard.header["number"] == 2
    written = path.stat().st_mtime_ns
    assert run() == 0
    assert path.stat().st_mtime_ns == written
    # Also the number that sequences have by default.
    assert run("--frames", "12") == 2
    assert "frames 12, found 4" in capsys.readouterr().err

    frames = len(shard)
    config = TrainConfig(
        "kpcn", settings="width=4", steps=1, batch=2, crop=16, frames=frames, temporal_weight=0, validation_frames=0
    )
    assert train(config, [out], tmp_path / "run", validation=[out]).is_file()
