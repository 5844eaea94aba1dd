from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from mcdenoise.frame import Frame
from mcdenoise.data import open_sequence
from mcdenoise.denoiser import Denoiser, Images
from mcdenoise.errors import InputError
from mcdenoise.evaluate import (
    METRICS,
    Score,
    Scorer,
    folded,
    mean_over_scenes,
    reference_noise,
    score_sequence,
    summary,
    verdicts,
)
from mcdenoise.metrics import smape_linear, temporal_rmse_srgb, temporal_smape_linear
from mcdenoise.models import Denoised
from mcdenoise.peers import JointBilateral, joint_bilateral_peers

QUICK = ("SMAPE", "relMSE", "PSNR", "SSIM", "tSMAPE", "tRMSE")


class Half(nn.Module):
    """Initial: twice the input. Final: half of it."""

    def forward(self, color: Tensor, albedo: Tensor, normal: Tensor, depth: Tensor) -> Denoised:
        return Denoised(color * 2, color / 2)


class Same(nn.Module):
    def forward(self, color: Tensor, albedo: Tensor, normal: Tensor, depth: Tensor) -> Denoised:
        return Denoised(color, color)


@dataclass(frozen=True)
class Scaled:
    """A peer: the noisy image times a factor."""

    factor: float
    group: str = "dull"
    family: str = "Scaled"
    remembers: bool = False

    @property
    def name(self) -> str:
        return f"Scaled {self.factor}"

    def reset(self) -> None:
        pass

    def __call__(self, frame: Frame, images: Images) -> Tensor:
        return images.noisy * self.factor


def by_method(scores: list[Score]) -> dict[str, Score]:
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


def test_temporal_errors_are_of_pairs_with_references() -> None:
    scorer = Scorer("gap", metrics=("SMAPE", "tSMAPE", "tRMSE"))
    levels = [0.1, 0.3, 0.2, 0.6, 0.5]
    for index, level in enumerate(levels):
        image = torch.full((1, 3, 2, 2), level)
        reference = torch.full((1, 3, 2, 2), 0.2)
        # The third frame has no reference: of four pairs, the first and the last one remain.
        frame = Frame(color=image, reference=None if index == 2 else reference)
        scorer.add(frame, Images(image, image, image, image))
    (score, *_) = scorer.scores()
    assert score.counts == {"SMAPE": 4, "tSMAPE": 2, "tRMSE": 2}
    still = torch.full((1, 2, 3, 2, 2), 0.2)
    pairs = [torch.tensor(pair).reshape(1, 2, 1, 1, 1).expand(1, 2, 3, 2, 2) for pair in ([0.1, 0.3], [0.6, 0.5])]
    for name, metric in (("tSMAPE", temporal_smape_linear), ("tRMSE", temporal_rmse_srgb)):
        assert score.values[name] == pytest.approx(sum(float(metric(pair, still)) for pair in pairs) / 2)


def test_flip_of_some_frames_only() -> None:
    pytest.importorskip("flip_evaluator")
    scorer = Scorer("some", metrics=("SMAPE", "FLIP"), flip_every=3)
    image = torch.full((1, 3, 4, 4), 0.5)
    for _ in range(4):
        scorer.add(Frame(color=image, reference=image), Images(image, image, image, image))
    assert scorer.scores()[0].counts == {"SMAPE": 4, "FLIP": 2}


def test_one_pass_scores_every_model_and_peer(small_sequence: Path) -> None:
    sequence = open_sequence(small_sequence)
    denoisers = {"half": Denoiser(Half()), "same": Denoiser(Same())}
    done: list[int] = []
    scores = by_method(
        score_sequence(sequence, denoisers, peers=[Scaled(1.0), Scaled(0.5)], metrics=QUICK, on_frame=done.append)
    )
    assert done == [0, 1, 2, 3]
    methods = ["noisy", "accumulated", "Scaled 1.0", "Scaled 0.5", "half, initial", "half", "same, initial", "same"]
    assert list(scores) == methods
    assert scores["Scaled 1.0"].values == scores["noisy"].values
    assert (scores["Scaled 0.5"].group, scores["Scaled 0.5"].family) == ("dull", "Scaled")
    # The second model has a history of its own, which is reset as the first one's is.
    assert scores["same"].values == pytest.approx(scores["accumulated"].values, rel=1e-5)
    assert all(set(score.values) == set(QUICK) for score in scores.values())
    assert scores["half"].counts == {"SMAPE": 4, "relMSE": 4, "PSNR": 4, "SSIM": 4, "tSMAPE": 3, "tRMSE": 3}
    # By hand, for the noisy image.
    frames = [sequence.frame(number) for number in sequence.numbers]
    color, reference = (torch.cat([getattr(frame, name) for frame in frames]) for name in ("color", "reference"))
    assert scores["noisy"].values["SMAPE"] == pytest.approx(float(smape_linear(color, reference).mean()), rel=1e-5)
    assert scores["noisy"].values["tRMSE"] == pytest.approx(float(temporal_rmse_srgb(color, reference)), rel=1e-5)
    again = by_method(score_sequence(sequence, denoisers, metrics=QUICK))
    assert again["same"].values == scores["same"].values


def test_frames_that_are_not_neighbours_are_no_pair(small_sequence: Path) -> None:
    sequence = open_sequence(small_sequence, "0,2-3")
    (score, *_) = score_sequence(sequence, {"half": Denoiser(Half())}, metrics=("SMAPE", "tRMSE"))
    assert score.counts == {"SMAPE": 3, "tRMSE": 1}


@dataclass(frozen=True)
class Counting(Scaled):
    """A peer that notes how many frames it has seen."""

    seen: list[Frame] = field(default_factory=list)

    def __call__(self, frame: Frame, images: Images) -> Tensor:
        self.seen.append(frame)
        return super().__call__(frame, images)


@pytest.mark.parametrize("remembers", [False, True])
def test_a_peer_that_remembers_sees_frames_without_a_reference_too(small_sequence: Path, remembers: bool) -> None:
    (small_sequence / "inputs" / "reference1.exr").unlink()
    peer = Counting(1.0, remembers=remembers)
    scores = score_sequence(open_sequence(small_sequence), {"half": Denoiser(Half())}, peers=[peer], metrics=("SMAPE",))
    assert len(peer.seen) == (4 if remembers else 3)
    assert by_method(scores)[peer.name].counts == {"SMAPE": 3}


def test_the_plain_filter_is_the_best_of_its_sweep(small_sequence: Path) -> None:
    sequence = open_sequence(small_sequence)
    denoisers = {"half": Denoiser(Half())}
    scores = score_sequence(sequence, denoisers, peers=joint_bilateral_peers(), metrics=("SMAPE", "PSNR"))
    rows = by_method(folded(scores))
    filtered = "joint bilateral, best of 20 settings"
    assert list(rows) == ["noisy", "accumulated", filtered, "half, initial", "half"]
    one = by_method(scores)[JointBilateral(0.2, 2.5).name]
    assert rows[filtered].values["SMAPE"] <= one.values["SMAPE"]
    assert rows[filtered].values["PSNR"] >= one.values["PSNR"]
    assert rows[filtered].values["SMAPE"] < rows["accumulated"].values["SMAPE"]


def test_without_references_there_is_nothing_to_compare(small_sequence: Path) -> None:
    for path in (small_sequence / "inputs").glob("reference*.exr"):
        path.unlink()
    with pytest.raises(InputError, match="expected references"):
        score_sequence(open_sequence(small_sequence), {"half": Denoiser(Half())})


def test_without_a_denoiser_there_is_no_history(small_sequence: Path) -> None:
    with pytest.raises(ValueError, match="denoisers: expected one at least"):
        score_sequence(open_sequence(small_sequence), {})


def test_a_bad_frame_is_named(small_sequence: Path) -> None:
    sequence = open_sequence(small_sequence)
    original = sequence.frame(1)
    albedo = original.albedo.clone()
    albedo[0, 0, 3, 4] = float("nan")

    class Spoilt:
        def __getattr__(self, name: str) -> object:
            return getattr(sequence, name)

        def __len__(self) -> int:
            return len(sequence)

        def frame(self, number: int, reference: bool = True) -> Frame:
            return original.replace(albedo=albedo) if number == 1 else sequence.frame(number, reference)

    with pytest.raises(InputError, match="frame 1: buffer 'albedo'"):
        score_sequence(Spoilt(), {"half": Denoiser(Half())}, metrics=QUICK)  # type: ignore[arg-type]


def score(sequence: str, method: str, smape: float, psnr: float, group: str = "") -> Score:
    family = "OIDN" if group else ""
    return Score(sequence, method, 2, {"SMAPE": smape, "PSNR": psnr}, {"SMAPE": 2, "PSNR": 2}, group, family)


@pytest.fixture
def two_scenes() -> list[Score]:
    """A is best for the first scene in SMAPE, B for the second, C never; D has the best PSNR throughout."""
    return [
        score("one", "noisy", 0.9, 5),
        score("one", "A", 0.10, 20, "fast"),
        score("one", "B", 0.20, 21, "fast"),
        score("one", "C", 0.16, 22, "high"),
        score("one", "D", 0.30, 30, "high"),
        score("one", "ours", 0.09, 29),
        score("two", "noisy", 0.7, 7),
        score("two", "A", 0.30, 20, "fast"),
        score("two", "B", 0.12, 21, "fast"),
        score("two", "C", 0.14, 22, "high"),
        score("two", "D", 0.30, 26, "high"),
        score("two", "ours", 0.13, 31),
    ]


def test_settings_fold_to_the_best_of_each_metric(two_scenes: list[Score]) -> None:
    rows = folded(two_scenes)
    methods = ["noisy", "fast", "high", "OIDN, best of 4 settings", "ours"]
    assert [(row.sequence, row.method) for row in rows] == [(s, m) for s in ("one", "two") for m in methods]
    one = by_method(rows[:5])
    assert one["fast"].values == {"SMAPE": 0.10, "PSNR": 21}
    assert one["fast"].chosen == {"SMAPE": "A", "PSNR": "B"}
    assert one["OIDN, best of 4 settings"].values == {"SMAPE": 0.10, "PSNR": 30}
    assert one["OIDN, best of 4 settings"].chosen == {"SMAPE": "A", "PSNR": "D"}
    assert one["ours"].values == {"SMAPE": 0.09, "PSNR": 29}


def test_every_scene_counts_the_same(two_scenes: list[Score]) -> None:
    longer = [replace(s, frames=98, counts={"SMAPE": 98}) if s.sequence == "two" else s for s in two_scenes]
    means = by_method(mean_over_scenes(longer))
    assert means["A"].values == pytest.approx({"SMAPE": 0.2, "PSNR": 20})
    assert (means["A"].sequence, means["A"].frames, means["A"].counts["SMAPE"]) == ("mean of 2", 100, 100)


def test_a_metric_that_one_scene_lacks_has_no_mean(two_scenes: list[Score]) -> None:
    two_scenes[0].values["tRMSE"] = 0.5
    assert set(by_method(mean_over_scenes(two_scenes))["noisy"].values) == {"SMAPE", "PSNR"}


def test_summary_tells_one_setting_for_all_from_one_for_each(two_scenes: list[Score]) -> None:
    rows = by_method(summary(two_scenes))
    best, of_each = "OIDN, best of 4 settings", "OIDN, best of each scene"
    assert list(rows) == ["noisy", "fast", "high", best, of_each, "ours"]
    # Means of A, B, C: 0.2, 0.16, 0.15. Best of each scene: 0.10 and 0.12.
    assert rows[best].values == pytest.approx({"SMAPE": 0.15, "PSNR": 28})
    assert rows[best].chosen == {"SMAPE": "C", "PSNR": "D"}
    assert rows[of_each].values == pytest.approx({"SMAPE": 0.11, "PSNR": 28})


def test_verdicts(two_scenes: list[Score]) -> None:
    smape, psnr = verdicts(two_scenes, "ours")
    assert (smape.metric, smape.value) == ("SMAPE", pytest.approx(0.11))
    assert (smape.single, smape.setting, smape.best) == (pytest.approx(0.15), "C", pytest.approx(0.11))
    assert smape.scenes == {"one": (0.09, 0.10), "two": (0.13, 0.12)}
    assert smape.ahead
    assert smape.won == ["one"]
    assert str(smape) == (
        "SMAPE: ours 0.11; OIDN's best single setting 0.15 (C): 0.733 times; its best setting of each scene 0.11: "
        "1.000 times; better in 1 of 2 scenes, not in two"
    )
    # 29 and 31 dB against 30 and 26 dB: higher is better, and 29 is not.
    assert psnr.ahead
    assert psnr.won == ["two"]
    assert "+2; its best setting of each scene 28: +2; better in 1 of 2 scenes, not in one" in str(psnr)


def test_a_worse_model_is_not_ahead(two_scenes: list[Score]) -> None:
    smape, psnr = verdicts(two_scenes, "noisy")
    assert not smape.ahead
    assert not psnr.ahead
    assert smape.won == psnr.won == []
    # As good is not better.
    assert not METRICS["SMAPE"].better(0.1, 0.1)
    with pytest.raises(ValueError, match="'ours' and of 'joint bilateral'"):
        verdicts(two_scenes, "ours", "joint bilateral")


def noted(write: Callable[[str], object], noise: object) -> None:
    write(json.dumps({"color_includes_albedo": True, "reference_noise": noise}))


def test_the_noise_of_the_references_is_the_renderers(small_sequence: Path) -> None:
    described = small_sequence / "inputs" / "camera.json"
    assert reference_noise(open_sequence(small_sequence)) is None
    # A reference without an estimate is left out.
    noted(described.write_text, {"0": 0.01, "1": 0.03, "2": None})
    for path in (small_sequence, small_sequence / "inputs"):
        assert reference_noise(open_sequence(path)) == pytest.approx(0.02)
    assert reference_noise(open_sequence(small_sequence, "1-3")) == pytest.approx(0.03)
    described.unlink()
    assert reference_noise(open_sequence(small_sequence)) is None


def test_a_metric_that_cannot_be_computed_is_left_out_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    scorer = Scorer("small", metrics=("SMAPE", "SSIM", "FLIP"))
    image = torch.full((1, 3, 10, 20), 0.5)
    scorer.add(Frame(color=image, reference=image), Images(image, image, image, image))
    (score, *_) = scorer.scores()
    assert score.values == {"SMAPE": 0}
    assert "11 x 11 pixels, found 10 x 20" in score.left_out["SSIM"]
    assert "flip-evaluator" in score.left_out["FLIP"]


def test_a_wrong_shape_is_not_left_out() -> None:
    scorer = Scorer("wrong")
    image = torch.full((1, 3, 12, 12), 0.5)
    small = image[..., :6]
    with pytest.raises(ValueError, match="reference: expected the shape of image"):
        scorer.add(Frame(color=image, reference=image), Images(image, image, small, image))
