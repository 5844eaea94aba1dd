"""The default model, by the features and the noise of a frame."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from commands import succeeds
from planes import plane

from mcdenoise import Denoiser, InputError, denoise
from mcdenoise.data import open_sequence
from mcdenoise.denoiser import suitable_model
from mcdenoise.folder import denoised_frames
from mcdenoise.frame import Frame
from mcdenoise.shot import ShotSettings, default_model

LITTLE_NOISE = (
    "features have no noise, and the color has little; oidn_temporal usually has a smaller error, but takes longer"
)
MUCH_NOISE = "features have no noise, and the color of a sequence has much"


def noisy_plane() -> Frame:
    """A plane seen through the pixel centres, as noisy as with one sample a pixel."""
    frame = plane()
    return frame.replace(color=frame.color**4)


def test_at_pixel_centres_the_noise_decides() -> None:
    frame = noisy_plane()
    clean = frame.replace(color=torch.full_like(frame.color, 0.5))
    assert suitable_model(frame)[0] == "cascaded_v2"
    assert suitable_model(clean) == ("oidn_tuned_exact", LITTLE_NOISE)
    assert suitable_model(frame, still=True)[0] == "oidn_tuned_exact"
    # The settings of its history require a cascade.
    assert suitable_model(clean, cascade=True)[0] == "cascaded_v2"


def test_the_layout_of_a_lab_is_examined(small_sequence: Path) -> None:
    sequence = open_sequence(small_sequence)
    assert default_model(sequence) == ("cascaded_v2", MUCH_NOISE)
    assert default_model(replace(sequence, layout="files"))[0] == "oidn_tuned"
    assert default_model(replace(sequence, layout="files"), cascade=True)[0] == "cascaded_v3"
    # A damaged frame is reported when it is denoised, and does not change the choice.
    (small_sequence / "inputs" / "color0.exr").write_bytes(b"damaged")
    assert default_model(sequence)[0] == "cascaded_v2"


def test_settings_that_only_a_cascade_has_choose_one(small_sequence: Path) -> None:
    sequence = replace(open_sequence(small_sequence), layout="files")
    for settings, model in (
        (ShotSettings(), "oidn_tuned"),
        # Any model's image is split into layers.
        (ShotSettings(layers=("all",)), "oidn_tuned"),
        (ShotSettings(alpha=True), "oidn_tuned"),
        (ShotSettings(alpha_min=0.5), "cascaded_v3"),
        (ShotSettings(tolerance=0.0), "cascaded_v3"),
        (ShotSettings(anti_lag=False), "cascaded_v3"),
        (ShotSettings(model="kp"), "kp"),
    ):
        chosen, _ = settings.chosen(sequence)
        assert chosen.spelling.model == model
        chosen.denoiser()


def test_the_command_says_what_it_picked(small_sequence: Path, tmp_path: Path) -> None:
    def printed(*options: str) -> str:
        return succeeds("denoise", small_sequence, "-o", tmp_path / str(len(options)), *options)

    def report(folder: str) -> dict[str, Any]:
        return json.loads((tmp_path / folder / "denoise.json").read_text())

    picked = f"cascaded_v2: {MUCH_NOISE}"
    assert f"picked {picked}\n" in printed()
    assert report("0")["picked"] == picked
    assert "picked" not in printed("--model", "joint_bilateral")
    assert report("2")["picked"] == ""
    # The model is also known before denoising.
    inspected = succeeds("inspect", small_sequence, "--json", tmp_path / "inspect.json")
    assert f"`mcdenoise denoise` picks {picked}\n" in inspected
    assert json.loads((tmp_path / "inspect.json").read_text())["picked"] == picked


def test_a_still_in_python_is_denoised_by_what_suits_it() -> None:
    frame = noisy_plane()
    color, normal, depth = (getattr(frame, name)[0].numpy() for name in ("color", "normal", "depth"))
    for more, model in (({"depth": depth}, "oidn_tuned_exact"), ({}, "oidn_tuned")):
        arrays = {"layout": "CHW", "normal": normal, **more}
        picked, named = (denoise(color, **arrays, **given) for given in ({}, {"model": model}))
        np.testing.assert_array_equal(picked, named)
    # Settings are those of the default.
    denoise(color, layout="CHW", alpha_min=0.5)


def test_the_first_frame_picks_the_model_of_a_denoiser(small_sequence: Path) -> None:
    sequence = open_sequence(small_sequence, "0-1")
    name, why = default_model(sequence)
    denoiser, named = Denoiser(), Denoiser(name)
    assert denoiser.model is None
    for number in sequence.numbers:
        frame = sequence.frame(number, reference=False)
        assert torch.equal(denoiser(frame), named(frame))
        assert denoiser.report.model == f"{name}: {why}"
        assert f"model: {name}" in str(denoiser.report)
        assert named.report.model == ""
    # The next shots are denoised by the same model, whose weights a user may hold.
    model = denoiser.model
    denoiser.reset()
    denoiser(Frame(sequence.frame(0).color))
    assert denoiser.model is model
    # A whole shot, as the command denoises it.
    fresh = Denoiser()
    assert len(list(denoised_frames(sequence, fresh))) == len(sequence)
    assert fresh.report.model == f"{name}: {why}"


def test_a_picked_model_obeys_the_arguments_of_the_denoiser() -> None:
    frame = noisy_plane()
    still = Denoiser()
    still.reset(frames=1)
    still(frame)
    assert still.report.model.startswith("oidn_tuned_exact: ")
    Denoiser().reset({"color"}, 3, (64, 96))
    historic = Denoiser(alpha_min=0.5)
    historic(frame)
    assert historic.report.model.startswith("cascaded_v2: ")
    # Alpha rides along with any model.
    plain, with_alpha = Denoiser(), Denoiser(alpha=True)
    for denoiser in (plain, with_alpha):
        denoiser.reset(frames=1)
        denoiser(frame.replace(alpha=torch.ones_like(frame.color[:, :1])))
    assert with_alpha.report.model == plain.report.model
    tiled = Denoiser(tile=64, precision="bfloat16")
    assert tiled.precision == "bfloat16"
    tiled(frame)
    assert "asked for" in tiled.report.tiles
    learns = Denoiser(differentiable=True)
    with torch.inference_mode():
        learns(frame)
    learns.reset()
    learns(frame).sum().backward()
    assert all(each.grad is not None for each in learns.model.parameters() if each.requires_grad)
    wrong: dict[str, Any]
    for wrong in ({"tile": 65}, {"max_memory": -1}, {"alfa_min": 0.5}, {"tile": 64, "max_memory": 2.0}):
        with pytest.raises(InputError):
            Denoiser(**wrong)
    # An invalid frame picks nothing.
    denoiser = Denoiser()
    with pytest.raises(InputError):
        denoiser(frame.replace(depth=torch.full_like(frame.color[:, :1], torch.nan)))
    assert denoiser.model is None
