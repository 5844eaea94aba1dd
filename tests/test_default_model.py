"""The model of those who name none."""

import json
from pathlib import Path

import numpy as np
import torch
from commands import succeeds
from planes import plane

from mcdenoise import Denoiser, denoise
from mcdenoise.data import open_sequence
from mcdenoise.folder import denoised_frames
from mcdenoise.models import DEFAULT
from mcdenoise.models.wild import WildNetwork
from mcdenoise.shot import ShotSettings


def test_a_denoiser_without_a_name_is_the_default(small_sequence: Path, weights: Path) -> None:
    sequence = open_sequence(small_sequence, "0-1")
    images = [[image for *_, image in denoised_frames(sequence, each)] for each in (Denoiser(), Denoiser(DEFAULT))]
    assert len(images[0]) == len(sequence)
    assert all(torch.equal(a.image, b.image) for a, b in zip(*images, strict=True))
    assert any(isinstance(each, WildNetwork) for each in Denoiser(alpha_min=0.5, tolerance=0).model.modules())
    # Weights say which model they are for.
    assert not any(isinstance(each, WildNetwork) for each in Denoiser(weights=weights).model.modules())


def test_a_still_in_python() -> None:
    frame = plane()
    color, normal, depth = (getattr(frame, name)[0].numpy() for name in ("color", "normal", "depth"))
    unnamed, named = (
        denoise(color, layout="CHW", normal=normal, depth=depth, alpha_min=0.5, **given)
        for given in ({}, {"model": DEFAULT})
    )
    np.testing.assert_array_equal(unnamed, named)


def test_the_command(small_sequence: Path, tmp_path: Path) -> None:
    for settings, model in (
        (ShotSettings(), DEFAULT),
        (ShotSettings(alpha_min=0.5, anti_lag=False, tolerance=0.0), DEFAULT),
        (ShotSettings(model="kp"), "kp"),
    ):
        assert settings.spelling.model == model
        settings.denoiser()
    assert "picked" not in succeeds("denoise", small_sequence, "-o", tmp_path, "--frames", "0")
    report = json.loads((tmp_path / "denoise.json").read_text())
    assert (report["model"], report["picked"]) == (DEFAULT, "")
