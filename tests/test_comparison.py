"""Many methods, settings and scenes in short: means and the best settings."""

import pytest

from mcdenoise.benchmark import Score, folded, mean_over_scenes


def by_method(scores: list[Score]) -> dict[str, Score]:
    return {score.method: score for score in scores}


def score(scene: str, method: str, smape: float, psnr: float, quality: str = "") -> Score:
    about = {"family": "oidn", "settings": {"quality": quality, "trick": method}} if quality else {}
    return Score(scene, method, 2, {"SMAPE": smape, "PSNR": psnr}, **about)  # type: ignore[arg-type]


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
    rows = folded(two_scenes, ("quality",))
    methods = ["noisy", "oidn(quality=fast)", "oidn(quality=high)", "oidn, best of 4 settings", "ours"]
    assert [(row.scene, row.method) for row in rows] == [(s, m) for s in ("one", "two") for m in methods]
    one = by_method(rows[:5])
    assert one["oidn(quality=fast)"].values == {"SMAPE": 0.10, "PSNR": 21}
    assert one["oidn(quality=fast)"].chosen == {"SMAPE": "A", "PSNR": "B"}
    assert one["oidn, best of 4 settings"].values == {"SMAPE": 0.10, "PSNR": 30}
    assert one["oidn, best of 4 settings"].chosen == {"SMAPE": "A", "PSNR": "D"}
    assert one["ours"].values == {"SMAPE": 0.09, "PSNR": 29}


def test_one_setting_is_the_best_for_all_scenes(two_scenes: list[Score]) -> None:
    rows = by_method(folded(mean_over_scenes(two_scenes), ("quality",)))
    best = "oidn, best of 4 settings"
    assert list(rows) == ["noisy", "oidn(quality=fast)", "oidn(quality=high)", best, "ours"]
    # Means of A, B, C: 0.2, 0.16, 0.15.
    assert rows[best].values == pytest.approx({"SMAPE": 0.15, "PSNR": 28})
    assert rows[best].chosen == {"SMAPE": "C", "PSNR": "D"}
