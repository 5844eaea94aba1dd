"""The scripts in `training/` that made the training set."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from mcdenoise.data import open_sequence, read_exr
from mcdenoise.data.camera_path import Camera
from mcdenoise.errors import InputError
from mcdenoise.models import Chain, create_model, describe_weights, load_weights, parts_of, save_weights
from mcdenoise.nn.unet import UNet

SCRIPTS = Path(__file__).parents[2] / "training"


def script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, SCRIPTS / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("place", [".", "inputs"])
def test_cleaned_references(small_sequence: Path, tmp_path: Path, place: str) -> None:
    pytest.importorskip("pyoidn", reason="Open Image Denoise is in the extra mcdenoise[peers]")
    description = small_sequence / "inputs" / "camera.json"
    about = json.loads(description.read_text())
    description.write_text(json.dumps({**about, "reference_spp": {"0": 64}, "reference_noise": {"0": 0.1}}))
    oidn = create_model("oidn", quality="high", auxiliary="clean", source="raw", threads=1)
    copied = script("clean_references").clean(small_sequence / place, tmp_path / "out", oidn)
    assert copied == tmp_path / "out" / "plane"
    source, cleaned = open_sequence(small_sequence), open_sequence(copied)
    assert cleaned.reference_numbers == source.reference_numbers
    before, after = (dict(sequence.frame(1).items()) for sequence in (source, cleaned))
    assert {name for name in before if not torch.equal(before[name], after[name])} == {"reference"}
    # What was known of the references is not said of what the filter made of them.
    said = json.loads((copied / "inputs" / "camera.json").read_text())
    assert said == {**about, "reference_filter": "Open Image Denoise, high, clean aux"}


def test_more_noise_of_a_scene_that_moves(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba", reason="rendering needs Mitsuba: pip install 'mcdenoise[render]'")
    from mcdenoise.scenes.render import render_sequence

    scene = tmp_path / "scene.xml"
    scene.write_text(
        '<scene version="3.0.0"><shape type="sphere" id="lamp">'
        '<emitter type="area"><rgb name="radiance" value="5"/></emitter></shape></scene>'
    )
    moves = np.tile(np.eye(4), (2, 1, 1))
    moves[1, 0, 3] = 1.5
    camera = Camera.look_at((0, 0, 6), (0, 0, 0), fov_x=60)
    settings = {"size": (16, 12), "variant": "scalar_rgb", "reference_frames": []}
    render_sequence(scene, [camera] * 2, tmp_path / "source", moves={"lamp": moves}, **settings)
    copied = script("more_noise").add_realisations(tmp_path / "source", scene, tmp_path / "out", 2)
    assert open_sequence(copied).realisations == 2
    for number in range(2):
        # Light seen directly has no noise: the further realisation shows the lamp where the first one does.
        first, second = (
            read_exr(copied / "inputs" / place / f"color{number}.exr")[0] for place in ("", "realisation1")
        )
        assert first.max() == 5
        np.testing.assert_array_equal(second, first)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["source"]


def test_more_noise_needs_the_cameras(small_sequence: Path, tmp_path: Path) -> None:
    pytest.importorskip("mitsuba", reason="rendering needs Mitsuba: pip install 'mcdenoise[render]'")
    with pytest.raises(InputError, match=r"camera\.json: expected cameras and max_depth"):
        script("more_noise").add_realisations(small_sequence, tmp_path / "scene.xml", tmp_path / "out", 2)
    assert not (tmp_path / "out").exists()


def test_wider_inputs_change_no_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    model = create_model("cascaded_v2", width=8)
    for parameter in model.parameters():
        parameter.data = parameter.data.half().float()
    # As if the U-Net of the first network were not given the last two channels of the features.
    chain = next(parts_of(model, Chain))
    first = next(parts_of(chain.initial, UNet)).encoder[0][0]
    first.weight.data[:, -2:] = 0
    wide = model.state_dict()
    (key,) = (key for key, value in model.named_parameters() if value is first.weight)
    monkeypatch.setattr(model, "state_dict", lambda: {**wide, key: first.weight.data[:, :-2]})
    old, new = tmp_path / "old.safetensors", tmp_path / "new.safetensors"
    old.write_bytes(save_weights(model, "cascaded_v2", {"width": 8}, {"steps": "7"}))
    new.write_bytes(script("widen_inputs").widened(old))
    loaded = load_weights(new)
    assert all(torch.equal(value, wide[key]) for key, value in loaded.state_dict().items())


def test_the_weights_of_a_run_that_has_not_ended(small_sequence: Path, tmp_path: Path, monkeypatch: Any) -> None:
    pytest.importorskip("lightning_fabric", reason="training needs the packages of mcdenoise[train]")
    pytest.importorskip("tensorboard", reason="training needs the packages of mcdenoise[train]")
    from mcdenoise.train import TrainConfig, train

    settings = {"width": 4, "crop": 16, "frames": 2, "batch": 1, "steps": 2, "ema": 0.5, "validation_frames": 0}
    weights = train(TrainConfig(**settings), [small_sequence], tmp_path / "run", checkpoint_every=1)
    out = tmp_path / "early.safetensors"
    monkeypatch.setattr("sys.argv", ["weights_of_checkpoint.py", str(tmp_path / "run"), "-o", str(out)])
    script("weights_of_checkpoint").main()
    assert describe_weights(out) == describe_weights(weights)


def test_a_zoomed_shot_shows_a_part_of_the_image() -> None:
    path = [Camera.look_at((0, 1, i / 10), (0, 1, 5), fov_x=90) for i in range(9)]
    zoomed = script("zoomed_cameras").zoomed
    for seed in range(20):
        shot = zoomed(path, 4, (2.0, 8.0), np.random.default_rng(seed))
        assert len(shot) == 4
        start = next(i for i, camera in enumerate(path) if np.allclose(camera.to_world[:3, 3], shot[0].to_world[:3, 3]))
        for wide, narrow in zip(path[start:], shot, strict=False):
            np.testing.assert_allclose(narrow.to_world[:3, :3].T @ narrow.to_world[:3, :3], np.eye(3), atol=1e-12)
            np.testing.assert_array_equal(narrow.to_world[:3, 3], wide.to_world[:3, 3])
            assert 2 <= 1 / np.tan(np.radians(narrow.fov_x) / 2) <= 8
            # The middle of the narrow image, in the image of 16:9 of the wide one.
            x, y, z = wide.to_world[:3, :3].T @ narrow.to_world[:3, 2]
            assert abs(x / z) < 1
            assert abs(y / z) < 9 / 16


def test_weights_are_averaged(tmp_path: Path) -> None:
    files = [tmp_path / "first.safetensors", tmp_path / "second.safetensors"]
    models = [create_model("cascaded_v2_tiny", width=4) for _ in files]
    for number, (file, model) in enumerate(zip(files, models, strict=True)):
        for parameter in model.parameters():
            torch.nn.init.constant_(parameter, 1 + 2 * number)
        file.write_bytes(save_weights(model, "cascaded_v2_tiny", {"width": 4}, {"steps": str(number)}))
    out = tmp_path / "mean.safetensors"
    script("average_weights").average(files, out)
    assert {float(value.unique()) for value in load_weights(out, "cascaded_v2_tiny").state_dict().values()} == {2.0}
    about = describe_weights(out)
    assert about["steps"] == "1"
    assert json.loads(about["mean_of"]) == [describe_weights(file)["sha256"] for file in files]
    with pytest.raises(InputError, match="expected at least two files of weights, found 1"):
        script("average_weights").average(files[:1], out)
    other = tmp_path / "other.safetensors"
    other.write_bytes(save_weights(create_model("cascaded_v2", width=4), "cascaded_v2", {"width": 4}, {}))
    with pytest.raises(InputError, match="expected weights of model 'cascaded_v2_tiny', found those of 'cascaded_v2'"):
        script("average_weights").average([other, *files], out)
