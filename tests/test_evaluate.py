from __future__ import annotations

from pathlib import Path

import pytest
import torch
from kornia.filters import joint_bilateral_blur
from torch import Tensor, nn

from mcdenoise.buffers import Frame
from mcdenoise.data import open_sequence
from mcdenoise.denoiser import Denoiser, Images
from mcdenoise.errors import InputError
from mcdenoise.evaluate import METRICS, Scorer, score_sequence
from mcdenoise.metrics import psnr_srgb, smape_linear
from mcdenoise.models import Denoised


class Half(nn.Module):
    """Initial: twice the input. Final: half of it."""

    def forward(self, color: Tensor, albedo: Tensor, normal: Tensor, depth: Tensor) -> Denoised:
        return Denoised(color * 2, color / 2)


def by_method(scores: list) -> dict:
    return {score.method: score for score in scores}


def test_scores_are_means_over_the_frames_with_a_reference() -> None:
    scorer = Scorer("two")
    one = torch.full((1, 3, 2, 2), 0.5)
    for factor in (1.0, 3.0):
        images = Images(noisy=factor * one, accumulated=one, initial=2 * one, denoised=one)
        scorer.add(Frame(color=one, reference=one), images)
        scorer.add(Frame(color=one), images)
    scores = by_method(scorer.scores())
    assert list(scores) == ["noisy", "accumulated", "initial", "denoised"]
    assert all((score.sequence, score.frames) == ("two", 2) for score in scores.values())
    # |0.5 - 0.5| and |1.5 - 0.5| / (1.5 + 0.5 + 0.01)
    assert scores["noisy"].values["SMAPE"] == pytest.approx((0 + 1 / 2.01) / 2)
    assert scores["initial"].values["SMAPE"] == pytest.approx(0.5 / 1.51)
    assert scores["initial"].values["relMSE"] == pytest.approx(0.25 / 0.26)
    assert scores["denoised"].values == {"SMAPE": 0.0, "relMSE": 0.0, "PSNR": float("inf")}


def test_the_plain_filter_is_the_best_of_its_sweep(small_sequence: Path) -> None:
    """Never worse than one setting, written out with kornia's own function."""
    sequence = open_sequence(small_sequence)
    denoiser = Denoiser(Half())
    scores = by_method(score_sequence(sequence, denoiser))
    assert list(scores) == ["noisy", "accumulated", "joint bilateral, best", "initial", "denoised"]
    denoiser.reset()
    smape, decibels = [], []
    for number in sequence.numbers:
        frame = sequence.frame(number)
        light = denoiser.history.update(frame).color
        depth = torch.where(frame.depth.isfinite(), frame.depth, 1)
        typical = torch.exp(torch.log(depth).sum() / frame.depth.isfinite().sum())
        nearness = torch.where(frame.depth.isfinite(), depth / (depth + typical), 1)
        guide = torch.cat([frame.albedo, frame.normal, 10 * nearness], 1)
        image = joint_bilateral_blur(
            light, guide, 11, 0.2, (2.5, 2.5), border_type="replicate", color_distance_type="l2"
        )
        textured = (frame.albedo >= 1e-4).any(1, keepdim=True)
        image = image * torch.where(textured, frame.albedo.clamp_min(0.01), 1)
        smape.append(smape_linear(image, frame.reference))
        decibels.append(psnr_srgb(image, frame.reference))
    best = scores["joint bilateral, best"].values
    assert best["SMAPE"] <= float(torch.stack(smape).mean()) + 1e-6
    assert best["PSNR"] >= float(torch.stack(decibels).mean()) - 1e-4
    assert best["SMAPE"] < scores["accumulated"].values["SMAPE"]
    assert set(best) == set(METRICS)


def test_without_references_there_is_nothing_to_compare(small_sequence: Path) -> None:
    for path in (small_sequence / "inputs").glob("reference*.exr"):
        path.unlink()
    with pytest.raises(InputError, match="expected references"):
        score_sequence(open_sequence(small_sequence), Denoiser(Half()))


def test_a_bad_frame_is_named(small_sequence: Path) -> None:
    sequence = open_sequence(small_sequence)
    original = sequence.frame(1)
    albedo = original.albedo.clone()
    albedo[0, 0, 3, 4] = float("nan")

    class Spoilt:
        def __getattr__(self, name: str) -> object:
            return getattr(sequence, name)

        def frame(self, number: int, reference: bool = True) -> Frame:
            return original.replace(albedo=albedo) if number == 1 else sequence.frame(number, reference)

    with pytest.raises(InputError, match="frame 1: buffer 'albedo'"):
        score_sequence(Spoilt(), Denoiser(Half()), sweep=False)  # type: ignore[arg-type]
